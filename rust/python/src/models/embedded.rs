//! Bindings of models in the form of a microcontroller.

use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::embedded::{Embedded, Precision};
use sewfast_core::{Error, Result};

use super::{Rows, Values};
use crate::arrays::{array1, raise, rows, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<EmbeddedModel>()?;
    module.add_function(wrap_pyfunction!(tanh_quotients, module)?)
}

/// A model's coefficients by name, and its step in the arithmetic of a microcontroller.
#[pyclass(frozen, module = "sewfast._core")]
pub struct EmbeddedModel {
    inner: Embedded,
}

impl EmbeddedModel {
    pub fn of(inner: Embedded) -> Self {
        Self { inner }
    }

    fn free_run<T: Precision>(&self, u: &[f64], state: &[f64], held: &[f64]) -> Result<Vec<f64>> {
        self.inner.run::<T>(u, state, held)
    }
}

#[pymethods]
impl EmbeddedModel {
    #[getter]
    fn kind(&self) -> &'static str {
        self.inner.kind
    }

    #[getter]
    fn orders<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (orders, found) = (self.inner.orders, PyDict::new(py));
        found.set_item("na", orders.na)?;
        found.set_item("nb", orders.nb)?;
        found.set_item("nk", orders.nk)?;
        found.set_item("inputs", orders.inputs)?;
        Ok(found)
    }

    #[getter]
    fn parts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for (name, values) in &self.inner.parts {
            found.set_item(name, array1(py, values.clone()))?;
        }
        Ok(found)
    }

    #[getter]
    fn scaling<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let Some((u_mean, u_scale, y_mean, y_scale)) = &self.inner.scaling else {
            return Ok(None);
        };
        let found = PyDict::new(py);
        found.set_item("u_mean", array1(py, u_mean.clone()))?;
        found.set_item("u_scale", array1(py, u_scale.clone()))?;
        found.set_item("y_mean", array1(py, vec![*y_mean]))?;
        found.set_item("y_scale", array1(py, vec![*y_scale]))?;
        Ok(Some(found))
    }

    #[getter]
    fn output(&self) -> (&'static str, Vec<f64>) {
        (self.inner.output.name(), self.inner.output.parameters())
    }

    #[pyo3(signature = (u, state, held, *, precision="f64"))]
    fn run<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
        held: Values<'py>,
        precision: &str,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (u, state, held) = (
            rows(&u, "u")?.0,
            slice(&state, "state")?,
            slice(&held, "held")?,
        );
        let run = match precision {
            "f64" => Self::free_run::<f64>,
            "f32" => Self::free_run::<f32>,
            other => {
                let error =
                    Error::setting(format!("precision: expected f32 or f64, received {other}"));
                return Err(raise(py, error));
            }
        };
        let found = py.detach(|| run(self, u, state, held));
        Ok(array1(py, found.map_err(|e| raise(py, e))?))
    }
}

/// The coefficients of `tanh(x) = x P(x^2)/Q(x^2)`: numerator, denominator and end of each quotient.
#[pyfunction]
fn tanh_quotients(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    use sewfast_control::model::tanh::{FAR, NEAR, SINGLE};
    let found = PyDict::new(py);
    for (name, q) in [("near", NEAR), ("far", FAR)] {
        found.set_item(name, (q.numerator.to_vec(), q.denominator.to_vec(), q.end))?;
    }
    let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    let single = (
        wide(SINGLE.numerator),
        wide(SINGLE.denominator),
        f64::from(SINGLE.end),
    );
    found.set_item("single", single)?;
    Ok(found)
}
