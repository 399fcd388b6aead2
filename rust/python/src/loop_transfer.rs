//! Bindings of the sampled linear loop: its frequency response and its margins.

use numpy::{Complex64, PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::Standard;
use sewfast_core::Result;
use sewfast_core::loop_transfer::{self, Change, Changing, Loop, Path, Plant};

use crate::control::controller::{Section, cascade};
use crate::seam::{Raised, Values, Vector, array1, raise, released, slice};

/// The part of a controller that is in the loop: its feedback path. Gains in standard form.
#[pyclass(module = "sewfast._core", frozen)]
pub struct LoopPath(pub Path);

#[pymethods]
impl LoopPath {
    #[new]
    #[pyo3(signature = (*, Kp, Ti, Td, N, Ts, filter_samples, filter_time, observer_time, encoder, slope=0.0, biquads=Vec::new(), position=0.0))]
    fn new(
        py: Python<'_>,
        Kp: f64,
        Ti: f64,
        Td: f64,
        N: f64,
        Ts: f64,
        filter_samples: usize,
        filter_time: f64,
        observer_time: f64,
        encoder: bool,
        slope: f64,
        biquads: Vec<Section>,
        position: f64,
    ) -> PyResult<Self> {
        let gains = Standard {
            kp: Kp,
            ti: Ti,
            td: Td,
        };
        let biquads = cascade(&biquads).map_err(|e| raise(py, e.into()))?;
        Ok(Self(Path {
            gains,
            slope,
            n: N,
            filter_samples,
            filter_time,
            observer_time,
            biquads,
            encoder,
            position,
            ts: Ts,
        }))
    }
}

/// Numerator and denominator of a plant in powers of z^-1, as NumPy has them.
type Fraction<'py> = (Vector<'py>, Vector<'py>);

#[pyfunction]
#[pyo3(signature = (K, T, L, *, Ts))]
pub fn sampled_fopdt(py: Python<'_>, K: f64, T: f64, L: f64, Ts: f64) -> PyResult<Fraction<'_>> {
    let plant = Plant::fopdt(K, T, L, Ts).raised(py)?;
    Ok((
        array1(py, plant.num().to_vec()),
        array1(py, plant.den().to_vec()),
    ))
}

/// Frequencies \[rad/s\], responses and radii of a measured plant; whether its output was counted.
pub type Lines<'py> = (
    Values<'py>,
    PyReadonlyArray1<'py, Complex64>,
    Values<'py>,
    bool,
);

/// The measured plant at the sample time of its loop.
pub fn measured(
    (omega, response, radius, counted): &Lines<'_>,
    ts: f64,
) -> PyResult<loop_transfer::Measured> {
    let py = omega.py();
    let (omega, radius) = (slice(omega, "omega")?, slice(radius, "radius")?);
    let response = response.as_slice()?;
    loop_transfer::Measured::new(omega, response, radius, *counted, ts).raised(py)
}

#[pyfunction]
pub fn loop_response<'py>(
    py: Python<'py>,
    path: &LoopPath,
    num: Values<'py>,
    den: Values<'py>,
    omega: Values<'py>,
) -> PyResult<Bound<'py, PyArray1<Complex64>>> {
    let (num, den, omega) = (
        slice(&num, "num")?,
        slice(&den, "den")?,
        slice(&omega, "omega")?,
    );
    let response = || -> Result<Vec<Complex64>> {
        let plant = Plant::new(num, den)?;
        let closed = Loop::new(&path.0, &plant)?;
        Ok(omega.iter().map(|&w| closed.response(w)).collect())
    };
    let response = response().raised(py)?;
    Ok(PyArray1::from_vec(py, response))
}

#[pyfunction]
pub fn margins<'py>(
    py: Python<'py>,
    path: &LoopPath,
    num: Values<'py>,
    den: Values<'py>,
) -> PyResult<Bound<'py, PyDict>> {
    let (num, den) = (slice(&num, "num")?, slice(&den, "den")?);
    // this takes half a millisecond: on a busy computer starting a thread takes longer
    let found = released(py, || {
        let plant = Plant::new(num, den)?;
        let closed = Loop::new(&path.0, &plant)?;
        Ok(loop_transfer::margins(&closed))
    })?;
    let dict = PyDict::new(py);
    dict.set_item("stable", found.stable)?;
    let numbers = [
        ("largest_pole", found.largest_pole),
        ("Ms", found.ms.0),
        ("Ms_omega", found.ms.1),
        ("Mt", found.mt.0),
        ("Mt_omega", found.mt.1),
        ("gain_margin", found.gain_margin),
        ("gain_reduction", found.gain_reduction),
        ("phase_margin_deg", found.phase_margin),
        ("delay_margin_s", found.delay_margin),
        ("noise_gain", found.noise_gain),
        ("bandwidth", found.bandwidth),
    ];
    for (name, value) in numbers {
        dict.set_item(name, value)?;
    }
    dict.set_item("gain_crossovers", found.gain_crossovers)?;
    dict.set_item("phase_crossovers", found.phase_crossovers)?;
    Ok(dict)
}

/// Largest sensitivity of the position loop of a path, broken at its error.
#[pyfunction]
#[pyo3(signature = (path, num, den))]
pub fn position_sensitivity(
    py: Python<'_>,
    path: &LoopPath,
    num: Values<'_>,
    den: Values<'_>,
) -> PyResult<f64> {
    let (num, den) = (slice(&num, "num")?, slice(&den, "den")?);
    let found = py.detach(|| {
        let plant = Plant::new(num, den)?;
        let closed = Loop::new(&path.0, &plant)?;
        Ok(loop_transfer::position_sensitivity(&closed))
    });
    found.map_err(|e| raise(py, e))
}

/// Largest sensitivity after a change, factor on the gain, additional delay, factor on the resonances.
type Changed = (f64, f64, usize, f64);

#[pyfunction]
pub fn tolerance(
    py: Python<'_>,
    path: &LoopPath,
    num: Values<'_>,
    den: Values<'_>,
) -> PyResult<(f64, Option<Changed>)> {
    let (num, den) = (slice(&num, "num")?, slice(&den, "den")?);
    let (robust, worst) = released(py, || {
        Ok(Changing::new(Plant::new(num, den)?).sensitivity(&path.0))
    })?;
    let changed = |(most, Change { gain, delay, pitch })| (most, gain, delay, pitch);
    Ok((robust, worst.map(changed)))
}
