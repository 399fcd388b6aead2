//! Confirmation of a minimum, and its last digits. Begin reading at `polished`.
//!
//! Undamped steps from the candidate point must get shorter. These are Gauss-Newton steps `-J^+ r` or, if the residual is so large or so
//! curved that they do not contract, Newton steps with a Hessian from differences of the gradient `J'r`, which must be positive definite.
//! Steps are measured by the parameters and their standard errors, not by the cost.

use super::Residuals;
use super::point::{Point, Spread, nonzero};
use super::triangle::Triangle;
use super::trust::TrustRegion;
use crate::descent::{Method, Outcome, Termination};
use crate::lm::{cholesky, substitute};

/// A step counts as contracting if it is at most this share of the one before.
const CONTRACTION: f64 = 0.5;
/// Largest relative step that may remain when rounding ends the contraction, or when a test on the gradient holds.
const CONFIRMED: f64 = 1e-6;
/// Relative step beyond which the point is too far from a minimum to tell.
const REACH: f64 = 0.1;
/// Most steps.
const MOST: usize = 30;
/// Relative rise of the cost that rounding explains.
const ROUNDING: f64 = 1e-9;
/// Size of the steps for differences: `DEVIATIONS` standard deviations of the residuals plus, against rounding of the gradient, `PARTS`
/// of all parameters' share in the residuals. No parameter moves by more than `DEVIATIONS` of its measure.
const DEVIATIONS: f64 = 1e-3;
const PARTS: f64 = 1e-9;
/// Damping of the coordinates of the Hessian, relative to the columns: smaller singular values are not stretched any further.
const SOFTNESS: f64 = 1e-6;

/// The next undamped step, and its largest component relative to the parameters' measures.
struct Step {
    free: Vec<f64>,
    error: f64,
}

/// The Cholesky factor of the Hessian in coordinates `R theta`. In these `J'J` is about the unit matrix, so the
/// curvature of the residuals shows for any condition of `J`.
struct Hessian {
    triangle: Triangle,
    factor: Vec<f64>,
}

impl Step {
    /// Strictly shorter: a step of length zero proves no contraction.
    fn is_shorter_than(&self, before: &Self) -> bool {
        self.error < before.error && self.error <= CONTRACTION * before.error
    }
}

/// The state of the polish; the measures stay those of its start.
struct Polish {
    theta: Vec<f64>,
    cost: f64,
    measures: Vec<f64>,
    free: Vec<usize>,
    hessian: Option<Hessian>,
}

impl Polish {
    fn step(&self, point: &Point) -> Step {
        let n = self.free.len();
        let mut free = vec![0.0; n];
        if let Some(Hessian { triangle, factor }) = &self.hessian {
            for (p, &j) in free.iter_mut().zip(&self.free) {
                *p = -point.gradient[j];
            }
            triangle.solve_transposed(&mut free);
            substitute(factor, n, &mut free);
            triangle.solve(&mut free);
        } else {
            point.triangle.minimiser(&mut free);
        }
        let relative = |(p, w): (&f64, &f64)| if *p == 0.0 { 0.0 } else { p.abs() / w };
        // Unlike f64::max, this must not skip a NaN.
        let error = free.iter().zip(&self.measures).map(relative);
        let error = error.fold(0.0, |most: f64, e| if e <= most { most } else { e });
        Step { free, error }
    }

    fn moved(&self, step: &Step) -> Vec<f64> {
        let mut theta = self.theta.clone();
        for (&j, p) in self.free.iter().zip(&step.free) {
            theta[j] += p;
        }
        theta
    }
}

impl<P: Residuals> TrustRegion<'_, P> {
    /// `Ok`: the test that holds at the confirmed minimum, to which the outcome has moved. `Err`: the reason to doubt
    /// it; the outcome is unchanged.
    pub fn confirm(&mut self, outcome: &mut Outcome) -> Result<Termination, Termination> {
        let residual = self.point.residual.clone();
        let found = self.polished(outcome);
        match found {
            Ok((termination, polish)) => {
                if polish.theta != outcome.theta {
                    outcome.trace.push(polish.cost);
                }
                (outcome.theta, outcome.cost) = (polish.theta, polish.cost);
                Ok(termination)
            }
            Err(doubt) => {
                if self.point.residual != residual || !self.point.is_linearised {
                    self.point.residual = residual;
                    self.linearise_point(&outcome.theta);
                }
                Err(doubt)
            }
        }
    }

    fn polished(&mut self, outcome: &Outcome) -> Result<(Termination, Polish), Termination> {
        let spread = self.full_spread()?;
        let mut polish = Polish {
            measures: self.point.measures(&outcome.theta, &spread.inverse),
            theta: outcome.theta.clone(),
            cost: outcome.cost,
            free: self.point.free.clone(),
            hessian: None,
        };
        let mut contracted = self.has_contracted() || polish.free.is_empty();
        let mut step = polish.step(&self.point);
        for _ in 0..MOST {
            if step.error > REACH {
                return Err(Termination::Flat);
            }
            let settled = self.is_settled(&step);
            let next = self.advance(&mut polish, &step)?;
            let shrunk = next
                .as_ref()
                .is_some_and(|next| next.is_shorter_than(&step));
            contracted |= shrunk;
            match next {
                Some(next) if next.error < step.error => step = next,
                _ => self.linearise_again(&polish)?,
            }
            if contracted && ((settled && shrunk) || (!shrunk && step.error <= CONFIRMED)) {
                self.full_spread()?;
                return Ok((self.test(&step), polish));
            }
            if shrunk {
                continue;
            }
            if polish.hessian.is_some() {
                return Err(Termination::Flat);
            }
            let otherwise = if step.error <= CONFIRMED {
                Termination::Saddle
            } else {
                Termination::Flat
            };
            polish.hessian = Some(self.hessian(&polish, otherwise)?);
            contracted = true;
            step = polish.step(&self.point);
        }
        Err(Termination::Flat)
    }

    /// Rank and covariance, if the rank is full.
    fn full_spread(&self) -> Result<Spread, Termination> {
        let spread = Spread::new(
            &self.point.triangle,
            self.point.residual.len(),
            self.settings.precision,
        );
        let spread = spread.ok_or(Termination::NotFinite)?;
        if spread.is_full() {
            Ok(spread)
        } else {
            Err(Termination::RankDeficient)
        }
    }

    /// True if the step meets the tolerances.
    fn is_settled(&self, step: &Step) -> bool {
        let settings = self.settings;
        let level = self.point.cosine() <= settings.gtol.max(settings.ftol);
        step.error <= settings.xtol || (level && step.error <= CONFIRMED)
    }

    fn test(&self, step: &Step) -> Termination {
        if self.point.cosine() <= self.settings.gtol {
            Termination::SmallGradient
        } else if step.error <= self.settings.xtol {
            Termination::SmallStep
        } else {
            Termination::SmallReduction
        }
    }

    /// Takes the step if the next one is shorter, and returns the next one; `None` if the step leads nowhere. The point
    /// is linearised at the polished parameters only if a shorter next step is returned.
    fn advance(&mut self, polish: &mut Polish, step: &Step) -> Result<Option<Step>, Termination> {
        if self.monitor.stopped() {
            return Err(Termination::Interrupted);
        }
        if self.is_spent() {
            return Err(Termination::MaxEvaluations);
        }
        let theta = polish.moved(step);
        if !self.is_inside(&theta) {
            return Ok(None);
        }
        let cost = self.cost(&theta);
        let Some(cost) = cost.filter(|&c| c <= polish.cost * (1.0 + ROUNDING)) else {
            return Ok(None);
        };
        let residual = self.point.residual.clone();
        self.keep();
        if !self.linearise_point(&theta) || self.point.free != polish.free {
            self.point.residual = residual;
            return Ok(None);
        }
        let next = polish.step(&self.point);
        if next.error < step.error {
            (polish.theta, polish.cost) = (theta, cost);
        } else {
            self.point.residual = residual;
            self.point.is_linearised = false;
        }
        Ok(Some(next))
    }

    /// Returns to the polished parameters after a step that led elsewhere.
    fn linearise_again(&mut self, polish: &Polish) -> Result<(), Termination> {
        if self.linearise_point(&polish.theta) {
            return Ok(());
        }
        Err(Termination::NotFinite)
    }

    /// The Hessian from differences of the gradient at the polished parameters; `otherwise` if it is not positive definite.
    fn hessian(&mut self, polish: &Polish, otherwise: Termination) -> Result<Hessian, Termination> {
        let n = polish.free.len();
        let (residual, gradient) = (self.point.residual.clone(), self.point.gradient.clone());
        let triangle = self.point.softened();
        let size = self.point.typical_change(&polish.theta);
        let mut h = vec![0.0; n * n];
        for (a, row) in h.chunks_exact_mut(n).enumerate() {
            let mut axis = vec![0.0; n];
            axis[a] = 1.0;
            triangle.solve(&mut axis);
            let share = axis.iter().zip(&polish.measures).map(|(v, w)| v.abs() / w);
            let size = size.min(DEVIATIONS / share.fold(0.0, f64::max));
            let taken = self.beside(polish, &axis, size)?;
            for (h, &i) in row.iter_mut().zip(&polish.free) {
                *h = (self.point.gradient[i] - gradient[i]) / taken;
            }
            triangle.solve_transposed(row);
        }
        self.point.residual = residual;
        self.linearise_again(polish)?;
        for a in 0..n {
            for b in 0..a {
                h[a * n + b] = 0.5 * (h[a * n + b] + h[b * n + a]);
            }
        }
        if !cholesky(&mut h, n) {
            return Err(otherwise);
        }
        Ok(Hessian {
            triangle,
            factor: h,
        })
    }

    /// Linearises at `size` along `axis`, or at `-size` if that is not possible; returns the signed size.
    fn beside(&mut self, polish: &Polish, axis: &[f64], size: f64) -> Result<f64, Termination> {
        for size in [size, -size] {
            let mut theta = polish.theta.clone();
            for (&j, v) in polish.free.iter().zip(axis) {
                theta[j] += size * v;
            }
            if self.monitor.stopped() {
                return Err(Termination::Interrupted);
            }
            if self.is_inside(&theta) && self.cost(&theta).is_some() {
                self.keep();
                if self.linearise_point(&theta) {
                    return Ok(size);
                }
            }
        }
        Err(Termination::Stalled)
    }

    fn is_inside(&self, theta: &[f64]) -> bool {
        let inside = |(j, &x): (usize, &f64)| self.settings.clip(j, x) == x;
        theta.iter().enumerate().all(inside)
    }
}

impl Point {
    /// The triangle with slight damping: at a minimum with a nonzero residual the Jacobian may be singular.
    fn softened(&self) -> Triangle {
        let mut triangle = self.triangle.clone();
        for (a, &j) in self.free.iter().enumerate() {
            triangle.push(|row| {
                row.fill(0.0);
                row[a] = SOFTNESS * nonzero(self.columns[j]);
            });
        }
        triangle.fold();
        triangle
    }

    /// Size of a small change of the residuals, for differences.
    fn typical_change(&self, theta: &[f64]) -> f64 {
        let parts = self
            .free
            .iter()
            .map(|&j| (self.columns[j] * theta[j]).powi(2));
        DEVIATIONS * self.variance().unwrap_or(0.0).sqrt() + PARTS * parts.sum::<f64>().sqrt()
    }
}
