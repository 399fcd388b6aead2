//! Where the iteration stands: residuals, Jacobian and what follows from them.

use super::Settings;
use super::spread::{Spread, nonzero};
use super::triangle::Triangle;

/// Share of the other parameters' part in the residuals below which a parameter is zero.
const NOTHING: f64 = 1.5e-8;

/// Linearisation at one point; the triangle holds the columns of the free parameters.
pub(super) struct Point {
    pub residual: Vec<f64>,
    pub jacobian: Vec<f64>,
    pub is_linearised: bool,
    pub gradient: Vec<f64>,
    /// Norms of the Jacobian's columns.
    pub columns: Vec<f64>,
    /// -1 and 1 where a bound holds a parameter.
    pub active: Vec<i8>,
    /// Indices of the others.
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

    /// Gradient, norms, active bounds and triangle from the Jacobian; false where it is not finite.
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

    /// A parameter on a bound is held there while the cost falls towards the outside (the Kuhn-Tucker conditions).
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

    /// `s^2`, or none where there are not more residuals than parameters.
    pub fn variance(&self) -> Option<f64> {
        let spare = self.residual.len().checked_sub(self.free.len())?;
        (spare > 0).then(|| self.norm().powi(2) / spare as f64)
    }

    /// What a change of each free parameter is measured against: its value, its standard error (digits beyond it mean
    /// nothing), and the change that the residuals would not show beside what all parameters do to them.
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

    /// `s^2 (J'J)^-1` over all parameters: zero for those on a bound, NaN where `s` or the Jacobian is not known.
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
