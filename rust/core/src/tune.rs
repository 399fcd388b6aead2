//! Tuning of controller gains by simulated closed loops.
//!
//! A candidate's cost is taken over every plant and every reference, with encoder, filter and limits in the loop;
//! differential evolution searches the gains.

mod bench;
mod cost;
mod search;

pub use cost::{Cost, Terms, Weights, terms};

use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use sewfast_control::{Controller, Design, Settings};

use crate::closed_loop::{Plant, check_reference};
use crate::encoder::Encoder;
use crate::{Error, Monitor, Result};
use bench::Bench;
use search::{Bounds, Evolution, Trial};

/// What is tuned, on what.
#[derive(Clone, Debug)]
pub struct Task<'a, P> {
    /// Plants that one controller has to serve, each with the same weight.
    pub plants: &'a [P],
    /// References that it has to follow, each with the same weight.
    pub references: &'a [&'a [f64]],
    /// The encoder of plants that bring none; `None` for ideal feedback.
    pub encoder: Option<Encoder>,
    /// The controller to begin with; what is not searched is kept.
    pub start: Design<f64>,
    /// What counts how much.
    pub cost: Cost,
    /// How the plants' costs become one.
    pub aggregate: Aggregate,
}

/// How a candidate's costs on the plants become one; a plant's cost is the mean over the references.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Aggregate {
    /// The mean over the plants.
    #[default]
    Mean,
    /// The worst plant's.
    Worst,
}

/// How the search runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// Controllers tried, each on every plant and reference.
    pub evaluations: usize,
    /// Seed of the search; the result is the same at any number of threads.
    pub seed: u64,
    /// Threads.
    pub threads: usize,
}

/// Why the search ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Termination {
    /// All evaluations were used.
    Evaluations,
    /// All candidates had come together.
    Converged,
    /// A stop was requested; the best so far is returned.
    Interrupted,
}

impl Termination {
    /// The name of the outcome.
    pub fn name(self) -> &'static str {
        match self {
            Self::Evaluations => "evaluations",
            Self::Converged => "converged",
            Self::Interrupted => "interrupted",
        }
    }
}

/// The best controller and the story of its search.
#[derive(Clone, Debug, PartialEq)]
pub struct Tuned {
    /// Settings of the best controller.
    pub settings: Settings<f64>,
    /// Its cost.
    pub cost: f64,
    /// The cost of the start; infinite where it diverges.
    pub start_cost: f64,
    /// Controllers tried.
    pub evaluations: usize,
    /// The best cost after each generation, the start's first.
    pub trace: Vec<f64>,
    /// Why the search ended.
    pub termination: Termination,
    /// The weights in numbers.
    pub weights: Weights,
}

/// Searches `Kp`, `Ti`, `Td` (in their logarithms), `alpha`, `beta`, and `N` where the start has a finite one.
///
/// The bounds are wide multiples of the start and of the sample time; the sign of `Kp` is the start's. The result is
/// never worse than the start.
///
/// # Errors
/// `ErrorKind::Setting` for limits that are not finite or a start, weights or options out of range,
/// `ErrorKind::Data` for references that cannot be run, `ErrorKind::Fit` where every controller tried diverges.
pub fn tune<P: Plant + Clone + Send + Sync>(
    task: &Task<'_, P>,
    options: Options,
    monitor: &Monitor,
) -> Result<Tuned> {
    check(task, options)?;
    monitor.set_total(options.evaluations as u64);
    let mut benches = vec![Bench::new(task)?; options.threads];
    let start_cost = benches[0].cost(task, &task.start.pid, f64::INFINITY, monitor);
    let mut evolution = Evolution::new(Bounds::about(&task.start.pid), options.seed);
    let (mut used, mut trace) = (1, vec![start_cost]);
    let termination = loop {
        if monitor.stopped() {
            break Termination::Interrupted;
        } else if used >= options.evaluations {
            break Termination::Evaluations;
        } else if evolution.converged() {
            break Termination::Converged;
        }
        let trials = evolution.trials(options.evaluations - used);
        evolution.select(&trials, &evaluate(task, &mut benches, &trials, monitor));
        used += trials.len();
        trace.push(evolution.best_cost().min(start_cost));
    };
    let (settings, cost) = evolution.best_or(task.start.pid, start_cost);
    if !cost.is_finite() {
        return Err(Error::fit(format!(
            "expected gains with which no loop diverges, found none in {used} trials; begin with smaller gains, give \
             more evaluations, or check the model on new data first"
        )));
    }
    Ok(Tuned {
        settings,
        cost,
        start_cost,
        evaluations: used,
        trace,
        termination,
        weights: *benches[0].weights(),
    })
}

fn check<P>(task: &Task<'_, P>, options: Options) -> Result<()> {
    let controller = Controller::new(task.start)?;
    let Settings {
        u_min,
        u_max,
        gains,
        ..
    } = *controller.settings();
    if !(u_min.is_finite() && u_max.is_finite()) {
        return Err(Error::setting(format!(
            "expected finite output limits to tune within, got {u_min} and {u_max}; give those of the amplifier"
        )));
    }
    if !task.start.schedule.is_empty() {
        return Err(Error::setting(
            "expected a start with constant gains, got a gain schedule; leave it out while tuning",
        ));
    }
    if gains.kp == 0.0 {
        return Err(Error::setting(
            "expected a start with Kp other than 0, got 0; its sign says which way the plant acts",
        ));
    }
    if options.evaluations == 0 || options.threads == 0 {
        return Err(Error::setting(format!(
            "expected at least one evaluation and one thread, got {} and {}",
            options.evaluations, options.threads
        )));
    }
    if task.plants.is_empty() || task.references.is_empty() {
        return Err(Error::setting(format!(
            "expected at least one plant and one reference, got {} and {}",
            task.plants.len(),
            task.references.len()
        )));
    }
    task.references.iter().try_for_each(|r| check_reference(r))
}

/// Costs of the trials, by as many threads as there are benches; who computes what has no part in the result.
fn evaluate<P: Plant + Clone + Send + Sync>(
    task: &Task<'_, P>,
    benches: &mut [Bench<P>],
    trials: &[Trial],
    monitor: &Monitor,
) -> Vec<f64> {
    let next = AtomicUsize::new(0);
    let work = |bench: &mut Bench<P>| {
        let mut done = Vec::new();
        while let Some(trial) = trials.get(next.fetch_add(1, Ordering::Relaxed)) {
            let cost = bench.cost(task, &trial.settings, trial.to_beat, monitor);
            monitor.advance(1);
            monitor.report_cost(cost);
            done.push((trial.index, cost));
        }
        done
    };
    let mut costs = vec![f64::INFINITY; trials.len()];
    thread::scope(|scope| {
        let workers: Vec<_> = benches
            .iter_mut()
            .map(|bench| scope.spawn(|| work(bench)))
            .collect();
        for worker in workers {
            let done = worker
                .join()
                .unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            for (index, cost) in done {
                costs[index] = cost;
            }
        }
    });
    costs
}

#[cfg(test)]
mod tests;
