//! Bindings of the search for what has changed in a machine, from a run and earlier runs.

use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::causes::{self as core, Motor, Run};

use crate::seam::{slice, watched};

type Column<'py> = PyReadonlyArray1<'py, f64>;

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
#[pyo3(signature = (u, counts, before, *, Ts, counts_per_rev))]
#[expect(non_snake_case, reason = "the field's name for the sample time")]
fn causes<'py>(
    py: Python<'py>,
    u: Column<'py>,
    counts: Column<'py>,
    before: Vec<(Column<'py>, Column<'py>)>,
    Ts: f64,
    counts_per_rev: f64,
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
        core::causes(&before, run, Ts, counts_per_rev, monitor)
    })?;
    let all = PyDict::new(py);
    all.set_item("motor", motor_dict(py, &found.motor)?)?;
    all.set_item("unsure", found.unsure)?;
    all.set_item("together", found.together)?;
    all.set_item("backwards", found.backwards)?;
    all.set_item("error", found.error)?;
    all.set_item("size", found.size)?;
    all.set_item("rounding", found.rounding)?;
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

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(causes, module)?)
}
