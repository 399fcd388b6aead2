//! Levenberg-Marquardt on normal equations, with named outcomes.
//!
//! Minimises `1/2 |e(theta)|^2` through `(J'J + mu D) d = J'e`, with `J` the derivative of the model's output and
//! `e = y - yhat`. A trial costs a simulation; only an accepted step costs a Jacobian. `mu` is multiplied by 4 after a
//! rejected trial and divided by 5 after an accepted one (Levenberg 1944, Marquardt 1963).

use crate::Monitor;
use crate::descent::{Method, Proposal, Verdict, descend};
pub use crate::descent::{Outcome, Termination};
use crate::simd::{self, F64x8, Kernel};

/// The problem to minimise. `normal_equations` is only called at the parameters of the last successful `cost` and may
/// reuse its simulation.
pub trait Problem {
    /// Number of parameters.
    fn parameters(&self) -> usize;

    /// Cost at `theta`; `None` if the simulation diverges, leaves its constraints or is stopped.
    fn cost(&mut self, theta: &[f64]) -> Option<f64>;

    /// Cost at `theta` if it is below `limit`; may return `None` as soon as it cannot be.
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

    /// Fills `J'J` (row by row; the lower triangle is enough) and `J'e` at `theta`, both scaled like the cost.
    fn normal_equations(&mut self, theta: &[f64], jtj: &mut [f64], jte: &mut [f64]);
}

/// The matrix `D`, which `mu` multiplies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Damping {
    /// The unit matrix: for parameters of similar scale, such as the weights of a network.
    Identity,
    /// The diagonal of `J'J`: independent of the parameters' units.
    Diagonal,
}

/// When to stop, and how to damp.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Most Jacobians.
    pub max_iterations: usize,
    /// Kind of damping.
    pub damping: Damping,
    /// First `mu`.
    pub mu: f64,
    /// Largest cosine between the residual and a column of `J` that counts as zero.
    pub gradient_tolerance: f64,
    /// Relative step that counts as zero.
    pub step_tolerance: f64,
    /// Relative reduction of the cost that counts as none if it happens five times in a row.
    pub reduction_tolerance: f64,
    /// A step is taken back if it increases the trace of `J'J` by more than this factor.
    ///
    /// A model can become unstable between kinks that still bound its run (a friction that overshoots standstill). The
    /// run is then finite, but the sensitivities grow without bound and say nothing about the cost any more.
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

/// Slow iterations in a row that end the search.
const PATIENCE: usize = 5;
/// Rejected trials in a row that count as stalled: `mu` has then grown by a factor above 1e18.
const MOST_REJECTIONS: usize = 30;
/// Factor on the damping after a rejected trial.
const RAISE: f64 = 4.0;
/// Divisor of the damping after an accepted trial.
const GAIN: f64 = 5.0;
/// Least damping, so that a singular system stays solvable.
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
        // Asked once: a problem that takes two costs at once holds two simulations.
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

/// The step that would follow a rejection. If two costs at once take hardly longer than one, it is simulated together
/// with the present trial.
///
/// After a rejection `J'J` and `J'e` stay and `mu` grows by a known factor, so the next step is known before the present trial is judged.
/// A free run is a dependency chain that leaves units idle: one run takes 76 cycles a sample, two together 102. No decision changes, as
/// the second cost is only used if the first is rejected. The gain depends on the share of rejections: with 1.1 per iteration it is 3 %
/// (median) to 6 % (least of 7) of a training of 100 iterations; with hardly any rejections it is a loss of 3 %.
#[derive(Default)]
struct Next {
    two: bool,
    /// Its damping; 0 if no step is prepared.
    mu: f64,
    step: Vec<f64>,
    theta: Vec<f64>,
    /// Its cost, if that has been computed.
    cost: Option<Option<f64>>,
    /// The cost of the present trial, if it was simulated together with the last one.
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
        // This trial was simulated together with the last one, which was rejected.
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
        // The step was accepted: the step prepared for its rejection belongs to an old linearisation.
        self.next.mu = 0.0;
        let system = &mut self.system;
        self.problem
            .normal_equations(theta, &mut system.jtj, &mut system.jte);
        self.rejections = 0;
        true
    }

    fn takes_back(&mut self) -> bool {
        // Only the derivatives show it, one Jacobian too late: by its cost the step was good.
        let exploded = self.system.exploded(self.settings.most_growth);
        if exploded {
            // The step was accepted by its cost. Undo the division by GAIN, and raise the damping as after a rejection.
            self.mu *= GAIN * RAISE;
        }
        exploded
    }

    fn finished(&mut self, outcome: &mut Outcome) -> Option<Termination> {
        // The cosine between residual and columns has no unit (More 1978); J'e itself would depend on all scales.
        let cosine = self.system.largest_cosine(outcome.cost);
        (cosine <= self.settings.gradient_tolerance).then_some(Termination::SmallGradient)
    }

    fn propose(&mut self, theta: &[f64], trial: &mut [f64]) -> Proposal {
        // Bitwise equal if the damping was raised exactly once since: both are RAISE times the same number. After any
        // other change the prepared step is dropped.
        self.next.known = self.next.cost.take().filter(|_| self.next.mu == self.mu);
        self.next.mu = 0.0;
        if self.next.known.is_some() {
            self.system.step.copy_from_slice(&self.next.step);
        } else if !self.system.solve(self.mu, self.settings.damping) {
            // Not positive definite numerically: more damping makes it so, as after a rejection.
            return match self.reject() {
                Verdict::End(end) => Proposal::End(end),
                _ => Proposal::Again,
            };
        }
        let tolerance = self.settings.step_tolerance;
        // Relative to the parameters; the second `tolerance` is for parameters near 0.
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
        // Any decrease is accepted, and the factors are fixed: of ten random starts of a network 8 then ended near the
        // best cost, and only 1 with damping by the ratio of actual to promised decrease.
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
    /// Solves for the step that follows if the present one is rejected.
    fn prepare_next(&mut self, theta: &[f64]) {
        let mu = RAISE * self.mu;
        // `system.step` is free: the present trial has been written out of it.
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
/// With `e(theta + d) ~ e - J d` the quadratic model of the cost is least at `J'J d = J'e`. `mu D` bends the step from the Gauss-Newton
/// step (mu = 0) to a short one along the gradient (mu large), and keeps a singular system solvable. `J'J` is a sum over rows
/// ([`crate::gram`]) of n^2 numbers for any number of samples: a new factorisation for each mu costs n^3/6, little beside a simulation.
struct System {
    size: usize,
    // The undamped system is kept, and each solution is computed in `factor`: a rejected step costs a copy and a
    // factorisation.
    jtj: Vec<f64>,
    jte: Vec<f64>,
    /// `J'J` and `J'e` of the last point whose sensitivities had not exploded; empty without that test.
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

    /// Whether `J'J` exceeds the last one by more than this factor; if so, the last one is restored.
    fn exploded(&mut self, most_growth: f64) -> bool {
        if most_growth.is_infinite() {
            return false;
        }
        // The trace is the sum of squares of all sensitivities.
        let trace = |jtj: &[f64]| jtj.iter().step_by(self.size + 1).sum::<f64>();
        let (now, before) = (trace(&self.jtj), trace(&self.last.0));
        // NaN is tested separately: sensitivities may overflow even if the run does not.
        let exploded = !self.last.0.is_empty() && (now.is_nan() || now > most_growth * before);
        if exploded {
            // Those of the restored point: no Jacobian is computed again.
            self.jtj.copy_from_slice(&self.last.0);
            self.jte.copy_from_slice(&self.last.1);
        } else {
            self.last.0.clone_from(&self.jtj);
            self.last.1.clone_from(&self.jte);
        }
        exploded
    }

    fn largest_cosine(&self, cost: f64) -> f64 {
        // J'J and J'e are scaled like the cost: in that scale |e|^2 is 2 cost.
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

    /// Solves for the step by Cholesky; false if the damped matrix is not positive definite.
    fn solve(&mut self, mu: f64, damping: Damping) -> bool {
        let n = self.size;
        self.factor.copy_from_slice(&self.jtj);
        for i in 0..n {
            let diagonal = &mut self.factor[i * n + i];
            *diagonal += mu
                * match damping {
                    Damping::Identity => 1.0,
                    // mu D = mu diag(J'J): the same step for any units of the parameters. A column of zeros gets the
                    // least positive number: its pivot is then positive and its step 0/tiny = 0.
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

/// Replaces the lower triangle of `a` (row by row) by its Cholesky factor; false if `a` is not positive definite.
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
        // sum are contiguous; by columns they would not be.
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
    // Rows have length j: the remaining zero to seven products are added one by one.
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
    // L' x = b by columns of L', which are the rows of L: each x_i is subtracted from all before it as soon as it is
    // known. The transposed matrix is never traversed.
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

    /// A line that falls towards 3; its sensitivities explode beyond 2.
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
        // the first step leads to 2.997, where J'J = 1e9 allows no further step
        assert!(run(f64::INFINITY, 0.0).theta[0] > 2.99);
        let careful = run(1e3, 0.0);
        assert!(
            careful.theta[0] > 1.5 && careful.theta[0] < 2.9,
            "{careful:?}"
        );
        assert_eq!(careful.iterations, 40);
        // a start within the explosion has no point to return to
        assert!(run(1e3, 2.5).theta[0] > 2.4);
    }

    /// The valley, two costs at once; it returns only costs below the limit and counts the calls.
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
