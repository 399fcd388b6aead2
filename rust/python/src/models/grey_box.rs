//! Binding of the grey box: a motor's equations and a network for what they leave.

use std::sync::Arc;

use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::Error;
use sewfast_core::greybox::{self, Frame, PARAMETERS};

use super::{Kind, Model, Rows, Values};
use crate::arrays::{array1, array2, raise, rows, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("GREYBOX_UNITS", greybox::MOST_UNITS)?;
    module.add_class::<GreyBox>()
}

/// A motor and a network for what its equations leave.
#[pyclass(frozen, extends = Model, module = "sewfast._core")]
pub struct GreyBox {
    inner: Arc<greybox::GreyBox>,
}

impl Kind for GreyBox {
    type Inner = greybox::GreyBox;

    fn of(inner: Arc<Self::Inner>) -> Self {
        Self { inner }
    }
}

#[pymethods]
#[allow(non_snake_case)]
impl GreyBox {
    #[new]
    #[pyo3(signature = (
        *, values, free, Ts, steps, mean, unit, speed_scale, command_scale, residual_variance, process_noise, theta
    ))]
    #[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
    fn new(
        py: Python<'_>,
        values: Values<'_>,
        free: Vec<usize>,
        Ts: f64,
        steps: usize,
        mean: bool,
        unit: f64,
        speed_scale: f64,
        command_scale: f64,
        residual_variance: f64,
        process_noise: f64,
        theta: Values<'_>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let given = slice(&values, "values")?;
        let values = given.try_into().map_err(|_| {
            let message = format!(
                "expected {} values of a motor, got {}; identify the model again",
                PARAMETERS.len(),
                given.len()
            );
            raise(py, Error::setting(message))
        })?;
        let frame = Frame {
            values,
            free,
            sample_time: Ts,
            steps,
            mean,
            unit,
            speed_scale,
            command_scale,
            residual_variance,
            process_noise,
        };
        greybox::GreyBox::new(frame, slice(&theta, "theta")?)
            .map(Self::wrapped)
            .map_err(|e| raise(py, e))
    }

    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let frame = self.inner.frame();
        let settings = PyDict::new(py);
        settings.set_item("nx", 3)?;
        settings.set_item("nk", self.inner.nk())?;
        settings.set_item("n_inputs", 1)?;
        settings.set_item("integrator", false)?;
        settings.set_item("hidden", self.inner.units())?;
        settings.set_item("values", array1(py, frame.values.to_vec()))?;
        settings.set_item("free", frame.free.clone())?;
        settings.set_item("Ts", frame.sample_time)?;
        settings.set_item("steps", frame.steps)?;
        settings.set_item("mean", frame.mean)?;
        settings.set_item("unit", frame.unit)?;
        settings.set_item("speed_scale", frame.speed_scale)?;
        settings.set_item("command_scale", frame.command_scale)?;
        settings.set_item("residual_variance", frame.residual_variance)?;
        settings.set_item("process_noise", frame.process_noise)?;
        Ok(settings)
    }

    fn states<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let found = py.detach(|| self.inner.states(u, channels, state));
        array2(py, found.map_err(|e| raise(py, e))?, 3)
    }
}
