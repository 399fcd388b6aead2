//! Bindings of the core's control: the controller, the closed loop, tuning rules, tuning.

pub mod controller;
mod plant;
mod tuning;

use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::{Parallel, PerSample, Refused, Standard};
use sewfast_core::closed_loop::{self as looped, Outcome, Run, Signals};
use sewfast_core::metrics::{self, Effort};
use sewfast_core::{Error, Result};

use crate::arrays::{array1, raise, slice};
use crate::watch::watched_over;
pub use controller::{AnyGiven, Controller};
use plant::Model;

type Values<'py> = PyReadonlyArray1<'py, f64>;
type Triple = (f64, f64, f64);

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    controller::register(module)?;
    module.add_function(wrap_pyfunction!(convert_gains, module)?)?;
    module.add_function(wrap_pyfunction!(closed_loop, module)?)?;
    module.add_function(wrap_pyfunction!(step_metrics, module)?)?;
    module.add_function(wrap_pyfunction!(effort, module)?)?;
    tuning::register(module)
}

#[pyfunction]
#[pyo3(signature = (gains, *, form, to, Ts))]
#[expect(non_snake_case, reason = "the field's name for the sample time")]
fn convert_gains(py: Python<'_>, gains: Triple, form: &str, to: &str, Ts: f64) -> PyResult<Triple> {
    converted(gains, form, to, Ts).map_err(|e| raise(py, e))
}

fn converted((p, i, d): Triple, form: &str, to: &str, ts: f64) -> Result<Triple> {
    let per_sample = form == "per_sample" || to == "per_sample";
    if per_sample && !(ts > 0.0 && ts.is_finite()) {
        return Err(Error::setting(format!(
            "expected the sample time Ts [s] at which the per-sample gains hold, got {ts}; give Ts above 0"
        )));
    }
    let standard: std::result::Result<Standard<f64>, Refused> = match form {
        "standard" => Standard {
            kp: p,
            ti: i,
            td: d,
        }
        .checked(),
        "parallel" => Parallel {
            kp: p,
            ki: i,
            kd: d,
        }
        .to_standard(),
        "per_sample" => PerSample {
            kp: p,
            ki: i,
            kd: d,
            ts,
        }
        .to_standard(),
        _ => return Err(unknown_form(form)),
    };
    let standard = standard?;
    match to {
        _ if to == form => Ok((p, i, d)),
        "standard" => Ok((standard.kp, standard.ti, standard.td)),
        "parallel" => {
            let g = standard.to_parallel();
            Ok((g.kp, g.ki, g.kd))
        }
        "per_sample" => {
            let g = standard.to_per_sample(ts);
            Ok((g.kp, g.ki, g.kd))
        }
        _ => Err(unknown_form(to)),
    }
}

fn unknown_form(form: &str) -> Error {
    Error::setting(format!(
        "expected a form of gains, standard, parallel or per_sample, got '{form}'"
    ))
}

#[pyfunction]
#[pyo3(signature = (plant, controller, reference, *, counts_per_unit, encoder_phase=0.5, feedforward=None, disturbance=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn closed_loop<'py>(
    py: Python<'py>,
    plant: &Bound<'py, PyAny>,
    controller: AnyGiven<'py>,
    reference: Values<'py>,
    counts_per_unit: f64,
    encoder_phase: f64,
    feedforward: Option<Values<'py>>,
    disturbance: Option<Values<'py>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (model, design) = (Model::of(plant)?, controller.design());
    let beside = |values: &'_ Option<Values<'py>>, name| -> PyResult<Option<Vec<f64>>> {
        let values = values.as_ref().map(|values| slice(values, name));
        Ok(values.transpose()?.map(<[f64]>::to_vec))
    };
    let feedforward = beside(&feedforward, "feedforward")?;
    let disturbance = beside(&disturbance, "disturbance")?;
    let signals = Signals {
        reference: slice(&reference, "reference")?,
        feedforward: feedforward.as_deref(),
        disturbance: disturbance.as_deref(),
    };
    let run = watched_over(py, signals.reference.len(), |monitor| {
        let encoder = looped::encoder(counts_per_unit, encoder_phase)?;
        let mut controller = design.controller()?;
        let ts = design.ts();
        let mut plant = model.plant(ts)?;
        let encoder = encoder.as_ref();
        looped::closed_loop_with(&mut plant, &mut controller, signals, encoder, monitor)
            .and_then(|run| completed(run, ts))
    })?;
    let record = PyDict::new(py);
    record.set_item("u", array1(py, run.u))?;
    record.set_item("y", array1(py, run.y))?;
    record.set_item("feedback", array1(py, run.feedback))?;
    Ok(record)
}

fn completed(run: Run, ts: f64) -> Result<Run> {
    match run.outcome {
        Outcome::Completed => Ok(run),
        Outcome::Interrupted(_) => Err(Error::fit("the run was interrupted")),
        Outcome::Diverged(k) => Err(Error::fit(format!(
            "expected a loop that stays finite, got one that diverged at {:.4} s; use smaller gains or output limits, \
             or check the model on new data",
            k as f64 * ts
        ))),
    }
}

#[pyfunction]
#[pyo3(signature = (y, reference, *, Ts, smoothing))]
#[expect(non_snake_case, reason = "the field's name for the sample time")]
fn step_metrics<'py>(
    py: Python<'py>,
    y: Values<'py>,
    reference: Values<'py>,
    Ts: f64,
    smoothing: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let found = metrics::step_metrics(
        slice(&y, "y")?,
        slice(&reference, "reference")?,
        Ts,
        smoothing,
    )
    .map_err(|e| raise(py, e))?;
    named(
        py,
        [
            ("rise_time_ms", 1e3 * found.rise_time),
            ("reference_rise_time_ms", 1e3 * found.reference_rise_time),
            ("overshoot_percent", found.overshoot_percent),
        ],
    )
}

#[pyfunction]
#[pyo3(signature = (u, *, u_min, u_max))]
fn effort<'py>(
    py: Python<'py>,
    u: Values<'py>,
    u_min: f64,
    u_max: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let found = Effort::of(slice(&u, "u")?, u_min, u_max);
    named(
        py,
        [
            ("u_rms", found.u_rms),
            ("du_rms", found.du_rms),
            ("saturated", found.saturated),
        ],
    )
}

/// A dict of numbers by name.
pub fn named<'py, const N: usize>(
    py: Python<'py>,
    values: [(&str, f64); N],
) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (name, value) in values {
        dict.set_item(name, value)?;
    }
    Ok(dict)
}
