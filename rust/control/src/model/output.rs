//! The output function of a state-space model; the equations are in docs/CONVENTIONS.md.

use crate::Real;

/// The output function `y = f(s)`, in scaled units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Output<T> {
    /// `f(s) = s`.
    Linear,
    /// Limits with smooth corners.
    Saturation {
        /// Lower limit.
        low: T,
        /// Upper limit.
        high: T,
        /// Width of a corner.
        width: T,
    },
    /// `f(s) = sqrt(s^2 + w^2)`.
    Abs {
        /// Width of the corner.
        width: T,
    },
}

impl<T: Real> Output<T> {
    /// The output.
    pub fn value(self, s: T) -> T {
        match self {
            Self::Linear => s,
            Self::Saturation { low, high, width } => saturated(s, low, high, width),
            Self::Abs { width } => hypotenuse(s, width),
        }
    }
}

fn half<T: Real>() -> T {
    T::ONE / (T::ONE + T::ONE)
}

fn size<T: Real>(x: T) -> T {
    if x < T::ZERO { -x } else { x }
}

/// Expanded about the nearer limit: about the other one it would subtract large numbers.
fn saturated<T: Real>(s: T, low: T, high: T, width: T) -> T {
    let middle = low + half::<T>() * (high - low);
    let (base, first, second) = if s < middle {
        (low, s - low, s - high)
    } else {
        (high, low - s, high - s)
    };
    base + width * (softplus(first / width) - softplus(second / width))
}

/// `log(1 + e^z) = max(z, 0) + log(1 + e^-|z|)`.
fn softplus<T: Real>(z: T) -> T {
    // e^-a = (1 - t)/(1 + t) with t = tanh(a/2); its rounding is small compared with the result
    let t = (half::<T>() * size(z)).tanh();
    let e = (T::ONE - t) / (T::ONE + t);
    let positive = if z > T::ZERO { z } else { T::ZERO };
    // NaN is not above 0, but must not be lost
    let positive = if z.is_finite() { positive } else { z };
    positive + log_one_plus(e)
}

/// `log(1 + e)` for `e` from 0 to 1: `2 artanh(q)` with `q = e/(2 + e)` up to a third, by its series.
fn log_one_plus<T: Real>(e: T) -> T {
    let q = e / (T::ONE + T::ONE + e);
    let square = q * q;
    let sum = (0..18).rev().fold(T::ZERO, |sum, i| {
        T::ONE / T::from_count(2 * i + 1) + square * sum
    });
    (q + q) * sum
}

/// `sqrt(a^2 + b^2)` without overflow: the larger one times the root of a number from 1 to 2.
fn hypotenuse<T: Real>(a: T, b: T) -> T {
    let (a, b) = (size(a), size(b));
    let (large, small) = if a < b { (b, a) } else { (a, b) };
    let ratio = if large > T::ZERO && large.is_finite() {
        small / large
    } else {
        T::ZERO
    };
    let x = T::ONE + ratio * ratio;
    // a straight line within 1 %, then Newton's (Heron's) steps, each of which doubles the number of digits
    let line = T::from_count(42) / T::from_count(100) + T::from_count(59) / T::from_count(100) * x;
    large * (0..4).fold(line, |root, _| half::<T>() * (root + x / root))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn agrees_with_the_library(s in -50.0..50.0_f64, width in 0.01..2.0_f64) {
            let own: f64 = Output::Abs { width }.value(s);
            prop_assert!((own - s.hypot(width)).abs() <= 4.0 * f64::EPSILON * own);
            let single = Output::Abs { width: width as f32 }.value(s as f32);
            prop_assert!((f64::from(single) - own).abs() <= 8.0 * f64::from(f32::EPSILON) * own);
            let (low, high) = (-1.0, 2.0);
            let p = |z: f64| z.max(0.0) + (-z.abs()).exp().ln_1p();
            let expected = if s < 0.5 {
                low + width * (p((s - low) / width) - p((s - high) / width))
            } else {
                high + width * (p((low - s) / width) - p((high - s) / width))
            };
            let own = Output::Saturation { low, high, width }.value(s);
            prop_assert!((own - expected).abs() <= 1e-14, "{} {}", own, expected);
        }
    }

    #[test]
    fn keeps_what_is_no_number() {
        let soft = Output::Saturation {
            low: -1.0,
            high: 2.0,
            width: 0.1,
        };
        assert!(soft.value(f64::NAN).is_nan());
        assert!(Output::Abs { width: 0.1 }.value(f64::NAN).is_nan());
        assert_eq!(
            Output::Abs { width: 0.1 }.value(-f64::INFINITY),
            f64::INFINITY
        );
        let large = Output::Abs { width: 1e300 }.value(1e300);
        assert!((large / 1e300 - core::f64::consts::SQRT_2).abs() < 1e-15);
    }
}
