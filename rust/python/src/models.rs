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
mod grey_box;
mod guard;
mod hammerstein;
pub mod linear;
pub mod neural;
pub mod neural_ss;

use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::PyClass;
use pyo3::prelude::*;
use sewfast_core::Result;
use sewfast_core::linearised::Linearised;
use sewfast_core::model;

use crate::arrays::{array1, array2, raise, rows, slice};
use embedded::EmbeddedModel;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Model>()?;
    embedded::register(module)?;
    grey_box::register(module)?;
    guard::register(module)?;
    hammerstein::register(module)?;
    linear::register(module)?;
    neural::register(module)?;
    neural_ss::register(module)
}

/// A model of any kind: the class below which each kind adds its parameters.
#[pyclass(frozen, subclass, module = "sewfast._core")]
pub struct Model {
    /// The model itself, as whoever needs no more than a model knows it.
    pub inner: Arc<dyn model::Model>,
}

/// A kind of model in Python: its own value beside the one in [`Model`].
pub trait Kind: PyClass<BaseType = Model> + Sized {
    type Inner: model::Model + 'static;

    fn of(inner: Arc<Self::Inner>) -> Self;

    /// Both classes around one value.
    fn wrapped(inner: Self::Inner) -> PyClassInitializer<Self> {
        let inner = Arc::new(inner);
        let base = Model {
            inner: inner.clone(),
        };
        PyClassInitializer::from(base).add_subclass(Self::of(inner))
    }

    /// A new object of Python's.
    fn object(py: Python<'_>, inner: Self::Inner) -> PyResult<Py<Self>> {
        Py::new(py, Self::wrapped(inner))
    }
}

#[pymethods]
impl Model {
    #[getter]
    fn theta<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array1(py, self.inner.theta())
    }

    fn rest_state<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array1(py, py.detach(|| self.inner.rest_state()))
    }

    fn simulate<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let run = released(py, || self.inner.simulate(u, channels, state))?;
        Ok(array1(py, run))
    }

    fn predict<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        y: Values<'py>,
        state: Values<'py>,
        horizon: usize,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let ((u, channels), y, state) = (rows(&u, "u")?, slice(&y, "y")?, slice(&state, "state")?);
        let run = released(py, || self.inner.predict(u, channels, y, state, horizon))?;
        Ok(array1(py, run))
    }

    fn estimate_initial_state<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        y: Values<'py>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let ((u, channels), y) = (rows(&u, "u")?, slice(&y, "y")?);
        let state = released(py, || self.inner.estimate_state(u, channels, y))?;
        Ok(array1(py, state))
    }

    fn linearise<'py>(
        &self,
        py: Python<'py>,
        u: Values<'py>,
        state: Values<'py>,
    ) -> PyResult<Matrices<'py>> {
        let found = self
            .inner
            .linearise(slice(&u, "u")?, slice(&state, "state")?);
        matrices(py, found)
    }

    fn jacobian<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<RunAndJacobian<'py>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let (run, found) = released(py, || self.inner.jacobian(u, channels, state))?;
        let columns = found.len().checked_div(run.len()).unwrap_or(0);
        Ok((array1(py, run), array2(py, found, columns)?))
    }

    #[pyo3(signature = (*, scaled=false))]
    fn embedded(&self, py: Python<'_>, scaled: bool) -> PyResult<EmbeddedModel> {
        let made = self.inner.embedded(scaled);
        made.map(EmbeddedModel::of).map_err(|e| raise(py, e))
    }
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
