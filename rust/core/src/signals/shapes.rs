//! Step, staircase and trapezoid.

use super::{MAX_SAMPLES, finite, not_negative, samples};
use crate::{Error, Result};

/// `low` before time `at`, `high` from then on.
///
/// # Errors
/// `ErrorKind::Setting` for values that are not finite, `at` outside the signal, or a length outside 1 to
/// [`MAX_SAMPLES`] samples.
pub fn step(duration: f64, ts: f64, at: f64, low: f64, high: f64) -> Result<Vec<f64>> {
    let n = samples("duration", duration, ts)?;
    not_negative(&[("at", at)])?;
    finite(&[("low", low), ("high", high)])?;
    if at > duration {
        return Err(Error::setting(format!(
            "expected the step at {duration} s or before, got {at} s; lengthen the signal or step earlier"
        )));
    }
    let first = (at / ts).round() as usize;
    Ok((0..n).map(|k| if k < first { low } else { high }).collect())
}

/// Every level held for `hold` seconds, one after the other.
///
/// # Errors
/// `ErrorKind::Setting` for no level, levels that are not finite, a hold below one sample, or too many samples.
pub fn staircase(ts: f64, levels: &[f64], hold: f64) -> Result<Vec<f64>> {
    let held = samples("hold", hold, ts)?;
    if levels.is_empty() {
        return Err(Error::setting(
            "expected one level or more, got none; give the levels of the stairs",
        ));
    }
    if let Some(k) = levels.iter().position(|level| !level.is_finite()) {
        return Err(Error::setting(format!(
            "expected finite levels, got {} at index {k}; give finite numbers",
            levels[k]
        )));
    }
    if held.saturating_mul(levels.len()) > MAX_SAMPLES {
        return Err(Error::setting(format!(
            "expected at most {MAX_SAMPLES} samples, got {} levels of {held}; shorten the hold",
            levels.len()
        )));
    }
    Ok(levels
        .iter()
        .flat_map(|&level| std::iter::repeat_n(level, held))
        .collect())
}

/// A straight rise from `low` to `high`, a hold and a straight fall back to `low`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trapezoid {
    /// Length of the signal (s).
    pub duration: f64,
    /// When the rise starts (s).
    pub start: f64,
    /// How long the rise takes (s); 0 is a step.
    pub rise: f64,
    /// How long `high` is held (s).
    pub hold: f64,
    /// How long the fall takes (s).
    pub fall: f64,
    /// Level before and after.
    pub low: f64,
    /// Level between.
    pub high: f64,
}

impl Trapezoid {
    /// The sampled signal.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for values that are not finite, times below zero, a shape that ends after the signal,
    /// or a length outside 1 to [`MAX_SAMPLES`] samples.
    pub fn generate(&self, ts: f64) -> Result<Vec<f64>> {
        let n = samples("duration", self.duration, ts)?;
        not_negative(&[
            ("start", self.start),
            ("rise", self.rise),
            ("hold", self.hold),
            ("fall", self.fall),
        ])?;
        finite(&[("low", self.low), ("high", self.high)])?;
        let end = self.start + self.rise + self.hold + self.fall;
        if end > self.duration * (1.0 + 1e-9) {
            return Err(Error::setting(format!(
                "expected the trapezoid to end within {} s, got an end at {end} s; lengthen the signal",
                self.duration
            )));
        }
        Ok((0..n).map(|k| self.at(k as f64 * ts)).collect())
    }

    fn at(&self, t: f64) -> f64 {
        let top = self.start + self.rise;
        let share = if t < self.start {
            0.0
        } else if t < top {
            (t - self.start) / self.rise
        } else if t <= top + self.hold {
            1.0
        } else {
            (1.0 - (t - top - self.hold) / self.fall).max(0.0)
        };
        // Weighted so that a share of 1 gives `high` itself, without rounding.
        self.low * (1.0 - share) + self.high * share
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_and_climbs_at_the_stated_times() {
        assert_eq!(step(0.4, 0.1, 0.2, 1.0, 3.0).unwrap(), [1.0, 1.0, 3.0, 3.0]);
        assert_eq!(
            staircase(0.1, &[1.0, 2.0], 0.2).unwrap(),
            [1.0, 1.0, 2.0, 2.0]
        );
    }

    #[test]
    fn draws_a_trapezoid_and_a_pulse_without_ramps() {
        let mut shape = Trapezoid {
            duration: 9.0,
            start: 1.0,
            rise: 2.0,
            hold: 1.0,
            fall: 2.0,
            low: 2.0,
            high: 6.0,
        };
        let expected = [2.0, 2.0, 4.0, 6.0, 6.0, 4.0, 2.0, 2.0, 2.0];
        assert_eq!(shape.generate(1.0).unwrap(), expected);
        (shape.rise, shape.fall) = (0.0, 0.0);
        let pulse = shape.generate(1.0).unwrap();
        assert_eq!(pulse[..4], [2.0, 6.0, 6.0, 2.0]);
    }

    #[test]
    fn refuses_what_cannot_be_drawn() {
        for bad in [f64::NAN, f64::INFINITY, -1.0, 0.0, 1e-12] {
            assert!(step(1.0, bad, 0.5, 0.0, 1.0).is_err(), "Ts {bad}");
        }
        assert!(step(1.0, 0.1, 1.5, 0.0, 1.0).is_err());
        assert!(step(1.0, 0.1, 0.5, 0.0, f64::NAN).is_err());
        assert!(staircase(0.1, &[], 1.0).is_err());
        assert!(staircase(0.1, &[1.0], 0.01).is_err());
        assert!(staircase(1e-3, &[0.0; 200_000], 1.0).is_err());
    }
}
