//! What a candidate costs: tracking error, chatter, overshoot, saturation, over all plants and references.

use sewfast_control::{Controller, Settings};

use super::Task;
use crate::closed_loop::{Outcome, Plant, Run};
use crate::metrics::{Edge, Effort, rmse, smooth};
use crate::{Error, Monitor, Result};

/// What counts how much beside the tracking error, in shares of the references' span `R` (largest minus smallest value).
///
/// The cost of a run is, in the output's unit,
///
/// ```text
/// rms(r - y) + R (chatter rms(du)/(u_max - u_min) + overshoot max(o - overshoot_limit, 0)/100 + saturation s)
/// ```
///
/// with `du` the change of the command from sample to sample, `o` the overshoot in percent where the reference is a
/// step or trapezoid, and `s` the share of samples at a limit. A run that diverges costs infinitely much.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Weight of the command's restlessness.
    pub chatter: f64,
    /// Weight of the overshoot above its limit.
    pub overshoot: f64,
    /// Overshoot that costs nothing \[%\].
    pub overshoot_limit: f64,
    /// Weight of the time at a limit.
    pub saturation: f64,
}

impl Default for Weights {
    fn default() -> Self {
        Self {
            chatter: 0.5,
            overshoot: 1.0,
            overshoot_limit: 1.0,
            saturation: 0.02,
        }
    }
}

impl Weights {
    pub(super) fn check(&self) -> Result<()> {
        let all = [
            ("chatter", self.chatter),
            ("overshoot", self.overshoot),
            ("overshoot_limit", self.overshoot_limit),
            ("saturation", self.saturation),
        ];
        match all.iter().find(|(_, w)| !(*w >= 0.0 && w.is_finite())) {
            None => Ok(()),
            Some((name, weight)) => Err(Error::setting(format!(
                "expected a finite weight of 0 or more for {name}, got {weight}"
            ))),
        }
    }
}

/// Smoothing of the true output before its overshoot is taken [s]; docs/CONVENTIONS.md.
const SMOOTHING: f64 = 5e-3;

/// One thread's plants and memory.
#[derive(Clone, Debug)]
pub(super) struct Bench<P> {
    plants: Vec<P>,
    edges: Vec<Option<Edge>>,
    span: f64,
    run: Run,
}

impl<P: Plant + Clone> Bench<P> {
    pub(super) fn new(task: &Task<'_, P>) -> Self {
        let all = || task.references.iter().flat_map(|r| r.iter().copied());
        let longest = task.references.iter().map(|r| r.len()).max().unwrap_or(0);
        Self {
            plants: task.plants.to_vec(),
            edges: task.references.iter().map(|r| Edge::first(r)).collect(),
            span: all().fold(f64::MIN, f64::max) - all().fold(f64::MAX, f64::min),
            run: Run::with_capacity(longest),
        }
    }

    /// The cost of a controller; infinite as soon as it cannot be below `to_beat` any more, or on a stop.
    pub(super) fn cost(
        &mut self,
        task: &Task<'_, P>,
        settings: &Settings<f64>,
        to_beat: f64,
        monitor: &Monitor,
    ) -> f64 {
        let controller = Controller::new(*settings, task.filter_samples, task.filter_time);
        let Ok(mut controller) = controller else {
            return f64::INFINITY;
        };
        let runs = (self.plants.len() * task.references.len()) as f64;
        let mut sum = 0.0;
        for plant in 0..self.plants.len() {
            for reference in 0..task.references.len() {
                sum += self.one(task, plant, reference, &mut controller, monitor);
                let hopeless = sum > to_beat * runs || !sum.is_finite();
                if hopeless || monitor.stopped() {
                    return f64::INFINITY;
                }
            }
        }
        sum / runs
    }

    fn one(
        &mut self,
        task: &Task<'_, P>,
        plant: usize,
        reference: usize,
        controller: &mut Controller<f64>,
        monitor: &Monitor,
    ) -> f64 {
        let (r, edge) = (task.references[reference], self.edges[reference]);
        let plant = &mut self.plants[plant];
        self.run
            .record(plant, controller, r, task.encoder.as_ref(), monitor);
        if self.run.outcome != Outcome::Completed {
            return f64::INFINITY;
        }
        let Settings {
            u_min, u_max, ts, ..
        } = *controller.settings();
        let effort = Effort::of(&self.run.u, u_min, u_max);
        let overshoot = edge.map_or(0.0, |edge| {
            edge.overshoot_percent(&smooth(&self.run.y, ts, SMOOTHING))
        });
        let w = &task.weights;
        let penalty = w.chatter * effort.du_rms / (u_max - u_min)
            + w.overshoot * (overshoot - w.overshoot_limit).max(0.0) / 100.0
            + w.saturation * effort.saturated;
        rmse(r, &self.run.y) + self.span * penalty
    }
}
