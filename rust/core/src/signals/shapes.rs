//! Step, staircase, trapezoid; and large jumps that drive a motor into its current limit while its speed stays within a range.

use super::{MAX_SAMPLES, finite, not_negative, ordered, samples};
use crate::random::Random;
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

/// Random speeds, each reached by a pulse of high command and then held by the matching command.
///
/// The pulse lasts `|change of speed| / acceleration`, as long as a drive needs that accelerates at its current limit;
/// the level between pulses is `speed / gain`. The signal is planned open loop, so a real drive only comes near the
/// speeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jumps {
    /// Length of the signal (s).
    pub duration: f64,
    /// Lowest speed aimed at.
    pub speed_low: f64,
    /// Highest speed aimed at.
    pub speed_high: f64,
    /// Smallest change of speed from one pulse to the next.
    pub change_min: f64,
    /// Smallest magnitude of a pulse.
    pub level_min: f64,
    /// Largest magnitude of a pulse.
    pub level_max: f64,
    /// Shortest hold between pulses (s).
    pub hold_min: f64,
    /// Longest hold between pulses (s).
    pub hold_max: f64,
    /// How long the rise to a pulse and the fall from it take (s); 0 gives rectangular pulses.
    pub ramp: f64,
    /// Steady speed per unit of command.
    pub gain: f64,
    /// Acceleration at the current limit (speed/s).
    pub acceleration: f64,
}

impl Jumps {
    /// The sampled signal for `seed`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for values that are not finite, out of order or, for divisors, not above zero, a smallest
    /// change that does not fit twice into the range of speed, or a length outside 1 to [`super::MAX_SAMPLES`] samples.
    pub fn generate(&self, ts: f64, seed: u64) -> Result<Vec<f64>> {
        let n = samples("duration", self.duration, ts)?;
        self.check(ts)?;
        let mut random = Random::new(seed);
        let mut signal = Vec::with_capacity(n);
        let (mut speed, mut command) = (0.0, 0.0);
        while signal.len() < n {
            let next = self.next_speed(&mut random, speed);
            let pulse = random.between(self.level_min, self.level_max) * (next - speed).signum();
            let held = next / self.gain;
            let top = ((next - speed).abs() / self.acceleration - self.ramp).max(0.0);
            let hold = random.between(self.hold_min, self.hold_max);
            let mut ramp = |from: f64, to: f64, seconds: f64| {
                let count = (seconds / ts).round() as usize;
                let count = count.min(n - signal.len());
                let share = |k: usize| (k + 1) as f64 * ts / seconds;
                signal.extend((0..count).map(|k| from + (to - from) * share(k).min(1.0)));
            };
            ramp(command, pulse, self.ramp);
            ramp(pulse, pulse, top);
            ramp(pulse, held, self.ramp);
            ramp(held, held, hold);
            (speed, command) = (next, held);
        }
        Ok(signal)
    }

    /// A speed at least `change_min` away, uniform over the rest of the range.
    fn next_speed(&self, random: &mut Random, speed: f64) -> f64 {
        let below = (speed - self.change_min - self.speed_low).max(0.0);
        let above = (self.speed_high - speed - self.change_min).max(0.0);
        let place = random.between(0.0, below + above);
        if place < below {
            self.speed_low + place
        } else {
            self.speed_high - above + (place - below)
        }
    }

    fn check(&self, ts: f64) -> Result<()> {
        ordered(
            ("speed_low", self.speed_low),
            ("speed_high", self.speed_high),
        )?;
        ordered(("level_min", self.level_min), ("level_max", self.level_max))?;
        ordered(("hold_min", self.hold_min), ("hold_max", self.hold_max))?;
        samples("hold_min", self.hold_min, ts)?;
        not_negative(&[
            ("speed_low", self.speed_low),
            ("change_min", self.change_min),
            ("level_min", self.level_min),
            ("ramp", self.ramp),
        ])?;
        finite(&[("gain", self.gain), ("acceleration", self.acceleration)])?;
        if self.gain <= 0.0 || self.acceleration <= 0.0 {
            return Err(Error::setting(format!(
                "expected gain and acceleration above 0, got {} and {}; give those of the drive",
                self.gain, self.acceleration
            )));
        }
        let range = self.speed_high - self.speed_low;
        if 2.0 * self.change_min > range {
            return Err(Error::setting(format!(
                "expected change_min of at most half the range of speed ({}), got {}; lower it or widen the range",
                0.5 * range,
                self.change_min
            )));
        }
        Ok(())
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

    const JUMPS: Jumps = Jumps {
        duration: 20.0,
        speed_low: 200.0,
        speed_high: 4500.0,
        change_min: 800.0,
        level_min: 14.0,
        level_max: 20.0,
        hold_min: 0.1,
        hold_max: 0.5,
        ramp: 0.0,
        gain: 490.0,
        acceleration: 25_000.0,
    };

    #[test]
    fn jumps_to_its_levels_and_holds_its_speeds() {
        let u = JUMPS.generate(1e-3, 4).unwrap();
        assert_eq!(u.len(), 20_000);
        let pulses = u.iter().filter(|v| v.abs() >= 14.0).count();
        assert!((1_000..8_000).contains(&pulses), "{pulses}");
        let held = |v: &&f64| v.abs() < 14.0;
        assert!(
            u.iter()
                .filter(held)
                .all(|v| (200.0 / 490.0..=4500.0 / 490.0).contains(v))
        );
        assert!(u.iter().all(|v| v.abs() <= 20.0));
    }

    #[test]
    fn slants_its_pulses() {
        let slanted = Jumps {
            ramp: 0.02,
            ..JUMPS
        };
        let u = slanted.generate(1e-3, 4).unwrap();
        let steepest = u
            .windows(2)
            .map(|w| (w[1] - w[0]).abs())
            .fold(0.0, f64::max);
        assert!(steepest <= 30.0 / 20.0, "{steepest}");
    }

    #[test]
    fn refuses_what_has_no_next_speed_or_would_not_end() {
        let bad = [
            Jumps {
                change_min: 2_200.0,
                ..JUMPS
            },
            Jumps {
                hold_min: 0.0,
                ..JUMPS
            },
            Jumps { gain: 0.0, ..JUMPS },
            Jumps {
                acceleration: f64::NAN,
                ..JUMPS
            },
            Jumps {
                level_min: 21.0,
                ..JUMPS
            },
            Jumps {
                ramp: -0.1,
                ..JUMPS
            },
        ];
        for jumps in bad {
            assert!(jumps.generate(1e-3, 0).is_err(), "{jumps:?}");
        }
    }
}
