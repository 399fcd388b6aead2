//! Excitation signals and references: seeded, validated, sampled at `k Ts`.
//!
//! This file has the checks of arguments, common to all signals, and the limits of amplitude, rate and slew, which are
//! kept exactly. The signals are in `shapes` (steps, trapezoids, jumps), `sines` and `random_steps`.

mod random_steps;
mod shapes;
mod sines;

use crate::{Error, Result};

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

/// The limits of a signal `x`: `low <= x(k) <= high`, `|x(k) - x(k-1)| <= rate Ts` and
/// `|x(k) - 2 x(k-1) + x(k-2)| <= slew Ts^2`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Lowest value.
    pub low: f64,
    /// Highest value.
    pub high: f64,
    /// Largest rate of change (unit/s); infinity sets no limit.
    pub rate: f64,
    /// Largest change of the rate (unit/s^2); infinity sets no limit.
    pub slew: f64,
}

impl Limits {
    /// The signal that follows `signal` within the limits; it starts at the first value, at any rate.
    ///
    /// A signal within the limits is returned bit for bit. Otherwise each sample follows the time-optimal braking law:
    /// towards the signal as fast as it can still be met, and never so fast that `low` or `high` could no longer be
    /// kept. All limits hold in floating-point arithmetic, as `numpy.diff` computes it.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for limits out of order, not above zero, or too fine for double precision beside the
    /// amplitude; `ErrorKind::Data` for a signal that is not finite.
    pub fn apply(&self, signal: &[f64], ts: f64) -> Result<Vec<f64>> {
        self.check(ts)?;
        if let Some(k) = signal.iter().position(|v| !v.is_finite()) {
            return Err(Error::data(format!(
                "expected finite values to limit, got {} at sample {k}; repair the signal",
                signal[k]
            )));
        }
        let (speed, change) = (self.rate * ts, self.slew * ts * ts);
        if self.hold_for(signal, speed, change) {
            return Ok(signal.to_vec());
        }
        let follower = Follower::new(self, speed, change)?;
        Ok(follower.follow(signal))
    }

    fn check(&self, ts: f64) -> Result<()> {
        sample_time(ts)?;
        ordered(("low", self.low), ("high", self.high))?;
        for (name, value) in [("rate", self.rate), ("slew", self.slew)] {
            if value.is_nan() || value <= 0.0 {
                return Err(Error::setting(format!(
                    "expected {name} above 0, got {value}; infinity sets no limit"
                )));
            }
        }
        Ok(())
    }

    fn hold_for(&self, signal: &[f64], speed: f64, change: f64) -> bool {
        let step = |w: &[f64]| w[1] - w[0];
        signal.iter().all(|v| (self.low..=self.high).contains(v))
            && signal.windows(2).all(|w| step(w).abs() <= speed)
            && signal
                .windows(3)
                .all(|w| (step(&w[1..]) - step(w)).abs() <= change)
    }
}

/// The limits per sample. `speed` and `change` leave room for rounding; planning uses `brake`.
struct Follower {
    low: f64,
    high: f64,
    speed: f64,
    change: f64,
    brake: f64,
}

impl Follower {
    fn new(limits: &Limits, speed: f64, change: f64) -> Result<Self> {
        let ulp = limits.low.abs().max(limits.high.abs()) * f64::EPSILON;
        for (name, value) in [("rate x Ts", speed), ("slew x Ts^2", change)] {
            if value < 1e3 * ulp {
                return Err(Error::setting(format!(
                    "expected {name} of {} or more beside values up to {}, got {value}; double precision resolves no less",
                    1e3 * ulp,
                    limits.low.abs().max(limits.high.abs())
                )));
            }
        }
        Ok(Self {
            low: limits.low,
            high: limits.high,
            speed: speed - 4.0 * ulp,
            change: change - 8.0 * ulp,
            brake: change - 64.0 * ulp,
        })
    }

    fn follow(&self, signal: &[f64]) -> Vec<f64> {
        let mut out = Vec::with_capacity(signal.len());
        let (mut x, mut v) = (0.0, None);
        for (k, &target) in signal.iter().enumerate() {
            let next = match k {
                0 => target.clamp(self.low, self.high),
                _ => self.next(x, v, signal[k - 1], target, signal.len() - 1 - k),
            };
            if k > 0 {
                v = Some(next - x);
            }
            x = next;
            out.push(x);
        }
        out
    }

    /// The next value from `x` and the last change `v`, with `ahead` samples after it.
    fn next(&self, x: f64, v: Option<f64>, before: f64, target: f64, ahead: usize) -> f64 {
        let motion = (target - before).clamp(-self.speed, self.speed);
        let gap = target - motion - x;
        let wanted = motion + gap.signum() * fastest(gap.abs(), self.brake, ahead);
        // Both ends contain 0 and, by the choice one sample before, a change that braking can reach.
        let up = fastest(self.high - x, self.brake, ahead);
        let down = -fastest(x - self.low, self.brake, ahead);
        let change = wanted.clamp(down, up).clamp(-self.speed, self.speed);
        let change = v.map_or(change, |v| change.clamp(v - self.change, v + self.change));
        // The target itself if it is reachable, so that rounding does not accumulate along a followed signal.
        let next = if change == target - x {
            target
        } else {
            x + change
        };
        next.clamp(self.low, self.high)
    }
}

/// The largest `v` that does not overshoot a gap if braked by `a` per sample, over `ahead` further samples.
///
/// The distance is `v + (v - a) + (v - 2a) + .. = (n + 1) v - a n (n + 1)/2`, with `n` the samples that still move.
fn fastest(gap: f64, a: f64, ahead: usize) -> f64 {
    if a == f64::INFINITY {
        return gap;
    }
    let n = (0.5 * ((1.0 + 8.0 * gap / a).sqrt() - 1.0)).floor();
    let n = n.min(ahead as f64);
    gap / (n + 1.0) + 0.5 * a * n
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn assert_within(limits: &Limits, x: &[f64], ts: f64) {
        let d: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
        for (k, v) in x.iter().enumerate() {
            assert!((limits.low..=limits.high).contains(v), "value {v} at {k}");
        }
        for (k, v) in d.iter().enumerate() {
            assert!(v.abs() <= limits.rate * ts, "rate {v} at {k}");
        }
        for (k, w) in d.windows(2).enumerate() {
            let change = (w[1] - w[0]).abs();
            assert!(change <= limits.slew * ts * ts, "slew {change} at {k}");
        }
    }

    #[test]
    fn follows_a_step_in_the_shortest_time_without_overshoot() {
        let mut signal = vec![10.0; 12];
        signal[0] = 0.0;
        signal[1] = 0.0;
        let limits = Limits {
            low: 0.0,
            high: 20.0,
            rate: 3.0,
            slew: 1.0,
        };
        let x = limits.apply(&signal, 1.0).unwrap();
        let expected = [0.0, 0.0, 1.0, 3.0, 6.0];
        assert!(
            x[..5]
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-9),
            "{x:?}"
        );
        assert!(x.iter().all(|v| *v <= 10.0 + 1e-9));
        assert_eq!(x[11], 10.0);
    }

    #[test]
    fn limits_the_rate_alone() {
        let limits = Limits {
            low: -5.0,
            high: 5.0,
            rate: 2.0,
            slew: f64::INFINITY,
        };
        let x = limits.apply(&[0.0, 9.0, 9.0, 9.0, 9.0, -1.0], 1.0).unwrap();
        let expected = [0.0, 2.0, 4.0, 5.0, 5.0, 3.0];
        assert!(
            x.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12),
            "{x:?}"
        );
    }

    #[test]
    fn refuses_limits_that_cannot_be_kept() {
        let good = Limits {
            low: 0.0,
            high: 1.0,
            rate: 1.0,
            slew: 1.0,
        };
        let bad = [
            Limits { low: 2.0, ..good },
            Limits { rate: 0.0, ..good },
            Limits {
                slew: f64::NAN,
                ..good
            },
            Limits {
                high: f64::INFINITY,
                ..good
            },
            Limits {
                slew: 1e-13,
                ..good
            },
        ];
        for limits in bad {
            assert!(limits.apply(&[0.0, 5.0, 0.0], 1.0).is_err(), "{limits:?}");
        }
        assert!(good.apply(&[0.0, f64::NAN], 1.0).is_err());
        assert!(good.apply(&[], 1.0).unwrap().is_empty());
    }

    fn values() -> impl Strategy<Value = Vec<f64>> {
        let smooth = prop::collection::vec((-3.0..3.0f64, 1usize..40), 1..20).prop_map(|levels| {
            let held = levels.into_iter().map(|(v, n)| std::iter::repeat_n(v, n));
            held.flatten().collect()
        });
        prop_oneof![
            prop::collection::vec(-3.0..3.0f64, 0..200),
            prop::collection::vec(prop::num::f64::NORMAL, 0..50),
            smooth,
        ]
    }

    proptest! {
        #![proptest_config(crate::laws::cases(2000))]

        #[test]
        fn whatever_comes_in_stays_within(
            signal in values(), low in -2.0..0.5f64, range in 0.0..3.0f64,
            rate in prop_oneof![1e-3..3.0f64, Just(f64::INFINITY)],
            slew in prop_oneof![1e-6..1e-2f64, 1e-2..3.0f64, Just(f64::INFINITY)],
            scale in prop_oneof![Just(1.0), 1e-9..1e9f64], ts in 1e-3..1.0f64,
        ) {
            let limits = Limits {
                low: low * scale, high: (low + range) * scale,
                rate: rate * scale / ts, slew: slew * scale / (ts * ts),
            };
            let signal: Vec<f64> = signal.iter().map(|v| (v * scale).clamp(-1e300, 1e300)).collect();
            assert_within(&limits, &limits.apply(&signal, ts).unwrap(), ts);
        }

        #[test]
        fn what_is_within_comes_back_bit_for_bit(
            signal in values(), rate in 0.01..1.0f64, slew in 0.01..1.0f64,
        ) {
            let limits = Limits { low: -2.0, high: 2.0, rate, slew };
            let once = limits.apply(&signal, 1.0).unwrap();
            prop_assert_eq!(limits.apply(&once, 1.0).unwrap(), once);
        }

        #[test]
        fn a_step_is_reached_and_never_passed(
            height in 0.1..2.0f64, rate in 0.01..1.0f64, slew in 0.01..1.0f64,
        ) {
            let limits = Limits { low: -3.0, high: 3.0, rate, slew };
            let mut signal = vec![height; 600];
            signal[..2].fill(0.0);
            let x = limits.apply(&signal, 1.0).unwrap();
            prop_assert!(x.iter().all(|v| *v <= height + 1e-9));
            prop_assert!((x[599] - height).abs() < 1e-9);
        }
    }
}
