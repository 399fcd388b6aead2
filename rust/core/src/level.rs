//! Fits of linear models about the level at which their records begin.
//!
//! A constant in input or output is the offset's alone. Beside a large one the columns of a fit are nearly dependent, and
//! where its iterations end would depend on it. So records are fitted as differences from their first values, and the
//! offset for the values themselves follows from the model:
//!
//! ```text
//! offset = offset' + (1 + sum a) y0 - sum b u0
//! ```

use nalgebra::DMatrix;

use crate::lagged::Lagged;
use crate::linear::{LinearFit, LinearModel};
use crate::{Record, Result};

/// The first input and the first measured output that counts.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Level {
    u: Vec<f64>,
    y: f64,
}

impl Level {
    /// Of the first record; zero for no record at all.
    pub(crate) fn of(records: &[Record]) -> Self {
        let Some(first) = records.first() else {
            return Self {
                u: Vec::new(),
                y: 0.0,
            };
        };
        // an outlier that weighs next to nothing is no level
        let usual = first.total_weight() / first.measured().max(1) as f64;
        let counts = |k: &usize| !first.y[*k].is_nan() && first.weight(*k) >= 0.5 * usual;
        let k = (0..first.len()).find(counts);
        Self {
            u: first.u[..first.channels.min(first.u.len())].to_vec(),
            y: k.map_or(0.0, |k| first.y[k]),
        }
    }

    fn is_zero(&self) -> bool {
        self.y == 0.0 && self.u.iter().all(|u| *u == 0.0)
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
        with_offset(model, model.offset() - self.offset(model))
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

/// `fit` on the differences of the records from their level, if it fits an `offset`; its result is of the values.
pub(crate) fn about_level(
    records: &[Record],
    offset: bool,
    fit: impl FnOnce(&[Record], &Level) -> Result<LinearFit>,
) -> Result<LinearFit> {
    let level = Level::of(records);
    if !offset || level.is_zero() {
        let none = Level {
            u: vec![0.0; level.u.len()],
            y: 0.0,
        };
        return fit(records, &none);
    }
    let lower = |record: &Record| -> (Vec<f64>, Vec<f64>) {
        let channels = record.channels.max(1);
        let u = record
            .u
            .iter()
            .enumerate()
            .map(|(i, u)| u - level.u.get(i % channels).unwrap_or(&0.0));
        (u.collect(), record.y.iter().map(|y| y - level.y).collect())
    };
    let lowered: Vec<_> = records.iter().map(lower).collect();
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
    fn a_fit_without_an_offset_is_of_the_values_themselves() {
        let [(u, y), _] = records((0.0, 5.0));
        let records = [Record::new(&u, 2, &y).unwrap()];
        let found = oe::fit(&records, 2, 2, 1, false, 100, &Monitor::default()).unwrap();
        assert_eq!(found.model.offset(), 0.0);
    }
}
