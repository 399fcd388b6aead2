//! Bindings of the core's optimisers, to use them alone or compare them with others: least squares with residuals and
//! Jacobians, and the searches.

use std::sync::Mutex;

use crate::seam::{Matrix, Raised, Rows, Values, array1, array2, is_ctrl_c, raise, rows, slice};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::least_squares::{self, Residuals, Settings, Solution, Termination};
use sewfast_core::search::nsga2::{self, Objectives};
use sewfast_core::search::{Candidate, Judgement, Options, Problem, cma_es, genetic};
use sewfast_core::{Error, Monitor};

/// A Python function over the unit box; an exception in it ends the search.
struct Function {
    function: Py<PyAny>,
    dimensions: usize,
    objectives: usize,
    raised: Mutex<Option<PyErr>>,
}

impl Function {
    /// The function's result; `None` once it has raised.
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

    fn judge(&self, (): &mut (), points: &[Vec<f64>], monitor: &Monitor) -> Vec<nsga2::Values> {
        points
            .iter()
            .map(|point| self.values_of(point, monitor))
            .collect()
    }
}

impl Function {
    fn values_of(&self, point: &[f64], monitor: &Monitor) -> nsga2::Values {
        let values = self.at(point, monitor, |value| value.extract::<Vec<f64>>());
        nsga2::Values {
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

/// Most coordinates, and most objectives.
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
pub fn search_least<'py>(
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
    bounded(dimensions).raised(py)?;
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
    .raised(py)?;
    problem.checked()?;
    let dict = dict! { py;
        "x" => array1(py, found.point), "value" => found.judgement.cost,
    };
    let trace = found.trace.iter().map(|j| j.cost).collect();
    dict.set_item("trace", array1(py, trace))?;
    Ok(dict)
}

/// A front of least values of a function over the unit box.
#[pyfunction]
#[pyo3(signature = (function, dimensions, objectives, *, size, evaluations, seed))]
pub fn search_front<'py>(
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
    bounded(dimensions).and(bounded(objectives)).raised(py)?;
    let options = options(evaluations, seed, 0.0);
    let front = nsga2::search(&problem, &[], size, options, &Monitor::default()).raised(py)?;
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

/// Python functions as residuals. Every call gets its own arrays, so that a function may keep them.
struct Functions<'a, 'py> {
    py: Python<'py>,
    fun: &'a Bound<'py, PyAny>,
    jac: &'a Bound<'py, PyAny>,
    parameters: usize,
    residuals: usize,
    /// Residuals at the start, which are already known.
    first: Option<Vec<f64>>,
    monitor: &'a Monitor,
    raised: Option<PyErr>,
}

impl<'py> Functions<'_, 'py> {
    fn residuals_at(&mut self, theta: &[f64], r: &mut [f64]) -> PyResult<()> {
        self.py.check_signals()?;
        if let Some(first) = self.first.take() {
            r.copy_from_slice(&first);
            return Ok(());
        }
        let values = self.fun.call1((PyArray1::from_slice(self.py, theta),))?;
        let values: Values<'py> = values.extract()?;
        r.copy_from_slice(slice(&values, "fun")?);
        Ok(())
    }

    fn jacobian_at(&mut self, theta: &[f64], r: &[f64], j: &mut [f64]) -> PyResult<()> {
        self.py.check_signals()?;
        let at = PyArray1::from_slice(self.py, theta);
        let values = self.jac.call1((at, PyArray1::from_slice(self.py, r)))?;
        let values: Rows<'py> = values.extract()?;
        j.copy_from_slice(rows(&values, "jac")?.0);
        Ok(())
    }

    /// An exception stops the iteration and is kept for the caller.
    fn had(&mut self, result: PyResult<()>) -> bool {
        let had = result.is_ok();
        if let Err(error) = result {
            self.monitor.request_stop();
            self.raised = Some(error);
        }
        had
    }
}

impl Residuals for Functions<'_, '_> {
    fn parameters(&self) -> usize {
        self.parameters
    }

    fn len(&self) -> usize {
        self.residuals
    }

    fn residuals(&mut self, theta: &[f64], r: &mut [f64]) -> bool {
        if self.raised.is_some() {
            return false;
        }
        let result = self.residuals_at(theta, r);
        self.had(result)
    }

    fn jacobian(&mut self, theta: &[f64], r: &[f64], j: &mut [f64]) -> bool {
        if self.raised.is_some() {
            return false;
        }
        let result = self.jacobian_at(theta, r, j);
        self.had(result)
    }
}

#[pyfunction]
#[pyo3(signature = (fun, jac, x0, first, *, lower, upper, x_scale, ftol, xtol, gtol, max_nfev, precision))]
pub fn least_squares_fit<'py>(
    py: Python<'py>,
    fun: Bound<'py, PyAny>,
    jac: Bound<'py, PyAny>,
    x0: Values<'py>,
    first: Values<'py>,
    lower: Option<Values<'py>>,
    upper: Option<Values<'py>>,
    x_scale: Option<Values<'py>>,
    ftol: f64,
    xtol: f64,
    gtol: f64,
    max_nfev: usize,
    precision: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let owned = |values: Option<Values<'py>>, name| {
        values
            .map(|v| slice(&v, name).map(<[f64]>::to_vec))
            .transpose()
    };
    let settings = Settings {
        ftol,
        xtol,
        gtol,
        max_evaluations: max_nfev,
        precision,
        scale: owned(x_scale, "x_scale")?,
        lower: owned(lower, "bounds")?,
        upper: owned(upper, "bounds")?,
    };
    let (start, first) = (slice(&x0, "x0")?.to_vec(), slice(&first, "fun")?.to_vec());
    let monitor = Monitor::default();
    let mut functions = Functions {
        py,
        fun: &fun,
        jac: &jac,
        parameters: start.len(),
        residuals: first.len(),
        first: Some(first),
        monitor: &monitor,
        raised: None,
    };
    let solution = least_squares::solve(&mut functions, start, &settings, &monitor);
    match functions.raised {
        // Exactly this class: Ctrl-C keeps the best point; every other exception goes to the caller.
        Some(error) if !is_ctrl_c(py, &error) => Err(error),
        _ => story(py, solution.raised(py)?),
    }
}

fn story(py: Python<'_>, solution: Solution) -> PyResult<Bound<'_, PyDict>> {
    let n = solution.theta.len();
    let story = dict! { py;
        "x" => array1(py, solution.theta), "cost" => solution.cost, "fun" => array1(py, solution.residual),
    };
    let jacobian: Matrix<'_> = array2(py, solution.jacobian, n)?;
    story.set_item("jac", jacobian)?;
    story.set_item("success", solution.termination.is_converged())?;
    story.set_item("status", status(solution.termination))?;
    story.set_item("termination", solution.termination.name())?;
    story.set_item("message", solution.termination.remedy())?;
    story.set_item("nfev", solution.evaluations)?;
    story.set_item("njev", solution.jacobians)?;
    story.set_item("optimality", solution.optimality)?;
    story.set_item("relative_offset", solution.cosine)?;
    let active: Vec<i64> = solution.active.iter().map(|&v| i64::from(v)).collect();
    story.set_item("active_mask", PyArray1::from_vec(py, active))?;
    story.set_item("covariance", array2(py, solution.covariance, n)?)?;
    story.set_item("condition", solution.condition)?;
    story.set_item("rank", solution.rank)?;
    story.set_item("trace", array1(py, solution.trace))?;
    Ok(story)
}

/// SciPy's status numbers, where it has one; failures that it does not distinguish are below zero.
fn status(termination: Termination) -> i32 {
    match termination {
        Termination::SmallGradient => 1,
        Termination::SmallReduction => 2,
        Termination::SmallStep => 3,
        Termination::MaxEvaluations | Termination::MaxIterations => 0,
        Termination::NotFinite => -1,
        Termination::Interrupted => -2,
        Termination::Stalled => -3,
        Termination::Flat => -4,
        Termination::RankDeficient => -5,
        Termination::Saddle => -6,
    }
}
