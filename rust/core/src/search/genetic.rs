//! A real-coded genetic algorithm with elitism and local refinement.
//!
//! Breeding: children come from tournament winners by blend crossover (Eshelman and Schaffer 1993, BLX-.5) and a
//! mutation that narrows with each generation; the best of parents and children survive. Refinement: an evolution
//! (`cma_es`) starts at the best member with the distribution of the best quarter, helped by a quadratic model of all
//! judged points (`model`). When it ends, a new population is bred around the best so far.

use nalgebra::{DMatrix, DVector};

use super::cma_es::{Evolution, GENERATION, STALLED};
use super::model::Archive;
use super::{Candidate, Found, Judgement, Options, Problem, Strategy, run};
use crate::random::Random;
use crate::{Monitor, Result};

/// Members of the population per dimension, and the least number.
const MEMBERS: (usize, usize) = (4, 20);
/// Share of the first members that lie near the start, if there is one.
const NEAR: f64 = 0.5;
/// Spread of the members near the start, in shares of the box.
pub(super) const JITTER: f64 = 0.08;
/// Spread of a later population's members around the best so far. The best itself is not a member: it would draw all
/// others into its basin.
const AWAY: f64 = 0.2;
/// Share of all evaluations spent on breeding before a refinement.
const BRED: f64 = 0.18;
/// Share of the population whose spread starts a refinement.
const ELITE: f64 = 0.25;
/// Least spread that starts a refinement.
const LEAST_SPREAD: f64 = 0.015;
/// How far blends reach beyond their parents, in shares of the parents' distance.
const BLEND: f64 = 0.5;
/// Spread of a mutation at the beginning and at the end of a breeding.
const MUTATION: (f64, f64) = (0.1, 0.01);

/// Searches the box, beginning around `start` if there is one.
///
/// # Errors
/// `ErrorKind::Setting` without evaluations or threads.
pub fn search<P: Problem>(
    problem: &P,
    start: Option<&[f64]>,
    options: Options,
    monitor: &Monitor,
) -> Result<Found> {
    options.check()?;
    let mut strategy = Genetic::new(problem.dimensions(), start, options);
    Ok(run(problem, &mut strategy, options, monitor))
}

#[derive(Clone, Debug)]
struct Member {
    point: Vec<f64>,
    judgement: Judgement,
}

struct Genetic {
    random: Random,
    size: usize,
    dimensions: usize,
    /// Sorted, best first.
    members: Vec<Member>,
    /// First members that have not been judged yet.
    unborn: Vec<Vec<f64>>,
    /// Candidates judged in this breeding.
    bred: usize,
    refinement: Option<Evolution>,
    best: Option<Member>,
    /// The points of the refinement's model.
    archive: Archive,
    options: Options,
}

impl Genetic {
    fn new(dimensions: usize, start: Option<&[f64]>, options: Options) -> Self {
        let mut new = Self {
            random: Random::new(options.seed),
            size: MEMBERS.1.max(MEMBERS.0 * dimensions),
            dimensions,
            members: Vec::new(),
            unborn: Vec::new(),
            bred: 0,
            refinement: None,
            best: None,
            archive: Archive::default(),
            options,
        };
        new.unborn.extend(start.map(<[f64]>::to_vec));
        new.settle(start, JITTER);
        new
    }

    /// A new population, half of it around a point if there is one.
    fn settle(&mut self, about: Option<&[f64]>, spread: f64) {
        let near = about.map_or(0, |_| (NEAR * self.size as f64) as usize);
        if let Some(point) = about {
            for _ in self.unborn.len()..near {
                let member = jittered(point, spread, &mut self.random);
                self.unborn.push(member);
            }
        }
        let others = stratified(self.size - near, self.dimensions, &mut self.random);
        self.unborn.extend(others);
        self.members.clear();
        self.bred = 0;
    }

    fn evaluations_to_breed(&self) -> f64 {
        (BRED * self.options.evaluations as f64).max(4.0 * self.size as f64)
    }

    fn breed(&mut self, limit: usize) -> Vec<Candidate> {
        let first = !self.unborn.is_empty();
        let count = limit.min(if first { self.unborn.len() } else { self.size });
        let points: Vec<Vec<f64>> = if first {
            self.unborn.drain(..count).collect()
        } else {
            (0..count).map(|_| self.child()).collect()
        };
        // A child that is no better than the worst survivor is of no use.
        let full = self.members.len() == self.size;
        let to_beat = match self.members.last() {
            Some(worst) if full => worst.judgement,
            _ => Judgement::HOPELESS,
        };
        let candidate = |point| Candidate { point, to_beat };
        points.into_iter().map(candidate).collect()
    }

    fn child(&mut self) -> Vec<f64> {
        let mut child = self.blend();
        self.mutate(&mut child);
        child
    }

    /// Starts at the best member, with the spread of the best quarter around it.
    fn refine(&mut self) -> Evolution {
        let elite = ((ELITE * self.members.len() as f64) as usize).max(1);
        let best = DVector::from_column_slice(&self.members[0].point);
        let mut spread = DMatrix::identity(self.dimensions, self.dimensions) * LEAST_SPREAD.powi(2);
        for member in &self.members[1..elite.max(2).min(self.members.len())] {
            let apart = DVector::from_column_slice(&member.point) - &best;
            spread.ger(1.0 / elite as f64, &apart, &apart, 1.0);
        }
        Evolution::spread(best, spread, GENERATION)
    }

    /// The better of two members.
    fn winner(&mut self) -> usize {
        let pick = |random: &mut Random| (random.uniform() * self.members.len() as f64) as usize;
        pick(&mut self.random).min(pick(&mut self.random))
    }

    fn blend(&mut self) -> Vec<f64> {
        let (a, b) = (self.winner(), self.winner());
        let parents = self.members[a].point.iter().zip(&self.members[b].point);
        let random = &mut self.random;
        parents
            .map(|(a, b)| inside(a + random.between(-BLEND, 1.0 + BLEND) * (b - a)))
            .collect()
    }

    fn mutate(&mut self, child: &mut [f64]) {
        let progress = (self.bred as f64 / self.evaluations_to_breed()).min(1.0);
        let spread = MUTATION.0 * (MUTATION.1 / MUTATION.0).powf(progress);
        let chance = 1.0 / child.len() as f64;
        for x in child {
            if self.random.uniform() < chance {
                *x = inside(*x + spread * self.random.normal());
            }
        }
    }
}

impl Strategy for Genetic {
    fn ask(&mut self, limit: usize) -> Vec<Candidate> {
        let tolerance = self.options.tolerance;
        let ended = |e: &Evolution| e.ended(tolerance) || e.stalled(STALLED);
        if self.refinement.as_ref().is_some_and(ended) {
            self.refinement = None;
            let best = self.best.as_ref().map(|b| b.point.clone());
            self.settle(best.as_deref(), AWAY);
        }
        if self.refinement.is_none() && self.bred as f64 >= self.evaluations_to_breed() {
            self.refinement = Some(self.refine());
        }
        match &mut self.refinement {
            Some(evolution) => evolution.ask(limit, &mut self.random, &self.archive),
            None => self.breed(limit),
        }
    }

    fn tell(&mut self, candidates: Vec<Candidate>, judgements: &[Judgement]) {
        if let Some(evolution) = &mut self.refinement {
            evolution.adapt(judgements);
        }
        self.archive.keep(&candidates, judgements);
        let told = candidates.into_iter().zip(judgements);
        let born = told.map(|(candidate, judgement)| Member {
            point: candidate.point,
            judgement: *judgement,
        });
        self.members.extend(born);
        self.members.sort_by(|a, b| a.judgement.order(&b.judgement));
        self.members.truncate(self.size);
        self.bred += judgements.len();
        if let Some(first) = self.members.first() {
            let better = |b: &Member| first.judgement.beats(&b.judgement);
            if self.best.as_ref().is_none_or(better) {
                self.best = Some(first.clone());
            }
        }
    }

    /// There is always another population.
    fn converged(&self) -> bool {
        false
    }
}

/// A point near another one.
pub(super) fn jittered(point: &[f64], spread: f64, random: &mut Random) -> Vec<f64> {
    let about = |x: &f64| (x + spread * random.normal()).clamp(0.0, 1.0);
    point.iter().map(about).collect()
}

/// Points with exactly one in every slice of each coordinate (Latin hypercube, McKay 1979).
pub(super) fn stratified(count: usize, dimensions: usize, random: &mut Random) -> Vec<Vec<f64>> {
    let mut points = vec![vec![0.0; dimensions]; count];
    let mut order: Vec<usize> = (0..count).collect();
    for i in 0..dimensions {
        for k in (1..count).rev() {
            order.swap(k, (random.uniform() * (k + 1) as f64) as usize);
        }
        for (point, slice) in points.iter_mut().zip(&order) {
            point[i] = (*slice as f64 + random.uniform()) / count as f64;
        }
    }
    points
}

/// Mirrored into 0 .. 1.
pub(super) fn inside(x: f64) -> f64 {
    let folded = x.rem_euclid(2.0);
    if folded > 1.0 { 2.0 - folded } else { folded }
}
