//! Bindings of the network output-error model and its training.

use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::lagged::{Lagged, Lags};
use sewfast_core::neural::{self, InitialState, Scaling, Settings, Shape};
use sewfast_core::{Error, Result};

use super::linear::LinearModel;
use super::{Kind, Model};
use crate::seam::{
    Experiments, Matrix, Raised, Rows, Values, Vector, array1, array2, raise, records, rows, slice,
    watched,
};

/// Network output-error model.
#[pyclass(frozen, extends = Model, module = "sewfast._core")]
pub struct NeuralOE {
    /// The model itself.
    pub inner: Arc<neural::NeuralOE>,
}

impl Kind for NeuralOE {
    type Inner = neural::NeuralOE;

    fn of(inner: Arc<Self::Inner>) -> Self {
        Self { inner }
    }
}

#[pymethods]
impl NeuralOE {
    #[new]
    #[pyo3(signature = (*, na, nb, nk, n_inputs, hidden, bypass, theta, u_mean, u_scale, y_mean, y_scale, output_low, output_high))]
    fn new(
        py: Python<'_>,
        na: usize,
        nb: usize,
        nk: usize,
        n_inputs: usize,
        hidden: usize,
        bypass: bool,
        theta: Values<'_>,
        u_mean: Values<'_>,
        u_scale: Values<'_>,
        y_mean: f64,
        y_scale: f64,
        output_low: Option<f64>,
        output_high: Option<f64>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let scaling = Scaling {
            u_mean: slice(&u_mean, "u_mean")?.to_vec(),
            u_scale: slice(&u_scale, "u_scale")?.to_vec(),
            y_mean,
            y_scale,
        };
        let limits = (
            output_low.unwrap_or(f64::NEG_INFINITY),
            output_high.unwrap_or(f64::INFINITY),
        );
        let theta = slice(&theta, "theta")?.to_vec();
        Lags::new(na, nb, nk, n_inputs)
            .and_then(|lags| Shape::new(lags, hidden, bypass))
            .and_then(|shape| neural::NeuralOE::new(shape, theta, scaling, limits))
            .map(Self::wrapped)
            .raised(py)
    }

    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (shape, scaling) = (self.inner.shape(), self.inner.scaling());
        let limit = |value: f64| value.is_finite().then_some(value);
        Ok(dict! { py;
            "na" => shape.lags.na, "nb" => shape.lags.nb, "nk" => shape.lags.nk,
            "n_inputs" => shape.lags.channels, "hidden" => shape.hidden, "bypass" => shape.bypass,
            "u_mean" => array1(py, scaling.u_mean.clone()), "u_scale" => array1(py, scaling.u_scale.clone()),
            "y_mean" => scaling.y_mean, "y_scale" => scaling.y_scale,
            "output_low" => limit(self.inner.limits().0), "output_high" => limit(self.inner.limits().1),
        })
    }

    #[getter]
    fn na(&self) -> usize {
        self.inner.lags().na
    }
}

/// A trained network and how the training went.
#[pyclass(frozen, module = "sewfast._core")]
pub struct NeuralFit {
    inner: neural::NeuralFit,
}

started_fit_methods!(NeuralFit {
    #[getter]
    fn model(&self, py: Python<'_>) -> PyResult<Py<NeuralOE>> {
        NeuralOE::object(py, self.inner.model.clone())
    }

    #[getter]
    fn models(&self, py: Python<'_>) -> PyResult<Vec<Py<NeuralOE>>> {
        let models = self.inner.models.iter();
        models.map(|m| NeuralOE::object(py, m.clone())).collect()
    }

    #[getter]
    fn trials(&self) -> usize {
        self.inner.trials
    }

    #[getter]
    fn initial_states<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
        let states = self.inner.initial_states.concat();
        array2(py, states, self.inner.model.lags().na)
    }
});

#[pyfunction]
#[pyo3(signature = (
    experiments, validation, *, na, nb, nk, hidden, linear, u_mean, u_scale, y_mean, y_scale, saturate,
    initial_state, weight_decay, max_iterations, starts, seed, threads, initial_theta = None,
    progress = None
))]
pub fn fit_neural_oe(
    py: Python<'_>,
    experiments: Experiments<'_>,
    validation: Experiments<'_>,
    na: usize,
    nb: usize,
    nk: usize,
    hidden: usize,
    linear: Option<PyRef<'_, LinearModel>>,
    u_mean: Option<Values<'_>>,
    u_scale: Option<Values<'_>>,
    y_mean: Option<f64>,
    y_scale: Option<f64>,
    saturate: Option<f64>,
    initial_state: &str,
    weight_decay: f64,
    max_iterations: usize,
    starts: usize,
    seed: u64,
    threads: usize,
    initial_theta: Option<Rows<'_>>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<NeuralFit> {
    let scaling = match (u_mean, u_scale, y_mean, y_scale) {
        (None, None, None, None) => None,
        (Some(u_mean), Some(u_scale), Some(y_mean), Some(y_scale)) => Some(Scaling {
            u_mean: slice(&u_mean, "u_mean")?.to_vec(),
            u_scale: slice(&u_scale, "u_scale")?.to_vec(),
            y_mean,
            y_scale,
        }),
        _ => return Err(raise(py, half_a_scaling())),
    };
    let settings = Settings {
        na,
        nb,
        nk,
        hidden,
        linear: linear.map(|l| l.inner.as_ref().clone()),
        scaling,
        saturate,
        initial_state: parsed(initial_state).raised(py)?,
        weight_decay,
        max_iterations,
        starts,
        initial_theta: initial_theta
            .map(|theta| rows(&theta, "initial_theta").map(|(theta, _)| theta.to_vec()))
            .transpose()?,
        seed,
        threads,
    };
    let (records, validation) = (records(py, &experiments)?, records(py, &validation)?);
    let inner = watched(py, progress.as_ref(), |monitor| {
        neural::fit(&records, &validation, &settings, monitor)
    })?;
    Ok(NeuralFit { inner })
}

fn half_a_scaling() -> Error {
    Error::setting(
        "expected all of u_mean, u_scale, y_mean, y_scale or none of them, got some; give the rest or leave all out",
    )
}

fn parsed(name: &str) -> Result<InitialState> {
    match name {
        "zero" => Ok(InitialState::Zero),
        "measured" => Ok(InitialState::Measured),
        "estimated" => Ok(InitialState::Estimated),
        other => Err(Error::setting(format!(
            "expected initial_state zero, measured or estimated, got {other:?}; choose one of the three"
        ))),
    }
}
