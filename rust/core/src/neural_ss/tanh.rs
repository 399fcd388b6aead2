//! The hyperbolic tangent, eight at a time.

use crate::neural::tanh::{LN2, ROUND, SATURATED, TAYLOR};
use crate::simd::Eight;

/// `tanh(x) = m/(m + 2)` with `m = exp(2|x|) - 1`, sign restored: as [`crate::neural::tanh()`], but in groups and with
/// products that are rounded once where the processor can. NaN stays NaN.
#[inline(always)]
pub(super) fn tanh<V: Eight>(x: V) -> V {
    let m = growth(x);
    m.div(m.add(V::splat(2.0))).with_sign(x)
}

/// `1 - tanh(x)^2 = q (2 - q)` with `q = 1 - |tanh(x)|`: near saturation the difference itself has lost its digits.
#[inline(always)]
pub(super) fn rise<V: Eight>(x: V) -> V {
    let two = V::splat(2.0);
    let q = two.div(growth(x).add(two));
    q.mul(two.sub(q))
}

/// `exp(2|x|) - 1`.
#[inline(always)]
fn growth<V: Eight>(x: V) -> V {
    let one = V::splat(1.0);
    let size = x.size_up_to(SATURATED);
    let twice = size.add(size);
    let shifted = V::splat(ROUND).add_product(twice, V::splat(std::f64::consts::LOG2_E));
    let n = shifted.sub(V::splat(ROUND));
    let r = twice
        .add_product(n, V::splat(-LN2[0]))
        .add_product(n, V::splat(-LN2[1]));
    let power = shifted.power_of_two();
    let series = r.add_product(r.mul(r), series(r));
    power.sub(one).add_product(power, series)
}

/// The Taylor sum in Estrin's form: short chains, so that a processor can do several things at once.
#[inline(always)]
fn series<V: Eight>(r: V) -> V {
    let r2 = r.mul(r);
    let r4 = r2.mul(r2);
    let pair = |i: usize| V::splat(TAYLOR[i]).add_product(V::splat(TAYLOR[i + 1]), r);
    let four = |i: usize| pair(i).add_product(pair(i + 2), r2);
    four(0).add_product(r4, four(4).add_product(r4, four(8)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{self, Kernel, LANES};
    use proptest::prelude::*;

    struct Tanh([f64; LANES]);

    struct Rise([f64; LANES]);

    impl Kernel for Rise {
        type Output = [f64; LANES];

        #[inline(always)]
        fn run<V: Eight>(self) -> Self::Output {
            let mut values = self.0;
            rise(V::load(&values)).store(&mut values);
            values
        }
    }

    impl Kernel for Tanh {
        type Output = [f64; LANES];

        #[inline(always)]
        fn run<V: Eight>(self) -> Self::Output {
            let mut values = self.0;
            tanh(V::load(&values)).store(&mut values);
            values
        }
    }

    #[test]
    fn keeps_its_special_values() {
        let special = [
            0.0,
            -0.0,
            f64::INFINITY,
            f64::NEG_INFINITY,
            f64::NAN,
            20.5,
            -300.0,
            1e-300,
        ];
        let values = simd::run(Tanh(special));
        assert_eq!(
            values[..2].iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
            [0, 1 << 63]
        );
        assert_eq!(
            (values[2], values[3], values[5], values[6]),
            (1.0, -1.0, 1.0, -1.0)
        );
        assert!(values[4].is_nan());
        assert_eq!(values[7], 1e-300);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(5_000))]
        #[test]
        fn agrees_with_the_library(x in prop::array::uniform8(-25.0f64..25.0), scale in -12i32..1) {
            let x = x.map(|x| x * 10f64.powi(scale));
            for (own, x) in simd::run(Tanh(x)).iter().zip(x) {
                let library = x.tanh();
                prop_assert!((own - library).abs() <= 4e-15 * library.abs());
                prop_assert!(own.abs() <= 1.0);
            }
        }

        #[test]
        fn its_slope_keeps_its_digits_into_saturation(x in prop::array::uniform8(-300.0f64..300.0)) {
            for (own, x) in simd::run(Rise(x)).iter().zip(x) {
                let expected = 1.0 / x.cosh().powi(2);
                prop_assert!((own - expected).abs() <= 1e-12 * expected, "{own} {expected}");
            }
        }
    }
}
