//! Tuning by simulated loops.

mod task;

use std::collections::BTreeMap;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::AnyDesign;
use sewfast_core::closed_loop::Run;
use sewfast_core::search::Options;
use sewfast_core::tune::{self as tuning, Method, Objective, Terms, Tuned, Variable, terms};
use sewfast_core::{Error, Result};

use super::controller::AnyGiven;
use super::named;
use crate::seam::{Raised, Values, array1, slice, watched};
use task::{Asked, Given, cost as named_cost};

/// What a run was like, term by term.
#[pyfunction]
#[pyo3(signature = (reference, u, y, *, u_min, u_max, Ts))]
pub fn cost_terms<'py>(
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
    let terms = terms(reference, &run, (u_min, u_max), Ts).raised(py)?;
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

/// The terms of [`cost_terms`] that a cost along a reference has.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Along {
    tracking: f64,
    chatter: f64,
    effort: f64,
    overshoot: f64,
    rise: f64,
    lag: f64,
    saturation: f64,
}

/// The cost of a run with these terms, for references of range `span` and commands of range `command`.
#[pyfunction]
#[pyo3(signature = (cost, terms, *, span, command))]
#[expect(clippy::needless_pass_by_value, reason = "extracted from Python")]
pub fn run_cost(
    py: Python<'_>,
    cost: BTreeMap<String, f64>,
    terms: Along,
    span: f64,
    command: f64,
) -> PyResult<f64> {
    let weights = named_cost(&cost).and_then(|c| c.weights(span, command));
    let terms = Terms {
        tracking: terms.tracking,
        chatter: terms.chatter,
        effort: terms.effort,
        overshoot: terms.overshoot,
        rise: terms.rise,
        lag: terms.lag,
        saturation: terms.saturation,
        ..Terms::default()
    };
    Ok(weights.raised(py)?.of(&terms))
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

/// The best controller, and how the search found it.
#[pyfunction]
#[pyo3(signature = (task, *, method, evaluations, seed, threads, progress=None))]
pub fn tune<'py>(
    py: Python<'py>,
    task: Asked<'py>,
    method: &str,
    evaluations: usize,
    seed: u64,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let given = Given::new(py, &task)?;
    let method = self::method(method).raised(py)?;
    let options = options(evaluations, seed, threads);
    let tuned = watched(py, progress, |monitor| {
        given.with(monitor, |task| tuning::tune(task, method, options, monitor))
    })?;
    result(py, &given, tuned)
}

fn result<'py>(py: Python<'py>, given: &Given, tuned: Tuned) -> PyResult<Bound<'py, PyDict>> {
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

fn values(variables: &[Variable], design: &AnyDesign<f64>) -> Vec<f64> {
    variables.iter().map(|v| v.parameter.of(design)).collect()
}

/// What controllers cost, by how much they violate the constraints, their largest overshoot [%] and command [u].
#[pyfunction]
#[pyo3(signature = (task, controllers, *, threads, progress=None))]
pub fn tuning_costs<'py>(
    py: Python<'py>,
    task: Asked<'py>,
    controllers: Vec<AnyGiven<'py>>,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Vec<(f64, f64, f64, f64)>> {
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
    let each = judged.iter();
    Ok(each
        .map(|j| (j.cost, j.violation, j.overshoot, j.u_max))
        .collect())
}

fn designs(controllers: &[AnyGiven<'_>]) -> Vec<AnyDesign<f64>> {
    controllers.iter().map(AnyGiven::design).collect()
}

/// Recovery [ms] and rms deviation [y] of each plant in each variation under the load steps, the worst of these.
#[pyfunction]
pub fn tuning_loads<'py>(py: Python<'py>, task: Asked<'py>) -> PyResult<Vec<(f64, f64)>> {
    let given = Given::new(py, &task)?;
    let did = watched(py, None, |monitor| {
        given.with(monitor, |task| tuning::loaded(task, &task.start, monitor))
    })?;
    Ok(did.iter().map(|did| (did.recovery, did.load)).collect())
}

/// Controllers of which none is better than another in everything.
#[pyfunction]
#[pyo3(signature = (task, *, others, objectives, size, evaluations, seed, threads, progress=None))]
pub fn pareto<'py>(
    py: Python<'py>,
    task: Asked<'py>,
    others: Vec<AnyGiven<'py>>,
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
        .raised(py)?;
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
