//! ARX by least squares: one-step errors, normal equations with scaled columns, QR where they are near singular.

use nalgebra::{DMatrix, DVector};

use crate::lagged::Lags;
use crate::linear::LinearModel;
use crate::{Error, Record, Result};

/// A pivot of the scaled Gram matrix below this leaves fewer than five digits: QR then keeps them.
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
    let (a, rest) = solution.as_slice().split_at(na);
    let (b, offset) = rest.split_at(nb * lags.channels);
    let a = a.iter().map(|a| -a).collect();
    LinearModel::new(
        a,
        b.to_vec(),
        lags.channels,
        nk,
        offset.first().copied().unwrap_or(0.0),
    )
}

/// The orders, once the records have been found fit for identification.
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
    let whole = |r: &Record| whole_rows(r, lags).count();
    records.iter().map(whole).sum()
}

/// Samples whose regressor lies inside the record and which, like the outputs in it, were measured.
fn whole_rows<'r>(record: &'r Record<'r>, lags: &Lags) -> impl Iterator<Item = usize> + 'r {
    let (na, complete) = (lags.na, record.unmeasured == 0);
    (lags.first_whole()..record.len())
        .filter(move |&k| complete || record.y[k - na..=k].iter().all(|y| !y.is_nan()))
}

/// Calls `each(row, y)` for every sample with a whole regressor; a last column is 1.
fn each_row(records: &[Record], lags: &Lags, columns: usize, mut each: impl FnMut(&[f64], f64)) {
    let mut row = vec![1.0; columns];
    for record in records {
        for k in whole_rows(record, lags) {
            for (i, past) in row[..lags.na].iter_mut().enumerate() {
                *past = record.y[k - 1 - i];
            }
            lags.write_inputs(record.u, k, &mut row[lags.na..lags.regressors()]);
            each(&row, record.y[k]);
        }
    }
}

fn normal_equations(
    records: &[Record],
    lags: &Lags,
    columns: usize,
) -> (DMatrix<f64>, DVector<f64>) {
    let mut gram = DMatrix::zeros(columns, columns);
    let mut moment = DVector::zeros(columns);
    each_row(records, lags, columns, |row, y| {
        for j in 0..columns {
            moment[j] += row[j] * y;
            for i in j..columns {
                gram[(i, j)] += row[i] * row[j];
            }
        }
    });
    gram.fill_upper_triangle_with_lower_triangle();
    (gram, moment)
}

/// Solution of the normal equations with columns scaled to length 1; none where a pivot is small.
fn by_cholesky(gram: &DMatrix<f64>, moment: &DVector<f64>) -> Option<DVector<f64>> {
    let scale = gram
        .diagonal()
        .map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 0.0 });
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
    each_row(records, lags, columns, |row, y| {
        values.extend_from_slice(row);
        outputs.push(y);
    });
    let mut matrix = DMatrix::from_row_slice(rows, columns, &values);
    let lengths: Vec<f64> = matrix.column_iter().map(|c| c.norm()).collect();
    for (mut column, length) in matrix.column_iter_mut().zip(&lengths) {
        column /= length.max(f64::MIN_POSITIVE);
    }
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
