//! Bindings of the core's models.

/// The methods of a fit: those that each has, and its own. PyO3 takes one block of methods a class.
macro_rules! fit_methods {
    ($fit:ident { $($own:tt)* }) => {
        #[pymethods]
        impl $fit {
            #[getter]
            fn cost(&self) -> f64 {
                self.inner.cost
            }

            #[getter]
            fn iterations(&self) -> usize {
                self.inner.iterations
            }

            #[getter]
            fn termination(&self) -> &'static str {
                self.inner.termination.name()
            }

            #[getter]
            fn remedy(&self) -> &'static str {
                self.inner.termination.remedy()
            }

            #[getter]
            fn trace<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
                array1(py, self.inner.trace.clone())
            }

            $($own)*
        }
    };
}

/// The methods of a fit that was chosen among starts.
macro_rules! started_fit_methods {
    ($fit:ident { $($own:tt)* }) => {
        fit_methods!($fit {
            #[getter]
            fn validation_cost(&self) -> Option<f64> {
                self.inner.validation_cost
            }

            #[getter]
            fn start(&self) -> usize {
                self.inner.start
            }

            #[getter]
            fn start_costs<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
                array1(py, self.inner.start_costs.clone())
            }

            #[getter]
            fn sound(&self) -> bool {
                self.inner.sound
            }

            #[getter]
            fn discarded(&self) -> usize {
                self.inner.discarded
            }

            $($own)*
        });
    };
}

pub mod embedded;
mod guard;
pub mod linear;
pub mod neural;
pub mod neural_ss;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use sewfast_core::Result;
use sewfast_core::lagged::Lagged;
use sewfast_core::linearised::Linearised;

use crate::arrays::{array2, raise, rows, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    embedded::register(module)?;
    guard::register(module)?;
    linear::register(module)?;
    neural::register(module)?;
    neural_ss::register(module)
}

/// A, B, C, D.
type Matrices<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
);

fn matrices(py: Python<'_>, found: Result<Linearised>) -> PyResult<Matrices<'_>> {
    let Linearised {
        a,
        b,
        c,
        d,
        states,
        inputs,
    } = found.map_err(|e| raise(py, e))?;
    Ok((
        array2(py, a, states)?,
        array2(py, b, inputs)?,
        array2(py, c, states)?,
        array2(py, d, inputs)?,
    ))
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
