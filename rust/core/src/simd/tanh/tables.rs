//! The hyperbolic tangent from tables in registers, for processors that can look numbers up there (AVX-512), in two ways.
//!
//! Both split the argument at the nearest quarter, `|x| = a + t` with `|t| <= 1/8`, and look up values for `a`. The
//! index of the quarter is in the low bits of `|x| + QUARTERS`; with it `vpermi2pd` picks eight of a table's 16
//! numbers, which fill two registers. [`in_chain`] looks up the coefficients of a polynomial in t, for the shortest
//! chain; [`of_four`] looks up only `tanh(a)` and uses the addition theorem, for the fewest operations:
//!
//! ```text
//!   A = tanh(a)  from a table of 16,        B = tanh(t) = t + t^3 p(t^2)
//!   tanh(|x|) = (A + B) / (1 + A B)
//! ```
//!
//! As p has degree 4 only, the sum takes 20 operations. Two results share a division, `1/(d1 d2)` giving `d2/(d1 d2)`
//! and `d1/(d1 d2)`, because a division takes as long as 8 products and has only one unit.

use crate::simd::x86::Wide;
use crate::simd::{Arithmetic, F64x8, Lanes};

use super::tanh as quotients;

/// Adding this rounds to quarters; the index of the quarter is then in the low bits.
// 1.5 * 2^50: numbers of this size are spaced by 2^(50 - 52), a quarter. The additional half keeps the sum in that range.
const QUARTERS: f64 = 1_688_849_860_263_936.0;
/// [`near`] is valid below this size.
// 15.5 quarters: from here on the nearest one could be the 16th, which the tables do not have.
const NEAR: f64 = 3.875;

/// `tanh(x)` for any size.
#[inline(always)]
pub(in crate::simd) fn in_chain(x: Wide) -> Wide {
    let (size, limit) = (x.abs(), Wide::splat(NEAR));
    let near = near(x);
    // A branch, not only a selection: a processor that predicts it continues with the polynomial, and neither the
    // comparison nor the quotients are on the chain.
    if size.are_less(limit) == Wide::ALL {
        return near;
    }
    size.if_less(limit, near, quotients(x))
}

/// `tanh(x)` below [`NEAR`]: one polynomial around each multiple of a quarter.
///
/// A chain of some 36 cycles instead of the quotients' 46: index and remainder are available at once, nothing is
/// divided, and the coefficients arrive one per cycle in the order in which they are needed.
#[inline(always)]
fn near(x: Wide) -> Wide {
    let size = x.abs();
    // Rounded like the addition of QUARTERS, to the even one of two equally near: index and remainder must match. The
    // remainder is computed from |x| itself, so it does not wait for the index.
    let t = size.beyond_quarters();
    let t2 = t.mul(t);
    let t4 = t2.mul(t2);
    let piece = Piece {
        number: size.add(Wide::splat(QUARTERS)),
        t,
        t2,
    };
    //   four(i) = (c_i + c_(i+1) t) + t^2 (c_(i+2) + c_(i+3) t)
    //   sum of c_i t^i = four(0) + t^4 (four(4) + t^4 four(8))
    let high = piece.four(4).add_product(piece.four(8), t4);
    // From |x|, so never negative: the sign is applied by an OR, which makes tanh odd to the last bit.
    piece.four(0).add_product(high, t4).with_sign_of(x)
}

/// The polynomial of each lane: its index in the low bits, and powers of the distance from its centre.
#[derive(Clone, Copy)]
struct Piece {
    number: Wide,
    t: Wide,
    t2: Wide,
}

impl Piece {
    #[inline(always)]
    fn coefficient(self, power: usize) -> Wide {
        // Only the low four bits count: the sum's bits can be used directly as an index.
        self.number.pick(&PIECES[power])
    }

    /// `c(i) + c(i+1) t`.
    #[inline(always)]
    fn pair(self, i: usize) -> Wide {
        self.coefficient(i)
            .add_product(self.coefficient(i + 1), self.t)
    }

    #[inline(always)]
    fn four(self, i: usize) -> Wide {
        self.pair(i).add_product(self.pair(i + 2), self.t2)
    }
}

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

/// `tanh` of each for any size. The first two and the last two share a division.
#[inline(always)]
pub(in crate::simd) fn of_four(x: [Wide; 4]) -> [Wide; 4] {
    let [a, b, c, d] = x;
    let parts = [Parts::of(a), Parts::of(b), Parts::of(c), Parts::of(d)];
    let [p, q, r, s] = parts;
    // Both denominators are 1 + A B with 0 <= A < 1 and |B| < 1/8, between .87 and 1.13: their product is as good a
    // divisor as each of them and cannot overflow.
    let (first, last) = (p.share(q), r.share(s));
    let near = [
        p.beside(q, first),
        q.beside(p, first),
        r.beside(s, last),
        s.beside(r, last),
    ];
    // If one argument of a pair is large, its lookup is meaningless, and so is the shared division.
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

/// `tanh` for any size, bit for bit the result of [`of_four`] if neighbours are its first two or its last two.
#[inline(always)]
pub(in crate::simd) fn of_neighbours(x: Wide) -> Wide {
    let own = Parts::of(x);
    // In a single loop this is a register of hidden units, one group; `of_four` has four registers of loops. Units 2i
    // and 2i+1 are partners there and neighbours here. There is one division either way, so nothing is saved; it is
    // done for equal bits, so that a search judges a loop alone as in lanes.
    let other = own.of_neighbours();
    let near = own.beside(other, own.share(other));
    if own.are_near() == Wide::ALL {
        return near;
    }
    own.at_any_size(other, near)
}

/// `tanh(x)` below [`NEAR`] before the division: `(A + B)/(1 + A B)`, with `A` the tangent of the nearest quarter and
/// `B` that of the remainder.
///
/// With one division for two results these are 20 operations instead of the quotients' 33, but a longer chain.
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
        // Horner, not Estrin: one product less, and four of these run side by side, so nothing waits.
        let mut share = Wide::splat(BEYOND[4]);
        for power in [3, 2, 1, 0] {
            share = Wide::splat(BEYOND[power]).add_product(share, t2);
        }
        // t + t^3 p: t itself is exact, and the addend is at most 1/192 of it, so its rounding does not count.
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

    /// The division shared by two results.
    #[inline(always)]
    fn share(self, other: Self) -> Wide {
        Wide::splat(1.0).div(self.below.mul(other.below))
    }

    /// `tanh(x)` if both are near.
    #[inline(always)]
    fn beside(self, other: Self, share: Wide) -> Wide {
        // sum / below = sum * (other.below / (below other.below)): two products instead of a separate division.
        self.sum.mul(other.below.mul(share)).with_sign_of(self.x)
    }

    /// `near` if both are near, else a separate `tanh(x)`.
    #[inline(always)]
    fn at_any_size(self, other: Self, near: Wide) -> Wide {
        let (limit, own) = (Wide::splat(NEAR), quotients(self.x));
        // A lane whose partner is large takes its own quotient. It depends on its partner but not on other lanes: these
        // are other samples or loops, which must not matter.
        let near = other.size.if_less(limit, near, own);
        self.size.if_less(limit, near, own)
    }
}

/// Coefficients of each power around 0, 1/4, 1/2 ... 15/4: relative error 1.3e-16 (`tests/golden/tanh_pieces.py`).
///
/// Around 0 they begin with 0 and 1: small numbers stay unchanged.
#[rustfmt::skip]
static PIECES: [[Lanes; 2]; 12] = [
    [
        Lanes([
            0.0, 0.2449186624037091, 0.4621171572600098, 0.6351489523872873,
            0.7615941559557649, 0.8482836399575129, 0.9051482536448664, 0.9413755384972874,
        ]),
        Lanes([
            0.9640275800758169, 0.9780261147388136, 0.9866142981514303, 0.9918597245682077,
            0.9950547536867305, 0.996997635486526, 0.9981778976111987, 0.9988944427261528,
        ]),
    ],
    [
        Lanes([
            1.0, 0.9400148488063794, 0.7864477329659272, 0.5965858082813313,
            0.4199743416140261, 0.28041486618043265, 0.18070663892364852, 0.11381209551894224,
        ]),
        Lanes([
            0.07065082485316447, 0.04346491888890094, 0.02659222668316062, 0.01621428677947907,
            0.00986603716544019, 0.0059957148342761986, 0.003640884720487306, 0.0022098922908086417,
        ]),
    ],
    [
        Lanes([
            -1.8157314029048293e-16, -0.230227179409153, -0.36343099069186674, -0.3789208511390338,
            -0.3198500042245946, -0.23787134338173138, -0.16356629864377517, -0.10713992270664993,
        ]),
        Lanes([
            -0.06810934371355677, -0.04250982574834947, -0.026236271065290227, -0.016082298019164023,
            -0.009817247181521209, -0.005977713512824855, -0.003634250655740755, -0.002207449128312119,
        ]),
    ],
    [
        Lanes([
            -0.33333333333326376, -0.2569513501075317, -0.0942015480430041, 0.04180924554504467,
            0.10360444679518307, 0.10831074694527815, 0.0878162032646829, 0.06292153725955016,
        ]),
        Lanes([
            0.04210901084967774, 0.02708741341858201, 0.017021004602138477, 0.010546621423885507,
            0.006480019420943605, 0.003961194626476835, 0.002414000438776991, 0.001468377903268785,
        ]),
    ],
    [
        Lanes([
            -9.214117840569437e-12, 0.13967457400832686, 0.16467581520988175, 0.0997518518890203,
            0.027712126851390777, -0.01258778687500554, -0.02496458347789161, -0.02351948845117702,
        ]),
        Lanes([
            -0.01789113325742474, -0.012322255787975907, -0.00804774282096101, -0.005100003014245816,
            -0.00317555840162491, -0.001956730505360253, -0.0011981849975648943, -0.0007309381512932878,
        ]),
    ],
    [
        Lanes([
            0.1333333339361396, 0.07233075976473309, -0.027222387361563596, -0.06403623706562349,
            -0.04630744630850315, -0.01919412716941718, -0.0026597155283863776, 0.0036959830309582394,
        ]),
        Lanes([
            0.004781227279055785, 0.003988237233309321, 0.002857288305010653, 0.0019032645943601867,
            0.0012190932798398257, 0.0007636955857306705, 0.000472243518236981, 0.00028977947378733634,
        ]),
    ],
    [
        Lanes([
            -2.256409875712725e-08, -0.06938947632407602, -0.05038826536930447, -0.0009985365325459656,
            0.0189223306122523, 0.015191964167002227, 0.007094157800272961, 0.0019796340981596,
        ]),
        Lanes([
            -0.00015906490136598423, -0.0007378443663987176, -0.0007194887957896723, -0.0005451548883102671,
            -0.00037270614282020265, -0.0002419972687888795, -0.00015274916844759532, -9.486748055437597e-05,
        ]),
    ],
    [
        Lanes([
            -0.05396773518972113, -0.014815060142623602, 0.028601608441183233, 0.021646121264131207,
            0.002438166387649014, -0.00467561819338506, -0.003965669771517192, -0.0019381893002699763,
        ]),
        Lanes([
            -0.0006541692299116072, -9.782806899586275e-05, 7.939320546304482e-05, 0.00010634906237354906,
            8.761852307052427e-05, 6.204271353493836e-05, 4.0995215902055257e-05, 2.6123040560354267e-05,
        ]),
    ],
    [
        Lanes([
            -7.533642977859354e-06, 0.030346011780783815, 0.008009275785165252, -0.010396418893223685,
            -0.0068720269026115366, -0.0008741584868285876, 0.001016234773813758, 0.000868806296691391,
        ]),
        Lanes([
            0.00043023127292008664, 0.00015776676055659087, 3.8186225097893934e-05, -3.0623040182866667e-06,
            -1.2740783659025636e-05, -1.2022422430783898e-05, -8.938956249468227e-06, -6.042895238711453e-06,
        ]),
    ],
    [
        Lanes([
            0.021937977330731863, -0.0001368401388622488, -0.013473828269854776, -0.00199818292647828,
            0.0032613211951720966, 0.001703701780623401, 0.00019537294232745256, -0.0001987451484037822,
        ]),
        Lanes([
            -0.00016461483787488755, -8.119292570679726e-05, -3.104014765918875e-05, -9.007165151543307e-06,
            -1.0638455400141953e-06, 1.161840452086165e-06, 1.4134437704503677e-06, 1.1280986270917574e-06,
        ]),
    ],
    [
        Lanes([
            -0.0003663061216424279, -0.011771108125225183, 0.0019060426895845018, 0.004387420302478624,
            0.0001264191233880411, -0.0008328920964178407, -0.00034150539491958583, -3.280662318206158e-05,
        ]),
        Lanes([
            3.483169123109586e-05, 2.749078799316615e-05, 1.3425038548140125e-05, 5.256058986843449e-06,
            1.6784038303487946e-06, 3.5236405172241184e-07, -5.7259561459749195e-08, -1.404507738014114e-07,
        ]),
    ],
    [
        Lanes([
            -0.007928448309057309, 0.00218998642308117, 0.004208924714839117, -0.0014778096658119313,
            -0.0010025077637356038, 9.151683072631072e-05, 0.00017396201540157986, 5.6310009567228365e-05,
        ]),
        Lanes([
            3.920806421211255e-06, -5.596773735226095e-06, -4.109860761086536e-06, -1.970320408210693e-06,
            -7.795714605291559e-07, -2.6285259746254913e-07, -6.83715478153346e-08, -4.7406439202824826e-09,
        ]),
    ],
];
