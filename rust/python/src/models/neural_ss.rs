//! Bindings of the neural state-space model and its training.

use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::neural_ss::{self, OutputFunction, Scaling, Settings, Shape, Statistics};
use sewfast_core::{Error, Result};

use super::linear::LinearModel;
use super::{Kind, Model};
use crate::seam::{
    Experiments, Matrix, Raised, Rows, Values, Vector, array1, array2, raise, records, released,
    rows, slice, watched,
};

/// Neural state-space model.
#[pyclass(frozen, extends = Model, module = "sewfast._core")]
pub struct NeuralSS {
    /// The model itself.
    pub inner: Arc<neural_ss::NeuralSS>,
}

impl Kind for NeuralSS {
    type Inner = neural_ss::NeuralSS;

    fn of(inner: Arc<Self::Inner>) -> Self {
        Self { inner }
    }
}

#[pymethods]
impl NeuralSS {
    #[new]
    #[pyo3(signature = (
        *, nx, nk, n_inputs, n_outputs, hidden, integrator, output, output_parameters, theta, u_mean, u_scale, y_mean,
        y_scale, state_mean, state_covariance, residual_variance, process_noise
    ))]
    fn new(
        py: Python<'_>,
        nx: usize,
        nk: usize,
        n_inputs: usize,
        n_outputs: usize,
        hidden: usize,
        integrator: bool,
        output: &str,
        output_parameters: Values<'_>,
        theta: Values<'_>,
        u_mean: Values<'_>,
        u_scale: Values<'_>,
        y_mean: Values<'_>,
        y_scale: Values<'_>,
        state_mean: Values<'_>,
        state_covariance: Rows<'_>,
        residual_variance: Values<'_>,
        process_noise: f64,
    ) -> PyResult<PyClassInitializer<Self>> {
        if n_outputs != 1 {
            let message = format!("expected one output, got {n_outputs}");
            return Err(raise(py, Error::setting(message)));
        }
        let shape = Shape {
            nx,
            nk,
            inputs: n_inputs,
            hidden,
            integrator,
        };
        let scaling = Scaling {
            u_mean: slice(&u_mean, "u_mean")?.to_vec(),
            u_scale: slice(&u_scale, "u_scale")?.to_vec(),
            y_mean: one(py, &y_mean, "y_mean")?,
            y_scale: one(py, &y_scale, "y_scale")?,
        };
        let statistics = Statistics {
            state_mean: slice(&state_mean, "state_mean")?.to_vec(),
            state_covariance: rows(&state_covariance, "state_covariance")?.0.to_vec(),
            residual_variance: one(py, &residual_variance, "residual_variance")?,
            process_noise,
        };
        let theta = slice(&theta, "theta")?.to_vec();
        OutputFunction::new(output, slice(&output_parameters, "output_parameters")?)
            .and_then(|output| neural_ss::NeuralSS::new(shape, output, theta, scaling, statistics))
            .map(Self::wrapped)
            .raised(py)
    }

    #[getter]
    fn nx(&self) -> usize {
        self.inner.shape().nx
    }

    #[getter]
    fn nk(&self) -> usize {
        self.inner.shape().nk
    }

    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (shape, scaling) = (self.inner.shape(), self.inner.scaling());
        let (output, statistics) = (self.inner.output(), self.inner.statistics());
        let array = |values: &[f64]| array1(py, values.to_vec());
        Ok(dict! { py;
            "nx" => shape.nx, "nk" => shape.nk, "n_inputs" => shape.inputs, "n_outputs" => 1, "hidden" => shape.hidden,
            "integrator" => shape.integrator, "output" => output.name(), "output_parameters" => array(&output.parameters()),
            "u_mean" => array(&scaling.u_mean), "u_scale" => array(&scaling.u_scale),
            "y_mean" => array(&[scaling.y_mean]), "y_scale" => array(&[scaling.y_scale]),
            "state_mean" => array(&statistics.state_mean),
            "state_covariance" => array2(py, statistics.state_covariance.clone(), shape.nx)?,
            "residual_variance" => array(&[statistics.residual_variance]), "process_noise" => statistics.process_noise,
        })
    }

    fn slowed(&self, py: Python<'_>, factor: f64) -> PyResult<Py<Self>> {
        let slowed = self.inner.slowed(factor);
        Self::object(py, slowed.raised(py)?)
    }

    fn grown(&self, py: Python<'_>, nx: usize, hidden: usize, seed: u64) -> PyResult<Py<Self>> {
        let grown = self.inner.grown(nx, hidden, seed);
        Self::object(py, grown.raised(py)?)
    }

    fn states<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Matrix<'py>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let states = released(py, || self.inner.states(u, channels, state))?;
        array2(py, states, self.inner.shape().nx)
    }
}

/// The value of the output, of which a file has a list.
fn one(py: Python<'_>, values: &Values<'_>, name: &str) -> PyResult<f64> {
    match slice(values, name)? {
        [value] => Ok(*value),
        other => Err(raise(
            py,
            Error::setting(format!(
                "expected {name} of one output, got {}",
                other.len()
            )),
        )),
    }
}

/// A trained model and how the training went.
#[pyclass(frozen, module = "sewfast._core")]
pub struct NeuralSSFit {
    inner: neural_ss::NeuralSSFit,
}

started_fit_methods!(NeuralSSFit {
    #[getter]
    fn model(&self, py: Python<'_>) -> PyResult<Py<NeuralSS>> {
        NeuralSS::object(py, self.inner.model.clone())
    }

    #[getter]
    fn models(&self, py: Python<'_>) -> PyResult<Vec<Py<NeuralSS>>> {
        let models = self.inner.models.iter();
        models.map(|m| NeuralSS::object(py, m.clone())).collect()
    }

    #[getter]
    fn start_models(&self, py: Python<'_>) -> PyResult<Vec<Option<Py<NeuralSS>>>> {
        let object = |m: &neural_ss::NeuralSS| NeuralSS::object(py, m.clone());
        let models = self.inner.start_models.iter();
        models.map(|m| m.as_ref().map(object).transpose()).collect()
    }

    #[getter]
    fn sounds(&self) -> Vec<bool> {
        self.inner.sounds.clone()
    }

    #[getter]
    fn initial_states<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
        let states = self.inner.initial_states.concat();
        array2(py, states, self.inner.model.shape().nx)
    }
});

#[pyfunction]
#[pyo3(signature = (
    experiments, validation, *, nx, nk, hidden, linear, output, output_parameters, integrator, weight_decay,
    hidden_scale, max_iterations, starts, first_start, seed, threads, initial = None, guard = true, progress = None
))]
pub fn fit_neural_ss(
    py: Python<'_>,
    experiments: Experiments<'_>,
    validation: Experiments<'_>,
    nx: usize,
    nk: usize,
    hidden: usize,
    linear: Option<PyRef<'_, LinearModel>>,
    output: &str,
    output_parameters: Values<'_>,
    integrator: bool,
    weight_decay: f64,
    hidden_scale: f64,
    max_iterations: usize,
    starts: usize,
    first_start: usize,
    seed: u64,
    threads: usize,
    initial: Option<Vec<PyRef<'_, NeuralSS>>>,
    guard: bool,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<NeuralSSFit> {
    let initial = initial.unwrap_or_default();
    let output: Result<OutputFunction> =
        OutputFunction::new(output, slice(&output_parameters, "output_parameters")?);
    let settings = Settings {
        nx,
        nk,
        hidden,
        linear: linear.map(|l| l.inner.as_ref().clone()),
        initial: initial.iter().map(|m| m.inner.as_ref().clone()).collect(),
        output: output.raised(py)?,
        integrator,
        weight_decay,
        hidden_scale,
        max_iterations,
        starts,
        first_start,
        seed,
        threads,
        guard,
    };
    let (records, validation) = (records(py, &experiments)?, records(py, &validation)?);
    let inner = watched(py, progress.as_ref(), |monitor| {
        neural_ss::fit(&records, &validation, &settings, monitor)
    })?;
    Ok(NeuralSSFit { inner })
}
