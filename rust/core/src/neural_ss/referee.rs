//! Which iterate of a start is kept: the best on the validation data, else the best on the training data.

use super::free_run::{self, Trajectory};
use super::network::{Network, Scratch};
use super::problem::{Attempts, Experiment};
use super::state::{self, Statistics};
use crate::Monitor;
use crate::lagged::STATE_SAMPLES;

/// Least residual variance, relative to the output's: below it is rounding.
const LEAST_VARIANCE: f64 = 1e-12;

/// The iterate kept.
pub(super) struct Best {
    score: f64,
    pub validation_cost: Option<f64>,
    pub theta: Vec<f64>,
    pub cost: f64,
}

/// Keeps the best iterate of a start.
pub(super) struct Referee<'a> {
    network: Network,
    experiments: &'a [Experiment],
    attempts: &'a Attempts,
    validation: &'a [Experiment],
    monitor: &'a Monitor,
    /// The last iterate's initial states of the validation experiments.
    states: Vec<Option<Vec<f64>>>,
    own: Vec<Trajectory>,
    scratch: Scratch,
    pub best: Option<Best>,
}

impl<'a> Referee<'a> {
    pub fn new(
        network: Network,
        experiments: &'a [Experiment],
        attempts: &'a Attempts,
        validation: &'a [Experiment],
        monitor: &'a Monitor,
    ) -> Self {
        let own = validation
            .iter()
            .map(|e| Trajectory::new(&network, e.y.len()));
        Self {
            own: own.collect(),
            scratch: Scratch::new(network.shape),
            states: vec![None; validation.len()],
            network,
            experiments,
            attempts,
            validation,
            monitor,
            best: None,
        }
    }

    /// Judges an accepted iterate whose training run is stored; `error` is its cost without weight decay.
    pub fn judge(&mut self, all: &[f64], cost: f64, error: f64) {
        self.network.load(&all[..self.network.shape.parameters()]);
        let validation_cost = (!self.validation.is_empty()).then(|| self.validation_cost(all));
        let score = validation_cost.unwrap_or(cost);
        if self.best.as_ref().is_none_or(|best| score < best.score) {
            self.best = Some(Best {
                score,
                validation_cost,
                theta: all.to_vec(),
                cost: error,
            });
        }
    }

    /// J over all validation experiments, without the samples from which their states are estimated; infinite if one
    /// diverges.
    fn validation_cost(&mut self, all: &[f64]) -> f64 {
        let statistics = statistics(&self.network, self.experiments, &self.attempts.at(all));
        let (mut sum, mut samples) = (0.0, 0.0);
        for i in 0..self.validation.len() {
            let Some((squares, known)) = self.score(i, &statistics) else {
                return f64::INFINITY;
            };
            (sum, samples) = (sum + squares, samples + known);
        }
        let cost = 0.5 * sum / samples;
        if cost.is_nan() { f64::INFINITY } else { cost }
    }

    /// Sum of squared errors, and of the weights of the outputs in it.
    fn score(&mut self, i: usize, statistics: &Statistics) -> Option<(f64, f64)> {
        let Experiment { v, y, .. } = &self.validation[i];
        let skipped = STATE_SAMPLES.min(y.len() / 2);
        let first_v = &v[..skipped * self.network.shape.inputs];
        let first_y = &y[..skipped];
        let state = match self.states[i].take() {
            Some(last) => {
                let starts = [last, statistics.state_mean.clone()];
                state::update(&self.network, statistics, first_v, first_y, &starts)
            }
            None => state::estimate(&self.network, statistics, first_v, first_y, &[]),
        };
        let state = state?;
        let run = &mut self.own[i];
        let found = free_run::alone(
            &self.network,
            v,
            &state,
            run,
            &mut self.scratch,
            self.monitor,
        );
        self.states[i] = Some(state);
        if !found {
            return None;
        }
        let (sums, output) = (&run.sums, self.network.output);
        let known = (skipped..y.len()).filter(|&k| !y[k].is_nan());
        let errors = known.map(|k| (y[k] - output.value(sums[k]), self.validation[i].weight(k)));
        Some(errors.fold((0.0, 0.0), |(sum, known), (e, w)| {
            (sum + w * (e * e), known + w)
        }))
    }
}

/// Statistics of states and residuals from the runs over the training data.
pub(super) fn statistics(
    network: &Network,
    experiments: &[Experiment],
    runs: &[Trajectory],
) -> Statistics {
    let nx = network.shape.nx;
    let states = || runs.iter().flat_map(|run| run.states.chunks_exact(nx));
    let count = states().count() as f64;
    let mut mean = vec![0.0; nx];
    for x in states() {
        mean.iter_mut()
            .zip(x)
            .for_each(|(mean, x)| *mean += x / count);
    }
    let mut covariance = vec![0.0; nx * nx];
    for x in states() {
        for i in 0..nx {
            for j in 0..=i {
                covariance[i * nx + j] += (x[i] - mean[i]) * (x[j] - mean[j]) / count;
            }
        }
    }
    (0..nx).for_each(|i| (0..i).for_each(|j| covariance[j * nx + i] = covariance[i * nx + j]));
    let errors = runs.iter().zip(experiments).flat_map(|(run, e)| {
        let known = (0..e.y.len()).filter(|&i| !e.y[i].is_nan());
        known.map(|i| (e.y[i] - network.output.value(run.sums[i]), e.weight(i)))
    });
    let (sum, known) = errors.fold((0.0, 0.0), |(sum, n), (e, w)| (sum + w * (e * e), n + w));
    let variance: f64 = if known > 0.0 { sum / known } else { 0.0 };
    Statistics {
        state_mean: mean,
        residual_variance: match variance.is_finite() {
            true => variance.max(LEAST_VARIANCE),
            false => 1.0,
        },
        state_covariance: covariance,
        process_noise: 0.0,
    }
}
