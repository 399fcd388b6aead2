//! Bindings of the controller, one sample at a time, in double precision and in the single precision of most microcontrollers.

use crate::seam::{Raised, Rows, Values, raise, slice};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::{
    AnyDesign, Biquad, Cascade, Design, Feedforward, Level, PidController as Core, Point, Refused,
    Row, STATES, Schedule, Settings, Standard, StateDesign, StateFeedback as States, Weights, lqg,
};
use sewfast_core::inverse::{self, Local};
use sewfast_core::{Error, Result as CoreResult};

/// The controller's arithmetic (paper Fig. 16). Gains in standard form.
#[pyclass(module = "sewfast._core")]
pub struct Controller {
    pub core: Core<f64>,
}

/// The same arithmetic in single precision, as a microcontroller has it: settings are rounded first.
#[pyclass(module = "sewfast._core")]
pub struct SingleController {
    core: Core<f32>,
}

/// A controller of any kind, as passed by Python.
#[derive(FromPyObject)]
pub enum AnyGiven<'py> {
    Pid(Bound<'py, Controller>),
    StateFeedback(Bound<'py, StateFeedback>),
}

impl AnyGiven<'_> {
    /// Its design.
    pub fn design(&self) -> AnyDesign<f64> {
        match self {
            Self::Pid(controller) => (*controller.borrow().core.design()).into(),
            Self::StateFeedback(controller) => (*controller.borrow().core.design()).into(),
        }
    }
}

/// Speed, then Kp, Ti, Td in standard form.
type Given = (f64, f64, f64, f64);

/// `c0`, `c1`, `a1`, `a2` of a biquad.
pub type Section = (f64, f64, f64, f64);

pub fn cascade(sections: &[Section]) -> Result<Cascade<f64>, Refused> {
    let section = |&(c0, c1, a1, a2): &Section| Biquad { c0, c1, a1, a2 };
    Cascade::new(&sections.iter().map(section).collect::<Vec<_>>())
}

/// The coefficients of a biquad of `kind` with its numbers, at sample time `Ts` \[s\].
#[pyfunction]
#[pyo3(signature = (kind, numbers, *, Ts))]
pub fn biquad(py: Python<'_>, kind: &str, numbers: Vec<f64>, Ts: f64) -> PyResult<Section> {
    let made = match (kind, &numbers[..]) {
        ("notch", &[frequency, depth, width]) => Biquad::notch(frequency, depth, width, Ts),
        ("low_pass", &[frequency, damping]) => Biquad::low_pass(frequency, damping, Ts),
        ("lead_lag", &[zero, pole]) => Biquad::lead_lag(zero, pole, Ts),
        ("resonance", &[zero, zero_damping, pole, pole_damping]) => {
            Biquad::resonance(zero, zero_damping, pole, pole_damping, Ts)
        }
        _ => Err(Refused {
            name: "biquads",
            expected: "notch, low_pass, lead_lag or resonance with 3, 2, 2 or 4 numbers",
            received: numbers.len() as f64,
        }),
    };
    let Biquad::<f64> { c0, c1, a1, a2 } = made.map_err(|e| raise(py, Error::from(e)))?;
    Ok((c0, c1, a1, a2))
}

/// Preview [samples], lateness of the measurement [samples], levels of output and command, taps.
type Ahead = (usize, f64, Vec<(f64, f64)>, Vec<f64>);

fn feedforward(given: &Option<Ahead>) -> Result<Feedforward<f64>, Refused> {
    let Some((preview, late, levels, taps)) = given else {
        return Ok(Feedforward::NONE);
    };
    let level = |&(y, u): &(f64, f64)| Level { y, u };
    let levels: Vec<_> = levels.iter().map(level).collect();
    Feedforward::new(*preview, *late, &levels, taps)
}

/// A, B, C, D of one input, its delay [samples], and the slope of the levels.
type Point1<'py> = (Rows<'py>, Values<'py>, Values<'py>, f64, usize, f64);

/// The taps of a feedforward on plants linearised about levels, for each pair of preview and smoothing.
#[pyfunction]
#[pyo3(signature = (points, choices, *, count))]
pub fn inverse_taps(
    py: Python<'_>,
    points: Vec<Point1<'_>>,
    choices: Vec<(usize, f64)>,
    count: usize,
) -> PyResult<Vec<Vec<f64>>> {
    let local = |(a, b, c, d, delay, slope): &Point1<'_>| -> PyResult<Local> {
        let a = a.as_array().iter().copied().collect::<Vec<_>>();
        Ok(Local::new(
            &a,
            slice(b, "B")?,
            slice(c, "C")?,
            *d,
            *delay,
            *slope,
        ))
    };
    let plants = points.iter().map(local).collect::<PyResult<Vec<_>>>()?;
    let each = choices.iter();
    each.map(|&(preview, smoothing)| inverse::taps(&plants, preview, count, smoothing))
        .collect::<CoreResult<_>>()
        .raised(py)
}

fn schedule(rows: &[Given]) -> Result<Schedule<f64>, Refused> {
    let point = |&(speed, kp, ti, td): &Given| Point {
        speed,
        gains: Standard { kp, ti, td },
    };
    Schedule::new(&rows.iter().map(point).collect::<Vec<_>>())
}

/// A design rounded to single precision.
pub(super) fn single(design: &Design<f64>) -> Result<Design<f32>, Refused> {
    let gains = |g: Standard<f64>| Standard {
        kp: g.kp as f32,
        ti: g.ti as f32,
        td: g.td as f32,
    };
    let point = |p: &Point<f64>| Point {
        speed: p.speed as f32,
        gains: gains(p.gains),
    };
    let points: Vec<_> = design.schedule.points().iter().map(point).collect();
    let section = |s: &Biquad<f64>| Biquad {
        c0: s.c0 as f32,
        c1: s.c1 as f32,
        a1: s.a1 as f32,
        a2: s.a2 as f32,
    };
    let sections: Vec<_> = design.biquads.sections().iter().map(section).collect();
    let s = &design.pid;
    Ok(Design {
        pid: Settings {
            gains: gains(s.gains),
            alpha: s.alpha as f32,
            beta: s.beta as f32,
            n: s.n as f32,
            tt: s.tt as f32,
            u_min: s.u_min as f32,
            u_max: s.u_max as f32,
            slew: s.slew as f32,
            ts: s.ts as f32,
        },
        filter_samples: design.filter_samples,
        filter_time: design.filter_time as f32,
        observer_time: design.observer_time as f32,
        r_rate: design.r_rate as f32,
        schedule: Schedule::new(&points)?,
        biquads: Cascade::new(&sections)?,
        feedforward: single_feedforward(&design.feedforward)?,
    })
}

fn single_feedforward(given: &Feedforward<f64>) -> Result<Feedforward<f32>, Refused> {
    if given.is_none() {
        return Ok(Feedforward::NONE);
    }
    let level = |level: &Level<f64>| Level {
        y: level.y as f32,
        u: level.u as f32,
    };
    let levels: Vec<_> = given.levels().iter().map(level).collect();
    let taps: Vec<_> = given.taps().iter().map(|tap| *tap as f32).collect();
    Feedforward::new(given.preview(), given.late() as f32, &levels, &taps)
}

/// The methods common to both precisions; each class adds its own.
macro_rules! controller_methods {
    ($class:ident, $float:ty { $($own:tt)* }) => {
        #[pymethods]
        impl $class {
            $($own)*

            #[pyo3(signature = (r, y, feedforward=0.0))]
            fn step(&mut self, r: $float, y: $float, feedforward: $float) -> $float {
                self.core.step_with(r, y, feedforward)
            }

            fn set_design(&mut self, py: Python<'_>, other: &Bound<'_, Self>) -> PyResult<()> {
                // the argument may be this controller itself, which cannot be borrowed a second time
                let design = match other.try_borrow() {
                    Ok(other) => *other.core.design(),
                    Err(_) => *self.core.design(),
                };
                let done = self.core.set_design(design);
                done.raised(py)
            }

            fn set_manual(&mut self, py: Python<'_>, u: $float) -> PyResult<()> {
                let done = self.core.set_manual(u);
                done.raised(py)
            }

            fn set_automatic(&mut self) {
                self.core.set_automatic();
            }

            #[getter]
            fn manual(&self) -> bool {
                self.core.is_manual()
            }

            fn reset(&mut self) {
                self.core.reset();
            }

            #[getter]
            fn filtered(&self) -> $float {
                self.core.filtered()
            }

            /// What the step computes with, worked out from the settings in this precision.
            #[getter]
            fn numbers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
                let (design, found) = (*self.core.design(), PyDict::new(py));
                let constant = Design { schedule: Schedule::NONE, ..design };
                let constant = Core::new(constant).map_err(|e| raise(py, Error::from(e)))?;
                let Some(numbers) = constant.numbers() else {
                    return Ok(found);
                };
                let (keep, gain) = numbers.observer.unwrap_or_default();
                for (name, value) in [
                    ("kp", numbers.terms.kp),
                    ("ki", numbers.terms.ki),
                    ("kd", numbers.terms.kd),
                    ("pole", numbers.terms.pole),
                    ("tracking", numbers.tracking),
                    ("lag", numbers.lag),
                    ("keep", keep),
                    ("gain", gain),
                    ("ramp", numbers.ramp),
                    ("change", design.pid.slew * design.pid.ts),
                    ("alpha", design.pid.alpha),
                    ("beta", design.pid.beta),
                    ("u_min", design.pid.u_min),
                    ("u_max", design.pid.u_max),
                    ("n", design.pid.n),
                    ("ts", design.pid.ts),
                ] {
                    found.set_item(name, f64::from(value))?;
                }
                found.set_item("tracks", design.pid.tt != 0.0)?;
                found.set_item("observes", numbers.observer.is_some())?;
                found.set_item("samples", numbers.samples)?;
                let row = |r: &Row<$float>| {
                    [r.speed, r.kp, r.ki, r.td, r.inverse].map(f64::from)
                };
                let rows: Vec<_> = self.core.rows().iter().map(row).collect();
                found.set_item("rows", rows)?;
                let section = |s: &Biquad<$float>| [s.c0, s.c1, s.a1, s.a2].map(f64::from);
                let sections: Vec<_> = design.biquads.sections().iter().map(section).collect();
                found.set_item("biquads", sections)?;
                let ahead = &design.feedforward;
                let levels: Vec<_> =
                    ahead.levels().iter().map(|l| [l.y, l.u].map(f64::from)).collect();
                let taps: Vec<_> = ahead.taps().iter().map(|tap| f64::from(*tap)).collect();
                let late = f64::from(ahead.late());
                found.set_item("feedforward", (ahead.preview(), late, levels, taps))?;
                Ok(found)
            }
        }
    };
}

controller_methods!(Controller, f64 {
    #[new]
    #[pyo3(signature = (*, Kp, Ti, Td, alpha, beta, N, Tt, u_min, u_max, slew, Ts, filter_samples, filter_time, observer_time=0.0, r_rate=f64::INFINITY, schedule=Vec::new(), biquads=Vec::new(), feedforward=None))]
    fn new(
        py: Python<'_>,
        Kp: f64,
        Ti: f64,
        Td: f64,
        alpha: f64,
        beta: f64,
        N: f64,
        Tt: f64,
        u_min: f64,
        u_max: f64,
        slew: f64,
        Ts: f64,
        filter_samples: usize,
        filter_time: f64,
        observer_time: f64,
        r_rate: f64,
        schedule: Vec<Given>,
        biquads: Vec<Section>,
        feedforward: Option<Ahead>,
    ) -> PyResult<Self> {
        let gains = Standard {
            kp: Kp,
            ti: Ti,
            td: Td,
        };
        let pid = Settings {
            gains,
            alpha,
            beta,
            n: N,
            tt: Tt,
            u_min,
            u_max,
            slew,
            ts: Ts,
        };
        let made = cascade(&biquads).and_then(|biquads| {
            Core::new(Design {
                pid,
                filter_samples,
                filter_time,
                observer_time,
                r_rate,
                schedule: self::schedule(&schedule)?,
                biquads,
                feedforward: self::feedforward(&feedforward)?,
            })
        });
        let core = made.raised(py)?;
        Ok(Self { core })
    }

    /// The same settings in single precision.
    fn single(&self, py: Python<'_>) -> PyResult<SingleController> {
        let made = single(self.core.design()).and_then(Core::new);
        let core = made.raised(py)?;
        Ok(SingleController { core })
    }
});

controller_methods!(SingleController, f32 {});

/// State feedback with an observer, its gains from weights; see `sewfast_control::state_feedback`.
#[pyclass(module = "sewfast._core")]
pub struct StateFeedback {
    pub core: States<f64>,
}

/// The same arithmetic in single precision.
#[pyclass(module = "sewfast._core")]
pub struct SingleStateFeedback {
    core: States<f32>,
}

macro_rules! state_feedback_methods {
    ($class:ident, $float:ty { $($own:tt)* }) => {
        #[pymethods]
        impl $class {
            $($own)*

            #[pyo3(signature = (r, y, feedforward=0.0))]
            fn step(&mut self, r: $float, y: $float, feedforward: $float) -> $float {
                self.core.step_with(r, y, feedforward)
            }

            fn reset(&mut self) {
                self.core.reset();
            }

            #[getter]
            fn filtered(&self) -> $float {
                self.core.filtered()
            }

            /// What the step computes with.
            #[getter]
            fn numbers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
                let (design, found) = (self.core.design(), PyDict::new(py));
                for (name, vector) in [
                    ("den", design.a),
                    ("num", design.b),
                    ("K", design.k),
                    ("L", design.l),
                    ("rest", design.rest),
                ] {
                    found.set_item(name, vector.map(f64::from))?;
                }
                for (name, value) in [("Kr", design.kr), ("Ki", design.ki), ("lead", design.lead)] {
                    found.set_item(name, f64::from(value))?;
                }
                Ok(found)
            }
        }
    };
}

state_feedback_methods!(StateFeedback, f64 {
    #[new]
    #[pyo3(signature = (*, num, den, rho, integral, noise, weight, lead, r_rate, u_min, u_max, slew, Ts))]
    fn new(
        py: Python<'_>,
        num: [f64; STATES],
        den: [f64; STATES],
        rho: f64,
        integral: f64,
        noise: f64,
        weight: f64,
        lead: f64,
        r_rate: f64,
        u_min: f64,
        u_max: f64,
        slew: f64,
        Ts: f64,
    ) -> PyResult<Self> {
        let weights = Weights {
            rho,
            integral,
            noise,
            reference: weight,
        };
        let none = [0.0; STATES];
        let plant = StateDesign {
            a: den,
            b: num,
            k: none,
            l: none,
            rest: none,
            kr: 0.0,
            ki: 0.0,
            lead,
            r_rate,
            u_min,
            u_max,
            slew,
            ts: Ts,
            weights,
        };
        let made = lqg(plant, weights).and_then(States::new);
        let core = made.raised(py)?;
        Ok(Self { core })
    }

    /// The same gains in single precision.
    fn single(&self, py: Python<'_>) -> PyResult<SingleStateFeedback> {
        let made = States::new(self.core.design().single());
        let core = made.raised(py)?;
        Ok(SingleStateFeedback { core })
    }

    /// The numbers sent to a device, before the counts per unit and second.
    fn sent(&self) -> Vec<f64> {
        self.core.design().numbers().to_vec()
    }
});

state_feedback_methods!(SingleStateFeedback, f32 {});
