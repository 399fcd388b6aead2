//! Nonlinear least squares with dense Jacobians: `min 1/2 |r(theta)|^2` within bounds, with a confirmed minimum.
//!
//! Levenberg-Marquardt in a trust region on the triangle of the Jacobian ([`triangle`], [`trust`]). If a test for a
//! minimum holds, the minimum is confirmed ([`confirm`]) before the outcome counts as converged: the Jacobian has full
//! rank, and the Gauss-Newton steps contract to below the tolerances. These steps are judged by their own size, because
//! the cost cannot distinguish points whose parameters differ by less than the square root of rounding.
//!
//! To read: `point` (the present point), `triangle` (the QR factor), `trust` (the steps), `confirm` (the end).

mod confirm;
mod point;
pub(crate) mod triangle;
mod trust;

pub use crate::descent::Termination;

use std::cmp::Ordering;

use crate::descent::descend;
use crate::{Error, Monitor, Result};
use point::Spread;
use trust::TrustRegion;

/// Residuals and their derivatives.
///
/// ```
/// use sewfast_core::Monitor;
/// use sewfast_core::least_squares::{Residuals, Settings, solve};
///
/// /// A line through three points.
/// struct Line;
///
/// impl Residuals for Line {
///     fn parameters(&self) -> usize {
///         2
///     }
///     fn len(&self) -> usize {
///         3
///     }
///     fn residuals(&mut self, t: &[f64], r: &mut [f64]) -> bool {
///         for (k, (r, y)) in r.iter_mut().zip([1.0, 3.0, 5.0]).enumerate() {
///             *r = t[0] + t[1] * k as f64 - y;
///         }
///         true
///     }
///     fn jacobian(&mut self, _: &[f64], _: &[f64], j: &mut [f64]) -> bool {
///         j.copy_from_slice(&[1.0, 0.0, 1.0, 1.0, 1.0, 2.0]);
///         true
///     }
/// }
///
/// let fit = solve(&mut Line, vec![0.0, 0.0], &Settings::default(), &Monitor::default())?;
/// assert!(fit.termination.is_converged());
/// assert!((fit.theta[0] - 1.0).abs() < 1e-12 && (fit.theta[1] - 2.0).abs() < 1e-12);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
#[expect(
    clippy::len_without_is_empty,
    reason = "a problem without residuals is refused"
)]
pub trait Residuals {
    /// Number of parameters.
    fn parameters(&self) -> usize;

    /// Number of residuals.
    fn len(&self) -> usize;

    /// Fills the residuals at `theta`; false if they cannot be computed.
    fn residuals(&mut self, theta: &[f64], r: &mut [f64]) -> bool;

    /// Fills the derivatives at `theta`, one row per residual; `r` are the residuals there. False if they cannot be computed.
    fn jacobian(&mut self, theta: &[f64], r: &[f64], j: &mut [f64]) -> bool;
}

/// Tolerances, limits, scaling.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Relative reduction of the cost that counts as none.
    pub ftol: f64,
    /// Relative step that counts as none.
    pub xtol: f64,
    /// Cosine between the residual and the range of the Jacobian that counts as zero.
    pub gtol: f64,
    /// Most evaluations of the residuals; those within a numerical Jacobian are not counted.
    pub max_evaluations: usize,
    /// Relative error of the Jacobian, 0 if it is exact to rounding: ranks cannot be resolved any finer.
    pub precision: f64,
    /// Typical sizes of the parameters; `None`: scaled by the largest norms of the Jacobian's columns so far.
    pub scale: Option<Vec<f64>>,
    /// Lower bounds; `None`: minus infinity.
    pub lower: Option<Vec<f64>>,
    /// Upper bounds; `None`: infinity.
    pub upper: Option<Vec<f64>>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            ftol: 1e-8,
            xtol: 1e-8,
            gtol: 1e-8,
            max_evaluations: 1000,
            precision: 0.0,
            scale: None,
            lower: None,
            upper: None,
        }
    }
}

/// The best parameters found, how the search ended, and how well the data determine them.
#[derive(Clone, Debug)]
pub struct Solution {
    /// Best parameters.
    pub theta: Vec<f64>,
    /// `1/2 |r|^2` there.
    pub cost: f64,
    /// Residuals there.
    pub residual: Vec<f64>,
    /// Jacobian there, row by row; NaN if there is none.
    pub jacobian: Vec<f64>,
    /// How it ended.
    pub termination: Termination,
    /// Evaluations of the residuals.
    pub evaluations: usize,
    /// Evaluations of the Jacobian.
    pub jacobians: usize,
    /// Largest component of the gradient that no bound holds.
    pub optimality: f64,
    /// Cosine between the residual and the range of the Jacobian: the relative offset of Bates and Watts (1981).
    pub cosine: f64,
    /// -1 if the lower bound holds a parameter, 1 if the upper one does, else 0.
    pub active: Vec<i8>,
    /// `s^2 (J'J)^-1` row by row, `s^2 = |r|^2 / (m - n)`; parameters on a bound count as known.
    pub covariance: Vec<f64>,
    /// Condition of the Jacobian with columns of unit length.
    pub condition: f64,
    /// Its rank, without parameters on a bound.
    pub rank: usize,
    /// Cost at the start and after each accepted step.
    pub trace: Vec<f64>,
}

/// Minimises `1/2 |r(theta)|^2` from `start`.
///
/// # Errors
/// `ErrorKind::Setting` for sizes that do not fit, a start outside the bounds or not finite, bounds that leave no room,
/// typical sizes that are not above zero, and negative tolerances.
pub fn solve(
    problem: &mut impl Residuals,
    start: Vec<f64>,
    settings: &Settings,
    monitor: &Monitor,
) -> Result<Solution> {
    check(problem, &start, settings)?;
    let mut method = TrustRegion::new(problem, settings, monitor);
    let mut outcome = descend(&mut method, start, usize::MAX, monitor, |_, _| {});
    if !outcome.termination.is_converged() {
        outcome.termination = method.conclude(&mut outcome);
    }
    let point = &method.point;
    let spread = point
        .is_linearised
        .then(|| Spread::new(&point.triangle, point.residual.len(), settings.precision))
        .flatten();
    let n = outcome.theta.len();
    Ok(Solution {
        cost: outcome.cost,
        residual: point.residual.clone(),
        jacobian: point.jacobian_or_nan(),
        termination: outcome.termination,
        evaluations: method.evaluations,
        jacobians: method.jacobians,
        optimality: point.optimality(),
        cosine: point.cosine(),
        active: point.active.clone(),
        covariance: point.covariance(spread.as_ref(), n),
        condition: spread.as_ref().map_or(f64::NAN, |s| s.condition),
        rank: spread.as_ref().map_or(0, |s| s.rank),
        trace: outcome.trace,
        theta: outcome.theta,
    })
}

fn check(problem: &impl Residuals, start: &[f64], settings: &Settings) -> Result<()> {
    let n = problem.parameters();
    if n == 0 || problem.len() == 0 {
        return Err(Error::setting(format!(
            "expected at least one parameter and one residual, got {n} and {}; nothing is to be fitted",
            problem.len()
        )));
    }
    let sizes = [Some(start.len())].into_iter().chain(
        [&settings.scale, &settings.lower, &settings.upper].map(|v| v.as_ref().map(Vec::len)),
    );
    if let Some(other) = sizes.flatten().find(|&size| size != n) {
        return Err(Error::setting(format!(
            "expected {n} values for x0, bounds and x_scale alike, got {other}; give one per parameter"
        )));
    }
    if let Some(j) = start.iter().position(|v| !v.is_finite()) {
        return Err(Error::setting(format!(
            "expected a finite x0, got {} in place {j}; start from numbers",
            start[j]
        )));
    }
    for (j, &x) in start.iter().enumerate() {
        let (low, high) = settings.bounds(j);
        if low.partial_cmp(&high) != Some(Ordering::Less) {
            return Err(Error::setting(format!(
                "expected a lower bound below the upper one, got {low} and {high} in place {j}; fix a parameter by leaving it out"
            )));
        }
        if x < low || x > high {
            return Err(Error::setting(format!(
                "expected x0 within the bounds, got {x} outside {low} .. {high} in place {j}; move it inside"
            )));
        }
    }
    let unusable = |v: &&f64| !(**v > 0.0 && v.is_finite());
    if let Some(size) = settings.scale.iter().flatten().find(unusable) {
        return Err(Error::setting(format!(
            "expected an x_scale finite and above 0, got {size}; give typical sizes of the parameters"
        )));
    }
    let tolerances = [
        settings.ftol,
        settings.xtol,
        settings.gtol,
        settings.precision,
    ];
    if let Some(bad) = tolerances.iter().find(|v| !(**v >= 0.0 && **v < 1.0)) {
        return Err(Error::setting(format!(
            "expected ftol, xtol and gtol of 0 to 1, got {bad}; 1e-8 is usual"
        )));
    }
    Ok(())
}

impl Settings {
    fn bounds(&self, j: usize) -> (f64, f64) {
        (
            self.lower.as_ref().map_or(f64::NEG_INFINITY, |v| v[j]),
            self.upper.as_ref().map_or(f64::INFINITY, |v| v[j]),
        )
    }

    fn clip(&self, j: usize, value: f64) -> f64 {
        let (low, high) = self.bounds(j);
        value.clamp(low, high)
    }
}

#[cfg(test)]
mod tests;
