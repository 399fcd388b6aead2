//! What the Jacobian says of the parameters: rank, condition, covariance.

use nalgebra::DMatrix;

use super::triangle::Triangle;

/// Rank, condition and `(J'J)^-1` of the free parameters.
#[derive(Clone, Debug)]
pub(super) struct Spread {
    /// Singular values of `J` with columns of unit length that are above rounding.
    pub rank: usize,
    /// Largest by smallest of these singular values; infinite where the rank is not full.
    pub condition: f64,
    /// `(J'J)^-1` row by row; NaN in rows and columns of parameters that the data do not fix, infinite on their diagonal.
    pub inverse: Vec<f64>,
}

/// Share of a parameter in the null space above which it counts as not fixed.
const SHARE: f64 = 1e-6;

impl Spread {
    /// By singular values of the triangle with its columns scaled to unit length, so that units play no part; `rows` is
    /// the number of residuals, `precision` the relative error of the Jacobian. None where it is not finite.
    pub fn new(triangle: &Triangle, rows: usize, precision: f64) -> Option<Self> {
        let n = triangle.columns();
        if n == 0 {
            return Some(Self {
                rank: 0,
                condition: 1.0,
                inverse: Vec::new(),
            });
        }
        let lengths: Vec<f64> = (0..n).map(|j| column_length(triangle, j)).collect();
        let scaled = DMatrix::from_fn(n, n, |i, j| triangle.at(i, j) / nonzero(lengths[j]));
        if !scaled.iter().all(|v| v.is_finite()) {
            return None;
        }
        let svd = scaled.try_svd(false, true, f64::EPSILON, 0)?;
        let (values, v_t) = (svd.singular_values, svd.v_t?);
        let (most, least) = (values.max(), values.min());
        let tolerance = precision.max(f64::EPSILON * rows.max(n) as f64) * most;
        let kept: Vec<usize> = (0..n).filter(|&k| values[k] > tolerance).collect();
        let mut inverse = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..n {
                let sum: f64 = kept
                    .iter()
                    .map(|&k| v_t[(k, i)] * v_t[(k, j)] / values[k].powi(2))
                    .sum();
                inverse[i * n + j] = sum / (nonzero(lengths[i]) * nonzero(lengths[j]));
            }
        }
        let fixed = |j: usize| kept.iter().map(|&k| v_t[(k, j)].powi(2)).sum::<f64>() > 1.0 - SHARE;
        for j in (0..n).filter(|&j| !fixed(j)) {
            for i in 0..n {
                (inverse[i * n + j], inverse[j * n + i]) = (f64::NAN, f64::NAN);
            }
            inverse[j * n + j] = f64::INFINITY;
        }
        let full = kept.len() == n;
        Some(Self {
            rank: kept.len(),
            condition: if full {
                most.max(f64::MIN_POSITIVE) / least
            } else {
                f64::INFINITY
            },
            inverse,
        })
    }

    pub fn is_full(&self) -> bool {
        self.condition.is_finite()
    }
}

fn column_length(triangle: &Triangle, j: usize) -> f64 {
    (0..=j)
        .map(|i| triangle.at(i, j).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// 1 instead of 0, as a divisor.
pub(super) fn nonzero(value: f64) -> f64 {
    if value > 0.0 { value } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(rows: &[[f64; 3]]) -> Spread {
        let mut triangle = Triangle::new(2);
        for row in rows {
            triangle.push(|out| out.copy_from_slice(row));
        }
        triangle.fold();
        Spread::new(&triangle, rows.len(), 0.0).unwrap()
    }

    #[test]
    fn inverts_the_gram_matrix_whatever_the_units() {
        let spread = of(&[[1.0, 0.0, 0.0], [1.0, 1e-9, 0.0], [1.0, 2e-9, 0.0]]);
        assert_eq!(spread.rank, 2);
        assert!(spread.condition < 10.0);
        // J'J = [3, 3e-9; 3e-9, 5e-18], its determinant 6e-18
        for (ours, exact) in spread
            .inverse
            .iter()
            .zip([5.0 / 6.0, -0.5e9, -0.5e9, 0.5e18])
        {
            assert!((ours / exact - 1.0).abs() < 1e-12, "{:?}", spread.inverse);
        }
    }

    #[test]
    fn says_which_parameter_is_not_fixed() {
        let spread = of(&[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        assert_eq!((spread.rank, spread.condition), (1, f64::INFINITY));
        assert!((spread.inverse[0] - 0.2).abs() < 1e-15);
        assert!(spread.inverse[1].is_nan() && spread.inverse[3].is_infinite());
        let together = of(&[[1.0, 2.0, 0.0], [2.0, 4.0, 0.0]]);
        assert!(together.inverse[0].is_infinite() && together.inverse[3].is_infinite());
    }
}
