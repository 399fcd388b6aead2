//! A single number, for code that is written over several.

use super::{Arithmetic, Choice, LANES};

impl Arithmetic for f64 {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        value
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self + other
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self - other
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self * other
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self / other
    }

    /// Rounded twice: what is computed one by one uses the plain operations of the language.
    #[inline(always)]
    fn add_product(self, a: Self, b: Self) -> Self {
        self + a * b
    }

    #[inline(always)]
    fn at_most(self, limit: f64) -> Self {
        if self > limit { limit } else { self }
    }

    #[inline(always)]
    fn at_least(self, limit: f64) -> Self {
        if self < limit { limit } else { self }
    }
}

impl Choice for f64 {
    const ALL: u8 = 1;

    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        values[0]
    }

    #[inline(always)]
    fn at_most_each(self, limits: Self) -> Self {
        self.at_most(limits)
    }

    #[inline(always)]
    fn at_least_each(self, limits: Self) -> Self {
        self.at_least(limits)
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
    }

    #[inline(always)]
    fn floor(self) -> Self {
        f64::floor(self)
    }

    #[inline(always)]
    fn if_less(self, other: Self, yes: Self, no: Self) -> Self {
        if self < other { yes } else { no }
    }

    #[inline(always)]
    fn if_equal(self, other: Self, yes: Self, no: Self) -> Self {
        if self == other { yes } else { no }
    }

    #[inline(always)]
    fn are_less(self, other: Self) -> u8 {
        u8::from(self < other)
    }
}
