//! Bindings of the core's speed.

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use sewfast_core::Result;
use sewfast_core::speed::{self, Kalman, Scale};

use crate::arrays::{array1, raise, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(speed_difference, module)?)?;
    module.add_function(wrap_pyfunction!(speed_savgol, module)?)?;
    module.add_function(wrap_pyfunction!(speed_kalman, module)?)?;
    module.add_function(wrap_pyfunction!(unwrap_counts, module)?)
}

type Counts<'py> = PyReadonlyArray1<'py, f64>;
type Speed<'py> = PyResult<Bound<'py, PyArray1<f64>>>;

fn released<'py>(
    py: Python<'py>,
    counts: &Counts<'py>,
    work: impl FnOnce(&[f64]) -> Result<Vec<f64>> + Send,
) -> Speed<'py> {
    let counts = slice(counts, "counts")?;
    let values = py.detach(|| work(counts)).map_err(|e| raise(py, e))?;
    Ok(array1(py, values))
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit))]
#[allow(non_snake_case)]
fn speed_difference<'py>(
    py: Python<'py>,
    counts: Counts<'py>,
    Ts: f64,
    counts_per_unit: f64,
) -> Speed<'py> {
    released(py, &counts, |counts| {
        speed::difference(counts, Scale::new(Ts, counts_per_unit)?)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit, window, order))]
#[allow(non_snake_case)]
fn speed_savgol<'py>(
    py: Python<'py>,
    counts: Counts<'py>,
    Ts: f64,
    counts_per_unit: f64,
    window: usize,
    order: usize,
) -> Speed<'py> {
    released(py, &counts, |counts| {
        speed::savgol(counts, Scale::new(Ts, counts_per_unit)?, window, order)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit, process_noise = None, ripple_orders = Vec::new(),
    counts_per_rev = 1.0))]
#[allow(non_snake_case)]
fn speed_kalman<'py>(
    py: Python<'py>,
    counts: Counts<'py>,
    Ts: f64,
    counts_per_unit: f64,
    process_noise: Option<f64>,
    ripple_orders: Vec<u32>,
    counts_per_rev: f64,
) -> Speed<'py> {
    let kalman = Kalman {
        process_noise,
        ripple_orders: &ripple_orders,
        counts_per_rev,
    };
    released(py, &counts, |counts| {
        kalman.smooth(counts, Scale::new(Ts, counts_per_unit)?)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, bits))]
fn unwrap_counts<'py>(py: Python<'py>, counts: Counts<'py>, bits: u32) -> Speed<'py> {
    released(py, &counts, |counts| speed::unwrap(counts, bits))
}
