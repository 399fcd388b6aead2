//! One thread's plants and memory: a controller's terms and cost over all plants and references.

use sewfast_control::{Controller, Design, Settings};

use super::cost::{Measure, Terms, Weights};
use super::{Aggregate, LoadLimit, Task};
use crate::closed_loop::{Outcome, Plant, Run};
use crate::search::Judgement;
use crate::{Monitor, Result};

/// Largest minus smallest value of all references.
fn span(references: &[&[f64]]) -> f64 {
    let all = || references.iter().flat_map(|r| r.iter().copied());
    all().fold(f64::MIN, f64::max) - all().fold(f64::MAX, f64::min)
}

#[derive(Clone, Debug)]
pub(super) struct Bench<P> {
    plants: Vec<P>,
    measures: Vec<Measure>,
    weights: Weights,
    run: Run,
}

impl<P: Plant + Clone> Bench<P> {
    pub(super) fn new(task: &Task<'_, P>) -> Result<Self> {
        let Settings { u_min, u_max, .. } = task.start.pid;
        let weights = task.cost.weights(span(task.references), u_max - u_min)?;
        let longest = (0..task.runs()).map(|k| task.signals(k).reference.len());
        let longest = longest.max().unwrap_or(0);
        let measure = |r: &&[f64]| {
            let measure = Measure::needed(r, &weights);
            match task.constraints.overshoot {
                Some(_) => measure.with_overshoot(),
                None => measure,
            }
        };
        Ok(Self {
            plants: task.plants.to_vec(),
            measures: task.references.iter().map(measure).collect(),
            weights,
            run: Run::with_capacity(longest),
        })
    }

    /// The same, for values of which every term is wanted.
    pub(super) fn with_all_terms(mut self, task: &Task<'_, P>) -> Self {
        self.measures = task.references.iter().map(|r| Measure::all(r)).collect();
        self
    }

    pub(super) fn weights(&self) -> &Weights {
        &self.weights
    }

    /// How good a controller is; hopeless where a run diverges or on a stop.
    ///
    /// The work ends as soon as it cannot beat `to_beat` any more: a cost is then what it costs at least.
    pub(super) fn judge(
        &mut self,
        task: &Task<'_, P>,
        design: &Design<f64>,
        to_beat: &Judgement,
        monitor: &Monitor,
    ) -> Judgement {
        let Ok(mut controller) = Controller::new(*design) else {
            return Judgement::HOPELESS;
        };
        let loops = task.constraints.of_loops(design);
        let (mut total, mut largest) = (Total::default(), Terms::default());
        let mut late = 0.0;
        for plant in 0..self.plants.len() {
            for run in 0..task.runs() {
                let Some(terms) = self.run(task, plant, run, &mut controller, monitor) else {
                    return Judgement::HOPELESS;
                };
                largest = largest.max(&terms);
                late = f64::max(late, task.constraints.of_load(plant, &terms));
                total.add(self.weights.of(&terms) / task.alike(run));
                let least = Judgement {
                    violation: loops + late + task.constraints.of_runs(&largest),
                    cost: total.lower_bound(task),
                };
                // Later runs can only add to either.
                if to_beat.beats(&least) {
                    return least;
                }
            }
            total.next_plant();
        }
        Judgement {
            violation: loops + late + task.constraints.of_runs(&largest),
            cost: total.lower_bound(task),
        }
    }

    /// Terms over all plants and references, as the task aggregates them, and the violation of its constraints; `None`
    /// where a run diverges or on a stop.
    pub(super) fn terms(
        &mut self,
        task: &Task<'_, P>,
        design: &Design<f64>,
        monitor: &Monitor,
    ) -> Option<(Terms, f64)> {
        let mut controller = Controller::new(*design).ok()?;
        let (mut sum, mut worst) = (Terms::default(), Terms::default());
        let (mut largest, mut late) = (Terms::default(), 0.0);
        for plant in 0..self.plants.len() {
            let mut own = Terms::default();
            for run in 0..task.runs() {
                let terms = self.run(task, plant, run, &mut controller, monitor)?;
                largest = largest.max(&terms);
                late = f64::max(late, task.constraints.of_load(plant, &terms));
                own = own.plus(&terms, 1.0 / task.alike(run));
            }
            sum = sum.plus(&own, 1.0 / self.plants.len() as f64);
            worst = worst.max(&own);
        }
        let violation =
            task.constraints.of_loops(design) + late + task.constraints.of_runs(&largest);
        let terms = match task.aggregate {
            Aggregate::Mean => sum,
            Aggregate::Worst => worst,
        };
        Some((terms, violation))
    }

    /// What each plant does under the load steps, the worst of all of them; `None` where a run diverges or on a stop.
    pub(super) fn loaded(
        &mut self,
        task: &Task<'_, P>,
        design: &Design<f64>,
        monitor: &Monitor,
    ) -> Option<Vec<LoadLimit>> {
        let mut controller = Controller::new(*design).ok()?;
        let mut all = Vec::with_capacity(self.plants.len());
        for plant in 0..self.plants.len() {
            let mut worst = Terms::default();
            for run in 0..task.loads.len() {
                worst = worst.max(&self.run(task, plant, run, &mut controller, monitor)?);
            }
            all.push(LoadLimit {
                recovery: worst.recovery,
                load: worst.load,
            });
        }
        Some(all)
    }

    /// The terms of one run on one plant; `None` where it diverges or on a stop.
    fn run(
        &mut self,
        task: &Task<'_, P>,
        plant: usize,
        run: usize,
        controller: &mut Controller<f64>,
        monitor: &Monitor,
    ) -> Option<Terms> {
        let signals = task.signals(run);
        let (plant, encoder) = (&mut self.plants[plant], task.encoder.as_ref());
        self.run
            .record_with(plant, controller, signals, encoder, monitor);
        if self.run.outcome != Outcome::Completed || monitor.stopped() {
            return None;
        }
        let Settings {
            u_min, u_max, ts, ..
        } = *controller.settings();
        if let Some(load) = task.loads.get(run) {
            return Some(load.terms(&self.run, ts));
        }
        let measure = &self.measures[run - task.loads.len()];
        Some(measure.of(signals.reference, &self.run, (u_min, u_max), ts))
    }
}

/// The costs so far.
#[derive(Clone, Copy, Debug, Default)]
struct Total {
    finished: f64,
    worst: f64,
    own: f64,
}

impl Total {
    fn add(&mut self, cost: f64) {
        self.own += cost;
    }

    fn next_plant(&mut self) {
        self.finished += self.own;
        self.worst = self.worst.max(self.own);
        self.own = 0.0;
    }

    fn lower_bound<P>(&self, task: &Task<'_, P>) -> f64 {
        match task.aggregate {
            Aggregate::Mean => (self.finished + self.own) / task.plants.len() as f64,
            Aggregate::Worst => self.worst.max(self.own),
        }
    }
}
