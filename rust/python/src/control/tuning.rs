//! Tuning by simulated loops.

use std::collections::BTreeMap;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::closed_loop::{Varied, encoder};
use sewfast_core::tune::{self as tuning, Options, Task, Tuned, Weights};
use sewfast_core::{Error, Monitor, Result};

use super::controller::Controller;
use super::plant::{AnyPlant, Model};
use super::{Values, named};
use crate::arrays::{array1, raise, slice};
use crate::watch::watched;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(default_weights, module)?)?;
    module.add_function(wrap_pyfunction!(tune, module)?)
}

/// The cost's weights by name.
#[pyfunction]
fn default_weights(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let w = Weights::default();
    named(
        py,
        [
            ("chatter", w.chatter),
            ("overshoot", w.overshoot),
            ("overshoot_limit", w.overshoot_limit),
            ("saturation", w.saturation),
        ],
    )
}

fn weights(changes: &BTreeMap<String, f64>) -> Result<Weights> {
    let mut weights = Weights::default();
    for (name, &value) in changes {
        let place = match name.as_str() {
            "chatter" => &mut weights.chatter,
            "overshoot" => &mut weights.overshoot,
            "overshoot_limit" => &mut weights.overshoot_limit,
            "saturation" => &mut weights.saturation,
            _ => {
                return Err(Error::setting(format!(
                    "expected weights named chatter, overshoot, overshoot_limit or saturation, got '{name}'"
                )));
            }
        };
        *place = value;
    }
    Ok(weights)
}

#[pyfunction]
#[pyo3(signature = (plants, references, *, start, counts_per_unit, variations, weights, evaluations, seed, threads, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn tune<'py>(
    py: Python<'py>,
    plants: Vec<Bound<'py, PyAny>>,
    references: Vec<Values<'py>>,
    start: &Bound<'py, Controller>,
    counts_per_unit: f64,
    variations: Vec<(f64, usize)>,
    weights: BTreeMap<String, f64>,
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
    let settings = *start.core.settings();
    let varied = varied(&models, &variations, settings.ts).map_err(|e| raise(py, e))?;
    let task = Task {
        plants: &varied,
        references: &references,
        encoder: encoder(counts_per_unit, 0.5).map_err(|e| raise(py, e))?,
        start: settings,
        filter_samples: start.filter_samples,
        filter_time: start.filter_time,
        weights: self::weights(&weights).map_err(|e| raise(py, e))?,
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
    Ok(dict)
}
