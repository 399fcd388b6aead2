//! The hyperbolic tangent from that of the nearest quarter and that of what is beyond it, where a processor picks numbers
//! from tables in registers.
//!
//! ```text
//!   |x| = a + t,   a the nearest quarter,   |t| <= 1/8
//!   A = tanh(a)  from a table of 16,        B = tanh(t) = t + t^3 p(t^2)
//!   tanh(|x|) = (A + B) / (1 + A B)
//! ```
//!
//! The table's 16 numbers fill two registers, and one instruction (`vpermi2pd`) picks eight of them by the low bits of the
//! rounded argument. Because p has degree 4 only, the whole is 20 operations; the division is shared by two results,
//! `1/(d1 d2)` giving `d2/(d1 d2)` and `d1/(d1 d2)`, since a division takes as long as 8 products and there is one unit for it.

use crate::simd::Lanes;
use crate::simd::x86::Wide;
use crate::simd::{Arithmetic, Choice};

use super::pieces::{NEAR, QUARTERS};
use super::tanh as quotients;

/// `tanh(t)/t - 1` over `t^2` up to `t = 1/8` as a polynomial of `t^2`, with a relative error of `tanh(t)` of 2.8e-17
/// (`tests/golden/tanh_sums.py`).
const BEYOND: [f64; 5] = [
    -0.3333333333332524,
    0.13333333325983435,
    -0.05396823229463513,
    0.021866697038365468,
    -0.008699701918881335,
];

/// `tanh` of 0, 1/4, 1/2 ... 15/4.
#[rustfmt::skip]
static OF_QUARTERS: [Lanes; 2] = [
    Lanes([
        0.0, 0.24491866240370913, 0.46211715726000974, 0.6351489523872873,
        0.7615941559557649, 0.8482836399575129, 0.9051482536448664, 0.9413755384972874,
    ]),
    Lanes([
        0.9640275800758169, 0.9780261147388136, 0.9866142981514303, 0.9918597245682077,
        0.9950547536867305, 0.996997635486526, 0.9981778976111987, 0.9988944427261528,
    ]),
];

/// `tanh` of each at any size. The first two and the last two share a division.
#[inline(always)]
pub(in crate::simd) fn of_four(x: [Wide; 4]) -> [Wide; 4] {
    let [a, b, c, d] = x;
    let parts = [Parts::of(a), Parts::of(b), Parts::of(c), Parts::of(d)];
    let [p, q, r, s] = parts;
    let (first, last) = (p.share(q), r.share(s));
    let near = [
        p.beside(q, first),
        q.beside(p, first),
        r.beside(s, last),
        s.beside(r, last),
    ];
    if p.are_near() & q.are_near() & r.are_near() & s.are_near() == Wide::ALL {
        return near;
    }
    [
        p.at_any_size(q, near[0]),
        q.at_any_size(p, near[1]),
        r.at_any_size(s, near[2]),
        s.at_any_size(r, near[3]),
    ]
}

/// `tanh` at any size, to the bit what [`of_four`] gives where neighbours are its first two or its last two.
#[inline(always)]
pub(in crate::simd) fn of_neighbours(x: Wide) -> Wide {
    let own = Parts::of(x);
    let other = own.of_neighbours();
    let near = own.beside(other, own.share(other));
    if own.are_near() == Wide::ALL {
        return near;
    }
    own.at_any_size(other, near)
}

/// `tanh(x)` below [`NEAR`] before the division: `(A + B)/(1 + A B)` of the tangents `A` of the nearest quarter and `B` of
/// what is beyond it.
///
/// With one division for two these are 20 operations where the quotients take 33, but a longer chain.
#[derive(Clone, Copy)]
struct Parts {
    x: Wide,
    size: Wide,
    sum: Wide,
    below: Wide,
}

impl Parts {
    #[inline(always)]
    fn of(x: Wide) -> Self {
        let size = x.abs();
        let quarters = size.add(Wide::splat(QUARTERS)).pick(&OF_QUARTERS);
        let t = size.beyond_quarters();
        let t2 = t.mul(t);
        let mut share = Wide::splat(BEYOND[4]);
        for power in [3, 2, 1, 0] {
            share = Wide::splat(BEYOND[power]).add_product(share, t2);
        }
        let beyond = t.add_product(t.mul(t2), share);
        Self {
            x,
            size,
            sum: quarters.add(beyond),
            below: Wide::splat(1.0).add_product(quarters, beyond),
        }
    }

    /// The parts of each lane's neighbour.
    #[inline(always)]
    fn of_neighbours(self) -> Self {
        Self {
            x: self.x.neighbours(),
            size: self.size.neighbours(),
            sum: self.sum.neighbours(),
            below: self.below.neighbours(),
        }
    }

    #[inline(always)]
    fn are_near(self) -> u8 {
        self.size.are_less(Wide::splat(NEAR))
    }

    /// The division that two have in common.
    #[inline(always)]
    fn share(self, other: Self) -> Wide {
        Wide::splat(1.0).div(self.below.mul(other.below))
    }

    /// `tanh(x)` where both are near.
    #[inline(always)]
    fn beside(self, other: Self, share: Wide) -> Wide {
        self.sum.mul(other.below.mul(share)).with_sign_of(self.x)
    }

    /// `near` where both are, else `tanh(x)` of its own.
    #[inline(always)]
    fn at_any_size(self, other: Self, near: Wide) -> Wide {
        let (limit, own) = (Wide::splat(NEAR), quotients(self.x));
        let near = other.size.if_less(limit, near, own);
        self.size.if_less(limit, near, own)
    }
}
