//! Bindings of the search for what has changed in a machine, from a run and earlier runs.

use crate::seam::{Values, slice, watched};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::causes::{self as core, Motor, Run};

fn motor_dict<'py>(py: Python<'py>, motor: &Motor) -> PyResult<Bound<'py, PyDict>> {
    let found = PyDict::new(py);
    for (name, value) in [
        ("gain", motor.gain),
        ("lag", motor.lag),
        ("delay", motor.delay),
        ("friction", motor.friction),
        ("bias", motor.bias),
    ] {
        found.set_item(name, value)?;
    }
    Ok(found)
}

/// The changes that explain a run, the best first, with the motor that each began with.
#[pyfunction]
#[pyo3(signature = (u, counts, before, *, Ts, counts_per_rev, most=f64::INFINITY))]
pub fn causes<'py>(
    py: Python<'py>,
    u: Values<'py>,
    counts: Values<'py>,
    before: Vec<(Values<'py>, Values<'py>)>,
    Ts: f64,
    counts_per_rev: f64,
    most: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let run = Run {
        u: slice(&u, "u")?,
        counts: slice(&counts, "counts")?,
    };
    let before = before
        .iter()
        .map(|(u, counts)| {
            Ok(Run {
                u: slice(u, "u")?,
                counts: slice(counts, "counts")?,
            })
        })
        .collect::<PyResult<Vec<_>>>()?;
    let found = watched(py, None, |monitor| {
        core::causes(&before, run, Ts, counts_per_rev, most, monitor)
    })?;
    let all = dict! { py;
        "motor" => motor_dict(py, &found.motor)?, "unsure" => found.unsure, "together" => found.together,
        "backwards" => found.backwards, "error" => found.error, "size" => found.size,
        "rounding" => found.rounding,
    };
    let findings = found
        .findings
        .iter()
        .map(|f| {
            let motor = motor_dict(py, &f.motor)?;
            Ok((f.change.name(), f.value, f.at, f.error, motor))
        })
        .collect::<PyResult<Vec<_>>>()?;
    all.set_item("findings", findings)?;
    Ok(all)
}
