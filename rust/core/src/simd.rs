//! Eight numbers side by side, in the widest registers of the processor. Begin reading at `F64x8` and `Kernel`.
//!
//! Eight doubles are one cache line, one AVX-512 register, two of AVX2, four of the baseline:
//!
//! ```text
//!   Lanes (memory, 64 bytes, aligned)    | 0 | 1 | 2 | 3 | 4 | 5 | 6 | 7 |
//!   AVX-512  x86::Wide                   |             zmm               |
//!   AVX2     x86::Halves                 |      ymm      |      ymm      |
//!   baseline plain::Plain                |  the compiler's, as xmm pairs |
//! ```
//!
//! Every kernel works on groups of eight for any register, so memory layouts and the order of sums are the same on all
//! levels. The kernel decides what a lane is: a hidden unit of one network, a column of a Jacobian, or one of eight
//! closed loops.
//!
//! The gain of the levels, end to end (docs/PERFORMANCE.md, processor time of the public call, Zen 5): 100 iterations of a training take
//! 177 ms with AVX-512, 285 with AVX2, 619 on the baseline; 1,000 closed loops 37.5, 68.4 and 158 ms; a state-space training 401, 627 and
//! 1,625 ms. A free run gains 5 % from AVX-512 and 92 % from AVX2: it is limited by one dependency chain, not by throughput.
//!
//! A [`Kernel`] is written once over [`F64x8`] and compiled for AVX-512, for AVX2 with fused multiply-add, and for the baseline. [`run`]
//! takes the best one at run time, or the one named by `SEWFAST_CPU`. Except for `tanh`, all do the same operations in the same order and
//! differ only in the rounding of fused products; on one level a kernel has one answer.

mod plain;
mod tanh;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::sync::OnceLock;

use crate::{Error, Result};

/// Numbers in a group.
pub(crate) const LANES: usize = 8;

/// Eight numbers in memory, on their own cache line.
#[derive(Clone, Copy, Debug, PartialEq)]
// Aligned, because any other load of 64 bytes touches two cache lines and takes two accesses. Tables, weights and
// states are `Lanes`; slices of plain numbers are read by `F64x8::first` from any address.
#[repr(C, align(64))]
pub(crate) struct Lanes(pub [f64; LANES]);

impl Lanes {
    /// Eight zeros.
    pub const ZERO: Self = Self([0.0; LANES]);
}

/// Numbers computed side by side, each compared and selected on its own: eight, or one.
pub(crate) trait Arithmetic: Copy {
    /// The result of [`are_less`](Self::are_less) if all are less.
    const ALL: u8;

    fn splat(value: f64) -> Self;
    /// Loads as many of the values as there are lanes.
    fn load(values: &[f64; LANES]) -> Self;
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    // Limits are comparisons, not `f64::min`, which turns NaN into the limit: a run that has left the finite numbers
    // would go on as if its output were merely limited.
    /// The smaller of `self` and `limits`, one by one; NaN in `self` stays NaN.
    fn at_most_each(self, limits: Self) -> Self;
    /// The larger of `self` and `limits`, one by one; NaN in `self` stays NaN.
    fn at_least_each(self, limits: Self) -> Self;
    /// `|self|`.
    fn abs(self) -> Self;
    /// `yes` if `self < other`, else `no`, lane by lane.
    fn if_less(self, other: Self, yes: Self, no: Self) -> Self;
    /// `yes` if `self == other`, else `no`, lane by lane.
    fn if_equal(self, other: Self, yes: Self, no: Self) -> Self;
    /// One bit for each lane with `self < other`, the first lane lowest.
    fn are_less(self, other: Self) -> u8;
    /// A function of each number, one by one: for what is rare, or has no form in lanes.
    fn each(self, of: impl Fn(f64) -> f64) -> Self;
}

/// Eight numbers in registers.
pub(crate) trait F64x8: Arithmetic {
    /// Groups of sums that stay in registers beside one group of products: 8, 6 or 2.
    ///
    /// A group takes one of the 32 registers of AVX-512, two of the 16 of AVX2, four of the 16 of the baseline; the
    /// sums leave room for a group being read and a broadcast number. The sums also have to hide the latency of a fused
    /// multiply-add: 4 cycles on two units need 8 registers in flight.
    const TILE_ROWS: usize;

    /// `self + a b`, rounded once if the processor can.
    fn add_product(self, a: Self, b: Self) -> Self;
    /// The largest integers not above `self`.
    fn floor(self) -> Self;
    fn store(self, values: &mut [f64; LANES]);
    /// The sum of all eight, by halving.
    fn sum(self) -> f64;
    /// `2^n` for numbers with the integer `n` in their low bits.
    fn power_of_two(self) -> Self;

    /// The smaller of `self` and `limit`; NaN stays NaN.
    #[inline(always)]
    fn at_most(self, limit: f64) -> Self {
        self.at_most_each(Self::splat(limit))
    }

    /// The larger of `self` and `limit`; NaN stays NaN.
    #[inline(always)]
    fn at_least(self, limit: f64) -> Self {
        self.at_least_each(Self::splat(limit))
    }

    /// `tanh`, as [`tanh::tanh`] computes it.
    #[inline(always)]
    fn tanh(self) -> Self {
        tanh::tanh(self)
    }

    /// The derivative of `tanh`, as [`tanh::rise`] computes it.
    #[inline(always)]
    fn rise(self) -> Self {
        tanh::rise(self)
    }

    /// `tanh` with the shortest dependency chain, for results that wait for each other.
    #[inline(always)]
    fn tanh_in_chain(self) -> Self {
        self.tanh()
    }

    /// `tanh` with the fewest operations, for results that do not wait for each other.
    #[inline(always)]
    fn tanh_of_four([a, b, c, d]: [Self; 4]) -> [Self; 4] {
        [a.tanh(), b.tanh(), c.tanh(), d.tanh()]
    }

    /// Bit for bit the result of [`tanh_of_four`](Self::tanh_of_four) if neighbours are its first two or its last two.
    #[inline(always)]
    fn tanh_as_of_four(self) -> Self {
        self.tanh()
    }

    /// The step that closes the chain of a free run: `y = 1'(direct + second h)`, `z = rest + weights y`.
    ///
    /// In this form eight numbers are summed to one (3 dependent additions), which is broadcast again and multiplied. If a
    /// level can, it uses another order: after two foldings all lanes hold one of two partial sums `p`, `q` with `y = p + q`,
    /// and `z = (rest + weights p) + weights q` needs neither the last addition nor the way back from scalar to vector.
    ///
    /// Returns the output `y` of hidden units `self`, which is the sum of `direct + second self`, and the next
    /// arguments `rest + weights y`. The rounding is that of the shortest order on this level.
    #[inline(always)]
    fn fed_back(self, second: Self, direct: Self, rest: Self, weights: Self) -> (f64, Self) {
        // Eight lanes to one number, and back to eight lanes; `x86::Wide` has an order without this way through a
        // scalar.
        let y = direct.add_product(second, self).sum();
        (y, rest.add_product(weights, Self::splat(y)))
    }

    /// The first eight numbers of a slice.
    #[inline(always)]
    fn first(values: &[f64]) -> Self {
        match values.first_chunk() {
            Some(values) => Self::load(values),
            // NaN instead of a panic: it reaches the cost, and leaves no call in a kernel, which would spill the
            // registers.
            None => Self::splat(f64::NAN),
        }
    }

    /// Overwrites the first eight numbers of a slice.
    #[inline(always)]
    fn write(self, values: &mut [f64]) {
        if let Some(values) = values.first_chunk_mut() {
            self.store(values);
        }
    }
}

/// Work that is compiled for every level.
pub(crate) trait Kernel {
    type Output;

    /// Does the work; `#[inline(always)]`, like everything it calls that uses `V`.
    // `x86::wide` and `x86::half` have the processor's features, and only code inlined into them gets these. A function
    // that stays a call is compiled for the baseline: each intrinsic in it is then a call itself, with its operands in
    // memory.
    fn run<V: F64x8>(self) -> Self::Output;
}

/// Does the work on the level in use.
pub(crate) fn run<K: Kernel>(kernel: K) -> K::Output {
    run_at(in_use(), kernel)
}

/// Does the work on a level that this processor has.
fn run_at<K: Kernel>(level: Level, kernel: K) -> K::Output {
    // One branch for a whole kernel, not for an operation: it selects one of three copies of the kernel.
    #[cfg(target_arch = "x86_64")]
    match level {
        // SAFETY: callers only pass levels of this processor.
        Level::Avx512 => return unsafe { x86::wide(kernel) },
        // SAFETY: as above.
        Level::Avx2 => return unsafe { x86::half(kernel) },
        Level::Baseline => (),
    }
    let _ = level;
    kernel.run::<plain::Plain>()
}

/// The kernel's result on every level that this processor has, the baseline first.
#[cfg(test)]
pub(crate) fn run_everywhere<K: Kernel>(mut kernel: impl FnMut() -> K) -> Vec<(Level, K::Output)> {
    let levels = Level::ALL.into_iter().filter(|level| level.is_here());
    levels
        .map(|level| (level, run_at(level, kernel())))
        .collect()
}

/// The level for which kernels are compiled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// What every processor of the architecture has.
    Baseline,
    /// AVX2 with fused multiply-add.
    Avx2,
    /// AVX-512, including its doubles and quadwords (DQ).
    Avx512,
}

impl Level {
    /// All levels, the narrowest first.
    pub const ALL: [Self; 3] = [Self::Baseline, Self::Avx2, Self::Avx512];

    /// The name used in `SEWFAST_CPU`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Baseline => "baseline",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Whether this processor has it.
    pub fn is_here(self) -> bool {
        // Processor and operating system: a register that the system does not save on a thread switch cannot be used.
        #[cfg(target_arch = "x86_64")]
        let (half, wide) = (
            is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq"),
        );
        #[cfg(not(target_arch = "x86_64"))]
        let (half, wide) = (false, false);
        match self {
            Self::Baseline => true,
            Self::Avx2 => half,
            // Wide kernels end with AVX2 instructions (sums of eight), so both must be present.
            Self::Avx512 => half && wide,
        }
    }

    fn best() -> Self {
        let here = Self::ALL.into_iter().rev().find(|level| level.is_here());
        here.unwrap_or(Self::Baseline)
    }
}

/// The variable that forces a level.
const VARIABLE: &str = "SEWFAST_CPU";

/// The level in use: the processor's best one, or the one named by the environment variable `SEWFAST_CPU`.
///
/// # Errors
/// `ErrorKind::Setting` if the variable names no level, or one that this processor does not have; the best one is then
/// in use.
pub fn level() -> Result<Level> {
    asked_for().map(|_| in_use())
}

fn asked_for() -> Result<Level> {
    let Some(name) = std::env::var_os(VARIABLE) else {
        return Ok(Level::best());
    };
    named(&name.to_string_lossy())
}

fn named(name: &str) -> Result<Level> {
    let known = Level::ALL.into_iter().find(|level| level.name() == name);
    match known {
        Some(level) if level.is_here() => Ok(level),
        // Refused, not lowered: a test for a level would otherwise pass without having run on it.
        Some(_) => Err(Error::setting(format!(
            "expected a processor with {name} for {VARIABLE}={name}, got one without; its best is {}",
            Level::best().name()
        ))),
        None => Err(Error::setting(format!(
            "expected baseline, avx2 or avx512 for {VARIABLE}, got {name:?}; without the variable the best is taken"
        ))),
    }
}

/// The level that every kernel runs on; it does not change while the program runs.
#[inline]
fn in_use() -> Level {
    static IN_USE: OnceLock<Level> = OnceLock::new();
    // Determined once: a model trained on one level and judged on another would differ in its last bits. A wrong name
    // is no error here, because no caller could handle it: `level`, which the Python module calls on import, reports
    // it.
    *IN_USE.get_or_init(|| asked_for().unwrap_or_else(|_| Level::best()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation on one pair of groups.
    struct All([f64; LANES], [f64; LANES]);

    impl Kernel for All {
        type Output = Vec<[f64; LANES]>;

        #[inline(always)]
        fn run<V: F64x8>(self) -> Self::Output {
            let (a, b) = (V::load(&self.0), V::load(&self.1));
            let all = [
                a.add(b),
                a.sub(b),
                a.mul(b),
                a.div(b),
                a.add_product(a, b),
                V::splat(a.sum()),
                a.abs().at_most(2.5),
                a.at_most(2.5).at_least(-1.5),
                V::splat(f64::from_bits(3)).power_of_two(),
                a.at_most_each(b),
                a.at_least_each(b),
                a.abs(),
                a.floor(),
                a.if_less(b, a, b),
                a.if_equal(V::splat(0.5), b, a),
                V::splat(f64::from(a.are_less(b))),
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
        let all = run_everywhere(|| All(a, b));
        for (level, values) in &all {
            for (operation, (plain, best)) in all[0].1.iter().zip(values).enumerate() {
                for (x, y) in plain.iter().zip(best) {
                    let same = x == y || (x.is_nan() && y.is_nan());
                    assert!(same, "{level:?}, {operation}: {x} {y}");
                }
            }
            assert_eq!(values[8][0], 8.0);
            assert_eq!(values[7][..3], [1.0, -1.5, 2.5]);
            let smaller = [-4.0, -2.0, -0.5, -0.0, 1.0, -1.0, 2.0, -7.25];
            assert_eq!((values[9], values[13]), (smaller, smaller));
            assert_eq!(values[10][..3], [1.0, 2.0, 3.5]);
            assert_eq!(
                values[12],
                [1.0, -2.0, 3.0, -0.0, 1e300, 0.0, f64::INFINITY, -8.0]
            );
            assert_eq!(values[12][3].to_bits(), 1 << 63);
            assert_eq!((values[14][5], values[14][0]), (-1.0, 1.0));
            assert_eq!(values[15], [f64::from(0b1000_1010_u8); LANES]);
        }
        for (_, values) in run_everywhere(|| All([f64::NAN; LANES], b)) {
            let nan = [6, 7, 9, 10, 11, 12].map(|operation| values[operation][0].is_nan());
            assert_eq!(nan, [true; 6]);
            assert_eq!((values[13], values[15][0]), (b, 0.0));
        }
    }

    #[test]
    fn takes_a_level_by_its_name_where_the_processor_has_it() {
        for level in Level::ALL {
            assert_eq!(named(level.name()).is_ok(), level.is_here());
        }
        assert_eq!(named("baseline"), Ok(Level::Baseline));
        let refused = named("sse9").unwrap_err().message;
        assert!(refused.contains("avx2") && refused.contains("sse9"));
        assert!(Level::best().is_here());
    }
}
