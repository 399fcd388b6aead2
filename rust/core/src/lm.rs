//! Levenberg-Marquardt on normal equations, with named outcomes.
//!
//! Minimises `1/2 |e(theta)|^2` through `(J'J + mu D) d = J'e`, `J` being the derivative of the model's output and
//! `e = y - yhat`. A trial costs a simulation; only an accepted one costs a Jacobian. Damping: `mu` times 4 after a
//! rejected trial, divided by 5 after an accepted one (Levenberg 1944, Marquardt 1963).

use crate::Monitor;
use crate::descent::{Method, Proposal, Verdict, descend};
pub use crate::descent::{Outcome, Termination};
use crate::simd::{self, F64x8, Kernel};

/// What is minimised. `normal_equations` is only called at the parameters of the last successful `cost`, whose
/// simulation it may reuse.
pub trait Problem {
    /// Number of parameters.
    fn parameters(&self) -> usize;

    /// Cost at `theta`; none where the simulation diverges, leaves its constraints or is stopped.
    fn cost(&mut self, theta: &[f64]) -> Option<f64>;

    /// Cost at `theta`, where it is below `limit`; none may be told as soon as it cannot be.
    fn cost_below(&mut self, theta: &[f64], limit: f64) -> Option<f64> {
        let _ = limit;
        self.cost(theta)
    }

    /// Whether two costs at once take hardly longer than one.
    fn takes_two(&self) -> bool {
        false
    }

    /// [`Problem::cost_below`] at two points; `normal_equations` may follow at either.
    fn costs_below(&mut self, thetas: [&[f64]; 2], limit: f64) -> [Option<f64>; 2] {
        thetas.map(|theta| self.cost_below(theta, limit))
    }

    /// Fills `J'J` (row by row, the lower triangle is enough) and `J'e` at `theta`, scaled as the cost is.
    fn normal_equations(&mut self, theta: &[f64], jtj: &mut [f64], jte: &mut [f64]);
}

/// The matrix `D` that `mu` multiplies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Damping {
    /// The unit matrix: for parameters of one scale, such as weights of a network.
    Identity,
    /// The diagonal of `J'J`: indifferent to the parameters' units.
    Diagonal,
}

/// When to stop, and how to damp.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Jacobians at most.
    pub max_iterations: usize,
    /// Kind of damping.
    pub damping: Damping,
    /// First `mu`.
    pub mu: f64,
    /// Largest cosine between the residual and a column of `J` that counts as zero.
    pub gradient_tolerance: f64,
    /// Relative step that counts as zero.
    pub step_tolerance: f64,
    /// Relative reduction of the cost that counts as none, five times in a row.
    pub reduction_tolerance: f64,
    /// A step after which the trace of `J'J` is larger by more than this factor is taken back.
    ///
    /// Where a model has become unstable between kinks that hold it (a friction that overshoots the standstill), its run
    /// is still finite, and the sensitivities grow without end: they say nothing of the cost any more.
    pub most_growth: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_iterations: 100,
            damping: Damping::Diagonal,
            mu: 1e-3,
            gradient_tolerance: 1e-10,
            step_tolerance: 1e-12,
            reduction_tolerance: 1e-10,
            most_growth: f64::INFINITY,
        }
    }
}

/// Slow iterations in a row that count as the end of progress.
const PATIENCE: usize = 5;
/// Rejected trials in a row that count as stalled: `mu` has then grown by more than 1e18.
const MOST_REJECTIONS: usize = 30;
/// What a rejected trial multiplies the damping by.
const RAISE: f64 = 4.0;
/// What an accepted trial divides it by.
const GAIN: f64 = 5.0;
/// Damping never falls below this, so that a singular system stays solvable.
const LEAST_MU: f64 = 1e-14;

/// Minimises `problem` from `start`; `accepted(theta, cost)` sees the start and each accepted step.
pub fn minimize(
    problem: &mut impl Problem,
    start: Vec<f64>,
    settings: &Settings,
    monitor: &Monitor,
    accepted: impl FnMut(&[f64], f64),
) -> Outcome {
    let mut method = Marquardt {
        system: System::new(problem.parameters()),
        // Asked once: a problem that takes two has the room for two simulations.
        next: Next {
            two: problem.takes_two(),
            ..Next::default()
        },
        problem,
        settings,
        mu: settings.mu,
        slow: 0,
        rejections: 0,
    };
    descend(
        &mut method,
        start,
        settings.max_iterations,
        monitor,
        accepted,
    )
}

/// The step that follows a rejection: where two costs at once take hardly longer than one, it is tried beside the one
/// before it.
///
/// After a rejection `J'J` and `J'e` stay and only `mu` grows, by a known factor: the next step is known before the trial at hand is
/// judged. A free run is a chain that leaves units idle, so two of them take 102 cycles a sample where one takes 76. No decision
/// changes, for the second cost is looked at only after the first is rejected. It pays by the share of rejections: with 1.1 of them an
/// iteration, 3 % (median) to 6 % (least of 7) of a training of 100 iterations; where hardly a step is rejected it costs 3 %.
#[derive(Default)]
struct Next {
    two: bool,
    /// Its damping; 0 where there is none.
    mu: f64,
    step: Vec<f64>,
    theta: Vec<f64>,
    /// Its cost, where that has been taken.
    cost: Option<Option<f64>>,
    /// The cost of the trial at hand, where it was tried beside the last one.
    known: Option<Option<f64>>,
}

/// Normal equations whose damping follows success and failure by fixed factors.
struct Marquardt<'a, P> {
    problem: &'a mut P,
    system: System,
    next: Next,
    settings: &'a Settings,
    mu: f64,
    /// Iterations in a row that gained nothing.
    slow: usize,
    /// Trials in a row that were rejected.
    rejections: usize,
}

impl<P: Problem> Method for Marquardt<'_, P> {
    fn parameters(&self) -> usize {
        self.problem.parameters()
    }

    fn cost(&mut self, theta: &[f64]) -> Option<f64> {
        self.problem.cost(theta)
    }

    fn trial_cost(&mut self, theta: &[f64], before: f64) -> Option<f64> {
        // This trial was simulated beside the last one, which was rejected.
        if let Some(cost) = self.next.known.take() {
            return cost;
        }
        if self.next.mu == 0.0 {
            return self.problem.cost_below(theta, before);
        }
        let [cost, next] = self.problem.costs_below([theta, &self.next.theta], before);
        self.next.cost = Some(next);
        cost
    }

    fn linearise(&mut self, theta: &[f64]) -> bool {
        // An accepted step: the step that was prepared for its rejection is of another linearisation.
        self.next.mu = 0.0;
        let system = &mut self.system;
        self.problem
            .normal_equations(theta, &mut system.jtj, &mut system.jte);
        self.rejections = 0;
        true
    }

    fn takes_back(&mut self) -> bool {
        // Seen from the derivatives only, and so one Jacobian late: by its cost the step was a good one.
        let exploded = self.system.exploded(self.settings.most_growth);
        if exploded {
            // the step was accepted by its cost: its damping is raised as if it had not been
            // Divided by GAIN when it was accepted; that, and the rise of a rejection.
            self.mu *= GAIN * RAISE;
        }
        exploded
    }

    fn finished(&mut self, outcome: &mut Outcome) -> Option<Termination> {
        // Of the angle between residual and columns, which has no unit (More 1978): J'e itself would depend on the
        // scales of all.
        let cosine = self.system.largest_cosine(outcome.cost);
        (cosine <= self.settings.gradient_tolerance).then_some(Termination::SmallGradient)
    }

    fn propose(&mut self, theta: &[f64], trial: &mut [f64]) -> Proposal {
        // Equal to the bit where the damping was raised once since: both are RAISE times the same number. Anything else
        // in between, and the prepared step is dropped.
        self.next.known = self.next.cost.take().filter(|_| self.next.mu == self.mu);
        self.next.mu = 0.0;
        if self.next.known.is_some() {
            self.system.step.copy_from_slice(&self.next.step);
        } else if !self.system.solve(self.mu, self.settings.damping) {
            // Not positive definite to the digits at hand: more damping makes it so, as a rejection does.
            return match self.reject() {
                Verdict::End(end) => Proposal::End(end),
                _ => Proposal::Again,
            };
        }
        let tolerance = self.settings.step_tolerance;
        // Relative to the parameters, with the tolerance once more for those near 0.
        if length(&self.system.step) <= tolerance * (length(theta) + tolerance) {
            return Proposal::End(Termination::SmallStep);
        }
        for ((trial, theta), step) in trial.iter_mut().zip(theta).zip(&self.system.step) {
            *trial = theta + step;
        }
        if self.next.two && self.next.known.is_none() {
            self.prepare_next(theta);
        }
        Proposal::Trial
    }

    fn judge(&mut self, before: f64, after: Option<f64>) -> Verdict {
        // Any decrease is accepted, and the factors are fixed: of ten random starts of a network 8 ended near the best cost so,
        // and 1 with a damping by the ratio of the decrease to the promised one.
        if after.is_some_and(|cost| cost < before) {
            self.mu = (self.mu / GAIN).max(LEAST_MU);
            return Verdict::Accepted;
        }
        self.reject()
    }

    fn settled(&mut self, before: f64, after: f64) -> Option<Termination> {
        let gained = (before - after) > self.settings.reduction_tolerance * before;
        self.slow = if gained { 0 } else { self.slow + 1 };
        (self.slow == PATIENCE).then_some(Termination::SmallReduction)
    }
}

impl<P> Marquardt<'_, P> {
    /// Solves for the step that follows if the one at hand is rejected.
    fn prepare_next(&mut self, theta: &[f64]) {
        let mu = RAISE * self.mu;
        // `system.step` is free: the trial at hand has been written out of it.
        if !self.system.solve(mu, self.settings.damping) {
            return;
        }
        let Next {
            step, theta: next, ..
        } = &mut self.next;
        step.clone_from(&self.system.step);
        next.clear();
        next.extend(theta.iter().zip(step).map(|(theta, step)| theta + *step));
        self.next.mu = mu;
    }

    fn reject(&mut self) -> Verdict {
        self.mu *= RAISE;
        self.rejections += 1;
        if self.rejections == MOST_REJECTIONS {
            return Verdict::End(Termination::Stalled);
        }
        Verdict::Rejected
    }
}

fn length(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// The damped normal equations with all buffers of an iteration.
///
/// From `e(theta + d) ~ e - J d` the cost's quadratic model is least where `J'J d = J'e`; `mu D` bends the step from Gauss and Newton's
/// (mu = 0) to a short one along the gradient (mu large), and keeps a singular system solvable. `J'J` is at hand as a sum over rows
/// ([`crate::gram`]), n^2 numbers whatever the samples, so a factorisation anew for each mu costs n^3/6, nothing beside a simulation.
struct System {
    size: usize,
    // The undamped system stays as it is, and each solution is made in `factor`: a rejected step costs a copy and a
    // factorisation.
    jtj: Vec<f64>,
    jte: Vec<f64>,
    /// `J'J` and `J'e` of the last point whose sensitivities had not exploded, where that is asked.
    last: (Vec<f64>, Vec<f64>),
    factor: Vec<f64>,
    step: Vec<f64>,
}

impl System {
    fn new(size: usize) -> Self {
        Self {
            size,
            jtj: vec![0.0; size * size],
            jte: vec![0.0; size],
            last: (Vec::new(), Vec::new()),
            factor: vec![0.0; size * size],
            step: vec![0.0; size],
        }
    }

    /// Whether `J'J` is larger than the last one by more than this factor, which is then put back in its place.
    fn exploded(&mut self, most_growth: f64) -> bool {
        if most_growth.is_infinite() {
            return false;
        }
        // The trace is the sum of squares of all sensitivities.
        let trace = |jtj: &[f64]| jtj.iter().step_by(self.size + 1).sum::<f64>();
        let (now, before) = (trace(&self.jtj), trace(&self.last.0));
        // NaN is compared apart: sensitivities may overflow where the run does not.
        let exploded = !self.last.0.is_empty() && (now.is_nan() || now > most_growth * before);
        if exploded {
            self.jtj.copy_from_slice(&self.last.0);
            self.jte.copy_from_slice(&self.last.1);
        } else {
            self.last.0.clone_from(&self.jtj);
            self.last.1.clone_from(&self.jte);
        }
        exploded
    }

    fn largest_cosine(&self, cost: f64) -> f64 {
        // J'J and J'e are scaled as the cost is: 2 cost is |e|^2 in that scale.
        let residual = (2.0 * cost).sqrt();
        let cosine = |i: usize| {
            let column = self.jtj[i * self.size + i].sqrt();
            if column > 0.0 {
                self.jte[i].abs() / (column * residual)
            } else {
                0.0
            }
        };
        (0..self.size).map(cosine).fold(0.0, f64::max)
    }

    /// Solves for the step by Cholesky; false where the damped matrix is not positive definite.
    fn solve(&mut self, mu: f64, damping: Damping) -> bool {
        let n = self.size;
        self.factor.copy_from_slice(&self.jtj);
        for i in 0..n {
            let diagonal = &mut self.factor[i * n + i];
            *diagonal += mu
                * match damping {
                    Damping::Identity => 1.0,
                    // mu D = mu diag(J'J): the same step whatever the units of the parameters. A column of zeros gets
                    // the least positive number, so that its pivot is positive and its step 0/tiny = 0.
                    Damping::Diagonal => diagonal.max(f64::MIN_POSITIVE),
                };
        }
        self.step.copy_from_slice(&self.jte);
        cholesky(&mut self.factor, n) && {
            substitute(&self.factor, n, &mut self.step);
            true
        }
    }
}

/// Replaces the lower triangle of `a` (row by row) by its Cholesky factor; false where `a` is not positive definite.
pub(crate) fn cholesky(a: &mut [f64], n: usize) -> bool {
    simd::run(Cholesky { a, n })
}

struct Cholesky<'a> {
    a: &'a mut [f64],
    n: usize,
}

impl Kernel for Cholesky<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<V: F64x8>(self) -> bool {
        let Self { a, n } = self;
        // Row by row (Cholesky-Banachiewicz): L_ij = (a_ij - sum_k L_ik L_jk)/L_jj. In row order both operands of the
        // sum are contiguous, which is why it is this variant and not the one by columns.
        for i in 0..n {
            let (above, row) = a.split_at_mut(i * n);
            for j in 0..i {
                let other = &above[j * n..j * n + j + 1];
                row[j] = (row[j] - dot::<V>(&row[..j], &other[..j])) / other[j];
            }
            // L_ii^2 = a_ii - sum L_ik^2.
            let pivot = row[i] - dot::<V>(&row[..i], &row[..i]);
            // Written so that NaN is refused too.
            if !(pivot > 0.0 && pivot.is_finite()) {
                return false;
            }
            row[i] = pivot.sqrt();
        }
        true
    }
}

/// The sum of products, eight at a time.
#[inline(always)]
fn dot<V: F64x8>(a: &[f64], b: &[f64]) -> f64 {
    // Rows of length j: the rest of up to seven is added at the end, one by one.
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks(), b.as_chunks());
    let sum = a.iter().zip(b).fold(V::splat(0.0), |sum, (a, b)| {
        sum.add_product(V::load(a), V::load(b))
    });
    let rest = a_rest.iter().zip(b_rest).map(|(a, b)| a * b);
    sum.sum() + rest.sum::<f64>()
}

/// Solves `L L' x = b` in place.
pub(crate) fn substitute(factor: &[f64], n: usize, x: &mut [f64]) {
    for i in 0..n {
        let dot: f64 = factor[i * n..i * n + i]
            .iter()
            .zip(&*x)
            .map(|(l, x)| l * x)
            .sum();
        x[i] = (x[i] - dot) / factor[i * n + i];
    }
    // L' x = b by columns of L', which are rows of L: as soon as x_i is known it is taken off all before it. No
    // transposed matrix is walked through.
    for i in (0..n).rev() {
        x[i] /= factor[i * n + i];
        let value = x[i];
        for (x, l) in x[..i].iter_mut().zip(&factor[i * n..i * n + i]) {
            *x -= l * value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley as residuals `10 (x1 - x0^2)` and `1 - x0` (More, Garbow and Hillstrom 1981, problem 1).
    struct Valley;

    impl Problem for Valley {
        fn parameters(&self) -> usize {
            2
        }

        fn cost(&mut self, t: &[f64]) -> Option<f64> {
            let e = [-10.0 * (t[1] - t[0] * t[0]), t[0] - 1.0];
            Some(0.5 * (e[0] * e[0] + e[1] * e[1]))
        }

        fn normal_equations(&mut self, t: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
            let e = [-10.0 * (t[1] - t[0] * t[0]), 1.0 - t[0]];
            let j = [[-20.0 * t[0], 10.0], [1.0, 0.0]];
            for a in 0..2 {
                jte[a] = j[0][a] * e[0] + j[1][a] * e[1];
                for b in 0..2 {
                    jtj[a * 2 + b] = j[0][a] * j[0][b] + j[1][a] * j[1][b];
                }
            }
        }
    }

    fn run(damping: Damping, max_iterations: usize) -> Outcome {
        let settings = Settings {
            damping,
            max_iterations,
            ..Settings::default()
        };
        minimize(
            &mut Valley,
            vec![-1.2, 1.0],
            &settings,
            &Monitor::default(),
            |_, _| {},
        )
    }

    #[test]
    fn finds_the_minimum_and_names_its_end() {
        for damping in [Damping::Identity, Damping::Diagonal] {
            let outcome = run(damping, 200);
            assert!((outcome.theta[0] - 1.0).abs() < 1e-8, "{outcome:?}");
            assert!(outcome.trace.windows(2).all(|w| w[1] < w[0]));
            assert_ne!(outcome.termination, Termination::MaxIterations);
        }
        assert_eq!(
            run(Damping::Identity, 2).termination,
            Termination::MaxIterations
        );
    }

    /// A line that falls towards 3, whose sensitivities explode beyond 2.
    struct Cliff;

    impl Problem for Cliff {
        fn parameters(&self) -> usize {
            1
        }

        fn cost(&mut self, t: &[f64]) -> Option<f64> {
            Some(0.5 * (3.0 - t[0]) * (3.0 - t[0]))
        }

        fn normal_equations(&mut self, t: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
            jtj[0] = if t[0] > 2.0 { 1e9 } else { 1.0 };
            jte[0] = 3.0 - t[0];
        }
    }

    #[test]
    fn takes_back_a_step_into_exploding_sensitivities() {
        let run = |most_growth: f64, start: f64| {
            let settings = Settings {
                damping: Damping::Identity,
                max_iterations: 40,
                most_growth,
                ..Settings::default()
            };
            let none = Monitor::default();
            minimize(&mut Cliff, vec![start], &settings, &none, |_, _| {})
        };
        // the first step leads to 2.997, and 1e9 in its place leads nowhere
        assert!(run(f64::INFINITY, 0.0).theta[0] > 2.99);
        let careful = run(1e3, 0.0);
        assert!(
            careful.theta[0] > 1.5 && careful.theta[0] < 2.9,
            "{careful:?}"
        );
        assert_eq!(careful.iterations, 40);
        // a start within the explosion has nothing to go back to
        assert!(run(1e3, 2.5).theta[0] > 2.4);
    }

    /// The valley, two costs at once; it tells only those below the limit and counts the calls.
    struct Twice(usize);

    impl Problem for Twice {
        fn parameters(&self) -> usize {
            2
        }

        fn cost(&mut self, t: &[f64]) -> Option<f64> {
            self.0 += 1;
            Valley.cost(t)
        }

        fn takes_two(&self) -> bool {
            true
        }

        fn costs_below(&mut self, thetas: [&[f64]; 2], limit: f64) -> [Option<f64>; 2] {
            self.0 += 1;
            thetas.map(|t| Valley.cost(t).filter(|cost| *cost < limit))
        }

        fn normal_equations(&mut self, t: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
            Valley.normal_equations(t, jtj, jte);
        }
    }

    #[test]
    fn two_costs_at_once_change_nothing_but_the_number_of_calls() {
        for damping in [Damping::Identity, Damping::Diagonal] {
            let one = run(damping, 200);
            let settings = Settings {
                damping,
                max_iterations: 200,
                ..Settings::default()
            };
            let mut twice = Twice(0);
            let start = vec![-1.2, 1.0];
            let two = minimize(&mut twice, start, &settings, &Monitor::default(), |_, _| {});
            assert_eq!((&one.theta, &one.trace), (&two.theta, &two.trace));
            assert_eq!((one.trials, one.termination), (two.trials, two.termination));
            assert!(twice.0 < one.trials + 1, "{} {}", twice.0, one.trials);
        }
    }

    #[test]
    fn names_a_start_without_a_cost_and_a_stop() {
        let settings = Settings::default();
        let start = vec![f64::NAN, 0.0];
        let bad = minimize(
            &mut Valley,
            start,
            &settings,
            &Monitor::default(),
            |_, _| {},
        );
        assert_eq!(bad.termination, Termination::NotFinite);
        let monitor = Monitor::default();
        monitor.request_stop();
        let stopped = minimize(&mut Valley, vec![0.0; 2], &settings, &monitor, |_, _| {});
        assert_eq!(stopped.termination, Termination::Interrupted);
        assert_eq!(stopped.theta, [0.0; 2]);
    }

    #[test]
    fn factors_and_solves() {
        let mut a = vec![4.0, 0.0, 2.0, 3.0];
        assert!(cholesky(&mut a, 2));
        let mut x = vec![10.0, 8.0];
        substitute(&a, 2, &mut x);
        assert!((x[0] - 1.75).abs() < 1e-14 && (x[1] - 1.5).abs() < 1e-14);
        assert!(!cholesky(&mut [1.0, 0.0, 2.0, 1.0], 2));
    }
}
