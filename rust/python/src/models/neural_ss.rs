//! Bindings of the neural state-space model and its training.

use std::sync::Arc;

use numpy::{PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::neural_ss::{
    self, OutputFunction, Recording, Scaling, Settings, Shape, Statistics,
};
use sewfast_core::{Error, Result};

use super::linear::LinearModel;
use super::{Kind, Model};
use crate::seam::{
    Experiment, Raised, Rows, Values, Vector, array1, array2, raise, released, rows, slice, watched,
};

/// Outputs: one per sample, or rows of several.
pub(super) type Outputs<'py> = PyReadonlyArrayDyn<'py, f64>;
/// A list of experiments of any number of outputs.
pub(super) type Experiments<'py> = Vec<Experiment<'py, Outputs<'py>>>;
type Array<'py> = Bound<'py, PyArrayDyn<f64>>;

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
        let shape = Shape {
            nx,
            nk,
            inputs: n_inputs,
            outputs: n_outputs,
            hidden,
            integrator,
        };
        let scaling = Scaling {
            u_mean: slice(&u_mean, "u_mean")?.to_vec(),
            u_scale: slice(&u_scale, "u_scale")?.to_vec(),
            y_mean: slice(&y_mean, "y_mean")?.to_vec(),
            y_scale: slice(&y_scale, "y_scale")?.to_vec(),
        };
        let statistics = Statistics {
            state_mean: slice(&state_mean, "state_mean")?.to_vec(),
            state_covariance: rows(&state_covariance, "state_covariance")?.0.to_vec(),
            residual_variance: slice(&residual_variance, "residual_variance")?.to_vec(),
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
        let settings = dict! { py;
            "nx" => shape.nx, "nk" => shape.nk, "n_inputs" => shape.inputs, "n_outputs" => shape.outputs,
            "hidden" => shape.hidden, "integrator" => shape.integrator, "output" => output.name(),
            "output_parameters" => array1(py, output.parameters()),
            "u_mean" => array1(py, scaling.u_mean.clone()), "u_scale" => array1(py, scaling.u_scale.clone()),
            "y_mean" => array1(py, scaling.y_mean.clone()), "y_scale" => array1(py, scaling.y_scale.clone()),
            "state_mean" => array1(py, statistics.state_mean.clone()),
        };
        let covariance = array2(py, statistics.state_covariance.clone(), shape.nx)?;
        settings.set_item("state_covariance", covariance)?;
        let variance = array1(py, statistics.residual_variance.clone());
        settings.set_item("residual_variance", variance)?;
        settings.set_item("process_noise", statistics.process_noise)?;
        Ok(settings)
    }

    fn slowed(&self, py: Python<'_>, factor: f64) -> PyResult<Py<Self>> {
        let slowed = self.inner.slowed(factor);
        Self::object(py, slowed.raised(py)?)
    }

    fn grown(&self, py: Python<'_>, nx: usize, hidden: usize, seed: u64) -> PyResult<Py<Self>> {
        let grown = self.inner.grown(nx, hidden, seed);
        Self::object(py, grown.raised(py)?)
    }

    fn simulate<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Array<'py>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let run = released(py, || self.inner.simulate(u, channels, state))?;
        self.outputs(py, run)
    }

    fn states<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Array<'py>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let states = released(py, || self.inner.states(u, channels, state))?;
        shaped(py, states, &[self.inner.shape().nx])
    }

    fn predict<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        y: Outputs<'py>,
        state: Values<'py>,
        horizon: usize,
    ) -> PyResult<Array<'py>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let (y, _) = outputs(py, &y)?;
        let run = released(py, || self.inner.predict(u, channels, y, state, horizon))?;
        self.outputs(py, run)
    }

    fn estimate_initial_state<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        y: Outputs<'py>,
    ) -> PyResult<Vector<'py>> {
        let ((u, channels), (y, _)) = (rows(&u, "u")?, outputs(py, &y)?);
        let state = released(py, || self.inner.estimate_initial_state(u, channels, y))?;
        Ok(array1(py, state))
    }

    fn jacobian<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<(Array<'py>, Array<'py>)> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let (run, jacobian) = released(py, || self.inner.jacobian(u, channels, state))?;
        let shape = self.inner.shape();
        let columns = shape.parameters() + shape.nx;
        let jacobian = match shape.outputs {
            1 => shaped(py, jacobian, &[columns])?,
            count => shaped(py, jacobian, &[count, columns])?,
        };
        Ok((self.outputs(py, run)?, jacobian))
    }
}

impl NeuralSS {
    /// `(N,)` for one output, else `(N, ny)`.
    fn outputs<'py>(&self, py: Python<'py>, run: Vec<f64>) -> PyResult<Array<'py>> {
        match self.inner.shape().outputs {
            1 => shaped(py, run, &[]),
            count => shaped(py, run, &[count]),
        }
    }
}

/// An array with time first and the given lengths after it.
fn shaped<'py>(py: Python<'py>, values: Vec<f64>, lengths: &[usize]) -> PyResult<Array<'py>> {
    let samples = values.len() / lengths.iter().product::<usize>();
    let shape: Vec<usize> = std::iter::once(samples)
        .chain(lengths.iter().copied())
        .collect();
    PyArray1::from_vec(py, values).reshape(shape)
}

/// Values of `(N,)` or `(N, ny)` outputs and their number, borrowed.
fn outputs<'a>(py: Python<'_>, y: &'a Outputs<'_>) -> PyResult<(&'a [f64], usize)> {
    let count = match y.shape() {
        [_] => 1,
        [_, count] => *count,
        other => {
            return Err(raise(
                py,
                Error::data(format!(
                    "expected y of shape (N,) or (N, ny), got {other:?}; give the outputs time first"
                )),
            ));
        }
    };
    let values = y.as_slice().map_err(|_| {
        raise(py, Error::data(
            "expected a C-contiguous array for y, got another memory layout; use numpy.ascontiguousarray",
        ))
    })?;
    Ok((values, count))
}

pub(super) fn recordings<'a>(
    py: Python<'_>,
    experiments: &'a Experiments<'_>,
) -> PyResult<Vec<Recording<'a>>> {
    let recording = |experiment: &'a Experiment<'_, Outputs<'_>>| {
        let (u, inputs) = rows(&experiment.u, "u")?;
        let ((y, count), weights) = (outputs(py, &experiment.y)?, experiment.weights()?);
        let recording = Recording::new(u, inputs, y, count);
        let weighted = recording.and_then(|r| weights.map_or(Ok(r), |w| r.with_weights(w)));
        weighted.raised(py)
    };
    experiments.iter().map(recording).collect()
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
    fn initial_states<'py>(&self, py: Python<'py>) -> PyResult<Array<'py>> {
        let states = self.inner.initial_states.concat();
        shaped(py, states, &[self.inner.model.shape().nx])
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
    let (recordings, validation) = (recordings(py, &experiments)?, recordings(py, &validation)?);
    let inner = watched(py, progress.as_ref(), |monitor| {
        neural_ss::fit(&recordings, &validation, &settings, monitor)
    })?;
    Ok(NeuralSSFit { inner })
}
