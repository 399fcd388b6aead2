//! Binding of the guard.

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use sewfast_core::guard::{Unsound, verdict};
use sewfast_core::linear;

use super::linear::LinearModel;
use super::neural::NeuralOE;
use super::neural_ss::{Experiments, NeuralSS, recordings};
use crate::watch::watched;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(guard, module)?)
}

#[pyfunction]
#[pyo3(signature = (model, experiments, *, linear = Vec::new()))]
fn guard(
    py: Python<'_>,
    model: &Bound<'_, PyAny>,
    experiments: Experiments<'_>,
    linear: Vec<PyRef<'_, LinearModel>>,
) -> PyResult<&'static str> {
    let experiments = recordings(py, &experiments)?;
    let linear: Vec<linear::LinearModel> =
        linear.iter().map(|m| m.inner.as_ref().clone()).collect();
    let found = if let Ok(model) = model.cast::<LinearModel>() {
        let model = model.get().inner.as_ref();
        watched(py, None, |m| verdict(model, &experiments, &linear, m))
    } else if let Ok(model) = model.cast::<NeuralOE>() {
        let model = model.get().inner.as_ref();
        watched(py, None, |m| verdict(model, &experiments, &linear, m))
    } else if let Ok(model) = model.cast::<NeuralSS>() {
        let model = model.get().inner.as_ref();
        watched(py, None, |m| verdict(model, &experiments, &linear, m))
    } else {
        Err(PyTypeError::new_err(format!(
            "expected a LinearModel, a NeuralOE or a NeuralSS, got {}",
            model.get_type().name()?
        )))
    };
    Ok(found?.map_or("", Unsound::reason))
}
