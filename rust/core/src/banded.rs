//! Symmetric positive definite band matrices: products and Cholesky factors, which keep the band.

use crate::column::dot;
use crate::{Error, Result};

/// The lower triangle of a symmetric matrix within `band` places of its diagonal.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Banded {
    size: usize,
    band: usize,
    /// Row by row; entry `(i, j)` lies `band - (i - j)` places into row `i`.
    values: Vec<f64>,
}

impl Banded {
    /// All zero.
    pub fn zeros(size: usize, band: usize) -> Self {
        let band = band.min(size.saturating_sub(1));
        Self {
            size,
            band,
            values: vec![0.0; size * (band + 1)],
        }
    }

    /// The identity plus `weight` times the squared second differences: the inverse is a low-pass without phase.
    pub fn low_pass(size: usize, weight: f64) -> Self {
        let mut made = Self::zeros(size, 2);
        (0..size).for_each(|i| *made.at(i, i) += 1.0);
        let second = [1.0, -2.0, 1.0];
        for k in 0..size.saturating_sub(2) {
            for (i, left) in second.iter().enumerate() {
                for (j, right) in second[..=i].iter().enumerate() {
                    *made.at(k + i, k + j) += weight * left * right;
                }
            }
        }
        made
    }

    /// Places beside the diagonal.
    pub fn band(&self) -> usize {
        self.band
    }

    /// Entry `(i, j)` with `i - band <= j <= i`.
    pub fn at(&mut self, i: usize, j: usize) -> &mut f64 {
        &mut self.values[i * (self.band + 1) + self.band + j - i]
    }

    /// Sum of the diagonal.
    pub fn trace(&self) -> f64 {
        self.values
            .iter()
            .skip(self.band)
            .step_by(self.band + 1)
            .sum()
    }

    /// Adds a multiple of a matrix of the same shape.
    pub fn add(&mut self, share: f64, other: &Self) {
        for (to, from) in self.values.iter_mut().zip(&other.values) {
            *to += share * from;
        }
    }

    /// Adds to the diagonal.
    pub fn ridge(&mut self, value: f64) {
        (0..self.size).for_each(|i| *self.at(i, i) += value);
    }

    /// The product with a vector.
    pub fn times(&self, x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; self.size];
        for i in 0..self.size {
            let first = i.saturating_sub(self.band);
            let row = &self.row(i)[self.band + first - i..];
            let (before, own) = y.split_at_mut(i);
            own[0] = dot(row, &x[first..=i]);
            for (y, a) in before[first..].iter_mut().zip(row) {
                *y += a * x[i];
            }
        }
        y
    }

    fn row(&self, i: usize) -> &[f64] {
        &self.values[i * (self.band + 1)..(i + 1) * (self.band + 1)]
    }

    /// The Cholesky factor.
    ///
    /// # Errors
    /// `ErrorKind::Fit` for a matrix that is not positive definite.
    pub fn factor(mut self) -> Result<Factor> {
        let (band, width) = (self.band, self.band + 1);
        for i in 0..self.size {
            let first = i.saturating_sub(band);
            for j in first..=i {
                // columns first..j of row i and of row j
                let from = first.max(j.saturating_sub(band));
                let (rows, row) = self.values.split_at(i * width);
                let own = &row[band + from - i..band + j - i];
                let sum = match j == i {
                    true => dot(own, own),
                    false => dot(own, &rows[j * width + band + from - j..][..j - from]),
                };
                let left = row[band + j - i] - sum;
                let value = if j < i {
                    left / rows[j * width + band]
                } else if left > 0.0 && left.is_finite() {
                    left.sqrt()
                } else {
                    return Err(Error::fit(
                        "expected equations with one solution, got some without; check that the loop answers its reference",
                    ));
                };
                *self.at(i, j) = value;
            }
        }
        Ok(Factor(self))
    }
}

/// A lower triangular band matrix whose product with its transpose is the matrix.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Factor(Banded);

impl Factor {
    /// Solves in place.
    pub fn solve(&self, x: &mut [f64]) {
        let Banded { size, band, .. } = self.0;
        for i in 0..size {
            let first = i.saturating_sub(band);
            let row = &self.0.row(i)[band + first - i..];
            let sum = dot(&row[..i - first], &x[first..i]);
            x[i] = (x[i] - sum) / row[i - first];
        }
        for i in (0..size).rev() {
            let first = i.saturating_sub(band);
            let row = &self.0.row(i)[band + first - i..];
            x[i] /= row[i - first];
            let (before, at) = x.split_at_mut(i);
            for (x, l) in before[first..].iter_mut().zip(row) {
                *x -= l * at[0];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_factor_solves_as_a_dense_one_does(
            size in 1usize..24, band in 0usize..9, seed in prop::collection::vec(-1.0f64..1.0, 24 * 24),
        ) {
            // R'R + I with R of the band is positive definite and of the band
            let r = DMatrix::from_fn(size, size, |i, j| {
                if j >= i && j - i <= band { seed[i * 24 + j] } else { 0.0 }
            });
            let dense = r.transpose() * &r + DMatrix::identity(size, size);
            let mut banded = Banded::zeros(size, band);
            for i in 0..size {
                for j in i.saturating_sub(banded.band())..=i {
                    *banded.at(i, j) = dense[(i, j)];
                }
            }
            prop_assert!((banded.trace() - dense.trace()).abs() < 1e-9);
            let times = banded.times(&seed[..size]);
            let expected = &dense * DVector::from_fn(size, |i, _| seed[i]);
            prop_assert!(times.iter().zip(expected.iter()).all(|(a, b)| (a - b).abs() < 1e-9));
            let right = DVector::from_fn(size, |i, _| seed[i]);
            let expected = dense.cholesky().unwrap().solve(&right);
            let mut x = right.as_slice().to_vec();
            banded.factor().unwrap().solve(&mut x);
            for (x, expected) in x.iter().zip(expected.iter()) {
                prop_assert!((x - expected).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_low_pass_keeps_lines_and_takes_the_fastest_swing_away() {
        let filter = Banded::low_pass(50, 100.0).factor().unwrap();
        let line: Vec<f64> = (0..50).map(|k| 3.0 - 0.5 * f64::from(k)).collect();
        let mut x = line.clone();
        filter.solve(&mut x);
        assert!(x.iter().zip(&line).all(|(x, y)| (x - y).abs() < 1e-8));
        let mut x: Vec<f64> = (0..50).map(|k| f64::from(1 - 2 * (k % 2))).collect();
        filter.solve(&mut x);
        assert!(x[20..30].iter().all(|x| x.abs() < 1e-2), "{x:?}");
    }

    #[test]
    fn a_matrix_without_a_factor_is_refused() {
        assert!(Banded::zeros(3, 1).factor().is_err());
        let mut one = Banded::zeros(2, 1);
        one.ridge(1.0);
        *one.at(1, 0) = 2.0;
        assert!(one.factor().is_err());
    }
}
