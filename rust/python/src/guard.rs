//! The device's guard, in front of machines that have no device.

use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use sewfast_control::link::{Limits, Trip, Watch};

use crate::seam::slice;

/// Watches the samples of one run.
#[pyclass(module = "sewfast._core")]
pub struct Guard {
    watch: Watch,
}

/// The name of a reason, and the value that passed its limit.
type Seen = (String, f64);

fn seen((reason, value): Trip) -> Seen {
    (format!("{reason:?}"), value.into())
}

/// As a counter of 32 bits that wraps, like a device's.
fn counter(counts: f64) -> i32 {
    counts as i64 as i32
}

#[pymethods]
impl Guard {
    #[new]
    #[pyo3(signature = (*, Ts, counts_per_rev, volt, speed, between=None))]
    #[expect(non_snake_case, reason = "the field's name for the sample time")]
    fn new(
        Ts: f64,
        counts_per_rev: f64,
        volt: f64,
        speed: f64,
        between: Option<(f64, f64)>,
    ) -> Self {
        let limits = Limits {
            volt: volt as f32,
            speed: speed as f32,
            acceleration: f32::INFINITY,
            current: f32::INFINITY,
        };
        let between = between.map(|(low, high)| (low as f32, high as f32));
        Self {
            watch: Watch::new(Ts as f32, counts_per_rev as f32, limits, between),
        }
    }

    fn take(&mut self, counts: f64) -> Option<Seen> {
        self.watch.take(counter(counts)).err().map(seen)
    }

    fn watch(
        &mut self,
        u: PyReadonlyArray1<'_, f64>,
        counts: PyReadonlyArray1<'_, f64>,
    ) -> PyResult<Option<(usize, Seen)>> {
        let (u, counts) = (slice(&u, "u")?, slice(&counts, "counts")?);
        for (k, (u, counts)) in u.iter().zip(counts).enumerate() {
            // a sample that a link has lost
            if !(u.is_finite() && counts.is_finite()) {
                continue;
            }
            let passed = self
                .watch
                .take(counter(*counts))
                .and_then(|()| self.watch.sent(*u as f32));
            if let Err(trip) = passed {
                return Ok(Some((k, seen(trip))));
            }
        }
        Ok(None)
    }

    #[getter]
    fn at_rest(&self) -> bool {
        self.watch.at_rest()
    }
}

/// Adds the guard to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Guard>()
}
