//! Bindings of estimation: the descent with a statistical end, and covariances.

use crate::seam::{Matrix, Raised, Rows, Values, Vector, array1, array2, released, rows, slice};
use nalgebra::{DMatrix, DVector};
use pyo3::prelude::*;
use sewfast_core::bounded::{self, Ends, Normal, Squares};
use sewfast_core::sandwich::{self, Scores};

/// A problem of two Python functions.
struct Called<'a, 'py> {
    normal: &'a Bound<'py, PyAny>,
    cost: &'a Bound<'py, PyAny>,
}

impl<'py> Called<'_, 'py> {
    fn x(&self, x: &[f64]) -> Vector<'py> {
        array1(self.cost.py(), x.to_vec())
    }
}

impl Squares for Called<'_, '_> {
    type Stop = PyErr;

    fn normal(&mut self, x: &[f64]) -> PyResult<Normal> {
        type Found<'py> = (f64, Values<'py>, Rows<'py>);
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
type Minimum<'py> = (Vector<'py>, f64, f64, Option<PyErr>);

#[pyfunction]
#[pyo3(signature = (normal, cost, start, low, high, *, count, enough, iterations))]
pub fn minimised<'py>(
    py: Python<'py>,
    normal: &Bound<'py, PyAny>,
    cost: &Bound<'py, PyAny>,
    start: Values<'py>,
    low: Values<'py>,
    high: Values<'py>,
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
#[pyo3(signature = (jacobian, residuals, lengths, *, channels=1, known=None))]
pub fn sandwich_covariance<'py>(
    py: Python<'py>,
    jacobian: Rows<'py>,
    residuals: Values<'py>,
    lengths: Vec<usize>,
    channels: usize,
    known: Option<Rows<'py>>,
) -> PyResult<Matrix<'py>> {
    let (jacobian, n) = rows(&jacobian, "jacobian")?;
    let scores = Scores {
        jacobian,
        residuals: slice(&residuals, "residuals")?,
        lengths: &lengths,
        channels,
    };
    let known = match &known {
        Some(known) => square(known),
        None => DMatrix::zeros(0, 0),
    };
    let found = released(py, || sandwich::covariance(&scores, &known))?;
    array2(py, found.iter().copied().collect(), n)
}

fn square(matrix: &Rows<'_>) -> DMatrix<f64> {
    let view = matrix.as_array();
    DMatrix::from_fn(view.nrows(), view.ncols(), |i, j| view[[i, j]])
}

/// A root of the inverse, (n, determined directions), and a huge covariance for the other directions, (n, n).
type Root<'py> = (Matrix<'py>, Matrix<'py>);

#[pyfunction]
pub fn inverse_root<'py>(py: Python<'py>, matrix: Rows<'py>) -> PyResult<Root<'py>> {
    let found = sandwich::root(&square(&matrix)).raised(py)?;
    let array = |matrix: &DMatrix<f64>| {
        array2(
            py,
            matrix.transpose().iter().copied().collect(),
            matrix.ncols(),
        )
    };
    Ok((array(&found.half)?, array(&found.unknown)?))
}
