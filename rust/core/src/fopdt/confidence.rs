//! How sure a first-order fit is of its rise, `T` and `L`.

use nalgebra::{DMatrix, DVector};

use super::{Candidate, Step};

/// Standard errors of rise, `t` and `l` \[samples\] in sandwich form: `P S P`, `P = (J'J)^-1`, with `S` the covariance of the
/// sums `J'e` by Bartlett's window, whose width is Andrews' for a residual of first order (*Econometrica* 59, 1991):
///
/// ```text
/// S = sum_k sum_|m|<=M (1 - |m|/(M + 1)) j(k) e(k) e(k+m) j(k+m)',   M = 1.1447 (4 rho^2 N/(1 - rho^2)^2)^(1/3)
/// ```
pub(super) fn errors(step: &Step<'_>, found: &Candidate) -> [f64; 3] {
    let (rows, residual) = slopes(step, found);
    let (n, p) = (rows.nrows(), rows.ncols());
    let Some(inverse) = (rows.transpose() * &rows).try_inverse() else {
        return [f64::INFINITY; 3];
    };
    let scores = DMatrix::from_fn(n, p, |k, i| rows[(k, i)] * residual[k]);
    let width = window(&residual);
    let mut middle = scores.transpose() * &scores;
    for lag in 1..=width {
        let weight = 1.0 - lag as f64 / (width + 1) as f64;
        let cross = scores.rows(0, n - lag).transpose() * scores.rows(lag, n - lag);
        middle += (&cross + cross.transpose()) * weight;
    }
    let covariance = &inverse * middle * &inverse * (n as f64 / (n - p).max(1) as f64);
    [0, 1, 2].map(|i| covariance[(i, i)].max(0.0).sqrt())
}

/// Derivatives by rise, `t`, `l`, level and, where it is fitted, the free response; residuals.
fn slopes(step: &Step<'_>, found: &Candidate) -> (DMatrix<f64>, DVector<f64>) {
    let places: Vec<(usize, f64)> = step.samples().collect();
    let Candidate {
        t, l, rise, free, ..
    } = *found;
    let columns = if step.moving { 5 } else { 4 };
    let rows = DMatrix::from_fn(places.len(), columns, |row, column| {
        let k = places[row].0;
        let since = (k as f64 - step.at as f64 - l).max(0.0);
        let left = if since > 0.0 { (-since / t).exp() } else { 0.0 };
        let own = (-(k as f64) / t).exp();
        match column {
            0 => found.share(k, step.at),
            1 => (free * k as f64 * own - rise * since * left) / (t * t),
            2 => -rise * left / t,
            3 => 1.0,
            _ => own,
        }
    });
    let residual = places.iter().map(|&(k, y)| y - found.output(k, step.at));
    (rows, DVector::from_iterator(places.len(), residual))
}

fn window(e: &DVector<f64>) -> usize {
    let n = e.len();
    let lagged: f64 = (1..n).map(|k| e[k] * e[k - 1]).sum();
    let power = e.norm_squared();
    let rho = if power > 0.0 {
        (lagged / power).clamp(-0.99, 0.99)
    } else {
        0.0
    };
    let alpha = 4.0 * rho * rho / (1.0 - rho * rho).powi(2);
    let width = 1.1447 * (alpha * n as f64).cbrt();
    (width as usize).clamp(1, (n / 4).max(1))
}
