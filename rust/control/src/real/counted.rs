//! A number that counts what is done with it.

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
}
