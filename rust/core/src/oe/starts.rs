//! Where linear output error starts: least squares, instrumental variables, and poles over all time constants.

use std::f64::consts::PI;

use nalgebra::{Complex, DMatrix, DVector};

use super::problem::OutputError;
use crate::lagged::Lagged;
use crate::linear::{LinearModel, is_stable, poles, polynomial};
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
    for a in identified(problem, records)
        .into_iter()
        .chain(drawn(problem, records))
    {
        if monitor.stopped() && !found.is_empty() {
            break;
        }
        found.extend(problem.with_poles(&a));
    }
    found.sort_by(|x, y| x.0.total_cmp(&y.0));
    found.dedup_by(|x, y| (x.0 - y.0).abs() <= SAME_COST * y.0);
    found
}

/// Denominators by ARX, by SRIV and by Steiglitz and McBride, made stable.
fn identified(problem: &OutputError, records: &[Record]) -> Vec<Vec<f64>> {
    let lags = problem.lags;
    let offset = problem.shared() > lags.regressors();
    let Ok(first) = arx::fit(records, lags.na, lags.nb, lags.nk, offset) else {
        return Vec::new();
    };
    let mut all = vec![stabilised(first.a())];
    for instruments in [Instruments::Simulated, Instruments::Measured] {
        let mut model = with_denominator(&first, stabilised(first.a()));
        for _ in 0..IV_ITERATIONS {
            let Some(next) = model
                .as_ref()
                .and_then(|m| refined(m, records, offset, instruments))
            else {
                break;
            };
            all.push(next.a().to_vec());
            model = Some(next);
        }
    }
    all
}

#[derive(Clone, Copy)]
enum Instruments {
    /// SRIV: regressors made of simulated outputs.
    Simulated,
    /// Steiglitz and McBride: the regressors themselves.
    Measured,
}

/// One iteration: everything filtered by `1/A` of the model before, then the instrumental-variable estimate.
fn refined(
    model: &LinearModel,
    records: &[Record],
    offset: bool,
    kind: Instruments,
) -> Option<LinearModel> {
    let lags = model.lags();
    let columns = lags.regressors() + usize::from(offset);
    let (mut left, mut right) = (DMatrix::zeros(columns, columns), DVector::zeros(columns));
    let (mut row, mut instruments) = (vec![0.0; columns], vec![0.0; columns]);
    for record in records {
        let state = vec![record.y.first().copied().unwrap_or(0.0); lags.na];
        let simulated = model.simulate(record.u, record.channels, &state).ok()?;
        let y = filtered(model.a(), record.y, 1);
        let x = filtered(model.a(), &simulated, 1);
        let u = filtered(model.a(), record.u, record.channels);
        let ones = filtered(model.a(), &vec![1.0; record.len()], 1);
        for k in lags.first_whole()..record.len() {
            lags.write_inputs(&u, k, &mut row[lags.na..lags.regressors()]);
            row[lags.regressors()..].fill(ones[k]);
            instruments.copy_from_slice(&row);
            for i in 0..lags.na {
                row[i] = y[k - 1 - i];
                instruments[i] = match kind {
                    Instruments::Simulated => x[k - 1 - i],
                    Instruments::Measured => y[k - 1 - i],
                };
            }
            for (i, z) in instruments.iter().enumerate() {
                right[i] += z * y[k];
                for (j, value) in row.iter().enumerate() {
                    left[(i, j)] += z * value;
                }
            }
        }
    }
    let solution = left.lu().solve(&right)?;
    let a: Vec<f64> = solution.iter().take(lags.na).map(|a| -a).collect();
    let b = solution.as_slice()[lags.na..lags.regressors()].to_vec();
    let offset = solution
        .as_slice()
        .get(lags.regressors())
        .copied()
        .unwrap_or(0.0);
    if !a.iter().all(|v| v.is_finite()) {
        return None;
    }
    LinearModel::new(stabilised(&a), b, lags.channels, lags.nk, offset).ok()
}

/// Each channel divided by `A(q)`, from rest at its first value.
fn filtered(a: &[f64], values: &[f64], channels: usize) -> Vec<f64> {
    let gain = 1.0 / (1.0 + a.iter().sum::<f64>());
    let mut out = vec![0.0; values.len()];
    for k in 0..values.len() {
        let at = |i: usize| {
            if k >= i * channels {
                out[k - i * channels]
            } else {
                values[k % channels] * gain
            }
        };
        let past: f64 = a.iter().enumerate().map(|(i, a)| a * at(i + 1)).sum();
        out[k] = values[k] - past;
    }
    out
}

fn with_denominator(model: &LinearModel, a: Vec<f64>) -> Option<LinearModel> {
    LinearModel::new(
        a,
        model.b().to_vec(),
        model.lags().channels,
        model.lags().nk,
        model.offset(),
    )
    .ok()
}

/// The denominator with every root inside the unit circle: those outside are mirrored at it.
fn stabilised(a: &[f64]) -> Vec<f64> {
    if is_stable(a, 1e-6) {
        return a.to_vec();
    }
    let inside = |p: Complex<f64>| {
        let radius = p.norm();
        let wanted = if radius > 1.0 { 1.0 / radius } else { radius };
        if radius > 0.0 {
            p * (wanted.min(0.999) / radius)
        } else {
            p
        }
    };
    polynomial(&poles(a).into_iter().map(inside).collect::<Vec<_>>())
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
