//! The one loop of every least-squares fit: linearise, test, try damped steps until one lowers the cost.
//!
//! The [`Method`] says what a linearisation is and how damping follows success and failure: normal equations with
//! Marquardt's factors ([`crate::lm`]), or a triangle with a trust region ([`crate::least_squares`]).
//!
//! ```text
//!   cost(start), keep
//!   repeat                         iterate
//!     linearise                    one Jacobian
//!     finished?                    tests for a minimum
//!     repeat                       improve
//!       propose a step             for the damping at hand
//!       cost of the trial          one simulation
//!       judge                      accept: damping falls, keep; reject: damping grows
//!     settled?                     no progress any more
//! ```
//!
//! The loop owns the outcome (theta, cost, trace); the method owns its linearisation and its damping. `keep` tells the
//! method to linearise at the point of its last cost, so nothing is simulated twice.

use crate::Monitor;

/// How the iteration ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Termination {
    /// The residual is orthogonal to the Jacobian: a minimum.
    SmallGradient,
    /// The step no longer changes the parameters.
    SmallStep,
    /// The cost no longer falls.
    SmallReduction,
    /// The permitted iterations are used up.
    MaxIterations,
    /// The permitted evaluations are used up.
    MaxEvaluations,
    /// No damping gave a lower cost.
    Stalled,
    /// The cost no longer falls, but parameters that it hardly depends on still move.
    Flat,
    /// The cost cannot be lowered, but some combination of parameters does not change the residuals.
    RankDeficient,
    /// The gradient is zero where the cost curves downwards.
    Saddle,
    /// The start, or the Jacobian at the present point, is not finite.
    NotFinite,
    /// A stop was requested.
    Interrupted,
}

impl Termination {
    /// The name used in files and in Python.
    pub fn name(self) -> &'static str {
        match self {
            Self::SmallGradient => "small_gradient",
            Self::SmallStep => "small_step",
            Self::SmallReduction => "small_reduction",
            Self::MaxIterations => "max_iterations",
            Self::MaxEvaluations => "max_evaluations",
            Self::Stalled => "stalled",
            Self::Flat => "flat",
            Self::RankDeficient => "rank_deficient",
            Self::Saddle => "saddle",
            Self::NotFinite => "not_finite",
            Self::Interrupted => "interrupted",
        }
    }

    /// What a user can do about it.
    pub fn remedy(self) -> &'static str {
        match self {
            Self::SmallGradient | Self::SmallStep | Self::SmallReduction => {
                "converged; nothing to do"
            }
            Self::MaxIterations => {
                "allow more iterations if the trace still falls; for a network this is the usual end"
            }
            Self::MaxEvaluations => {
                "raise max_nfev if the trace still falls, or start nearer to the answer"
            }
            Self::Stalled => {
                "the best point found is kept; try more starts, a smaller model or better scaled data"
            }
            Self::Flat => {
                "a parameter may be running to infinity or the data do not fix it: look at standard_errors, set bounds, start elsewhere or drop it"
            }
            Self::RankDeficient => {
                "the data do not fix every parameter: look for infinite standard_errors, fix or drop those, add data, or start elsewhere"
            }
            Self::Saddle => "the start lies on a ridge or a symmetry of the cost: start beside it",
            Self::NotFinite => {
                "start from other parameters, scale the data, or use a stable linear model as start"
            }
            Self::Interrupted => "the best result so far is kept; run again to go on",
        }
    }

    /// True if a test for a minimum ended the iteration.
    pub fn is_converged(self) -> bool {
        matches!(
            self,
            Self::SmallGradient | Self::SmallStep | Self::SmallReduction
        )
    }
}

/// The best parameters found, and how.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Best parameters.
    pub theta: Vec<f64>,
    /// Their cost.
    pub cost: f64,
    /// Jacobians computed by the loop.
    pub iterations: usize,
    /// Steps tried, accepted or not.
    pub trials: usize,
    /// How it ended.
    pub termination: Termination,
    /// Cost at the start and after each accepted step.
    pub trace: Vec<f64>,
}

/// What a method proposes next.
pub(crate) enum Proposal {
    /// The trial is filled in.
    Trial,
    /// No step with this damping: ask again.
    Again,
    /// Nothing left to try.
    End(Termination),
}

/// The verdict on a trial.
pub(crate) enum Verdict {
    Accepted,
    Rejected,
    /// Rejected, and nothing left to try.
    End(Termination),
}

/// A problem with a linearisation and a damping policy. `Method` must make sure that every loop over proposals ends.
pub(crate) trait Method {
    fn parameters(&self) -> usize;

    /// Cost at `theta`; `None` if it is not finite or not allowed, or if a stop was requested.
    fn cost(&mut self, theta: &[f64]) -> Option<f64>;

    /// Cost at `theta` if it is below `before`; may return `None` as soon as it cannot be.
    fn trial_cost(&mut self, theta: &[f64], _before: f64) -> Option<f64> {
        self.cost(theta)
    }

    /// Makes the point of the last cost the present one.
    // Costs and Jacobians share a simulation: this tells the method which simulated point to linearise.
    fn keep(&mut self) {}

    /// Linearises at the present point; false if the result is not finite.
    fn linearise(&mut self, theta: &[f64]) -> bool;

    /// Whether the derivatives at the present point are of no use; the method has then restored those of the point before.
    fn takes_back(&mut self) -> bool {
        false
    }

    /// The tests that end the iteration; they may refine the outcome.
    // Before a step: at a minimum a step is not worth its simulations. `settled`, after the step, sees what it gained.
    fn finished(&mut self, outcome: &mut Outcome) -> Option<Termination>;

    fn propose(&mut self, theta: &[f64], trial: &mut [f64]) -> Proposal;

    /// Compares costs and adapts the damping.
    fn judge(&mut self, before: f64, after: Option<f64>) -> Verdict;

    /// Whether an accepted step was the last one worth taking.
    fn settled(&mut self, _before: f64, _after: f64) -> Option<Termination> {
        None
    }
}

/// Descends from `start`; `accepted(theta, cost)` sees the start and each accepted step.
pub(crate) fn descend(
    method: &mut impl Method,
    start: Vec<f64>,
    max_iterations: usize,
    monitor: &Monitor,
    mut accepted: impl FnMut(&[f64], f64),
) -> Outcome {
    let mut outcome = Outcome {
        cost: f64::INFINITY,
        theta: start,
        iterations: 0,
        trials: 0,
        termination: Termination::NotFinite,
        // A limit of a million iterations must not reserve memory that is never used.
        trace: Vec::with_capacity(max_iterations.min(1000) + 1),
    };
    // A start without a finite cost has no direction to go. That is an outcome, not an error: it may be one of many
    // starts.
    match method.cost(&outcome.theta) {
        Some(cost) if cost.is_finite() => outcome.cost = cost,
        _ => {
            if monitor.stopped() {
                outcome.termination = Termination::Interrupted;
            }
            return outcome;
        }
    }
    method.keep();
    outcome.trace.push(outcome.cost);
    accepted(&outcome.theta, outcome.cost);
    outcome.termination = iterate(method, &mut outcome, max_iterations, monitor, &mut accepted);
    outcome
}

fn iterate(
    method: &mut impl Method,
    outcome: &mut Outcome,
    max_iterations: usize,
    monitor: &Monitor,
    accepted: &mut impl FnMut(&[f64], f64),
) -> Termination {
    // One vector for all trials: an iteration allocates nothing.
    let mut trial = vec![0.0; method.parameters()];
    // For methods that take a step back after seeing its derivatives.
    let (mut last, mut last_cost) = (outcome.theta.clone(), outcome.cost);
    for _ in 0..max_iterations {
        // Once per iteration: a rejected trial needs no Jacobian.
        let finite = method.linearise(&outcome.theta);
        if finite && method.takes_back() {
            // The step's cost was accepted, but its sensitivities are of no use to go on from.
            outcome.theta.copy_from_slice(&last);
            outcome.cost = last_cost;
        } else {
            last.copy_from_slice(&outcome.theta);
            last_cost = outcome.cost;
        }
        // Checked after the Jacobian: a stop request ends its computation early and leaves it unusable.
        if monitor.stopped() {
            return Termination::Interrupted;
        }
        // The Jacobian can overflow even if the run did not: the point stays the best one.
        if !finite {
            return Termination::NotFinite;
        }
        outcome.iterations += 1;
        monitor.advance(1);
        if let Some(end) = method.finished(outcome) {
            return end;
        }
        let before = outcome.cost;
        // No step was accepted: theta is the best point, but a rejected trial has been simulated since.
        if let Some(end) = improve(method, outcome, &mut trial, monitor) {
            return end;
        }
        outcome.trace.push(outcome.cost);
        monitor.report_cost(outcome.cost);
        accepted(&outcome.theta, outcome.cost);
        // Last, so that the outcome includes the step that ended the iteration.
        if let Some(end) = method.settled(before, outcome.cost) {
            return end;
        }
    }
    Termination::MaxIterations
}

/// Tries steps until one is accepted; returns why if none is.
fn improve(
    method: &mut impl Method,
    outcome: &mut Outcome,
    trial: &mut [f64],
    monitor: &Monitor,
) -> Option<Termination> {
    // `Marquardt` ends this loop after `MOST_REJECTIONS`.
    loop {
        if monitor.stopped() {
            return Some(Termination::Interrupted);
        }
        match method.propose(&outcome.theta, trial) {
            // No step with this damping, so no trial either.
            Proposal::Again => continue,
            Proposal::End(end) => return Some(end),
            Proposal::Trial => {}
        }
        outcome.trials += 1;
        // The cost to beat is passed on: a simulation may stop as soon as its partial sum exceeds it.
        let cost = method.trial_cost(trial, outcome.cost);
        match method.judge(outcome.cost, cost) {
            Verdict::Rejected => {}
            Verdict::End(end) => return Some(end),
            Verdict::Accepted => {
                // A step is accepted by its cost; without one there is nothing to accept.
                outcome.cost = cost.unwrap_or(outcome.cost);
                outcome.theta.copy_from_slice(trial);
                method.keep();
                return None;
            }
        }
    }
}
