//! How much of a signal some columns explain beyond others, on parts that the regression has not seen (cross-validation: Stone 1974,
//! *Journal of the Royal Statistical Society B* 36).

use nalgebra::{DMatrix, DVector};

use crate::regression::{solve_scaled, triangle};
use crate::{Error, Result};

/// Singular values below this, relative to the largest, count as 0: columns may repeat each other.
const LEAST: f64 = 1e-10;

/// For each of some contiguous parts, the share of the squares that all columns explain of those that the first `own` columns leave;
/// each regression is fitted to the other parts. Below 0 if the further columns make it worse. Rows of `x` have `width` numbers.
///
/// # Errors
/// Data errors for columns of other lengths, for numbers that are not finite, and for fewer rows in a part than columns.
pub fn explained(x: &[f64], width: usize, y: &[f64], own: usize, parts: usize) -> Result<Vec<f64>> {
    if x.len() != width * y.len() || own > width || x.iter().chain(y).any(|v| !v.is_finite()) {
        return Err(Error::data(format!(
            "expected {width} finite numbers for each of {} samples, the first {own} of them given, got others; leave gaps out",
            y.len()
        )));
    }
    if parts < 2 || y.len() / parts <= width {
        return Err(Error::data(format!(
            "expected at least 2 parts of more than {width} samples, got {parts} of {}; record more",
            y.len() / parts.max(1)
        )));
    }
    let edge = |part: usize| part * y.len() / parts;
    let triangles: Vec<DMatrix<f64>> = (0..parts)
        .map(|part| {
            let rows = edge(part)..edge(part + 1);
            let row = |k: usize| x[k * width..(k + 1) * width].iter().copied().chain([y[k]]);
            triangle(width + 1, rows.map(row)).0
        })
        .collect();
    let shares = (0..parts).map(|part| {
        let others = (0..parts).filter(|&other| other != part);
        let rows = others.flat_map(|other| triangles[other].row_iter());
        let (r, _) = triangle(
            width + 1,
            rows.map(|row| row.iter().copied().collect::<Vec<_>>()),
        );
        let left = |columns: usize| left(&triangles[part], &r, columns);
        let first = left(own);
        if first > 0.0 {
            1.0 - left(width) / first
        } else {
            0.0
        }
    });
    Ok(shares.collect())
}

/// Squares that a regression on the first columns of `other` leaves of the last column of `own`.
fn left(own: &DMatrix<f64>, other: &DMatrix<f64>, columns: usize) -> f64 {
    let last = own.ncols() - 1;
    let goal: DVector<f64> = other.column(last).into_owned();
    let theta = solve_scaled(other.columns(0, columns).into_owned(), &goal, LEAST).theta;
    (own.column(last) - own.columns(0, columns) * theta).norm_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Rows of 1, a slow wave and a fast one.
    fn rows(n: usize) -> Vec<f64> {
        (0..n)
            .flat_map(|k| [1.0, (0.1 * k as f64).sin(), (1.7 * k as f64).cos()])
            .collect()
    }

    proptest! {
        #![proptest_config(crate::laws::cases(50))]
        #[test]
        fn what_belongs_to_the_further_columns_is_their_share(gain in 0.1..5.0_f64, offset in -3.0..3.0_f64, parts in 2_usize..6) {
            let x = rows(400);
            let y: Vec<f64> = x.chunks(3).map(|r| offset + 2.0 * r[1] + gain * r[2]).collect();
            for share in explained(&x, 3, &y, 2, parts).unwrap() {
                prop_assert!((share - 1.0).abs() < 1e-9, "{share}");
            }
            let without: Vec<f64> = x.chunks(3).map(|r| offset + r[1] + 0.3 * r[0]).collect();
            let noisy: Vec<f64> = without.iter().enumerate().map(|(k, v)| v + ((k * k) as f64 * 0.7).sin()).collect();
            for share in explained(&x, 3, &noisy, 2, parts).unwrap() {
                prop_assert!(share < 0.1, "{share}");
            }
        }
    }

    #[test]
    fn short_and_broken_records_are_refused() {
        assert!(explained(&rows(7), 3, &[0.0; 7], 1, 2).is_err());
        assert!(explained(&rows(40), 3, &[f64::NAN; 40], 1, 2).is_err());
        assert!(explained(&rows(40), 3, &[0.0; 39], 1, 2).is_err());
    }
}
