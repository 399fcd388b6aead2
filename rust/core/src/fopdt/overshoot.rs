//! Whether a response goes beyond where it settles, which none of first order does.

use super::confidence::Colour;
use super::{Candidate, Step};

/// Less than this share of the rise is none.
const LEAST: f64 = 0.05;
/// Standard deviations that noise is allowed: it exceeds them at one of 1,000 samples with a probability of 2e-5.
const SIGMAS: f64 = 5.5;
/// The most that they are widened to: of 100 records with noise that is remembered for 100 samples, none went beyond 11.4.
const MOST: f64 = 12.0;
/// The end of the record over this share of the samples after the step is where it has settled.
const END: f64 = 1.0 / 3.0;

/// The largest excess over the settled level as a share of the rise; 0 where the noise would reach it too.
///
/// It is taken of moving means, as long as a fraction of the fitted response, whose scatter about the fit is that of the end of
/// the record. That scatter is known as well as from so many independent samples as the noise's colour and the means leave;
/// [`SIGMAS`] standard deviations of a normal distribution are widened to those of Student's (Wallace, *Ann. Math. Stat.* 30, 1959).
pub(super) fn overshoot(step: &Step<'_>, found: &Candidate) -> f64 {
    let after = step.at..step.y.len();
    let residual: Vec<f64> = after
        .clone()
        .map(|k| step.y[k] - found.output(k, step.at))
        .collect();
    // beyond the settled level; a free response is no part of it
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

/// Standard deviations that means over `width` of this noise are allowed.
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
    let student = (independent * (SIGMAS.powi(2) / independent).exp_m1()).sqrt();
    student.min(MOST)
}

/// Means over `width` neighbours.
fn means(values: &[f64], width: usize) -> Vec<f64> {
    values.windows(width).map(mean).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn deviation(values: &[f64]) -> f64 {
    let level = mean(values);
    let squares = values.iter().map(|e| (e - level).powi(2));
    (squares.sum::<f64>() / values.len() as f64).sqrt()
}
