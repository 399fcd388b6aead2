//! Which iterate of a start is kept: the best on the validation data, else the best on the training data.

use super::free_run;
use super::network::Network;
use super::problem::Experiment;
use super::train::{InitialState, Training};
use crate::data::window;
use crate::lagged::{Lagged, STATE_SAMPLES};

/// Keeps the best iterate of a start: on the validation data, else on the training data.
pub(super) struct Referee<'t> {
    training: &'t Training<'t>,
    network: Network,
    /// Score, validation J, all parameters, cost.
    pub best: Option<(f64, Option<f64>, Vec<f64>, f64)>,
}

impl<'t> Referee<'t> {
    pub fn new(training: &'t Training<'t>) -> Self {
        let network = Network::zero(training.shape, training.limits);
        Self {
            training,
            network,
            best: None,
        }
    }

    pub fn judge(&mut self, all: &[f64], theta: &[f64], cost: f64) {
        self.network.load(theta);
        let validation = (!self.training.validation.is_empty()).then(|| self.validation_cost());
        let score = validation.unwrap_or(cost);
        if self.best.as_ref().is_none_or(|b| score < b.0) {
            self.best = Some((score, validation, all.to_vec(), cost));
        }
    }

    /// J over all validation experiments; infinite where one diverges.
    fn validation_cost(&self) -> f64 {
        let scores = self.training.validation.iter().map(|e| self.score(e));
        let (sum, samples) = scores.fold((0.0, 0.0), |(sum, n), (s, m)| (sum + s, n + m));
        let cost = 0.5 * sum / samples;
        if cost.is_nan() { f64::INFINITY } else { cost }
    }

    /// Sum of squared errors and of the weights of the measured samples it is taken over.
    fn score(&self, experiment: &Experiment) -> (f64, f64) {
        let lags = self.network.shape.lags;
        let estimated = self.training.settings.initial_state == InitialState::Estimated;
        let half = (experiment.measured() / 2).max(1);
        let (first, skipped) = if estimated {
            let known = window(&experiment.y, STATE_SAMPLES.min(half));
            (0, known.unwrap_or(experiment.y.len()))
        } else {
            (experiment.first, experiment.first)
        };
        let state = match estimated {
            true => {
                let u = &experiment.u[..skipped * lags.channels];
                self.network
                    .estimate_initial_state(u, lags.channels, &experiment.y[..skipped])
            }
            false => Ok(experiment.state.clone()),
        };
        let Ok(state) = state else {
            return (f64::INFINITY, 1.0);
        };
        let samples = experiment.y.len() - first;
        let run = free_run::outputs(&self.network, &experiment.u, first, &state, samples);
        if run.last().is_none_or(|y| y.is_nan()) {
            return (f64::INFINITY, 1.0);
        }
        let squares = experiment.squares_from(skipped, &run[skipped - first..]);
        (squares, experiment.weight_from(skipped))
    }
}
