//! A tanh without branches or library calls: the same bits on every platform, and four at a time.

/// `tanh` is 1 to the last bit from 20 on; from here on its derivative is below 1e-294, too.
pub(crate) const SATURATED: f64 = 340.0;
/// Adding this rounds to an integer, which is then found in the low bits.
pub(crate) const ROUND: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts; the first has so few bits that its product with a small integer is exact (Cody and Waite 1980).
pub(crate) const LN2: [f64; 2] = [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10];
/// `1/(i + 2)!`: Taylor coefficients of `(exp(r) - 1 - r)/r^2`, exact to rounding for `|r| <= ln(2)/2`.
pub(crate) const TAYLOR: [f64; 12] = [
    1.0 / 2.0,
    1.0 / 6.0,
    1.0 / 24.0,
    1.0 / 120.0,
    1.0 / 720.0,
    1.0 / 5_040.0,
    1.0 / 40_320.0,
    1.0 / 362_880.0,
    1.0 / 3_628_800.0,
    1.0 / 39_916_800.0,
    1.0 / 479_001_600.0,
    1.0 / 6_227_020_800.0,
];

/// `tanh(x) = m/(m + 2)` with `m = exp(2|x|) - 1`, sign restored; within 1e-15 of the true value, NaN stays NaN.
#[inline(always)]
pub fn tanh(x: f64) -> f64 {
    from_growth(growth(x), x)
}

/// `tanh(x)` from `growth(x)`.
#[inline(always)]
pub(super) fn from_growth(m: f64, x: f64) -> f64 {
    (m / (m + 2.0)).copysign(x)
}

/// `d tanh(x)/dx = 1 - tanh(x)^2 = q (2 - q)` with `q = 1 - |tanh(x)| = 2/(m + 2)`, from `m = growth(x)`.
///
/// Near saturation `1 - h * h` has lost the digits that this one keeps.
#[inline(always)]
pub(super) fn slope(m: f64) -> f64 {
    let q = 2.0 / (m + 2.0);
    q * (2.0 - q)
}

/// `exp(2|x|) - 1`.
#[inline(always)]
pub(super) fn growth(x: f64) -> f64 {
    let size = x.abs();
    // A comparison rather than `min`, which would turn NaN into a number.
    let twice = 2.0 * if size > SATURATED { SATURATED } else { size };
    let shifted = twice * std::f64::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (twice - n * LN2[0]) - n * LN2[1];
    let power = f64::from_bits((shifted.to_bits() << 52).wrapping_add(1023 << 52));
    power * (r + r * r * series(r)) + (power - 1.0)
}

/// The Taylor sum in Estrin's form: short chains, so that a processor can do several things at once.
#[inline(always)]
fn series(r: f64) -> f64 {
    let (r2, c) = (r * r, &TAYLOR);
    let r4 = r2 * r2;
    let low = (c[0] + c[1] * r) + (c[2] + c[3] * r) * r2;
    let middle = (c[4] + c[5] * r) + (c[6] + c[7] * r) * r2;
    let high = (c[8] + c[9] * r) + (c[10] + c[11] * r) * r2;
    low + r4 * (middle + r4 * high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn keeps_its_special_values() {
        assert_eq!(tanh(0.0).to_bits(), 0.0f64.to_bits());
        assert_eq!(tanh(-0.0).to_bits(), (-0.0f64).to_bits());
        assert_eq!((tanh(f64::INFINITY), tanh(f64::NEG_INFINITY)), (1.0, -1.0));
        assert!(tanh(f64::NAN).is_nan());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]
        #[test]
        fn agrees_with_the_library(x in -25.0f64..25.0) {
            let (own, library) = (tanh(x), x.tanh());
            prop_assert!((own - library).abs() <= 1e-15);
            prop_assert!((own - library).abs() <= 4e-15 * library.abs());
            prop_assert!(own.abs() <= 1.0);
            prop_assert_eq!(tanh(-x).to_bits(), (-own).to_bits());
        }

        #[test]
        fn its_slope_keeps_its_digits_into_saturation(x in -300.0f64..300.0) {
            let expected = 1.0 / x.cosh().powi(2);
            let slope = slope(growth(x));
            prop_assert!((slope - expected).abs() <= 1e-12 * expected, "{slope} {expected}");
        }

        #[test]
        fn is_bounded_and_relative_at_any_size(bits in any::<u64>()) {
            let x = f64::from_bits(bits);
            prop_assume!(!x.is_nan());
            prop_assert!(tanh(x).abs() <= 1.0);
            prop_assert!((tanh(x) - x.tanh()).abs() <= 4e-15 * x.tanh().abs());
        }
    }
}
