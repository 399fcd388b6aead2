//! The searches on functions of Python's, for whoever wants to compare them with others.

use std::sync::Mutex;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::search::nsga2::{self, Objectives, Values};
use sewfast_core::search::{Candidate, Judgement, Options, Problem, cma_es, genetic};
use sewfast_core::{Error, Monitor};

use crate::arrays::{array1, raise};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(search_least, module)?)?;
    module.add_function(wrap_pyfunction!(search_front, module)?)
}

/// A function of Python's over the unit box; what it raises ends the search.
struct Function {
    function: Py<PyAny>,
    dimensions: usize,
    objectives: usize,
    raised: Mutex<Option<PyErr>>,
}

impl Function {
    /// What the function returns; `None` once it has raised.
    fn at<T>(
        &self,
        point: &[f64],
        monitor: &Monitor,
        extract: impl Fn(&Bound<'_, PyAny>) -> PyResult<T>,
    ) -> Option<T> {
        if monitor.stopped() {
            return None;
        }
        let called = Python::attach(|py| {
            py.check_signals()?;
            let value = self
                .function
                .bind(py)
                .call1((array1(py, point.to_vec()),))?;
            extract(&value)
        });
        called
            .map_err(|error| {
                monitor.request_stop();
                if let Ok(mut raised) = self.raised.lock() {
                    *raised = Some(error);
                }
            })
            .ok()
    }

    fn checked(self) -> PyResult<()> {
        let raised = self.raised.into_inner();
        raised.ok().flatten().map_or(Ok(()), Err)
    }
}

impl Problem for Function {
    type Memory = ();

    fn dimensions(&self) -> usize {
        self.dimensions
    }

    fn memory(&self) {}

    fn judge(&self, (): &mut (), candidates: &[Candidate], monitor: &Monitor) -> Vec<Judgement> {
        let judged = candidates.iter().map(|c| self.judge_one(&c.point, monitor));
        judged.collect()
    }
}

impl Function {
    fn judge_one(&self, point: &[f64], monitor: &Monitor) -> Judgement {
        self.at(point, monitor, |value| value.extract::<f64>())
            .map_or(Judgement::HOPELESS, Judgement::feasible)
    }
}

impl Objectives for Function {
    type Memory = ();

    fn dimensions(&self) -> usize {
        self.dimensions
    }

    fn memory(&self) {}

    fn judge(&self, (): &mut (), points: &[Vec<f64>], monitor: &Monitor) -> Vec<Values> {
        points
            .iter()
            .map(|point| self.values_of(point, monitor))
            .collect()
    }
}

impl Function {
    fn values_of(&self, point: &[f64], monitor: &Monitor) -> Values {
        let values = self.at(point, monitor, |value| value.extract::<Vec<f64>>());
        Values {
            violation: if values.is_some() { 0.0 } else { f64::INFINITY },
            objectives: values
                .filter(|values| values.len() == self.objectives)
                .unwrap_or_else(|| vec![f64::INFINITY; self.objectives]),
        }
    }
}

fn options(evaluations: usize, seed: u64, tolerance: f64) -> Options {
    Options {
        evaluations,
        seed,
        threads: 1,
        tolerance,
    }
}

/// The most coordinates and objectives.
const MOST: usize = 1000;

fn bounded(count: usize) -> sewfast_core::Result<()> {
    if count <= MOST {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected at most {MOST} coordinates and objectives, got {count}"
    )))
}

/// The least value of a function over the unit box.
#[pyfunction]
#[pyo3(signature = (function, dimensions, *, method, evaluations, seed, start=None, tolerance=1e-8))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
fn search_least<'py>(
    py: Python<'py>,
    function: Py<PyAny>,
    dimensions: usize,
    method: &str,
    evaluations: usize,
    seed: u64,
    start: Option<Vec<f64>>,
    tolerance: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let problem = Function {
        function,
        dimensions,
        objectives: 1,
        raised: Mutex::new(None),
    };
    let inside = |s: &Vec<f64>| s.len() == dimensions && s.iter().all(|x| (0.0..=1.0).contains(x));
    bounded(dimensions).map_err(|e| raise(py, e))?;
    if dimensions == 0 || !start.as_ref().is_none_or(inside) {
        let message = format!(
            "expected {dimensions} coordinates, 1 or more, from 0 to 1 as a start, got {start:?}"
        );
        return Err(raise(py, Error::setting(message)));
    }
    let (monitor, start) = (Monitor::default(), start.as_deref());
    let options = options(evaluations, seed, tolerance);
    let found = match method {
        "genetic" => genetic::search(&problem, start, options, &monitor),
        "cma-es" => cma_es::search(&problem, start, options, &monitor),
        _ => Err(Error::setting(format!(
            "expected method 'genetic' or 'cma-es', got '{method}'"
        ))),
    }
    .map_err(|e| raise(py, e))?;
    problem.checked()?;
    let dict = PyDict::new(py);
    dict.set_item("x", array1(py, found.point))?;
    dict.set_item("value", found.judgement.cost)?;
    let trace = found.trace.iter().map(|j| j.cost).collect();
    dict.set_item("trace", array1(py, trace))?;
    Ok(dict)
}

/// A front of least values of a function over the unit box.
#[pyfunction]
#[pyo3(signature = (function, dimensions, objectives, *, size, evaluations, seed))]
fn search_front<'py>(
    py: Python<'py>,
    function: Py<PyAny>,
    dimensions: usize,
    objectives: usize,
    size: usize,
    evaluations: usize,
    seed: u64,
) -> PyResult<Bound<'py, PyDict>> {
    let problem = Function {
        function,
        dimensions,
        objectives,
        raised: Mutex::new(None),
    };
    bounded(dimensions)
        .and(bounded(objectives))
        .map_err(|e| raise(py, e))?;
    let options = options(evaluations, seed, 0.0);
    let front = nsga2::search(&problem, &[], size, options, &Monitor::default())
        .map_err(|e| raise(py, e))?;
    problem.checked()?;
    let dict = PyDict::new(py);
    let points: Vec<_> = front.members.iter().map(|m| m.point.clone()).collect();
    let values: Vec<_> = front
        .members
        .into_iter()
        .map(|m| m.values.objectives)
        .collect();
    dict.set_item("points", points)?;
    dict.set_item("values", values)?;
    Ok(dict)
}
