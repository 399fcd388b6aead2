//! The number type of the controller: `f32` or `f64`.

use core::fmt::Debug;
use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// What the controller asks of a number; implemented for `f32` and `f64` only.
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
    /// The value for a message.
    fn to_f64(self) -> f64;

    /// The nearest value in `[low, high]`; NaN stays NaN.
    fn limit(self, low: Self, high: Self) -> Self {
        if self < low {
            low
        } else if self > high {
            high
        } else {
            self
        }
    }
}

macro_rules! real {
    ($($float:ident)*) => {$(
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
            fn to_f64(self) -> f64 {
                self.into()
            }
        }
    )*};
}

real!(f32 f64);
