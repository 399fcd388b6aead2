//! The seam: arrays borrowed in and owned out, core errors as the package's exceptions. Long work runs on its own
//! thread while the interpreter stays free, so that progress is shown and Ctrl-C is noticed.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::conversion::FromPyObjectOwned;
use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use pyo3::types::{PyTuple, PyType};
use sewfast_core::data::Samples;
use sewfast_core::{Error, ErrorKind, Monitor, Record, Result};

/// Values borrowed from Python, (N,).
pub type Values<'py> = PyReadonlyArray1<'py, f64>;
/// Values borrowed from Python, (N, n).
pub type Rows<'py> = PyReadonlyArray2<'py, f64>;
/// A new array, (N,).
pub type Vector<'py> = Bound<'py, PyArray1<f64>>;
/// A new array, (N, n).
pub type Matrix<'py> = Bound<'py, PyArray2<f64>>;

/// A dict from names and values.
macro_rules! dict {
    ($py:expr; $($name:literal => $value:expr),* $(,)?) => {{
        let dict = pyo3::types::PyDict::new($py);
        $(dict.set_item($name, $value)?;)*
        dict
    }};
}

/// A result whose error becomes an exception.
pub trait Raised<T> {
    fn raised(self, py: Python<'_>) -> PyResult<T>;
}

impl<T, E: Into<Error>> Raised<T> for std::result::Result<T, E> {
    fn raised(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|error| raise(py, error.into()))
    }
}

/// Does `work` without the interpreter.
pub fn released<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    py.detach(work).raised(py)
}

/// Turns a core error into the exception class of `sewfast.errors` for its kind.
pub fn raise(py: Python<'_>, error: Error) -> PyErr {
    let class = match error.kind {
        ErrorKind::Data => "DataError",
        ErrorKind::Setting => "SettingError",
        ErrorKind::Fit => "FitError",
    };
    match exception(py, class) {
        Ok(class) => PyErr::from_type(class, error.message),
        Err(import_error) => import_error,
    }
}

fn exception<'py>(py: Python<'py>, class: &str) -> PyResult<Bound<'py, PyType>> {
    Ok(py
        .import("sewfast.errors")?
        .getattr(class)?
        .cast_into::<PyType>()?)
}

/// The values of a one-dimensional array, borrowed.
pub fn slice<'a>(array: &'a Values<'_>, name: &str) -> PyResult<&'a [f64]> {
    array
        .as_slice()
        .map_err(|_| not_contiguous(array.py(), name))
}

/// The values of a two-dimensional array row by row and its number of columns, borrowed.
pub fn rows<'a>(array: &'a Rows<'_>, name: &str) -> PyResult<(&'a [f64], usize)> {
    // `as_slice` of the array itself takes columns for rows where they are contiguous
    let view = array.as_array();
    let columns = view.ncols();
    let values = view.to_slice();
    Ok((
        values.ok_or_else(|| not_contiguous(array.py(), name))?,
        columns,
    ))
}

fn not_contiguous(py: Python<'_>, name: &str) -> PyErr {
    let message = format!(
        "expected a C-contiguous array for {name}, got another memory layout; use numpy.ascontiguousarray"
    );
    raise(py, Error::data(message))
}

/// An experiment passed by Python, borrowed: `(u, y)`, or `(u, y, weights)` if its samples have weights.
pub struct Experiment<'py, Y> {
    /// Inputs, time first.
    pub u: Rows<'py>,
    /// Outputs.
    pub y: Y,
    weights: Option<Values<'py>>,
}

impl<'a, 'py, Y: FromPyObjectOwned<'py>> FromPyObject<'a, 'py> for Experiment<'py, Y> {
    type Error = PyErr;

    fn extract(values: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let is_weighted = values.cast::<PyTuple>().is_ok_and(|v| v.len() == 3);
        let (u, y, weights) = match is_weighted {
            true => values
                .extract::<(_, _, Values<'py>)>()
                .map(|(u, y, w)| (u, y, Some(w)))?,
            false => values.extract().map(|(u, y)| (u, y, None))?,
        };
        Ok(Self { u, y, weights })
    }
}

impl<Y> Experiment<'_, Y> {
    /// Weights of the samples, if they have any.
    pub fn weights(&self) -> PyResult<Option<&[f64]>> {
        self.weights
            .as_ref()
            .map(|w| slice(w, "weights"))
            .transpose()
    }
}

/// A list of experiments of one output.
pub type Experiments<'py> = Vec<Experiment<'py, Values<'py>>>;

/// The experiments with their shapes checked but not their values.
pub fn samples<'a>(py: Python<'_>, experiments: &'a Experiments<'_>) -> PyResult<Vec<Samples<'a>>> {
    let samples = |experiment: &'a Experiment<'_, Values<'_>>| {
        let ((u, channels), y) = (rows(&experiment.u, "u")?, slice(&experiment.y, "y")?);
        let weights = experiment.weights()?;
        let samples = Samples::new(u, channels, y);
        let weighted = samples.and_then(|s| weights.map_or(Ok(s), |w| s.with_weights(w)));
        weighted.raised(py)
    };
    experiments.iter().map(samples).collect()
}

/// The experiments as the core's records.
pub fn records<'a>(py: Python<'_>, experiments: &'a Experiments<'_>) -> PyResult<Vec<Record<'a>>> {
    let record = |samples: Samples<'a>| samples.record().raised(py);
    samples(py, experiments)?.into_iter().map(record).collect()
}

/// A new one-dimensional array that owns `values`.
pub fn array1(py: Python<'_>, values: Vec<f64>) -> Vector<'_> {
    PyArray1::from_vec(py, values)
}

/// A new two-dimensional array from `values` row by row.
pub fn array2(py: Python<'_>, values: Vec<f64>, columns: usize) -> PyResult<Matrix<'_>> {
    use numpy::PyArrayMethods;
    let rows = values.len().checked_div(columns).unwrap_or(0);
    PyArray1::from_vec(py, values).reshape([rows, columns])
}

/// Longest time until Ctrl-C is noticed.
const PERIOD: Duration = Duration::from_millis(20);

/// Runs `work` on its own thread; meanwhile calls `progress(done, total, best_cost)` and forwards Ctrl-C.
///
/// After Ctrl-C the work is asked to stop and returns its best result so far, which it marks as interrupted. If it has no result, or
/// finished before it noticed the request, `KeyboardInterrupt` is raised. A subclass of `KeyboardInterrupt`, which `progress` raises at a
/// deadline, does the same, except that a result finished before the request is whole and is returned. Any other exception, from a signal
/// handler or from `progress`, stops the work and is raised.
pub fn watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce(&Monitor) -> Result<T> + Send,
) -> PyResult<T> {
    let (monitor, done) = (Monitor::default(), AtomicBool::new(false));
    thread::scope(|scope| {
        let (shared, done, watcher) = (&monitor, &done, thread::current());
        let worker = scope.spawn(move || {
            let result = work(shared);
            done.store(true, Ordering::Release);
            watcher.unpark();
            result
        });
        let mut raised = None;
        // A worker that panics never reports that it is done, but its thread finishes.
        while !done.load(Ordering::Acquire) && !worker.is_finished() {
            py.detach(|| thread::park_timeout(PERIOD));
            if raised.is_none() {
                raised = look(py, progress, shared).err();
                if raised.is_some() {
                    shared.request_stop();
                }
            }
        }
        let outcome = py.detach(|| worker.join());
        let result = outcome.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        match raised {
            Some(error) if !error.is_instance_of::<PyKeyboardInterrupt>(py) => Err(error),
            Some(interrupt) => result
                .ok()
                .filter(|_| monitor.heard() || !is_ctrl_c(py, &interrupt))
                .ok_or(interrupt),
            None => result.raised(py),
        }
    })
}

/// Whether an exception is exactly Ctrl-C, not a subclass of it.
pub fn is_ctrl_c(py: Python<'_>, error: &PyErr) -> bool {
    error.get_type(py).is(py.get_type::<PyKeyboardInterrupt>())
}

/// This many samples of a loop or machine take a few milliseconds, during which Ctrl-C can wait.
const BRIEF: usize = 5_000;

/// [`watched`] for work over `samples` of a loop or a machine. Brief work runs on the calling thread, because a new
/// thread would take longer than some of it.
pub fn watched_over<T: Send>(
    py: Python<'_>,
    samples: usize,
    work: impl FnOnce(&Monitor) -> Result<T> + Send,
) -> PyResult<T> {
    if samples > BRIEF {
        return watched(py, None, work);
    }
    py.detach(|| work(&Monitor::default())).raised(py)
}

fn look(py: Python<'_>, progress: Option<&Bound<'_, PyAny>>, monitor: &Monitor) -> PyResult<()> {
    py.check_signals()?;
    progress.map_or(Ok(()), |callback| {
        callback.call1(monitor.progress()).map(drop)
    })
}
