//! The trust-region method: scaling, the best step within a radius and bounds, the radius's response to success and
//! failure, and the tests that call for confirmation.

use super::point::{Point, nonzero};
use super::triangle::Triangle;
use super::{Residuals, Settings};
use crate::Monitor;
use crate::descent::{Method, Outcome, Proposal, Termination, Verdict};

/// Relative reduction that the cost cannot resolve: below it, steps are judged by their size.
const UNSEEN: f64 = 1e-10;
/// Failed confirmations in a row before the failure is believed; the count restarts if the cost falls below `PROGRESS`
/// times the last one.
const PATIENCE: usize = 5;
const PROGRESS: f64 = 0.9;

/// Residuals, the present point, and the trust region.
pub(super) struct TrustRegion<'a, P> {
    pub problem: &'a mut P,
    pub settings: &'a Settings,
    pub monitor: &'a Monitor,
    pub point: Point,
    pub trial: Vec<f64>,
    pub evaluations: usize,
    pub jacobians: usize,
    radius: Radius,
    promise: Promise,
    /// The scaling `D` of all parameters.
    scale: Vec<f64>,
    /// `D`, the step and its image, of the free parameters.
    d: Vec<f64>,
    step: Vec<f64>,
    image: Vec<f64>,
    /// `|D theta|` of the free parameters.
    size: f64,
    /// Scaled length of the undamped step just taken, if it was one.
    full_step: Option<f64>,
    /// Whether a test on cost or step held.
    called: bool,
    doubts: usize,
    /// Cost at the last failed confirmation.
    doubted: f64,
}

impl<'a, P: Residuals> TrustRegion<'a, P> {
    pub fn new(problem: &'a mut P, settings: &'a Settings, monitor: &'a Monitor) -> Self {
        let (m, n) = (problem.len(), problem.parameters());
        let fixed = settings.scale.as_ref();
        Self {
            problem,
            settings,
            monitor,
            point: Point::new(m, n),
            trial: vec![0.0; m],
            evaluations: 0,
            jacobians: 0,
            radius: Radius::new(n),
            promise: Promise {
                reduction: 0.0,
                slope: 0.0,
            },
            scale: fixed.map_or_else(
                || vec![0.0; n],
                |sizes| sizes.iter().map(|s| 1.0 / s).collect(),
            ),
            d: Vec::with_capacity(n),
            step: vec![0.0; n],
            image: vec![0.0; n],
            size: 0.0,
            full_step: None,
            called: false,
            doubts: 0,
            doubted: f64::INFINITY,
        }
    }

    /// True if the permitted evaluations are used up.
    pub fn is_spent(&self) -> bool {
        self.evaluations >= self.settings.max_evaluations
    }

    /// Computes the Jacobian and all that follows from it at the present point, without changing the scaling.
    pub fn linearise_point(&mut self, theta: &[f64]) -> bool {
        let point = &mut self.point;
        self.jacobians += 1;
        point.is_linearised = self
            .problem
            .jacobian(theta, &point.residual, &mut point.jacobian)
            && point.digest(theta, self.settings);
        point.is_linearised
    }

    /// A second look at a stalled end: it may be a minimum that the cost alone cannot show.
    pub fn conclude(&mut self, outcome: &mut Outcome) -> Termination {
        let end = outcome.termination;
        if end != Termination::Stalled || !self.point.is_linearised {
            return end;
        }
        match self.confirm(outcome) {
            Ok(minimum) => minimum,
            Err(doubt) => doubt,
        }
    }

    /// Confirms a minimum, or returns why the iteration should end without one; `None` to go on. `level`: the residual
    /// is orthogonal to every column.
    fn decide(&mut self, outcome: &mut Outcome, level: bool) -> Option<Termination> {
        match self.confirm(outcome) {
            Ok(minimum) => Some(minimum),
            Err(Termination::Interrupted) => Some(Termination::Interrupted),
            Err(doubt) => {
                let fell = outcome.cost < PROGRESS * self.doubted;
                self.doubts = if fell { 1 } else { self.doubts + 1 };
                self.doubted = outcome.cost;
                let rank = doubt == Termination::RankDeficient && level;
                (rank || self.doubts == PATIENCE).then_some(doubt)
            }
        }
    }

    /// True if the Gauss-Newton step is so small that the cost may not show it, or is below the tolerance.
    fn is_near(&mut self, theta: &[f64]) -> bool {
        let point = &self.point;
        if !point.triangle.seems_regular() {
            return false;
        }
        let cosine = point.cosine();
        if cosine * cosine <= UNSEEN || cosine <= self.settings.gtol {
            return true;
        }
        let step = &mut self.step[..point.free.len()];
        point.triangle.minimiser(step);
        let small = |(p, &j): (&f64, &usize)| p.abs() <= self.settings.xtol * theta[j].abs();
        step.iter().zip(&point.free).all(small)
    }

    /// True if the last step was undamped and the next one is at most half as long: the iteration contracts.
    pub fn has_contracted(&mut self) -> bool {
        let step = &mut self.step[..self.point.free.len()];
        self.point.triangle.minimiser(step);
        let next = scaled_length(&self.d, step);
        self.full_step.is_some_and(|last| next <= 0.5 * last)
    }

    /// Fills the trial; if bounds cut the step, recomputes what the linear model promises.
    fn place(&mut self, theta: &[f64], trial: &mut [f64]) {
        trial.copy_from_slice(theta);
        let (norm, mut cut) = (self.point.norm(), false);
        for (p, &j) in self.step.iter_mut().zip(&self.point.free) {
            let free = theta[j] + *p;
            trial[j] = self.settings.clip(j, free);
            if trial[j] != free {
                *p = trial[j] - theta[j];
                cut = true;
            }
        }
        let n = self.point.free.len();
        self.point.triangle.times(&self.step[..n], &mut self.image);
        self.promise = self.radius.promise(&self.image[..n], norm);
        if cut {
            let rhs = self.point.triangle.rhs();
            let along: f64 = rhs.zip(&self.image).map(|(b, v)| b * v).sum();
            let square: f64 = self.image[..n].iter().map(|v| v * v).sum();
            self.promise = Promise {
                reduction: -(2.0 * along + square) / (norm * norm),
                slope: along / (norm * norm),
            };
        }
    }
}

impl<P: Residuals> Method for TrustRegion<'_, P> {
    fn parameters(&self) -> usize {
        self.problem.parameters()
    }

    fn cost(&mut self, theta: &[f64]) -> Option<f64> {
        self.evaluations += 1;
        let had = self.problem.residuals(theta, &mut self.trial);
        let cost = 0.5 * self.trial.iter().map(|r| r * r).sum::<f64>();
        (had && cost.is_finite()).then_some(cost)
    }

    fn keep(&mut self) {
        std::mem::swap(&mut self.point.residual, &mut self.trial);
        self.point.is_linearised = false;
    }

    fn linearise(&mut self, theta: &[f64]) -> bool {
        if !self.linearise_point(theta) {
            return false;
        }
        if self.settings.scale.is_none() {
            // The largest norms so far: a column that vanishes must not release its parameter (More 1978).
            for (d, c) in self.scale.iter_mut().zip(&self.point.columns) {
                *d = d.max(*c);
            }
        }
        self.d.clear();
        self.d
            .extend(self.point.free.iter().map(|&j| nonzero(self.scale[j])));
        let values = self.point.free.iter().map(|&j| theta[j]);
        self.size = self
            .d
            .iter()
            .zip(values)
            .map(|(d, x)| (d * x).powi(2))
            .sum::<f64>()
            .sqrt();
        self.radius.begin(self.size);
        true
    }

    fn finished(&mut self, outcome: &mut Outcome) -> Option<Termination> {
        let level = self.point.largest_cosine() <= self.settings.gtol;
        let fresh = outcome.cost < self.doubted;
        if level || std::mem::take(&mut self.called) || (fresh && self.is_near(&outcome.theta)) {
            return self.decide(outcome, level);
        }
        None
    }

    fn propose(&mut self, theta: &[f64], trial: &mut [f64]) -> Proposal {
        if self.is_spent() {
            return Proposal::End(Termination::MaxEvaluations);
        }
        let n = self.point.free.len();
        self.radius
            .step(&self.point.triangle, &self.d, &mut self.step[..n]);
        self.place(theta, trial);
        Proposal::Trial
    }

    fn judge(&mut self, before: f64, after: Option<f64>) -> Verdict {
        // Beyond ten times the residual the parabola for the radius is meaningless.
        let actual = after
            .filter(|&cost| cost < 100.0 * before)
            .map_or(f64::NEG_INFINITY, |cost| 1.0 - cost / before);
        let good = self.radius.learn(self.promise, actual);
        let Settings { ftol, xtol, .. } = *self.settings;
        let even = actual.abs() <= ftol && self.promise.reduction <= ftol;
        let short = self.radius.is_below(xtol, self.size);
        if good {
            self.called = even || short;
            self.full_step = self.radius.is_undamped().then_some(self.radius.length);
            return Verdict::Accepted;
        }
        let least = f64::EPSILON;
        if self.promise.reduction.abs() <= least || self.radius.is_below(least, self.size) {
            return Verdict::End(Termination::Stalled);
        }
        Verdict::Rejected
    }
}

// The trust region: the best step within a radius, and how the radius follows success and failure.
//
// The subproblem `min |r + J p|, |D p| <= radius` has the solution of the damped system `[J; sqrt(lambda) D] p = -[r; 0]`
// for one `lambda >= 0`, which Newton's method finds on `|D p(lambda)| = radius` (More, The Levenberg-Marquardt
// algorithm, Lecture Notes in Mathematics 630, 1978, 105-116).

/// Relative accuracy of `|D p| = radius`.
const SLACK: f64 = 0.1;
/// Most Newton steps for lambda; that accuracy never needs more.
const MOST_TRIALS: usize = 30;
/// The first radius, in lengths of the scaled start (More recommends 0.1 to 100).
const FIRST: f64 = 1.0;
/// Least share of the promised reduction that an accepted step must bring.
const LEAST_GAIN: f64 = 1e-4;

/// Radius, damping and the resulting step, for the free parameters.
struct Radius {
    /// `None` before the first step.
    radius: Option<f64>,
    lambda: f64,
    /// `|D p|` of the last step.
    length: f64,
    damped: Triangle,
    work: Vec<f64>,
    first_trial: bool,
}

/// The reduction that the linear model promises, relative to the cost, and its slope at the start.
#[derive(Clone, Copy, Debug)]
struct Promise {
    reduction: f64,
    slope: f64,
}

impl Radius {
    fn new(n: usize) -> Self {
        Self {
            radius: None,
            lambda: 0.0,
            length: 0.0,
            damped: Triangle::new(n),
            work: vec![0.0; n],
            first_trial: true,
        }
    }

    /// True if the last step was a full Gauss-Newton step.
    fn is_undamped(&self) -> bool {
        self.lambda == 0.0
    }

    /// True if the radius is below `tolerance` times the scaled length of the parameters.
    fn is_below(&self, tolerance: f64, size: f64) -> bool {
        self.radius.is_some_and(|radius| radius <= tolerance * size)
    }

    /// Starts from the scaled length of the parameters, once.
    fn begin(&mut self, size: f64) {
        self.radius
            .get_or_insert(if size > 0.0 { FIRST * size } else { FIRST });
    }

    /// Fills the step that minimises the linear model within the radius.
    fn step(&mut self, triangle: &Triangle, d: &[f64], p: &mut [f64]) {
        let radius = self.radius.unwrap_or(FIRST);
        let regular = triangle.is_solvable();
        // A singular system is damped at the level of rounding in its null space.
        let mut lower = if regular {
            0.0
        } else {
            (f64::EPSILON * d.len() as f64).powi(2)
        };
        if regular {
            triangle.minimiser(p);
            let length = scaled_length(d, p);
            if length <= (1.0 + SLACK) * radius {
                (self.lambda, self.length) = (0.0, length);
                return;
            }
            let slope = self.slope(triangle, d, p, length);
            lower = (length - radius) / radius * slope;
        }
        triangle.gradient(p);
        let upper = p
            .iter()
            .zip(d)
            .map(|(g, d)| (g / d).powi(2))
            .sum::<f64>()
            .sqrt()
            / radius;
        self.search(triangle, d, p, radius, lower, upper.max(lower));
    }

    fn search(
        &mut self,
        triangle: &Triangle,
        d: &[f64],
        p: &mut [f64],
        radius: f64,
        floor: f64,
        mut upper: f64,
    ) {
        let mut lower = floor;
        let mut lambda = self.lambda.clamp(lower, upper);
        if lambda == 0.0 {
            lambda = 1e-3 * upper;
        }
        for _ in 0..MOST_TRIALS {
            self.damp(triangle, d, lambda);
            self.damped.minimiser(p);
            let length = scaled_length(d, p);
            (self.lambda, self.length) = (lambda, length);
            let excess = length - radius;
            if excess.abs() <= SLACK * radius || (excess < 0.0 && lambda <= floor) || length == 0.0
            {
                return;
            }
            if excess > 0.0 {
                lower = lower.max(lambda);
            } else {
                upper = upper.min(lambda);
            }
            let damped = std::mem::replace(&mut self.damped, Triangle::new(0));
            let slope = self.slope(&damped, d, p, length);
            self.damped = damped;
            lambda = (lambda + excess / radius * slope).max(lower);
            if lambda > upper {
                lambda = (lower * upper).sqrt().max(1e-3 * upper);
            }
        }
        let shorter = (radius / self.length).min(1.0);
        p.iter_mut().for_each(|p| *p *= shorter);
        self.length *= shorter;
    }

    /// `1 / |R^-T D^2 p / |D p||^2`, from the derivative of `|D p(lambda)|`.
    fn slope(&mut self, triangle: &Triangle, d: &[f64], p: &[f64], length: f64) -> f64 {
        let work = &mut self.work[..d.len()];
        for ((w, d), p) in work.iter_mut().zip(d).zip(p) {
            *w = d * (d * p / length);
        }
        triangle.solve_transposed(work);
        1.0 / work.iter().map(|w| w * w).sum::<f64>()
    }

    /// The triangle of `[R; sqrt(lambda) D]`.
    fn damp(&mut self, triangle: &Triangle, d: &[f64], lambda: f64) {
        self.damped.copy_from(triangle);
        let root = lambda.sqrt();
        for (j, d) in d.iter().enumerate() {
            self.damped.push(|row| {
                row.fill(0.0);
                row[j] = root * d;
            });
        }
        self.damped.fold();
    }

    /// The reduction promised by the last step, for a residual of length `norm`; `image` is `R p`.
    fn promise(&self, image: &[f64], norm: f64) -> Promise {
        let linear = image.iter().map(|v| (v / norm).powi(2)).sum::<f64>();
        let damping = self.lambda * (self.length / norm).powi(2);
        Promise {
            reduction: linear + 2.0 * damping,
            slope: -(linear + damping),
        }
    }

    /// Adapts the radius to the actual relative reduction (minus infinity if the cost rose much or is not finite); true
    /// if the step is good enough.
    fn learn(&mut self, promise: Promise, actual: f64) -> bool {
        let radius = self.radius.unwrap_or(FIRST);
        let radius = if std::mem::take(&mut self.first_trial) {
            radius.min(self.length)
        } else {
            radius
        };
        let ratio = if promise.reduction > 0.0 {
            actual / promise.reduction
        } else {
            0.0
        };
        self.radius = Some(radius);
        if ratio <= 0.25 {
            let shrink = shrinkage(promise.slope, actual);
            self.radius = Some(shrink * radius.min(self.length / 0.1));
            self.lambda /= shrink;
        } else if self.lambda == 0.0 || ratio >= 0.75 {
            self.radius = Some(self.length / 0.5);
            self.lambda *= 0.5;
        }
        ratio >= LEAST_GAIN
    }
}

/// The minimum of the parabola through both costs and the slope, clipped to 0.1 to 0.5.
fn shrinkage(slope: f64, actual: f64) -> f64 {
    if actual >= 0.0 {
        return 0.5;
    }
    (0.5 * slope / (slope + 0.5 * actual)).clamp(0.1, 0.5)
}

/// `|D p|`.
fn scaled_length(d: &[f64], p: &[f64]) -> f64 {
    d.iter()
        .zip(p)
        .map(|(d, p)| (d * p).powi(2))
        .sum::<f64>()
        .sqrt()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn triangle_of(rows: &[[f64; 4]]) -> Triangle {
        let mut triangle = Triangle::new(3);
        for row in rows {
            triangle.push(|out| out.copy_from_slice(row));
        }
        triangle.fold();
        triangle
    }

    proptest! {
        #[test]
        fn a_step_fills_the_region_and_no_shorter_one_is_better(
            rows in prop::collection::vec(prop::array::uniform4(-5.0..5.0f64), 3..20),
            reach in 1e-3..10.0f64,
            direction in prop::array::uniform3(-1.0..1.0f64),
        ) {
            let (triangle, d) = (triangle_of(&rows), [1.0, 2.0, 0.5]);
            let mut radius = Radius::new(3);
            radius.radius = Some(reach);
            let mut p = [0.0; 3];
            radius.step(&triangle, &d, &mut p);
            let length = scaled_length(&d, &p);
            prop_assert!(length <= 1.11 * reach);
            prop_assert!(radius.is_undamped() || length >= 0.89 * reach || !triangle.seems_regular());
            let model = |p: &[f64]| rows.iter()
                .map(|r| (r[3] + r[0] * p[0] + r[1] * p[1] + r[2] * p[2]).powi(2)).sum::<f64>();
            let scale = length / scaled_length(&d, &direction).max(1e-9);
            let other = direction.map(|v| v * scale * 0.999);
            prop_assert!(model(&p) <= model(&other) * (1.0 + 1e-9) + 1e-9);
        }
    }

    #[test]
    fn follows_success_and_failure() {
        let triangle = triangle_of(&[
            [1.0, 0.0, 0.0, -1.0],
            [0.0, 1.0, 0.0, -1.0],
            [0.0, 0.0, 1.0, -1.0],
        ]);
        let mut radius = Radius::new(3);
        radius.begin(0.5);
        let (mut p, mut image, d) = ([0.0; 3], [0.0; 3], [1.0; 3]);
        radius.step(&triangle, &d, &mut p);
        triangle.times(&p, &mut image);
        let promise = radius.promise(&image, 3f64.sqrt());
        let model = 1.0 - p.iter().map(|p| (1.0 - p).powi(2)).sum::<f64>() / 3.0;
        assert!((promise.reduction - model).abs() < 1e-12);
        assert!(radius.learn(promise, promise.reduction) && !radius.is_below(0.9, 1.0));
        assert!(!radius.learn(promise, f64::NEG_INFINITY) && radius.is_below(0.2, 1.0));
    }
}
