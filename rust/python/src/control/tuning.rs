//! Tuning by simulated loops.

use std::collections::BTreeMap;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::closed_loop::{Run, Varied, encoder};
use sewfast_core::tune::{self as tuning, Aggregate, Cost, Options, Task, Tuned, terms};
use sewfast_core::{Error, Monitor, Result};

use super::controller::Controller;
use super::plant::{AnyPlant, Model};
use super::{Values, named};
use crate::arrays::{array1, raise, slice};
use crate::watch::watched;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(cost_terms, module)?)?;
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

#[pyfunction]
#[pyo3(signature = (plants, references, *, start, counts_per_unit, variations, cost, aggregate, evaluations, seed, threads, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn tune<'py>(
    py: Python<'py>,
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    start: &Bound<'py, Controller>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    cost: BTreeMap<String, f64>,
    aggregate: &str,
    evaluations: usize,
    seed: u64,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let models: Vec<Model> = plants.iter().map(Model::of).collect::<PyResult<_>>()?;
    let references: Vec<&[f64]> = references
        .iter()
        .map(|r| slice(r, "references"))
        .collect::<PyResult<_>>()?;
    let start = start.borrow();
    let design = *start.core.design();
    let varied = varied(&models, &variations, design.pid.ts).map_err(|e| raise(py, e))?;
    let task = Task {
        plants: &varied,
        references: &references,
        encoder: encoder(counts_per_unit, 0.5).map_err(|e| raise(py, e))?,
        start: design,
        cost: self::cost(&cost).map_err(|e| raise(py, e))?,
        aggregate: self::aggregate(aggregate).map_err(|e| raise(py, e))?,
    };
    let options = Options {
        evaluations,
        seed,
        threads,
    };
    let work = |monitor: &Monitor| tuning::tune(&task, options, monitor);
    told(py, watched(py, progress, work)?)
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

fn told(py: Python<'_>, tuned: Tuned) -> PyResult<Bound<'_, PyDict>> {
    let s = &tuned.settings;
    let dict = named(
        py,
        [
            ("Kp", s.gains.kp),
            ("Ti", s.gains.ti),
            ("Td", s.gains.td),
            ("alpha", s.alpha),
            ("beta", s.beta),
            ("N", s.n),
            ("cost", tuned.cost),
            ("start_cost", tuned.start_cost),
        ],
    )?;
    dict.set_item("evaluations", tuned.evaluations)?;
    dict.set_item("trace", array1(py, tuned.trace))?;
    dict.set_item("termination", tuned.termination.name())?;
    dict.set_item("weights", named(py, tuned.weights.named())?)?;
    Ok(dict)
}
