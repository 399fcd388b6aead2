//! Bindings of what is seen in a record without a model, and of the tests of a model's residuals.

use crate::seam::{
    Experiments, Matrix, Raised, Rows, Values, Vector, array1, array2, released, rows, samples,
    slice, watched,
};
use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use sewfast_core::Monitor;
use sewfast_core::residuals::{self, Noise, Run, Test};
use sewfast_core::{
    changes, column, dead_time, excitation, faults, feedback as loops, orders, sensor,
};

/// Experiment, sample, gain, shift, and the share of the error that is left.
type Change = (usize, usize, f64, isize, f64);

#[pyfunction]
pub fn changed(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<Change>> {
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

/// Input, gain, offset, delay.
type Copied = (usize, f64, f64, usize);

#[pyfunction]
pub fn copied(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<Copied>> {
    let borrowed = samples(py, &experiments)?;
    let found = py.detach(|| faults::copied(&borrowed));
    Ok(found.map(|c| (c.input, c.gain, c.offset, c.delay)))
}

#[pyfunction]
pub fn computed(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<&'static str>> {
    let borrowed = samples(py, &experiments)?;
    let found = py.detach(|| faults::computed(&borrowed));
    Ok(found.map(|sum| match sum {
        faults::Sum::Output => "output",
        faults::Sum::Change => "change",
        faults::Sum::Curve => "curve",
    }))
}

/// Kind, input, shift, and twice the log-likelihood.
type Order = (&'static str, usize, usize, f64);

#[pyfunction]
pub fn order_in_time(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<Order>> {
    let borrowed = samples(py, &experiments)?;
    let work = |monitor: &Monitor| Ok(faults::order_in_time(&borrowed, monitor));
    Ok(watched(py, None, work)?.map(|o| {
        let kind = match o.kind {
            faults::Kind::Exchanged => "exchanged",
            faults::Kind::Late => "late",
            faults::Kind::AtOnce => "at_once",
        };
        (kind, o.input, o.shift, o.evidence)
    }))
}

/// Whether it is an integral, input, lengths, time constant, gain, and standard errors of restoring and driving.
type Integration = (bool, usize, f64, f64, f64, f64, f64);

#[pyfunction]
#[pyo3(signature = (experiments, *, Ts))]
pub fn integration(
    py: Python<'_>,
    experiments: Experiments<'_>,
    Ts: f64,
) -> PyResult<Option<Integration>> {
    let borrowed = samples(py, &experiments)?;
    let found = py.detach(|| loops::integration(&borrowed, Ts));
    Ok(found.map(|i| {
        let (is, of) = (i.is_integral, i.input);
        (
            is,
            of,
            i.lengths,
            i.time_constant,
            i.gain,
            i.restoring,
            i.driving,
        )
    }))
}

/// Input, lead, correlation, significance, misfit.
type Feedback = (usize, usize, f64, f64, f64);

#[pyfunction]
pub fn feedback(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<Feedback>> {
    let borrowed = samples(py, &experiments)?;
    let work = |monitor: &Monitor| Ok(loops::feedback(&borrowed, monitor));
    Ok(
        watched(py, None, work)?
            .map(|f| (f.input, f.lead, f.correlation, f.significance, f.misfit)),
    )
}

#[pyfunction]
pub fn quantum(py: Python<'_>, column: Values<'_>) -> PyResult<Option<f64>> {
    let column = slice(&column, "column")?;
    Ok(py.detach(|| column::quantum(column)))
}

/// First sample and number of samples of stretches of each experiment.
type Stretches = Vec<Vec<(usize, usize)>>;

#[pyfunction]
pub fn dead(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Stretches> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| sensor::dead(&borrowed)))
}

#[pyfunction]
pub fn spikes(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Stretches> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| sensor::spikes(&borrowed)))
}

#[pyfunction]
pub fn two_levels(
    py: Python<'_>,
    experiments: Experiments<'_>,
) -> PyResult<Vec<Option<(f64, f64)>>> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| excitation::two_levels(&borrowed)))
}

/// Input, limit, number of stretches, share of the samples.
type Limit = (usize, f64, usize, f64);

#[pyfunction]
pub fn limits(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Vec<Limit>> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| excitation::limits(&borrowed)))
}

#[pyfunction]
pub fn rests(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Vec<(usize, usize)>> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| excitation::rests(&borrowed)))
}

#[pyfunction]
pub fn period(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<(f64, f64)>> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| excitation::period(&borrowed)))
}

#[pyfunction]
pub fn wraps(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<(f64, usize)>> {
    let borrowed = samples(py, &experiments)?;
    let found = py.detach(|| excitation::wraps(&borrowed));
    Ok(found.map(|w| (w.period, w.jumps)))
}

#[pyfunction]
pub fn unstable_pole(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<f64>> {
    let borrowed = samples(py, &experiments)?;
    Ok(py.detach(|| excitation::unstable_pole(&borrowed)))
}

/// Lag of the least cost, first and last plausible lag, first correlated lag, costs in free run and one step ahead, correlations, and
/// their bound. Lags count from the least delay.
type Delay<'py> = (
    usize,
    (usize, usize),
    Option<usize>,
    Vector<'py>,
    Vector<'py>,
    Vector<'py>,
    f64,
);

#[pyfunction]
#[pyo3(signature = (experiments, *, least, longest, confidence))]
pub fn delay<'py>(
    py: Python<'py>,
    experiments: Experiments<'py>,
    least: usize,
    longest: usize,
    confidence: f64,
) -> PyResult<Vec<Delay<'py>>> {
    let borrowed = samples(py, &experiments)?;
    let found = watched(py, None, |monitor| {
        dead_time::delay(&borrowed, least..longest + 1, confidence, monitor)
    })?;
    let handed_over = |d: dead_time::InputDelay| {
        let [cost, one_step, correlation] =
            [d.cost, d.one_step_cost, d.correlation].map(|v| array1(py, v));
        let (best, plausible, seen) = (d.best, d.plausible, d.correlated);
        (best, plausible, seen, cost, one_step, correlation, d.bound)
    };
    Ok(found.into_iter().map(handed_over).collect())
}

/// Orders, parameters, one-step error, squared free-run errors in parts, criteria, Lipschitz index.
type Structure<'py> = (
    (usize, usize, usize),
    usize,
    f64,
    Vector<'py>,
    [f64; 4],
    f64,
);

#[pyfunction]
#[pyo3(signature = (train, later, *, na, nb, nk, init, progress = None))]
pub fn order_table<'py>(
    py: Python<'py>,
    train: Experiments<'py>,
    later: Experiments<'py>,
    na: Vec<usize>,
    nb: Vec<usize>,
    nk: Vec<usize>,
    init: usize,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Vec<Structure<'py>>> {
    let (train, later) = (samples(py, &train)?, samples(py, &later)?);
    let grid = orders::Grid {
        na: &na,
        nb: &nb,
        nk: &nk,
    };
    let found = watched(py, progress.as_ref(), |monitor| {
        orders::table(&train, &later, grid, init, monitor)
    })?;
    let handed_over = |s: orders::Structure| {
        let blocks = array1(py, s.blocks);
        let (orders, count) = (s.orders, s.parameters);
        (orders, count, s.one_step, blocks, s.criteria, s.lipschitz)
    };
    Ok(found.into_iter().map(handed_over).collect())
}

/// Inputs, computed output, residual, which samples count, and sensitivities of one experiment.
type Experiment<'py> = (
    Rows<'py>,
    Values<'py>,
    Values<'py>,
    PyReadonlyArray1<'py, bool>,
    Rows<'py>,
);

/// Lags, series, correlations, limits, statistic, p-value, degrees of freedom, threshold, explained share.
type Tested<'py> = (
    Vec<usize>,
    Vec<Vec<usize>>,
    Matrix<'py>,
    Matrix<'py>,
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
#[pyo3(signature = (x, y, *, own, parts))]
pub fn explained(
    py: Python<'_>,
    x: Rows<'_>,
    y: Values<'_>,
    own: usize,
    parts: usize,
) -> PyResult<Vec<f64>> {
    let ((x, width), y) = (rows(&x, "x")?, slice(&y, "y")?);
    released(py, || {
        sewfast_core::explained::explained(x, width, y, own, parts)
    })
}

#[pyfunction]
#[pyo3(signature = (experiments, *, memory, one_step))]
pub fn residual_tests<'py>(
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
pub fn parameter_test<'py>(
    py: Python<'py>,
    experiments: Vec<Experiment<'py>>,
    trained: usize,
) -> PyResult<Tested<'py>> {
    let (runs, channels) = borrowed(&experiments)?;
    let test = py.detach(|| residuals::parameters(&runs, channels, trained));
    handed_over(py, test.raised(py)?)
}

#[pyfunction]
pub fn innovation(py: Python<'_>, series: Vec<Values<'_>>) -> PyResult<f64> {
    let known =
        |e: &Values<'_>| slice(e, "series").map(|e| e.iter().map(|v| v.is_finite()).collect());
    let known = series
        .iter()
        .map(known)
        .collect::<PyResult<Vec<Vec<bool>>>>()?;
    let whole = |e: &Values<'_>| {
        let values = slice(e, "series")?.iter();
        Ok(values
            .map(|v| if v.is_finite() { *v } else { 0.0 })
            .collect())
    };
    let series = series
        .iter()
        .map(whole)
        .collect::<PyResult<Vec<Vec<f64>>>>()?;
    Ok(py.detach(|| Noise::fit(&series, &known, 0.0, true).innovation.sqrt()))
}

#[pyfunction]
#[pyo3(signature = (experiments, *, spent))]
pub fn coloured_information<'py>(
    py: Python<'py>,
    experiments: Vec<Experiment<'py>>,
    spent: f64,
) -> PyResult<Matrix<'py>> {
    let (runs, channels) = borrowed(&experiments)?;
    let found = released(py, || {
        residuals::coloured_information(&runs, channels, spent)
    })?;
    let width = found.ncols();
    array2(py, found.as_slice().to_vec(), width)
}
