//! Bindings of the core's grey-box motor.

use numpy::{PyArray1, PyArray2, PyReadonlyArray1};
use pyo3::prelude::*;
use sewfast_core::Error;
use sewfast_core::greybox::{self, PARAMETERS, Run};

use crate::arrays::{array1, array2, raise, slice};
use crate::watch::watched_over;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("GREYBOX_PARAMETERS", PARAMETERS)?;
    module.add_function(wrap_pyfunction!(greybox_run, module)?)
}

/// Speed, drive and their derivatives.
type Found<'py> = (
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
);

#[pyfunction]
#[pyo3(signature = (theta, free, u, *, Ts, steps, speed=0.0, mean=false, angle=None))]
#[allow(non_snake_case, clippy::too_many_arguments)]
fn greybox_run<'py>(
    py: Python<'py>,
    theta: PyReadonlyArray1<'py, f64>,
    free: Vec<usize>,
    u: PyReadonlyArray1<'py, f64>,
    Ts: f64,
    steps: usize,
    speed: f64,
    mean: bool,
    angle: Option<PyReadonlyArray1<'py, f64>>,
) -> PyResult<Found<'py>> {
    let u = slice(&u, "u")?;
    let angle = angle.as_ref().map(|a| slice(a, "angle")).transpose()?;
    let values = slice(&theta, "theta")?;
    let theta = values.try_into().map_err(|_| {
        let message = format!(
            "expected {} parameters, got {}",
            PARAMETERS.len(),
            values.len()
        );
        raise(py, Error::setting(message))
    })?;
    let found = watched_over(py, u.len(), |monitor| {
        let task = Run {
            theta,
            free: &free,
            sample_time: Ts,
            steps,
            speed,
            mean,
            angle,
        };
        greybox::run(task, u, monitor)
    })?;
    let columns = free.len();
    Ok((
        array1(py, found.speed),
        array1(py, found.drive),
        array2(py, found.speed_by, columns)?,
        array2(py, found.drive_by, columns)?,
    ))
}
