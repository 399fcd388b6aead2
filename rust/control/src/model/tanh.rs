//! The hyperbolic tangent for microcontrollers: a quotient of polynomials, using only `+ - * /` and comparisons.
//!
//! `tanh(x)/x = P(s)/Q(s)` with `s = x^2` (Remez's algorithm with 60 digits, `tests/golden/tanh.py`). All coefficients
//! are positive, so nothing cancels.

/// A quotient's coefficients, the constant first, with a bound for its argument.
#[derive(Clone, Copy, Debug)]
pub struct Quotient<T: 'static> {
    /// `P`.
    pub numerator: &'static [T],
    /// `Q`.
    pub denominator: &'static [T],
    /// The largest magnitude of an argument for which it was made.
    pub end: T,
}

/// Double precision for the usual arguments in networks, below 8: a relative error of 1.1e-17.
pub const NEAR: Quotient<f64> = Quotient {
    numerator: &NEAR_NUMERATOR,
    denominator: &NEAR_DENOMINATOR,
    end: 8.0,
};
/// Double precision up to where `tanh` is 1 to the last bit: a relative error of 2.5e-18.
pub const FAR: Quotient<f64> = Quotient {
    numerator: &NUMERATOR,
    denominator: &DENOMINATOR,
    end: 19.1,
};
/// Single precision up to where `tanh` is 1 to the last bit: a relative error of 6.2e-8, half a unit in the last place.
pub const SINGLE: Quotient<f32> = Quotient {
    numerator: &SINGLE_NUMERATOR,
    denominator: &SINGLE_DENOMINATOR,
    end: 9.1,
};

/// Of [`FAR`].
pub const NUMERATOR: [f64; 11] = [
    1.0,
    0.15342010899213995,
    0.006218719727800223,
    0.00010308332400821754,
    8.279151667440908e-07,
    3.4541114898965334e-09,
    7.560627214653178e-12,
    8.307073685177713e-15,
    4.069825331388988e-18,
    6.773230739311428e-22,
    1.615141015295681e-26,
];
/// Of [`FAR`].
pub const DENOMINATOR: [f64; 11] = [
    1.0,
    0.4867534423254733,
    0.03513653383629132,
    0.000883056260962854,
    1.0053683169986197e-05,
    5.7931712066037706e-08,
    1.7541773556984035e-10,
    2.7458456140969587e-13,
    2.057898725685464e-16,
    6.18199285124705e-20,
    4.764238210598914e-24,
];
/// Of [`NEAR`].
pub const NEAR_NUMERATOR: [f64; 8] = [
    1.0,
    0.14881781282238896,
    0.00553061499956883,
    7.715039209671254e-05,
    4.5470732847987743e-07,
    1.099905863206026e-09,
    8.807499367377642e-13,
    1.0228779747038627e-16,
];
/// Of [`NEAR`].
pub const NEAR_DENOMINATOR: [f64; 8] = [
    1.0,
    0.4821511461557223,
    0.032914330384809606,
    0.0007300283345242129,
    6.5870715235225754e-06,
    2.518690175001794e-08,
    3.666532835695883e-11,
    1.3626929902246258e-14,
];
/// Of [`SINGLE`].
pub const SINGLE_NUMERATOR: [f32; 5] = [1.0, 0.13346742, 0.0034549776, 1.99519e-05, 1.2477821e-08];
/// Of [`SINGLE`].
pub const SINGLE_DENOMINATOR: [f32; 5] = [1.0, 0.4668006, 0.025722131, 0.0003219611, 7.4098875e-07];

/// `tanh(x)` in double precision, bit for bit as networks compute it on a processor without fused multiply-add.
///
/// Polynomials are in Estrin's form, as there, for short chains.
pub(crate) fn double(x: f64) -> f64 {
    let size = if x < 0.0 { -x } else { x };
    if size < NEAR.end { near(x) } else { far(x) }
}

fn near(x: f64) -> f64 {
    let s = x * x;
    let (s2, c) = (s * s, NEAR_DENOMINATOR);
    let s4 = s2 * s2;
    // x is multiplied into the numerator's coefficients; meanwhile its square is computed
    eight(NEAR_NUMERATOR.map(|c| x * c), s, s2, s4) / eight(c, s, s2, s4)
}

fn eight(c: [f64; 8], s: f64, s2: f64, s4: f64) -> f64 {
    let low = (c[0] + c[1] * s) + (c[2] + c[3] * s) * s2;
    let high = (c[4] + c[5] * s) + (c[6] + c[7] * s) * s2;
    low + high * s4
}

fn far(x: f64) -> f64 {
    let s = x * x;
    let s = if s > FAR.end * FAR.end {
        FAR.end * FAR.end
    } else {
        s
    };
    let s2 = s * s;
    let s4 = s2 * s2;
    let ((p_low, p_high), (q_low, q_high)) = (
        eleven(&NUMERATOR, s, s2, s4),
        eleven(&DENOMINATOR, s, s2, s4),
    );
    held((x * p_low + x * s4 * p_high) / (q_low + s4 * q_high))
}

/// `low + s^4 high`.
fn eleven(c: &[f64; 11], s: f64, s2: f64, s4: f64) -> (f64, f64) {
    let low = (c[0] + c[1] * s) + (c[2] + c[3] * s) * s2;
    let four = (c[4] + c[5] * s) + (c[6] + c[7] * s) * s2;
    (low, four + s4 * ((c[8] + c[9] * s) + c[10] * s2))
}

fn held(t: f64) -> f64 {
    let t = if t > 1.0 { 1.0 } else { t };
    if t < -1.0 { -1.0 } else { t }
}

/// `tanh(x)` in single precision, within 3 units in the last place, never beyond +-1.
pub(crate) fn single(x: f32) -> f32 {
    let s = x * x;
    let s = if s > SINGLE.end * SINGLE.end {
        SINGLE.end * SINGLE.end
    } else {
        s
    };
    let horner = |c: [f32; 5]| c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * c[4])));
    let t = x * horner(SINGLE_NUMERATOR) / horner(SINGLE_DENOMINATOR);
    let t = if t > 1.0 { 1.0 } else { t };
    if t < -1.0 { -1.0 } else { t }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn agrees_with_the_library(x in prop_oneof![-25.0..25.0, -1e-3..1e-3_f64], scale in -12i32..1) {
            let x: f64 = x * 10f64.powi(scale);
            prop_assert!((double(x) - x.tanh()).abs() <= 1.2e-15 * x.tanh().abs());
            let (x, exact) = (x as f32, f64::from(x as f32).tanh());
            let error = (f64::from(single(x)) - exact).abs();
            prop_assert!(error <= 3.0 * f64::from(f32::EPSILON) * exact.abs(), "{x} {error}");
        }

        #[test]
        fn is_bounded_and_odd(x in any::<f64>()) {
            prop_assert!(double(x).abs() <= 1.0 && double(-x) == -double(x));
            let x = x as f32;
            prop_assert!(single(x).abs() <= 1.0 && single(-x) == -single(x));
        }
    }

    #[test]
    fn keeps_its_special_values() {
        assert_eq!(
            [double(0.0), double(30.0), double(-1e300)],
            [0.0, 1.0, -1.0]
        );
        assert_eq!([single(0.0), single(30.0), single(-1e30)], [0.0, 1.0, -1.0]);
        assert_eq!(double(-0.0).to_bits(), 1 << 63);
        assert!(double(f64::NAN).is_nan() && single(f32::NAN).is_nan());
        assert_eq!([double(f64::INFINITY), double(-f64::INFINITY)], [1.0, -1.0]);
        assert_eq!(single(f32::INFINITY), 1.0);
    }
}
