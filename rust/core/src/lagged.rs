//! The common part of every model with lagged inputs and outputs: regressor, free run, k-step prediction, initial state.

use crate::linear::LinearModel;
use crate::neural::Network;
use crate::{Error, Result};

/// Samples from which an unknown initial state is estimated, as in a score's default (docs/CONVENTIONS.md, `init`).
pub(crate) const STATE_SAMPLES: usize = 20;

/// Orders of a lagged model; the regressor is the one of docs/CONVENTIONS.md (paper Eq. 2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lags {
    /// Number of past outputs.
    pub na: usize,
    /// Number of past values of each input.
    pub nb: usize,
    /// Delay in samples from input to output.
    pub nk: usize,
    /// Number of inputs.
    pub channels: usize,
}

/// More lags than this are a typing error, not a model.
const MOST_LAGS: usize = 1_000;
/// How often the prior of the initial state may be relaxed; on a clean record each time gains two digits or more.
const RELAXATIONS: usize = 6;
/// In a record this short other starts are tried too, as two basins may look alike.
const SHORT: usize = 1000;
/// The least weight of the prior of the initial state.
const LEAST_PRIOR: f64 = 1e-9;
/// A run whose squares are below this share of the outputs' is exact: the record is clean, and no other state fits better.
const EXACT: f64 = 1e-10;

impl Lags {
    /// Checked orders.
    ///
    /// # Errors
    /// `ErrorKind::Setting` unless `na`, `nb` and `channels` are at least 1 and all are at most 1,000.
    pub fn new(na: usize, nb: usize, nk: usize, channels: usize) -> Result<Self> {
        let sizes = [
            ("na", na, 1),
            ("nb", nb, 1),
            ("nk", nk, 0),
            ("inputs", channels, 1),
        ];
        for (name, value, least) in sizes {
            if value < least || value > MOST_LAGS {
                return Err(Error::setting(format!(
                    "expected {name} from {least} to {MOST_LAGS}, got {value}; choose orders near 2 to begin with"
                )));
            }
        }
        Ok(Self {
            na,
            nb,
            nk,
            channels,
        })
    }

    /// Number of regressors.
    pub fn regressors(&self) -> usize {
        self.na + self.nb * self.channels
    }

    /// First sample whose regressor lies wholly inside a record.
    pub fn first_whole(&self) -> usize {
        self.na.max(self.nk + self.nb - 1)
    }

    /// Writes the input part of the regressor of sample `k`; before the first sample inputs hold their first value.
    pub fn write_inputs(&self, u: &[f64], k: usize, phi: &mut [f64]) {
        for (j, lagged) in phi.chunks_exact_mut(self.nb).enumerate() {
            for (i, value) in lagged.iter_mut().enumerate() {
                *value = u[k.saturating_sub(self.nk + i) * self.channels + j];
            }
        }
    }

    /// Number of samples in `u`, after a check of its shape and of the past outputs.
    ///
    /// # Errors
    /// `ErrorKind::Data` for a wrong number of past outputs or inputs, or values that are not finite.
    pub fn check(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<usize> {
        if channels != self.channels {
            return Err(Error::data(format!(
                "expected u of shape (N, {}), got (N, {channels}); give the inputs the model was made with, time first",
                self.channels
            )));
        }
        if y_past.len() != self.na {
            return Err(Error::data(format!(
                "expected {} past outputs, newest first, got {}; give y(-1) .. y(-{})",
                self.na,
                y_past.len(),
                self.na
            )));
        }
        if !(all_finite(u) && all_finite(y_past)) {
            return Err(Error::data(
                "expected finite inputs and past outputs, got NaN or infinity; cut or repair that part of the recording",
            ));
        }
        Ok(u.len() / channels)
    }
}

/// A model that kernels step within registers, in the data's units.
#[derive(Clone, Debug)]
pub enum Form {
    /// A difference equation.
    Linear(LinearModel),
    /// A network with inputs and outputs in the data's units.
    Network(Network),
}

impl Form {
    /// The output for the regressor `phi`.
    pub fn output(&self, phi: &[f64]) -> f64 {
        match self {
            Self::Linear(model) => model.output(phi),
            Self::Network(network) => network.output(phi),
        }
    }
}

/// A model whose next output is a function of its regressor, in the data's units.
pub trait Lagged {
    /// The model's orders.
    fn lags(&self) -> Lags;

    /// The output for the regressor `phi`.
    fn output(&self, phi: &[f64]) -> f64;

    /// The output; writes its derivatives with respect to the past outputs in `phi` into `slope`.
    fn output_and_slope(&self, phi: &[f64], slope: &mut [f64]) -> f64;

    /// The form in which kernels step the model, in the data's units; `None` if they do not know its kind.
    fn form(&self) -> Option<Form> {
        None
    }

    /// Free run: the regressor holds the model's own outputs.
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong shapes, `ErrorKind::Fit` for a run that leaves the finite numbers.
    fn simulate(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<Vec<f64>> {
        let lags = self.lags();
        let samples = lags.check(u, channels, y_past)?;
        let mut phi = vec![0.0; lags.regressors()];
        phi[..lags.na].copy_from_slice(y_past);
        let mut run = Vec::with_capacity(samples);
        for k in 0..samples {
            lags.write_inputs(u, k, &mut phi[lags.na..]);
            let y = self.output(&phi);
            push_past(&mut phi[..lags.na], y);
            run.push(y);
        }
        finite(run)
    }

    /// The output `horizon` steps ahead: measured outputs up to sample `k - horizon`, the model's own after it.
    ///
    /// The first samples have fewer known outputs before them and start from `y_past`. An output that was not measured
    /// (NaN) is replaced by the model's one-step prediction.
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong shapes, `ErrorKind::Setting` for a horizon of 0, `ErrorKind::Fit` as in free run.
    fn predict(
        &self,
        u: &[f64],
        channels: usize,
        y: &[f64],
        y_past: &[f64],
        horizon: usize,
    ) -> Result<Vec<f64>> {
        let lags = self.lags();
        let samples = lags.check(u, channels, y_past)?;
        check_predicted(y, samples, horizon)?;
        let filled = self.filled(u, y, y_past);
        let y = filled.as_deref().unwrap_or(y);
        let mut phi = vec![0.0; lags.regressors()];
        let ahead = |k: usize| {
            let start = (k + 1).saturating_sub(horizon);
            for (i, past) in phi[..lags.na].iter_mut().enumerate() {
                *past = if start > i {
                    y[start - 1 - i]
                } else {
                    y_past[i - start]
                };
            }
            let mut output = f64::NAN;
            for step in start..=k {
                lags.write_inputs(u, step, &mut phi[lags.na..]);
                output = self.output(&phi);
                push_past(&mut phi[..lags.na], output);
            }
            output
        };
        finite((0..samples).map(ahead).collect())
    }

    /// `y` with each unmeasured value replaced by its one-step prediction; `None` if all were measured.
    fn filled(&self, u: &[f64], y: &[f64], y_past: &[f64]) -> Option<Vec<f64>> {
        if !y.iter().any(|v| v.is_nan()) {
            return None;
        }
        let lags = self.lags();
        let mut phi = vec![0.0; lags.regressors()];
        phi[..lags.na].copy_from_slice(y_past);
        let next = |(k, &measured): (usize, &f64)| {
            let known = if measured.is_nan() {
                lags.write_inputs(u, k, &mut phi[lags.na..]);
                self.output(&phi)
            } else {
                measured
            };
            push_past(&mut phi[..lags.na], known);
            known
        };
        Some(y.iter().enumerate().map(next).collect())
    }

    /// The past outputs whose free run fits `y` best, by regularised least squares.
    ///
    /// Outputs that are NaN have no weight.
    ///
    /// Damped Gauss-Newton steps on `sum e^2 + rho |y_past - level|^2` from several starts; `level` is the mean of the
    /// first outputs. `rho` is first 1e-2, then the ratio of the residual's to the output's variance if that is
    /// smaller: so a noisy or short record cannot give a wild state. A clean one gives the exact state: if the least
    /// `rho` leads to an exact run, that is kept.
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong shapes or no measured samples, `ErrorKind::Fit` if every start leaves the finite
    /// numbers.
    fn estimate_initial_state(&self, u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<f64>> {
        let lags = self.lags();
        let samples = lags.check(u, channels, &vec![0.0; lags.na])?;
        check_measured(y, samples)?;
        let known: Vec<f64> = y.iter().copied().filter(|v| !v.is_nan()).collect();
        if known.is_empty() {
            return Err(Error::data(
                "expected measured outputs to estimate the initial state from, got none; give 20 or so",
            ));
        }
        let first = &known[..known.len().min(lags.na.max(3))];
        let level = first.iter().sum::<f64>() / first.len() as f64;
        let mut search = StateSearch::new(self, lags, u, y, level);
        let starts = [level, known[0], 0.0];
        let run = |search: &mut StateSearch<Self>, start: f64| search.descend(vec![start; lags.na]);
        let best = best_of(starts.iter().filter_map(|&s| run(&mut search, s)))?;
        let (mut best, exact) = search.relaxed(best, &known);
        if known.len() <= SHORT && !exact {
            let before = best.0;
            // a network need not be monotone: starts with equal past outputs can all miss the best state
            for start in spread_starts(lags.na, level, &known) {
                best = match search.descend(start) {
                    // smaller improvements of another start are due to noise
                    Some(found) if found.0 < 0.5 * best.0 => found,
                    _ => best,
                };
            }
            if best.0 < before {
                best = search.relaxed(best, &known).0;
            }
        }
        Ok(best.1)
    }
}

/// Past outputs that differ from each other, as far from `level` as the outputs go, and three times as far.
fn spread_starts(na: usize, level: f64, known: &[f64]) -> Vec<Vec<f64>> {
    let width = known.iter().map(|y| (y - level).abs()).fold(0.0, f64::max);
    let patterns: [fn(usize) -> f64; 4] = [
        |_| 1.0,
        |i| if i % 2 == 0 { 1.0 } else { -1.0 },
        |i| f64::from(u8::from(i == 0)),
        |i| f64::from(u8::from(i > 0)),
    ];
    let sizes = [width, -width, 3.0 * width, -3.0 * width];
    let starts = sizes.into_iter().flat_map(|size| {
        patterns.map(|pattern| (0..na).map(|i| level + size * pattern(i)).collect())
    });
    starts.collect()
}

fn best_of(found: impl Iterator<Item = (f64, Vec<f64>)>) -> Result<(f64, Vec<f64>)> {
    found.min_by(|x, y| x.0.total_cmp(&y.0)).ok_or_else(|| {
        Error::fit("expected an initial state with a finite free run, found none; the model is unstable on this record")
    })
}

/// Refuses outputs that are not one per input sample, finite or NaN.
pub(crate) fn check_measured(y: &[f64], samples: usize) -> Result<()> {
    if y.len() != samples {
        return Err(Error::data(format!(
            "expected {samples} measured outputs, one per input sample, got {}; give u and y the same number of samples",
            y.len()
        )));
    }
    if y.iter().any(|v| v.is_infinite()) {
        return Err(Error::data(
            "expected finite outputs, or NaN where none was measured, got infinity; set it to NaN",
        ));
    }
    Ok(())
}

/// As [`check_measured`]; also refuses a horizon of 0.
pub(crate) fn check_predicted(y: &[f64], samples: usize, horizon: usize) -> Result<()> {
    check_measured(y, samples)?;
    if horizon == 0 {
        return Err(Error::setting(
            "expected a horizon of 1 step or more, got 0; 1 is one-step prediction",
        ));
    }
    Ok(())
}

/// Puts `y` in front of the past outputs, newest first.
pub fn push_past(past: &mut [f64], y: f64) {
    let last = past.len() - 1;
    past.copy_within(..last, 1);
    past[0] = y;
}

/// Without a branch, so that several values are tested at once.
fn all_finite(values: &[f64]) -> bool {
    values.iter().fold(true, |all, v| all & v.is_finite())
}

/// The run, if all of it is finite.
pub(crate) fn finite(run: Vec<f64>) -> Result<Vec<f64>> {
    if all_finite(&run) {
        return Ok(run);
    }
    let k = run.iter().take_while(|y| y.is_finite()).count();
    Err(Error::fit(format!(
        "expected a finite simulation, got {} at sample {k}; the model is unstable on this input: identify it again with other orders or more data",
        run[k]
    )))
}

/// Gauss-Newton over the past outputs, with preallocated buffers.
struct StateSearch<'a, M: ?Sized> {
    model: &'a M,
    lags: Lags,
    u: &'a [f64],
    y: &'a [f64],
    level: f64,
    rho: f64,
    phi: Vec<f64>,
    slope: Vec<f64>,
    /// Sensitivities of the last `na` outputs, newest first, `na` values each.
    rows: Vec<f64>,
    normal: Vec<f64>,
    gradient: Vec<f64>,
}

impl<'a, M: Lagged + ?Sized> StateSearch<'a, M> {
    fn new(model: &'a M, lags: Lags, u: &'a [f64], y: &'a [f64], level: f64) -> Self {
        let n = lags.na;
        Self {
            model,
            lags,
            u,
            y,
            level,
            rho: 1e-2,
            phi: vec![0.0; lags.regressors()],
            slope: vec![0.0; n],
            rows: vec![0.0; (n + 1) * n],
            normal: vec![0.0; n * n],
            gradient: vec![0.0; n],
        }
    }

    /// Sum of squared residuals and of the prior; also fills the normal equations.
    fn evaluate(&mut self, state: &[f64]) -> f64 {
        let n = self.lags.na;
        self.phi[..n].copy_from_slice(state);
        self.rows.fill(0.0);
        self.normal.fill(0.0);
        let mut cost = 0.0;
        for (i, value) in state.iter().enumerate() {
            self.rows[(i + 1) * n + i] = 1.0;
            let off = self.level - value;
            cost += self.rho * off * off;
            self.gradient[i] = self.rho * off;
            self.normal[i * n + i] = self.rho;
        }
        for (k, &measured) in self.y.iter().enumerate() {
            self.lags.write_inputs(self.u, k, &mut self.phi[n..]);
            let y = self.model.output_and_slope(&self.phi, &mut self.slope);
            let error = if measured.is_nan() {
                None
            } else {
                Some(measured - y)
            };
            cost += error.map_or(0.0, |e| e * e);
            self.add_row(error);
            push_past(&mut self.phi[..n], y);
        }
        cost
    }

    /// Computes the sensitivity row of this sample by the chain rule over the past rows; adds it to the normal
    /// equations if the sample was measured.
    fn add_row(&mut self, error: Option<f64>) {
        let n = self.lags.na;
        let (row, past) = self.rows.split_at_mut(n);
        for j in 0..n {
            row[j] = (0..n).map(|m| self.slope[m] * past[m * n + j]).sum();
        }
        for (i, error) in (0..n).zip(error.iter().cycle()) {
            self.gradient[i] += row[i] * error;
            for j in 0..n {
                self.normal[i * n + j] += row[i] * row[j];
            }
        }
        self.rows.copy_within(..n * n, n);
    }

    fn descend(&mut self, mut state: Vec<f64>) -> Option<(f64, Vec<f64>)> {
        let n = self.lags.na;
        let mut cost = self.evaluate(&state);
        let mut damping = 0.0;
        for _ in 0..20 {
            if !cost.is_finite() {
                return None;
            }
            let mut normal = nalgebra::DMatrix::from_row_slice(n, n, &self.normal);
            let gradient = nalgebra::DVector::from_column_slice(&self.gradient);
            let mean = normal.trace() / n as f64;
            let (kept_normal, kept_gradient) = (self.normal.clone(), self.gradient.clone());
            for i in 0..n {
                normal[(i, i)] += damping * mean;
            }
            let step = normal.cholesky()?.solve(&gradient);
            let trial: Vec<f64> = state.iter().zip(step.iter()).map(|(s, d)| s + d).collect();
            let reached = self.evaluate(&trial);
            if reached <= cost {
                let done = cost - reached <= 1e-12 * cost;
                (state, cost) = (trial, reached);
                damping *= 0.1;
                if done {
                    break;
                }
            } else {
                (self.normal, self.gradient) = (kept_normal, kept_gradient);
                damping = (damping * 8.0).max(1e-3);
            }
        }
        Some((cost, state))
    }

    /// Sum of squared residuals.
    fn squares(&mut self, state: &[f64]) -> f64 {
        let prior = std::mem::replace(&mut self.rho, 0.0);
        let squares = self.evaluate(state);
        self.rho = prior;
        squares
    }

    /// The descent from a state on with the least prior that its residual allows, and whether it is exact.
    fn relaxed(&mut self, mut best: (f64, Vec<f64>), known: &[f64]) -> ((f64, Vec<f64>), bool) {
        let level = self.level;
        let squares: f64 = known.iter().map(|y| (y - level) * (y - level)).sum();
        let is_long = known.len() > 2 * self.lags.na;
        for _ in 0..RELAXATIONS {
            if !is_long || !self.relax(&best.1, known) {
                break;
            }
            best = self.descend(best.1.clone()).unwrap_or(best);
        }
        if self.squares(&best.1) <= EXACT * squares {
            return (best, true);
        }
        if is_long {
            // a state far from `level` that is soon forgotten: its prior outweighs the few outputs that depend on it
            let prior = std::mem::replace(&mut self.rho, LEAST_PRIOR);
            match self.descend(best.1.clone()) {
                Some(found) if self.squares(&found.1) <= EXACT * squares => return (found, true),
                _ => self.rho = prior,
            }
        }
        (best, false)
    }

    /// Lowers the prior's weight to what the residual suggests; false if it is low enough already.
    fn relax(&mut self, state: &[f64], known: &[f64]) -> bool {
        let (prior, samples, level) = (self.rho, known.len(), self.level);
        let residual = self.squares(state) / (samples - self.lags.na) as f64;
        let spread = known.iter().map(|y| (y - level) * (y - level)).sum::<f64>() / samples as f64;
        self.rho = (residual / spread.max(f64::MIN_POSITIVE)).clamp(LEAST_PRIOR, prior);
        self.rho < prior
    }
}
