//! One thread's plants and memory: terms and costs of controllers over all plants and references.

use sewfast_control::{AnyController, AnyDesign, Controller};

use super::batch::{Batch, Runs};
use super::cost::{Measure, Terms, Weights};
use super::{Aggregate, LoadLimit, Task};
use crate::closed_loop::batch::MOST;
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
    batch: Batch,
}

/// Candidates that are best judged at once.
pub(super) const TOGETHER: usize = MOST;

impl<P: Plant + Clone> Bench<P> {
    pub(super) fn new(task: &Task<'_, P>) -> Result<Self> {
        let (u_min, u_max) = task.start.limits();
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
            batch: Batch::default(),
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

    /// How good a controller is.
    pub(super) fn judge_one(
        &mut self,
        task: &Task<'_, P>,
        design: &AnyDesign<f64>,
        monitor: &Monitor,
    ) -> Judgement {
        let judged = self.judge(task, &[(*design, Judgement::HOPELESS)], monitor);
        judged.first().copied().unwrap_or(Judgement::HOPELESS)
    }

    /// How good controllers are, each with what it has to beat; hopeless where a run diverges or on a stop.
    ///
    /// The work on one ends as soon as it cannot beat that any more: a cost is then what it costs at least.
    pub(super) fn judge(
        &mut self,
        task: &Task<'_, P>,
        trials: &[(AnyDesign<f64>, Judgement)],
        monitor: &Monitor,
    ) -> Vec<Judgement> {
        let weights = self.weights;
        let designs = trials.iter().map(|(design, _)| design);
        let loops: Vec<f64> = designs.map(|d| task.constraints.of_loops(d)).collect();
        let mut totals = vec![Total::default(); trials.len()];
        let mut judgements = vec![Judgement::HOPELESS; trials.len()];
        let designs = trials.iter().map(|(design, _)| *design).collect();
        self.each_run(task, designs, monitor, |i, plant, run, terms| {
            let Some(terms) = terms else {
                judgements[i] = Judgement::HOPELESS;
                return false;
            };
            let total = &mut totals[i];
            total.go_to(plant);
            total.largest = total.largest.max(&terms);
            total.late = f64::max(total.late, task.constraints.of_load(plant, &terms));
            total.own += weights.of(&terms) / task.alike(run);
            judgements[i] = Judgement {
                violation: loops[i] + total.late + task.constraints.of_runs(&total.largest),
                cost: total.lower_bound(task),
            };
            // Later runs can only add to either.
            !trials[i].1.beats(&judgements[i])
        });
        judgements
    }

    /// Terms over all plants and references, as the task aggregates them, and the violation of its constraints; `None`
    /// where a run diverges or on a stop.
    pub(super) fn terms(
        &mut self,
        task: &Task<'_, P>,
        designs: &[AnyDesign<f64>],
        monitor: &Monitor,
    ) -> Vec<Option<(Terms, f64)>> {
        let mut means = vec![Some(Mean::default()); designs.len()];
        self.each_run(task, designs.to_vec(), monitor, |i, plant, run, terms| {
            let (Some(terms), Some(mean)) = (terms, &mut means[i]) else {
                means[i] = None;
                return false;
            };
            mean.go_to(plant, task);
            mean.largest = mean.largest.max(&terms);
            mean.late = f64::max(mean.late, task.constraints.of_load(plant, &terms));
            mean.own = mean.own.plus(&terms, 1.0 / task.alike(run));
            true
        });
        let aggregated = |(mean, design): (Option<Mean>, &AnyDesign<f64>)| {
            let mut mean = mean?;
            mean.go_to(task.plants.len(), task);
            let runs = mean.late + task.constraints.of_runs(&mean.largest);
            let terms = match task.aggregate {
                Aggregate::Mean => mean.sum,
                Aggregate::Worst => mean.worst,
            };
            Some((terms, task.constraints.of_loops(design) + runs))
        };
        means.into_iter().zip(designs).map(aggregated).collect()
    }

    /// Runs every controller over every run on every plant; `take` is told of the controller's place, the plant, the run
    /// and its terms, `None` where it diverges or on a stop, and says whether to go on with that controller.
    fn each_run(
        &mut self,
        task: &Task<'_, P>,
        designs: Vec<AnyDesign<f64>>,
        monitor: &Monitor,
        mut take: impl FnMut(usize, usize, usize, Option<Terms>) -> bool,
    ) {
        let made = designs.iter().map(AnyDesign::controller).enumerate();
        let mut open: Vec<_> = made.filter_map(|(i, made)| Some((i, made.ok()?))).collect();
        for plant in 0..self.plants.len() {
            for run in 0..task.runs() {
                let mut all = self
                    .several(task, plant, run, &mut open, monitor)
                    .into_iter();
                open.retain(|(i, _)| take(*i, plant, run, all.next().flatten()));
            }
        }
    }

    /// The terms of one run with each controller on one plant: side by side where plant and controllers allow it.
    fn several(
        &mut self,
        task: &Task<'_, P>,
        plant: usize,
        run: usize,
        open: &mut [(usize, AnyController<f64>)],
        monitor: &Monitor,
    ) -> Vec<Option<Terms>> {
        let controllers: Vec<&AnyController<f64>> = open.iter().map(|(_, c)| c).collect();
        match self.plants[plant].known() {
            Some(known) if Batch::take(&controllers) => {
                let course = Runs {
                    known,
                    signals: task.signals(run),
                    encoder: task.encoder.as_ref(),
                    load: task.loads.get(run),
                    measure: run.checked_sub(task.loads.len()).map(|r| self.measures[r]),
                };
                self.batch.terms(&course, &controllers, monitor)
            }
            _ => open
                .iter_mut()
                .map(|(_, controller)| self.run(task, plant, run, controller, monitor))
                .collect(),
        }
    }

    /// What each plant does under the load steps, the worst of all of them; `None` where a run diverges or on a stop.
    pub(super) fn loaded(
        &mut self,
        task: &Task<'_, P>,
        design: &AnyDesign<f64>,
        monitor: &Monitor,
    ) -> Option<Vec<LoadLimit>> {
        let mut controller = design.controller().ok()?;
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
        controller: &mut AnyController<f64>,
        monitor: &Monitor,
    ) -> Option<Terms> {
        let signals = task.signals(run);
        let (plant, encoder) = (&mut self.plants[plant], task.encoder.as_ref());
        self.run
            .record_with(plant, controller, signals, encoder, monitor);
        if self.run.outcome != Outcome::Completed || monitor.stopped() {
            return None;
        }
        let ts = controller.ts();
        if let Some(load) = task.loads.get(run) {
            return Some(load.terms(&self.run, ts));
        }
        let measure = &self.measures[run - task.loads.len()];
        Some(measure.of(signals.reference, &self.run, controller.limits(), ts))
    }
}

/// The costs of a controller so far.
#[derive(Clone, Copy, Debug, Default)]
struct Total {
    plant: usize,
    finished: f64,
    worst: f64,
    own: f64,
    /// The largest of each term of all runs.
    largest: Terms,
    /// The largest violation under a load step.
    late: f64,
}

impl Total {
    fn go_to(&mut self, plant: usize) {
        if plant != self.plant {
            self.finished += self.own;
            self.worst = self.worst.max(self.own);
            (self.plant, self.own) = (plant, 0.0);
        }
    }

    fn lower_bound<P>(&self, task: &Task<'_, P>) -> f64 {
        match task.aggregate {
            Aggregate::Mean => (self.finished + self.own) / task.plants.len() as f64,
            Aggregate::Worst => self.worst.max(self.own),
        }
    }
}

/// The terms of a controller so far.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    plant: usize,
    sum: Terms,
    worst: Terms,
    own: Terms,
    largest: Terms,
    late: f64,
}

impl Mean {
    fn go_to<P>(&mut self, plant: usize, task: &Task<'_, P>) {
        if plant != self.plant {
            self.sum = self.sum.plus(&self.own, 1.0 / task.plants.len() as f64);
            self.worst = self.worst.max(&self.own);
            (self.plant, self.own) = (plant, Terms::default());
        }
    }
}
