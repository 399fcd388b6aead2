//! Binding of least squares with residuals and Jacobians of Python.

use crate::seam::{Raised, Rows, Values, array1, array2, is_ctrl_c, rows, slice};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_core::Monitor;
use sewfast_core::least_squares::{self, Residuals, Settings, Solution, Termination};

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
    let active: Vec<i64> = solution.active.iter().map(|&v| i64::from(v)).collect();
    Ok(dict! { py;
        "x" => array1(py, solution.theta), "cost" => solution.cost, "fun" => array1(py, solution.residual),
        "jac" => array2(py, solution.jacobian, n)?, "success" => solution.termination.is_converged(),
        "status" => status(solution.termination), "termination" => solution.termination.name(),
        "message" => solution.termination.remedy(), "nfev" => solution.evaluations, "njev" => solution.jacobians,
        "optimality" => solution.optimality, "relative_offset" => solution.cosine,
        "active_mask" => PyArray1::from_vec(py, active), "covariance" => array2(py, solution.covariance, n)?,
        "condition" => solution.condition, "rank" => solution.rank, "trace" => array1(py, solution.trace),
    })
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
