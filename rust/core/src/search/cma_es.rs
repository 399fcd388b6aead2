//! CMA-ES with restarts: the covariance matrix adapts to the landscape (Hansen, arXiv 1604.00772). A finished run
//! starts again with a larger or a smaller population (BIPOP, Hansen 2009).
//!
//! The minimum of a quadratic model of the points judged so far joins each generation (Hansen, arXiv 1110.4181, on
//! injected candidates): in smooth valleys that saves most of the evaluations.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::genetic::inside;
use super::model::{Archive, Ellipsoid, Model};
use super::{Candidate, Found, Judgement, Options, Problem, Strategy, proceed, run};
use crate::random::Random;
use crate::{Monitor, Result};

/// First step around a start, and without a start, in shares of the box.
const STEP: (f64, f64) = (0.15, 0.3);
/// First step of a refinement, in shares of the box.
const SMALL_STEP: f64 = 0.03;
/// Size of a refinement's generations relative to the usual one: larger generations follow the slope of a rough landscape.
pub(super) const GENERATION: f64 = 1.4;
/// A refinement ends when the best improves by less than this share within so many generations.
pub(super) const STALLED: (f64, usize) = (1e-6, 30);
/// Steps smaller than this share of the box change nothing.
const SMALLEST_STEP: f64 = 1e-11;
/// Squared ratio of the longest to the shortest axis beyond which the matrix is of no use.
const WORST_CONDITION: f64 = 1e14;
/// A candidate that costs more than this many medians of the last generation is not judged to its end.
const ABANDONED: f64 = 3.0;
/// Radii within which a model's minimum is searched, in standard deviations: about the length of the samples' steps in
/// few dimensions, so that none need clipping.
const TRUST: [f64; 2] = [1.5, 3.0];

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
    let mut strategy = Restarts::new(problem.dimensions(), start, options);
    Ok(run(problem, &mut strategy, options, monitor))
}

/// Continues from the best point of a search on a part of the problem, with small steps until nothing improves any
/// more. The evaluations count for both.
///
/// # Errors
/// As [`search`].
pub fn refine<P: Problem>(
    problem: &P,
    begun: Found,
    options: Options,
    monitor: &Monitor,
) -> Result<Found> {
    options.check()?;
    let size = (GENERATION * population(begun.point.len()) as f64) as usize;
    let mut strategy = Refinement {
        random: Random::new(options.seed),
        now: Evolution::new(begun.point.clone(), SMALL_STEP, size),
        archive: Archive::default(),
        tolerance: options.tolerance,
    };
    Ok(proceed(problem, &mut strategy, begun, options, monitor))
}

/// One evolution to its end.
struct Refinement {
    random: Random,
    now: Evolution,
    archive: Archive,
    tolerance: f64,
}

impl Strategy for Refinement {
    fn ask(&mut self, limit: usize) -> Vec<Candidate> {
        self.now.ask(limit, &mut self.random, &self.archive)
    }

    fn tell(&mut self, candidates: Vec<Candidate>, judgements: &[Judgement]) {
        self.archive.keep(&candidates, judgements);
        self.now.adapt(judgements);
    }

    fn converged(&self) -> bool {
        self.now.ended(self.tolerance) || self.now.stalled(STALLED)
    }
}

/// Evolutions one after the other; the evaluations of large and small populations are kept equal.
struct Restarts {
    random: Random,
    options: Options,
    dimensions: usize,
    now: Evolution,
    archive: Archive,
    /// How often the large population was doubled.
    doublings: u32,
    large: bool,
    used: [usize; 2],
}

impl Restarts {
    fn new(dimensions: usize, start: Option<&[f64]>, options: Options) -> Self {
        let step = if start.is_some() { STEP.0 } else { STEP.1 };
        let mean = start.map_or_else(|| vec![0.5; dimensions], <[f64]>::to_vec);
        Self {
            random: Random::new(options.seed),
            options,
            dimensions,
            now: Evolution::new(mean, step, population(dimensions)),
            archive: Archive::default(),
            doublings: 0,
            large: true,
            used: [0; 2],
        }
    }

    fn restart(&mut self) {
        let least = population(self.dimensions) as f64;
        self.large = self.used[1] <= self.used[0];
        let (size, step) = if self.large {
            self.doublings += 1;
            (least * f64::from(1 << self.doublings.min(16)), STEP.1)
        } else {
            let share = self.random.uniform().powi(2);
            let most = 0.5 * f64::from(1 << self.doublings.min(16));
            let step = STEP.1 * 10.0_f64.powf(-2.0 * self.random.uniform());
            (least * most.powf(share), step)
        };
        let random = &mut self.random;
        let mean = (0..self.dimensions).map(|_| random.uniform()).collect();
        self.now = Evolution::new(mean, step, size as usize);
        // What an earlier run knows would draw this one to the end of that run.
        self.archive = Archive::default();
    }
}

/// The default population size, `4 + 3 ln n`.
fn population(dimensions: usize) -> usize {
    4 + (3.0 * (dimensions as f64).ln()) as usize
}

impl Strategy for Restarts {
    fn ask(&mut self, limit: usize) -> Vec<Candidate> {
        if self.now.ended(self.options.tolerance) {
            self.restart();
        }
        self.now.ask(limit, &mut self.random, &self.archive)
    }

    fn tell(&mut self, candidates: Vec<Candidate>, judgements: &[Judgement]) {
        self.used[usize::from(self.large)] += candidates.len();
        self.archive.keep(&candidates, judgements);
        self.now.adapt(judgements);
    }

    /// There is always another restart.
    fn converged(&self) -> bool {
        false
    }
}

/// Constants for a population size (Hansen 2016, Table 1).
#[derive(Clone, Debug)]
struct Weights {
    size: usize,
    /// Weights of the best half, with sum 1.
    parents: Vec<f64>,
    /// Effective number of parents.
    effective: f64,
    c_sigma: f64,
    damping: f64,
    c_c: f64,
    c_1: f64,
    c_mu: f64,
    /// Expected length of a standard normal vector.
    length: f64,
}

impl Weights {
    fn new(dimensions: usize, size: usize) -> Self {
        let n = dimensions as f64;
        let raw: Vec<f64> = (0..size / 2)
            .map(|i| ((size as f64 + 1.0) / 2.0).ln() - ((i + 1) as f64).ln())
            .collect();
        let sum: f64 = raw.iter().sum();
        let parents: Vec<f64> = raw.iter().map(|w| w / sum).collect();
        let effective = 1.0 / parents.iter().map(|w| w * w).sum::<f64>();
        let c_sigma = (effective + 2.0) / (n + effective + 5.0);
        let c_1 = 2.0 / ((n + 1.3).powi(2) + effective);
        let c_mu = 2.0 * (effective - 2.0 + 1.0 / effective) / ((n + 2.0).powi(2) + effective);
        Self {
            size,
            parents,
            effective,
            c_sigma,
            damping: 1.0 + 2.0 * (((effective - 1.0) / (n + 1.0)).sqrt() - 1.0).max(0.0) + c_sigma,
            c_c: (4.0 + effective / n) / (n + 4.0 + 2.0 * effective / n),
            c_1,
            c_mu: c_mu.min(1.0 - c_1),
            length: n.sqrt() * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n)),
        }
    }
}

/// One run of the evolution, in coordinates that are mirrored into the box.
pub(super) struct Evolution {
    weights: Weights,
    mean: DVector<f64>,
    sigma: f64,
    covariance: DMatrix<f64>,
    /// Axes of the distribution, and their lengths.
    axes: DMatrix<f64>,
    lengths: DVector<f64>,
    path_sigma: DVector<f64>,
    path_c: DVector<f64>,
    generation: usize,
    /// Steps `(x - mean)/sigma` of this generation.
    steps: Vec<DVector<f64>>,
    /// Best of each generation.
    history: Vec<Judgement>,
    last: Vec<Judgement>,
}

impl Evolution {
    fn new(mean: Vec<f64>, sigma: f64, size: usize) -> Self {
        let n = mean.len();
        Self {
            weights: Weights::new(n, size.max(4)),
            mean: DVector::from_vec(mean),
            sigma,
            covariance: DMatrix::identity(n, n),
            axes: DMatrix::identity(n, n),
            lengths: DVector::from_element(n, 1.0),
            path_sigma: DVector::zeros(n),
            path_c: DVector::zeros(n),
            generation: 0,
            steps: Vec::new(),
            history: Vec::new(),
            last: Vec::new(),
        }
    }

    /// From a point, with this covariance, in generations `larger` times the usual size.
    pub(super) fn spread(mean: DVector<f64>, covariance: DMatrix<f64>, larger: f64) -> Self {
        let size = larger * population(mean.len()) as f64;
        let mut new = Self::new(mean.as_slice().to_vec(), 1.0, size as usize);
        new.covariance = covariance;
        new.decompose();
        new
    }

    /// A generation, or as much of it as there are evaluations left: candidates of a model of known points, and samples.
    pub(super) fn ask(
        &mut self,
        limit: usize,
        random: &mut Random,
        known: &Archive,
    ) -> Vec<Candidate> {
        let to_beat = self.to_beat();
        let size = self.weights.size.min(limit);
        let mut points = self.promising(known);
        points.truncate(size);
        let step = |point: &DVector<f64>| (point - &self.mean) / self.sigma;
        self.steps = points.iter().map(step).collect();
        let mut points: Vec<Vec<f64>> = points.iter().map(|p| p.as_slice().to_vec()).collect();
        points.resize_with(size, || self.sample(random));
        let candidate = |point| Candidate { point, to_beat };
        points.into_iter().map(candidate).collect()
    }

    /// The minima of a model of known points, one within each trust radius.
    fn promising(&self, known: &Archive) -> Vec<DVector<f64>> {
        let lengths = &self.lengths * self.sigma;
        let about = Ellipsoid {
            centre: &self.mean,
            axes: &self.axes,
            lengths: &lengths,
        };
        let model = Model::fit(known, about);
        let least = |radius| model.as_ref()?.least(radius);
        let mut points: Vec<_> = TRUST.into_iter().filter_map(least).collect();
        points.dedup();
        points
    }

    fn sample(&mut self, random: &mut Random) -> Vec<f64> {
        let n = self.mean.len();
        let z = DVector::from_fn(n, |i, _| self.lengths[i] * random.normal());
        let step = &self.axes * z;
        let point = &self.mean + self.sigma * &step;
        self.steps.push(step);
        point.iter().map(|x| inside(*x)).collect()
    }

    /// The cost above which a candidate would be among the worst anyway.
    fn to_beat(&self) -> Judgement {
        let median = self.last.get(self.last.len() / 2);
        match median {
            Some(j) if j.violation == 0.0 && j.cost > 0.0 => {
                Judgement::feasible(ABANDONED * j.cost)
            }
            _ => Judgement::HOPELESS,
        }
    }

    /// Moves the mean towards the best, updates the paths, then step size and covariance (Hansen 2016, Fig. 6).
    pub(super) fn adapt(&mut self, judgements: &[Judgement]) {
        let mut order: Vec<usize> = (0..judgements.len()).collect();
        order.sort_by(|&a, &b| judgements[a].order(&judgements[b]));
        let steps = std::mem::take(&mut self.steps);
        self.last = order.iter().map(|&i| judgements[i]).collect();
        self.history.push(self.last[0]);
        self.generation += 1;
        if judgements.len() < self.weights.size {
            return;
        }
        let w = &self.weights;
        let n = self.mean.len() as f64;
        let parents = || w.parents.iter().zip(order.iter().map(|&i| &steps[i]));
        let mut mean_step = DVector::zeros(self.mean.len());
        for (weight, step) in parents() {
            mean_step.axpy(*weight, step, 1.0);
        }
        self.mean.axpy(self.sigma, &mean_step, 1.0);

        let whitened = self.axes.tr_mul(&mean_step).component_div(&self.lengths);
        let gain = (w.c_sigma * (2.0 - w.c_sigma) * w.effective).sqrt();
        self.path_sigma *= 1.0 - w.c_sigma;
        self.path_sigma += gain * (&self.axes * whitened);
        let length = self.path_sigma.norm();
        let settled = 1.0 - (1.0 - w.c_sigma).powi(2 * self.generation as i32);
        let calm = length / settled.sqrt() < (1.4 + 2.0 / (n + 1.0)) * w.length;
        self.path_c *= 1.0 - w.c_c;
        if calm {
            self.path_c.axpy(
                (w.c_c * (2.0 - w.c_c) * w.effective).sqrt(),
                &mean_step,
                1.0,
            );
        }
        let lost = if calm {
            0.0
        } else {
            w.c_1 * w.c_c * (2.0 - w.c_c)
        };
        self.covariance *= 1.0 - w.c_1 - w.c_mu + lost;
        self.covariance.ger(w.c_1, &self.path_c, &self.path_c, 1.0);
        for (weight, step) in parents() {
            self.covariance.ger(w.c_mu * weight, step, step, 1.0);
        }
        self.sigma *= ((w.c_sigma / w.damping) * (length / w.length - 1.0))
            .min(1.0)
            .exp();
        self.fold();
        self.decompose();
    }

    /// Mirrors a mean that has left the box back into it, near the known points. Paths and covariance are mirrored too,
    /// so the distribution stays the same.
    fn fold(&mut self) {
        for i in 0..self.mean.len() {
            let mirrored = self.mean[i].floor().rem_euclid(2.0) == 1.0;
            self.mean[i] = inside(self.mean[i]);
            if mirrored {
                self.path_sigma[i] *= -1.0;
                self.path_c[i] *= -1.0;
                self.covariance.row_mut(i).neg_mut();
                self.covariance.column_mut(i).neg_mut();
            }
        }
    }

    fn decompose(&mut self) {
        let symmetric = (&self.covariance + self.covariance.transpose()) / 2.0;
        let found = SymmetricEigen::new(symmetric);
        self.lengths = found.eigenvalues.map(|v| v.max(0.0).sqrt());
        self.axes = found.eigenvectors;
    }

    /// Whether this run has ended: nothing changes any more, or the distribution has degenerated.
    pub(super) fn ended(&self, tolerance: f64) -> bool {
        let (least, most) = (self.lengths.min(), self.lengths.max());
        let degenerate =
            !(most.is_finite() && least > 0.0 && most * most < WORST_CONDITION * least * least);
        degenerate || self.sigma * most < SMALLEST_STEP || self.flat(tolerance)
    }

    /// Whether the best has improved by less than a share within the last generations.
    pub(super) fn stalled(&self, (share, generations): (f64, usize)) -> bool {
        let Some(earlier) = self.history.len().checked_sub(generations + 1) else {
            return false;
        };
        let best = |judged: &[Judgement]| {
            let first = Judgement::HOPELESS;
            let better = |best: Judgement, j: &Judgement| if j.beats(&best) { *j } else { best };
            judged.iter().fold(first, better)
        };
        let (before, now) = (best(&self.history[..=earlier]), best(&self.history));
        before.violation == now.violation && before.cost - now.cost <= share * now.cost.abs()
    }

    /// Whether the best of the last generations and all of the last one cost the same.
    fn flat(&self, tolerance: f64) -> bool {
        let dimensions = self.mean.len() as f64;
        let window = 10 + (30.0 * dimensions / self.weights.size as f64) as usize;
        if self.history.len() < window {
            return false;
        }
        let recent = self.history[self.history.len() - window..].iter();
        let all = || recent.clone().chain(&self.last);
        let least = all().map(|j| j.cost).fold(f64::INFINITY, f64::min);
        let most = all().map(|j| j.cost).fold(f64::NEG_INFINITY, f64::max);
        let feasible = all().all(|j| j.violation == 0.0);
        feasible && most - least <= tolerance * least.abs()
    }
}
