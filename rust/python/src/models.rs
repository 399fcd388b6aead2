//! Bindings of the core's models.

pub mod linear;
pub mod neural;
pub mod neural_ss;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use sewfast_core::Result;
use sewfast_core::lagged::Lagged;

use crate::arrays::{raise, rows, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    linear::register(module)?;
    neural::register(module)?;
    neural_ss::register(module)
}

type RunAndJacobian<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>);
type Rows<'py> = PyReadonlyArray2<'py, f64>;
type Values<'py> = PyReadonlyArray1<'py, f64>;

fn released<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    py.detach(work).map_err(|e| raise(py, e))
}

fn simulate(
    py: Python<'_>,
    model: &(impl Lagged + Sync),
    u: &Rows<'_>,
    y_past: &Values<'_>,
) -> PyResult<Vec<f64>> {
    let ((u, channels), y_past) = (rows(u, "u")?, slice(y_past, "y_past")?);
    released(py, || model.simulate(u, channels, y_past))
}

fn predict(
    py: Python<'_>,
    model: &(impl Lagged + Sync),
    u: &Rows<'_>,
    y: &Values<'_>,
    y_past: &Values<'_>,
    horizon: usize,
) -> PyResult<Vec<f64>> {
    let ((u, channels), y, y_past) = (rows(u, "u")?, slice(y, "y")?, slice(y_past, "y_past")?);
    released(py, || model.predict(u, channels, y, y_past, horizon))
}

fn initial_state(
    py: Python<'_>,
    model: &(impl Lagged + Sync),
    u: &Rows<'_>,
    y: &Values<'_>,
) -> PyResult<Vec<f64>> {
    let ((u, channels), y) = (rows(u, "u")?, slice(y, "y")?);
    released(py, || model.estimate_initial_state(u, channels, y))
}
