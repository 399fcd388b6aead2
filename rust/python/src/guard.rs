//! The device's guard, for machines without a device.

use crate::seam::{Values, slice};
use pyo3::prelude::*;
use sewfast_control::link::{Alarm, Limits, Trip, Watch};

/// Watches the samples of one run.
#[pyclass(module = "sewfast._core")]
pub struct Guard {
    watch: Watch,
    /// A power of two.
    scale: f64,
    /// All counts so far were whole numbers: those of an encoder with steps.
    whole: bool,
}

/// The name of a reason, and the value that passed its limit.
type Seen = (String, f64);

fn seen((reason, value): Trip) -> Seen {
    (format!("{reason:?}"), value.into())
}

fn alarmed(alarm: Alarm) -> Seen {
    match alarm {
        Alarm::Trip(trip) => seen(trip),
        Alarm::Lost(u) => ("Lost".to_owned(), u.into()),
    }
}

/// Least number of counts per turn in the counter: an input in turns or radians does not count whole steps.
const FINE: f64 = 4096.0;

impl Guard {
    /// As a 32-bit counter that wraps, like a device's, with the size of its step.
    fn counter(&mut self, counts: f64) -> (i32, u32) {
        self.whole &= counts.fract() == 0.0;
        let step = if self.whole { self.scale } else { 1.0 };
        ((counts * self.scale).floor() as i64 as i32, step as u32)
    }
}

#[pymethods]
impl Guard {
    #[new]
    #[pyo3(signature = (*, Ts, counts_per_rev, volt, speed, between=None))]
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
        let scale = (FINE / counts_per_rev).log2().ceil().max(0.0).exp2();
        let counts_per_rev = scale * counts_per_rev;
        Self {
            watch: Watch::new(Ts as f32, counts_per_rev as f32, limits, between),
            scale,
            whole: true,
        }
    }

    fn take(&mut self, counts: f64) -> Option<Seen> {
        let (counts, step) = self.counter(counts);
        self.watch.take_on_time(counts, step).err().map(seen)
    }

    fn sent(&mut self, u: f64) -> Option<Seen> {
        self.watch.sent(u as f32).err().map(alarmed)
    }

    fn watch(&mut self, u: Values<'_>, counts: Values<'_>) -> PyResult<Option<(usize, Seen)>> {
        let (u, counts) = (slice(&u, "u")?, slice(&counts, "counts")?);
        for (k, (u, counts)) in u.iter().zip(counts).enumerate() {
            // a sample lost by the link
            if !(u.is_finite() && counts.is_finite()) {
                self.watch.forget();
                continue;
            }
            let (counts, step) = self.counter(*counts);
            if let Err(trip) = self.watch.take(counts, step) {
                return Ok(Some((k, seen(trip))));
            }
            if let Err(alarm) = self.watch.sent(*u as f32) {
                return Ok(Some((k, alarmed(alarm))));
            }
        }
        Ok(None)
    }

    #[getter]
    fn at_rest(&self) -> bool {
        self.watch.at_rest()
    }
}
