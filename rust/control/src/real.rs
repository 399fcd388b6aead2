//! The number type of the controller: `f32` or `f64`.

use core::fmt::Debug;
use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

pub(crate) mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// Number type of the controller; implemented for `f32` and `f64` only.
pub trait Real:
    sealed::Sealed
    + Copy
    + Debug
    + Default
    + PartialOrd
    + Add<Output = Self>
    + AddAssign
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// Zero.
    const ZERO: Self;
    /// One.
    const ONE: Self;
    /// Positive infinity, which switches a limit or a filter off.
    const INFINITY: Self;

    /// Neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// A count of samples as a number.
    fn from_count(count: usize) -> Self;
    /// The nearest value.
    fn from_f64(value: f64) -> Self;
    /// The value for a message.
    fn to_f64(self) -> f64;
    /// The hyperbolic tangent ([`model::tanh`](crate::model::tanh)).
    fn tanh(self) -> Self;
    /// The square root to within one unit in the last place; 0 for what is not above 0.
    fn sqrt(self) -> Self;
    /// The largest whole number that is not above it, for magnitudes below 2^53.
    fn floor(self) -> Self;

    /// The nearest value in `[low, high]`; NaN stays NaN. Always two comparisons.
    fn limit(self, low: Self, high: Self) -> Self {
        let raised = if self < low { low } else { self };
        if raised > high { high } else { raised }
    }
}

/// `1 - exp(-x)` for `x` of 0 or more, to a few units in the last place; infinite is 1.
///
/// The series for `x/256`, then eight times `1 - exp(-2h) = q (2 - q)` with `q = 1 - exp(-h)`, which magnifies no
/// relative error.
pub(crate) fn one_minus_exp<T: Real>(x: T) -> T {
    let two = T::ONE + T::ONE;
    // beyond 64, exp(-x) does not show in double precision
    let h = x.limit(T::ZERO, T::from_count(64)) / T::from_count(256);
    // 1 - exp(-h) = h (1 - h/2 (1 - h/3 (1 - ..)))
    let series = (2..=12)
        .rev()
        .fold(T::ONE, |sum, i| T::ONE - h / T::from_count(i) * sum);
    (0..8).fold(h * series, |q, _| q * (two - q))
}

macro_rules! real {
    ($($float:ident $tanh:ident $half:literal),*) => {$(
        impl Real for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            const INFINITY: Self = $float::INFINITY;

            fn is_finite(self) -> bool {
                $float::is_finite(self)
            }
            fn from_count(count: usize) -> Self {
                count as $float
            }
            fn from_f64(value: f64) -> Self {
                value as $float
            }
            fn to_f64(self) -> f64 {
                self.into()
            }
            fn tanh(self) -> Self {
                crate::model::tanh::$tanh(self)
            }
            fn sqrt(self) -> Self {
                if !(self > 0.0 && self < $float::INFINITY) {
                    return if self > 0.0 { self } else { 0.0 };
                }
                // half the exponent gives the root within 7 %; each of Newton's (Heron's) steps doubles the number of digits
                let first = $float::from_bits((self.to_bits() >> 1) + $half);
                (0..4).fold(first, |root, _| 0.5 * (root + self / root))
            }
            fn floor(self) -> Self {
                let whole = self as i64 as $float;
                if whole > self { whole - 1.0 } else { whole }
            }
        }
    )*};
}

real!(f32 single 0x1fc0_0000, f64 double 0x1ff8_0000_0000_0000);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn one_minus_exp_is_that(x in prop_oneof![0.0..1.0, 0.0..100.0, 1e-12..1e-6_f64]) {
            let x: f64 = x;
            let exact = f64::exp_m1(-x).abs();
            prop_assert!((one_minus_exp(x) - exact).abs() <= 8.0 * f64::EPSILON * exact);
            let single = one_minus_exp(x as f32);
            let exact = f64::exp_m1(-f64::from(x as f32)).abs();
            prop_assert!((f64::from(single) - exact).abs() <= 8.0 * f64::from(f32::EPSILON) * exact);
        }
    }

    proptest! {
        #[test]
        fn roots_and_whole_numbers_are_those_of_the_library(x in 0.0..1e12_f64, small in 0.0..1e-6_f64) {
            for x in [x, small] {
                let root = x.sqrt();
                prop_assert!((Real::sqrt(x) - root).abs() <= f64::EPSILON * root);
                let (x, root) = (x as f32, (x as f32).sqrt());
                prop_assert!((Real::sqrt(x) - root).abs() <= f32::EPSILON * root);
            }
            prop_assert_eq!(Real::floor(x), x.floor());
            prop_assert_eq!(Real::floor(-x), (-x).floor());
        }
    }

    #[test]
    fn roots_know_their_ends() {
        assert_eq!(Real::sqrt(-1.0), 0.0);
        assert_eq!(Real::sqrt(f64::NAN), 0.0);
        assert_eq!(Real::sqrt(f64::INFINITY), f64::INFINITY);
    }

    #[test]
    fn one_minus_exp_knows_its_ends() {
        assert_eq!(one_minus_exp(0.0), 0.0);
        assert_eq!(one_minus_exp(f64::INFINITY), 1.0);
    }
}

#[cfg(test)]
pub(crate) mod counted {
    //! A number that counts the operations on it.

    use core::cmp::Ordering;
    use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub};
    use std::cell::Cell;
    use std::thread_local;

    use super::{Real, sealed::Sealed};

    thread_local! {
        static COUNT: Cell<u64> = const { Cell::new(0) };
    }

    fn one_more() {
        COUNT.set(COUNT.get() + 1);
    }

    /// Operations on [`Counted`] numbers within `work`: arithmetic, comparisons, tests for finiteness.
    pub(crate) fn operations(work: impl FnOnce()) -> u64 {
        let before = COUNT.get();
        work();
        COUNT.get() - before
    }

    /// Double precision.
    #[derive(Clone, Copy, Debug, Default)]
    pub(crate) struct Counted(pub(crate) f64);

    impl Sealed for Counted {}

    macro_rules! operators {
        ($($name:ident $function:ident $operator:tt),*) => { $(
            impl $name for Counted {
                type Output = Self;
                fn $function(self, other: Self) -> Self {
                    one_more();
                    Self(self.0 $operator other.0)
                }
            }
        )* };
    }

    operators!(Add add +, Sub sub -, Mul mul *, Div div /);

    impl AddAssign for Counted {
        fn add_assign(&mut self, other: Self) {
            *self = *self + other;
        }
    }

    impl Neg for Counted {
        type Output = Self;
        fn neg(self) -> Self {
            one_more();
            Self(-self.0)
        }
    }

    impl PartialEq for Counted {
        fn eq(&self, other: &Self) -> bool {
            one_more();
            self.0 == other.0
        }
    }

    impl PartialOrd for Counted {
        fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
            one_more();
            self.0.partial_cmp(&other.0)
        }
    }

    impl Real for Counted {
        const ZERO: Self = Self(0.0);
        const ONE: Self = Self(1.0);
        const INFINITY: Self = Self(f64::INFINITY);

        fn is_finite(self) -> bool {
            one_more();
            self.0.is_finite()
        }
        fn from_count(count: usize) -> Self {
            Self(count as f64)
        }
        fn from_f64(value: f64) -> Self {
            Self(value)
        }
        fn to_f64(self) -> f64 {
            self.0
        }
        fn tanh(self) -> Self {
            panic!("a controller has no tanh")
        }
        fn sqrt(self) -> Self {
            Self(self.0.sqrt())
        }
        fn floor(self) -> Self {
            Self(self.0.floor())
        }
    }
}
