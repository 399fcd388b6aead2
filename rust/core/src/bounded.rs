//! Levenberg-Marquardt on normal equations within bounds, with a statistical end.
//!
//! Dry friction makes the cost of a motor's free run piecewise smooth, with kinks: tests of the last digits of cost or step do not hold
//! at its minimum, and a solver that waits for one goes in circles. The end here is statistical. With errors of variance 1,
//! `g' inv(H) g` is the squared distance to the minimum in standard errors (the relative offset of Bates and Watts 1981,
//! Technometrics 23); a fraction of one standard error is irrelevant.

use nalgebra::{DMatrix, DVector};

const DAMPING: f64 = 1e-3;
/// Factor by which a rejected trial raises the damping, and divisor of an accepted one.
const RAISE: f64 = 6.0;
const LOWER: f64 = 8.0;
/// Ratio of predicted gains above which another damping would repeat a rejected trial.
const SAME: f64 = 0.8;
const MOST_DAMPING: f64 = 1e7;
const LEAST_DAMPING: f64 = 1e-9;
/// Least eigenvalue of a direction to step in, relative to the largest of the scaled matrix.
const FLAT: f64 = 1e-12;

/// Cost `e'e`, gradient `J'e` and `J'J`.
#[derive(Clone, Debug)]
pub struct Normal {
    /// `e'e`.
    pub cost: f64,
    /// `J'e`, (n).
    pub gradient: DVector<f64>,
    /// `J'J`, (n, n).
    pub matrix: DMatrix<f64>,
}

/// The problem to minimise. An error ends the descent where it is.
pub trait Squares {
    /// What can end the descent early.
    type Stop;

    /// The normal equations; only asked where the cost is finite.
    ///
    /// # Errors
    /// What ends the descent.
    fn normal(&mut self, x: &[f64]) -> Result<Normal, Self::Stop>;

    /// The cost; infinite to reject a trial.
    ///
    /// # Errors
    /// What ends the descent.
    fn cost(&mut self, x: &[f64]) -> Result<f64, Self::Stop>;
}

/// Bounds, and when a descent ends.
#[derive(Clone, Copy, Debug)]
pub struct Ends<'a> {
    /// Lower bounds, (n).
    pub low: &'a [f64],
    /// Upper bounds, (n).
    pub high: &'a [f64],
    /// Number of residuals; their mean square is the variance for the standard errors.
    pub count: f64,
    /// Squared distance to the minimum in standard errors that is close enough.
    pub enough: f64,
    /// Most Jacobians.
    pub iterations: usize,
}

/// Where a descent ended.
#[derive(Clone, Debug)]
pub struct Minimum<E> {
    /// Parameters, (n).
    pub x: Vec<f64>,
    /// Their cost.
    pub cost: f64,
    /// Squared distance to the minimum in standard errors.
    pub left: f64,
    /// What ended it early.
    pub stopped: Option<E>,
}

/// Minimises the cost near a start within the bounds.
///
/// # Errors
/// What ends the descent at its start. Later, it is told in the minimum.
pub fn minimised<S: Squares>(
    problem: &mut S,
    start: Vec<f64>,
    ends: &Ends<'_>,
) -> Result<Minimum<S::Stop>, S::Stop> {
    let normal = problem.normal(&start)?;
    let mut at = Point {
        x: start,
        normal,
        left: f64::INFINITY,
    };
    let mut damping = DAMPING;
    for _ in 0..ends.iterations {
        // a stop leaves the last point that was linearised, and the distance that was known on the way there
        let before = at.left;
        let stopped = |at: Point, stop| {
            Ok(Minimum {
                x: at.x,
                cost: at.normal.cost,
                left: before,
                stopped: Some(stop),
            })
        };
        // no eigenvectors: the derivatives say nothing
        if at.normal.matrix.iter().any(|v| !v.is_finite()) {
            at.left = f64::INFINITY;
            break;
        }
        let Some(scaled) = Scaled::new(&at, ends) else {
            at.left = 0.0;
            break;
        };
        let variance = (at.normal.cost / ends.count).max(1e-300);
        at.left = scaled.distance() / variance;
        if at.left < ends.enough {
            break;
        }
        let step = match scaled.step(problem, &at, ends, variance, &mut damping) {
            Ok(Some(step)) => step,
            Ok(None) => break,
            Err(stop) => return stopped(at, stop),
        };
        damping = (damping / LOWER).max(LEAST_DAMPING);
        let gained = (at.normal.cost - step.1) / variance;
        at.normal = match problem.normal(&step.0) {
            Ok(normal) => normal,
            Err(stop) => return stopped(at, stop),
        };
        at.x = step.0;
        if gained < ends.enough {
            at.left = at.left.min(gained);
            break;
        }
    }
    Ok(Minimum {
        x: at.x,
        cost: at.normal.cost,
        left: at.left,
        stopped: None,
    })
}

struct Point {
    x: Vec<f64>,
    normal: Normal,
    left: f64,
}

/// The normal equations of the parameters that no bound holds, with columns of length 1, along their eigenvectors.
struct Scaled {
    free: Vec<usize>,
    scale: Vec<f64>,
    size: DVector<f64>,
    along: DMatrix<f64>,
    slope: DVector<f64>,
    least: f64,
}

impl Scaled {
    /// `None` if nothing is free.
    fn new(at: &Point, ends: &Ends<'_>) -> Option<Self> {
        let Normal {
            gradient, matrix, ..
        } = &at.normal;
        let held = |j: usize| {
            at.x[j] <= ends.low[j] && gradient[j] > 0.0
                || at.x[j] >= ends.high[j] && gradient[j] < 0.0
        };
        let free: Vec<usize> = (0..at.x.len())
            .filter(|&j| !held(j) && matrix[(j, j)] > 0.0)
            .collect();
        if free.is_empty() {
            return None;
        }
        let n = free.len();
        let scale: Vec<f64> = free.iter().map(|&j| matrix[(j, j)].sqrt()).collect();
        let eigen = DMatrix::from_fn(n, n, |i, j| {
            matrix[(free[i], free[j])] / (scale[i] * scale[j])
        })
        .symmetric_eigen();
        let slope = DVector::from_fn(n, |i, _| gradient[free[i]] / scale[i]);
        Some(Self {
            slope: eigen.eigenvectors.tr_mul(&slope),
            least: FLAT * eigen.eigenvalues.max(),
            size: eigen.eigenvalues,
            along: eigen.eigenvectors,
            free,
            scale,
        })
    }

    /// The sum of a function of slope and size over the directions to step in.
    fn sum(&self, of: impl Fn(f64, f64) -> f64) -> f64 {
        let pairs = self.slope.iter().zip(&self.size);
        let known = pairs.filter(|(_, size)| **size > self.least);
        known.map(|(slope, size)| of(*slope, *size)).sum()
    }

    fn distance(&self) -> f64 {
        self.sum(|slope, size| slope * slope / size)
    }

    /// The first trial that lowers the cost, with its cost; `None` at a kink, where the gain that the linear model promises does not
    /// exist or is not worth a trial.
    fn step<S: Squares>(
        &self,
        problem: &mut S,
        at: &Point,
        ends: &Ends<'_>,
        variance: f64,
        mu: &mut f64,
    ) -> Result<Option<(Vec<f64>, f64)>, S::Stop> {
        let mut refused = f64::INFINITY;
        while *mu <= MOST_DAMPING {
            let damping = *mu;
            let promised = self.sum(|slope, size| {
                slope * slope * (size + 2.0 * damping) / (size + damping).powi(2)
            });
            if promised < ends.enough * variance {
                return Ok(None);
            }
            // else nearly the step that was just rejected
            if promised <= SAME * refused {
                let trial = self.trial(at, ends, damping);
                let after = problem.cost(&trial)?;
                if after < at.normal.cost {
                    return Ok(Some((trial, after)));
                }
                refused = promised;
            }
            *mu *= RAISE;
        }
        Ok(None)
    }

    fn trial(&self, at: &Point, ends: &Ends<'_>, damping: f64) -> Vec<f64> {
        let along = DVector::from_fn(self.size.len(), |i, _| {
            if self.size[i] > self.least {
                self.slope[i] / (self.size[i] + damping)
            } else {
                0.0
            }
        });
        let step = &self.along * along;
        let mut trial = at.x.clone();
        for ((&j, scale), step) in self.free.iter().zip(&self.scale).zip(&step) {
            trial[j] -= step / scale;
        }
        for (x, (low, high)) in trial.iter_mut().zip(ends.low.iter().zip(ends.high)) {
            *x = x.max(*low).min(*high);
        }
        trial
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// `(a exp(-b t) - y)` and its derivatives.
    struct Decay(Vec<f64>);

    impl Squares for Decay {
        type Stop = &'static str;

        fn normal(&mut self, x: &[f64]) -> Result<Normal, Self::Stop> {
            let (mut gradient, mut matrix) = (DVector::zeros(2), DMatrix::zeros(2, 2));
            for (k, y) in self.0.iter().enumerate() {
                let t = 0.1 * k as f64;
                let shape = (-x[1] * t).exp();
                let row = DVector::from_vec(vec![shape, -x[0] * t * shape]);
                gradient += (x[0] * shape - y) * &row;
                matrix += &row * row.transpose();
            }
            let cost = self.cost(x)?;
            Ok(Normal {
                cost,
                gradient,
                matrix,
            })
        }

        fn cost(&mut self, x: &[f64]) -> Result<f64, Self::Stop> {
            if x[1] < -5.0 {
                return Err("too steep");
            }
            let off = |(k, y): (usize, &f64)| (x[0] * (-x[1] * 0.1 * k as f64).exp() - y).powi(2);
            Ok(self.0.iter().enumerate().map(off).sum())
        }
    }

    fn decay(a: f64, b: f64) -> Decay {
        Decay((0..50).map(|k| a * (-b * 0.1 * k as f64).exp()).collect())
    }

    fn ends<'a>(low: &'a [f64], high: &'a [f64]) -> Ends<'a> {
        Ends {
            low,
            high,
            count: 50.0,
            enough: 1e-8,
            iterations: 60,
        }
    }

    const INFINITE: [f64; 2] = [f64::INFINITY; 2];

    proptest! {
        #![proptest_config(crate::laws::cases(50))]
        #[test]
        fn a_minimum_is_found_from_nearby(a in 0.5..3.0_f64, b in 0.2..2.0_f64, off in -0.3..0.3_f64) {
            let low = INFINITE.map(|v| -v);
            let found = minimised(&mut decay(a, b), vec![a + off, b - off], &ends(&low, &INFINITE)).unwrap();
            prop_assert!((found.x[0] - a).abs() < 1e-5 && (found.x[1] - b).abs() < 1e-5, "{:?}", found.x);
        }

        #[test]
        fn a_bound_is_kept_and_the_rest_is_least(a in 1.0..3.0_f64, b in 0.5..2.0_f64) {
            let high = [f64::INFINITY, 0.8 * b];
            let found = minimised(&mut decay(a, b), vec![a, 0.5 * b], &ends(&[-9.0, 0.0], &high)).unwrap();
            prop_assert!((found.x[1] - high[1]).abs() < 1e-12);
            let normal = decay(a, b).normal(&found.x).unwrap();
            prop_assert!(normal.gradient[0].abs() < 1e-3 && normal.gradient[1] < 0.0);
        }
    }

    #[test]
    fn a_stop_keeps_the_point_before_it() {
        let (low, start) = (INFINITE.map(|v| -v), vec![1.0, -6.0]);
        assert!(minimised(&mut decay(1.0, 1.0), start, &ends(&low, &INFINITE)).is_err());
        let mut steep = Decay((0..50).map(|k| (0.62 * k as f64).exp()).collect());
        let found = minimised(&mut steep, vec![1.0, -4.5], &ends(&low, &INFINITE)).unwrap();
        assert_eq!(found.stopped, Some("too steep"));
        assert!(found.x[1] > -5.0 && found.cost.is_finite());
    }
}
