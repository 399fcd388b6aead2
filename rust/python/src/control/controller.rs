//! The controller, one sample at a time.

use pyo3::prelude::*;
use sewfast_control::{Controller as Core, Design, Point, Refused, Schedule, Settings, Standard};
use sewfast_core::Error;

use crate::arrays::raise;

/// The controller's arithmetic (paper Fig. 16). Gains in standard form.
#[pyclass(module = "sewfast._core")]
pub struct Controller {
    pub core: Core<f64>,
}

/// Speed, then Kp, Ti, Td in standard form.
type Row = (f64, f64, f64, f64);

fn schedule(rows: &[Row]) -> Result<Schedule<f64>, Refused> {
    let point = |&(speed, kp, ti, td): &Row| Point {
        speed,
        gains: Standard { kp, ti, td },
    };
    Schedule::new(&rows.iter().map(point).collect::<Vec<_>>())
}

#[pymethods]
impl Controller {
    #[new]
    #[pyo3(signature = (*, Kp, Ti, Td, alpha, beta, N, Tt, u_min, u_max, slew, Ts, filter_samples, filter_time, observer_time=0.0, r_rate=f64::INFINITY, schedule=Vec::new()))]
    #[expect(non_snake_case, reason = "the field's names")]
    #[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
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
        schedule: Vec<Row>,
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
        let made = self::schedule(&schedule).and_then(|schedule| {
            Core::new(Design {
                pid,
                filter_samples,
                filter_time,
                observer_time,
                r_rate,
                schedule,
            })
        });
        let core = made.map_err(|refused| raise(py, Error::from(refused)))?;
        Ok(Self { core })
    }

    #[pyo3(signature = (r, y, feedforward=0.0))]
    fn step(&mut self, r: f64, y: f64, feedforward: f64) -> f64 {
        self.core.step_with(r, y, feedforward)
    }

    fn set_design(&mut self, py: Python<'_>, other: &Bound<'_, Self>) -> PyResult<()> {
        // a controller takes its own design as well, which a second borrow would not allow
        let design = match other.try_borrow() {
            Ok(other) => *other.core.design(),
            Err(_) => *self.core.design(),
        };
        let done = self.core.set_design(design);
        done.map_err(|refused| raise(py, Error::from(refused)))
    }

    fn set_manual(&mut self, py: Python<'_>, u: f64) -> PyResult<()> {
        let done = self.core.set_manual(u);
        done.map_err(|refused| raise(py, Error::from(refused)))
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
    fn filtered(&self) -> f64 {
        self.core.filtered()
    }
}
