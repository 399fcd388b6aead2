//! Bindings of the core's models: the part common to all kinds, the guard, and models in a microcontroller's form.

use std::sync::Arc;

use pyo3::PyClass;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::embedded::{Embedded, Precision};
use sewfast_core::guard::{Unsound, verdict};
use sewfast_core::linearised::Linearised;
use sewfast_core::{Error, Result, model, stacking};

use crate::seam::{
    Experiments, Matrix, Raised, Rows, Values, Vector, array1, array2, raise, records, released,
    rows, slice, watched,
};
use linear::LinearModel;
use neural::NeuralOE;
use neural_ss::NeuralSS;

/// The methods of a fit: common ones, and its own. PyO3 allows one block of methods per class.
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
            fn trace<'py>(&self, py: Python<'py>) -> Vector<'py> {
                array1(py, self.inner.trace.clone())
            }

            $($own)*
        }
    };
}

/// The methods of a fit that was chosen from several starts.
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
            fn start_costs<'py>(&self, py: Python<'py>) -> Vector<'py> {
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

pub mod linear;
pub mod neural;
pub mod neural_ss;

/// A model of any kind: the class below which each kind adds its parameters.
#[pyclass(frozen, subclass, module = "sewfast._core")]
pub struct Model {
    /// The model as the trait object that most code needs.
    pub inner: Arc<dyn model::Model>,
}

/// A kind of model in Python: it adds its own value to the one in [`Model`].
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

    /// A new Python object.
    fn object(py: Python<'_>, inner: Self::Inner) -> PyResult<Py<Self>> {
        Py::new(py, Self::wrapped(inner))
    }
}

#[pymethods]
impl Model {
    #[getter]
    fn theta<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array1(py, self.inner.theta())
    }

    fn rest_state<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array1(py, py.detach(|| self.inner.rest_state()))
    }

    fn simulate<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Vector<'py>> {
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
    ) -> PyResult<Vector<'py>> {
        let ((u, channels), y, state) = (rows(&u, "u")?, slice(&y, "y")?, slice(&state, "state")?);
        let run = released(py, || self.inner.predict(u, channels, y, state, horizon))?;
        Ok(array1(py, run))
    }

    fn estimate_initial_state<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        y: Values<'py>,
    ) -> PyResult<Vector<'py>> {
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
        made.map(EmbeddedModel::of).raised(py)
    }
}

/// A, B, C, D.
type Matrices<'py> = (Matrix<'py>, Matrix<'py>, Matrix<'py>, Matrix<'py>);

fn matrices(py: Python<'_>, found: Result<Linearised>) -> PyResult<Matrices<'_>> {
    let Linearised {
        a,
        b,
        c,
        d,
        states,
        inputs,
    } = found.raised(py)?;
    Ok((
        array2(py, a, states)?,
        array2(py, b, inputs)?,
        array2(py, c, states)?,
        array2(py, d, inputs)?,
    ))
}

type RunAndJacobian<'py> = (Vector<'py>, Matrix<'py>);

#[pyfunction]
pub fn convex_weights<'py>(
    py: Python<'py>,
    residuals: Rows<'py>,
    weights: Values<'py>,
) -> PyResult<Vector<'py>> {
    let ((residuals, models), weights) =
        (rows(&residuals, "residuals")?, slice(&weights, "weights")?);
    let found = released(py, || stacking::convex_weights(residuals, models, weights))?;
    Ok(array1(py, found))
}

#[pyfunction]
#[pyo3(signature = (model, experiments, *, linear = Vec::new()))]
pub fn guard(
    py: Python<'_>,
    model: &Bound<'_, PyAny>,
    experiments: Experiments<'_>,
    linear: Vec<PyRef<'_, LinearModel>>,
) -> PyResult<&'static str> {
    let experiments = records(py, &experiments)?;
    let linear: Vec<_> = linear.iter().map(|m| m.inner.as_ref().clone()).collect();
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
        let found = dict! { py;
            "u_mean" => array1(py, u_mean.clone()), "u_scale" => array1(py, u_scale.clone()),
            "y_mean" => array1(py, vec![*y_mean]), "y_scale" => array1(py, vec![*y_scale]),
        };
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
    ) -> PyResult<Vector<'py>> {
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
        Ok(array1(py, found.raised(py)?))
    }
}

/// The coefficients of `tanh(x) = x P(x^2)/Q(x^2)`: numerator, denominator and end of each quotient.
#[pyfunction]
pub fn tanh_quotients(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
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
