//! The controller, one sample at a time.

use pyo3::prelude::*;
use sewfast_control::{Controller as Core, Settings, Standard};
use sewfast_core::Error;

use crate::arrays::raise;

/// The controller's arithmetic (paper Fig. 16). Gains in standard form.
#[pyclass(module = "sewfast._core")]
pub struct Controller {
    pub core: Core<f64>,
    pub filter_samples: usize,
    pub filter_time: f64,
}

#[pymethods]
impl Controller {
    #[new]
    #[pyo3(signature = (*, Kp, Ti, Td, alpha, beta, N, Tt, u_min, u_max, slew, Ts, filter_samples, filter_time))]
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
    ) -> PyResult<Self> {
        let gains = Standard {
            kp: Kp,
            ti: Ti,
            td: Td,
        };
        let settings = Settings {
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
        let core = Core::new(settings, filter_samples, filter_time)
            .map_err(|refused| raise(py, Error::from(refused)))?;
        Ok(Self {
            core,
            filter_samples,
            filter_time,
        })
    }

    fn step(&mut self, r: f64, y: f64) -> f64 {
        self.core.step(r, y)
    }

    fn reset(&mut self) {
        self.core.reset();
    }

    #[getter]
    fn filtered(&self) -> f64 {
        self.core.filtered()
    }
}
