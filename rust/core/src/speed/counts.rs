//! Counts: how an encoder makes them of a position; their scale, their checks, their wrapping.

use crate::simd::F64x8;
use crate::{Error, Result};

/// Sample time and resolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    ts: f64,
    counts_per_unit: f64,
}

impl Scale {
    /// `ts` in seconds, `counts_per_unit` in counts per (unit of speed x second).
    ///
    /// # Errors
    /// `ErrorKind::Setting` for values that are not finite and above zero.
    pub fn new(ts: f64, counts_per_unit: f64) -> Result<Self> {
        for (name, value) in [("Ts", ts), ("counts_per_unit", counts_per_unit)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::setting(format!(
                    "expected {name} finite and above 0, got {value}; give the recording's own"
                )));
            }
        }
        Ok(Self {
            ts,
            counts_per_unit,
        })
    }

    /// Speed that one count per sample stands for.
    pub fn per_count(&self) -> f64 {
        1.0 / (self.ts * self.counts_per_unit)
    }

    /// White-jerk intensity (unit^2/s^3) in counts and samples (counts^2/sample^5).
    pub(super) fn jerk_in_counts(&self, process_noise: f64) -> f64 {
        process_noise * self.counts_per_unit.powi(2) * self.ts.powi(5)
    }
}

/// Whole numbers up to this are exact in double precision: 2^53.
const EXACT: f64 = 9_007_199_254_740_992.0;

/// Refuses too few counts, counts that are not finite or not exact, and jumps that look like a wrapped counter.
pub(super) fn check(counts: &[f64], at_least: usize) -> Result<()> {
    if counts.len() < at_least {
        return Err(Error::data(format!(
            "expected {at_least} counts or more, got {}; record for longer",
            counts.len()
        )));
    }
    if let Some(k) = counts.iter().position(|c| !c.is_finite()) {
        return Err(Error::data(format!(
            "expected finite counts, got {} at sample {k}; cut or repair that part of the recording",
            counts[k]
        )));
    }
    if let Some(k) = counts.iter().position(|c| c.abs() > EXACT) {
        return Err(Error::data(format!(
            "expected counts up to 2^53, got {} at sample {k}; subtract the first count or repair the recording",
            counts[k]
        )));
    }
    match wrap(counts) {
        None => Ok(()),
        Some((k, bits)) => Err(Error::data(format!(
            "expected counts without wrapping, got a jump of {} at sample {k}, near 2^{bits}; give unwrap_bits={bits}",
            counts[k] - counts[k - 1]
        ))),
    }
}

/// The first single jump within an eighth of `2^16` or `2^32` whose neighbours are less than a sixteenth of it.
fn wrap(counts: &[f64]) -> Option<(usize, u32)> {
    let step = |k: usize| counts.get(k).map_or(0.0, |c| (c - counts[k - 1]).abs());
    let quiet =
        |k: usize, range: f64| (k < 2 || step(k - 1) < range / 16.0) && step(k + 1) < range / 16.0;
    let near = |k: usize, bits: u32| {
        let range = (1u64 << bits) as f64;
        (step(k) - range).abs() < range / 8.0 && quiet(k, range)
    };
    (1..counts.len()).find_map(|k| {
        let bits = [16, 32].into_iter().find(|&bits| near(k, bits))?;
        Some((k, bits))
    })
}

/// Counts of a counter of `bits` bits as one continuous count: every step is the shortest one modulo `2^bits`.
///
/// # Errors
/// `ErrorKind::Setting` for bits outside 1 to 52; `ErrorKind::Data` for counts that are not finite or whose range
/// exceeds `2^bits`.
pub fn unwrap(counts: &[f64], bits: u32) -> Result<Vec<f64>> {
    if !(1..=52).contains(&bits) {
        return Err(Error::setting(format!(
            "expected unwrap_bits of 1 to 52, got {bits}; give the width of the counter"
        )));
    }
    if let Some(k) = counts.iter().position(|c| !c.is_finite()) {
        return Err(Error::data(format!(
            "expected finite counts, got {} at sample {k}; cut or repair that part of the recording",
            counts[k]
        )));
    }
    let range = (1u64 << bits) as f64;
    let span = |f: fn(f64, f64) -> f64| counts.iter().copied().reduce(f).unwrap_or(0.0);
    if span(f64::max) - span(f64::min) >= range {
        return Err(Error::data(format!(
            "expected counts of a {bits}-bit counter, got {} to {}; the counter is wider or was unwrapped already",
            span(f64::min),
            span(f64::max)
        )));
    }
    let mut turns = 0.0;
    let mut last = counts.first().copied().unwrap_or(0.0);
    Ok(counts
        .iter()
        .map(|&c| {
            turns -= ((c - last) / range).round() * range;
            last = c;
            c + turns
        })
        .collect())
}

/// An encoder whose counter stands at zero, `phase` of a count past the last edge, where the position is zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Encoder {
    counts_per_unit: f64,
    phase: f64,
    quantised: bool,
}

impl Encoder {
    /// An encoder with `counts_per_unit` counts per unit of position and `phase` in `[0, 1)` counts.
    pub fn new(counts_per_unit: f64, phase: f64) -> Self {
        Self {
            counts_per_unit,
            phase,
            quantised: true,
        }
    }

    /// The ideal encoder: the position in counts as a real number.
    pub fn ideal(counts_per_unit: f64) -> Self {
        Self {
            counts_per_unit,
            phase: 0.0,
            quantised: false,
        }
    }

    /// Counts per unit of position.
    pub fn counts_per_unit(&self) -> f64 {
        self.counts_per_unit
    }

    /// The counter at `position`: `floor(position counts_per_unit + phase)`, without the floor where ideal.
    #[inline]
    pub fn count(&self, position: f64) -> f64 {
        let exact = position * self.counts_per_unit + self.phase;
        if self.quantised { exact.floor() } else { exact }
    }

    /// The counters at eight positions.
    #[inline(always)]
    pub(crate) fn counts<V: F64x8>(&self, positions: V) -> V {
        let scaled = positions.mul(V::splat(self.counts_per_unit));
        let exact = scaled.add(V::splat(self.phase));
        if self.quantised { exact.floor() } else { exact }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn finds_a_wrap_and_leaves_fast_motion_alone() {
        let wrapped = [65_500.0, 65_530.0, 24.0, 54.0];
        let message = check(&wrapped, 2).unwrap_err().message;
        assert!(message.contains("sample 2") && message.contains("unwrap_bits=16"));
        let fast: Vec<f64> = (0..9).map(|k| 65_536.0 * k as f64).collect();
        assert!(check(&fast, 2).is_ok());
        assert!(check(&[0.0, f64::NAN], 2).is_err());
    }

    #[test]
    fn refuses_a_counter_that_does_not_fit() {
        assert!(unwrap(&[0.0, 70_000.0], 16).is_err());
        assert!(unwrap(&[0.0, 1.0], 0).is_err() && unwrap(&[0.0, 1.0], 53).is_err());
        assert!(unwrap(&[0.0, f64::INFINITY], 16).is_err());
        assert!(unwrap(&[], 16).unwrap().is_empty());
    }

    proptest! {
        #[test]
        fn unwrapping_undoes_wrapping(steps in prop::collection::vec(-30_000i64..30_000, 1..100), start in 0i64..65_536) {
            let path = steps.iter().scan(start, |at, step| { *at += step; Some(*at) });
            let whole: Vec<i64> = std::iter::once(start).chain(path).collect();
            let wrapped: Vec<f64> = whole.iter().map(|c| c.rem_euclid(65_536) as f64).collect();
            let expected: Vec<f64> = whole.iter().map(|&c| c as f64).collect();
            prop_assert_eq!(unwrap(&wrapped, 16).unwrap(), expected);
        }
    }

    #[test]
    fn counts_whole_edges_in_both_directions() {
        let encoder = Encoder::new(10.0, 0.25);
        let counts = [0.0, 0.07, 0.08, -0.02, -0.03].map(|position| encoder.count(position));
        assert_eq!(counts, [0.0, 0.0, 1.0, 0.0, -1.0]);
    }

    #[test]
    fn is_exact_where_ideal() {
        assert_eq!(Encoder::ideal(4.0).count(0.3), 1.2);
    }
}
