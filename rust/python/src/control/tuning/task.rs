//! The task of tuning: as passed by Python, and as the core takes it.

use std::collections::BTreeMap;

use pyo3::prelude::*;
use sewfast_control::AnyDesign;
use sewfast_core::closed_loop::{Varied, encoder, white_noise};
use sewfast_core::tune::{
    self as tuning, Aggregate, Constraints, Cost, LoadLimit, LoadStep, Parameter, Sensitivity,
    Task, Variable,
};
use sewfast_core::{Error, Monitor, Result, loop_transfer as linear};

use super::super::controller::AnyGiven;
use super::super::{AnyPlant, Model};
use crate::loop_transfer::{Lines, measured};
use crate::seam::{Raised, Values, slice};

/// A variable by its name, with its bounds unless they are the usual ones.
type Wanted = (String, Option<(f64, f64)>);
/// Reference, disturbance, band and samples of the mean of a load step.
type Load<'py> = (Values<'py>, Values<'py>, f64, usize);

/// A limit as a number, or the result of another controller on each plant.
#[derive(FromPyObject)]
enum Most<'py> {
    Number(f64),
    Rival(AnyGiven<'py>),
}

/// The limits by name.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Limits<'py> {
    #[pyo3(item("Ms"))]
    ms: Option<f64>,
    overshoot: Option<f64>,
    u: Option<f64>,
    recovery: Option<Most<'py>>,
    load: Option<Most<'py>>,
}

/// The arguments common to tuning, comparing and the front, as passed by Python.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Asked<'py> {
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    disturbances: Vec<Values<'py>>,
    noise: Vec<f64>,
    load_steps: Vec<Load<'py>>,
    start: AnyGiven<'py>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    variables: Vec<Wanted>,
    cost: BTreeMap<String, f64>,
    aggregate: String,
    limits: Limits<'py>,
    linear_plants: Vec<Fraction<'py>>,
    measured: Vec<Lines<'py>>,
}

/// The same, owned.
pub struct Given {
    models: Vec<Model>,
    references: Vec<Vec<f64>>,
    disturbances: Vec<Vec<f64>>,
    noise: Vec<f64>,
    load_steps: Vec<OwnedLoad>,
    variations: Vec<(f64, usize)>,
    counts_per_unit: f64,
    pub start: AnyDesign<f64>,
    pub variables: Vec<Variable>,
    cost: Cost,
    aggregate: Aggregate,
    ms: Option<f64>,
    overshoot: Option<f64>,
    u: Option<f64>,
    recovery: Option<OwnedMost>,
    load: Option<OwnedMost>,
    loops: Vec<linear::Changing>,
    measured: Vec<linear::Measured>,
}

struct OwnedLoad {
    reference: Vec<f64>,
    disturbance: Vec<f64>,
    band: f64,
    mean: usize,
}

impl OwnedLoad {
    fn new((reference, disturbance, band, mean): &Load<'_>) -> PyResult<Self> {
        Ok(Self {
            reference: slice(reference, "reference")?.to_vec(),
            disturbance: slice(disturbance, "disturbance")?.to_vec(),
            band: *band,
            mean: *mean,
        })
    }

    fn step(&self) -> LoadStep<'_> {
        LoadStep {
            reference: &self.reference,
            disturbance: &self.disturbance,
            band: self.band,
            mean: self.mean,
        }
    }
}

enum OwnedMost {
    Number(f64),
    Rival(Box<AnyDesign<f64>>),
}

impl OwnedMost {
    fn new(most: &Most<'_>) -> Self {
        match most {
            Most::Number(limit) => Self::Number(*limit),
            Most::Rival(rival) => Self::Rival(Box::new(rival.design())),
        }
    }

    fn rival(&self) -> Option<&AnyDesign<f64>> {
        match self {
            Self::Number(_) => None,
            Self::Rival(design) => Some(design),
        }
    }

    /// The limit as a number; `did` is the rival's result on a plant for which it counts.
    fn limit(most: &Option<Self>, did: Option<f64>) -> f64 {
        match most {
            Some(Self::Number(limit)) => *limit,
            Some(Self::Rival(_)) => did.unwrap_or(f64::INFINITY),
            None => f64::INFINITY,
        }
    }
}

/// Numerator and denominator in powers of `z^-1`.
type Fraction<'py> = (Values<'py>, Values<'py>);

fn loops(given: &[Fraction<'_>]) -> PyResult<Vec<linear::Changing>> {
    let plant = |(num, den): &Fraction<'_>| {
        let (num, den) = (slice(num, "num")?, slice(den, "den")?);
        let plant = linear::Plant::new(num, den).raised(given[0].0.py())?;
        Ok(linear::Changing::new(plant))
    };
    given.iter().map(plant).collect()
}

impl Given {
    pub fn new(py: Python<'_>, asked: &Asked<'_>) -> PyResult<Self> {
        let start = asked.start.design();
        let owned = |name: &'static str, signals: &[Values<'_>]| -> PyResult<Vec<Vec<f64>>> {
            let samples = |s: &Values<'_>| slice(s, name).map(<[f64]>::to_vec);
            signals.iter().map(samples).collect()
        };
        let limits = &asked.limits;
        Ok(Self {
            models: asked
                .plants
                .iter()
                .map(Model::of)
                .collect::<PyResult<_>>()?,
            references: owned("references", &asked.references)?,
            disturbances: owned("disturbances", &asked.disturbances)?,
            noise: asked.noise.clone(),
            load_steps: asked
                .load_steps
                .iter()
                .map(OwnedLoad::new)
                .collect::<PyResult<_>>()?,
            variations: asked.variations.clone(),
            counts_per_unit: asked.counts_per_unit,
            start,
            variables: variables(&asked.variables, &start).raised(py)?,
            cost: cost(&asked.cost).raised(py)?,
            aggregate: aggregate(&asked.aggregate).raised(py)?,
            ms: limits.ms,
            overshoot: limits.overshoot,
            u: limits.u,
            recovery: limits.recovery.as_ref().map(OwnedMost::new),
            load: limits.load.as_ref().map(OwnedMost::new),
            loops: loops(&asked.linear_plants)?,
            measured: asked
                .measured
                .iter()
                .map(|lines| measured(lines, start.ts()))
                .collect::<PyResult<_>>()?,
        })
    }

    /// Does `work` with the task.
    pub fn with<T>(
        &self,
        monitor: &Monitor,
        work: impl FnOnce(&Task<'_, Varied<AnyPlant<'_>>>) -> Result<T>,
    ) -> Result<T> {
        let plants = varied(&self.models, &self.variations, self.start.ts())?;
        let references: Vec<&[f64]> = self.references.iter().map(Vec::as_slice).collect();
        let disturbances: Vec<&[f64]> = self.disturbances.iter().map(Vec::as_slice).collect();
        let noise = self.noise();
        let noise: Vec<&[f64]> = noise.iter().map(Vec::as_slice).collect();
        let load_steps: Vec<LoadStep<'_>> = self.load_steps.iter().map(OwnedLoad::step).collect();
        if self.ms.is_some() && self.loops.is_empty() && self.measured.is_empty() {
            return Err(Error::setting(
                "expected a linear plant to take Ms on, got none; give Constraints(plant=...)",
            ));
        }
        let encoder = encoder(self.counts_per_unit, 0.5)?;
        let sensitivity = |design: &AnyDesign<f64>| {
            let paths = paths(design, encoder.is_some());
            let of = |path: &linear::Path| {
                let plants = self.loops.iter().map(|plant| plant.sensitivity(path).0);
                let measured = self.measured.iter().map(|m| m.peak_sensitivity(path));
                plants.chain(measured).fold(1.0, f64::max)
            };
            paths.iter().map(of).fold(1.0, f64::max)
        };
        let sensitivity: &Sensitivity<'_> = &sensitivity;
        // Without a limit Ms may still be an objective.
        let ms = match self.ms {
            None if self.loops.is_empty() && self.measured.is_empty() => None,
            limit => Some((limit.unwrap_or(f64::MAX), sensitivity)),
        };
        let mut task = Task {
            plants: &plants,
            references: &references,
            disturbances: &disturbances,
            noise: &noise,
            loads: &load_steps,
            encoder,
            start: self.start,
            variables: &self.variables,
            cost: self.cost,
            aggregate: self.aggregate,
            constraints: Constraints {
                ms,
                overshoot: self.overshoot,
                u: self.u,
                loads: &[],
            },
        };
        let limits = self.load_limits(&task, monitor)?;
        task.constraints.loads = &limits;
        work(&task)
    }

    /// The measurement noise of each plant in each of its variations; empty if no plant has noise.
    fn noise(&self) -> Vec<Vec<f64>> {
        if self.noise.iter().all(|deviation| *deviation == 0.0) {
            return Vec::new();
        }
        let longest = self.references.iter().map(Vec::len).max().unwrap_or(0);
        let each = self.noise.iter();
        each.flat_map(|&deviation| vec![white_noise(deviation, longest, 0); self.variations.len()])
            .collect()
    }

    /// Whether the rival counts on plant `k`: only on plants without variation, if these are among the variations.
    fn is_compared(&self, k: usize) -> bool {
        let as_it_is = (1.0, 0);
        let own = self.variations[k % self.variations.len()];
        own == as_it_is || !self.variations.contains(&as_it_is)
    }

    /// Limits for each plant under the load steps.
    fn load_limits(
        &self,
        task: &Task<'_, Varied<AnyPlant<'_>>>,
        monitor: &Monitor,
    ) -> Result<Vec<LoadLimit>> {
        if self.recovery.is_none() && self.load.is_none() {
            return Ok(Vec::new());
        }
        let of = |rival| tuning::loaded(task, rival, monitor);
        let [first, second] =
            [&self.recovery, &self.load].map(|most| most.as_ref().and_then(OwnedMost::rival));
        let did = first.map(of).transpose()?;
        let other = match second {
            Some(rival) if Some(rival) != first => Some(of(rival)?),
            _ => None,
        };
        let least = 1e3 * self.start.ts();
        let limit = |k: usize| {
            let compared = |did: &Vec<LoadLimit>| self.is_compared(k).then(|| did[k]);
            let recovery = did.as_ref().and_then(compared);
            let load = other.as_ref().or(did.as_ref()).and_then(compared);
            LoadLimit {
                // A rival that never leaves the band recovers within a sample.
                recovery: OwnedMost::limit(&self.recovery, recovery.map(|r| r.recovery)).max(least),
                load: OwnedMost::limit(&self.load, load.map(|l| l.load)),
            }
        };
        Ok((0..task.plants.len()).map(limit).collect())
    }
}

/// The feedback paths of a design: one, or one for each point of its schedule.
fn paths(design: &AnyDesign<f64>, encoder: bool) -> Vec<linear::Path> {
    let Some(design) = design.pid() else {
        return Vec::new();
    };
    let points = design.schedule.points();
    let constant = points.is_empty().then_some(design.pid.gains);
    let all = points.iter().map(|p| p.gains).chain(constant);
    let of = |gains| linear::Path {
        n: design.pid.n,
        filter_samples: design.filter_samples,
        filter_time: design.filter_time,
        observer_time: design.observer_time,
        biquads: design.biquads,
        encoder,
        ..linear::Path::new(gains, design.pid.ts)
    };
    all.map(of).collect()
}

fn variables(wanted: &[Wanted], start: &AnyDesign<f64>) -> Result<Vec<Variable>> {
    if wanted.is_empty() {
        return Variable::usual(start);
    }
    let variable = |(name, bounds): &Wanted| Variable::new(Parameter::named(name)?, *bounds, start);
    wanted.iter().map(variable).collect()
}

/// A cost from its weights by name; others keep their defaults.
pub fn cost(changes: &BTreeMap<String, f64>) -> Result<Cost> {
    let mut cost = Cost::default();
    for (name, &value) in changes {
        match name.as_str() {
            "tracking" => cost.tracking = value,
            "chatter" => cost.chatter = Some(value),
            "effort" => cost.effort = value,
            "overshoot" => cost.overshoot = Some(value),
            "overshoot_limit" => cost.overshoot_limit = value,
            "rise" => cost.rise = value,
            "lag" => cost.lag = value,
            "saturation" => cost.saturation = Some(value),
            "recovery" => cost.recovery = value,
            "load" => cost.load = value,
            _ => {
                return Err(Error::setting(format!(
                    "expected a term of the cost, tracking, chatter, effort, overshoot, overshoot_limit, rise, lag, \
                     saturation, recovery or load, got '{name}'"
                )));
            }
        }
    }
    Ok(cost)
}

fn aggregate(name: &str) -> Result<Aggregate> {
    match name {
        "mean" => Ok(Aggregate::Mean),
        "worst" => Ok(Aggregate::Worst),
        _ => Err(Error::setting(format!(
            "expected aggregate 'mean' or 'worst', got '{name}'"
        ))),
    }
}

fn varied<'a>(
    models: &'a [Model],
    variations: &[(f64, usize)],
    ts: f64,
) -> Result<Vec<Varied<AnyPlant<'a>>>> {
    models
        .iter()
        .flat_map(|model| variations.iter().map(move |variation| (model, *variation)))
        .map(|(model, (gain, delay))| Varied::new(model.plant(ts)?, gain, delay))
        .collect()
}
