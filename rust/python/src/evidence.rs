//! Bindings of what is seen in a record without a model, and of the tests of a model's residuals.

use numpy::{PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use sewfast_core::changes;
use sewfast_core::residuals::{self, Run, Test};

use crate::seam::{Experiments, array2, raise, rows, slice, watched};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(changed, module)?)?;
    module.add_function(wrap_pyfunction!(residual_tests, module)?)?;
    module.add_function(wrap_pyfunction!(parameter_test, module)?)?;
    module.add_function(wrap_pyfunction!(coloured_information, module)?)
}

/// Experiment, sample, gain, shift, and the share of the error that is left.
type Change = (usize, usize, f64, isize, f64);

#[pyfunction]
fn changed(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<Change>> {
    let mut channels = 1;
    let borrowed = experiments.iter().map(|e| {
        let (u, width) = rows(&e.u, "u")?;
        channels = width;
        Ok(changes::Experiment {
            u,
            y: slice(&e.y, "y")?,
        })
    });
    let borrowed = borrowed.collect::<PyResult<Vec<_>>>()?;
    let found = watched(py, None, |monitor| {
        changes::changed(&borrowed, channels, monitor)
    })?;
    Ok(found.map(|c| (c.experiment, c.start, c.gain, c.shift, c.left)))
}

/// Inputs, computed output, residual, which samples count, and sensitivities of one experiment.
type Experiment<'py> = (
    PyReadonlyArray2<'py, f64>,
    PyReadonlyArray1<'py, f64>,
    PyReadonlyArray1<'py, f64>,
    PyReadonlyArray1<'py, bool>,
    PyReadonlyArray2<'py, f64>,
);

/// Lags, series, correlations, limits, statistic, p-value, degrees of freedom, threshold, explained share.
type Tested<'py> = (
    Vec<usize>,
    Vec<Vec<usize>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
    f64,
    f64,
    usize,
    f64,
    f64,
);

/// The experiments, and their number of inputs.
fn borrowed<'a>(experiments: &'a [Experiment<'_>]) -> PyResult<(Vec<Run<'a>>, usize)> {
    let mut channels = 0;
    let runs = experiments.iter().map(|(u, output, error, counts, psi)| {
        let (u, width) = rows(u, "u")?;
        channels = width;
        Ok(Run {
            u,
            output: slice(output, "output")?,
            error: slice(error, "error")?,
            counts: counts.as_slice()?,
            sensitivity: rows(psi, "sensitivity")?.0,
        })
    });
    Ok((runs.collect::<PyResult<_>>()?, channels))
}

fn handed_over(py: Python<'_>, test: Test) -> PyResult<Tested<'_>> {
    let width = test.lags.len();
    Ok((
        test.lags,
        test.series,
        array2(py, test.correlations, width)?,
        array2(py, test.limits, width)?,
        test.statistic,
        test.p_value,
        test.freedom,
        test.threshold,
        test.explained,
    ))
}

#[pyfunction]
#[pyo3(signature = (experiments, *, memory, one_step))]
fn residual_tests<'py>(
    py: Python<'py>,
    experiments: Vec<Experiment<'py>>,
    memory: usize,
    one_step: bool,
) -> PyResult<Vec<Tested<'py>>> {
    let (runs, channels) = borrowed(&experiments)?;
    let found = watched(py, None, |monitor| {
        residuals::tests(&runs, channels, memory, one_step, monitor)
    })?;
    let tests = found.into_iter().map(|test| handed_over(py, test));
    tests.collect()
}

#[pyfunction]
#[pyo3(signature = (experiments, *, trained))]
fn parameter_test<'py>(
    py: Python<'py>,
    experiments: Vec<Experiment<'py>>,
    trained: usize,
) -> PyResult<Tested<'py>> {
    let (runs, channels) = borrowed(&experiments)?;
    let test = py.detach(|| residuals::parameters(&runs, channels, trained));
    handed_over(py, test.map_err(|e| raise(py, e))?)
}

#[pyfunction]
#[pyo3(signature = (experiments, *, spent))]
fn coloured_information<'py>(
    py: Python<'py>,
    experiments: Vec<Experiment<'py>>,
    spent: f64,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (runs, channels) = borrowed(&experiments)?;
    let found = py.detach(|| residuals::coloured_information(&runs, channels, spent));
    let found = found.map_err(|e| raise(py, e))?;
    let width = found.ncols();
    array2(py, found.as_slice().to_vec(), width)
}
