//! Bindings of the core's control: plants from Python, the closed loop, the first-order-plus-dead-time fit and the
//! tuning rules; controller and tuning have their own files.

pub mod controller;
pub mod moves;
pub mod position;
pub mod tuning;

use std::sync::Arc;

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::{Parallel, PerSample, Refused, Standard};
use sewfast_core::closed_loop::{self as looped, KernelPlant, Outcome, Plant, Run, Signals};
use sewfast_core::fopdt::fit_fopdt as fit;
use sewfast_core::machine::{self, SAMPLE_TIME};
use sewfast_core::metrics::{self, Effort};
use sewfast_core::model::{self, ClonePlant};
use sewfast_core::rules::{self, Costs, Outside, Rule};
use sewfast_core::speed::Encoder;
use sewfast_core::{Error, Record, Result};

use crate::device::Machine;
use crate::seam::{Raised, Values, array1, slice, watched, watched_over};

pub use controller::{AnyGiven, Controller};

type Triple = (f64, f64, f64);

#[pyfunction]
#[pyo3(signature = (gains, *, form, to, Ts))]
pub fn convert_gains(
    py: Python<'_>,
    gains: Triple,
    form: &str,
    to: &str,
    Ts: f64,
) -> PyResult<Triple> {
    converted(gains, form, to, Ts).raised(py)
}

fn converted((p, i, d): Triple, form: &str, to: &str, ts: f64) -> Result<Triple> {
    let per_sample = form == "per_sample" || to == "per_sample";
    if per_sample && !(ts > 0.0 && ts.is_finite()) {
        return Err(Error::setting(format!(
            "expected the sample time Ts [s] at which the per-sample gains hold, got {ts}; give Ts above 0"
        )));
    }
    let standard: std::result::Result<Standard<f64>, Refused> = match form {
        "standard" => Standard {
            kp: p,
            ti: i,
            td: d,
        }
        .checked(),
        "parallel" => Parallel {
            kp: p,
            ki: i,
            kd: d,
        }
        .to_standard(),
        "per_sample" => PerSample {
            kp: p,
            ki: i,
            kd: d,
            ts,
        }
        .to_standard(),
        _ => return Err(unknown_form(form)),
    };
    let standard = standard?;
    match to {
        _ if to == form => Ok((p, i, d)),
        "standard" => Ok((standard.kp, standard.ti, standard.td)),
        "parallel" => {
            let g = standard.to_parallel();
            Ok((g.kp, g.ki, g.kd))
        }
        "per_sample" => {
            let g = standard.to_per_sample(ts);
            Ok((g.kp, g.ki, g.kd))
        }
        _ => Err(unknown_form(to)),
    }
}

fn unknown_form(form: &str) -> Error {
    Error::setting(format!(
        "expected a form of gains, standard, parallel or per_sample, got '{form}'"
    ))
}

#[pyfunction]
#[pyo3(signature = (plant, controller, reference, *, counts_per_unit, encoder_phase=0.5, feedforward=None, disturbance=None, noise=0.0, seed=0))]
pub fn closed_loop<'py>(
    py: Python<'py>,
    plant: &Bound<'py, PyAny>,
    controller: AnyGiven<'py>,
    reference: Values<'py>,
    counts_per_unit: f64,
    encoder_phase: f64,
    feedforward: Option<Values<'py>>,
    disturbance: Option<Values<'py>>,
    noise: f64,
    seed: u64,
) -> PyResult<Bound<'py, PyDict>> {
    let (model, design) = (Model::of(plant)?, controller.design());
    let beside = |values: &'_ Option<Values<'py>>, name| -> PyResult<Option<Vec<f64>>> {
        let values = values.as_ref().map(|values| slice(values, name));
        Ok(values.transpose()?.map(<[f64]>::to_vec))
    };
    let feedforward = beside(&feedforward, "feedforward")?;
    let disturbance = beside(&disturbance, "disturbance")?;
    let reference = slice(&reference, "reference")?;
    let noise = (noise != 0.0).then(|| looped::white_noise(noise, reference.len(), seed));
    let signals = Signals {
        reference,
        setpoint: None,
        feedforward: feedforward.as_deref(),
        disturbance: disturbance.as_deref(),
        noise: noise.as_deref(),
    };
    let run = watched_over(py, signals.reference.len(), |monitor| {
        let encoder = looped::encoder(counts_per_unit, encoder_phase)?;
        let mut controller = design.controller()?;
        let ts = design.ts();
        let mut plant = model.plant(ts)?;
        let encoder = encoder.as_ref();
        looped::closed_loop_with(&mut plant, &mut controller, signals, encoder, monitor)
            .and_then(|run| completed(run, ts))
    })?;
    Ok(dict! { py;
        "u" => array1(py, run.u), "y" => array1(py, run.y), "feedback" => array1(py, run.feedback),
    })
}

fn completed(run: Run, ts: f64) -> Result<Run> {
    match run.outcome {
        Outcome::Completed => Ok(run),
        Outcome::Interrupted(_) => Err(Error::fit("the run was interrupted")),
        Outcome::Diverged(k) => Err(Error::fit(format!(
            "expected a loop that stays finite, got one that diverged at {:.4} s; use smaller gains or output limits, \
             or check the model on new data",
            k as f64 * ts
        ))),
    }
}

#[pyfunction]
#[pyo3(signature = (y, reference, *, Ts, smoothing))]
pub fn step_metrics<'py>(
    py: Python<'py>,
    y: Values<'py>,
    reference: Values<'py>,
    Ts: f64,
    smoothing: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let found = metrics::step_metrics(
        slice(&y, "y")?,
        slice(&reference, "reference")?,
        Ts,
        smoothing,
    )
    .raised(py)?;
    named(
        py,
        [
            ("rise_time_ms", 1e3 * found.rise_time),
            ("reference_rise_time_ms", 1e3 * found.reference_rise_time),
            ("overshoot_percent", found.overshoot_percent),
        ],
    )
}

#[pyfunction]
#[pyo3(signature = (u, *, u_min, u_max))]
pub fn effort<'py>(
    py: Python<'py>,
    u: Values<'py>,
    u_min: f64,
    u_max: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let found = Effort::of(slice(&u, "u")?, u_min, u_max);
    named(
        py,
        [
            ("u_rms", found.u_rms),
            ("du_rms", found.du_rms),
            ("saturated", found.saturated),
        ],
    )
}

/// A dict of numbers by name.
fn named<'py, const N: usize>(
    py: Python<'py>,
    values: [(&str, f64); N],
) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (name, value) in values {
        dict.set_item(name, value)?;
    }
    Ok(dict)
}

/// The core's value of a Python object, which can be used on other threads.
enum Model {
    Identified(Arc<dyn model::Model>),
    Machine(Box<machine::Machine>),
}

impl Model {
    fn of(object: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(model) = object.cast::<crate::models::Model>() {
            return Ok(Self::Identified(model.get().inner.clone()));
        }
        if let Ok(machine) = object.cast::<Machine>() {
            return Ok(Self::Machine(Box::new(machine.try_borrow()?.core.clone())));
        }
        Err(PyTypeError::new_err(format!(
            "expected a compiled model or a Machine, got {}",
            object.get_type().name()?
        )))
    }

    /// This model as a plant at sample time `ts`.
    fn plant(&self, ts: f64) -> Result<AnyPlant<'_>> {
        match self {
            Self::Identified(model) => Ok(AnyPlant(model.plant(ts)?)),
            Self::Machine(_) if (ts / SAMPLE_TIME - 1.0).abs() > 1e-9 => {
                Err(Error::setting(format!(
                    "expected a controller with the machine's sample time of {SAMPLE_TIME} s, got {ts} s; convert its gains"
                )))
            }
            Self::Machine(machine) => Ok(AnyPlant(machine.copied())),
        }
    }
}

/// One of the plants.
struct AnyPlant<'a>(Box<dyn ClonePlant + 'a>);

impl Clone for AnyPlant<'_> {
    fn clone(&self) -> Self {
        Self(self.0.copied())
    }
}

impl Plant for AnyPlant<'_> {
    fn reset(&mut self) {
        self.0.reset();
    }

    fn output(&self) -> f64 {
        self.0.output()
    }

    fn position(&self) -> f64 {
        self.0.position()
    }

    fn advance(&mut self, u: f64) {
        self.0.advance(u);
    }

    fn encoder(&self) -> Option<&Encoder> {
        self.0.encoder()
    }

    fn known(&self) -> Option<KernelPlant<'_>> {
        self.0.known()
    }
}

#[pyfunction]
#[pyo3(signature = (u, y, *, Ts))]
pub fn fit_fopdt<'py>(
    py: Python<'py>,
    u: Values<'py>,
    y: Values<'py>,
    Ts: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let record = Record::new(slice(&u, "u")?, 1, slice(&y, "y")?).raised(py)?;
    let found = watched(py, None, |monitor| fit(record, Ts, monitor))?;
    let dict = named(
        py,
        [
            ("K", found.k),
            ("T", found.t),
            ("L", found.l),
            ("offset", found.offset),
            ("u_low", found.u_low),
            ("u_high", found.u_high),
            ("fit_percent", found.fit_percent),
            ("K_se", found.errors[0]),
            ("T_se", found.errors[1]),
            ("L_se", found.errors[2]),
            ("overshoot_percent", 100.0 * found.overshoot),
        ],
    )?;
    dict.set_item("limited", found.limited)?;
    dict.set_item("moving", found.moving)?;
    Ok(dict)
}

#[pyfunction]
#[pyo3(signature = (K, T, L, *, nearest=false))]
pub fn table_1(
    py: Python<'_>,
    K: f64,
    T: f64,
    L: f64,
    nearest: bool,
) -> PyResult<Bound<'_, PyDict>> {
    let outside = if nearest {
        Outside::Nearest
    } else {
        Outside::Error
    };
    answered(py, rules::table_1(K, T, L, outside))
}

#[pyfunction]
#[pyo3(signature = (K, T, L, *, Ms))]
pub fn eq_12(py: Python<'_>, K: f64, T: f64, L: f64, Ms: f64) -> PyResult<Bound<'_, PyDict>> {
    let (rule, costs) = watched(py, None, |_| rules::eq_12(K, T, L, Ms))?;
    let dict = answered(py, Ok(rule))?;
    for (name, value) in by_name(costs) {
        dict.set_item(name, value)?;
    }
    Ok(dict)
}

#[pyfunction]
#[pyo3(signature = (ratio, *, KpK, Ti, Td, alpha, beta))]
pub fn eq_12_costs(
    py: Python<'_>,
    ratio: f64,
    KpK: f64,
    Ti: f64,
    Td: f64,
    alpha: f64,
    beta: f64,
) -> PyResult<Bound<'_, PyDict>> {
    let gains = Standard {
        kp: KpK,
        ti: Ti,
        td: Td,
    };
    let costs = watched(py, None, |_| rules::costs(ratio, gains, alpha, beta))?;
    named(py, by_name(costs))
}

#[pyfunction]
#[pyo3(signature = (K, T, L, *, tau_c, derivative))]
pub fn simc(
    py: Python<'_>,
    K: f64,
    T: f64,
    L: f64,
    tau_c: f64,
    derivative: bool,
) -> PyResult<Bound<'_, PyDict>> {
    answered(py, rules::simc(K, T, L, tau_c, derivative))
}

#[pyfunction]
pub fn amigo(py: Python<'_>, K: f64, T: f64, L: f64) -> PyResult<Bound<'_, PyDict>> {
    answered(py, rules::amigo(K, T, L))
}

fn by_name(costs: Costs) -> [(&'static str, f64); 3] {
    [
        ("disturbance_cost", costs.disturbance),
        ("reference_cost", costs.reference),
        ("Ms", costs.ms),
    ]
}

fn answered(py: Python<'_>, rule: Result<Rule>) -> PyResult<Bound<'_, PyDict>> {
    let rule = rule.raised(py)?;
    named(
        py,
        [
            ("Kp", rule.gains.kp),
            ("Ti", rule.gains.ti),
            ("Td", rule.gains.td),
            ("alpha", rule.alpha),
            ("beta", rule.beta),
        ],
    )
}
