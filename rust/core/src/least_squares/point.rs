//! The present point: residuals, Jacobian and what follows from them, including rank, condition and covariance of the parameters.
//! condition, covariance.

use nalgebra::DMatrix;

use super::Settings;
use super::triangle::Triangle;

/// A parameter whose part in the residuals is below this share of all parameters' part counts as zero.
const NOTHING: f64 = 1.5e-8;

/// Linearisation at one point; the triangle holds the columns of the free parameters.
pub(super) struct Point {
    pub residual: Vec<f64>,
    pub jacobian: Vec<f64>,
    pub is_linearised: bool,
    pub gradient: Vec<f64>,
    /// Norms of the Jacobian's columns.
    pub columns: Vec<f64>,
    /// -1 and 1 if a bound holds a parameter, else 0.
    pub active: Vec<i8>,
    /// Indices of the free parameters.
    pub free: Vec<usize>,
    pub triangle: Triangle,
}

impl Point {
    pub fn new(m: usize, n: usize) -> Self {
        Self {
            residual: vec![f64::NAN; m],
            jacobian: vec![0.0; m * n],
            is_linearised: false,
            gradient: vec![0.0; n],
            columns: vec![0.0; n],
            active: vec![0; n],
            free: Vec::with_capacity(n),
            triangle: Triangle::new(n),
        }
    }

    /// `|r|`.
    pub fn norm(&self) -> f64 {
        self.residual.iter().map(|r| r * r).sum::<f64>().sqrt()
    }

    /// Gradient, norms, active bounds and triangle from the Jacobian; false if it is not finite.
    pub fn digest(&mut self, theta: &[f64], settings: &Settings) -> bool {
        let n = theta.len();
        self.gradient.fill(0.0);
        self.columns.fill(0.0);
        for (row, r) in self.jacobian.chunks_exact(n).zip(&self.residual) {
            for ((g, c), v) in self.gradient.iter_mut().zip(&mut self.columns).zip(row) {
                *g += v * r;
                *c += v * v;
            }
        }
        self.columns.iter_mut().for_each(|c| *c = c.sqrt());
        self.is_linearised = self
            .columns
            .iter()
            .chain(&self.gradient)
            .all(|v| v.is_finite());
        if self.is_linearised {
            self.choose_free(theta, settings);
            self.factor(n);
        }
        self.is_linearised
    }

    /// A parameter on a bound is held there if the cost falls towards the outside (Karush-Kuhn-Tucker conditions).
    fn choose_free(&mut self, theta: &[f64], settings: &Settings) {
        self.free.clear();
        for (j, (&x, &g)) in theta.iter().zip(&self.gradient).enumerate() {
            let (low, high) = settings.bounds(j);
            self.active[j] = match (x <= low && g >= 0.0, x >= high && g <= 0.0) {
                (true, _) => -1,
                (_, true) => 1,
                _ => 0,
            };
            if self.active[j] == 0 {
                self.free.push(j);
            }
        }
    }

    fn factor(&mut self, n: usize) {
        let (free, triangle) = (&self.free, &mut self.triangle);
        triangle.clear(free.len());
        for (row, r) in self.jacobian.chunks_exact(n).zip(&self.residual) {
            triangle.push(|out| {
                for (out, &j) in out.iter_mut().zip(free) {
                    *out = row[j];
                }
                out[free.len()] = *r;
            });
        }
        triangle.fold();
    }

    /// `|Q'r| / |r|`.
    pub fn cosine(&self) -> f64 {
        if !self.is_linearised {
            return f64::NAN;
        }
        let along = self.triangle.rhs().map(|b| b * b).sum::<f64>().sqrt();
        if along > 0.0 {
            along / self.norm()
        } else {
            0.0
        }
    }

    /// Largest cosine between the residual and a column.
    pub fn largest_cosine(&self) -> f64 {
        let norm = nonzero(self.norm());
        let cosine = |&j: &usize| self.gradient[j].abs() / (nonzero(self.columns[j]) * norm);
        self.free.iter().map(cosine).fold(0.0, f64::max)
    }

    /// Largest free component of the gradient.
    pub fn optimality(&self) -> f64 {
        if !self.is_linearised {
            return f64::NAN;
        }
        self.free
            .iter()
            .map(|&j| self.gradient[j].abs())
            .fold(0.0, f64::max)
    }

    /// `s^2`; `None` unless there are more residuals than parameters.
    pub fn variance(&self) -> Option<f64> {
        let spare = self.residual.len().checked_sub(self.free.len())?;
        (spare > 0).then(|| self.norm().powi(2) / spare as f64)
    }

    /// The measure for changes of each free parameter: its value, its standard error (digits beyond it mean nothing),
    /// and the change that is invisible in the residuals beside what all parameters contribute to them.
    pub fn measures(&self, theta: &[f64], inverse: &[f64]) -> Vec<f64> {
        let n = self.free.len();
        let parts = self
            .free
            .iter()
            .map(|&j| (self.columns[j] * theta[j]).powi(2));
        let whole = parts.sum::<f64>().sqrt();
        let s = self.variance().unwrap_or(0.0).sqrt();
        let measure = |(i, &j): (usize, &usize)| {
            theta[j].abs()
                + s * inverse[i * n + i].sqrt()
                + NOTHING * whole / nonzero(self.columns[j])
        };
        self.free.iter().enumerate().map(measure).collect()
    }

    pub fn jacobian_or_nan(&self) -> Vec<f64> {
        if self.is_linearised {
            self.jacobian.clone()
        } else {
            vec![f64::NAN; self.jacobian.len()]
        }
    }

    /// `s^2 (J'J)^-1` over all parameters: zero for those on a bound, NaN if `s` or the Jacobian is not known.
    pub fn covariance(&self, spread: Option<&Spread>, n: usize) -> Vec<f64> {
        let (Some(spread), Some(variance)) = (spread, self.variance()) else {
            return vec![f64::NAN; n * n];
        };
        let (mut all, free) = (vec![0.0; n * n], self.free.len());
        for (a, &i) in self.free.iter().enumerate() {
            for (b, &j) in self.free.iter().enumerate() {
                let value = spread.inverse[a * free + b];
                all[i * n + j] = if value.is_finite() {
                    variance * value
                } else {
                    value
                };
            }
        }
        all
    }
}

/// Rank, condition and `(J'J)^-1` of the free parameters.
#[derive(Clone, Debug)]
pub(super) struct Spread {
    /// Number of singular values of `J`, with columns of unit length, above rounding.
    pub rank: usize,
    /// Ratio of the largest to the smallest of these singular values; infinite if the rank is not full.
    pub condition: f64,
    /// `(J'J)^-1` row by row; rows and columns of parameters that the data do not determine are NaN, infinite on the diagonal.
    pub inverse: Vec<f64>,
}

/// Share of a parameter in the null space above which the data do not determine it.
const SHARE: f64 = 1e-6;

impl Spread {
    /// From the singular values of the triangle with its columns scaled to unit length, so that units do not matter. `rows` is the number
    /// of residuals, `precision` the relative error of the Jacobian. `None` if the triangle is not finite.
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
