//! Bindings for measured frequency responses: a machine with shafts, and the search for gains and filters.

use numpy::{Complex64, PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use sewfast_core::local_polynomial;
use sewfast_core::loop_transfer::Plant;
use sewfast_core::proposal::{self, Task};
use sewfast_core::shaft;

use crate::loop_transfer::{Lines, LoopPath, measured};
use crate::seam::{Matrix, Raised, Values, Vector, array1, array2, slice, watched};

/// Lines, values, variances, coherences, numbers of averaged values, and whether the reference is visible.
type Response<'py> = (
    Vector<'py>,
    Bound<'py, PyArray1<Complex64>>,
    Vector<'py>,
    Vector<'py>,
    Vector<'py>,
    bool,
);

#[pyfunction]
pub fn record_response<'py>(
    py: Python<'py>,
    u: Values<'py>,
    y: Values<'py>,
    r: Option<Values<'py>>,
) -> PyResult<Option<Response<'py>>> {
    let (u, y) = (slice(&u, "u")?, slice(&y, "y")?);
    let r = r.as_ref().map(|r| slice(r, "r")).transpose()?;
    let found = py.detach(|| local_polynomial::response(u, y, r));
    Ok(found.map(|f| {
        let [lines, variance, coherence, blocks] =
            [f.lines, f.variance, f.coherence, f.blocks].map(|v| array1(py, v));
        let value = PyArray1::from_vec(py, f.value);
        (lines, value, variance, coherence, blocks, f.is_related)
    }))
}

#[pyfunction]
#[pyo3(signature = (theta, hertz, *, Ts, counted))]
pub fn shaft_response<'py>(
    py: Python<'py>,
    theta: Values<'py>,
    hertz: Values<'py>,
    Ts: f64,
    counted: bool,
) -> PyResult<Bound<'py, PyArray1<Complex64>>> {
    let (theta, hertz) = (slice(&theta, "theta")?, slice(&hertz, "hertz")?);
    let found = shaft::response(theta, hertz, Ts, counted).raised(py)?;
    Ok(PyArray1::from_vec(py, found))
}

/// Numerator and denominator in powers of z^-1.
type Fraction<'py> = (Vector<'py>, Vector<'py>);

#[pyfunction]
#[pyo3(signature = (theta, *, Ts))]
pub fn shaft_fraction<'py>(
    py: Python<'py>,
    theta: Values<'py>,
    Ts: f64,
) -> PyResult<Fraction<'py>> {
    let (num, den) = shaft::fraction(slice(&theta, "theta")?, Ts).raised(py)?;
    Ok((array1(py, num), array1(py, den)))
}

/// Sum of squares, parameters, covariance; frequency of a resonance above the lines.
type Fitted<'py> = (f64, Vector<'py>, Matrix<'py>, Option<f64>);

#[pyfunction]
#[pyo3(signature = (hertz, value, sigma, *, Ts, counted, resonance))]
pub fn fit_shaft<'py>(
    py: Python<'py>,
    hertz: Values<'py>,
    value: PyReadonlyArray1<'py, Complex64>,
    sigma: Values<'py>,
    Ts: f64,
    counted: bool,
    resonance: Option<bool>,
) -> PyResult<Fitted<'py>> {
    let lines = shaft::Lines {
        hertz: slice(&hertz, "hertz")?,
        value: value.as_slice()?,
        sigma: slice(&sigma, "sigma")?,
        ts: Ts,
        counted,
    };
    let (found, beyond) = watched(py, None, |monitor| shaft::search(lines, resonance, monitor))?;
    let n = found.theta.len();
    Ok((
        found.cost,
        array1(py, found.theta),
        array2(py, found.covariance, n)?,
        beyond,
    ))
}

/// Gains in standard form with `N`, the lag \[s\], and the numbers of each filter.
type Proposed = ((f64, f64, f64, f64), f64, Vec<Vec<f64>>);

/// A machine from a frequency response, and what a controller of it has to keep.
#[pyclass(module = "sewfast._core", frozen)]
pub struct ProposalTask(Task);

#[pymethods]
impl ProposalTask {
    #[new]
    #[pyo3(signature = (path, num, den, *, lines, above, Ms, quiet))]
    fn new(
        py: Python<'_>,
        path: &LoopPath,
        num: Values<'_>,
        den: Values<'_>,
        lines: Lines<'_>,
        above: Lines<'_>,
        Ms: f64,
        quiet: f64,
    ) -> PyResult<Self> {
        Ok(Self(Task {
            plant: Plant::new(slice(&num, "num")?, slice(&den, "den")?).raised(py)?,
            lines: measured(&lines, path.0.ts)?,
            above: measured(&above, path.0.ts)?,
            path: path.0,
            ms: Ms,
            quiet,
        }))
    }

    fn best<'py>(
        &self,
        py: Python<'py>,
        starts: Vec<Vec<f64>>,
    ) -> PyResult<(Option<f64>, Vector<'py>, Proposed)> {
        let found = watched(py, None, |monitor| self.0.best(&starts, monitor))?;
        let proposal::Proposed {
            gains,
            n,
            filter_time,
            filters,
        } = found.proposed;
        let gains = (gains.kp, gains.ti, gains.td, n);
        Ok((
            found.merit,
            array1(py, found.x),
            (gains, filter_time, filters),
        ))
    }
}
