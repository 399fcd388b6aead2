//! Eight numbers for the baseline of any processor.

use super::{Arithmetic, F64x8, LANES, tanh};

#[derive(Clone, Copy)]
pub(super) struct Plain([f64; LANES]);

impl Plain {
    /// Written out: in kernels this large the compiler does not inline `array::from_fn` and `map`.
    #[inline(always)]
    fn each(self, f: impl Fn(usize, f64) -> f64) -> Self {
        let v = self.0;
        Self([
            f(0, v[0]),
            f(1, v[1]),
            f(2, v[2]),
            f(3, v[3]),
            f(4, v[4]),
            f(5, v[5]),
            f(6, v[6]),
            f(7, v[7]),
        ])
    }

    #[inline(always)]
    fn with(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        self.each(|i, v| f(v, other.0[i]))
    }
}

impl Arithmetic for Plain {
    const ALL: u8 = u8::MAX;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.with(other, |a, b| a / b)
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(|_, v| v.sqrt())
    }

    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        Self(*values)
    }

    #[inline(always)]
    fn at_most_each(self, limits: Self) -> Self {
        self.with(limits, |v, limit| if v > limit { limit } else { v })
    }

    #[inline(always)]
    fn at_least_each(self, limits: Self) -> Self {
        self.with(limits, |v, limit| if v < limit { limit } else { v })
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.each(|_, v| v.abs())
    }

    #[inline(always)]
    fn if_less(self, other: Self, yes: Self, no: Self) -> Self {
        self.each(|i, v| if v < other.0[i] { yes.0[i] } else { no.0[i] })
    }

    #[inline(always)]
    fn if_equal(self, other: Self, yes: Self, no: Self) -> Self {
        self.each(|i, v| if v == other.0[i] { yes.0[i] } else { no.0[i] })
    }

    #[inline(always)]
    fn are_less(self, other: Self) -> u8 {
        (0..LANES).fold(0, |bits, i| bits | u8::from(self.0[i] < other.0[i]) << i)
    }

    #[inline(always)]
    fn each(self, of: impl Fn(f64) -> f64) -> Self {
        Self(self.0.map(of))
    }
}

impl F64x8 for Plain {
    const TILE_ROWS: usize = 2;

    #[inline(always)]
    fn add_product(self, a: Self, b: Self) -> Self {
        // 64-bit ARM has it in its baseline; elsewhere it would be a call.
        if cfg!(target_arch = "aarch64") {
            return self.each(|i, v| a.0[i].mul_add(b.0[i], v));
        }
        self.add(a.mul(b))
    }

    #[inline(always)]
    fn floor(self) -> Self {
        self.each(|_, v| floor(v))
    }

    #[inline(always)]
    fn store(self, values: &mut [f64; LANES]) {
        *values = self.0;
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        let v = self.0;
        // The order of folding a register in the middle, again and again, as in `x86::sum`: a sum has the same rounding
        // on all levels.
        ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
    }

    #[inline(always)]
    fn tanh(self) -> Self {
        tanh_of(&self)
    }

    #[inline(always)]
    fn rise(self) -> Self {
        rise_of(&self)
    }

    #[inline(always)]
    fn power_of_two(self) -> Self {
        // The lowest bits of n move into the exponent, whose bias is 1023; `wrapping`, because a negative n is in two's
        // complement.
        self.each(|_, v| f64::from_bits((v.to_bits() << 52).wrapping_add(1023 << 52)))
    }
}

/// A call instead of inlining: eight of them in sixteen registers are hundreds of instructions, most of a kernel's.
// The call halved the kernels' code and their build time.
#[inline(never)]
fn tanh_of(x: &Plain) -> Plain {
    tanh::tanh(*x)
}

#[inline(never)]
fn rise_of(x: &Plain) -> Plain {
    tanh::rise(*x)
}

/// From here on every double is an integer.
const WHOLE: f64 = 4_503_599_627_370_496.0;

/// The standard library's `floor` is a call if the baseline has no instruction for it.
#[inline(always)]
fn floor(v: f64) -> f64 {
    let shift = WHOLE.copysign(v);
    // Near 2^52 a number has no bits left for a fraction, so adding rounds to an integer and subtracting is exact.
    // `shift` has the sign of v: the sum's magnitude then grows and stays where the spacing is 1 or more.
    let nearest = (v + shift) - shift;
    // Rounded to the nearest, so at most one too high.
    let below = if nearest > v { nearest - 1.0 } else { nearest };
    // The result keeps the sign of v, also for 0. From 2^52 on there is nothing to round, and v + shift would round v itself.
    if v.abs() < WHOLE {
        below.copysign(v)
    } else {
        v
    }
}

// One number in place of eight: the lanes' controllers for a single loop. It fuses no products, so a controller gives
// the same bits alone, in lanes of any level, and on a microcontroller.

impl Arithmetic for f64 {
    const ALL: u8 = 1;

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

    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }

    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        values[0]
    }

    #[inline(always)]
    fn at_most_each(self, limits: Self) -> Self {
        if self > limits { limits } else { self }
    }

    #[inline(always)]
    fn at_least_each(self, limits: Self) -> Self {
        if self < limits { limits } else { self }
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
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

    #[inline(always)]
    fn each(self, of: impl Fn(f64) -> f64) -> Self {
        of(self)
    }
}
