//! Tuning by simulated loops.

use std::collections::BTreeMap;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::Design;
use sewfast_core::closed_loop::{Run, Varied, encoder};
use sewfast_core::loop_transfer as linear;
use sewfast_core::search::Options;
use sewfast_core::tune::{
    self as tuning, Aggregate, Constraints, Cost, LoadLimit, LoadStep, Method, Objective,
    Parameter, Sensitivity, Task, Tuned, Variable, terms,
};
use sewfast_core::{Error, Monitor, Result};

use super::controller::Controller;
use super::plant::{AnyPlant, Model};
use super::{Values, named};
use crate::arrays::{array1, raise, slice};
use crate::watch::watched;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(cost_terms, module)?)?;
    module.add_function(wrap_pyfunction!(tuning_costs, module)?)?;
    module.add_function(wrap_pyfunction!(tuning_loads, module)?)?;
    module.add_function(wrap_pyfunction!(pareto, module)?)?;
    module.add_function(wrap_pyfunction!(tune, module)?)
}

/// A cost from its weights by name; those left out keep their defaults.
fn cost(changes: &BTreeMap<String, f64>) -> Result<Cost> {
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

/// What a run was like, term by term.
#[pyfunction]
#[pyo3(signature = (reference, u, y, *, u_min, u_max, Ts))]
#[expect(non_snake_case, reason = "the field's name for the sample time")]
fn cost_terms<'py>(
    py: Python<'py>,
    reference: Values<'py>,
    u: Values<'py>,
    y: Values<'py>,
    u_min: f64,
    u_max: f64,
    Ts: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let reference = slice(&reference, "reference")?;
    let run = Run {
        u: slice(&u, "u")?.to_vec(),
        y: slice(&y, "y")?.to_vec(),
        ..Run::default()
    };
    let terms = terms(reference, &run, (u_min, u_max), Ts).map_err(|e| raise(py, e))?;
    named(
        py,
        [
            ("tracking", terms.tracking),
            ("chatter", terms.chatter),
            ("effort", terms.effort),
            ("overshoot", terms.overshoot),
            ("rise", terms.rise),
            ("lag", terms.lag),
            ("saturation", terms.saturation),
            ("u_max", terms.u_max),
        ],
    )
}

/// A variable by its name, with its bounds unless they are the usual ones.
type Wanted = (String, Option<(f64, f64)>);
/// Reference, disturbance, band and samples of the mean of a load step.
type Load<'py> = (Values<'py>, Values<'py>, f64, usize);

/// A limit in numbers, or what another controller does on each plant.
#[derive(FromPyObject)]
enum Most<'py> {
    Number(f64),
    Rival(Bound<'py, Controller>),
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

/// What tuning, comparing and the front have in common, as Python gives it.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Asked<'py> {
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    load_steps: Vec<Load<'py>>,
    start: Bound<'py, Controller>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    variables: Vec<Wanted>,
    cost: BTreeMap<String, f64>,
    aggregate: String,
    limits: Limits<'py>,
    linear_plants: Vec<Fraction<'py>>,
}

/// The same, owned.
struct Given {
    models: Vec<Model>,
    references: Vec<Vec<f64>>,
    load_steps: Vec<OwnedLoad>,
    variations: Vec<(f64, usize)>,
    counts_per_unit: f64,
    start: Design<f64>,
    variables: Vec<Variable>,
    cost: Cost,
    aggregate: Aggregate,
    ms: Option<f64>,
    overshoot: Option<f64>,
    u: Option<f64>,
    recovery: Option<OwnedMost>,
    load: Option<OwnedMost>,
    loops: Vec<linear::Plant>,
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
    Rival(Box<Design<f64>>),
}

impl OwnedMost {
    fn new(most: &Most<'_>) -> Self {
        match most {
            Most::Number(limit) => Self::Number(*limit),
            Most::Rival(rival) => Self::Rival(Box::new(*rival.borrow().core.design())),
        }
    }
}

/// Numerator and denominator in powers of `z^-1`.
type Fraction<'py> = (Values<'py>, Values<'py>);

fn loops(given: &[Fraction<'_>]) -> PyResult<Vec<linear::Plant>> {
    let plant = |(num, den): &Fraction<'_>| {
        let (num, den) = (slice(num, "num")?, slice(den, "den")?);
        linear::Plant::new(num, den).map_err(|e| raise(given[0].0.py(), e))
    };
    given.iter().map(plant).collect()
}

impl Given {
    fn new(py: Python<'_>, asked: &Asked<'_>) -> PyResult<Self> {
        let refused = |e| raise(py, e);
        let start = *asked.start.borrow().core.design();
        let samples = |r: &Values<'_>| slice(r, "references").map(<[f64]>::to_vec);
        let limits = &asked.limits;
        Ok(Self {
            models: asked
                .plants
                .iter()
                .map(Model::of)
                .collect::<PyResult<_>>()?,
            references: asked
                .references
                .iter()
                .map(samples)
                .collect::<PyResult<_>>()?,
            load_steps: asked
                .load_steps
                .iter()
                .map(OwnedLoad::new)
                .collect::<PyResult<_>>()?,
            variations: asked.variations.clone(),
            counts_per_unit: asked.counts_per_unit,
            start,
            variables: variables(&asked.variables, &start).map_err(refused)?,
            cost: cost(&asked.cost).map_err(refused)?,
            aggregate: aggregate(&asked.aggregate).map_err(refused)?,
            ms: limits.ms,
            overshoot: limits.overshoot,
            u: limits.u,
            recovery: limits.recovery.as_ref().map(OwnedMost::new),
            load: limits.load.as_ref().map(OwnedMost::new),
            loops: loops(&asked.linear_plants)?,
        })
    }

    /// Does `work` with the task.
    fn with<T>(
        &self,
        monitor: &Monitor,
        work: impl FnOnce(&Task<'_, Varied<AnyPlant<'_>>>) -> Result<T>,
    ) -> Result<T> {
        let plants = varied(&self.models, &self.variations, self.start.pid.ts)?;
        let references: Vec<&[f64]> = self.references.iter().map(Vec::as_slice).collect();
        let load_steps: Vec<LoadStep<'_>> = self.load_steps.iter().map(OwnedLoad::step).collect();
        if self.ms.is_some() && self.loops.is_empty() {
            return Err(Error::setting(
                "expected a linear plant to take Ms on, got none; give Constraints(plant=...)",
            ));
        }
        let encoder = encoder(self.counts_per_unit, 0.5)?;
        let sensitivity = |design: &Design<f64>| {
            let all = self.loops.iter();
            let of = |plant| peak_sensitivity(design, encoder.is_some(), plant);
            all.map(of).fold(1.0, f64::max)
        };
        let sensitivity: &Sensitivity<'_> = &sensitivity;
        // Without a limit Ms may still be an objective.
        let ms = match self.ms {
            None if self.loops.is_empty() => None,
            limit => Some((limit.unwrap_or(f64::MAX), sensitivity)),
        };
        let mut task = Task {
            plants: &plants,
            references: &references,
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

    /// Whether a rival is a measure on plant `k`: on plants as they are, where these are among the variations.
    fn is_compared(&self, k: usize) -> bool {
        let as_it_is = (1.0, 0);
        let own = self.variations[k % self.variations.len()];
        own == as_it_is || !self.variations.contains(&as_it_is)
    }

    /// What each plant may do under the load steps.
    fn load_limits(
        &self,
        task: &Task<'_, Varied<AnyPlant<'_>>>,
        monitor: &Monitor,
    ) -> Result<Vec<LoadLimit>> {
        if self.recovery.is_none() && self.load.is_none() {
            return Ok(Vec::new());
        }
        let of = |most: &Option<OwnedMost>, told: fn(&LoadLimit) -> f64| -> Result<Vec<f64>> {
            match most {
                None => Ok(vec![f64::INFINITY; task.plants.len()]),
                Some(OwnedMost::Number(limit)) => Ok(vec![*limit; task.plants.len()]),
                Some(OwnedMost::Rival(design)) => {
                    let did = tuning::loaded(task, design, monitor)?;
                    let told = |(k, did)| {
                        if self.is_compared(k) {
                            told(did)
                        } else {
                            f64::INFINITY
                        }
                    };
                    Ok(did.iter().enumerate().map(told).collect())
                }
            }
        };
        // One that is never beyond the band has recovered within a sample.
        let least = 1e3 * self.start.pid.ts;
        let recovery = of(&self.recovery, |did| did.recovery)?;
        let load = of(&self.load, |did| did.load)?;
        let limit = |(recovery, load): (&f64, &f64)| LoadLimit {
            recovery: recovery.max(least),
            load: *load,
        };
        Ok(recovery.iter().zip(&load).map(limit).collect())
    }
}

/// `Ms` of a design around a linear plant, of a schedule that of its worst point; infinite where there is no loop.
fn peak_sensitivity(design: &Design<f64>, encoder: bool, plant: &linear::Plant) -> f64 {
    let points = design.schedule.points();
    let constant = points.is_empty().then_some(design.pid.gains);
    let all = points.iter().map(|p| p.gains).chain(constant);
    let of = |gains| {
        let path = linear::Path {
            n: design.pid.n,
            filter_samples: design.filter_samples,
            filter_time: design.filter_time,
            observer_time: design.observer_time,
            encoder,
            ..linear::Path::new(gains, design.pid.ts)
        };
        linear::Loop::new(&path, plant)
            .map_or(f64::INFINITY, |closed| linear::peak_sensitivity(&closed))
    };
    all.map(of).fold(1.0, f64::max)
}

fn variables(wanted: &[Wanted], start: &Design<f64>) -> Result<Vec<Variable>> {
    if wanted.is_empty() {
        return Variable::usual(start);
    }
    let variable = |(name, bounds): &Wanted| Variable::new(Parameter::named(name)?, *bounds, start);
    wanted.iter().map(variable).collect()
}

fn method(name: &str) -> Result<Method> {
    match name {
        "genetic" => Ok(Method::Genetic),
        "cma-es" => Ok(Method::CmaEs),
        _ => Err(Error::setting(format!(
            "expected method 'genetic' or 'cma-es', got '{name}'"
        ))),
    }
}

fn options(evaluations: usize, seed: u64, threads: usize) -> Options {
    Options {
        evaluations,
        seed,
        threads,
        tolerance: tuning::TOLERANCE,
    }
}

/// The best controller, and the story of its search.
#[pyfunction]
#[pyo3(signature = (task, *, method, evaluations, seed, threads, progress=None))]
fn tune<'py>(
    py: Python<'py>,
    task: Asked<'py>,
    method: &str,
    evaluations: usize,
    seed: u64,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let given = Given::new(py, &task)?;
    let method = self::method(method).map_err(|e| raise(py, e))?;
    let options = options(evaluations, seed, threads);
    let tuned = watched(py, progress, |monitor| {
        given.with(monitor, |task| tuning::tune(task, method, options, monitor))
    })?;
    told(py, &given, tuned)
}

fn told<'py>(py: Python<'py>, given: &Given, tuned: Tuned) -> PyResult<Bound<'py, PyDict>> {
    let dict = named(
        py,
        [
            ("cost", tuned.cost),
            ("violation", tuned.violation),
            ("start_cost", tuned.start_cost),
        ],
    )?;
    dict.set_item("values", values(&given.variables, &tuned.design))?;
    dict.set_item("moved", tuned.start != given.start)?;
    dict.set_item("start", values(&given.variables, &tuned.start))?;
    dict.set_item("variables", described(&given.variables))?;
    dict.set_item("trace", array1(py, tuned.trace))?;
    dict.set_item("termination", tuned.termination.name())?;
    dict.set_item("weights", named(py, tuned.weights.named())?)?;
    Ok(dict)
}

/// Name, least and largest value of each variable.
fn described(variables: &[Variable]) -> Vec<(String, f64, f64)> {
    let described = |v: &Variable| (v.parameter.name(), v.low, v.high);
    variables.iter().map(described).collect()
}

fn values(variables: &[Variable], design: &Design<f64>) -> Vec<f64> {
    variables.iter().map(|v| v.parameter.of(design)).collect()
}

/// What controllers cost, and by how much they violate the constraints.
#[pyfunction]
#[pyo3(signature = (task, controllers, *, threads, progress=None))]
fn tuning_costs<'py>(
    py: Python<'py>,
    task: Asked<'py>,
    controllers: Vec<Bound<'py, Controller>>,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Vec<(f64, f64)>> {
    let given = Given::new(py, &task)?;
    let designs = designs(&controllers);
    let judged = watched(py, progress, |monitor| {
        let judged = given.with(monitor, |task| {
            tuning::costs(task, &designs, threads, monitor)
        })?;
        if monitor.stopped() {
            return Err(Error::fit("the comparison was interrupted"));
        }
        Ok(judged)
    })?;
    Ok(judged.iter().map(|j| (j.cost, j.violation)).collect())
}

fn designs(controllers: &[Bound<'_, Controller>]) -> Vec<Design<f64>> {
    let design = |c: &Bound<'_, Controller>| *c.borrow().core.design();
    controllers.iter().map(design).collect()
}

/// Recovery [ms] and rms deviation [y] of each plant in each variation under the load steps, the worst of these.
#[pyfunction]
fn tuning_loads<'py>(py: Python<'py>, task: Asked<'py>) -> PyResult<Vec<(f64, f64)>> {
    let given = Given::new(py, &task)?;
    let did = watched(py, None, |monitor| {
        given.with(monitor, |task| tuning::loaded(task, &task.start, monitor))
    })?;
    Ok(did.iter().map(|did| (did.recovery, did.load)).collect())
}

/// Controllers of which none is better than another in everything.
#[pyfunction]
#[pyo3(signature = (task, *, others, objectives, size, evaluations, seed, threads, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn pareto<'py>(
    py: Python<'py>,
    task: Asked<'py>,
    others: Vec<Bound<'py, Controller>>,
    objectives: Vec<String>,
    size: usize,
    evaluations: usize,
    seed: u64,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let given = Given::new(py, &task)?;
    let objectives: Vec<Objective> = objectives
        .iter()
        .map(|name| Objective::named(name))
        .collect::<Result<_>>()
        .map_err(|e| raise(py, e))?;
    let mut starts = vec![given.start];
    starts.extend(designs(&others));
    let options = options(evaluations, seed, threads);
    let front = watched(py, progress, |monitor| {
        given.with(monitor, |task| {
            tuning::pareto(task, &objectives, &starts, size, options, monitor)
        })
    })?;
    let dict = PyDict::new(py);
    let controllers = front.designs.iter().map(|d| values(&given.variables, d));
    dict.set_item("controllers", controllers.collect::<Vec<_>>())?;
    dict.set_item("values", front.values)?;
    dict.set_item("variables", described(&given.variables))?;
    dict.set_item("evaluations", front.evaluations)?;
    dict.set_item("termination", front.termination.name())?;
    Ok(dict)
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
