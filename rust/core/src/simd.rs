//! Eight numbers side by side, in the widest registers that the processor has.
//!
//! A [`Kernel`] is written once over [`Eight`] and compiled for AVX-512, for AVX2 with fused multiply-add and for the
//! baseline; [`run`] takes the best one at run time. All do the same operations in the same order and differ only in
//! the rounding of products that are added at once: on one kind of processor a kernel has one answer.

mod plain;
#[cfg(target_arch = "x86_64")]
mod x86;

/// Numbers in a group.
pub(crate) const LANES: usize = 8;

/// Eight numbers in memory, on a cache line of their own.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Group(pub [f64; LANES]);

impl Group {
    /// Eight zeros.
    pub const ZERO: Self = Self([0.0; LANES]);
}

/// Eight numbers in registers.
pub(crate) trait Eight: Copy {
    /// Sums that stay in registers: rows of a tile, and groups of columns, of which there are at most three.
    const TILE: (usize, usize);

    fn load(values: &[f64; LANES]) -> Self;
    fn store(self, values: &mut [f64; LANES]);
    fn splat(value: f64) -> Self;
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    /// `self + a b`, rounded once where the processor can.
    fn add_product(self, a: Self, b: Self) -> Self;
    /// The sum of all eight, in halves.
    fn sum(self) -> f64;
    /// `|self|`, but `limit` where that is larger; NaN stays NaN.
    fn size_up_to(self, limit: f64) -> Self;
    /// `2^n` for numbers that hold the integer `n` in their low bits.
    fn power_of_two(self) -> Self;
    /// The size of `self` with the sign of `sign`.
    fn with_sign(self, sign: Self) -> Self;

    /// The first eight numbers of a slice.
    #[inline(always)]
    fn first(values: &[f64]) -> Self {
        match values.first_chunk() {
            Some(values) => Self::load(values),
            None => Self::splat(f64::NAN),
        }
    }

    /// Writes over the first eight numbers of a slice.
    #[inline(always)]
    fn write(self, values: &mut [f64]) {
        if let Some(values) = values.first_chunk_mut() {
            self.store(values);
        }
    }
}

/// Work that is compiled for every kind of processor.
pub(crate) trait Kernel {
    type Output;

    /// Does the work; `#[inline(always)]`, as everything it calls that uses `V`.
    fn run<V: Eight>(self) -> Self::Output;
}

/// Does the work as this processor does it best.
#[inline]
pub(crate) fn run<K: Kernel>(kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            // SAFETY: the processor has what the function is compiled for.
            return unsafe { x86::wide(kernel) };
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            // SAFETY: as above.
            return unsafe { x86::half(kernel) };
        }
    }
    kernel.run::<plain::Plain>()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation on one pair of groups.
    struct All([f64; LANES], [f64; LANES]);

    impl Kernel for All {
        type Output = Vec<[f64; LANES]>;

        #[inline(always)]
        fn run<V: Eight>(self) -> Self::Output {
            let (a, b) = (V::load(&self.0), V::load(&self.1));
            let all = [
                a.add(b),
                a.sub(b),
                a.mul(b),
                a.div(b),
                a.add_product(a, b),
                V::splat(a.sum()),
                a.size_up_to(2.5),
                a.with_sign(b),
                V::splat(f64::from_bits(3)).power_of_two(),
            ];
            let stored = |v: V| {
                let mut values = [0.0; LANES];
                v.store(&mut values);
                values
            };
            all.map(stored).to_vec()
        }
    }

    #[test]
    fn every_processor_computes_alike() {
        let a = [1.0, -2.0, 3.5, -0.0, 1e300, 0.5, f64::INFINITY, -7.25];
        let b = [-4.0, 2.0, -0.5, 3.0, 1.0, -1.0, 2.0, 8.0];
        let plain = All(a, b).run::<plain::Plain>();
        let best = run(All(a, b));
        for (operation, (plain, best)) in plain.iter().zip(&best).enumerate() {
            for (x, y) in plain.iter().zip(best) {
                assert!(x == y || (x.is_nan() && y.is_nan()), "{operation}: {x} {y}");
            }
        }
        assert_eq!(best[8][0], 8.0);
        assert!(run(All([f64::NAN; LANES], b))[6][0].is_nan());
    }
}
