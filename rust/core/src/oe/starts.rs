//! Where linear output error starts: least squares, instrumental variables, and poles over all time constants.

use std::f64::consts::PI;

use nalgebra::Complex;

use super::problem::OutputError;
use crate::iv::{self, Outputs};
use crate::linear::{LinearModel, is_stable, polynomial, stabilised};
use crate::random::Random;
use crate::{Monitor, Record, arx};

/// Instrumental-variable iterations; they settle within five or so where they settle at all.
const IV_ITERATIONS: usize = 12;
/// Samples to simulate in all for drawn poles: about a fifth of a second.
const SCREENED_SAMPLES: usize = 4_000_000;
/// Candidates whose costs agree this closely are one.
const SAME_COST: f64 = 1e-6;

/// Start parameters with their costs, best free run first.
pub(super) fn candidates(
    problem: &mut OutputError,
    records: &[Record],
    monitor: &Monitor,
) -> Vec<(f64, Vec<f64>)> {
    let mut found: Vec<(f64, Vec<f64>)> = Vec::new();
    let lags = problem.lags;
    let offset = problem.shared() > lags.regressors();
    // the quickest one first, so that there is something after an early stop
    let least_squares = arx::fit(records, lags.na, lags.nb, lags.nk, offset);
    if let Ok(first) = &least_squares {
        found.extend(problem.with_poles(&stabilised(first.a())));
    }
    let identified = least_squares.map_or_else(
        |_| Vec::new(),
        |first| identified(records, &first, offset, monitor),
    );
    for a in identified.into_iter().chain(drawn(problem, records)) {
        if monitor.stopped() {
            break;
        }
        found.extend(problem.with_poles(&a));
    }
    found.sort_by(|x, y| x.0.total_cmp(&y.0));
    found.dedup_by(|x, y| (x.0 - y.0).abs() <= SAME_COST * y.0);
    found
}

/// Denominators by SRIV and by Steiglitz and McBride, made stable.
fn identified(
    records: &[Record],
    first: &LinearModel,
    offset: bool,
    monitor: &Monitor,
) -> Vec<Vec<f64>> {
    let denominators =
        |instruments| iv::denominators(records, first, offset, instruments, IV_ITERATIONS, monitor);
    [Outputs::Simulated, Outputs::Measured]
        .into_iter()
        .flat_map(denominators)
        .collect()
}

/// Denominators with poles drawn over time constants from half a sample to a quarter of the record; a third of them
/// has complex pairs.
fn drawn(problem: &OutputError, records: &[Record]) -> Vec<Vec<f64>> {
    let samples: usize = records.iter().map(Record::len).sum();
    let longest = records.iter().map(Record::len).max().unwrap_or(1) as f64 / 4.0;
    let na = problem.lags.na;
    let draws = (SCREENED_SAMPLES / samples.max(1)).clamp(20, 60 * na.min(4));
    let mut random = Random::new(0);
    (0..draws)
        .map(|i| {
            let mut roots = Vec::with_capacity(na);
            while roots.len() < na {
                let time = (random.between(0.5f64.ln(), longest.max(2.0).ln())).exp();
                let radius = (-1.0 / time).exp();
                if i % 3 == 2 && na - roots.len() >= 2 {
                    let angle = random.between((0.5 / longest.max(1.0)).ln(), PI.ln()).exp();
                    let root = Complex::from_polar(radius, angle.min(PI));
                    roots.extend([root, root.conj()]);
                } else {
                    roots.push(Complex::new(radius, 0.0));
                }
            }
            polynomial(&roots)
        })
        .filter(|a| is_stable(a, 1e-9))
        .collect()
}
