//! Bindings of the linear model, of the Hammerstein-Wiener model around it, and of their fits.

use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::hammerstein::{self, Knots};
use sewfast_core::lagged::{Lagged, Lags};
use sewfast_core::output_error::Fit;
use sewfast_core::{Error, arx, innovations, iv, linear, oe};

use super::{Kind, Model};
use crate::seam::{
    Experiments, Matrix, Raised, Rows, Values, Vector, array1, array2, raise, records, released,
    rows, samples, slice, watched,
};

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
            .raised(py)
    }

    #[getter]
    fn a<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array1(py, self.inner.a().to_vec())
    }

    #[getter]
    fn b<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
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

    fn poles<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
        let pairs = self
            .inner
            .poles()
            .iter()
            .flat_map(|p| [p.re, p.im])
            .collect();
        array2(py, pairs, 2)
    }

    fn dc_gain<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array1(py, self.inner.dc_gain())
    }
}

/// A fitted linear model and how the fit went.
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
    fn initial_states<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
        let states = self.inner.initial_states.concat();
        array2(py, states, self.inner.model.lags().na)
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
        let rows = self.inner.covariance.clone();
        array2(py, rows, self.inner.model.parameters())
    }

    #[getter]
    fn standard_errors<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array1(py, self.inner.standard_errors())
    }
});

#[pyfunction]
#[pyo3(signature = (experiments, *, na, nb, nk, offset))]
pub fn fit_arx(
    py: Python<'_>,
    experiments: Experiments<'_>,
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
) -> PyResult<Py<LinearModel>> {
    let samples = samples(py, &experiments)?;
    let inner = released(py, || arx::fit_samples(&samples, na, nb, nk, offset))?;
    LinearModel::object(py, inner)
}

#[pyfunction]
#[pyo3(signature = (
    experiments, *, na, nb, nk, offset = true, max_iterations = 100, initial = None, progress = None
))]
pub fn fit_oe(
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
pub fn fit_iv(
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

#[pyfunction]
#[pyo3(signature = (experiments, *, nk = None, max_iterations = 60, progress = None))]
pub fn fit_innovations(
    py: Python<'_>,
    experiments: Experiments<'_>,
    nk: Option<usize>,
    max_iterations: usize,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<LinearFit> {
    let records = records(py, &experiments)?;
    let inner = watched(py, progress.as_ref(), |monitor| {
        innovations::fit(&records, nk, max_iterations, monitor)
    })?;
    Ok(LinearFit { inner })
}

/// A linear difference equation between static characteristics.
#[pyclass(frozen, extends = Model, module = "sewfast._core")]
pub struct HammersteinWiener {
    inner: Arc<hammerstein::HammersteinWiener>,
}

impl Kind for HammersteinWiener {
    type Inner = hammerstein::HammersteinWiener;

    fn of(inner: Arc<Self::Inner>) -> Self {
        Self { inner }
    }
}

#[pymethods]
impl HammersteinWiener {
    #[new]
    #[pyo3(signature = (*, na, nb, nk, input_low, input_high, input_pieces, x_low, x_high, output_pieces, theta))]
    fn new(
        py: Python<'_>,
        na: usize,
        nb: usize,
        nk: usize,
        input_low: Values<'_>,
        input_high: Values<'_>,
        input_pieces: usize,
        x_low: f64,
        x_high: f64,
        output_pieces: usize,
        theta: Values<'_>,
    ) -> PyResult<PyClassInitializer<Self>> {
        let (low, high) = (
            slice(&input_low, "input_low")?,
            slice(&input_high, "input_high")?,
        );
        let of_inputs = |(low, high): (&f64, &f64)| Knots {
            low: *low,
            high: *high,
            pieces: input_pieces,
        };
        let inputs: Vec<Knots> = low.iter().zip(high).map(of_inputs).collect();
        let output = Knots {
            low: x_low,
            high: x_high,
            pieces: output_pieces,
        };
        let theta = slice(&theta, "theta")?.to_vec();
        Lags::new(na, nb, nk, low.len().max(high.len()))
            .and_then(|lags| hammerstein::HammersteinWiener::new(lags, &inputs, output, theta))
            .map(Self::wrapped)
            .raised(py)
    }

    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (lags, inputs, output) = (
            self.inner.lags(),
            self.inner.input_knots(),
            self.inner.output_knots(),
        );
        let ends = |of: fn(&Knots) -> f64| array1(py, inputs.iter().map(of).collect());
        Ok(dict! { py;
            "na" => lags.na, "nb" => lags.nb, "nk" => lags.nk, "input_low" => ends(|k| k.low),
            "input_high" => ends(|k| k.high), "input_pieces" => inputs[0].pieces, "x_low" => output.low,
            "x_high" => output.high, "output_pieces" => output.pieces,
        })
    }

    fn input_curve<'py>(
        &self,
        py: Python<'py>,
        input: usize,
        u: Values<'py>,
    ) -> PyResult<Vector<'py>> {
        Ok(array1(py, self.inner.input_curve(input, slice(&u, "u")?)))
    }

    fn output_curve<'py>(&self, py: Python<'py>, x: Values<'py>) -> PyResult<Vector<'py>> {
        Ok(array1(py, self.inner.output_curve(slice(&x, "x")?)))
    }
}

/// A fitted Hammerstein-Wiener model and how the fit went.
#[pyclass(frozen, module = "sewfast._core")]
pub struct HammersteinWienerFit {
    inner: Fit<hammerstein::HammersteinWiener>,
}

fit_methods!(HammersteinWienerFit {
    #[getter]
    fn model(&self, py: Python<'_>) -> PyResult<Py<HammersteinWiener>> {
        HammersteinWiener::object(py, self.inner.model.clone())
    }

    #[getter]
    fn initial_states<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py>> {
        let states = self.inner.initial_states.concat();
        array2(py, states, self.inner.model.lags().na)
    }
});

#[pyfunction]
#[pyo3(signature = (
    experiments, *, na, nb, nk, input_pieces, output_pieces, max_iterations = 100, progress = None
))]
pub fn fit_hammerstein_wiener(
    py: Python<'_>,
    experiments: Experiments<'_>,
    na: usize,
    nb: usize,
    nk: usize,
    input_pieces: usize,
    output_pieces: usize,
    max_iterations: usize,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<HammersteinWienerFit> {
    let records = records(py, &experiments)?;
    let pieces = (input_pieces, output_pieces);
    let inner = watched(py, progress.as_ref(), |monitor| {
        hammerstein::fit(&records, na, nb, nk, pieces, max_iterations, monitor)
    })?;
    Ok(HammersteinWienerFit { inner })
}
