//! NSGA-II: a front of points of which none is better than another in every objective (Deb, Pratap, Agarwal and
//! Meyarivan 2002), with simulated binary crossover (Deb and Agrawal 1995) and polynomial mutation.

use std::cmp::Ordering;

use super::genetic::{JITTER, jittered, stratified};
use super::{Options, Termination, several};
use crate::random::Random;
use crate::{Error, Monitor, Result};

/// What is searched: several objectives over the unit box, each to be small.
pub trait Objectives: Sync {
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

    /// The values at each point, independent of the other points.
    fn judge(
        &self,
        memory: &mut Self::Memory,
        points: &[Vec<f64>],
        monitor: &Monitor,
    ) -> Vec<Values>;
}

/// The values of a candidate.
#[derive(Clone, Debug, PartialEq)]
pub struct Values {
    /// Sum of the relative violations of the constraints; 0 for a feasible candidate.
    pub violation: f64,
    /// The objectives, as many for every candidate; infinite if the candidate is useless.
    pub objectives: Vec<f64>,
}

impl Values {
    /// Whether these dominate others under constraints: feasible before infeasible, then by dominance.
    pub fn dominate(&self, other: &Self) -> bool {
        match self.violation.total_cmp(&other.violation) {
            Ordering::Less => true,
            Ordering::Greater => false,
            Ordering::Equal => {
                let pairs = || self.objectives.iter().zip(&other.objectives);
                pairs().all(|(a, b)| a <= b) && pairs().any(|(a, b)| a < b)
            }
        }
    }
}

/// A point of the front.
#[derive(Clone, Debug, PartialEq)]
pub struct Member {
    /// Where it is.
    pub point: Vec<f64>,
    /// Its values.
    pub values: Values,
}

/// The front and how it was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Front {
    /// Points of which none dominates another, sorted by the first objective.
    pub members: Vec<Member>,
    /// Candidates judged.
    pub evaluations: usize,
    /// Why the search ended.
    pub termination: Termination,
}

/// Distribution indices of crossover and mutation; the larger, the closer children are to their parents.
const CROSSOVER: f64 = 15.0;
const MUTATION: f64 = 20.0;
/// The largest population: ranking compares all pairs and stores the result.
const MOST: usize = 2000;
/// Probability that parents are crossed at all.
const CROSSED: f64 = 0.9;

/// Searches the box with a population of `size`, of which `starts` are the first members.
///
/// # Errors
/// `ErrorKind::Setting` without evaluations or threads, or for a population that is not from 4 to 2,000.
pub fn search<P: Objectives>(
    problem: &P,
    starts: &[Vec<f64>],
    size: usize,
    options: Options,
    monitor: &Monitor,
) -> Result<Front> {
    options.check()?;
    if !(4..=MOST).contains(&size) {
        return Err(Error::setting(format!(
            "expected a population of 4 to {MOST}, got {size}; 40 is usual"
        )));
    }
    let mut random = Random::new(options.seed);
    let mut memories: Vec<_> = (0..options.threads).map(|_| problem.memory()).collect();
    let (mut parents, mut used) = (Vec::<Ranked>::new(), 0);
    let termination = loop {
        if monitor.stopped() {
            break Termination::Interrupted;
        } else if used >= options.evaluations {
            break Termination::Evaluations;
        }
        let count = size.min(options.evaluations - used);
        let points: Vec<Vec<f64>> = if parents.is_empty() {
            first(starts, count, problem.dimensions(), &mut random)
        } else {
            offspring(&parents, count, &mut random)
        };
        let together = problem.together();
        let values = several(&mut memories, &points, together, |memory, some| {
            let values = problem.judge(memory, some, monitor);
            monitor.advance(some.len() as u64);
            values
        });
        used += points.len();
        if monitor.stopped() {
            // Judgements made after the stop request are not valid.
            break Termination::Interrupted;
        }
        let children = points.into_iter().zip(values);
        let mut all: Vec<Member> = parents.into_iter().map(|p| p.member).collect();
        all.extend(children.map(|(point, values)| Member { point, values }));
        parents = survivors(all, size);
    };
    Ok(Front {
        members: front(parents),
        evaluations: used,
        termination,
    })
}

#[derive(Clone, Debug)]
struct Ranked {
    member: Member,
    rank: usize,
    crowding: f64,
}

impl Ranked {
    /// The member with the lower rank is better; within a rank, the one with more room around it.
    fn beats(&self, other: &Self) -> bool {
        self.rank < other.rank || (self.rank == other.rank && self.crowding > other.crowding)
    }
}

/// One half is the starts and points near them, the other lies anywhere in the box.
fn first(
    starts: &[Vec<f64>],
    count: usize,
    dimensions: usize,
    random: &mut Random,
) -> Vec<Vec<f64>> {
    let mut points: Vec<Vec<f64>> = starts.iter().take(count).cloned().collect();
    let near = if starts.is_empty() { 0 } else { count / 2 };
    for k in points.len()..near {
        points.push(jittered(&starts[k % starts.len()], JITTER, random));
    }
    let others = count - points.len();
    points.extend(stratified(others, dimensions, random));
    points
}

/// Children of tournament winners.
fn offspring(parents: &[Ranked], count: usize, random: &mut Random) -> Vec<Vec<f64>> {
    let mut children = Vec::with_capacity(count + 1);
    while children.len() < count {
        let (a, b) = (winner(parents, random), winner(parents, random));
        let (mut a, mut b) = (a.member.point.clone(), b.member.point.clone());
        cross(&mut a, &mut b, random);
        for mut child in [a, b] {
            mutate(&mut child, random);
            children.push(child);
        }
    }
    children.truncate(count);
    children
}

fn winner<'a>(parents: &'a [Ranked], random: &mut Random) -> &'a Ranked {
    let mut pick = || &parents[(random.uniform() * parents.len() as f64) as usize];
    let (a, b) = (pick(), pick());
    if b.beats(a) { b } else { a }
}

/// Simulated binary crossover within bounds 0 and 1.
fn cross(a: &mut [f64], b: &mut [f64], random: &mut Random) {
    if random.uniform() >= CROSSED {
        return;
    }
    for (a, b) in a.iter_mut().zip(b) {
        let (low, high) = (a.min(*b), a.max(*b));
        if random.uniform() >= 0.5 || high - low < 1e-14 {
            continue;
        }
        let u = random.uniform();
        let spread = |room: f64| {
            let beta = 1.0 + 2.0 * room / (high - low);
            let alpha = 2.0 - beta.powf(-(CROSSOVER + 1.0));
            if u <= 1.0 / alpha {
                (u * alpha).powf(1.0 / (CROSSOVER + 1.0))
            } else {
                (1.0 / (2.0 - u * alpha)).powf(1.0 / (CROSSOVER + 1.0))
            }
        };
        let middle = (low + high) / 2.0;
        let half = (high - low) / 2.0;
        let first = (middle - half * spread(low)).clamp(0.0, 1.0);
        let second = (middle + half * spread(1.0 - high)).clamp(0.0, 1.0);
        (*a, *b) = if random.uniform() < 0.5 {
            (first, second)
        } else {
            (second, first)
        };
    }
}

/// Polynomial mutation within bounds 0 and 1, of one coordinate on average.
fn mutate(point: &mut [f64], random: &mut Random) {
    let chance = 1.0 / point.len() as f64;
    let power = 1.0 / (MUTATION + 1.0);
    for x in point {
        if random.uniform() >= chance {
            continue;
        }
        let u = random.uniform();
        let moved = if u < 0.5 {
            let room = (1.0 - *x).powf(MUTATION + 1.0);
            (2.0 * u + (1.0 - 2.0 * u) * room).powf(power) - 1.0
        } else {
            let room = x.powf(MUTATION + 1.0);
            1.0 - (2.0 * (1.0 - u) + (2.0 * u - 1.0) * room).powf(power)
        };
        *x = (*x + moved).clamp(0.0, 1.0);
    }
}

/// The best `size` by rank; of the last rank, those with most room around them.
fn survivors(all: Vec<Member>, size: usize) -> Vec<Ranked> {
    let mut kept = Vec::with_capacity(size);
    for (rank, indices) in ranks(&all).into_iter().enumerate() {
        let crowding = crowding(&all, &indices);
        let mut ranked: Vec<Ranked> = indices
            .iter()
            .zip(crowding)
            .map(|(&i, crowding)| Ranked {
                member: all[i].clone(),
                rank,
                crowding,
            })
            .collect();
        ranked.sort_by(|a, b| b.crowding.total_cmp(&a.crowding));
        ranked.truncate(size - kept.len());
        kept.extend(ranked);
        if kept.len() == size {
            break;
        }
    }
    kept
}

/// Indices by rank: none of rank 0 is dominated, none of rank 1 by others than those of rank 0, and so on.
fn ranks(all: &[Member]) -> Vec<Vec<usize>> {
    let mut better = vec![0; all.len()];
    let mut worse = vec![Vec::new(); all.len()];
    for (i, a) in all.iter().enumerate() {
        for (j, b) in all.iter().enumerate() {
            if a.values.dominate(&b.values) {
                worse[i].push(j);
                better[j] += 1;
            }
        }
    }
    let mut found = Vec::new();
    let mut now: Vec<usize> = (0..all.len()).filter(|&i| better[i] == 0).collect();
    while !now.is_empty() {
        let mut next = Vec::new();
        for &i in &now {
            for &j in &worse[i] {
                better[j] -= 1;
                if better[j] == 0 {
                    next.push(j);
                }
            }
        }
        next.sort_unstable();
        found.push(std::mem::replace(&mut now, next));
    }
    found
}

/// How far apart each member's neighbours are, in shares of the front's extent; infinite at its ends.
fn crowding(all: &[Member], indices: &[usize]) -> Vec<f64> {
    let mut room = vec![0.0; indices.len()];
    let objectives = indices
        .first()
        .map_or(0, |&i| all[i].values.objectives.len());
    for m in 0..objectives {
        let value = |k: usize| all[indices[k]].values.objectives[m];
        let mut order: Vec<usize> = (0..indices.len()).collect();
        order.sort_by(|&a, &b| value(a).total_cmp(&value(b)));
        let (first, last) = (order[0], order[order.len() - 1]);
        let extent = value(last) - value(first);
        room[first] = f64::INFINITY;
        room[last] = f64::INFINITY;
        if extent > 0.0 && extent.is_finite() {
            for trio in order.windows(3) {
                room[trio[1]] += (value(trio[2]) - value(trio[0])) / extent;
            }
        }
    }
    room
}

/// The members of the first rank, each point once.
fn front(parents: Vec<Ranked>) -> Vec<Member> {
    let useful =
        |p: &Ranked| p.rank == 0 && p.member.values.objectives.iter().all(|v| v.is_finite());
    let mut members: Vec<Member> = parents
        .into_iter()
        .filter(useful)
        .map(|p| p.member)
        .collect();
    members.sort_by(|a, b| {
        let pairs = a.values.objectives.iter().zip(&b.values.objectives);
        pairs.fold(Ordering::Equal, |order, (a, b)| order.then(a.total_cmp(b)))
    });
    members.dedup_by(|a, b| a.point == b.point);
    members
}
