//! Searches of the unit box for the least cost, or for a Pareto front; none of them knows what it searches.
//!
//! Candidates are judged in batches over threads. Which thread judges which candidate does not matter: a seed gives the
//! same bits at any number of threads.
//!
//! To read: [`cma_es`] and [`genetic`] for the least cost, with the quadratic `model` that both use; [`nsga2`] for a front.

pub mod cma_es;
pub mod genetic;
mod model;
pub mod nsga2;

use std::cmp::Ordering;
use std::sync::atomic::{self, AtomicUsize};
use std::thread;

use crate::{Error, Monitor, Result};

/// How good a candidate is: feasible before infeasible, then by cost (Deb 2000).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judgement {
    /// Sum of the relative violations of the constraints; 0 for a feasible candidate.
    pub violation: f64,
    /// Its cost; a lower bound of it if the candidate cannot beat what it has to.
    pub cost: f64,
    /// The largest relative excess over a limit, below 0 within all of them; minus infinity without limits.
    pub excess: f64,
}

impl Judgement {
    /// The judgement of a candidate that cannot be judged at all.
    pub const HOPELESS: Self = Self {
        violation: f64::INFINITY,
        cost: f64::INFINITY,
        excess: f64::INFINITY,
    };

    /// The judgement of a feasible candidate.
    pub fn feasible(cost: f64) -> Self {
        Self {
            violation: 0.0,
            cost,
            excess: f64::NEG_INFINITY,
        }
    }

    /// The less is the better: of two feasible candidates the cheaper, of two infeasible ones the one with the smaller violation.
    pub fn order(&self, other: &Self) -> Ordering {
        self.violation
            .total_cmp(&other.violation)
            .then(self.cost.total_cmp(&other.cost))
    }

    /// Whether it is better than another.
    pub fn beats(&self, other: &Self) -> bool {
        self.order(other) == Ordering::Less
    }
}

/// What is searched: a function over the unit box.
pub trait Problem: Sync {
    /// The memory that one thread needs to judge candidates.
    type Memory: Send;

    /// Number of coordinates of a point.
    fn dimensions(&self) -> usize;

    /// Fresh memory for a thread.
    fn memory(&self) -> Self::Memory;

    /// How many candidates are best judged at once.
    fn together(&self) -> usize {
        1
    }

    /// Whether its costs are the final ones, not those on a part of the work.
    fn is_whole(&self) -> bool {
        true
    }

    /// How good each candidate is, independent of the others. The work on one may end as soon as it cannot beat its
    /// `to_beat` any more, or on a stop.
    fn judge(
        &self,
        memory: &mut Self::Memory,
        candidates: &[Candidate],
        monitor: &Monitor,
    ) -> Vec<Judgement>;
}

/// How a search runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Candidates judged.
    pub evaluations: usize,
    /// Seed of the search; the result is the same at any number of threads.
    pub seed: u64,
    /// Threads.
    pub threads: usize,
    /// A population has converged when its costs lie within this share of the best.
    pub tolerance: f64,
}

impl Options {
    pub(crate) fn check(&self) -> Result<()> {
        if self.evaluations == 0 || self.threads == 0 || self.threads > 1024 {
            return Err(Error::setting(format!(
                "expected at least one evaluation and 1 to 1,024 threads, got {} and {}",
                self.evaluations, self.threads
            )));
        }
        Ok(())
    }
}

/// Why a search ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Termination {
    /// All evaluations were used.
    Evaluations,
    /// All candidates had converged.
    Converged,
    /// A stop was requested; the best so far is returned.
    Interrupted,
}

impl Termination {
    /// The name of the outcome.
    pub fn name(self) -> &'static str {
        match self {
            Self::Evaluations => "evaluations",
            Self::Converged => "converged",
            Self::Interrupted => "interrupted",
        }
    }
}

/// The best point and how the search found it.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// The best point.
    pub point: Vec<f64>,
    /// How good it is.
    pub judgement: Judgement,
    /// The best so far after each evaluation.
    pub trace: Vec<Judgement>,
    /// Why the search ended.
    pub termination: Termination,
}

/// A point to judge, and the judgement it has to beat to be of use.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Where it is.
    pub point: Vec<f64>,
    /// The judgement it has to beat.
    pub to_beat: Judgement,
}

/// A search strategy: it is asked for candidates and told how good they are.
trait Strategy {
    /// The next candidates, 1 to `limit`.
    fn ask(&mut self, limit: usize) -> Vec<Candidate>;
    /// Learns their judgements.
    fn tell(&mut self, candidates: Vec<Candidate>, judgements: &[Judgement]);
    /// Whether more candidates would be of no use.
    fn converged(&self) -> bool;
}

/// Asks, judges and tells until the evaluations are used.
fn run<P: Problem>(
    problem: &P,
    strategy: &mut impl Strategy,
    options: Options,
    monitor: &Monitor,
) -> Found {
    let begun = Found {
        point: vec![0.5; problem.dimensions()],
        judgement: Judgement::HOPELESS,
        trace: Vec::new(),
        termination: Termination::Evaluations,
    };
    proceed(problem, strategy, begun, options, monitor)
}

/// Continues a search that has begun, as [`run`]; the evaluations count for both.
fn proceed<P: Problem>(
    problem: &P,
    strategy: &mut impl Strategy,
    begun: Found,
    options: Options,
    monitor: &Monitor,
) -> Found {
    let mut memories: Vec<_> = (0..options.threads).map(|_| problem.memory()).collect();
    let (mut best, mut trace) = ((begun.point, begun.judgement), begun.trace);
    let termination = loop {
        if monitor.stopped() {
            break Termination::Interrupted;
        } else if trace.len() >= options.evaluations {
            break Termination::Evaluations;
        } else if strategy.converged() {
            break Termination::Converged;
        }
        let candidates = strategy.ask(options.evaluations - trace.len());
        let together = problem.together();
        let judgements = several(&mut memories, &candidates, together, |memory, some| {
            let judged = problem.judge(memory, some, monitor);
            monitor.advance(some.len() as u64);
            let counts = |j: &&Judgement| problem.is_whole() && j.violation == 0.0;
            for judged in judged.iter().filter(counts) {
                monitor.report_cost(judged.cost);
            }
            judged
        });
        for (candidate, judged) in candidates.iter().zip(&judgements) {
            if judged.beats(&best.1) {
                best = (candidate.point.clone(), *judged);
            }
            trace.push(best.1);
        }
        strategy.tell(candidates, &judgements);
    };
    Found {
        point: best.0,
        judgement: best.1,
        trace,
        termination,
    }
}

/// `work` on the items, up to `together` at once, but few enough that every memory gets some; the results are in the
/// items' order.
pub(crate) fn several<M: Send, I: Sync, R: Send>(
    memories: &mut [M],
    items: &[I],
    together: usize,
    work: impl Fn(&mut M, &[I]) -> Vec<R> + Sync,
) -> Vec<R> {
    let share = items.len().div_ceil(memories.len().max(1));
    let some: Vec<&[I]> = items.chunks(together.min(share).max(1)).collect();
    let results = each(memories, &some, |memory, some| work(memory, some));
    results.into_iter().flatten().collect()
}

/// `work` on every item, with one thread per memory; the results are in the items' order, independent of the threads.
pub(crate) fn each<M: Send, I: Sync, R: Send>(
    memories: &mut [M],
    items: &[I],
    work: impl Fn(&mut M, &I) -> R + Sync,
) -> Vec<R> {
    if let [memory] = memories {
        return items.iter().map(|item| work(memory, item)).collect();
    }
    let next = AtomicUsize::new(0);
    let own = |memory: &mut M| {
        let mut done = Vec::new();
        loop {
            let index = next.fetch_add(1, atomic::Ordering::Relaxed);
            let Some(item) = items.get(index) else {
                return done;
            };
            done.push((index, work(memory, item)));
        }
    };
    let mut results = thread::scope(|scope| {
        let workers: Vec<_> = memories
            .iter_mut()
            .take(items.len())
            .map(|memory| scope.spawn(|| own(memory)))
            .collect();
        let mut all = Vec::with_capacity(items.len());
        for worker in workers {
            let done = worker.join();
            all.extend(done.unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        }
        all
    });
    results.sort_unstable_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests;
