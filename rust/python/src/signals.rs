//! Bindings of the core's signals, and of its methods from counts to speed.

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use sewfast_core::signals::{self, Chirp, Jumps, Limits, Multisine, RandomSteps, Sweep, Trapezoid};
use sewfast_core::speed::{self, Kalman, Scale};
use sewfast_core::{Error, Result};

use crate::seam::{array1, raise, slice};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(step, module)?)?;
    module.add_function(wrap_pyfunction!(staircase, module)?)?;
    module.add_function(wrap_pyfunction!(trapezoid, module)?)?;
    module.add_function(wrap_pyfunction!(chirp, module)?)?;
    module.add_function(wrap_pyfunction!(random_steps, module)?)?;
    module.add_function(wrap_pyfunction!(prbs, module)?)?;
    module.add_function(wrap_pyfunction!(multisine, module)?)?;
    module.add_function(wrap_pyfunction!(jumps, module)?)?;
    module.add_function(wrap_pyfunction!(limit, module)?)?;
    module.add_function(wrap_pyfunction!(crest_factor, module)?)?;
    module.add_function(wrap_pyfunction!(speed_difference, module)?)?;
    module.add_function(wrap_pyfunction!(speed_savgol, module)?)?;
    module.add_function(wrap_pyfunction!(speed_kalman, module)?)?;
    module.add_function(wrap_pyfunction!(unwrap_counts, module)?)
}

type Signal<'py> = PyResult<Bound<'py, PyArray1<f64>>>;

fn released(py: Python<'_>, work: impl FnOnce() -> Result<Vec<f64>> + Send) -> Signal<'_> {
    let values = py.detach(work).map_err(|e| raise(py, e))?;
    Ok(array1(py, values))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, at, low, high))]
#[allow(non_snake_case)]
fn step(py: Python<'_>, duration: f64, Ts: f64, at: f64, low: f64, high: f64) -> Signal<'_> {
    released(py, || signals::step(duration, Ts, at, low, high))
}

#[pyfunction]
#[pyo3(signature = (*, Ts, levels, hold))]
#[allow(non_snake_case)]
fn staircase<'py>(
    py: Python<'py>,
    Ts: f64,
    levels: PyReadonlyArray1<'py, f64>,
    hold: f64,
) -> Signal<'py> {
    let levels = slice(&levels, "levels")?;
    released(py, || signals::staircase(Ts, levels, hold))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, start, rise, hold, fall, low, high))]
#[allow(non_snake_case, clippy::too_many_arguments)]
fn trapezoid(
    py: Python<'_>,
    duration: f64,
    Ts: f64,
    start: f64,
    rise: f64,
    hold: f64,
    fall: f64,
    low: f64,
    high: f64,
) -> Signal<'_> {
    let shape = Trapezoid {
        duration,
        start,
        rise,
        hold,
        fall,
        low,
        high,
    };
    released(py, || shape.generate(Ts))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, f_start, f_end, amplitude_start, amplitude_end, offset_start, offset_end,
    sweep = "linear", phase = -std::f64::consts::FRAC_PI_2))]
#[allow(non_snake_case, clippy::too_many_arguments)]
fn chirp<'py>(
    py: Python<'py>,
    duration: f64,
    Ts: f64,
    f_start: f64,
    f_end: f64,
    amplitude_start: f64,
    amplitude_end: f64,
    offset_start: f64,
    offset_end: f64,
    sweep: &str,
    phase: f64,
) -> Signal<'py> {
    let chirp = Chirp {
        duration,
        f_start,
        f_end,
        amplitude_start,
        amplitude_end,
        offset_start,
        offset_end,
        sweep: sweep_named(sweep).map_err(|e| raise(py, e))?,
        phase,
    };
    released(py, || chirp.generate(Ts))
}

fn sweep_named(name: &str) -> Result<Sweep> {
    match name {
        "linear" => Ok(Sweep::Linear),
        "logarithmic" => Ok(Sweep::Logarithmic),
        _ => Err(Error::setting(format!(
            "expected sweep linear or logarithmic, got {name:?}; choose one of them"
        ))),
    }
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, low, high, hold_min, hold_max, smoothing, seed, start = None))]
#[allow(non_snake_case, clippy::too_many_arguments)]
fn random_steps(
    py: Python<'_>,
    duration: f64,
    Ts: f64,
    low: f64,
    high: f64,
    hold_min: f64,
    hold_max: f64,
    smoothing: f64,
    seed: u64,
    start: Option<f64>,
) -> Signal<'_> {
    let steps = RandomSteps {
        duration,
        low,
        high,
        hold_min,
        hold_max,
        smoothing,
        start,
    };
    released(py, || steps.generate(Ts, seed))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, low, high, hold, seed))]
#[allow(non_snake_case)]
fn prbs(
    py: Python<'_>,
    duration: f64,
    Ts: f64,
    low: f64,
    high: f64,
    hold: f64,
    seed: u64,
) -> Signal<'_> {
    released(py, || signals::prbs(duration, Ts, low, high, hold, seed))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, f_low, f_high, amplitude, offset, seed))]
#[allow(non_snake_case, clippy::too_many_arguments)]
fn multisine(
    py: Python<'_>,
    duration: f64,
    Ts: f64,
    f_low: f64,
    f_high: f64,
    amplitude: f64,
    offset: f64,
    seed: u64,
) -> Signal<'_> {
    let multisine = Multisine {
        duration,
        f_low,
        f_high,
        amplitude,
        offset,
    };
    released(py, || multisine.generate(Ts, seed))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, speed_low, speed_high, change_min, level_min, level_max, hold_min, hold_max,
    ramp, gain, acceleration, seed))]
#[allow(non_snake_case, clippy::too_many_arguments)]
fn jumps(
    py: Python<'_>,
    duration: f64,
    Ts: f64,
    speed_low: f64,
    speed_high: f64,
    change_min: f64,
    level_min: f64,
    level_max: f64,
    hold_min: f64,
    hold_max: f64,
    ramp: f64,
    gain: f64,
    acceleration: f64,
    seed: u64,
) -> Signal<'_> {
    let jumps = Jumps {
        duration,
        speed_low,
        speed_high,
        change_min,
        level_min,
        level_max,
        hold_min,
        hold_max,
        ramp,
        gain,
        acceleration,
    };
    released(py, || jumps.generate(Ts, seed))
}

#[pyfunction]
#[pyo3(signature = (signal, *, Ts, low, high, rate, slew))]
#[allow(non_snake_case)]
fn limit<'py>(
    py: Python<'py>,
    signal: PyReadonlyArray1<'py, f64>,
    Ts: f64,
    low: f64,
    high: f64,
    rate: f64,
    slew: f64,
) -> Signal<'py> {
    let limits = Limits {
        low,
        high,
        rate,
        slew,
    };
    let signal = slice(&signal, "signal")?;
    released(py, || limits.apply(signal, Ts))
}

#[pyfunction]
fn crest_factor(py: Python<'_>, signal: PyReadonlyArray1<'_, f64>) -> PyResult<f64> {
    signals::crest_factor(slice(&signal, "signal")?).map_err(|e| raise(py, e))
}

type Counts<'py> = PyReadonlyArray1<'py, f64>;

fn of_counts<'py>(
    py: Python<'py>,
    counts: &Counts<'py>,
    work: impl FnOnce(&[f64]) -> Result<Vec<f64>> + Send,
) -> Signal<'py> {
    let counts = slice(counts, "counts")?;
    let values = py.detach(|| work(counts)).map_err(|e| raise(py, e))?;
    Ok(array1(py, values))
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit))]
#[allow(non_snake_case)]
fn speed_difference<'py>(
    py: Python<'py>,
    counts: Counts<'py>,
    Ts: f64,
    counts_per_unit: f64,
) -> Signal<'py> {
    of_counts(py, &counts, |counts| {
        speed::difference(counts, Scale::new(Ts, counts_per_unit)?)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit, window, order))]
#[allow(non_snake_case)]
fn speed_savgol<'py>(
    py: Python<'py>,
    counts: Counts<'py>,
    Ts: f64,
    counts_per_unit: f64,
    window: usize,
    order: usize,
) -> Signal<'py> {
    of_counts(py, &counts, |counts| {
        speed::savgol(counts, Scale::new(Ts, counts_per_unit)?, window, order)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit, process_noise = None, ripple_orders = Vec::new(),
    counts_per_rev = 1.0))]
#[allow(non_snake_case)]
fn speed_kalman<'py>(
    py: Python<'py>,
    counts: Counts<'py>,
    Ts: f64,
    counts_per_unit: f64,
    process_noise: Option<f64>,
    ripple_orders: Vec<u32>,
    counts_per_rev: f64,
) -> Signal<'py> {
    let kalman = Kalman {
        process_noise,
        ripple_orders: &ripple_orders,
        counts_per_rev,
    };
    of_counts(py, &counts, |counts| {
        kalman.smooth(counts, Scale::new(Ts, counts_per_unit)?)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, bits))]
fn unwrap_counts<'py>(py: Python<'py>, counts: Counts<'py>, bits: u32) -> Signal<'py> {
    of_counts(py, &counts, |counts| speed::unwrap(counts, bits))
}
