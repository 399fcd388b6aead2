//! One thread's plants and memory: a controller's cost over all plants and references.

use sewfast_control::{Controller, Design, Settings};

use super::cost::{Measure, Weights};
use super::{Aggregate, Task};
use crate::closed_loop::{Outcome, Plant, Run};
use crate::{Monitor, Result};

/// Largest minus smallest value of all references.
pub(super) fn span(references: &[&[f64]]) -> f64 {
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
        let longest = task.references.iter().map(|r| r.len()).max().unwrap_or(0);
        let measure = |r: &&[f64]| Measure::needed(r, &weights);
        Ok(Self {
            plants: task.plants.to_vec(),
            measures: task.references.iter().map(measure).collect(),
            weights,
            run: Run::with_capacity(longest),
        })
    }

    pub(super) fn weights(&self) -> &Weights {
        &self.weights
    }

    /// The cost of a controller; infinite as soon as it cannot be below `to_beat` any more, or on a stop.
    pub(super) fn cost(
        &mut self,
        task: &Task<'_, P>,
        settings: &Settings<f64>,
        to_beat: f64,
        monitor: &Monitor,
    ) -> f64 {
        let controller = Controller::new(Design {
            pid: *settings,
            ..task.start
        });
        let Ok(mut controller) = controller else {
            return f64::INFINITY;
        };
        let references = task.references.len() as f64;
        let (mut sum, mut worst) = (0.0, 0.0);
        for plant in 0..self.plants.len() {
            let mut own = 0.0;
            for reference in 0..task.references.len() {
                own += self.one(task, plant, reference, &mut controller, monitor) / references;
                let lower_bound = task.aggregate.of(sum + own, f64::max(worst, own), task);
                if lower_bound > to_beat || !lower_bound.is_finite() || monitor.stopped() {
                    return f64::INFINITY;
                }
            }
            sum += own;
            worst = f64::max(worst, own);
        }
        task.aggregate.of(sum, worst, task)
    }

    fn one(
        &mut self,
        task: &Task<'_, P>,
        plant: usize,
        reference: usize,
        controller: &mut Controller<f64>,
        monitor: &Monitor,
    ) -> f64 {
        let r = task.references[reference];
        let plant = &mut self.plants[plant];
        self.run
            .record(plant, controller, r, task.encoder.as_ref(), monitor);
        if self.run.outcome != Outcome::Completed {
            return f64::INFINITY;
        }
        let Settings {
            u_min, u_max, ts, ..
        } = *controller.settings();
        let terms = self.measures[reference].of(r, &self.run, (u_min, u_max), ts);
        self.weights.of(&terms)
    }
}

impl Aggregate {
    /// Over plants, of the sum of their costs and of the largest.
    fn of<P>(self, sum: f64, worst: f64, task: &Task<'_, P>) -> f64 {
        match self {
            Self::Mean => sum / task.plants.len() as f64,
            Self::Worst => worst,
        }
    }
}
