//! Free runs of networks, one or two side by side, in the units of their inputs: scaled or the data's.
//!
//! A run waits for itself: each output needs the one before. Terms that do not depend on it, the inputs' part of the hidden units'
//! arguments, are computed in advance for a block of samples, and a second run fits into the waiting times.
//!
//! ```text
//!   z(k) = [ W1u u(k) + b1 ]                     drive     a block at once, off the chain
//!        + [ W1y_na y(k-na) + .. + W1y_2 y(k-2) ]  older     known a sample before
//!        + W1y_1 y(k-1)                            the chain: one product,
//!   y(k) = direct(k) + w2' tanh(z(k))              one tanh, one sum of eight lanes
//! ```
//!
//! Networks of one group of hidden units and up to four past outputs keep weights and past outputs in registers
//! ([`together`]). The others go through memory ([`Chain::alone`]), which makes a free run of 8 units 12 to 16 % and a
//! training 2 to 3 % longer (Zen 4, `free_run` with 1 to 4 past outputs and `training_8` of the kernels' example, least
//! and median of 100 and 150). One run takes 76 cycles a sample, two side by side 102 (AVX-512; with AVX2 90 and 117,
//! on the baseline 139 and 234: docs/PERFORMANCE.md), which pays when Levenberg-Marquardt tries two dampings at once.

use super::network::{self, Network};
use crate::Monitor;
use crate::data::weighted_squares;
use crate::monitor::Limit;
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};

/// Samples whose inputs are prepared together.
// The inputs' part of a block is 4 kB per group of hidden units: it is written and read back within the first-level
// cache.
const BLOCK: usize = 64;
/// Blocks between two checks of the monitor.
// 4,096 samples, a tenth of a millisecond.
const LOOK: usize = 64;

/// One network's run; its results go into the caller's buffers.
pub(super) struct Run<'a> {
    pub network: &'a Network,
    /// Past outputs before the first sample, newest first.
    pub state: &'a [f64],
    /// Outputs, one for each sample simulated.
    pub outputs: &'a mut [f64],
    /// Buffer for the hidden outputs of all samples, or empty.
    pub hidden: &'a mut [Lanes],
    /// `None` if the run has already failed elsewhere.
    pub limit: Option<Limit>,
}

/// Free runs of networks of one shape over the same inputs.
pub(super) struct FreeRuns<'a, const RUNS: usize> {
    pub runs: [Run<'a>; RUNS],
    /// Inputs of the whole experiment.
    pub u: &'a [f64],
    /// The first simulated sample.
    pub first: usize,
    /// Measured outputs of the simulated samples, NaN for unknown ones; empty if nothing is measured.
    pub y: &'a [f64],
    /// Their weights; empty if all count alike.
    pub weights: &'a [f64],
    /// An output of this magnitude has diverged.
    pub bound: f64,
    /// Asked for stop requests.
    pub monitor: Option<&'a Monitor>,
}

impl<const RUNS: usize> FreeRuns<'_, RUNS> {
    /// Sums of squared errors, 0 without measured outputs; `None` if a run diverges, is stopped, or can no longer stay
    /// below its limit.
    pub fn go(self) -> [Option<f64>; RUNS] {
        simd::run(self)
    }
}

impl<const RUNS: usize> Kernel for FreeRuns<'_, RUNS> {
    type Output = [Option<f64>; RUNS];

    #[inline(always)]
    fn run<V: F64x8>(self) -> Self::Output {
        let Self {
            runs,
            u,
            first,
            y,
            weights,
            bound,
            monitor,
        } = self;
        let samples = runs[0].outputs.len();
        let lags = runs[0].network.shape.lags;
        let mut chains = runs.map(Chain::new);
        // By entry of the regressor, the samples of a block contiguous: `drive` reads one number of each entry per sample.
        let mut inputs = vec![[0.0; BLOCK]; lags.regressors() - lags.na];
        for start in (0..samples).step_by(BLOCK) {
            let count = BLOCK.min(samples - start);
            if start % (BLOCK * LOOK) == 0 && monitor.is_some_and(Monitor::stopped) {
                return [None; RUNS];
            }
            for (entry, values) in inputs.iter_mut().enumerate() {
                network::input_entry(lags, u, first + start, entry, &mut values[..count]);
            }
            // Each run has its own weights, but all share the inputs, which are gathered once.
            for chain in chains.iter_mut().filter(|chain| chain.runs) {
                chain.drive::<V>(&inputs, count);
            }
            advance::<V, RUNS>(&mut chains, start, count);
            for chain in chains.iter_mut().filter(|chain| chain.runs) {
                let measured = y.get(start..start + count).unwrap_or_default();
                let weights = weights.get(start..start + count).unwrap_or_default();
                chain.conclude::<V>(start, (measured, weights), count, bound);
            }
            // A run that has diverged or can no longer win is left out from the next block on; the other continues alone.
            if chains.iter().all(|chain| !chain.runs) {
                break;
            }
        }
        chains.map(|chain| chain.runs.then_some(chain.sum))
    }
}

/// One block of all runs that have not ended.
#[inline(always)]
fn advance<V: F64x8, const RUNS: usize>(chains: &mut [Chain; RUNS], start: usize, count: usize) {
    let shape = chains[0].run.network.shape;
    // 0 for shapes without a register kernel.
    let na = if shape.groups() == 1 {
        shape.lags.na
    } else {
        0
    };
    if let [one, two] = &mut chains[..]
        && one.runs
        && two.runs
    {
        // Two runs with three past outputs would keep 20 registers, with four 26, in addition to those of tanh.
        match na {
            1 => return together::<V, 1, 2>([one, two], start, count),
            2 => return together::<V, 2, 2>([one, two], start, count),
            _ => (),
        }
    }
    for chain in chains.iter_mut().filter(|chain| chain.runs) {
        match na {
            1 => together::<V, 1, 1>([chain], start, count),
            2 => together::<V, 2, 1>([chain], start, count),
            3 => together::<V, 3, 1>([chain], start, count),
            4 => together::<V, 4, 1>([chain], start, count),
            _ => chain.alone::<V>(start, count),
        }
    }
}

/// A run in progress.
struct Chain<'a> {
    run: Run<'a>,
    /// The inputs' part of each group's argument, and last that of the bypass.
    driven: Vec<[Lanes; BLOCK]>,
    /// The last outputs, the oldest first, followed by those of the block.
    outputs: Vec<f64>,
    /// Squared errors, summed by position modulo eight.
    // Eight sums, kept from block to block: a single one would wait for each addition.
    sums: Lanes,
    sum: f64,
    limit: Limit,
    runs: bool,
}

impl<'a> Chain<'a> {
    fn new(run: Run<'a>) -> Self {
        let past = run.state.iter().rev().copied();
        Self {
            // At 64 hidden units, 8 groups of 64 samples are 32 kB: a first-level cache. One more row for the bypass.
            driven: vec![[Lanes::ZERO; BLOCK]; run.network.shape.groups() + 1],
            outputs: past.chain([0.0; BLOCK]).collect(),
            sums: Lanes::ZERO,
            sum: 0.0,
            limit: run.limit.unwrap_or(Limit::NONE),
            runs: run.limit.is_some(),
            run,
        }
    }

    /// Computes the inputs' part of a block.
    #[inline(always)]
    fn drive<V: F64x8>(&mut self, inputs: &[[f64; BLOCK]], count: usize) {
        let network = self.run.network;
        let n_phi = network.shape.lags.regressors();
        // The bypass is the last of these groups, with b2 as its bias.
        for (group, driven) in self.driven.iter_mut().enumerate() {
            let bias = V::load(&network.bias[group].0);
            let weights = &network.first[group * n_phi..][..n_phi];
            // The inputs' weights only, which follow those of the outputs.
            let weights = &weights[n_phi - inputs.len()..];
            for (k, driven) in driven.iter_mut().enumerate().take(count) {
                let mut sum = bias;
                for (w, values) in weights.iter().zip(inputs).rev() {
                    sum = sum.add_product(V::load(&w.0), V::splat(values[k]));
                }
                sum.store(&mut driven.0);
            }
        }
    }

    /// A block of a network of any shape.
    #[inline(always)]
    fn alone<V: F64x8>(&mut self, start: usize, count: usize) {
        let network = self.run.network;
        let (shape, na) = (network.shape, network.shape.lags.na);
        let (groups, n_phi) = (shape.groups(), shape.lags.regressors());
        let (units, direct) = self.driven.split_at(groups);
        //   outputs  | na before the block, oldest first | the block's, as they come |
        // The past of sample k is then a slice of it, and nothing is moved within a block.
        let mut newest = V::splat(self.outputs[na - 1]);
        for k in 0..count {
            let (past, next) = self.outputs.split_at_mut(na + k);
            let older = &past[k..na + k - 1];
            let weights = &network.first[groups * n_phi..][..na];
            let mut sum = argument(V::load(&direct[0][k].0), weights, older, newest);
            for (group, driven) in units.iter().enumerate() {
                let weights = &network.first[group * n_phi..][..na];
                let z = argument(V::load(&driven[k].0), weights, older, newest);
                let h = z.tanh_in_chain();
                sum = sum.add_product(V::load(&network.second[group].0), h);
                if let Some(hidden) = self.run.hidden.get_mut((start + k) * groups + group) {
                    h.store(&mut hidden.0);
                }
            }
            let y = network.limited(sum.sum());
            // Broadcast here, not where it is used: every group's argument waits for it.
            newest = V::splat(y);
            next[0] = y;
        }
    }

    /// Stores the block's outputs and adds up their errors.
    #[inline(always)]
    fn conclude<V: F64x8>(
        &mut self,
        start: usize,
        (measured, weights): (&[f64], &[f64]),
        count: usize,
        bound: f64,
    ) {
        let na = self.run.state.len();
        let outputs = &self.outputs[na..na + count];
        self.run.outputs[start..start + count].copy_from_slice(outputs);
        // NaN is not below the bound either. Checked once a block and without a branch: a run that leaves the bound may
        // continue for up to 64 samples, which nobody reads.
        let sound = outputs
            .iter()
            .fold(true, |sound, y| sound & (y.abs() < bound));
        self.runs = sound;
        if weights.is_empty() {
            self.sum = squared_errors_on::<V>(&mut self.sums, measured, outputs);
        } else {
            self.sum += weighted_squares(weights, measured, outputs);
        }
        // Sums of squares only grow, so a partial sum beyond the limit decides. Weighted squares are added one by one,
        // as hardly any training has weights.
        self.runs &= !self.limit.is_reached(self.sum);
        // The last na outputs are the past of the next block.
        self.outputs.copy_within(count..count + na, 0);
    }
}

/// The argument of a group: the inputs' part, then the outputs', the newest last, as all other terms are ready before
/// it is known. `older` has the oldest first.
#[inline(always)]
fn argument<V: F64x8>(driven: V, weights: &[Lanes], older: &[f64], newest: V) -> V {
    let mut sum = driven;
    for (w, y) in weights[1..].iter().rev().zip(older) {
        sum = sum.add_product(V::load(&w.0), V::splat(*y));
    }
    sum.add_product(V::load(&weights[0].0), newest)
}

/// A block of networks of one group of hidden units and `NA` past outputs, side by side.
#[inline(always)]
fn together<V: F64x8, const NA: usize, const RUNS: usize>(
    chains: [&mut Chain; RUNS],
    start: usize,
    count: usize,
) {
    // Registers in a block: NA groups of W1, NA of the bypass, w2 and NA broadcast past outputs, 3 NA + 1 per run, in
    // addition to those of tanh.
    let mut weights = [[V::splat(0.0); NA]; RUNS];
    let mut direct = [[V::splat(0.0); NA]; RUNS];
    let mut second = [V::splat(0.0); RUNS];
    let mut past = [[V::splat(0.0); NA]; RUNS];
    for (r, chain) in chains.iter().enumerate() {
        let network = chain.run.network;
        let n_phi = network.shape.lags.regressors();
        second[r] = V::load(&network.second[0].0);
        for m in 0..NA {
            weights[r][m] = V::load(&network.first[m].0);
            direct[r][m] = V::load(&network.first[n_phi + m].0);
            past[r][m] = V::splat(chain.outputs[NA - 1 - m]);
        }
    }
    // `arguments` is z of the present sample, computed one sample before: the loop is rotated to begin with the tanh
    // and to end with the next sample's argument.
    let mut arguments = [V::splat(0.0); RUNS];
    for (r, chain) in chains.iter().enumerate() {
        let driven = V::load(&chain.driven[0][0].0);
        arguments[r] = older(driven, &weights[r], &past[r][1..]);
        arguments[r] = arguments[r].add_product(weights[r][0], past[r][0]);
    }
    let limited = chains[0].run.network.saturates();
    let kept = !chains[0].run.hidden.is_empty();
    // `min` tells the compiler that k is within the arrays of a block.
    for k in 0..count.min(BLOCK) {
        for r in 0..RUNS {
            let chain = &mut *chains[r];
            // h(k), the head of the dependency chain.
            let h = arguments[r].tanh_in_chain();
            if kept {
                h.store(&mut chain.run.hidden[start + k].0);
            }
            // Off the chain: lane 0 of `sum` is b2 + linear' phi, complete before h is.
            let mut sum = V::load(&chain.driven[1][k].0);
            for m in (0..NA).rev() {
                sum = sum.add_product(direct[r][m], past[r][m]);
            }
            // there is no sample after the last one of a block
            let driven = V::load(&chain.driven[0][(k + 1) % BLOCK].0);
            let rest = older(driven, &weights[r], &past[r]);
            let mut y;
            // y and the next z together, in the order of operations that is shortest on this level.
            (y, arguments[r]) = h.fed_back(second[r], sum, rest, weights[r][0]);
            // A predicted branch if clipping is rare. The next argument was formed from the unclipped output and is
            // formed again.
            if limited && chain.run.network.is_clipped(y) {
                y = chain.run.network.limited(y);
                arguments[r] = rest.add_product(weights[r][0], V::splat(y));
            }
            // Only renames registers; nothing is moved.
            for m in (1..NA).rev() {
                past[r][m] = past[r][m - 1];
            }
            past[r][0] = V::splat(y);
            chain.outputs[NA + k] = y;
        }
    }
}

/// Adds the part of all outputs but the newest to the inputs' part of arguments; `past` begins with the second newest.
#[inline(always)]
fn older<V: F64x8, const NA: usize>(driven: V, weights: &[V; NA], past: &[V]) -> V {
    let mut sum = driven;
    for m in (1..NA).rev() {
        sum = sum.add_product(weights[m], past[m - 1]);
    }
    sum
}

/// Adds the squared errors of the measured samples; returns the sum of all so far.
#[inline(always)]
fn squared_errors_on<V: F64x8>(sums: &mut Lanes, y: &[f64], run: &[f64]) -> f64 {
    let mut sum = V::load(&sums.0);
    // Sample i of a block is lane i mod 8, and blocks are multiples of 8: summing the whole record at once would add
    // the same numbers in the same order.
    let ((y, y_rest), (run, run_rest)) = (y.as_chunks(), run.as_chunks());
    for (y, run) in y.iter().zip(run) {
        sum = square(sum, V::load(y).sub(V::load(run)));
    }
    if !y_rest.is_empty() {
        let mut errors = [0.0; LANES];
        for (error, (y, run)) in errors.iter_mut().zip(y_rest.iter().zip(run_rest)) {
            *error = y - run;
        }
        sum = square(sum, V::load(&errors));
    }
    sum.store(&mut sums.0);
    sum.sum()
}

/// Adds squares; the NaN of an unmeasured sample adds nothing.
#[inline(always)]
fn square<V: F64x8>(sum: V, error: V) -> V {
    let error = error.if_equal(error, error, V::splat(0.0));
    sum.add_product(error, error)
}

/// The outputs of `samples` from `first` on; NaN from the sample at which the run is no longer finite.
pub(super) fn outputs(
    network: &Network,
    u: &[f64],
    first: usize,
    state: &[f64],
    samples: usize,
) -> Vec<f64> {
    let mut outputs = vec![0.0; samples];
    let run = Run {
        network,
        state,
        outputs: &mut outputs,
        hidden: &mut [],
        limit: Some(Limit::NONE),
    };
    let whole = FreeRuns {
        runs: [run],
        u,
        first,
        y: &[],
        weights: &[],
        bound: f64::INFINITY,
        monitor: None,
    };
    // The run stopped at the end of the block in which it was no longer finite: the samples after it are still zeros.
    if whole.go()[0].is_none() {
        let end = outputs.iter().position(|y| !y.is_finite());
        outputs[end.unwrap_or(0)..].fill(f64::NAN);
    }
    outputs
}

#[cfg(test)]
mod tests;
