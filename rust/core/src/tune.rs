//! Tuning of controllers by simulated closed loops.
//!
//! A candidate's cost is taken over every plant and every reference, with encoder, filter and limits in the loop.
//! [`search`](crate::search) finds the least cost, or a Pareto front ([`pareto`]).
//!
//! To read: `variable` (what is searched), `cost` (what a run costs, and its constraints), `load` (load steps), `bench`
//! (the runs of one thread), `front`.

mod bench;
mod cost;
mod front;
mod load;
mod variable;

pub use cost::{Constraints, Cost, Sensitivity, Terms, Weights, terms};
pub use front::{Front, Objective, pareto};
pub use load::{LoadLimit, LoadStep};
pub use variable::{Parameter, Variable};

use std::iter;

use sewfast_control::{AnyDesign, Design};

use crate::closed_loop::{Plant, Signals};
use crate::random::Random;
use crate::search::{
    Candidate, Found, Judgement, Options, Problem, Termination, cma_es, genetic, several,
};
use crate::speed::Encoder;
use crate::{Error, Monitor, Result};
use bench::{Bench, TOGETHER};
use variable::{designed, moved, place};

/// What is tuned, on what.
#[derive(Clone, Debug)]
pub struct Task<'a, P> {
    /// Plants that one controller has to serve, all with the same weight.
    pub plants: &'a [P],
    /// References to follow, all with the same weight.
    pub references: &'a [&'a [f64]],
    /// A command added after the limits along each reference \[u\], as long as the reference; empty for none at all.
    pub disturbances: &'a [&'a [f64]],
    /// Measurement noise of each plant along the references \[y\], as long as the longest reference; empty for none at all.
    pub noise: &'a [&'a [f64]],
    /// Load steps to tolerate, all with the same weight; only recovery, deviation and `|u|` of their runs count.
    pub loads: &'a [LoadStep<'a>],
    /// The encoder of plants that bring none; `None` for ideal feedback.
    pub encoder: Option<Encoder>,
    /// The controller to begin with; parameters that are not searched keep its values.
    pub start: AnyDesign<f64>,
    /// What is searched.
    pub variables: &'a [Variable],
    /// The weights of the cost.
    pub cost: Cost,
    /// How the plants' costs become one.
    pub aggregate: Aggregate,
    /// Constraints on every controller.
    pub constraints: Constraints<'a>,
}

/// How a candidate's costs on the plants become one; a plant's cost is the mean over the references.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Aggregate {
    /// The mean over the plants.
    #[default]
    Mean,
    /// The worst plant's.
    Worst,
}

/// How the box is searched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// A genetic algorithm with local refinement.
    #[default]
    Genetic,
    /// CMA-ES with restarts.
    CmaEs,
}

/// The best controller and how the search found it.
#[derive(Clone, Debug, PartialEq)]
pub struct Tuned {
    /// The best controller.
    pub design: AnyDesign<f64>,
    /// The controller at which the search began: the task's start, moved within the given bounds.
    pub start: AnyDesign<f64>,
    /// Its cost.
    pub cost: f64,
    /// Sum of its relative violations of the constraints; above 0 only if the search was interrupted.
    pub violation: f64,
    /// The cost of the start; infinite if it diverges.
    pub start_cost: f64,
    /// The best cost so far after each evaluation, the start's first.
    pub trace: Vec<f64>,
    /// Why the search ended.
    pub termination: Termination,
    /// The weights in numbers.
    pub weights: Weights,
}

/// Share of the candidates judged on a part of the runs.
const SCOUTS: f64 = 0.6;
/// Candidates of one search on a part, of which there are as many as fit. Each ends in one of a few basins, as those of a PI and of a PID
/// are: of eight heaters and tanks, six seeds each, the worst single search cost up to 95 % more than the best, of whatever length it was.
/// With four of them, every other from anywhere, of 14 held-out heaters, axes and tanks, three seeds each, 12 cost within .4 % of the best
/// (the worst 4.6 %; all of them from the start: 65 %).
const SCOUTED: usize = 450;

/// Costs that differ by less than this share count as equal in the test whether a population has converged.
pub const TOLERANCE: f64 = 1e-5;

/// Searches the task's variables for the least cost. The result is never worse than the start, which is first moved
/// within the given bounds.
///
/// # Errors
/// `ErrorKind::Setting` for limits that are not finite or a start, variables, weights, constraints or options out of
/// range, `ErrorKind::Data` for references that cannot be run, `ErrorKind::Fit` if every controller tried diverges or
/// violates a constraint.
pub fn tune<P: Plant + Clone + Send + Sync>(
    task: &Task<'_, P>,
    method: Method,
    options: Options,
    monitor: &Monitor,
) -> Result<Tuned> {
    task.check()?;
    options.check()?;
    monitor.set_total(options.evaluations as u64);
    let mut bench = Bench::new(task)?;
    let first = moved(task.variables, &task.start)?;
    let start = bench.judge_one(task, &first, monitor);
    monitor.advance(1);
    monitor.report_cost(start.cost);
    let mut tuned = Tuned {
        design: first,
        start: first,
        cost: start.cost,
        violation: start.violation,
        start_cost: start.cost,
        trace: vec![start.cost],
        termination: Termination::Evaluations,
        weights: *bench.weights(),
    };
    let rest = Options {
        evaluations: options.evaluations - 1,
        ..options
    };
    if rest.evaluations > 0 {
        let point = place(task.variables, &first);
        let found = staged(task, &bench, method, &point, rest, monitor)?;
        if found.judgement.beats(&start) {
            tuned.design = designed(task.variables, &found.point, &task.start)?;
            tuned.cost = found.judgement.cost;
            tuned.violation = found.judgement.violation;
        }
        let better = |j: &Judgement| if j.beats(&start) { j.cost } else { start.cost };
        tuned.trace.extend(found.trace.iter().map(better));
        tuned.termination = found.termination;
    }
    tuned.checked()
}

/// First searches on a part of the runs for the region of the minimum, then on all runs for the minimum itself.
///
/// Runs of different plants along different references say much the same about a controller. In the part each reference
/// has one plant, so most of the search costs as little as a search on one plant. Every other search there begins at the start, the
/// others anywhere, as the start may lie in a dear basin; two of four see a rounder penalty of overshoot, whose ridges are lower. The best
/// of them goes on.
fn staged<P: Plant + Clone + Send + Sync>(
    task: &Task<'_, P>,
    bench: &Bench<P>,
    method: Method,
    start: &[f64],
    options: Options,
    monitor: &Monitor,
) -> Result<Found> {
    let on = |extent, bench| Searched {
        task,
        bench,
        extent,
    };
    let search = |problem, start, options| match method {
        Method::Genetic => genetic::search(problem, start, options, monitor),
        Method::CmaEs => cma_es::search(problem, start, options, monitor),
    };
    let whole = on(Extent::Whole, bench.clone());
    let scouts = (SCOUTS * options.evaluations as f64) as usize;
    if scouts == 0 {
        return search(&whole, Some(start), options);
    }
    let part = on(Extent::Part, bench.clone());
    let smooth = on(Extent::Part, bench.clone().smoothed());
    // a stop request must not lose what has been found
    let never = Monitor::default();
    let judge = |design| bench.clone().judge_one(task, &design, &never);
    let searches = (scouts / SCOUTED).max(1);
    let mut random = Random::new(options.seed);
    let mut seeds = iter::once(options.seed).chain(iter::from_fn(|| Some(random.next_u64())));
    let mut best: Option<Found> = None;
    let mut trace = Vec::new();
    for k in 0..searches {
        let own = Options {
            evaluations: scouts / searches,
            seed: seeds.next().unwrap_or_default(),
            ..options
        };
        let part = if k % 4 < 2 { &part } else { &smooth };
        let mut found = search(part, (k % 2 == 0).then_some(start), own)?;
        let design = designed(task.variables, &found.point, &task.start);
        found.judgement = design.map_or(Judgement::HOPELESS, judge);
        let known = best.as_ref().map_or(Judgement::HOPELESS, |b| b.judgement);
        trace.resize(trace.len() + found.trace.len(), known);
        if best.is_none() || found.judgement.beats(&known) {
            best = Some(found);
        }
        if let (Some(last), Some(best)) = (trace.last_mut(), &best) {
            *last = best.judgement;
        }
        if monitor.stopped() {
            break;
        }
    }
    let Some(best) = best else {
        return search(&whole, Some(start), options);
    };
    let found = Found { trace, ..best };
    cma_es::refine(&whole, found, options, monitor)
}

/// A design as a search judges it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// What it costs; infinite if a run diverges.
    pub cost: f64,
    /// Sum of the relative violations of the constraints; infinite if a run diverges.
    pub violation: f64,
    /// Largest overshoot of all runs \[%\]; infinite if one diverges.
    pub overshoot: f64,
    /// Largest `|u|` of all runs \[u\]; infinite if one diverges.
    pub u_max: f64,
}

/// What a search finds of each design.
///
/// # Errors
/// As [`tune`], except that useless designs are no error.
pub fn costs<P: Plant + Clone + Send + Sync>(
    task: &Task<'_, P>,
    designs: &[AnyDesign<f64>],
    threads: usize,
    monitor: &Monitor,
) -> Result<Vec<Judged>> {
    task.check()?;
    monitor.set_total(designs.len() as u64);
    let bench = Bench::new(task)?.with_overshoot();
    let mut benches = vec![bench; threads.clamp(1, designs.len().max(1))];
    Ok(several(&mut benches, designs, TOGETHER, |bench, some| {
        let judged = bench.records(task, some, monitor);
        monitor.advance(some.len() as u64);
        let judged = judged.into_iter().map(|record| {
            record.map_or(
                Judged {
                    cost: f64::INFINITY,
                    violation: f64::INFINITY,
                    overshoot: f64::INFINITY,
                    u_max: f64::INFINITY,
                },
                |record| Judged {
                    cost: record.cost,
                    violation: record.violation,
                    overshoot: record.largest.overshoot,
                    u_max: record.largest.u_max,
                },
            )
        });
        judged.collect()
    }))
}

/// The worst that each plant does with a design under the task's load steps: a reference for other designs.
///
/// # Errors
/// As [`tune`]; `ErrorKind::Fit` if a run diverges or on a stop.
pub fn loaded<P: Plant + Clone>(
    task: &Task<'_, P>,
    design: &AnyDesign<f64>,
    monitor: &Monitor,
) -> Result<Vec<LoadLimit>> {
    task.check()?;
    Bench::new(task)?.loaded(task, design, monitor).ok_or_else(|| {
        Error::fit(
            "expected a controller that bears the load steps on every plant, with this one a run diverges; take smaller \
             gains",
        )
    })
}

impl Tuned {
    fn checked(self) -> Result<Self> {
        let tried = self.trace.len();
        let interrupted = self.termination == Termination::Interrupted;
        if !self.cost.is_finite() {
            Err(Error::fit(format!(
                "expected a controller with which no loop diverges, found none in {tried} trials; begin with smaller \
                 gains, give more evaluations, or check the model on new data first"
            )))
        } else if self.violation > 0.0 && !interrupted {
            Err(Error::fit(format!(
                "expected a controller that keeps to the constraints, found none in {tried} trials: the best exceeds \
                 them by {:.3} of their limits in sum; relax them, search more variables, or give more evaluations",
                self.violation
            )))
        } else {
            Ok(self)
        }
    }
}

impl<'a, P> Task<'a, P> {
    /// Runs on each plant: first the load steps, which are short and expose useless candidates early, then the references.
    fn runs(&self) -> usize {
        self.loads.len() + self.references.len()
    }

    /// The external signals of a plant's run.
    fn signals(&self, plant: usize, run: usize) -> Signals<'a> {
        match self.loads.get(run) {
            // Without noise: recovery is the last time beyond a band, and with noise that would be one of its peaks.
            Some(load) => load.signals(),
            None => self.along(plant, run - self.loads.len()),
        }
    }

    /// A reference with its disturbance and its measurement noise.
    fn along(&self, plant: usize, reference: usize) -> Signals<'a> {
        let r = self.references[reference];
        let noise = self.noise.get(plant);
        Signals {
            disturbance: self.disturbances.get(reference).copied(),
            noise: noise.map(|noise| &noise[..noise.len().min(r.len())]),
            ..Signals::new(r)
        }
    }

    /// How many of a plant's runs weigh as much as one on all plants; `None` for a run outside this extent.
    ///
    /// In a part, every plant bears its load steps, as most constraints concern them, and one plant follows each
    /// reference. Plants are variations of models, model by model: strides of the golden ratio reach several of both.
    fn share(&self, extent: Extent, plant: usize, run: usize) -> Option<f64> {
        let Some(reference) = run.checked_sub(self.loads.len()) else {
            return Some(1.0);
        };
        let plants = self.plants.len();
        let golden = 0.5 * (5f64.sqrt() - 1.0);
        let chosen = (reference as f64 * golden * plants as f64) as usize % plants;
        match extent {
            Extent::Whole => Some(1.0),
            Extent::Part => (chosen == plant).then_some(plants as f64),
        }
    }

    /// How many runs of its kind share the weight of one.
    fn alike(&self, run: usize) -> f64 {
        let several = if run < self.loads.len() {
            self.loads.len()
        } else {
            self.references.len()
        };
        several as f64
    }

    fn check(&self) -> Result<()> {
        self.start.check()?;
        let (u_min, u_max) = self.start.limits();
        if !(u_min.is_finite() && u_max.is_finite()) {
            return Err(Error::setting(format!(
                "expected finite output limits to tune within, got {u_min} and {u_max}; give those of the amplifier"
            )));
        }
        let no_sign = |pid: &Design<f64>| pid.pid.gains.kp == 0.0 && pid.schedule.is_empty();
        if self.start.pid().is_some_and(no_sign) {
            return Err(Error::setting(
                "expected a start with Kp other than 0, got 0; its sign says which way the plant acts",
            ));
        }
        if self.plants.is_empty() || self.references.is_empty() {
            return Err(Error::setting(format!(
                "expected at least one plant and one reference, got {} and {}",
                self.plants.len(),
                self.references.len()
            )));
        }
        self.check_variables()?;
        self.constraints.check()?;
        self.check_loads()?;
        if !(self.disturbances.is_empty() || self.disturbances.len() == self.references.len()) {
            return Err(Error::setting(format!(
                "expected a disturbance for each of {} references or none at all, got {}",
                self.references.len(),
                self.disturbances.len()
            )));
        }
        for plant in 0..self.noise.len().max(1) {
            for reference in 0..self.references.len() {
                self.along(plant, reference).check()?;
            }
        }
        Ok(())
    }

    fn check_loads(&self) -> Result<()> {
        let weighed = self.cost.recovery > 0.0 || self.cost.load > 0.0;
        if self.loads.is_empty() && (weighed || !self.constraints.loads.is_empty()) {
            return Err(Error::setting(
                "expected a load step to take recovery and load on, got none; give loads",
            ));
        }
        self.loads.iter().try_for_each(LoadStep::check)
    }

    fn check_variables(&self) -> Result<()> {
        if self.variables.is_empty() {
            return Err(Error::setting("expected a variable to search, got none"));
        }
        for (i, variable) in self.variables.iter().enumerate() {
            let same = |v: &Variable| v.parameter == variable.parameter;
            if self.variables[..i].iter().any(same) {
                return Err(Error::setting(format!(
                    "expected each variable once, got {} twice",
                    variable.parameter.name()
                )));
            }
        }
        Ok(())
    }
}

/// The cost as a function over the box of the variables.
struct Searched<'a, P> {
    task: &'a Task<'a, P>,
    bench: Bench<P>,
    extent: Extent,
}

/// The runs on which candidates are judged: all of them, or one plant's for each reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Extent {
    Whole,
    Part,
}

impl<P: Plant + Clone + Send + Sync> Problem for Searched<'_, P> {
    type Memory = Bench<P>;

    fn dimensions(&self) -> usize {
        self.task.variables.len()
    }

    fn memory(&self) -> Bench<P> {
        self.bench.clone()
    }

    fn together(&self) -> usize {
        TOGETHER
    }

    fn is_whole(&self) -> bool {
        self.extent == Extent::Whole
    }

    fn judge(
        &self,
        bench: &mut Bench<P>,
        candidates: &[Candidate],
        monitor: &Monitor,
    ) -> Vec<Judgement> {
        let trial = |candidate: &Candidate| {
            let design = designed(self.task.variables, &candidate.point, &self.task.start);
            Some((design.ok()?, candidate.to_beat))
        };
        let trials: Vec<_> = candidates.iter().map(trial).collect();
        let known: Vec<_> = trials.iter().copied().flatten().collect();
        let judged = bench.judge(self.task, self.extent, &known, monitor);
        let mut judged = judged.into_iter();
        let judgement = |trial: &Option<_>| trial.and_then(|_| judged.next());
        let judgements = trials.iter().map(judgement);
        judgements
            .map(|j| j.unwrap_or(Judgement::HOPELESS))
            .collect()
    }
}

#[cfg(test)]
mod tests;
