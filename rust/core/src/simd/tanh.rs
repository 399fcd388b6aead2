//! The hyperbolic tangent, eight at a time: as a quotient, by the shortest dependency chain available on every processor.
//!
//! tanh is odd, so with `s = x^2`
//!
//! ```text
//!   tanh(x) = x P(s) / Q(s)
//! ```
//!
//! with P and Q of degree 7 up to |x| = NEAR and of degree 10 from there to SATURATED, where tanh is 1 to the last bit.
//! The coefficients are minimax fits (tests/golden/tanh.py) in `sewfast_control::model::tanh`, because the code for
//! microcontrollers uses the same: a model's deployed form behaves like the model here.
//!
//! Polynomials are in Estrin's form, `(c0 + c1 s) + s^2 (c2 + c3 s) + s^4 (..)`: more multiplications than Horner's,
//! but a chain of 3 steps instead of 7, and a free run is limited by its chain.
//!
//! There are three methods because there are two kinds of users:
//!
//! | way | of | when | what it costs on AVX-512 |
//! |---|---|---|---|
//! | quotients (here) | every level | single steps, state space; AVX2 and baseline always | 33 operations and a division, chain of 46 cycles |
//! | `pieces` | AVX-512 | free runs: each waits for the last | chain of 36 cycles |
//! | `sums` | AVX-512 | lanes: none waits, throughput counts | 20 operations, half a division |
//!
//! Measured end to end: `sums` reduces a candidate's step from 34.5 to 28.5 cycles (docs/PERFORMANCE.md, Zen 5). The gain of `pieces`
//! depends on the processor: by count it saves 10 of 86 cycles of a free run's sample if a permutation of two registers takes 3 cycles;
//! on a Zen 4, whose registers are half as wide inside, it saves nothing (`free_run` of the kernels' example, least of 300 calls: 22.17
//! ns with, 21.86 without). It may be removed once that holds for the processors whose figures are kept.

#[cfg(target_arch = "x86_64")]
pub(super) mod tables;

use sewfast_control::model::tanh::{
    self, DENOMINATOR, NEAR_DENOMINATOR, NEAR_NUMERATOR, NUMERATOR,
};

use crate::simd::F64x8;

/// From here on `tanh` is 1 to the last bit.
const SATURATED: f64 = tanh::FAR.end;
/// Up to here the shorter [`near`] is used.
const NEAR: f64 = tanh::NEAR.end;

/// `tanh(x)` with a relative error within 1e-15, never beyond +-1; NaN stays NaN. A lane's result does not depend on the others.
///
/// A branch that is almost always predicted keeps the operations for large arguments off the dependency chain.
#[inline(always)]
pub(super) fn tanh<V: F64x8>(x: V) -> V {
    let (size, limit) = (x.abs(), V::splat(NEAR));
    let near = near(x);
    // NaN is not below the limit: it takes the path for large arguments, which passes it on.
    if size.are_less(limit) == u8::MAX {
        return near;
    }
    size.if_less(limit, near, far(x))
}

/// `tanh(x)` below [`NEAR`], where the quotient is below 1.
#[inline(always)]
fn near<V: F64x8>(x: V) -> V {
    let s = x.mul(x);
    let s2 = s.mul(s);
    let s4 = s2.mul(s2);
    // x is multiplied into the numerator's coefficients while its square is still being computed.
    let scaled = |i: usize| x.mul(V::splat(NEAR_NUMERATOR[i]));
    let even = [x, scaled(2), scaled(4), scaled(6)];
    let odd = [scaled(1), scaled(3), scaled(5), scaled(7)];
    // P's constant is 1, so x itself takes its place: small numbers stay unchanged, and -0 stays -0.
    let c = NEAR_DENOMINATOR.map(V::splat);
    // Both need only s, s2 and s4, so numerator and denominator are computed in parallel until the division.
    let numerator = eight(even, odd, s, s2, s4);
    let denominator = eight(
        [c[0], c[2], c[4], c[6]],
        [c[1], c[3], c[5], c[7]],
        s,
        s2,
        s4,
    );
    numerator.div(denominator)
}

/// A polynomial of degree 7 in Estrin's form, with its even and odd coefficients separate.
#[inline(always)]
fn eight<V: F64x8>(even: [V; 4], odd: [V; 4], s: V, s2: V, s4: V) -> V {
    // Chain: s, then s2 and the pairs, then s4 and `low`, then the result: each power is used as soon as it is known.
    // Horner's form would be seven dependent steps.
    let pair = |i: usize| even[i].add_product(odd[i], s);
    let low = pair(0).add_product(pair(1), s2);
    low.add_product(pair(2).add_product(pair(3), s2), s4)
}

/// `tanh(x)` for any size.
///
/// Beyond [`SATURATED`] `P/Q` is held, so its product with `x` exceeds 1, and the last step gives +-1.
#[inline(always)]
fn far<V: F64x8>(x: V) -> V {
    // `at_most` passes NaN, which also goes through the quotient and the limits.
    let s = x.mul(x).at_most(SATURATED * SATURATED);
    let s2 = s.mul(s);
    let s4 = s2.mul(s2);
    let (p, q) = (
        Parts::of(&NUMERATOR, s, s2, s4),
        Parts::of(&DENOMINATOR, s, s2, s4),
    );
    // x is multiplied into the numerator's two parts while the denominator is still being summed: after the quotient it
    // would lengthen the chain by a product.
    let numerator = x.mul(p.low).add_product(x.mul(s4), p.high);
    let denominator = q.low.add_product(s4, q.high);
    // Also needed below SATURATED: from |x| = 10 on rounding can leave the quotient a few units of the last place above
    // 1, and sensitivities use 1 - h^2 as a slope that is not negative.
    numerator.div(denominator).at_most(1.0).at_least(-1.0)
}

/// A polynomial of degree 10 in Estrin's form: `low + s^4 high`.
struct Parts<V> {
    low: V,
    high: V,
}

impl<V: F64x8> Parts<V> {
    #[inline(always)]
    fn of(c: &[f64; 11], s: V, s2: V, s4: V) -> Self {
        let pair = |i: usize| V::splat(c[i]).add_product(V::splat(c[i + 1]), s);
        let four = |i: usize| pair(i).add_product(pair(i + 2), s2);
        let last = pair(8).add_product(V::splat(c[10]), s2);
        Self {
            low: four(0),
            high: four(4).add_product(s4, last),
        }
    }
}

/// `tanh` is 1 long before; from here on its derivative is below 1e-294, too.
const FLAT: f64 = 340.0;
/// Adding this rounds to an integer, which is then in the low bits.
const ROUND: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts; the first has so few bits that its product with a small integer is exact (Cody and Waite 1980).
const LN2: [f64; 2] = [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10];
/// `1/(i + 2)!`: Taylor coefficients of `(exp(r) - 1 - r)/r^2`, exact to rounding for `|r| <= ln(2)/2`.
const TAYLOR: [f64; 12] = [
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

/// `1 - tanh(x)^2 = q (2 - q)` with `q = 1 - |tanh(x)| = 2/(exp(2|x|) + 1)`: near saturation the plain difference has
/// lost its digits.
#[inline(always)]
pub(super) fn rise<V: F64x8>(x: V) -> V {
    let two = V::splat(2.0);
    // exp(2|x|) + 1 from exp(2|x|) - 1: for small x the latter has all its digits, and for large x they are the same.
    // With |tanh| = 1 - q, 1 - tanh^2 = (1 - |tanh|)(1 + |tanh|) = q (2 - q).
    let q = two.div(growth(x).add(two));
    q.mul(two.sub(q))
}

/// `exp(2|x|) - 1`.
#[inline(always)]
fn growth<V: F64x8>(x: V) -> V {
    let one = V::splat(1.0);
    // 2 * 340 * log2(e) = 981 is below 1023, so 2^n is a normal number.
    let size = x.abs().at_most(FLAT);
    let twice = size.add(size);
    // 2|x| = n ln 2 + r with |r| <= ln(2)/2, and exp(2|x|) = 2^n exp(r). ROUND is 1.5 * 2^52: the sum's spacing is 1
    // and its lowest bits are n, which `power_of_two` uses without a conversion.
    let shifted = V::splat(ROUND).add_product(twice, V::splat(std::f64::consts::LOG2_E));
    let n = shifted.sub(V::splat(ROUND));
    // The large part first: its product and the difference are exact, so only the small part rounds.
    let r = twice
        .add_product(n, V::splat(-LN2[0]))
        .add_product(n, V::splat(-LN2[1]));
    let power = shifted.power_of_two();
    let series = r.add_product(r.mul(r), series(r));
    // 2^n exp(r) - 1 = (2^n - 1) + 2^n (exp(r) - 1): both parts are exact or small; for n = 0 the first is 0.
    power.sub(one).add_product(power, series)
}

/// The Taylor sum in Estrin's form: short chains that the processor can overlap.
#[inline(always)]
fn series<V: F64x8>(r: V) -> V {
    let r2 = r.mul(r);
    let r4 = r2.mul(r2);
    let pair = |i: usize| V::splat(TAYLOR[i]).add_product(V::splat(TAYLOR[i + 1]), r);
    let four = |i: usize| pair(i).add_product(pair(i + 2), r2);
    four(0).add_product(r4, four(4).add_product(r4, four(8)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Kernel, LANES, Level, run_everywhere};
    use proptest::prelude::*;

    struct Tanh([f64; LANES]);

    struct Rise([f64; LANES]);

    impl Kernel for Rise {
        type Output = [f64; LANES];

        #[inline(always)]
        fn run<V: F64x8>(self) -> Self::Output {
            let mut values = self.0;
            rise(V::load(&values)).store(&mut values);
            values
        }
    }

    struct Chained([f64; LANES]);

    impl Kernel for Chained {
        type Output = [f64; LANES];

        #[inline(always)]
        fn run<V: F64x8>(self) -> Self::Output {
            let mut values = self.0;
            V::load(&values).tanh_in_chain().store(&mut values);
            values
        }
    }

    /// Each number as the first, or as the last, of four, with different other numbers.
    struct OfFour([f64; LANES], bool);

    impl Kernel for OfFour {
        type Output = [f64; LANES];

        #[inline(always)]
        fn run<V: F64x8>(self) -> Self::Output {
            let mut values = self.0;
            let own = V::load(&values);
            let other = own.mul(V::splat(0.3));
            let x = [own, other, other, own];
            let found = V::tanh_of_four(x);
            found[if self.1 { 3 } else { 0 }].store(&mut values);
            values
        }
    }

    struct Neighbours([f64; LANES]);

    impl Kernel for Neighbours {
        type Output = ([f64; LANES], [f64; LANES]);

        #[inline(always)]
        fn run<V: F64x8>(self) -> Self::Output {
            let (mut alone, mut four) = (self.0, self.0);
            V::load(&self.0).tanh_as_of_four().store(&mut alone);
            for half in [0, 4] {
                let mut place = [0.0; LANES];
                let one = |i: usize| V::splat(self.0[half + i]);
                let found = V::tanh_of_four([one(0), one(1), one(2), one(3)]);
                for i in 0..4 {
                    found[i].store(&mut place);
                    four[half + i] = place[i];
                }
            }
            (alone, four)
        }
    }

    /// Every method on every level.
    fn everywhere(x: [f64; LANES]) -> Vec<(Level, [f64; LANES])> {
        let mut all = run_everywhere(|| Tanh(x));
        all.extend(run_everywhere(|| Chained(x)));
        all.extend(run_everywhere(|| OfFour(x, false)));
        all.extend(run_everywhere(|| OfFour(x, true)));
        all
    }

    fn neighbours_are_as_of_four(x: [f64; LANES]) {
        for (level, (alone, four)) in run_everywhere(|| Neighbours(x)) {
            let bits = |values: [f64; LANES]| values.map(f64::to_bits);
            let nan = x.iter().any(|x| x.is_nan());
            assert!(
                nan || bits(alone) == bits(four),
                "{level:?} {x:?} {alone:?} {four:?}"
            );
        }
    }

    impl Kernel for Tanh {
        type Output = [f64; LANES];

        #[inline(always)]
        fn run<V: F64x8>(self) -> Self::Output {
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
        for (level, values) in everywhere(special) {
            let zeros = [values[0].to_bits(), values[1].to_bits()];
            assert_eq!(zeros, [0, 1 << 63], "{level:?}");
            let saturated = [values[2], values[3], values[5], values[6]];
            assert_eq!(saturated, [1.0, -1.0, 1.0, -1.0]);
            assert!(values[4].is_nan());
            assert_eq!(values[7], 1e-300);
        }
    }

    fn agrees_with_the_library(x: [f64; LANES]) {
        for (level, values) in everywhere(x) {
            for (own, x) in values.iter().zip(x) {
                let (library, difference) = (x.tanh(), (own - x.tanh()).abs());
                // the library itself errs by up to one unit in the last place
                assert!(
                    difference <= 1.2e-15 * library.abs() && own.abs() <= 1.0,
                    "{level:?} {x} {own} {library}"
                );
            }
        }
    }

    #[test]
    fn hardly_jumps_where_its_pieces_meet() {
        for edge in (1..160).map(|eighths| f64::from(eighths) / 8.0) {
            let beside = |i: usize| f64::from_bits(edge.to_bits() + i as u64 - 4);
            let x: [f64; LANES] = std::array::from_fn(beside);
            agrees_with_the_library(x);
            for (level, values) in everywhere(x) {
                let falls = values.windows(2).map(|pair| pair[0] - pair[1]);
                let most = falls.fold(0.0, f64::max);
                assert!(most <= 1e-15 * values[0], "{level:?} {edge} {most}");
            }
        }
    }

    #[test]
    fn a_lane_does_not_know_the_others() {
        let sizes = [0.3, -3.8, 3.9, 7.9, -8.1, 19.0, 1e-9, -40.0];
        let mixed = everywhere(sizes);
        for (lane, x) in sizes.into_iter().enumerate() {
            for ((level, alone), (_, mixed)) in everywhere([x; LANES]).iter().zip(&mixed) {
                assert_eq!(*alone, [mixed[lane]; LANES], "{level:?} {x}");
            }
        }
    }

    proptest! {
        #![proptest_config(crate::laws::cases(5_000))]
        #[test]
        fn agrees_with_the_library_at_any_scale(x in prop::array::uniform8(-25.0f64..25.0), scale in -12i32..1) {
            agrees_with_the_library(x.map(|x| x * 10f64.powi(scale)));
        }

        #[test]
        fn agrees_with_the_library_where_networks_work(x in prop::array::uniform8(-4.0f64..4.0)) {
            agrees_with_the_library(x);
            neighbours_are_as_of_four(x);
        }

        #[test]
        fn is_bounded_and_odd_at_any_size(bits in prop::array::uniform8(any::<u64>())) {
            let x = bits.map(f64::from_bits);
            neighbours_are_as_of_four(x);
            for ((_, values), (_, mirrored)) in
                everywhere(x).into_iter().zip(everywhere(x.map(|x| -x)))
            {
                for ((own, mirrored), x) in values.iter().zip(mirrored).zip(x) {
                    prop_assert!(own.is_nan() == x.is_nan());
                    prop_assert!(x.is_nan() || own.abs() <= 1.0 && -own == mirrored);
                }
            }
        }

        #[test]
        fn its_slope_keeps_its_digits_into_saturation(x in prop::array::uniform8(-300.0f64..300.0)) {
            for (_, values) in run_everywhere(|| Rise(x)) {
                for (own, x) in values.iter().zip(x) {
                    let expected = 1.0 / x.cosh().powi(2);
                    prop_assert!((own - expected).abs() <= 1e-12 * expected, "{own} {expected}");
                }
            }
        }
    }
}
