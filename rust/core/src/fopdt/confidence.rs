//! The uncertainty of a first-order fit: standard errors of its rise, `T` and `L`, and whether the response overshoots
//! its final level, which no first-order response does.

use nalgebra::{DMatrix, DVector};

use super::{Candidate, Step};
use crate::colour::Colour;

/// A free response below this many standard errors counts as none.
const SIGMAS: f64 = 3.0;

/// Whether the free response exceeds what the residuals alone would explain.
pub(super) fn moves(step: &Step<'_>, found: &Candidate) -> bool {
    variances(step, found).is_some_and(|v| found.free.powi(2) > SIGMAS.powi(2) * v[4])
}

/// Whether the outputs before the step drift by more than their noise explains.
pub(super) fn drifts(step: &Step<'_>) -> bool {
    let before: Vec<(f64, f64)> = step
        .samples()
        .take_while(|&(k, _)| k < step.at)
        .map(|(k, y)| (k as f64, y))
        .collect();
    let n = before.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| before.iter().map(of).sum::<f64>() / n;
    let (k_mean, y_mean) = (mean(|s| s.0), mean(|s| s.1));
    let about = || before.iter().map(|(k, y)| (k - k_mean, y - y_mean));
    let squares: f64 = about().map(|(k, _)| k * k).sum();
    let slope = about().map(|(k, y)| k * y).sum::<f64>() / squares;
    let left: Vec<f64> = about().map(|(k, y)| y - slope * k).collect();
    // coloured noise drifts by itself: count only as many independent samples as its spectrum leaves
    let free = Colour::of(&left).independent(left.len()) - 2.0;
    let variance = left.iter().map(|e| e * e).sum::<f64>() / (free * squares);
    free > 0.0 && slope * slope > SIGMAS * SIGMAS * variance
}

/// Standard errors of rise, `t` and `l` \[samples\].
pub(super) fn errors(step: &Step<'_>, found: &Candidate) -> [f64; 3] {
    variances(step, found).map_or([f64::INFINITY; 3], |v| {
        [0, 1, 2].map(|i| v[i].max(0.0).sqrt())
    })
}

/// Gauss-Newton step from a candidate, in `t` and `l`; with `held` `l` stays and its step is 0.
pub(super) fn step(step: &Step<'_>, found: &Candidate, held: bool) -> Option<(f64, f64)> {
    let (rows, residual) = slopes(step, found);
    let rows = if held { rows.remove_column(2) } else { rows };
    let squares = rows.transpose() * &rows;
    let x = squares.cholesky()?.solve(&(rows.transpose() * residual));
    let (t, l) = (x[1], if held { 0.0 } else { x[2] });
    (t.is_finite() && l.is_finite()).then_some((t, l))
}

/// Variances of rise, `t`, `l`, level and, if fitted, the free response, for residuals of any spectrum and of changing
/// size: `P S P` with `P = (J'J)^-1` and `S` the covariance of the sums `J'e`. The residuals are whitened by an
/// autoregression, and the slopes are carried back through it:
///
/// ```text
/// w(k) = e(k) - sum_m a_m e(k-m),   z(k) = j(k) + sum_m a_m z(k+m),   J'e = sum_k z(k) w(k),   S = sum_k w(k)^2 z(k) z(k)'
/// ```
///
/// (White, *Econometrica* 48, 1980, with the whitening of Andrews and Monahan, *Econometrica* 60, 1992.) A window over
/// the products `j e`, as in Andrews 1991, underestimates a strong correlation: for residuals of `.8 e(k-1) + w(k)` two
/// sigma then covered only 75 to 82 % of the records.
fn variances(step: &Step<'_>, found: &Candidate) -> Option<DVector<f64>> {
    let (rows, residual) = slopes(step, found);
    let (n, p) = (rows.nrows(), rows.ncols());
    let inverse = (rows.transpose() * &rows).try_inverse()?;
    let colour = Colour::of(residual.as_slice());
    let scores = colour.scores(&rows, residual.as_slice());
    let free = colour.independent(n);
    // corrects for the part of the residuals that the fit removed
    let share = free / (free - p as f64).max(0.5 * free);
    let covariance = &inverse * (scores.transpose() * scores) * &inverse * share;
    Some(covariance.diagonal())
}

/// Derivatives by rise, `t`, `l`, level and, if fitted, the free response; and the residuals.
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

/// A smaller share of the rise counts as no overshoot.
const LEAST: f64 = 0.05;
/// Standard deviations allowed to noise: one of 1,000 samples exceeds them with a probability of 2e-5.
const NOISE_SIGMAS: f64 = 5.5;
/// Upper bound of the widened number: of 100 records with noise remembered for 100 samples, none exceeded 11.4.
const MOST: f64 = 12.0;
/// Share of the samples after the step, at the end of the record, over which the response counts as settled.
const END: f64 = 1.0 / 3.0;

/// The largest excess over the settled level as a share of the rise; 0 if noise could reach it, too.
///
/// It is measured on moving means over a fraction of the fitted response, and compared with their scatter around the
/// fit at the end of the record. How well that scatter is known depends on the number of independent samples left by
/// the noise's spectrum and the means: [`NOISE_SIGMAS`] standard deviations of a normal distribution are widened to
/// those of Student's (Wallace, *Ann. Math. Stat.* 30, 1959).
pub(super) fn overshoot(step: &Step<'_>, found: &Candidate) -> f64 {
    let after = step.at..step.y.len();
    let residual: Vec<f64> = after
        .clone()
        .map(|k| step.y[k] - found.output(k, step.at))
        .collect();
    // beyond the settled level, without the free response
    let excess: Vec<f64> = after
        .zip(&residual)
        .map(|(k, e)| e - found.rise * (1.0 - found.share(k, step.at)))
        .collect();
    let n = residual.len();
    let width = (found.t.min(0.25 * (found.t + found.l)) as usize).clamp(1, (n / 6).max(1));
    let end = (n as f64 * END) as usize;
    let (last, averaged) = (&residual[n - end..], means(&residual, width));
    let settled = &averaged[averaged.len() - end..];
    let (level, scatter) = (mean(settled), deviation(settled));
    let outward = found.rise.signum();
    let beyond = |e: &f64| outward * (e - level);
    let most = means(&excess, width).iter().map(beyond).fold(0.0, f64::max);
    let share = most / found.rise.abs();
    if share > LEAST && most > scatter * allowed(last, width) {
        share
    } else {
        0.0
    }
}

/// Standard deviations allowed to means over `width` of this noise.
fn allowed(noise: &[f64], width: usize) -> f64 {
    let level = mean(noise);
    let centred: Vec<f64> = noise.iter().map(|e| e - level).collect();
    let n = noise.len();
    let independent = Colour::of(&centred)
        .independent(n)
        .min(n as f64 / width as f64)
        - 1.0;
    if independent < 1.0 {
        return MOST;
    }
    let student = (independent * (NOISE_SIGMAS.powi(2) / independent).exp_m1()).sqrt();
    student.min(MOST)
}

/// Means over `width` neighbours, from running sums: summing every window anew took seconds on a long record, without a
/// check for Ctrl-C.
fn means(values: &[f64], width: usize) -> Vec<f64> {
    let mut sums = vec![0.0];
    let mut sum = 0.0;
    for value in values {
        sum += value;
        sums.push(sum);
    }
    let of = |ends: &[f64]| (ends[width] - ends[0]) / width as f64;
    sums.windows(width + 1).map(of).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn deviation(values: &[f64]) -> f64 {
    let level = mean(values);
    let squares = values.iter().map(|e| (e - level).powi(2));
    (squares.sum::<f64>() / values.len() as f64).sqrt()
}
