//! The free run of a linear model as a least-squares problem.

use nalgebra::DMatrix;

use crate::colour::Colour;
use crate::data::weighted_squares;
use crate::gram::Gram;
use crate::lagged::{Lagged, Lags, push_past};
use crate::linear::{LinearModel, covariance_rows, is_stable, spread, without_nuisance};
use crate::lm::{Problem, cholesky, substitute};
use crate::monitor::look;
use crate::{Error, Monitor, Record, Result};

/// Least distance of a reflection coefficient from the unit circle.
const MARGIN: f64 = 1e-9;
/// Samples between two checks of the monitor.
const LOOK: usize = 4096;

/// Parameters: a (na), b (inputs x nb), the offset if there is one, then the past outputs of each experiment that does
/// not begin at rest.
pub(super) struct OutputError<'a> {
    pub lags: Lags,
    records: &'a [Record<'a>],
    monitor: &'a Monitor,
    offset: bool,
    /// Whether the last input is the output itself, with as many lags as the model's own.
    pub fed: bool,
    /// Number of samples that count, and the sum of their weights; both are equal if all count alike.
    samples: f64,
    weight: f64,
    /// Index of each experiment's past outputs among the parameters; `None` if it begins at rest.
    places: Vec<Option<usize>>,
    parameters: usize,
    /// Start of each free run: the first measured sample, as a state before a gap would have no effect.
    firsts: Vec<usize>,
    /// Free runs from there.
    runs: Vec<Vec<f64>>,
    gram: Gram,
    phi: Vec<f64>,
}

impl<'a> OutputError<'a> {
    pub fn new(
        records: &'a [Record<'a>],
        lags: Lags,
        offset: bool,
        fed: bool,
        monitor: &'a Monitor,
    ) -> Result<Self> {
        let samples: usize = records.iter().map(Record::counting).sum();
        let shared = lags.regressors() + usize::from(offset);
        let mut parameters = shared;
        let mut place = |record: &Record| {
            (!record.rests).then(|| {
                parameters += lags.na;
                parameters - lags.na
            })
        };
        let places = records.iter().map(&mut place).collect();
        if samples <= parameters {
            return Err(Error::data(format!(
                "expected more than {parameters} samples for as many parameters and initial states, got {samples} measured; record longer or lower na and nb"
            )));
        }
        Ok(Self {
            lags,
            records,
            monitor,
            offset,
            fed,
            samples: samples as f64,
            weight: records.iter().map(Record::total_weight).sum(),
            places,
            parameters,
            firsts: records.iter().map(Record::first_measured).collect(),
            runs: records
                .iter()
                .map(|r| vec![0.0; r.len() - r.first_measured()])
                .collect(),
            gram: Gram::new(shared + lags.na + 1, lags.na),
            phi: vec![0.0; lags.regressors()],
        })
    }

    /// Parameters that all experiments share.
    pub fn shared(&self) -> usize {
        self.lags.regressors() + usize::from(self.offset)
    }

    pub fn model(&self, theta: &[f64]) -> Result<LinearModel> {
        let (na, n_phi) = (self.lags.na, self.lags.regressors());
        let offset = if self.offset { theta[n_phi] } else { 0.0 };
        LinearModel::new(
            theta[..na].to_vec(),
            theta[na..n_phi].to_vec(),
            self.lags.channels,
            self.lags.nk,
            offset,
        )
    }

    pub fn initial_states(&self, theta: &[f64]) -> Vec<Vec<f64>> {
        let of = |experiment| self.state(theta, experiment);
        (0..self.records.len()).map(of).collect()
    }

    /// The past outputs of an experiment, newest first.
    fn state(&self, theta: &[f64], experiment: usize) -> Vec<f64> {
        let na = self.lags.na;
        match self.places[experiment] {
            Some(place) => theta[place..][..na].to_vec(),
            None => vec![self.equilibrium(theta, experiment).0; na],
        }
    }

    /// The output that the model holds under the first inputs of an experiment, and its derivatives with respect to the
    /// shared parameters:
    ///
    /// ```text
    /// y = (sum b u + offset) / (1 + sum a),   dy/da = -y / (1 + sum a),   dy/db = u / (1 + sum a)
    /// ```
    fn equilibrium(&self, theta: &[f64], experiment: usize) -> (f64, Vec<f64>) {
        let (na, n_phi) = (self.lags.na, self.lags.regressors());
        let left = 1.0 + theta[..na].iter().sum::<f64>();
        let mut by = vec![1.0; self.shared()];
        // before the first sample inputs hold their first value, so these are the inputs at rest
        self.lags
            .write_inputs(self.records[experiment].u, 0, &mut by[na..n_phi]);
        let shared = theta[na..self.shared()].iter();
        let push = shared.zip(&by[na..]).map(|(b, u)| b * u).sum::<f64>();
        let y = push / left;
        by[..na].fill(-y);
        by.iter_mut().for_each(|slope| *slope /= left);
        (y, by)
    }

    /// The best parameters with these poles.
    pub fn with_poles(&mut self, a: &[f64]) -> Option<(f64, Vec<f64>)> {
        let mut theta = vec![0.0; self.parameters()];
        theta[..a.len()].copy_from_slice(a);
        self.completed(theta, a.len())
    }

    /// The parameters of this model, and the best initial states for it.
    pub fn with_states(&mut self, model: &LinearModel) -> Option<(f64, Vec<f64>)> {
        let shared = self.shared();
        let known = [model.a(), model.b(), &[model.offset()]].concat();
        let mut theta = vec![0.0; self.parameters()];
        theta[..shared].copy_from_slice(&known[..shared]);
        self.completed(theta, shared)
    }

    /// `theta` with the best parameters from `first` on. These must not include `a`: all others enter the free run
    /// linearly.
    fn completed(&mut self, mut theta: Vec<f64>, first: usize) -> Option<(f64, Vec<f64>)> {
        let n = self.parameters();
        self.cost(&theta)?;
        let (mut jtj, mut jte) = (vec![0.0; n * n], vec![0.0; n]);
        self.normal_equations(&theta, &mut jtj, &mut jte);
        let linear = n - first;
        let mut normal = vec![0.0; linear * linear];
        for i in 0..linear {
            normal[i * linear..][..linear]
                .copy_from_slice(&jtj[(i + first) * n + first..][..linear]);
            // Initial states that have decayed within the first samples have no effect on the output.
            normal[i * linear + i] = normal[i * linear + i] * (1.0 + 1e-12) + f64::MIN_POSITIVE;
        }
        if !cholesky(&mut normal, linear) {
            return None;
        }
        substitute(&normal, linear, &mut jte[first..]);
        let step = theta[first..].iter_mut().zip(&jte[first..]);
        step.for_each(|(value, step)| *value += step);
        Some((self.cost(&theta)?, theta))
    }

    /// The number of independent samples in the residuals at `theta`.
    pub fn independent(&mut self, theta: &[f64]) -> f64 {
        if self.cost(theta).is_none() {
            return 0.0;
        }
        let measured = self.records.iter().zip(&self.firsts).zip(&self.runs);
        let residuals: Vec<f64> = measured
            .flat_map(|((record, &first), run)| {
                let outputs = record.y[first..].iter().zip(run);
                outputs.filter(|(y, _)| !y.is_nan()).map(|(y, run)| y - run)
            })
            .collect();
        Colour::of(&residuals).independent(residuals.len())
    }

    /// Covariance of the shared parameters for white noise, row by row, always with a row for the offset.
    pub fn covariance(&mut self, theta: &[f64], cost: f64) -> Vec<f64> {
        let n = self.parameters();
        let (mut jtj, mut jte) = (vec![0.0; n * n], vec![0.0; n]);
        let is_valid = self.cost(theta).is_some();
        self.normal_equations(theta, &mut jtj, &mut jte);
        let information = DMatrix::from_fn(n, n, |i, j| jtj[i.max(j) * n + i.min(j)]);
        // jtj is a mean over the samples, the cost half of one; weights are inverse variances up to a factor
        let variance = 2.0 * cost / (self.samples - n as f64);
        let shared = self.shared();
        let found = without_nuisance(&information, shared)
            .filter(|_| is_valid)
            .and_then(|i| spread(&i, variance));
        covariance_rows(found.as_ref(), self.lags.regressors() + 1)
    }

    fn simulate(&mut self, theta: &[f64], model: &LinearModel, experiment: usize) -> Option<f64> {
        let (lags, record) = (self.lags, &self.records[experiment]);
        let state = self.state(theta, experiment);
        self.phi[..lags.na].copy_from_slice(&state);
        let mut sum = 0.0;
        let samples = self.firsts[experiment]..record.len();
        for (k, out) in samples.zip(&mut self.runs[experiment]) {
            if k % LOOK == 0 && self.monitor.stopped() {
                return None;
            }
            lags.write_inputs(record.u, k, &mut self.phi[lags.na..]);
            if self.fed {
                feed_back(&mut self.phi, lags.na, record.y, k);
            }
            let y = model.output(&self.phi);
            push_past(&mut self.phi[..lags.na], y);
            *out = y;
            if !record.y[k].is_nan() {
                sum += (record.y[k] - y) * (record.y[k] - y);
            }
        }
        Some(match record.weights {
            None => sum,
            Some(weights) => {
                let first = self.firsts[experiment];
                weighted_squares(
                    &weights[first..],
                    &record.y[first..],
                    &self.runs[experiment],
                )
            }
        })
    }

    fn sensitivities(&mut self, theta: &[f64], experiment: usize) {
        let (lags, record, run) = (self.lags, &self.records[experiment], &self.runs[experiment]);
        let (na, n_phi, shared) = (
            lags.na,
            lags.regressors(),
            lags.regressors() + usize::from(self.offset),
        );
        let mut gains: Vec<f64> = theta[..na].iter().map(|a| -a).collect();
        let state = self.state(theta, experiment);
        self.phi[..na].copy_from_slice(&state);
        let rest = self.places[experiment]
            .is_none()
            .then(|| self.equilibrium(theta, experiment).1);
        self.gram.clear();
        for i in 0..na {
            let past = self.gram.past_mut(i + 1);
            match &rest {
                Some(slopes) => past[..shared].copy_from_slice(slopes),
                None => past[shared + i] = 1.0,
            }
        }
        let look = look((shared + na).pow(2));
        let weights = record.weights;
        for (k, &y) in (self.firsts[experiment]..).zip(run) {
            if k & (look - 1) == 0 && self.monitor.stopped() {
                return;
            }
            lags.write_inputs(record.u, k, &mut self.phi[na..]);
            if self.fed {
                feed_back(&mut self.phi, na, record.y, k);
                for (i, gain) in gains.iter_mut().enumerate() {
                    let own = is_missing(record.y, k, i);
                    *gain = if own { theta[n_phi - na + i] } else { 0.0 } - theta[i];
                }
            }
            let phi = &self.phi;
            let weight = weights.map_or(1.0, |w| w[k]);
            let error = (record.y[k] - y, weight);
            self.gram.push(&gains, shared + na, error, |row| {
                for (value, y) in row[..na].iter_mut().zip(&phi[..na]) {
                    *value = -y;
                }
                row[na..n_phi].copy_from_slice(&phi[na..]);
                row[n_phi..].fill(0.0);
                row[n_phi..shared].fill(1.0);
            });
            push_past(&mut self.phi[..na], y);
        }
    }
}

/// Whether the output at `lag + 1` samples before `k` was recorded without a value.
fn is_missing(y: &[f64], k: usize, lag: usize) -> bool {
    k > lag && y[k - lag - 1].is_nan()
}

/// Past outputs that are inputs, where they were not measured: the model's own.
fn feed_back(phi: &mut [f64], na: usize, y: &[f64], k: usize) {
    let (own, inputs) = phi.split_at_mut(na);
    let first = inputs.len() - na;
    for (i, (fed, own)) in inputs[first..].iter_mut().zip(own).enumerate() {
        if is_missing(y, k, i) {
            *fed = *own;
        }
    }
}

impl Problem for OutputError<'_> {
    fn parameters(&self) -> usize {
        self.parameters
    }

    fn cost(&mut self, theta: &[f64]) -> Option<f64> {
        if !is_stable(&theta[..self.lags.na], MARGIN) {
            return None;
        }
        let model = self.model(theta).ok()?;
        let mut sum = 0.0;
        for experiment in 0..self.records.len() {
            sum += self.simulate(theta, &model, experiment)?;
        }
        Some(0.5 * sum / self.weight).filter(|c| c.is_finite())
    }

    fn normal_equations(&mut self, theta: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
        let (shared, na, n) = (self.shared(), self.lags.na, self.parameters());
        jtj.fill(0.0);
        jte.fill(0.0);
        for experiment in 0..self.records.len() {
            self.sensitivities(theta, experiment);
            // for a record that begins at rest the columns of past outputs are 0
            let state = self.places[experiment];
            let place = |i: usize| {
                state
                    .filter(|_| i >= shared)
                    .map_or(i, |at| at + i - shared)
            };
            let own = if state.is_some() { shared + na } else { shared };
            let (sums, width) = self.gram.finish();
            for i in 0..own {
                jte[place(i)] += sums[(shared + na) * width + i] / self.weight;
                for j in 0..=i {
                    jtj[place(i) * n + place(j)] += sums[i * width + j] / self.weight;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::laws::{check_gradient, check_sum, weights};
    use crate::random::Random;

    #[test]
    fn puts_weights_on_cost_and_normal_equations_alike() {
        let mut random = Random::new(3);
        let u: Vec<f64> = (0..400).map(|_| random.normal()).collect();
        let mut y: Vec<f64> = (0..400).map(|_| random.normal()).collect();
        y[..4].fill(f64::NAN);
        y[200..230].fill(f64::NAN);
        let (records, monitor) = (
            [Record::with_gaps(&u, 1, &y).unwrap(); 2],
            Monitor::default(),
        );
        let lags = Lags::new(2, 2, 1, 1).unwrap();
        let theta = [-1.2, 0.5, 0.4, -0.3, 0.1, 0.3, -0.2, 0.7, 0.4];
        let w = weights(400, 1);
        let weighted = [records[0].with_weights(&w).unwrap(), records[1]];
        let problem = |records| OutputError::new(records, lags, true, false, &monitor).unwrap();
        check_gradient(&mut problem(&weighted), &theta);
        let begun = [records[0].at_rest(true), records[1]];
        check_gradient(&mut problem(&begun), &theta[..7]);
        // outputs that are fed back, with and without some of them
        let both: Vec<f64> = u
            .iter()
            .zip(&y)
            .flat_map(|(u, y)| [*u, if y.is_nan() { 0.0 } else { *y }])
            .collect();
        let fed = [Record::with_gaps(&both, 2, &y).unwrap()];
        let lags = Lags::new(2, 2, 1, 2).unwrap();
        let mut predictor = OutputError::new(&fed, lags, true, true, &monitor).unwrap();
        check_gradient(
            &mut predictor,
            &[-1.2, 0.5, 0.4, -0.3, 0.5, -0.3, 0.1, 0.3, -0.2],
        );
        // weights of 1, and of 3 on a part
        let part = |k: usize| k % 7 < 3;
        let tripled: Vec<f64> = (0..400).map(|k| if part(k) { 3.0 } else { 1.0 }).collect();
        let weighted = records.map(|r| r.with_weights(&tripled).unwrap());
        let only: Vec<f64> = (0..400).map(|k| f64::from(u8::from(part(k)))).collect();
        let parts = records.map(|r| r.with_weights(&only).unwrap());
        let mut whole = problem(&weighted);
        let (plain, part) = (problem(&records), problem(&parts));
        let (total, all, of_part) = (whole.weight, plain.weight, part.weight);
        assert_eq!(total, all + 2.0 * of_part);
        check_sum(
            &theta,
            (&mut whole, total),
            &mut [(plain, all, 1.0), (part, of_part, 2.0)],
        );
    }
}
