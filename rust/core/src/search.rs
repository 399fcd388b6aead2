//! Searches of the unit box for the least cost, or for a front of least values; none of them knows what it searches.
//!
//! Candidates are judged in batches over threads. Who judges what has no part in the result: a seed gives the same
//! bits at any number of threads.
//!
//! To read: [`cma_es`] and [`genetic`] for the least, with the quadratic `model` that both ask, [`nsga2`] for a front.

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
    /// What it costs; of a candidate that cannot beat what it has to, what it costs at least.
    pub cost: f64,
}

impl Judgement {
    /// Of a candidate that cannot be judged at all.
    pub const HOPELESS: Self = Self {
        violation: f64::INFINITY,
        cost: f64::INFINITY,
    };

    /// A feasible candidate's.
    pub fn feasible(cost: f64) -> Self {
        Self {
            violation: 0.0,
            cost,
        }
    }

    /// Of two feasible candidates the cheaper is less, of two infeasible ones that with the smaller violation.
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
    /// What one thread needs to judge candidates.
    type Memory: Send;

    /// Coordinates of a point.
    fn dimensions(&self) -> usize;

    /// Fresh memory for a thread.
    fn memory(&self) -> Self::Memory;

    /// How many candidates are best judged at once.
    fn together(&self) -> usize {
        1
    }

    /// Whether its costs are those that count, and not of a part of the work.
    fn is_whole(&self) -> bool {
        true
    }

    /// How good each candidate is, whatever the others are; the work on one may end as soon as it cannot beat what it has
    /// to any more, or on a stop.
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
    /// A population has come together when its costs lie within this share of the best.
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
    /// All candidates had come together.
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

/// The best point and the story of its search.
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

/// A point to be judged, and what it has to beat to be of any use.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Where it is.
    pub point: Vec<f64>,
    /// What it has to beat.
    pub to_beat: Judgement,
}

/// A way to search: it is asked for candidates and told how good they are.
trait Strategy {
    /// The next candidates, 1 to `limit`.
    fn ask(&mut self, limit: usize) -> Vec<Candidate>;
    /// What they were worth.
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

/// Goes on with a search that has begun, as [`run`]; the evaluations are those of both.
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

/// `work` on the items, up to `together` at once and no more than leave something for every memory; the results are in
/// the items' order.
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

/// `work` on every item, by as many threads as there are memories; the results are in the items' order, whichever thread
/// computed them.
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
