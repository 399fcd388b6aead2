//! ARX by least squares: one-step errors, normal equations with scaled columns, and QR if these are nearly singular.

mod shifts;

use nalgebra::{DMatrix, DVector, DVectorViewMut};

use crate::data::Samples;
use crate::lagged::Lags;
use crate::linear::LinearModel;
use crate::{Error, Record, Result};
use shifts::Shifts;

/// A pivot of the scaled Gram matrix below this leaves fewer than five digits; QR keeps them.
const SMALL_PIVOT: f64 = 1e-10;
/// Relative size of the smallest singular value below which columns count as linearly dependent.
const RANK_TOLERANCE: f64 = 1e-12;

/// Least squares on `y(k) = -sum a y(k-i) + sum b u(k-nk-i) [+ offset] + e(k)` over all experiments.
///
/// ```
/// use sewfast_core::lagged::Lagged;
/// use sewfast_core::linear::LinearModel;
/// use sewfast_core::{Record, arx};
///
/// let truth = LinearModel::new(vec![-0.9], vec![0.2], 1, 1, 0.5)?;
/// let u: Vec<f64> = (0..200).map(|k| f64::from(k * k % 7)).collect();
/// let y = truth.simulate(&u, 1, &[0.0])?;
/// let records = [Record::new(&u, 1, &y)?];
/// let model = arx::fit(&records, 1, 1, 1, true)?;
/// assert!((model.a()[0] + 0.9).abs() < 1e-6);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
///
/// # Errors
/// `ErrorKind::Data` for too few samples, different numbers of inputs, a constant input or output;
/// `ErrorKind::Fit` for linearly dependent columns.
pub fn fit(
    records: &[Record],
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
) -> Result<LinearModel> {
    let lags = check(records, na, nb, nk)?;
    let columns = lags.regressors() + usize::from(offset);
    let rows = usable(records, &lags);
    if rows < columns {
        return Err(Error::data(format!(
            "expected at least {columns} samples with a whole regressor (output and {na} outputs before it measured), got {rows}; record longer, lower na and nb, or use output error, which needs no neighbouring measurements"
        )));
    }
    let (gram, moment) = normal_equations(records, &lags, columns);
    let solution = match by_cholesky(&gram, &moment) {
        Some(solution) => solution,
        None => by_qr(records, &lags, columns, rows)?,
    };
    model(&lags, &solution)
}

/// As [`fit`], on samples whose values have not been checked yet: every pass over a long recording costs as much as the fit.
///
/// # Errors
/// As [`fit`], and as [`Record::with_gaps`].
pub fn fit_samples(
    samples: &[Samples],
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
) -> Result<LinearModel> {
    if let Some(model) = fit_unseen(samples, na, nb, nk, offset) {
        return Ok(model);
    }
    let records: Result<Vec<Record>> = samples.iter().map(|s| s.record()).collect();
    fit(&records?, na, nb, nk, offset)
}

/// The fit without checks of the values; its sums show whether all of them are finite.
fn fit_unseen(
    samples: &[Samples],
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
) -> Option<LinearModel> {
    let records: Vec<Record> = samples.iter().map(Samples::unseen).collect();
    let lags = check(&records, na, nb, nk).ok()?;
    let columns = lags.regressors() + usize::from(offset);
    let shifts = Shifts::new(&lags, columns);
    let ordinary = records
        .iter()
        .all(|r| shifts.suit(r) && has_finite_ends(r, &lags));
    if !ordinary || usable(&records, &lags) < columns {
        return None;
    }
    let (gram, moment) = normal_equations(&records, &lags, columns);
    if !gram.diagonal().sum().is_finite() {
        return None;
    }
    model(&lags, &by_cholesky(&gram, &moment)?).ok()
}

/// Whether the values at the ends of the record, which are in no column of the regressors, are finite.
fn has_finite_ends(record: &Record, lags: &Lags) -> bool {
    let (first, last) = (lags.first_whole(), lags.nk.max(1));
    let finite = |values: &[f64], width: usize| {
        let ends = [
            &values[..first * width],
            &values[values.len() - last * width..],
        ];
        ends.iter().all(|end| end.iter().all(|v| v.is_finite()))
    };
    finite(record.y, 1) && finite(record.u, record.channels)
}

/// The model from the coefficients of its regressors.
fn model(lags: &Lags, solution: &DVector<f64>) -> Result<LinearModel> {
    let (a, rest) = solution.as_slice().split_at(lags.na);
    let (b, offset) = rest.split_at(lags.nb * lags.channels);
    let offset = offset.first().copied().unwrap_or(0.0);
    let a = a.iter().map(|a| -a).collect();
    LinearModel::new(a, b.to_vec(), lags.channels, lags.nk, offset)
}

/// The orders, if the records can be used for identification.
///
/// # Errors
/// `ErrorKind::Setting` for impossible orders; `ErrorKind::Data` for no records, different numbers of inputs, or an
/// input or output that never changes.
pub(crate) fn check(records: &[Record], na: usize, nb: usize, nk: usize) -> Result<Lags> {
    let Some(first) = records.first() else {
        return Err(Error::data(
            "expected at least one experiment, got none; give a list of (u, y)",
        ));
    };
    let channels = first.channels;
    if let Some(other) = records.iter().find(|r| r.channels != channels) {
        return Err(Error::data(format!(
            "expected {channels} inputs in every experiment, got {}; give all experiments the same inputs",
            other.channels
        )));
    }
    for j in 0..channels {
        let values = records
            .iter()
            .flat_map(|r| r.u.iter().skip(j).step_by(channels));
        changes(values, &format!("input {j}"))?;
    }
    let measured = records.iter().flat_map(|r| r.y).filter(|y| !y.is_nan());
    changes(measured, "the output")?;
    Lags::new(na, nb, nk, channels)
}

fn changes<'a>(mut values: impl Iterator<Item = &'a f64>, name: &str) -> Result<()> {
    let first = values.next().copied();
    if values.any(|&v| Some(v) != first) {
        return Ok(());
    }
    let value = first.map_or("no samples".into(), |v| format!("{v} throughout"));
    Err(Error::data(format!(
        "expected {name} to change, got {value}; excite the drive, or leave out an input that is not used"
    )))
}

fn usable(records: &[Record], lags: &Lags) -> usize {
    let whole = |r: &Record| match (r.unmeasured, r.weights) {
        (0, None) => r.len().saturating_sub(lags.first_whole()),
        _ => whole_rows(r, lags).count(),
    };
    records.iter().map(whole).sum()
}

/// Samples that count: their regressor lies inside the record, and they and the outputs in it were measured.
fn whole_rows<'r>(record: &'r Record<'r>, lags: &Lags) -> impl Iterator<Item = usize> + 'r {
    let (na, complete) = (lags.na, record.unmeasured == 0);
    (lags.first_whole()..record.len())
        .filter(move |&k| complete || record.y[k - na..=k].iter().all(|y| !y.is_nan()))
        .filter(|&k| record.weight(k) > 0.0)
}

/// Calls `each(row, y)` for every sample of a record with a whole regressor; an additional column is 1. Both are
/// multiplied by the root of the sample's weight.
fn each_row(record: &Record, lags: &Lags, columns: usize, mut each: impl FnMut(&[f64], f64)) {
    let mut row = vec![1.0; columns];
    for k in whole_rows(record, lags) {
        for (i, past) in row[..lags.na].iter_mut().enumerate() {
            *past = record.y[k - 1 - i];
        }
        lags.write_inputs(record.u, k, &mut row[lags.na..lags.regressors()]);
        let Some(weights) = record.weights else {
            each(&row, record.y[k]);
            continue;
        };
        let root = weights[k].sqrt();
        row[lags.regressors()..].fill(1.0);
        row.iter_mut().for_each(|value| *value *= root);
        each(&row, root * record.y[k]);
    }
}

fn normal_equations(
    records: &[Record],
    lags: &Lags,
    columns: usize,
) -> (DMatrix<f64>, DVector<f64>) {
    let shifts = Shifts::new(lags, columns);
    let mut system = DMatrix::zeros(columns + 1, columns + 1);
    for record in records {
        match shifts.suit(record) {
            true => shifts.add(record, &mut system),
            false => add_rows(record, lags, &mut system),
        }
    }
    system.fill_upper_triangle_with_lower_triangle();
    let moment = system.view((0, columns), (columns, 1)).column(0).into();
    (system.view((0, 0), (columns, columns)).into(), moment)
}

/// Adds the record's rows, one by one, to the lower triangle of the system.
fn add_rows(record: &Record, lags: &Lags, system: &mut DMatrix<f64>) {
    let columns = system.ncols() - 1;
    each_row(record, lags, columns, |row, y| {
        for j in 0..columns {
            system[(columns, j)] += row[j] * y;
            for i in j..columns {
                system[(i, j)] += row[i] * row[j];
            }
        }
    });
}

/// Squared lengths below this have lost digits to underflow, or lose them in products with others.
const LEAST_SQUARE: f64 = 1e-280;

/// Solution of the normal equations with columns scaled to length 1; `None` if a pivot is small or products overflow or
/// underflow.
fn by_cholesky(gram: &DMatrix<f64>, moment: &DVector<f64>) -> Option<DVector<f64>> {
    let in_range = |d: &f64| *d > LEAST_SQUARE && d.is_finite();
    if !gram.diagonal().iter().all(in_range) {
        return None;
    }
    let scale = gram.diagonal().map(|d| 1.0 / d.sqrt());
    let scaled = DMatrix::from_fn(gram.nrows(), gram.ncols(), |i, j| {
        gram[(i, j)] * scale[i] * scale[j]
    });
    let factor = scaled.cholesky()?;
    let well_posed = factor
        .l_dirty()
        .diagonal()
        .iter()
        .all(|pivot| pivot * pivot > SMALL_PIVOT);
    well_posed.then(|| {
        factor
            .solve(&moment.component_mul(&scale))
            .component_mul(&scale)
    })
}

fn by_qr(records: &[Record], lags: &Lags, columns: usize, rows: usize) -> Result<DVector<f64>> {
    let mut values = Vec::with_capacity(rows * columns);
    let mut outputs = Vec::with_capacity(rows);
    for record in records {
        each_row(record, lags, columns, |row, y| {
            values.extend_from_slice(row);
            outputs.push(y);
        });
    }
    let mut matrix = DMatrix::from_row_slice(rows, columns, &values);
    let lengths: Vec<f64> = matrix.column_iter_mut().map(normalise).collect();
    let factor = matrix.qr();
    let mut right = DVector::from_vec(outputs);
    factor.q_tr_mul(&mut right);
    let r = factor.r();
    let singular = r.singular_values();
    let independent = singular.min() > RANK_TOLERANCE * singular.max();
    if !independent {
        return Err(Error::fit(
            "expected linearly independent regressors, got dependent columns (an input that repeats another, or too simple an excitation); lower na and nb, drop the copy, or excite with more frequencies",
        ));
    }
    let mut solution = r
        .solve_upper_triangular(&right.rows(0, columns).into_owned())
        .ok_or_else(|| {
            Error::fit("expected a regular triangular system, got a singular one; lower na and nb")
        })?;
    for (value, length) in solution.iter_mut().zip(&lengths) {
        *value /= length;
    }
    Ok(solution)
}

/// Scales a column to length 1 and returns its length; the square of the length may overflow.
fn normalise(mut column: DVectorViewMut<f64>) -> f64 {
    let largest = column.amax().max(f64::MIN_POSITIVE);
    column /= largest;
    let length = column.norm().max(f64::MIN_POSITIVE);
    column /= length;
    largest * length
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;
    use crate::lagged::Lagged;
    use crate::random::Random;

    fn noise(samples: usize, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        (0..samples).map(|_| random.normal()).collect()
    }

    fn worst(found: &[f64], true_values: &[f64]) -> f64 {
        found
            .iter()
            .zip(true_values)
            .map(|(f, t)| (f - t).abs())
            .fold(0.0, f64::max)
    }

    #[test]
    fn recovers_a_clean_system_from_several_experiments() {
        let truth =
            LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3, -0.2, 0.1], 2, 1, 0.4).unwrap();
        let (u1, u2) = (noise(400, 1), noise(600, 2));
        let y1 = truth.simulate(&u1, 2, &[0.0, 0.0]).unwrap();
        let y2 = truth.simulate(&u2, 2, &[5.0, 3.0]).unwrap();
        let records = [
            Record::new(&u1, 2, &y1).unwrap(),
            Record::new(&u2, 2, &y2).unwrap(),
        ];
        let model = fit(&records, 2, 2, 1, true).unwrap();
        assert!(worst(model.a(), truth.a()) < 1e-10 && worst(model.b(), truth.b()) < 1e-10);
        assert!((model.offset() - 0.4).abs() < 1e-10);
    }

    #[test]
    fn keeps_its_digits_on_nearly_dependent_columns() {
        let truth = LinearModel::new(vec![-1.87, 0.8705], vec![0.1228, 0.1224], 1, 1, 0.0).unwrap();
        let u: Vec<f64> = (0..4000)
            .map(|k| 1e3 + (k as f64 * k as f64 * 2e-6).sin())
            .collect();
        let y = truth.simulate(&u, 1, &[490e3, 490e3]).unwrap();
        let model = fit(&[Record::new(&u, 1, &y).unwrap()], 2, 2, 1, false).unwrap();
        assert!(worst(model.a(), truth.a()) < 1e-4, "{:?}", model.a());
    }

    #[test]
    fn leaves_out_rows_that_were_not_measured() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let u = noise(400, 1);
        let clean = truth.simulate(&u, 1, &[3.0, 1.0]).unwrap();
        let mut random = Random::new(7);
        let mut y = clean.clone();
        y.iter_mut()
            .filter(|_| random.between(0.0, 1.0) < 0.3)
            .for_each(|y| *y = f64::NAN);
        y[..30].fill(f64::NAN);
        let record = Record::with_gaps(&u, 1, &y).unwrap();
        let model = fit(&[record], 2, 2, 1, true).unwrap();
        assert!(worst(model.a(), truth.a()) < 1e-10 && worst(model.b(), truth.b()) < 1e-10);
        let every_other: Vec<f64> = clean
            .iter()
            .enumerate()
            .map(|(k, &y)| if k % 2 == 0 { y } else { f64::NAN })
            .collect();
        let record = Record::with_gaps(&u, 1, &every_other).unwrap();
        let message = fit(&[record], 2, 2, 1, true).unwrap_err().message;
        assert!(message.contains("output error"), "{message}");
    }

    #[test]
    fn counts_rows_by_their_weights() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let u = noise(400, 1);
        let clean = truth.simulate(&u, 1, &[3.0, 1.0]).unwrap();
        let mut y: Vec<f64> = clean
            .iter()
            .zip(noise(400, 5))
            .map(|(y, n)| y + 0.1 * n)
            .collect();
        let record = Record::new(&u, 1, &y).unwrap();
        let fitted = |weights: &[f64]| {
            let records = [record.with_weights(weights).unwrap(), record];
            fit(&records, 2, 2, 1, true).unwrap()
        };
        // a record twice is a record of weight 2; weight 0 counts nothing
        let once = fit(&[record; 2], 2, 2, 1, true).unwrap();
        let twice = fit(&[record; 3], 2, 2, 1, true).unwrap();
        assert_eq!(fitted(&[1.0; 400]).a(), once.a());
        assert!(worst(fitted(&[2.0; 400]).a(), twice.a()) < 1e-12);
        let half: Vec<f64> = (0..400).map(|k| if k < 200 { 0.0 } else { 1.0 }).collect();
        let later = Record::new(&u[198..], 1, &y[198..]).unwrap();
        let later = fit(&[later, record], 2, 2, 1, true).unwrap();
        assert!(worst(fitted(&half).a(), later.a()) < 1e-12);
        // the same with nearly dependent columns, which are solved by the triangle
        let rows = |weights: &[f64]| {
            let weighted = record.with_weights(weights).unwrap();
            let lags = check(&[weighted], 2, 2, 1).unwrap();
            by_qr(&[weighted], &lags, 5, usable(&[weighted], &lags)).unwrap()
        };
        let by_rows = fit(&[record.with_weights(&half).unwrap()], 2, 2, 1, true).unwrap();
        assert!((rows(&half)[0] + by_rows.a()[0]).abs() < 1e-12);
        y[..200].fill(1e6);
        let spoilt = Record::new(&u, 1, &y).unwrap();
        let small: Vec<f64> = (0..400).map(|k| if k < 202 { 0.0 } else { 1.0 }).collect();
        let found = fit(&[spoilt.with_weights(&small).unwrap()], 2, 2, 1, true).unwrap();
        assert!(worst(found.a(), truth.a()) < 0.1, "{:?}", found.a());
    }

    #[test]
    fn takes_samples_unseen_as_it_takes_checked_records() {
        let (u, y) = (noise(3000, 1), noise(3000, 2));
        let long = |u: &[f64], y: &[f64]| {
            let samples = [Samples::new(u, 1, y).unwrap()];
            fit_samples(&samples, 2, 2, 3, true)
        };
        let seen = fit(&[Record::new(&u, 1, &y).unwrap()], 2, 2, 3, true).unwrap();
        assert_eq!(long(&u, &y).unwrap().a(), seen.a());
        for at in [0, 1, 2, 1500, 2997, 2998, 2999] {
            for wrong in [f64::NAN, f64::INFINITY] {
                let mut bad = u.clone();
                bad[at] = wrong;
                let message = long(&bad, &y).unwrap_err().message;
                assert!(message.contains(&format!("sample {at};")), "{message}");
                let mut bad = y.clone();
                bad[at] = wrong;
                let found = long(&u, &bad);
                let expected =
                    Record::with_gaps(&u, 1, &bad).and_then(|record| fit(&[record], 2, 2, 3, true));
                match (found, expected) {
                    (Ok(found), Ok(expected)) => assert_eq!(found.b(), expected.b()),
                    (found, expected) => assert_eq!(found.err(), expected.err()),
                }
            }
        }
    }

    #[test]
    fn survives_values_whose_squares_are_no_numbers() {
        let truth = LinearModel::new(vec![-0.5], vec![1.0], 1, 1, 0.0).unwrap();
        for scale in [1e200, 1e-158, 1e-200] {
            let u: Vec<f64> = noise(500, 1).iter().map(|u| u * scale).collect();
            let y = truth.simulate(&u, 1, &[0.0]).unwrap();
            let samples = [Samples::new(&u, 1, &y).unwrap()];
            let model = fit_samples(&samples, 1, 1, 1, false).unwrap();
            assert!(
                worst(model.a(), truth.a()) < 1e-10,
                "{scale}: {:?}",
                model.a()
            );
        }
    }

    #[test]
    fn refuses_what_cannot_be_identified_and_says_why() {
        let (u, y) = (noise(100, 3), noise(100, 4));
        let constant = Record::new(&[1.0; 100], 1, &y).unwrap();
        assert_eq!(
            fit(&[constant], 2, 2, 1, true).unwrap_err().kind,
            ErrorKind::Data
        );
        let twice: Vec<f64> = u.iter().flat_map(|&v| [v, 2.0 * v]).collect();
        let copied = Record::new(&twice, 2, &y).unwrap();
        assert_eq!(
            fit(&[copied], 2, 2, 1, true).unwrap_err().kind,
            ErrorKind::Fit
        );
        let short = Record::new(&u[..5], 1, &y[..5]).unwrap();
        assert!(
            fit(&[short], 2, 2, 1, true)
                .unwrap_err()
                .message
                .contains("longer")
        );
        assert!(fit(&[], 2, 2, 1, true).is_err());
        assert!(fit(&[short], 0, 2, 1, true).is_err());
    }
}
