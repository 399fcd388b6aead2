//! Pareto fronts of controllers: on a front, none is better than another in every objective.

use sewfast_control::AnyDesign;

use super::Task;
use super::bench::{Bench, Record, TOGETHER};
use super::variable::{designed, place};
use crate::closed_loop::Plant;
use crate::search::nsga2::{self, Objectives, Values};
use crate::search::{Options, Termination};
use crate::{Error, Monitor, Result};

/// An objective: a value to be small.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names are those of the terms of the cost")]
pub enum Objective {
    /// The weighted sum of all terms.
    Cost,
    Tracking,
    Chatter,
    Effort,
    Overshoot,
    Rise,
    Lag,
    Saturation,
    Recovery,
    Load,
    /// The largest sensitivity of the linear loops.
    Ms,
}

impl Objective {
    /// By its name.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for an unknown name.
    pub fn named(name: &str) -> Result<Self> {
        match name {
            "cost" => Ok(Self::Cost),
            "tracking" => Ok(Self::Tracking),
            "chatter" => Ok(Self::Chatter),
            "effort" => Ok(Self::Effort),
            "overshoot" => Ok(Self::Overshoot),
            "rise" => Ok(Self::Rise),
            "lag" => Ok(Self::Lag),
            "saturation" => Ok(Self::Saturation),
            "recovery" => Ok(Self::Recovery),
            "load" => Ok(Self::Load),
            "Ms" => Ok(Self::Ms),
            _ => Err(Error::setting(format!(
                "expected objectives among cost, tracking, chatter, effort, overshoot, rise, lag, saturation, recovery, load \
                 and Ms, got '{name}'"
            ))),
        }
    }
}

/// Controllers of which none is better than another in every objective.
#[derive(Clone, Debug, PartialEq)]
pub struct Front {
    /// The controllers, sorted by their first objective.
    pub designs: Vec<AnyDesign<f64>>,
    /// The objectives of each.
    pub values: Vec<Vec<f64>>,
    /// Controllers tried.
    pub evaluations: usize,
    /// Why the search ended.
    pub termination: Termination,
}

/// Searches for controllers with small `objectives`, with a population of `size` that begins with `starts`.
///
/// # Errors
/// As [`tune`](super::tune); `ErrorKind::Setting` for fewer than two objectives, or `Ms` without a linear loop.
pub fn pareto<P: Plant + Clone + Send + Sync>(
    task: &Task<'_, P>,
    objectives: &[Objective],
    starts: &[AnyDesign<f64>],
    size: usize,
    options: Options,
    monitor: &Monitor,
) -> Result<Front> {
    task.check()?;
    check(task, objectives)?;
    monitor.set_total(options.evaluations as u64);
    let problem = Several {
        task,
        objectives,
        bench: Bench::new(task)?.with_all_terms(task),
    };
    let places = |design: &AnyDesign<f64>| place(task.variables, design);
    let starts: Vec<Vec<f64>> = starts.iter().map(places).collect();
    let found = nsga2::search(&problem, &starts, size, options, monitor)?;
    let feasible = found
        .members
        .iter()
        .filter(|member| member.values.violation == 0.0);
    let mut front = Front {
        designs: Vec::new(),
        values: Vec::new(),
        evaluations: found.evaluations,
        termination: found.termination,
    };
    for member in feasible {
        front
            .designs
            .push(designed(task.variables, &member.point, &task.start)?);
        front.values.push(member.values.objectives.clone());
    }
    if front.designs.is_empty() && front.termination != Termination::Interrupted {
        return Err(Error::fit(format!(
            "expected controllers that stay bounded within the constraints, found none in {} trials; begin with smaller \
             gains, relax the constraints, or give more evaluations",
            front.evaluations
        )));
    }
    Ok(front)
}

fn check<P>(task: &Task<'_, P>, objectives: &[Objective]) -> Result<()> {
    if objectives.len() < 2 {
        return Err(Error::setting(format!(
            "expected two objectives or more, got {}; one is what tune is for",
            objectives.len()
        )));
    }
    let twice = (1..objectives.len()).find(|&i| objectives[..i].contains(&objectives[i]));
    if let Some(i) = twice {
        return Err(Error::setting(format!(
            "expected each objective once, got {:?} twice",
            objectives[i]
        )));
    }
    let of_load = |o: &Objective| matches!(o, Objective::Recovery | Objective::Load);
    if objectives.iter().any(of_load) && task.loads.is_empty() {
        return Err(Error::setting(
            "expected a load step for the objectives recovery and load, got none; give loads",
        ));
    }
    if objectives.contains(&Objective::Ms) && task.constraints.ms.is_none() {
        return Err(Error::setting(
            "expected a linear plant for the objective Ms, got none; give one with the constraints",
        ));
    }
    Ok(())
}

struct Several<'a, P> {
    task: &'a Task<'a, P>,
    objectives: &'a [Objective],
    bench: Bench<P>,
}

impl<P: Plant + Clone + Send + Sync> Several<'_, P> {
    fn value(&self, objective: Objective, record: &Record, design: &AnyDesign<f64>) -> f64 {
        let terms = &record.terms;
        match objective {
            Objective::Cost => record.cost,
            Objective::Tracking => terms.tracking,
            Objective::Chatter => terms.chatter,
            Objective::Effort => terms.effort,
            Objective::Overshoot => terms.overshoot,
            Objective::Rise => terms.rise,
            Objective::Lag => terms.lag,
            Objective::Saturation => terms.saturation,
            Objective::Recovery => terms.recovery,
            Objective::Load => terms.load,
            Objective::Ms => self
                .task
                .constraints
                .ms
                .map_or(f64::INFINITY, |(_, sensitivity)| sensitivity(design)),
        }
    }
}

impl<P: Plant + Clone + Send + Sync> Objectives for Several<'_, P> {
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

    fn judge(&self, bench: &mut Bench<P>, points: &[Vec<f64>], monitor: &Monitor) -> Vec<Values> {
        let design = |point: &Vec<f64>| designed(self.task.variables, point, &self.task.start);
        let designs: Vec<_> = points.iter().map(|point| design(point).ok()).collect();
        let known: Vec<_> = designs.iter().copied().flatten().collect();
        let mut judged = bench.records(self.task, &known, monitor).into_iter();
        let values = |design: &Option<_>| {
            let judged = design.and_then(|design| Some((design, judged.next()??)));
            judged.map_or_else(|| self.hopeless(), |judged| self.values(judged))
        };
        designs.iter().map(values).collect()
    }
}

impl<P: Plant + Clone + Send + Sync> Several<'_, P> {
    fn values(&self, (design, record): (AnyDesign<f64>, Record)) -> Values {
        let objectives = self.objectives.iter();
        Values {
            violation: record.violation,
            objectives: objectives
                .map(|o| self.value(*o, &record, &design))
                .collect(),
        }
    }

    fn hopeless(&self) -> Values {
        Values {
            violation: f64::INFINITY,
            objectives: vec![f64::INFINITY; self.objectives.len()],
        }
    }
}
