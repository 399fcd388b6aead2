//! Random levels, held for random times, with smooth transitions; and the pseudo-random binary sequence of maximum length.

use std::f64::consts::PI;

use super::{MAX_SAMPLES, finite, not_negative, ordered, samples};
use crate::random::Random;
use crate::{Error, Result};

/// Uniform random levels and hold times; each change is half a cosine, so the signal never leaves `low .. high`.
///
/// A change of `D` within `smoothing` seconds has a rate of at most `pi D / (2 smoothing)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RandomSteps {
    /// Length of the signal (s).
    pub duration: f64,
    /// Lowest level.
    pub low: f64,
    /// Highest level.
    pub high: f64,
    /// Shortest time from one change to the next (s).
    pub hold_min: f64,
    /// Longest time from one change to the next (s).
    pub hold_max: f64,
    /// How long a change takes (s), at most `hold_min`; 0 jumps.
    pub smoothing: f64,
    /// Level before the first change; `None` starts at the first level.
    pub start: Option<f64>,
}

impl RandomSteps {
    /// The sampled signal for `seed`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for values that are not finite or out of order, a hold below one sample, a smoothing
    /// longer than the shortest hold, or a length outside 1 to [`super::MAX_SAMPLES`] samples.
    pub fn generate(&self, ts: f64, seed: u64) -> Result<Vec<f64>> {
        let n = samples("duration", self.duration, ts)?;
        self.check(ts)?;
        let change = (self.smoothing / ts).round() as usize;
        let mut random = Random::new(seed);
        let mut next = || random.between(self.low, self.high).min(self.high);
        let mut to = next();
        let mut from = self.start.unwrap_or(to);
        let mut signal = Vec::with_capacity(n);
        while signal.len() < n {
            let hold = self.hold(&mut random, ts).min(n - signal.len());
            signal.extend((0..hold).map(|k| blend(from, to, k + 1, change)));
            (from, to) = (to, random.between(self.low, self.high).min(self.high));
        }
        Ok(signal)
    }

    fn hold(&self, random: &mut Random, ts: f64) -> usize {
        let hold = random.between(self.hold_min, self.hold_max);
        ((hold / ts).round() as usize).max(1)
    }

    fn check(&self, ts: f64) -> Result<()> {
        ordered(("low", self.low), ("high", self.high))?;
        ordered(("hold_min", self.hold_min), ("hold_max", self.hold_max))?;
        samples("hold_min", self.hold_min, ts)?;
        not_negative(&[("smoothing", self.smoothing)])?;
        finite(&[("start", self.start.unwrap_or(0.0))])?;
        if self.smoothing > self.hold_min {
            return Err(Error::setting(format!(
                "expected smoothing of at most hold_min ({} s), got {} s; smooth less or hold longer",
                self.hold_min, self.smoothing
            )));
        }
        Ok(())
    }
}

/// Half a cosine from `from` to `to` within `change` samples; `to` itself from then on.
fn blend(from: f64, to: f64, k: usize, change: usize) -> f64 {
    if k >= change {
        return to;
    }
    let share = 0.5 * (1.0 - (PI * k as f64 / change as f64).cos());
    (from * (1.0 - share) + to * share).clamp(from.min(to), from.max(to))
}

/// Feedback masks of primitive polynomials for registers of 2 to 27 bits (taps of Xilinx XAPP 052; Golomb 1967).
const MASKS: [u32; 26] = [
    mask(&[2, 1]),
    mask(&[3, 2]),
    mask(&[4, 3]),
    mask(&[5, 3]),
    mask(&[6, 5]),
    mask(&[7, 6]),
    mask(&[8, 6, 5, 4]),
    mask(&[9, 5]),
    mask(&[10, 7]),
    mask(&[11, 9]),
    mask(&[12, 6, 4, 1]),
    mask(&[13, 4, 3, 1]),
    mask(&[14, 5, 3, 1]),
    mask(&[15, 14]),
    mask(&[16, 15, 13, 4]),
    mask(&[17, 14]),
    mask(&[18, 11]),
    mask(&[19, 6, 2, 1]),
    mask(&[20, 17]),
    mask(&[21, 19]),
    mask(&[22, 21]),
    mask(&[23, 18]),
    mask(&[24, 23, 22, 17]),
    mask(&[25, 22]),
    mask(&[26, 6, 2, 1]),
    mask(&[27, 5, 2, 1]),
];

const fn mask(taps: &[u32]) -> u32 {
    let (mut bits, mut i) = (0, 0);
    while i < taps.len() {
        bits |= 1 << (taps[i] - 1);
        i += 1;
    }
    bits
}

/// The shortest register whose period `2^n - 1` covers `bits`.
fn register_length(bits: usize) -> u32 {
    (2..=27).find(|&n| (1usize << n) > bits).unwrap_or(27)
}

/// One step of the Galois register; its lowest bit is the output.
fn advance(register: u32, mask: u32) -> u32 {
    (register >> 1) ^ (mask & (register & 1).wrapping_neg())
}

/// A maximum length sequence between `low` and `high`, each bit held for `hold` seconds.
///
/// The register is the shortest whose period covers the signal, so nothing repeats; the seed chooses the start within
/// the period.
///
/// # Errors
/// `ErrorKind::Setting` for values that are not finite, a hold below one sample, or a length outside 1 to
/// [`MAX_SAMPLES`] samples.
pub fn prbs(duration: f64, ts: f64, low: f64, high: f64, hold: f64, seed: u64) -> Result<Vec<f64>> {
    let n = samples("duration", duration, ts)?;
    let held = samples("hold", hold, ts)?.min(MAX_SAMPLES);
    finite(&[("low", low), ("high", high)])?;
    let length = register_length(n.div_ceil(held));
    let mask = MASKS[length as usize - 2];
    let mut register = start(length, seed);
    let mut signal = Vec::with_capacity(n);
    while signal.len() < n {
        let level = if register & 1 == 1 { high } else { low };
        signal.extend(std::iter::repeat_n(level, held.min(n - signal.len())));
        register = advance(register, mask);
    }
    Ok(signal)
}

/// A nonzero register content.
fn start(length: u32, seed: u64) -> u32 {
    let period = (1u64 << length) - 1;
    (1 + Random::new(seed).next_u64() % period) as u32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STEPS: RandomSteps = RandomSteps {
        duration: 20.0,
        low: 0.3,
        high: 6.0,
        hold_min: 0.2,
        hold_max: 0.9,
        smoothing: 0.1,
        start: None,
    };

    #[test]
    fn repeats_for_a_seed_and_differs_for_another() {
        let draw = |seed| STEPS.generate(1e-3, seed).unwrap();
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
    }

    #[test]
    fn comes_from_its_start_without_a_jump() {
        let steps = RandomSteps {
            start: Some(0.0),
            ..STEPS
        };
        let signal = steps.generate(1e-3, 3).unwrap();
        assert!(signal[0] < 0.01 && signal[0] > 0.0);
    }

    #[test]
    fn refuses_times_and_levels_out_of_order() {
        let bad = [
            RandomSteps { low: 7.0, ..STEPS },
            RandomSteps {
                hold_max: 0.1,
                ..STEPS
            },
            RandomSteps {
                hold_min: 1e-5,
                smoothing: 0.0,
                ..STEPS
            },
            RandomSteps {
                smoothing: 0.3,
                ..STEPS
            },
            RandomSteps {
                start: Some(f64::NAN),
                ..STEPS
            },
            RandomSteps {
                duration: 1e6,
                ..STEPS
            },
        ];
        for steps in bad {
            assert!(steps.generate(1e-3, 0).is_err(), "{steps:?}");
        }
    }

    proptest! {
        #[test]
        fn stays_between_its_levels_at_its_rate(
            seed: u64, low in -1e3..1e3f64, range in 0.0..1e3f64, smoothing in 0.0..0.2f64,
        ) {
            let high = low + range;
            let steps = RandomSteps { low, high, smoothing, ..STEPS };
            let signal = steps.generate(1e-2, seed).unwrap();
            prop_assert!(signal.iter().all(|v| (low..=high).contains(v)));
            let change = (smoothing / 1e-2).round().max(1.0);
            let fastest = range * (PI / 2.0 / change).sin() + 1e-9;
            prop_assert!(change < 1.5 || signal.windows(2).all(|w| (w[1] - w[0]).abs() <= fastest));
        }
    }

    #[test]
    fn every_register_has_the_longest_period() {
        for (length, mask) in (2..).zip(MASKS) {
            let mut register = advance(1, mask);
            let mut period = 1u32;
            while register != 1 {
                register = advance(register, mask);
                period += 1;
            }
            assert_eq!(period, (1 << length) - 1, "{length} bits");
        }
    }

    #[test]
    fn one_period_is_balanced_and_white() {
        let bits = 127;
        let u = prbs(bits as f64, 1.0, -1.0, 1.0, 1.0, 5).unwrap();
        assert_eq!(u.iter().sum::<f64>(), 1.0);
        for lag in 1..bits {
            let correlation: f64 = (0..bits).map(|k| u[k] * u[(k + lag) % bits]).sum();
            assert_eq!(correlation, -1.0);
        }
    }

    #[test]
    fn chooses_its_register_by_the_length_and_its_start_by_the_seed() {
        assert_eq!([3, 4, 127, 128].map(register_length), [2, 3, 7, 8]);
        let draw = |seed| prbs(10.0, 1e-3, 0.0, 5.0, 0.05, seed).unwrap();
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
        assert!(draw(3).chunks(50).all(|c| c.iter().all(|v| *v == c[0])));
    }

    #[test]
    fn refuses_a_hold_below_one_sample() {
        assert!(prbs(10.0, 1e-3, 0.0, 5.0, 1e-4, 0).is_err());
        assert!(prbs(10.0, 1e-3, 0.0, f64::INFINITY, 0.1, 0).is_err());
    }
}
