//! Eight numbers in one AVX-512 register, or in two of AVX2.
//!
//! Why the `unsafe` in this file is sound: an intrinsic needs a processor that has it, and loads and stores need room
//! for eight numbers. The types are private to `simd`, and their values arise only in [`wide`] and [`half`], whose
//! caller has checked the processor; the room is in the type, `[f64; LANES]`.

use std::arch::x86_64::*;

use super::{Arithmetic, F64x8, Kernel, LANES, Lanes, tanh};

/// The remainder from the nearest quarter; half way between two quarters, from the even one.
// Bits 4 to 7 are the binary places to round to: two for quarters.
const BEYOND_QUARTERS: i32 = 2 << 4 | _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

/// Rounding to the integer below.
const DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;

/// Runs a kernel in AVX-512 registers.
#[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
pub(super) fn wide<K: Kernel>(kernel: K) -> K::Output {
    // The kernel is inlined into this function and thereby compiled for these features. AVX2 and FMA, which AVX-512
    // implies, are named for the sums of half a register.
    kernel.run::<Wide>()
}

/// Runs a kernel in AVX2 registers.
#[target_feature(enable = "avx2,fma")]
pub(super) fn half<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Halves>()
}

/// A method that is one instruction, in one register or in both halves.
macro_rules! lanes {
    (wide one $name:ident $of:ident) => {
        lanes!($name(self) { $of(self.0) });
    };
    (halves one $name:ident $of:ident) => {
        lanes!($name(self) { $of(self.0), $of(self.1) });
    };
    (wide two $name:ident $of:ident) => {
        lanes!($name(self, other) { $of(self.0, other.0) });
    };
    (halves two $name:ident $of:ident) => {
        lanes!($name(self, other) { $of(self.0, other.0), $of(self.1, other.1) });
    };
    // If one is NaN the instruction returns its second operand, so `self` is the second.
    (wide limit $name:ident $of:ident) => {
        lanes!($name(self, limits) { $of(limits.0, self.0) });
    };
    (halves limit $name:ident $of:ident) => {
        lanes!($name(self, limits) { $of(limits.0, self.0), $of(limits.1, self.1) });
    };
    ($name:ident($this:ident $(, $other:ident)?) { $($half:expr),* }) => {
        #[inline(always)]
        fn $name($this $(, $other: Self)?) -> Self {
            // SAFETY: as `splat`.
            unsafe { Self($($half),*) }
        }
    };
}

#[derive(Clone, Copy)]
pub(super) struct Wide(__m512d);

impl Wide {
    /// Entries of a table, by the low four bits of each lane.
    #[inline(always)]
    pub(super) fn pick(self, table: &[Lanes; 2]) -> Self {
        // A table is 16 numbers, two cache lines. The instruction uses bits 0 to 2 of an index for the place and bit 3
        // for the register, and ignores the rest: the sum of `QUARTERS` and a number can be used directly.
        let (low, high) = (Self::load(&table[0].0), Self::load(&table[1].0));
        // SAFETY: as `splat`.
        unsafe {
            Self(_mm512_permutex2var_pd(
                low.0,
                _mm512_castpd_si512(self.0),
                high.0,
            ))
        }
    }

    /// The difference from the nearest multiple of a quarter, exact.
    #[inline(always)]
    pub(super) fn beyond_quarters(self) -> Self {
        // SAFETY: as `splat`.
        unsafe { Self(_mm512_reduce_pd::<BEYOND_QUARTERS>(self.0)) }
    }

    /// Swaps the two numbers of each pair.
    #[inline(always)]
    pub(super) fn neighbours(self) -> Self {
        // SAFETY: as `splat`.
        unsafe { Self(_mm512_permute_pd::<0b0101_0101>(self.0)) }
    }

    /// Swaps the upper four numbers and the lower four.
    #[inline(always)]
    fn halves_swapped(self) -> Self {
        // SAFETY: as `splat`.
        // A shuffle across the register takes three cycles, one within its 128-bit quarters (`neighbours`) one cycle.
        unsafe { Self(_mm512_shuffle_f64x2::<0b0100_1110>(self.0, self.0)) }
    }

    /// A nonnegative number with the sign of another.
    #[inline(always)]
    pub(super) fn with_sign_of(self, other: Self) -> Self {
        // SAFETY: as `splat`.
        // Two bit operations instead of a product with +-1: any unit can do them, and they do not round.
        unsafe {
            Self(_mm512_or_pd(
                self.0,
                _mm512_and_pd(other.0, _mm512_set1_pd(-0.0)),
            ))
        }
    }
}

impl Arithmetic for Wide {
    const ALL: u8 = u8::MAX;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        // SAFETY: only run if the processor has AVX-512, here and below.
        unsafe { Self(_mm512_set1_pd(value)) }
    }

    lanes!(wide two add _mm512_add_pd);
    lanes!(wide two sub _mm512_sub_pd);
    lanes!(wide two mul _mm512_mul_pd);
    lanes!(wide two div _mm512_div_pd);
    lanes!(wide one sqrt _mm512_sqrt_pd);

    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        // `loadu` also for aligned addresses, where it is as fast as the aligned load; slices may begin anywhere.
        // SAFETY: eight readable numbers; only run if the processor has AVX-512.
        unsafe { Self(_mm512_loadu_pd(values.as_ptr())) }
    }

    lanes!(wide limit at_most_each _mm512_min_pd);
    lanes!(wide limit at_least_each _mm512_max_pd);
    lanes!(wide one abs _mm512_abs_pd);

    #[inline(always)]
    fn if_less(self, other: Self, yes: Self, no: Self) -> Self {
        // No masks here: a comparison gives all ones or all zeros, and `blendv` uses the sign bit.
        // SAFETY: as `splat`.
        unsafe {
            let less = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0);
            Self(_mm512_mask_blend_pd(less, no.0, yes.0))
        }
    }

    #[inline(always)]
    fn if_equal(self, other: Self, yes: Self, no: Self) -> Self {
        // SAFETY: as `splat`.
        unsafe {
            let equal = _mm512_cmp_pd_mask::<_CMP_EQ_OQ>(self.0, other.0);
            Self(_mm512_mask_blend_pd(equal, no.0, yes.0))
        }
    }

    #[inline(always)]
    fn are_less(self, other: Self) -> u8 {
        // SAFETY: as `splat`.
        unsafe { _mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0) }
    }

    #[inline(always)]
    fn each(self, of: impl Fn(f64) -> f64) -> Self {
        let mut lanes = [0.0; LANES];
        self.store(&mut lanes);
        Self::load(&lanes.map(of))
    }
}

impl F64x8 for Wide {
    const TILE_ROWS: usize = 8;

    #[inline(always)]
    fn add_product(self, a: Self, b: Self) -> Self {
        // SAFETY: as `splat`.
        unsafe { Self(_mm512_fmadd_pd(a.0, b.0, self.0)) }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        // SAFETY: as `splat`.
        unsafe { Self(_mm512_roundscale_pd::<DOWN>(self.0)) }
    }

    #[inline(always)]
    fn store(self, values: &mut [f64; LANES]) {
        // SAFETY: room for eight numbers; only run if the processor has AVX-512.
        unsafe { _mm512_storeu_pd(values.as_mut_ptr(), self.0) }
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: as `splat`.
        unsafe {
            // Lanes i and i + 4 first, as in the two registers of AVX2: one order of additions on all levels.
            let low = _mm512_castpd512_pd256(self.0);
            sum(_mm256_add_pd(low, _mm512_extractf64x4_pd::<1>(self.0)))
        }
    }

    #[inline(always)]
    fn power_of_two(self) -> Self {
        // SAFETY: as `splat`.
        unsafe {
            // n is in the lowest bits: shifted to the exponent field it is an exponent without bias, and the bits of 1
            // are that bias.
            let exponent = _mm512_slli_epi64::<52>(_mm512_castpd_si512(self.0));
            let one = _mm512_castpd_si512(_mm512_set1_pd(1.0));
            Self(_mm512_castsi512_pd(_mm512_add_epi64(exponent, one)))
        }
    }

    #[inline(always)]
    fn tanh_in_chain(self) -> Self {
        tanh::tables::in_chain(self)
    }

    #[inline(always)]
    fn tanh_of_four(x: [Self; 4]) -> [Self; 4] {
        tanh::tables::of_four(x)
    }

    #[inline(always)]
    fn tanh_as_of_four(self) -> Self {
        tanh::tables::of_neighbours(self)
    }

    /// The sum is not waited for: halves are added, then neighbours, and the two remaining sums go into the arguments
    /// one by one.
    ///
    /// On a Zen 4 a free run takes 4 % less in this order than in the common one. A training, whose two runs side by side leave hardly a
    /// unit idle, takes 4 % more (`free_run` and `training_8` of the kernels' example, least and median of 200 and 150).
    #[inline(always)]
    fn fed_back(self, second: Self, direct: Self, rest: Self, weights: Self) -> (f64, Self) {
        // Lane i of y's sum is direct_i + second_i h_i. It is folded before the products are added: `direct` is known
        // early, so only two products and one shuffle of h are on the chain. Lanes 4 to 7 then equal lanes 0 to 3
        // except for the order of the two products, and so the last bit.
        let four = direct
            .add(direct.halves_swapped())
            .add_product(second, self)
            .add_product(second.halves_swapped(), self.halves_swapped());
        // The lanes hold p p q q p p q q, with y = p + q.
        let two = four.add(four.neighbours());
        // q q p p q q p p, a shuffle within each half.
        // SAFETY: as `splat`.
        let others = unsafe { Self(_mm512_permutex_pd::<0b0100_1110>(two.0)) };
        // The first product needs only `two` and goes ahead while `others` is computed. Each lane rounds its own p + q;
        // the output kept and measured is lane 0's.
        let arguments = rest.add_product(weights, two).add_product(weights, others);
        // SAFETY: as `splat`.
        let y = unsafe { _mm512_cvtsd_f64(two.0) + _mm512_cvtsd_f64(others.0) };
        (y, arguments)
    }
}

#[derive(Clone, Copy)]
pub(super) struct Halves(__m256d, __m256d);

impl Arithmetic for Halves {
    const ALL: u8 = u8::MAX;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        // SAFETY: only run if the processor has AVX2 and FMA, here and below.
        let all = unsafe { _mm256_set1_pd(value) };
        Self(all, all)
    }

    lanes!(halves two add _mm256_add_pd);
    lanes!(halves two sub _mm256_sub_pd);
    lanes!(halves two mul _mm256_mul_pd);
    lanes!(halves two div _mm256_div_pd);
    lanes!(halves one sqrt _mm256_sqrt_pd);

    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        let start = values.as_ptr();
        // SAFETY: eight readable numbers; only run if the processor has AVX2 and FMA.
        unsafe { Self(_mm256_loadu_pd(start), _mm256_loadu_pd(start.add(4))) }
    }

    lanes!(halves limit at_most_each _mm256_min_pd);
    lanes!(halves limit at_least_each _mm256_max_pd);

    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: as `splat`.
        let one = |v: __m256d| unsafe { _mm256_andnot_pd(_mm256_set1_pd(-0.0), v) };
        Self(one(self.0), one(self.1))
    }

    #[inline(always)]
    fn if_less(self, other: Self, yes: Self, no: Self) -> Self {
        // SAFETY: as `splat`.
        unsafe {
            Self(
                _mm256_blendv_pd(no.0, yes.0, _mm256_cmp_pd::<_CMP_LT_OQ>(self.0, other.0)),
                _mm256_blendv_pd(no.1, yes.1, _mm256_cmp_pd::<_CMP_LT_OQ>(self.1, other.1)),
            )
        }
    }

    #[inline(always)]
    fn if_equal(self, other: Self, yes: Self, no: Self) -> Self {
        // SAFETY: as `splat`.
        unsafe {
            Self(
                _mm256_blendv_pd(no.0, yes.0, _mm256_cmp_pd::<_CMP_EQ_OQ>(self.0, other.0)),
                _mm256_blendv_pd(no.1, yes.1, _mm256_cmp_pd::<_CMP_EQ_OQ>(self.1, other.1)),
            )
        }
    }

    #[inline(always)]
    fn are_less(self, other: Self) -> u8 {
        // SAFETY: as `splat`.
        unsafe {
            let low = _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(self.0, other.0));
            let high = _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(self.1, other.1));
            // Lanes 4 to 7 are in the upper register: the order of bits is that of AVX-512's mask.
            (low | high << 4) as u8
        }
    }

    #[inline(always)]
    fn each(self, of: impl Fn(f64) -> f64) -> Self {
        let mut lanes = [0.0; LANES];
        self.store(&mut lanes);
        Self::load(&lanes.map(of))
    }
}

impl F64x8 for Halves {
    const TILE_ROWS: usize = 6;

    #[inline(always)]
    fn add_product(self, a: Self, b: Self) -> Self {
        // SAFETY: as `splat`.
        unsafe {
            Self(
                _mm256_fmadd_pd(a.0, b.0, self.0),
                _mm256_fmadd_pd(a.1, b.1, self.1),
            )
        }
    }

    lanes!(halves one floor _mm256_floor_pd);

    #[inline(always)]
    fn store(self, values: &mut [f64; LANES]) {
        let start = values.as_mut_ptr();
        // SAFETY: room for eight numbers; only run if the processor has AVX2 and FMA.
        unsafe {
            _mm256_storeu_pd(start, self.0);
            _mm256_storeu_pd(start.add(4), self.1);
        }
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: as `splat`.
        unsafe { sum(_mm256_add_pd(self.0, self.1)) }
    }

    #[inline(always)]
    fn power_of_two(self) -> Self {
        // SAFETY: as `splat`.
        let one = |v: __m256d| unsafe {
            let exponent = _mm256_slli_epi64::<52>(_mm256_castpd_si256(v));
            let one = _mm256_castpd_si256(_mm256_set1_pd(1.0));
            _mm256_castsi256_pd(_mm256_add_epi64(exponent, one))
        };
        Self(one(self.0), one(self.1))
    }
}

/// `(v0 + v2) + (v1 + v3)`.
#[inline(always)]
fn sum(v: __m256d) -> f64 {
    // SAFETY: only reached from AVX2 or AVX-512.
    unsafe {
        let pair = _mm_add_pd(_mm256_castpd256_pd128(v), _mm256_extractf128_pd::<1>(v));
        _mm_cvtsd_f64(_mm_add_sd(pair, _mm_unpackhi_pd(pair, pair)))
    }
}
