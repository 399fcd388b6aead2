//! Speed from encoder counts. Here: the counts (scale, checks, unwrapping), differences and Savitzky-Golay. In
//! `kalman`: a Kalman filter with its smoother; in `ripple`: loads that repeat over the turn.

mod kalman;
mod ripple;

use nalgebra::DMatrix;

use crate::simd::F64x8;
use crate::{Error, Result};

pub use kalman::Kalman;

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
fn check(counts: &[f64], at_least: usize) -> Result<()> {
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

/// Counts of a `bits`-bit counter as one continuous count: every step is the shortest one modulo `2^bits`.
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

/// An encoder whose counter is zero at position zero, `phase` of a count past the last edge.
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

    /// The ideal encoder: the position in counts, as a real number.
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

    /// The counter at `position`: `floor(position counts_per_unit + phase)`, without the floor if ideal.
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

/// Backward difference `(c(k) - c(k-1)) / (Ts counts_per_unit)`; the first sample repeats the second.
///
/// # Errors
/// `ErrorKind::Data` for fewer than two counts, or counts that are not finite or jump like a wrapped counter.
pub fn difference(counts: &[f64], scale: Scale) -> Result<Vec<f64>> {
    check(counts, 2)?;
    let factor = scale.per_count();
    let first = counts[1] - counts[0];
    let rest = counts.windows(2).map(|w| w[1] - w[0]);
    Ok(std::iter::once(first)
        .chain(rest)
        .map(|d| d * factor)
        .collect())
}

/// The widest window: wider ones cost seconds and average over motion anyway.
const MAX_WINDOW: usize = 10_001;
/// The highest order of the local polynomial.
const MAX_ORDER: usize = 15;

/// Derivative of the polynomial of `order` fitted by least squares to the `window` counts around each sample.
///
/// Within half a window of an end, the polynomial of the first or last whole window is differentiated there. Polynomial
/// motion of that order is therefore exact everywhere (Savitzky and Golay, Anal. Chem. 36, 1964).
///
/// # Errors
/// `ErrorKind::Setting` for an even window, one outside 3 to 10,001, or an order outside 1 to `window - 1` (15 at
/// most); `ErrorKind::Data` for fewer counts than the window, or counts that cannot be used.
pub fn savgol(counts: &[f64], scale: Scale, window: usize, order: usize) -> Result<Vec<f64>> {
    settings(window, order)?;
    check(counts, window)?;
    let (factor, half, n) = (scale.per_count(), window / 2, counts.len());
    let weights = Weights::new(window, order);
    let mut speed = vec![0.0; n];
    let centre = weights.at(half);
    for (v, around) in speed[half..].iter_mut().zip(counts.windows(window)) {
        // Relative to the middle, so that a large count costs no digits.
        let middle = around[half];
        *v = factor * dot(&centre, around, middle);
    }
    let (head, tail) = (&counts[..window], &counts[n - window..]);
    for k in 0..half {
        speed[k] = factor * weights.slope(head, k);
        speed[n - half + k] = factor * weights.slope(tail, half + 1 + k);
    }
    Ok(speed)
}

fn settings(window: usize, order: usize) -> Result<()> {
    if window.is_multiple_of(2) || !(3..=MAX_WINDOW).contains(&window) {
        return Err(Error::setting(format!(
            "expected an odd window of 3 to {MAX_WINDOW} samples, got {window}; try {}",
            (window | 1).clamp(3, MAX_WINDOW)
        )));
    }
    if order == 0 || order >= window || order > MAX_ORDER {
        return Err(Error::setting(format!(
            "expected an order of 1 to {}, got {order}; 3 suits most motion",
            MAX_ORDER.min(window - 1)
        )));
    }
    Ok(())
}

fn dot(weights: &[f64], counts: &[f64], middle: f64) -> f64 {
    let terms = weights.iter().zip(counts);
    terms.map(|(w, c)| w * (c - middle)).sum()
}

/// Least squares over one window in Legendre polynomials of `x` in [-1, 1], which are well conditioned.
struct Weights {
    /// Coefficients from samples, `(order + 1) x window`.
    fit: DMatrix<f64>,
    /// Derivatives of the polynomials with respect to the sample number, `window x (order + 1)`.
    slopes: DMatrix<f64>,
}

impl Weights {
    fn new(window: usize, order: usize) -> Self {
        let half = (window / 2) as f64;
        let x = |k: usize| k as f64 / half - 1.0;
        let values = DMatrix::from_fn(window, order + 1, |k, j| legendre(j, x(k)).0);
        let slopes = DMatrix::from_fn(window, order + 1, |k, j| legendre(j, x(k)).1 / half);
        let qr = values.qr();
        let mut fit = qr.q().transpose();
        // R has a zero on its diagonal only if order >= window, which the settings exclude.
        qr.r().solve_upper_triangular_mut(&mut fit);
        Self { fit, slopes }
    }

    /// The weights of the counts for the slope at sample `k` of the window.
    fn at(&self, k: usize) -> Vec<f64> {
        (self.slopes.row(k) * &self.fit).iter().copied().collect()
    }

    fn slope(&self, counts: &[f64], k: usize) -> f64 {
        dot(&self.at(k), counts, counts[counts.len() / 2])
    }
}

/// Legendre polynomial `P_j(x)` and its derivative, by Bonnet's recursion.
fn legendre(j: usize, x: f64) -> (f64, f64) {
    let (mut p, mut d) = ([1.0, x], [0.0, 1.0]);
    for i in 1..j {
        let i = i as f64;
        let next = ((2.0 * i + 1.0) * x * p[1] - i * p[0]) / (i + 1.0);
        let slope = d[0] + (2.0 * i + 1.0) * p[1];
        (p, d) = ([p[1], next], [d[1], slope]);
    }
    if j == 0 { (1.0, 0.0) } else { (p[1], d[1]) }
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

    #[test]
    fn differences_in_the_unit() {
        let scale = Scale::new(1e-3, 26.2).unwrap();
        let v = difference(&[5.0, 5.0, 7.0], scale).unwrap();
        assert_eq!(v[..2], [0.0, 0.0]);
        assert!((v[2] - 2.0 * 38.167_938_931).abs() < 1e-6);
        assert!(difference(&[1.0], scale).is_err());
    }

    fn scale() -> Scale {
        Scale::new(1.0, 1.0).unwrap()
    }

    #[test]
    fn has_the_published_weights() {
        // Savitzky and Golay 1964, table for the first derivative, quadratic, 5 and 7 points.
        let five = Weights::new(5, 2).at(2);
        let expected = [-0.2, -0.1, 0.0, 0.1, 0.2];
        assert!(
            five.iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-14)
        );
        let seven = Weights::new(7, 3).at(3);
        let expected = [22.0, -67.0, -58.0, 0.0, 58.0, 67.0, -22.0].map(|v| v / 252.0);
        assert!(
            seven
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-14)
        );
    }

    #[test]
    fn refuses_windows_and_orders_without_meaning() {
        let counts = vec![0.0; 50];
        for (window, order) in [(4, 2), (1, 1), (5, 5), (5, 0), (41, 16), (20_001, 3)] {
            assert!(
                savgol(&counts, scale(), window, order).is_err(),
                "{window} {order}"
            );
        }
        assert!(savgol(&counts, scale(), 51, 3).is_err());
        assert!(savgol(&counts, scale(), 49, 3).is_ok());
    }

    proptest! {
        #[test]
        fn polynomial_motion_is_exact_up_to_the_ends(
            half in 2usize..60, order in 1usize..4, a in -1e3..1e3f64, b in -5.0..5.0f64, c in -0.1..0.1f64, d in -1e-3..1e-3f64,
        ) {
            let window = 2 * half + 1;
            let (c, d) = (if order > 1 { c } else { 0.0 }, if order > 2 { d } else { 0.0 });
            let position = |k: usize| { let t = k as f64; a + t * (b + t * (c + t * d)) };
            let counts: Vec<f64> = (0..window + 30).map(position).collect();
            let speed = savgol(&counts, scale(), window, order).unwrap();
            for (k, v) in speed.iter().enumerate() {
                let t = k as f64;
                let truth = b + t * (2.0 * c + 3.0 * t * d);
                prop_assert!((v - truth).abs() < 1e-8 * (1.0 + truth.abs()), "{k}: {v} {truth}");
            }
        }
    }
}
