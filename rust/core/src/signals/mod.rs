//! Excitation signals and references: seeded, validated, sampled at `k Ts`.
//!
//! Here is what every signal asks of its arguments; `shapes` (steps, trapezoids, jumps), `sines` and `random_steps` make signals,
//! `limit` keeps them within amplitude, rate and slew.

mod limit;
mod random_steps;
mod shapes;
mod sines;

use crate::{Error, Result};

pub use limit::Limits;
pub use random_steps::{RandomSteps, prbs};
pub use shapes::{Jumps, Trapezoid, staircase, step};
pub use sines::{Chirp, Multisine, Sweep, crest_factor};

/// The longest signal that is generated: 100 million samples, 800 MB.
pub const MAX_SAMPLES: usize = 100_000_000;

/// Refuses values that are not finite.
fn finite(arguments: &[(&str, f64)]) -> Result<()> {
    match arguments.iter().find(|(_, value)| !value.is_finite()) {
        None => Ok(()),
        Some((name, value)) => Err(Error::setting(format!(
            "expected {name} finite, got {value}; give a finite number"
        ))),
    }
}

/// Refuses values below zero or not finite.
fn not_negative(arguments: &[(&str, f64)]) -> Result<()> {
    finite(arguments)?;
    match arguments.iter().find(|(_, value)| *value < 0.0) {
        None => Ok(()),
        Some((name, value)) => Err(Error::setting(format!(
            "expected {name} of 0 or more, got {value}; turn its sign"
        ))),
    }
}

/// Refuses a pair out of order; equal values are in order.
fn ordered(low: (&str, f64), high: (&str, f64)) -> Result<()> {
    finite(&[low, high])?;
    if low.1 <= high.1 {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected {} <= {}, got {} and {}; exchange them",
        low.0, high.0, low.1, high.1
    )))
}

/// Number of samples in `duration`: `round(duration / Ts)`, 1 to [`MAX_SAMPLES`].
fn samples(name: &str, duration: f64, ts: f64) -> Result<usize> {
    sample_time(ts)?;
    finite(&[(name, duration)])?;
    let n = (duration / ts).round();
    if n < 1.0 {
        return Err(Error::setting(format!(
            "expected {name} of one sample time ({ts} s) or more, got {duration} s; lengthen it"
        )));
    }
    if n > MAX_SAMPLES as f64 {
        return Err(Error::setting(format!(
            "expected at most {MAX_SAMPLES} samples, got {n} from {name} {duration} s at Ts {ts} s; shorten it or raise Ts"
        )));
    }
    Ok(n as usize)
}

/// Refuses a sample time that is not finite and above zero.
fn sample_time(ts: f64) -> Result<()> {
    if ts.is_finite() && ts > 0.0 {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected Ts finite and above 0 s, got {ts}; give the sample time in seconds"
    )))
}

/// Refuses a frequency that is negative or at or above half the sampling frequency.
fn below_nyquist(name: &str, frequency: f64, ts: f64) -> Result<()> {
    not_negative(&[(name, frequency)])?;
    if frequency * ts < 0.5 {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected {name} below half the sampling frequency ({} Hz), got {frequency} Hz; lower it or shorten Ts",
        0.5 / ts
    )))
}
