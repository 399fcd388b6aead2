//! Tuning by simulated loops.

use std::collections::BTreeMap;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::Design;
use sewfast_core::closed_loop::{Run, Varied, encoder};
use sewfast_core::loop_transfer as linear;
use sewfast_core::search::Options;
use sewfast_core::tune::{
    self as tuning, Aggregate, Constraints, Cost, Method, Objective, Parameter, Sensitivity, Task,
    Tuned, Variable, terms,
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
            _ => {
                return Err(Error::setting(format!(
                    "expected a term of the cost, tracking, chatter, effort, overshoot, overshoot_limit, rise, lag or \
                     saturation, got '{name}'"
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
/// Limits of Ms, overshoot [%] and |u|.
type Limits = (Option<f64>, Option<f64>, Option<f64>);

/// What tuning, comparing and the front have in common, owned.
struct Given {
    models: Vec<Model>,
    references: Vec<Vec<f64>>,
    variations: Vec<(f64, usize)>,
    counts_per_unit: f64,
    start: Design<f64>,
    variables: Vec<Variable>,
    cost: Cost,
    aggregate: Aggregate,
    limits: Limits,
    loops: Vec<linear::Plant>,
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
    #[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
    fn new(
        plants: &[Bound<'_, PyAny>],
        references: &[Values<'_>],
        start: &Bound<'_, Controller>,
        counts_per_unit: f64,
        variations: Vec<(f64, usize)>,
        variables: &[Wanted],
        cost: &BTreeMap<String, f64>,
        aggregate: &str,
        limits: Limits,
        loops: &[Fraction<'_>],
    ) -> PyResult<Self> {
        let py = start.py();
        let refused = |e| raise(py, e);
        let start = *start.borrow().core.design();
        let models = plants.iter().map(Model::of).collect::<PyResult<_>>()?;
        let samples = |r: &Values<'_>| slice(r, "references").map(<[f64]>::to_vec);
        Ok(Self {
            models,
            references: references.iter().map(samples).collect::<PyResult<_>>()?,
            variations,
            counts_per_unit,
            start,
            variables: self::variables(variables, &start).map_err(refused)?,
            cost: self::cost(cost).map_err(refused)?,
            aggregate: self::aggregate(aggregate).map_err(refused)?,
            limits,
            loops: self::loops(loops)?,
        })
    }

    /// Does `work` with the task.
    fn with<T>(
        &self,
        work: impl FnOnce(&Task<'_, Varied<AnyPlant<'_>>>) -> Result<T>,
    ) -> Result<T> {
        let plants = varied(&self.models, &self.variations, self.start.pid.ts)?;
        let references: Vec<&[f64]> = self.references.iter().map(Vec::as_slice).collect();
        let (ms, overshoot, u) = self.limits;
        if ms.is_some() && self.loops.is_empty() {
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
        let ms = match ms {
            None if self.loops.is_empty() => None,
            limit => Some((limit.unwrap_or(f64::MAX), sensitivity)),
        };
        work(&Task {
            plants: &plants,
            references: &references,
            encoder,
            start: self.start,
            variables: &self.variables,
            cost: self.cost,
            aggregate: self.aggregate,
            constraints: Constraints { ms, overshoot, u },
        })
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

#[pyfunction]
#[pyo3(signature = (plants, references, *, start, counts_per_unit, variations, variables, cost, aggregate, limits, loops, method, evaluations, seed, threads, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn tune<'py>(
    py: Python<'py>,
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    start: &Bound<'py, Controller>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    variables: Vec<Wanted>,
    cost: BTreeMap<String, f64>,
    aggregate: &str,
    limits: Limits,
    loops: Vec<Fraction<'py>>,
    method: &str,
    evaluations: usize,
    seed: u64,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let given = Given::new(
        &plants,
        &references,
        start,
        counts_per_unit,
        variations,
        &variables,
        &cost,
        aggregate,
        limits,
        &loops,
    )?;
    let method = self::method(method).map_err(|e| raise(py, e))?;
    let options = options(evaluations, seed, threads);
    let work = |monitor: &Monitor| given.with(|task| tuning::tune(task, method, options, monitor));
    let tuned = watched(py, progress, work)?;
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
#[pyo3(signature = (plants, references, controllers, *, counts_per_unit, variations, cost, aggregate, limits, loops, threads, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn tuning_costs<'py>(
    py: Python<'py>,
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    controllers: Vec<Bound<'py, Controller>>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    cost: BTreeMap<String, f64>,
    aggregate: &str,
    limits: Limits,
    loops: Vec<Fraction<'py>>,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Vec<(f64, f64)>> {
    let Some(first) = controllers.first() else {
        return Ok(Vec::new());
    };
    let given = Given::new(
        &plants,
        &references,
        first,
        counts_per_unit,
        variations,
        &[],
        &cost,
        aggregate,
        limits,
        &loops,
    )?;
    let designs: Vec<_> = controllers
        .iter()
        .map(|c| *c.borrow().core.design())
        .collect();
    let judged = watched(py, progress, |monitor| {
        let judged = given.with(|task| tuning::costs(task, &designs, threads, monitor))?;
        if monitor.stopped() {
            return Err(Error::fit("the comparison was interrupted"));
        }
        Ok(judged)
    })?;
    Ok(judged.iter().map(|j| (j.cost, j.violation)).collect())
}

#[pyfunction]
#[pyo3(signature = (plants, references, *, start, others, counts_per_unit, variations, variables, cost, aggregate, limits, loops, objectives, size, evaluations, seed, threads, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn pareto<'py>(
    py: Python<'py>,
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    start: &Bound<'py, Controller>,
    others: Vec<Bound<'py, Controller>>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    variables: Vec<Wanted>,
    cost: BTreeMap<String, f64>,
    aggregate: &str,
    limits: Limits,
    loops: Vec<Fraction<'py>>,
    objectives: Vec<String>,
    size: usize,
    evaluations: usize,
    seed: u64,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let given = Given::new(
        &plants,
        &references,
        start,
        counts_per_unit,
        variations,
        &variables,
        &cost,
        aggregate,
        limits,
        &loops,
    )?;
    let objectives: Vec<Objective> = objectives
        .iter()
        .map(|name| Objective::named(name))
        .collect::<Result<_>>()
        .map_err(|e| raise(py, e))?;
    let mut starts = vec![given.start];
    starts.extend(others.iter().map(|c| *c.borrow().core.design()));
    let options = options(evaluations, seed, threads);
    let front = watched(py, progress, |monitor| {
        given.with(|task| tuning::pareto(task, &objectives, &starts, size, options, monitor))
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
