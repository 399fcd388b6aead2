//! Fits the free run of any lagged model by Levenberg-Marquardt, from the derivatives of one step.
//!
//! A model `y(k) = f(phi(k); theta)` that knows its gradient ([`Parametric`]) gets its sensitivities and its fit from
//! here. With `S(k) = dy(k)/d(theta, y_past)` the chain rule along the free run is
//!
//! ```text
//! S(k) = [df/dtheta  0](k) + sum_m (df/dy(k-m)) S(k-m),    S(-m) = [0  e_m]
//! ```
//!
//! Row by row this is a recursion with gains that change from sample to sample, which [`Gram`] provides. The parameters of a fit are
//! theta, then the past outputs of each experiment, so `J'J` is full for theta and block-diagonal for the past outputs.

use std::ops::Range;

use crate::data::weighted_squares;
use crate::gram::Gram;
use crate::lagged::{Lagged, push_past};
use crate::lm::{self, Damping, Outcome, Problem};
use crate::model::{Differentiable, RunAndRows};
use crate::monitor::look;
use crate::{Error, Monitor, Record, Result};

/// A lagged model that is a function of its parameters.
pub trait Parametric: Lagged + Clone + Send + Sync {
    /// The parameters.
    fn theta(&self) -> Vec<f64>;

    /// The same structure with other parameters; `None` if these make no stable model.
    fn with_theta(&self, theta: &[f64]) -> Option<Self>;

    /// The output; writes its derivatives with respect to the parameters and to the regressor, into slices of their lengths.
    fn gradient(&self, phi: &[f64], by_theta: &mut [f64], by_phi: &mut [f64]) -> f64;

    /// The parameters that a fit holds near 0 if the data do not determine them; each is of size 1.
    fn shrunk(&self) -> Range<usize>;
}

impl<M: Parametric> Differentiable for M {
    fn theta(&self) -> Vec<f64> {
        Parametric::theta(self)
    }

    fn slopes(&self, phi: &[f64]) -> Vec<f64> {
        let (mut by_theta, mut by_phi) = (vec![0.0; self.theta().len()], vec![0.0; phi.len()]);
        self.gradient(phi, &mut by_theta, &mut by_phi);
        by_phi
    }

    fn jacobian(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<RunAndRows> {
        let run = Lagged::simulate(self, u, channels, y_past)?;
        let (lags, parameters) = (self.lags(), Parametric::theta(self).len());
        let (na, columns) = (lags.na, parameters + lags.na);
        // the rows of the past outputs themselves come first, the oldest one on top
        let mut rows = vec![0.0; (na + run.len()) * columns];
        // dy(-1-i)/dy_past_i = 1: the unit matrix, the newest past output in the last of these rows.
        for i in 0..na {
            rows[(na - 1 - i) * columns + parameters + i] = 1.0;
        }
        let mut phi = vec![0.0; lags.regressors()];
        let mut by_phi = phi.clone();
        phi[..na].copy_from_slice(y_past);
        for (k, &y) in run.iter().enumerate() {
            lags.write_inputs(u, k, &mut phi[na..]);
            // All rows before this one, and the place of this one: S(k-m) is the m-th from the end.
            let (before, rest) = rows.split_at_mut((na + k) * columns);
            let row = &mut rest[..columns];
            self.gradient(&phi, &mut row[..parameters], &mut by_phi);
            // S(k) = df/dtheta + sum_m df/dy(k-m) S(k-m); the columns of y_past have only the second part.
            for (gain, old) in by_phi[..na].iter().zip(before.rchunks_exact(columns)) {
                for (value, old) in row.iter_mut().zip(old) {
                    *value += gain * old;
                }
            }
            push_past(&mut phi[..na], y);
        }
        // The rows of the past outputs are no samples.
        rows.drain(..na * columns);
        Ok((run, rows))
    }
}

/// A model fitted in free run.
#[derive(Clone, Debug)]
pub struct Fit<M> {
    /// The model.
    pub model: M,
    /// `1/(2N) sum e^2` in free run, in the output's unit squared, without the ridge.
    pub cost: f64,
    /// Iterations.
    pub iterations: usize,
    /// How the iteration ended.
    pub termination: lm::Termination,
    /// The minimised cost, including the ridge, at the start and after each accepted step.
    pub trace: Vec<f64>,
    /// Past outputs of each experiment, newest first, as estimated with the model.
    pub initial_states: Vec<Vec<f64>>,
}

/// Fits the free run of `start`'s structure to all experiments, from its parameters and from past outputs.
///
/// The cost includes `ridge` times half the sum of the squares of the shrunk parameters, in units of the output's variance. A parameter
/// that the data do not determine stays at 0; one that they do determine is moved by about `ridge`.
///
/// # Errors
/// `ErrorKind::Data` for fewer samples than unknowns, `ErrorKind::Fit` if the start has no finite free run.
pub fn fit<M: Parametric>(
    start: &M,
    initial_states: &[Vec<f64>],
    records: &[Record],
    ridge: f64,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<Fit<M>> {
    // Initial states are parameters, after theta: the model would have to explain errors caused by wrong past outputs.
    let theta = [Parametric::theta(start), initial_states.concat()].concat();
    let mut problem = FreeRun::new(start.clone(), records, ridge, monitor)?;
    let settings = lm::Settings {
        max_iterations,
        // The parameters have different units: a, b and the bends of a curve.
        damping: Damping::Diagonal,
        ..lm::Settings::default()
    };
    let found: Outcome = lm::minimize(&mut problem, theta, &settings, monitor, |_, _| ());
    if !found.cost.is_finite() {
        return Err(Error::fit(
            "expected a start with a finite free run, found none; scale the data, or identify a linear model first",
        ));
    }
    let shared = problem.shared;
    let model = start.with_theta(&found.theta[..shared]).ok_or_else(|| {
        Error::fit("expected a stable model, the fit found none; lower the orders")
    })?;
    Ok(Fit {
        // Only the error is reported, so that models with and without a ridge can be compared.
        cost: found.cost - problem.ridged(&found.theta),
        model,
        iterations: found.iterations,
        termination: found.termination,
        trace: found.trace,
        initial_states: found.theta[shared..]
            .chunks_exact(start.lags().na)
            .map(<[f64]>::to_vec)
            .collect(),
    })
}

/// The free runs over all experiments as a least-squares problem.
struct FreeRun<'a, M> {
    model: M,
    records: &'a [Record<'a>],
    monitor: &'a Monitor,
    /// Parameters that all experiments share.
    shared: usize,
    weight: f64,
    ridge: f64,
    /// Free runs from each record's first measured sample on: a state before a gap would have no effect.
    runs: Vec<Vec<f64>>,
    gram: Gram,
}

impl<'a, M: Parametric> FreeRun<'a, M> {
    fn new(model: M, records: &'a [Record<'a>], ridge: f64, monitor: &'a Monitor) -> Result<Self> {
        let (shared, na) = (Parametric::theta(&model).len(), model.lags().na);
        let samples: usize = records.iter().map(Record::counting).sum();
        let unknowns = shared + na * records.len();
        // Samples are counted, not weighted: a weight below 1 does not reduce the number of equations.
        if samples <= unknowns {
            return Err(Error::data(format!(
                "expected more than {unknowns} samples for as many parameters and initial states, got {samples} measured; record longer or lower na and nb"
            )));
        }
        let weight: f64 = records.iter().map(Record::total_weight).sum();
        Ok(Self {
            shared,
            monitor,
            weight,
            // In units of the cost, so that a ridge means the same for every unit of y.
            ridge: ridge * variance(records, weight),
            runs: records
                .iter()
                .map(|r| vec![0.0; r.len() - r.first_measured()])
                .collect(),
            // theta, the states of one experiment, the error: the states of other experiments would be zeros.
            gram: Gram::new(shared + na + 1, na),
            records,
            model,
        })
    }

    /// The ridge's part of the cost.
    fn ridged(&self, theta: &[f64]) -> f64 {
        // 1/2 ridge sum t^2: a residual sqrt(ridge) t each, without a sum over samples.
        let shrunk = &theta[self.model.shrunk()];
        0.5 * self.ridge * shrunk.iter().map(|value| value * value).sum::<f64>()
    }

    fn state<'t>(&self, theta: &'t [f64], experiment: usize) -> &'t [f64] {
        let na = self.model.lags().na;
        &theta[self.shared + experiment * na..][..na]
    }

    fn run(&mut self, model: &M, theta: &[f64], experiment: usize) -> Option<f64> {
        let (lags, record) = (model.lags(), &self.records[experiment]);
        // Checked by the duration of a sample: the interval is a power of two, so the test is a mask.
        let (first, look) = (record.first_measured(), look(8 * lags.regressors()));
        let mut phi = vec![0.0; lags.regressors()];
        phi[..lags.na].copy_from_slice(self.state(theta, experiment));
        let mut sum = 0.0;
        for (k, out) in (first..record.len()).zip(&mut self.runs[experiment]) {
            if k & (look - 1) == 0 && self.monitor.stopped() {
                return None;
            }
            lags.write_inputs(record.u, k, &mut phi[lags.na..]);
            *out = model.output(&phi);
            push_past(&mut phi[..lags.na], *out);
            let error = record.y[k] - *out;
            // A selection instead of a branch for gaps.
            sum += if record.y[k].is_nan() {
                0.0
            } else {
                error * error
            };
        }
        // A weighted sum is formed anew from the outputs: the loop above stays the same for every fit.
        Some(match record.weights {
            None => sum,
            Some(w) => weighted_squares(&w[first..], &record.y[first..], &self.runs[experiment]),
        })
    }

    /// Computes the rows of one experiment into the Gram matrix.
    fn sensitivities(&mut self, model: &M, theta: &[f64], experiment: usize) {
        let (lags, record, shared) = (model.lags(), &self.records[experiment], self.shared);
        let (first, na) = (record.first_measured(), lags.na);
        let mut phi = vec![0.0; lags.regressors()];
        let mut by_phi = phi.clone();
        phi[..na].copy_from_slice(self.state(theta, experiment));
        let (gram, mut by_theta) = (&mut self.gram, vec![0.0; shared]);
        gram.clear();
        for i in 0..na {
            gram.past_mut(i + 1)[shared + i] = 1.0;
        }
        let look = look((shared + na).pow(2));
        for (k, &y) in (first..).zip(&self.runs[experiment]) {
            if k & (look - 1) == 0 && self.monitor.stopped() {
                return;
            }
            lags.write_inputs(record.u, k, &mut phi[na..]);
            model.gradient(&phi, &mut by_theta, &mut by_phi);
            let weight = record.weights.map_or(1.0, |w| w[k]);
            let error = (record.y[k] - y, weight);
            // `push` adds the gains times the previous rows, keeps the error out of the recursion, and leaves an
            // unmeasured sample out of the sum.
            gram.push(&by_phi[..na], shared + na, error, |row| {
                row[..shared].copy_from_slice(&by_theta);
                row[shared..].fill(0.0);
            });
            push_past(&mut phi[..na], y);
        }
    }
}

/// The weighted variance of the measured outputs.
fn variance(records: &[Record], weight: f64) -> f64 {
    // Two passes, mean first: the mean of squares minus the squared mean would lose the digits of a position far from 0.
    let measured = || {
        records.iter().flat_map(|r| {
            let known = (0..r.len()).filter(|&k| !r.y[k].is_nan());
            known.map(|k| (r.weight(k), r.y[k]))
        })
    };
    let mean = measured().map(|(w, y)| w * y).sum::<f64>() / weight;
    measured().map(|(w, y)| w * (y - mean).powi(2)).sum::<f64>() / weight
}

impl<M: Parametric> Problem for FreeRun<'_, M> {
    fn parameters(&self) -> usize {
        self.shared + self.model.lags().na * self.records.len()
    }

    fn cost(&mut self, theta: &[f64]) -> Option<f64> {
        // No stable model: the trial is refused before it runs.
        let model = self.model.with_theta(&theta[..self.shared])?;
        let mut sum = 0.0;
        for experiment in 0..self.records.len() {
            sum += self.run(&model, theta, experiment)?;
        }
        // A run that overflows is a refused trial.
        Some(0.5 * sum / self.weight + self.ridged(theta)).filter(|c| c.is_finite())
    }

    fn normal_equations(&mut self, theta: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
        jtj.fill(0.0);
        jte.fill(0.0);
        let Some(model) = self.model.with_theta(&theta[..self.shared]) else {
            return;
        };
        let (shared, na, n) = (self.shared, model.lags().na, self.parameters());
        for experiment in 0..self.records.len() {
            self.sensitivities(&model, theta, experiment);
            // Shared parameters add up; the states of an experiment have their own rows and columns.
            let place = |i: usize| if i < shared { i } else { i + experiment * na };
            let (sums, width) = self.gram.finish();
            for i in 0..shared + na {
                // The error is the last column, and its row of X'X is J'e.
                jte[place(i)] += sums[(shared + na) * width + i] / self.weight;
                for j in 0..=i {
                    jtj[place(i) * n + place(j)] += sums[i * width + j] / self.weight;
                }
            }
        }
        for i in model.shrunk() {
            jtj[i * n + i] += self.ridge;
            jte[i] -= self.ridge * theta[i];
        }
        // a state that has decayed before the first measured sample has no effect
        for i in shared..n {
            jtj[i * n + i] += f64::MIN_POSITIVE;
        }
    }
}
