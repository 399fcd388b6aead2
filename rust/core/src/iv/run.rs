//! The free run of a linear model from the initial state that suits the record best.

use nalgebra::{DMatrix, DVector};

use crate::Record;
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::linear_fit::soften;

/// Responses to the past below this have left no trace in any digit of an output.
const DECAYED: f64 = 1e-30;

/// One free run.
pub(super) struct Run {
    /// The model's outputs.
    pub output: Vec<f64>,
    /// Past outputs before the first measured sample, newest first.
    pub state: Vec<f64>,
    /// Sum of squared errors at the measured samples.
    pub error: f64,
    /// Number of measured samples.
    pub measured: usize,
}

/// A model with its free run over each record.
pub(super) struct Point {
    pub model: LinearModel,
    pub runs: Vec<Run>,
}

impl Point {
    /// `1/(2N) sum e^2` over all records.
    pub fn cost(&self) -> f64 {
        let measured: usize = self.runs.iter().map(|r| r.measured).sum();
        0.5 * self.runs.iter().map(|r| r.error).sum::<f64>() / measured.max(1) as f64
    }

    /// Standard deviation of the free run over that of the noise, which the estimated parameters bring into it.
    pub fn relative_spread(&self) -> f64 {
        let measured: usize = self.runs.iter().map(|r| r.measured).sum();
        (self.model.parameters() as f64 / measured.max(1) as f64).sqrt()
    }

    /// Root mean square difference of the free runs.
    pub fn change(&self, before: &Self) -> f64 {
        let pairs = self.runs.iter().zip(&before.runs);
        let (n, sum) = pairs
            .flat_map(|(new, old)| new.output.iter().zip(&old.output))
            .fold((0.0, 0.0), |(n, sum), (x, y)| {
                (n + 1.0, sum + (x - y) * (x - y))
            });
        (sum / f64::max(n, 1.0)).sqrt()
    }
}

/// What one unit in each past output makes of the outputs after it, `na` values per sample, until it has decayed.
pub(super) fn responses(a: &[f64], samples: usize) -> Vec<f64> {
    let na = a.len();
    let mut rows = vec![0.0_f64; na * na];
    for i in 0..na {
        rows[(na - 1 - i) * na + i] = 1.0;
    }
    for k in na..na + samples {
        let past = &rows[(k - na) * na..];
        if past.iter().all(|v| v.abs() < DECAYED) {
            break;
        }
        let row: Vec<f64> = (0..na)
            .map(|i| {
                -(0..na)
                    .map(|m| a[m] * past[(na - 1 - m) * na + i])
                    .sum::<f64>()
            })
            .collect();
        rows.extend(row);
    }
    rows.split_off(na * na)
}

/// The run whose past outputs are the least-squares ones over the whole record: they enter the run linearly.
pub(super) fn best_run(model: &LinearModel, record: &Record, responses: &[f64]) -> Option<Run> {
    let na = model.lags().na;
    let mut output = model
        .simulate(record.u, record.channels, &vec![0.0; na])
        .ok()?;
    let (mut normal, mut moment) = (DMatrix::zeros(na, na), DVector::zeros(na));
    let errors = record.y.iter().zip(&output).map(|(y, x)| y - x);
    for (error, row) in errors.zip(responses.chunks_exact(na)) {
        if error.is_nan() {
            continue;
        }
        for i in 0..na {
            moment[i] += row[i] * error;
            for j in 0..na {
                normal[(i, j)] += row[i] * row[j];
            }
        }
    }
    soften(&mut normal);
    let state = normal.cholesky()?.solve(&moment);
    for (x, row) in output.iter_mut().zip(responses.chunks_exact(na)) {
        *x += row
            .iter()
            .zip(state.iter())
            .map(|(r, s)| r * s)
            .sum::<f64>();
    }
    let errors = record.y.iter().zip(&output).map(|(y, x)| y - x);
    let squares = errors.filter(|e| !e.is_nan()).map(|e| e * e);
    let (measured, error) = squares.fold((0, 0.0), |(n, sum), e| (n + 1, sum + e));
    error.is_finite().then(|| Run {
        state: before(record.first_measured(), &output, state.as_slice()),
        output,
        error,
        measured,
    })
}

/// Past outputs before sample `k` of a run that began at `state`.
fn before(k: usize, output: &[f64], state: &[f64]) -> Vec<f64> {
    let past = output[..k].iter().rev().chain(state);
    past.take(state.len()).copied().collect()
}
