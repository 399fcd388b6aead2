//! Bindings of estimation: the descent with a statistical end, and covariances.

use nalgebra::{DMatrix, DVector};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use sewfast_core::bounded::{self, Ends, Normal, Squares};
use sewfast_core::sandwich::{self, Scores};

use crate::seam::{array1, array2, raise, rows, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(minimised, module)?)?;
    module.add_function(wrap_pyfunction!(sandwich_covariance, module)?)?;
    module.add_function(wrap_pyfunction!(inverse_root, module)?)
}

/// A problem of two Python functions.
struct Called<'a, 'py> {
    normal: &'a Bound<'py, PyAny>,
    cost: &'a Bound<'py, PyAny>,
}

impl<'py> Called<'_, 'py> {
    fn x(&self, x: &[f64]) -> Bound<'py, PyArray1<f64>> {
        array1(self.cost.py(), x.to_vec())
    }
}

impl Squares for Called<'_, '_> {
    type Stop = PyErr;

    fn normal(&mut self, x: &[f64]) -> PyResult<Normal> {
        type Found<'py> = (f64, PyReadonlyArray1<'py, f64>, PyReadonlyArray2<'py, f64>);
        let found = self.normal.call1((self.x(x),))?;
        let (cost, gradient, matrix): Found<'_> = found.extract()?;
        Ok(Normal {
            cost,
            gradient: DVector::from_iterator(x.len(), gradient.as_array().iter().copied()),
            matrix: DMatrix::from_iterator(x.len(), x.len(), matrix.as_array().iter().copied()),
        })
    }

    fn cost(&mut self, x: &[f64]) -> PyResult<f64> {
        self.cost.call1((self.x(x),))?.extract()
    }
}

/// Where the descent ended: parameters, cost, squared distance to the minimum in standard errors, and the exception that ended it.
type Minimum<'py> = (Bound<'py, PyArray1<f64>>, f64, f64, Option<PyErr>);

#[pyfunction]
#[pyo3(signature = (normal, cost, start, low, high, *, count, enough, iterations))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn minimised<'py>(
    py: Python<'py>,
    normal: &Bound<'py, PyAny>,
    cost: &Bound<'py, PyAny>,
    start: PyReadonlyArray1<'py, f64>,
    low: PyReadonlyArray1<'py, f64>,
    high: PyReadonlyArray1<'py, f64>,
    count: f64,
    enough: f64,
    iterations: usize,
) -> PyResult<Minimum<'py>> {
    let ends = Ends {
        low: slice(&low, "low")?,
        high: slice(&high, "high")?,
        count,
        enough,
        iterations,
    };
    let start = slice(&start, "start")?.to_vec();
    let found = bounded::minimised(&mut Called { normal, cost }, start, &ends)?;
    Ok((array1(py, found.x), found.cost, found.left, found.stopped))
}

#[pyfunction]
#[pyo3(signature = (jacobian, residuals, lengths, windows, *, channels=1, known=None))]
fn sandwich_covariance<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    residuals: PyReadonlyArray1<'py, f64>,
    lengths: Vec<usize>,
    windows: Vec<usize>,
    channels: usize,
    known: Option<PyReadonlyArray2<'py, f64>>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (jacobian, n) = rows(&jacobian, "jacobian")?;
    let scores = Scores {
        jacobian,
        residuals: slice(&residuals, "residuals")?,
        lengths: &lengths,
        windows: &windows,
        channels,
    };
    let known = match &known {
        Some(known) => square(known),
        None => DMatrix::zeros(0, 0),
    };
    let found = py.detach(|| sandwich::covariance(&scores, &known));
    let found = found.map_err(|e| raise(py, e))?;
    array2(py, found.iter().copied().collect(), n)
}

fn square(matrix: &PyReadonlyArray2<'_, f64>) -> DMatrix<f64> {
    let view = matrix.as_array();
    DMatrix::from_fn(view.nrows(), view.ncols(), |i, j| view[[i, j]])
}

/// A root of the inverse, (n, determined directions), and a huge covariance for the other directions, (n, n).
type Root<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>);

#[pyfunction]
fn inverse_root<'py>(py: Python<'py>, matrix: PyReadonlyArray2<'py, f64>) -> PyResult<Root<'py>> {
    let found = sandwich::root(&square(&matrix)).map_err(|e| raise(py, e))?;
    let array = |matrix: &DMatrix<f64>| {
        array2(
            py,
            matrix.transpose().iter().copied().collect(),
            matrix.ncols(),
        )
    };
    Ok((array(&found.half)?, array(&found.unknown)?))
}
