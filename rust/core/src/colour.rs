//! The colour of residuals: how far one sample is told by those before it.

use nalgebra::DMatrix;

/// The most terms of the residuals' autoregression, and the fewest samples per term.
const TERMS: usize = 30;
const SAMPLES_PER_TERM: usize = 10;

/// The autoregression of residuals, of as many terms as Akaike's criterion asks for.
pub(crate) struct Colour {
    a: Vec<f64>,
    /// Power of the whitened residuals, as a share of their own.
    white: f64,
}

impl Colour {
    /// By Levinson's recursion on the sample autocovariance, which always gives a stable autoregression.
    pub fn of(e: &[f64]) -> Self {
        let n = e.len();
        let most = TERMS.min(n / SAMPLES_PER_TERM);
        let covariance: Vec<f64> = (0..=most)
            .map(|lag| e[lag..].iter().zip(e).map(|(x, y)| x * y).sum::<f64>())
            .collect();
        let none = Self {
            a: Vec::new(),
            white: 1.0,
        };
        if !(covariance[0] > 0.0 && covariance[0].is_finite()) {
            return none;
        }
        let (mut a, mut power, mut best, mut least) = (Vec::<f64>::new(), covariance[0], none, 0.0);
        for m in 1..=most {
            let known: f64 = (1..m).map(|i| a[i - 1] * covariance[m - i]).sum();
            let reflection = (covariance[m] - known) / power;
            let turned: Vec<f64> = a.iter().rev().map(|x| reflection * x).collect();
            a.iter_mut().zip(turned).for_each(|(x, y)| *x -= y);
            a.push(reflection);
            power *= 1.0 - reflection * reflection;
            let white = power / covariance[0];
            let criterion = n as f64 * white.ln() + 2.0 * m as f64;
            if !criterion.is_finite() {
                break;
            }
            if criterion < least {
                least = criterion;
                best = Self {
                    a: a.clone(),
                    white,
                };
            }
        }
        best
    }

    /// `z(k) w(k)`, one row a sample.
    pub fn scores(&self, rows: &DMatrix<f64>, e: &[f64]) -> DMatrix<f64> {
        let mut z = rows.clone();
        let n = e.len();
        for k in (0..n).rev() {
            for (m, a) in self.a.iter().enumerate().take(n - 1 - k) {
                for i in 0..z.ncols() {
                    z[(k, i)] += a * z[(k + m + 1, i)];
                }
            }
        }
        for (k, mut row) in z.row_iter_mut().enumerate() {
            let past = self.a.iter().zip(e[..k].iter().rev());
            row *= e[k] - past.map(|(a, e)| a * e).sum::<f64>();
        }
        z
    }

    /// How many independent samples have as sure a mean as `n` of these.
    pub fn independent(&self, n: usize) -> f64 {
        let slow = (1.0 - self.a.iter().sum::<f64>()).powi(2) / self.white;
        n as f64 * slow.min(1.0)
    }
}
