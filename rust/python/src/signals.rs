//! Bindings of the core's signals, and of its methods from counts to speed.

use crate::seam::{Raised, Values, Vector, array1, released, slice};
use pyo3::prelude::*;
use sewfast_core::signals::{self, Chirp, Jumps, Limits, Multisine, RandomSteps, Sweep, Trapezoid};
use sewfast_core::speed::{self, Kalman, Scale};
use sewfast_core::{Error, Result};

type Signal<'py> = PyResult<Vector<'py>>;

fn made(py: Python<'_>, work: impl FnOnce() -> Result<Vec<f64>> + Send) -> Signal<'_> {
    let values = released(py, work)?;
    Ok(array1(py, values))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, at, low, high))]
pub fn step(py: Python<'_>, duration: f64, Ts: f64, at: f64, low: f64, high: f64) -> Signal<'_> {
    made(py, || signals::step(duration, Ts, at, low, high))
}

#[pyfunction]
#[pyo3(signature = (*, Ts, levels, hold))]
pub fn staircase<'py>(py: Python<'py>, Ts: f64, levels: Values<'py>, hold: f64) -> Signal<'py> {
    let levels = slice(&levels, "levels")?;
    made(py, || signals::staircase(Ts, levels, hold))
}

/// A signal with the fields of a settings struct as keywords, and its arguments of `generate`.
macro_rules! signal {
    ($name:ident, $of:ident { $($field:ident: $kind:ty),* }, $($given:ident: $type:ty),*) => {
        #[pyfunction]
        #[pyo3(signature = (*, $($given),*, $($field),*))]
        pub fn $name(py: Python<'_>, $($given: $type,)* $($field: $kind),*) -> Signal<'_> {
            made(py, || $of { $($field),* }.generate($($given),*))
        }
    };
}

signal!(trapezoid, Trapezoid {
    duration: f64, start: f64, rise: f64, hold: f64, fall: f64, low: f64, high: f64
}, Ts: f64);
signal!(multisine, Multisine {
    duration: f64, f_low: f64, f_high: f64, amplitude: f64, offset: f64
}, Ts: f64, seed: u64);
signal!(jumps, Jumps {
    duration: f64, speed_low: f64, speed_high: f64, change_min: f64, level_min: f64, level_max: f64,
    hold_min: f64, hold_max: f64, ramp: f64, gain: f64, acceleration: f64
}, Ts: f64, seed: u64);

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, f_start, f_end, amplitude_start, amplitude_end, offset_start, offset_end,
    sweep = "linear", phase = -std::f64::consts::FRAC_PI_2))]
pub fn chirp<'py>(
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
        sweep: sweep_named(sweep).raised(py)?,
        phase,
    };
    made(py, || chirp.generate(Ts))
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
pub fn random_steps(
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
    made(py, || steps.generate(Ts, seed))
}

#[pyfunction]
#[pyo3(signature = (*, duration, Ts, low, high, hold, seed))]
pub fn prbs(
    py: Python<'_>,
    duration: f64,
    Ts: f64,
    low: f64,
    high: f64,
    hold: f64,
    seed: u64,
) -> Signal<'_> {
    made(py, || signals::prbs(duration, Ts, low, high, hold, seed))
}

#[pyfunction]
#[pyo3(signature = (signal, *, Ts, low, high, rate, slew))]
pub fn limit<'py>(
    py: Python<'py>,
    signal: Values<'py>,
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
    made(py, || limits.apply(signal, Ts))
}

#[pyfunction]
pub fn crest_factor(py: Python<'_>, signal: Values<'_>) -> PyResult<f64> {
    signals::crest_factor(slice(&signal, "signal")?).raised(py)
}

fn of_counts<'py>(
    py: Python<'py>,
    counts: &Values<'py>,
    work: impl FnOnce(&[f64]) -> Result<Vec<f64>> + Send,
) -> Signal<'py> {
    let counts = slice(counts, "counts")?;
    let values = released(py, || work(counts))?;
    Ok(array1(py, values))
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit))]
pub fn speed_difference<'py>(
    py: Python<'py>,
    counts: Values<'py>,
    Ts: f64,
    counts_per_unit: f64,
) -> Signal<'py> {
    of_counts(py, &counts, |counts| {
        speed::difference(counts, Scale::new(Ts, counts_per_unit)?)
    })
}

#[pyfunction]
#[pyo3(signature = (counts, *, Ts, counts_per_unit, window, order))]
pub fn speed_savgol<'py>(
    py: Python<'py>,
    counts: Values<'py>,
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
pub fn speed_kalman<'py>(
    py: Python<'py>,
    counts: Values<'py>,
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
pub fn unwrap_counts<'py>(py: Python<'py>, counts: Values<'py>, bits: u32) -> Signal<'py> {
    of_counts(py, &counts, |counts| speed::unwrap(counts, bits))
}
