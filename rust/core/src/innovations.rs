//! Linear models of plants that a loop held while they were recorded: the prediction error of an ARMAX model.
//!
//! Free runs say nothing about an unstable plant, and least squares of the one-step error is biased by noise of the
//! measurement. The innovations form of a linear system,
//!
//! ```text
//! A(q) y(k) = B(q) u(k) + offset + C(q) e(k),
//! ```
//!
//! has a predictor that is stable whatever the plant is, and that needs no knowledge of the loop (Ljung, *System
//! Identification*, 2nd ed., sections 4.2 and 13.4):
//!
//! ```text
//! C(q) y^(k) = B(q) u(k) + (C(q) - A(q)) y(k) + offset.
//! ```
//!
//! This is the free run of an output-error model whose inputs are `u` and the measured `y`, so that `oe` fits it. Where
//! an output is missing, the prediction takes its place, and has no error.

use nalgebra::DMatrix;

use crate::column::{MEASURED, Rows, runs};
use crate::lagged::Lagged;
use crate::linear::{LinearFit, LinearModel};
use crate::{Error, Monitor, Record, Result, oe};

/// Largest order. Longer runs of missing outputs part a record: a part costs as many initial states as its order.
pub(crate) const MOST_ORDER: usize = 8;
/// How many orders in a row without gain end the search.
const PATIENCE: usize = 2;

/// Fits ARMAX models of rising order and delay, and returns the plant of the one with the least Bayesian information
/// criterion (Schwarz, *Ann. Stat.* 6, 1978): `model` has `A`, `B` and the offset, `cost` is of the one-step error.
/// Its poles may lie outside the unit circle. Without `nk` it begins at one sample.
///
/// # Errors
/// `ErrorKind::Data` if no stretch of the records is long enough, else those of [`oe::fit`].
pub fn fit(
    records: &[Record],
    nk: Option<usize>,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<LinearFit> {
    let parts = bridged(records);
    let channels = records.first().map_or(0, |r| r.channels);
    let of = |order, nk| one(&parts, channels, order, nk, max_iterations, monitor);
    let first = nk.unwrap_or(1);
    let (mut best, mut idle) = (of(1, first)?, 0);
    for order in 2..=MOST_ORDER {
        if idle == PATIENCE || monitor.stopped() {
            break;
        }
        idle = if improved(&mut best, of(order, first)) {
            0
        } else {
            idle + 1
        };
    }
    // an order can be a delay
    let mut late = first + 1;
    while nk.is_none() && !monitor.stopped() {
        let order = best.fit.model.a().len();
        let smaller = order > 1 && improved(&mut best, of(order - 1, late));
        if !(improved(&mut best, of(order, late)) || smaller) {
            break;
        }
        late += 1;
    }
    let nk = best.fit.model.lags().nk;
    while !monitor.stopped() {
        let order = best.fit.model.a().len();
        if order == 1 || !improved(&mut best, of(order - 1, nk)) {
            break;
        }
    }
    Ok(best.fit)
}

/// The stretches of the records, each from a known sample to another, in which a few outputs at a time can be missing.
fn bridged(records: &[Record]) -> Vec<Rows> {
    let mut parts = Vec::new();
    for record in records {
        let rows = Rows::of(record, MEASURED);
        let commanded = |k: usize| (0..record.channels).all(|j| rows.at(k, j).is_finite());
        let mut found: Vec<(usize, usize)> = Vec::new();
        for (first, count) in runs(rows.known()) {
            match found.last_mut() {
                Some((_, end)) if first - *end <= MOST_ORDER && (*end..first).all(commanded) => {
                    *end = first + count;
                }
                _ => found.push((first, first + count)),
            }
        }
        parts.extend(found.iter().map(|&(a, b)| rows.part(a, b - a)));
    }
    parts
}

/// A fit and its criterion.
struct Candidate {
    fit: LinearFit,
    criterion: f64,
}

fn improved(best: &mut Candidate, other: Result<Candidate>) -> bool {
    match other {
        Ok(other) if other.criterion < best.criterion => {
            *best = other;
            true
        }
        _ => false,
    }
}

/// The ARMAX model of an order and delay, by output error with the measured output as a further input.
fn one(
    parts: &[Rows],
    channels: usize,
    order: usize,
    nk: usize,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<Candidate> {
    let unknowns = order * (2 + channels) + 1;
    // whoever is as short gives its past outputs and no more
    let able = |p: &&Rows| p.len() > 2 * order + nk;
    let columns: Vec<(Vec<f64>, Vec<f64>)> = parts
        .iter()
        .filter(able)
        .map(|p| advanced(p, channels, nk))
        .collect();
    let outputs = columns.iter().flat_map(|(_, y)| y);
    let samples = outputs.filter(|y| !y.is_nan()).count();
    if samples < 10 * unknowns {
        return Err(Error::data(format!(
            "expected at least {} samples for {unknowns} parameters of a plant in a loop, got {samples}; record longer",
            10 * unknowns
        )));
    }
    let records = columns
        .iter()
        .map(|(u, y)| Record::with_gaps(u, channels + 1, y))
        .collect::<Result<Vec<_>>>()?;
    let fit = oe::fit_predictor(&records, order, max_iterations, monitor)?;
    let fit = plant(&fit, order, channels, nk)?;
    let n = samples as f64;
    Ok(Candidate {
        criterion: n * fit.cost.max(f64::MIN_POSITIVE).ln() + unknowns as f64 * n.ln(),
        fit,
    })
}

/// Inputs row by row, each command earlier by what its delay is beyond a sample, then the output, the last one where it
/// is missing; and the output alone.
fn advanced(part: &Rows, channels: usize, nk: usize) -> (Vec<f64>, Vec<f64>) {
    let late = nk.saturating_sub(1);
    let mut last = f64::NAN;
    let held: Vec<f64> = part
        .column(channels)
        .map(|y| {
            last = if y.is_nan() { last } else { y };
            last
        })
        .collect();
    let row = |k: usize| {
        let inputs = (0..channels).map(move |j| part.at(k - late, j));
        inputs.chain([held[k]])
    };
    let u = (late..part.len()).flat_map(row).collect();
    (u, part.column(channels).skip(late).collect())
}

/// The plant of a predictor: `A` is `C` less the predictor's numerator of the output.
fn plant(predictor: &LinearFit, order: usize, channels: usize, nk: usize) -> Result<LinearFit> {
    let (c, b) = (predictor.model.a(), predictor.model.b());
    let (of_u, of_y) = b.split_at(order * channels);
    let a = c.iter().zip(of_y).map(|(c, d)| c - d).collect();
    let model = LinearModel::new(a, of_u.to_vec(), channels, nk, predictor.model.offset())?;
    // parameters of the predictor: c, b input by input, the output's numerator, offset
    let (kept, all) = (order * (1 + channels) + 1, order * (2 + channels) + 1);
    let place = |i: usize| if i + 1 == kept { all - 1 } else { i };
    let map = DMatrix::from_fn(kept, all, |i, j| {
        let is_own = f64::from(u8::from(j == place(i)));
        let is_output = i < order && j == order * (1 + channels) + i;
        is_own - f64::from(u8::from(is_output))
    });
    let covariance = DMatrix::from_row_slice(all, all, &predictor.covariance);
    let covariance = &map * covariance * map.transpose();
    Ok(LinearFit {
        model,
        // of a predictor it says where its error began, which is nothing of the plant
        initial_states: Vec::new(),
        covariance: covariance.transpose().as_slice().to_vec(),
        ..predictor.clone()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// `y'' = 25 y + 40 u` sampled every 10 ms, under a proportional-derivative controller with a dither on `u`.
    fn held(samples: usize, noise: f64, seed: u64) -> (Vec<f64>, Vec<f64>) {
        let (mut random, truth) = (Random::new(seed), [2.0 * 0.05_f64.cosh(), -1.0]);
        let gain = 40.0 / 25.0 * (0.05_f64.cosh() - 1.0);
        let (mut u, mut y, mut x) = (vec![0.0; samples], vec![0.0; samples], [0.0; 2]);
        for k in 0..samples {
            let past = if k > 0 { u[k - 1] } else { 0.0 };
            let before = if k > 1 { u[k - 2] } else { 0.0 };
            let now = truth[0] * x[0] + truth[1] * x[1] + gain * (past + before);
            y[k] = now + noise * random.normal();
            let slope = (y[k] - if k > 0 { y[k - 1] } else { 0.0 }) / 0.01;
            u[k] = -2.5 * y[k] - 0.5 * slope + random.normal();
            x = [now, x[0]];
        }
        (u, y)
    }

    #[test]
    fn an_unstable_plant_is_found_through_noise_and_loop() {
        for seed in 0..5 {
            let (u, y) = held(3_000, 0.003, seed);
            let record = Record::new(&u, 1, &y).unwrap();
            let found = fit(&[record], None, 60, &Monitor::default()).unwrap();
            let mut poles: Vec<f64> = found.model.poles().iter().map(|p| p.re).collect();
            poles.sort_by(f64::total_cmp);
            assert_eq!(found.model.a().len(), 2, "{poles:?}");
            assert!((poles[1] - 1.051_27).abs() < 2e-3, "{poles:?}");
            assert!((poles[0] - 0.951_23).abs() < 5e-3, "{poles:?}");
            let errors = found.standard_errors();
            let off = (found.model.a()[0] + 2.0 * 0.05_f64.cosh()).abs();
            assert!(off < 5.0 * errors[0], "{off} {errors:?}");
        }
    }

    #[test]
    fn a_gap_parts_a_record_and_short_ones_are_refused() {
        let (u, mut y) = held(2_000, 0.003, 9);
        y[700..720].fill(f64::NAN);
        let record = Record::with_gaps(&u, 1, &y).unwrap();
        let found = fit(&[record], Some(1), 60, &Monitor::default()).unwrap();
        let most = found
            .model
            .poles()
            .iter()
            .map(|p| p.norm())
            .fold(0.0, f64::max);
        assert!((most - 1.051_27).abs() < 3e-3, "{most}");
        let short = Record::new(&u[..30], 1, &y[..30]).unwrap();
        assert!(fit(&[short], None, 60, &Monitor::default()).is_err());
    }

    #[test]
    fn missing_outputs_are_predicted() {
        for missing in [9, 3, 2] {
            let (u, mut y) = held(3_000, 0.003, 4);
            y.iter_mut().step_by(missing).for_each(|y| *y = f64::NAN);
            let record = Record::with_gaps(&u, 1, &y).unwrap();
            let found = fit(&[record], None, 60, &Monitor::default()).unwrap();
            let mut poles: Vec<f64> = found.model.poles().iter().map(|p| p.re).collect();
            poles.sort_by(f64::total_cmp);
            assert_eq!(found.model.a().len(), 2, "{missing}: {poles:?}");
            assert!((poles[1] - 1.051_27).abs() < 3e-3, "{missing}: {poles:?}");
            assert!((poles[0] - 0.951_23).abs() < 8e-3, "{missing}: {poles:?}");
        }
    }

    #[test]
    fn a_delay_is_told_from_an_order() {
        let (u, y) = held(3_000, 0.001, 3);
        // the same loop, whose command is logged three samples early
        let early: Vec<f64> = (0..u.len()).map(|k| u[(k + 3).min(u.len() - 1)]).collect();
        let record = Record::new(&early[..2_990], 1, &y[..2_990]).unwrap();
        let found = fit(&[record], None, 60, &Monitor::default()).unwrap();
        assert_eq!((found.model.a().len(), found.model.lags().nk), (2, 4));
    }
}
