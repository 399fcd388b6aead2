//! Bindings of the linear model and its fits.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use sewfast_core::lagged::Lagged;
use sewfast_core::{Error, arx, iv, linear, oe};

use super::{Kind, Model, Rows, Values};
use crate::seam::{Experiments, array1, array2, raise, records, rows, samples, slice, watched};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LinearModel>()?;
    module.add_class::<LinearFit>()?;
    module.add_function(wrap_pyfunction!(fit_arx, module)?)?;
    module.add_function(wrap_pyfunction!(fit_iv, module)?)?;
    module.add_function(wrap_pyfunction!(fit_oe, module)?)
}

/// A linear difference equation with offset.
#[pyclass(frozen, extends = Model, module = "sewfast._core")]
pub struct LinearModel {
    /// The model itself.
    pub inner: Arc<linear::LinearModel>,
}

impl Kind for LinearModel {
    type Inner = linear::LinearModel;

    fn of(inner: Arc<Self::Inner>) -> Self {
        Self { inner }
    }
}

#[pymethods]
impl LinearModel {
    #[new]
    fn new(
        py: Python<'_>,
        a: Values<'_>,
        b: Rows<'_>,
        nk: usize,
        offset: f64,
    ) -> PyResult<PyClassInitializer<Self>> {
        let channels = b.as_array().nrows();
        let (b, _) = rows(&b, "b")?;
        linear::LinearModel::new(slice(&a, "a")?.to_vec(), b.to_vec(), channels, nk, offset)
            .map(Self::wrapped)
            .map_err(|e| raise(py, e))
    }

    #[getter]
    fn a<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array1(py, self.inner.a().to_vec())
    }

    #[getter]
    fn b<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        array2(py, self.inner.b().to_vec(), self.inner.lags().nb)
    }

    #[getter]
    fn nk(&self) -> usize {
        self.inner.lags().nk
    }

    #[getter]
    fn offset(&self) -> f64 {
        self.inner.offset()
    }

    #[getter]
    fn na(&self) -> usize {
        self.inner.lags().na
    }

    #[getter]
    fn is_stable(&self) -> bool {
        self.inner.is_stable()
    }

    fn poles<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let pairs = self
            .inner
            .poles()
            .iter()
            .flat_map(|p| [p.re, p.im])
            .collect();
        array2(py, pairs, 2)
    }

    fn dc_gain<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array1(py, self.inner.dc_gain())
    }
}

/// A fitted linear model with the story of its fit.
#[pyclass(frozen, module = "sewfast._core")]
pub struct LinearFit {
    inner: linear::LinearFit,
}

fit_methods!(LinearFit {
    #[getter]
    fn model(&self, py: Python<'_>) -> PyResult<Py<LinearModel>> {
        LinearModel::object(py, self.inner.model.clone())
    }

    #[getter]
    fn initial_states<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let states = self.inner.initial_states.concat();
        array2(py, states, self.inner.model.lags().na)
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows = self.inner.covariance.clone();
        array2(py, rows, self.inner.model.parameters())
    }

    #[getter]
    fn standard_errors<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array1(py, self.inner.standard_errors())
    }
});

#[pyfunction]
#[pyo3(signature = (experiments, *, na, nb, nk, offset))]
fn fit_arx(
    py: Python<'_>,
    experiments: Experiments<'_>,
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
) -> PyResult<Py<LinearModel>> {
    let samples = samples(py, &experiments)?;
    let inner = super::released(py, || arx::fit_samples(&samples, na, nb, nk, offset))?;
    LinearModel::object(py, inner)
}

#[pyfunction]
#[pyo3(signature = (
    experiments, *, na, nb, nk, offset = true, max_iterations = 100, initial = None, progress = None
))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn fit_oe(
    py: Python<'_>,
    experiments: Experiments<'_>,
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
    max_iterations: usize,
    initial: Option<PyRef<'_, LinearModel>>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<LinearFit> {
    let records = records(py, &experiments)?;
    let initial = initial.map(|m| m.inner.clone());
    if let Some(lags) = initial.as_ref().map(|m| m.lags())
        && (lags.na, lags.nb, lags.nk) != (na, nb, nk)
    {
        return Err(raise(
            py,
            Error::setting(format!(
                "expected an initial model with na {na}, nb {nb} and nk {nk}, got one with na {}, nb {} and nk {}; take its orders, or leave it out",
                lags.na, lags.nb, lags.nk
            )),
        ));
    }
    let inner = watched(py, progress.as_ref(), |monitor| match &initial {
        Some(initial) => oe::fit_from(&records, initial, offset, max_iterations, monitor),
        None => oe::fit(&records, na, nb, nk, offset, max_iterations, monitor),
    })?;
    Ok(LinearFit { inner })
}

#[pyfunction]
#[pyo3(signature = (experiments, *, na, nb, nk, offset = true, max_iterations = 50, progress = None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn fit_iv(
    py: Python<'_>,
    experiments: Experiments<'_>,
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
    max_iterations: usize,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<LinearFit> {
    let records = records(py, &experiments)?;
    let inner = watched(py, progress.as_ref(), |monitor| {
        iv::fit(&records, na, nb, nk, offset, max_iterations, monitor)
    })?;
    Ok(LinearFit { inner })
}
