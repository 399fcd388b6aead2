//! Fits of linear models about the level at which their records begin.
//!
//! A constant in input or output is the offset's alone. Beside a large one the columns of a fit are nearly dependent, and
//! where its iterations end would depend on it. So records are fitted as differences from their first values, and the
//! offset for the values themselves follows from the model:
//!
//! ```text
//! offset = offset' + (1 + sum a) y0 - sum b u0
//! ```
//!
//! Numbers beside a large constant have lost their last digits, and what follows from a fit may depend on its last digit: a
//! search of gains ends in another of two minima that cost the same. So the differences are rounded to a grid that is
//! coarser than what a constant takes away. Then the same record at another level gives the same bits.

use nalgebra::DMatrix;

use crate::lagged::Lagged;
use crate::linear::{LinearFit, LinearModel};
use crate::{Record, Result};

/// The grid of the differences relative to the span of a column. A constant of a thousand spans takes a ten-thousandth of
/// its step, so that of a thousand samples a few per cent of all records have one that is rounded otherwise.
const GRID: f64 = 1.0 / (1_u64 << 30) as f64;

/// The first input and the first measured output that counts, and the steps of the grids of their columns.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Level {
    u: Vec<f64>,
    y: f64,
    steps: Vec<f64>,
    step: f64,
}

impl Level {
    /// Of the first record; zero for no record at all.
    pub(crate) fn of(records: &[Record]) -> Self {
        let Some(first) = records.first() else {
            return Self::none(0);
        };
        let channels = first.channels.min(first.u.len());
        let column = |j: usize| {
            let rows = records.iter().map(move |r| r.u.iter().skip(j));
            rows.flat_map(move |u| u.step_by(channels)).copied()
        };
        // an outlier that weighs next to nothing is no level, and no part of the span
        let counting = |record: &Record| -> Vec<f64> {
            let usual = record.total_weight() / record.measured().max(1) as f64;
            let counts = |k: &usize| !record.y[*k].is_nan() && record.weight(*k) >= 0.5 * usual;
            let counting = (0..record.len()).filter(counts);
            counting.map(|k| record.y[k]).collect()
        };
        let outputs: Vec<Vec<f64>> = records.iter().map(counting).collect();
        Self {
            u: first.u[..channels].to_vec(),
            y: outputs[0].first().copied().unwrap_or(0.0),
            steps: (0..channels).map(|j| step(column(j))).collect(),
            step: step(outputs.iter().flatten().copied()),
        }
    }

    /// No level, and no grid.
    fn none(channels: usize) -> Self {
        Self {
            u: vec![0.0; channels],
            y: 0.0,
            steps: vec![0.0; channels],
            step: 0.0,
        }
    }

    /// The differences of a record's inputs and outputs.
    fn differences(&self, record: &Record) -> (Vec<f64>, Vec<f64>) {
        let channels = record.channels.max(1);
        let u = record.u.iter().enumerate().map(|(i, u)| {
            let j = i % channels;
            on_grid(u - self.u[j], self.steps[j])
        });
        let y = record.y.iter().map(|y| on_grid(y - self.y, self.step));
        (u.collect(), y.collect())
    }

    /// What is added to the offset of a model of the differences.
    fn offset(&self, model: &LinearModel) -> f64 {
        self.by_parameter(model)
            .iter()
            .zip(model.a().iter().chain(model.b()))
            .map(|(d, p)| d * p)
            .sum::<f64>()
            + self.y
    }

    /// Its derivatives with respect to `a` and `b`.
    fn by_parameter(&self, model: &LinearModel) -> Vec<f64> {
        let lags = model.lags();
        let mut by = vec![self.y; lags.na];
        by.extend(self.u.iter().flat_map(|u| std::iter::repeat_n(-u, lags.nb)));
        by
    }

    /// The model of the values from that of the differences.
    fn raised(&self, model: &LinearModel) -> Result<LinearModel> {
        with_offset(model, model.offset() + self.offset(model))
    }

    /// The model of the differences from that of the values.
    pub(crate) fn lowered(&self, model: &LinearModel) -> Result<LinearModel> {
        with_offset(
            model,
            on_grid(model.offset() - self.offset(model), self.step),
        )
    }
}

fn with_offset(model: &LinearModel, offset: f64) -> Result<LinearModel> {
    let lags = model.lags();
    LinearModel::new(
        model.a().to_vec(),
        model.b().to_vec(),
        lags.channels,
        lags.nk,
        offset,
    )
}

/// The step of the grid of some values: a power of two, so that the span is told alike at every level.
fn step(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
            (low.min(v), high.max(v))
        });
    let span = high - low;
    if span > 0.0 && span.is_finite() {
        // the exponent alone
        GRID * f64::from_bits(span.to_bits() & (0x7ff << 52))
    } else {
        0.0
    }
}

/// A value on a grid; a grid without a step leaves it as it is.
fn on_grid(value: f64, step: f64) -> f64 {
    if step >= f64::MIN_POSITIVE {
        (value / step).round() * step
    } else {
        value
    }
}

/// `fit` on the differences of the records from their level, if it fits an `offset`; its result is of the values.
pub(crate) fn about_level(
    records: &[Record],
    offset: bool,
    fit: impl FnOnce(&[Record], &Level) -> Result<LinearFit>,
) -> Result<LinearFit> {
    if !offset {
        let channels = records.first().map_or(0, |r| r.channels);
        return fit(records, &Level::none(channels));
    }
    let level = Level::of(records);
    let lowered: Vec<_> = records.iter().map(|r| level.differences(r)).collect();
    let views: Vec<Record> = records
        .iter()
        .zip(&lowered)
        .map(|(record, (u, y))| Record { u, y, ..*record })
        .collect();
    let mut found = fit(&views, &level)?;
    found.covariance = covariance(&found, &level.by_parameter(&found.model));
    found.model = level.raised(&found.model)?;
    found
        .initial_states
        .iter_mut()
        .flatten()
        .for_each(|y| *y += level.y);
    Ok(found)
}

/// `T C T'` with the last row of `T`, the offset's, `by` and 1.
fn covariance(found: &LinearFit, by: &[f64]) -> Vec<f64> {
    let n = by.len() + 1;
    let mut turn = DMatrix::identity(n, n);
    for (i, slope) in by.iter().enumerate() {
        turn[(n - 1, i)] = *slope;
    }
    let known = DMatrix::from_row_slice(n, n, &found.covariance);
    // what is not determined stays so
    if known.iter().any(|c| !c.is_finite()) {
        return found.covariance.clone();
    }
    let turned = &turn * known * turn.transpose();
    turned.transpose().as_slice().to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::{Monitor, iv, oe};

    type Columns = (Vec<f64>, Vec<f64>);

    /// A noisy record of two inputs, and the same with constants added.
    fn records(by: (f64, f64)) -> [Columns; 2] {
        let truth =
            LinearModel::new(vec![-1.6, 0.66], vec![0.05, 0.03, 0.02, 0.01], 2, 1, 0.1).unwrap();
        [7, 8].map(|seed| {
            let mut random = Random::new(seed);
            let u: Vec<f64> = (0..600)
                .map(|k| f64::from(k / 50 % 3) + 0.3 * random.normal())
                .collect();
            let y = truth.simulate(&u, 2, &[2.0, 2.0]).unwrap();
            let u = u.iter().map(|u| u + by.0).collect();
            (
                u,
                y.iter()
                    .map(|y| y + by.1 + 0.05 * random.normal())
                    .collect(),
            )
        })
    }

    fn shifted(fit: impl Fn(&[Record]) -> LinearFit, by: (f64, f64)) {
        let of = |columns: &[Columns; 2]| {
            let views: Vec<_> = columns
                .iter()
                .map(|(u, y)| Record::new(u, 2, y).unwrap())
                .collect();
            fit(&views)
        };
        let (here, there) = (of(&records((0.0, 0.0))), of(&records(by)));
        let apart = |one: &[f64], other: &[f64], by: f64| {
            let pairs = one.iter().zip(other);
            pairs.map(|(a, b)| (a + by - b).abs()).fold(0.0, f64::max)
        };
        assert!(apart(here.model.a(), there.model.a(), 0.0) < 1e-8, "{by:?}");
        assert!(apart(here.model.b(), there.model.b(), 0.0) < 1e-8, "{by:?}");
        assert!((here.cost / there.cost - 1.0).abs() < 1e-10);
        for (one, other) in here.initial_states.iter().zip(&there.initial_states) {
            assert!(apart(one, other, by.1) < 1e-7, "{one:?} {other:?}");
        }
        let (errors, others) = (here.standard_errors(), there.standard_errors());
        assert!(apart(&errors[..6], &others[..6], 0.0) < 1e-8);
        // the offset of the shifted record is a combination of the other's parameters
        let at = Level {
            u: vec![by.0; 2],
            y: by.1,
            ..Level::none(2)
        };
        let turned = covariance(&here, &at.by_parameter(&here.model));
        let expected = turned[turned.len() - 1].sqrt();
        assert!(
            (others[6] / expected - 1.0).abs() < 1e-6,
            "{} {expected}",
            others[6]
        );
        assert!(
            (at.raised(&here.model).unwrap().offset() - there.model.offset()).abs()
                < 1e-7 * by.1.abs().max(1.0)
        );
    }

    #[test]
    fn constants_change_nothing_but_the_offset() {
        let monitor = Monitor::default();
        for by in [(0.0, 24.5), (0.0, 293.15), (3.0, -1e4)] {
            shifted(|r| oe::fit(r, 2, 2, 1, true, 100, &monitor).unwrap(), by);
            shifted(|r| iv::fit(r, 2, 2, 1, true, 20, &monitor).unwrap(), by);
        }
    }

    #[test]
    fn the_same_record_at_another_level_gives_the_same_bits() {
        let fitted = |by: (f64, f64)| {
            let columns = records(by);
            let views: Vec<_> = columns
                .iter()
                .map(|(u, y)| Record::new(u, 2, y).unwrap())
                .collect();
            let monitor = Monitor::default();
            let one = oe::fit(&views, 2, 2, 1, true, 100, &monitor).unwrap();
            let other = iv::fit(&views, 2, 2, 1, true, 20, &monitor).unwrap();
            [one, other].map(|fit| (fit.model.a().to_vec(), fit.model.b().to_vec(), fit.cost))
        };
        let here = fitted((0.0, 0.0));
        for by in [(0.0, 24.5), (0.0, 293.15), (-7.3, 0.0), (3.1, -1.7)] {
            assert_eq!(here, fitted(by), "{by:?}");
        }
    }

    #[test]
    fn a_fit_without_an_offset_is_of_the_values_themselves() {
        let [(u, y), _] = records((0.0, 5.0));
        let records = [Record::new(&u, 2, &y).unwrap()];
        let found = oe::fit(&records, 2, 2, 1, false, 100, &Monitor::default()).unwrap();
        assert_eq!(found.model.offset(), 0.0);
    }
}
