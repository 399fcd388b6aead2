//! Linear least squares on the triangle R of `X = QR`: a regression of one column on some of the others has on R the sums of squares that it
//! has on X, and R has only as many rows as columns. X'X is never formed, because its condition number is the square of X's.

use nalgebra::{DMatrix, DVector};

use crate::least_squares::triangle::Triangle;

/// Most iterations of the singular value decomposition.
const ITERATIONS: usize = 10_000;

/// R of rows of so many numbers, and how many rows there are.
pub(crate) fn triangle<R: IntoIterator<Item = f64>>(
    width: usize,
    rows: impl IntoIterator<Item = R>,
) -> (DMatrix<f64>, usize) {
    let (mut triangle, mut count) = (Triangle::new(width), 0);
    for row in rows {
        // its right-hand side is not needed: every column can be one
        triangle.push(|place| {
            place[width] = 0.0;
            place.iter_mut().zip(row).for_each(|(v, x)| *v = x);
        });
        count += 1;
    }
    triangle.fold();
    (
        DMatrix::from_fn(width, width, |i, j| triangle.at(i, j)),
        count,
    )
}

/// Parameters of a regression.
#[derive(Clone, Debug)]
pub(crate) struct Solution {
    pub theta: DVector<f64>,
    /// Number of parameters that the rows determine.
    pub rank: usize,
}

/// The `x` of the least norm among those with the least `|a x - y|`; singular values below `least` times the largest count as 0, and
/// so does everything if something is not finite.
pub(crate) fn solve(a: DMatrix<f64>, y: &DVector<f64>, least: f64) -> Solution {
    let columns = a.ncols();
    let none = || Solution {
        theta: DVector::zeros(columns),
        rank: 0,
    };
    if columns == 0 || !a.iter().chain(y).all(|v| v.is_finite()) {
        return none();
    }
    let (norm, factor) = (a.norm(), a.qr());
    let (mut right, r) = (y.clone(), factor.r());
    factor.q_tr_mul(&mut right);
    let right = right.rows(0, r.nrows()).into_owned();
    if r.is_square() && is_regular(&r, least * norm) {
        let theta = r.solve_upper_triangular(&right);
        return theta.map_or_else(none, |theta| Solution {
            theta,
            rank: columns,
        });
    }
    let Some(svd) = r.try_svd(true, true, 5.0 * f64::EPSILON, ITERATIONS) else {
        return none();
    };
    let least = least * svd.singular_values.max();
    Solution {
        rank: svd.rank(least),
        theta: svd
            .solve(&right, least)
            .unwrap_or_else(|_| DVector::zeros(columns)),
    }
}

/// Whether every singular value of a triangle is certainly above a bound: `|R^-1|` in the Frobenius norm is at least the inverse of the
/// smallest. Nearly all regressions are so, and an inverse is far quicker than a decomposition.
fn is_regular(r: &DMatrix<f64>, bound: f64) -> bool {
    let mut inverse = DMatrix::identity(r.nrows(), r.nrows());
    r.solve_upper_triangular_mut(&mut inverse) && 1.0 > bound * inverse.norm()
}

/// The same with every column scaled to length 1 before singular values are compared.
pub(crate) fn solve_scaled(mut a: DMatrix<f64>, y: &DVector<f64>, least: f64) -> Solution {
    let scale = unit_columns(&mut a);
    let mut found = solve(a, y, least);
    found.theta.component_mul_assign(&scale);
    found
}

/// Scales every column to length 1, unless it is 0; returns the factors.
pub(crate) fn unit_columns(a: &mut DMatrix<f64>) -> DVector<f64> {
    let scale = |mut column: nalgebra::DVectorViewMut<f64>| {
        let length = column.norm();
        let scale = if length > 0.0 { 1.0 / length } else { 1.0 };
        column *= scale;
        scale
    };
    DVector::from_iterator(
        a.ncols(),
        a.column_iter_mut().map(scale).collect::<Vec<_>>(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    fn drawn(rows: usize, columns: usize, seed: u64) -> DMatrix<f64> {
        let mut random = Random::new(seed);
        DMatrix::from_fn(rows, columns, |_, _| random.normal())
    }

    #[test]
    fn the_triangle_has_the_regressions_of_all_rows() {
        for n in [3, 100, 1500] {
            let x = drawn(n, 6, 1);
            let (r, count) = triangle(
                6,
                x.row_iter().map(|r| r.iter().copied().collect::<Vec<_>>()),
            );
            assert_eq!(count, n);
            assert!((r.tr_mul(&r) - x.tr_mul(&x)).amax() < 1e-11 * n as f64);
            if n > 6 {
                let of = |m: &DMatrix<f64>| {
                    let y = m.column(0).into_owned();
                    solve(m.columns(1, 5).into_owned(), &y, 1e-10).theta
                };
                assert!((of(&r) - of(&x)).amax() < 1e-12);
            }
        }
    }

    /// A column that repeats ten others in the first blocks leaves nothing but rounding of rounding.
    #[test]
    fn columns_that_begin_alike_are_told_later() {
        let x = drawn(900, 11, 5);
        let x = DMatrix::from_fn(900, 12, |i, j| match j {
            11 => 1.0,
            _ if i < 300 => 0.7,
            _ => x[(i, j)],
        });
        let y = x.columns(0, 11).column_sum();
        let rows = (0..900).map(|i| x.row(i).iter().copied().chain([y[i]]).collect::<Vec<_>>());
        let (r, _) = triangle(13, rows);
        let goal = r.column(12).into_owned();
        let found = solve(r.columns(0, 12).into_owned(), &goal, 1e-10);
        assert_eq!(found.rank, 12);
        assert!((found.theta.rows(0, 11).add_scalar(-1.0)).amax() < 1e-12);
    }

    /// Of dependent columns each takes its part, as in the pseudo-inverse.
    #[test]
    fn dependent_columns_share() {
        let x = drawn(50, 3, 2);
        let twice = DMatrix::from_fn(50, 4, |i, j| x[(i, j.min(2))]);
        let y = x.column(0) * 2.0 + x.column(2) * 3.0;
        let found = solve(twice.clone(), &y, 1e-10);
        assert_eq!(found.rank, 3);
        let expected = DVector::from_vec(vec![2.0, 0.0, 1.5, 1.5]);
        assert!((&found.theta - expected).amax() < 1e-12);
        // scaled, a long column takes more
        let mut longer = twice;
        longer.column_mut(3).scale_mut(1e8);
        let found = solve_scaled(longer, &y, 1e-10);
        assert_eq!(found.rank, 3);
        assert!((found.theta[3] * 1e8 - 1.5).abs() < 1e-7);
    }

    #[test]
    fn few_rows_and_columns_of_zeros_and_numbers_that_are_none() {
        let found = solve(drawn(2, 4, 3), &DVector::from_vec(vec![1.0, 2.0]), 1e-10);
        assert_eq!(found.rank, 2);
        let found = solve_scaled(DMatrix::zeros(5, 2), &DVector::from_element(5, 1.0), 1e-10);
        assert_eq!((found.rank, found.theta.amax()), (0, 0.0));
        let mut wrong = drawn(5, 2, 4);
        wrong[(3, 1)] = f64::NAN;
        assert_eq!(solve(wrong, &DVector::zeros(5), 1e-10).rank, 0);
        assert_eq!(
            solve(DMatrix::zeros(5, 0), &DVector::zeros(5), 1e-10).rank,
            0
        );
    }
}
