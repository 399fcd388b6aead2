//! The trust-region method: scaling, steps within radius and bounds, tests that call for confirmation.

use super::point::{Point, nonzero};
use super::radius::{Promise, Radius, scaled_length};
use super::{Residuals, Settings};
use crate::Monitor;
use crate::descent::{Method, Outcome, Proposal, Termination, Verdict};

/// Relative reduction that the cost cannot show reliably: from here on steps are judged by their size.
const UNSEEN: f64 = 1e-10;
/// Confirmations in a row that fail before the failure is believed, and the share of the cost below which the row ends.
const PATIENCE: usize = 5;
const PROGRESS: f64 = 0.9;

/// Residuals, where the iteration stands, and the trust region.
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
    /// `D` over all parameters.
    scale: Vec<f64>,
    /// `D`, step and its image in the free ones.
    d: Vec<f64>,
    step: Vec<f64>,
    image: Vec<f64>,
    /// `|D theta|` of the free parameters.
    size: f64,
    /// Scaled length of an undamped step that has just been taken.
    full_step: Option<f64>,
    /// A test on cost or step held.
    called: bool,
    doubts: usize,
    /// Cost at the last confirmation that failed.
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

    /// True where the permitted evaluations are used up.
    pub fn is_spent(&self) -> bool {
        self.evaluations >= self.settings.max_evaluations
    }

    /// Jacobian and all that follows from it at the present point, without a change of the scaling.
    pub fn linearise_point(&mut self, theta: &[f64]) -> bool {
        let point = &mut self.point;
        self.jacobians += 1;
        point.is_linearised = self
            .problem
            .jacobian(theta, &point.residual, &mut point.jacobian)
            && point.digest(theta, self.settings);
        point.is_linearised
    }

    /// What ended the loop without a minimum is looked at once more: the end may be one that only the cost cannot see.
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

    /// Confirms a minimum, or says why the iteration should end without one; `level`: the residual is orthogonal to every
    /// column.
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

    /// True where the Gauss-Newton step is so small that the cost may not show it, or smaller than asked for.
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

    /// True where the last step was undamped and the next one is less than half as long: the iteration contracts.
    pub fn has_contracted(&mut self) -> bool {
        let step = &mut self.step[..self.point.free.len()];
        self.point.triangle.minimiser(step);
        let next = scaled_length(&self.d, step);
        self.full_step.is_some_and(|last| next <= 0.5 * last)
    }

    /// Fills the trial; where bounds cut the step, the linear model is asked again what it promises.
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
            // The largest norms so far: a column that vanishes must not set its parameter free (More 1978).
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
        // Beyond ten times the residual the parabola of the radius says nothing.
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
