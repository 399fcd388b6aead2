//! Free runs of networks in the units of their inputs, scaled or the data's, one or two side by side.
//!
//! A run waits for itself: each output needs the one before. What does not depend on it, the inputs' share of the hidden
//! units' arguments, is computed for a block of samples beforehand, and a second run fits into the waiting.
//!
//! ```text
//!   z(k) = [ W1u u(k) + b1 ]                     drive     a block at once, off the chain
//!        + [ W1y_na y(k-na) + .. + W1y_2 y(k-2) ]  older     known a sample before
//!        + W1y_1 y(k-1)                            the chain: one product,
//!   y(k) = direct(k) + w2' tanh(z(k))              one tanh, one sum of eight lanes
//! ```
//!
//! Networks of one group of hidden units and up to four past outputs keep weights and past outputs in registers ([`together`]); the
//! others go through memory ([`Chain::alone`]), by which a free run of 8 units takes 12 to 16 % longer and a training 2 to 3 % (Zen 4,
//! `free_run` with 1 to 4 past outputs and `training_8` of the kernels' example, least and median of 100 and 150). Two runs side by side take 102 cycles a sample where one takes 76 (AVX-512; with AVX2
//! 117 and 90, on the baseline 234 and 139: docs/PERFORMANCE.md), which pays where Levenberg and Marquardt try two dampings at once.

use super::network::{self, Network};
use crate::Monitor;
use crate::data::weighted_squares;
use crate::monitor::Limit;
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};

/// Samples whose inputs are prepared at once.
// A block's share of the inputs is 4 kB for a group of hidden units: written and read again within the first-level
// cache.
const BLOCK: usize = 64;
/// Blocks between two looks at the monitor.
// 4,096 samples, a tenth of a millisecond.
const LOOK: usize = 64;

/// One network's run; what it leaves behind goes where its caller says.
pub(super) struct Run<'a> {
    pub network: &'a Network,
    /// Past outputs before the first sample, newest first.
    pub state: &'a [f64],
    /// Outputs, one for each sample simulated.
    pub outputs: &'a mut [f64],
    /// Room for the hidden outputs of all samples, or of none.
    pub hidden: &'a mut [Lanes],
    /// None where it has already failed elsewhere.
    pub limit: Option<Limit>,
}

/// Free runs of networks of one shape over the same inputs.
pub(super) struct FreeRuns<'a, const RUNS: usize> {
    pub runs: [Run<'a>; RUNS],
    /// Inputs of the whole experiment.
    pub u: &'a [f64],
    /// The first sample that is simulated.
    pub first: usize,
    /// Measured outputs of the simulated samples, NaN where there is none; empty where nothing is measured.
    pub y: &'a [f64],
    /// Their weights; none where all count alike.
    pub weights: &'a [f64],
    /// An output of this size has diverged.
    pub bound: f64,
    /// Asked whether to stop.
    pub monitor: Option<&'a Monitor>,
}

impl<const RUNS: usize> FreeRuns<'_, RUNS> {
    /// Sums of squared errors, 0 without a measure; none where a run diverges, is stopped, or can no longer stay below
    /// its limit.
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
        // Entry by entry of the regressor, the samples of a block contiguous: the drive reads one number of each.
        let mut inputs = vec![[0.0; BLOCK]; lags.regressors() - lags.na];
        for start in (0..samples).step_by(BLOCK) {
            let count = BLOCK.min(samples - start);
            if start % (BLOCK * LOOK) == 0 && monitor.is_some_and(Monitor::stopped) {
                return [None; RUNS];
            }
            for (entry, values) in inputs.iter_mut().enumerate() {
                network::input_entry(lags, u, first + start, entry, &mut values[..count]);
            }
            // Each run has weights of its own, but all have the same inputs, which are gathered once.
            for chain in chains.iter_mut().filter(|chain| chain.runs) {
                chain.drive::<V>(&inputs, count);
            }
            advance::<V, RUNS>(&mut chains, start, count);
            for chain in chains.iter_mut().filter(|chain| chain.runs) {
                let measured = y.get(start..start + count).unwrap_or_default();
                let weights = weights.get(start..start + count).unwrap_or_default();
                chain.conclude::<V>(start, (measured, weights), count, bound);
            }
            // A run that has diverged or can no longer win is left out from the next block on; the other goes on alone.
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
    // 0 for what has no kernel with registers of its own.
    let na = if shape.groups() == 1 {
        shape.lags.na
    } else {
        0
    };
    if let [one, two] = &mut chains[..]
        && one.runs
        && two.runs
    {
        // Two runs of three past outputs would keep 20 registers, of four 26, beside what tanh needs.
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

/// A run on its way.
struct Chain<'a> {
    run: Run<'a>,
    /// The inputs' share of each group's arguments, and last of the direct way to the output.
    driven: Vec<[Lanes; BLOCK]>,
    /// The last outputs, the oldest first, and behind them those of the block.
    outputs: Vec<f64>,
    /// Squared errors, every eighth.
    // Eight sums, one for each place in a group of samples, kept from block to block: one sum alone would wait for each
    // addition.
    sums: Lanes,
    sum: f64,
    limit: Limit,
    runs: bool,
}

impl<'a> Chain<'a> {
    fn new(run: Run<'a>) -> Self {
        let past = run.state.iter().rev().copied();
        Self {
            // 8 groups of 64 samples are 32 kB at 64 hidden units: a first-level cache. Room for one direct row more.
            driven: vec![[Lanes::ZERO; BLOCK]; run.network.shape.groups() + 1],
            outputs: past.chain([0.0; BLOCK]).collect(),
            sums: Lanes::ZERO,
            sum: 0.0,
            limit: run.limit.unwrap_or(Limit::NONE),
            runs: run.limit.is_some(),
            run,
        }
    }

    /// The inputs' share of a block.
    #[inline(always)]
    fn drive<V: F64x8>(&mut self, inputs: &[[f64; BLOCK]], count: usize) {
        let network = self.run.network;
        let n_phi = network.shape.lags.regressors();
        // The direct way is the last of these groups, with b2 for its bias.
        for (group, driven) in self.driven.iter_mut().enumerate() {
            let bias = V::load(&network.bias[group].0);
            let weights = &network.first[group * n_phi..][..n_phi];
            // Those of the inputs alone, which stand behind the outputs'.
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
        // so that the past of sample k is a slice of it and nothing is moved within a block.
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
            // Spread here and not where it is used: every group's argument waits for it.
            newest = V::splat(y);
            next[0] = y;
        }
    }

    /// Hands the block's outputs on and measures them.
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
        // NaN is no number below the bound either.
        // Asked once a block and without a branch: a run that leaves the bound may go on for 64 samples, which nobody
        // reads.
        let sound = outputs
            .iter()
            .fold(true, |sound, y| sound & (y.abs() < bound));
        self.runs = sound;
        if weights.is_empty() {
            self.sum = squared_errors_on::<V>(&mut self.sums, measured, outputs);
        } else {
            self.sum += weighted_squares(weights, measured, outputs);
        }
        // Sums of squares only grow, so that a partial sum beyond the limit decides. With weights they are added one by
        // one, as hardly any training has them.
        self.runs &= !self.limit.is_reached(self.sum);
        // The last na outputs are the past of the next block.
        self.outputs.copy_within(count..count + na, 0);
    }
}

/// The argument of a group: the inputs' share, then the outputs', the newest last as everything else is ready before it
/// is known. `older` has the oldest first.
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
    // Registers for a block: NA groups of W1, NA of the direct way, w2, NA past outputs spread over the lanes; 3 NA + 1
    // for a run, beside what tanh needs.
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
    // `arguments` is z of the sample at hand, computed a sample before: the loop is turned so that it begins with the
    // tanh, and ends with what the next one waits for.
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
            // h(k), the head of the chain.
            let h = arguments[r].tanh_in_chain();
            if kept {
                h.store(&mut chain.run.hidden[start + k].0);
            }
            // Off the chain: lane 0 of `sum` is b2 + linear' phi, complete before h is.
            let mut sum = V::load(&chain.driven[1][k].0);
            for m in (0..NA).rev() {
                sum = sum.add_product(direct[r][m], past[r][m]);
            }
            // behind the last sample of a block nothing follows
            let driven = V::load(&chain.driven[0][(k + 1) % BLOCK].0);
            let rest = older(driven, &weights[r], &past[r]);
            let mut y;
            // y and the next z at once, in the order of operations that is shortest on this level.
            (y, arguments[r]) = h.fed_back(second[r], sum, rest, weights[r][0]);
            // A branch that is foretold where the limit is rare. The next argument has already been formed from the
            // output as it was, and is formed again.
            if limited && chain.run.network.is_clipped(y) {
                y = chain.run.network.limited(y);
                arguments[r] = rest.add_product(weights[r][0], V::splat(y));
            }
            // A register's name changes, nothing is moved.
            for m in (1..NA).rev() {
                past[r][m] = past[r][m - 1];
            }
            past[r][0] = V::splat(y);
            chain.outputs[NA + k] = y;
        }
    }
}

/// Adds to the inputs' share of arguments that of all outputs but the newest; `past` begins with the one before it.
#[inline(always)]
fn older<V: F64x8, const NA: usize>(driven: V, weights: &[V; NA], past: &[V]) -> V {
    let mut sum = driven;
    for m in (1..NA).rev() {
        sum = sum.add_product(weights[m], past[m - 1]);
    }
    sum
}

/// Adds the squared errors of the samples that were measured; the sum of all so far.
#[inline(always)]
fn squared_errors_on<V: F64x8>(sums: &mut Lanes, y: &[f64], run: &[f64]) -> f64 {
    let mut sum = V::load(&sums.0);
    // Sample i of a block is lane i mod 8, and blocks are multiples of 8: with a record as a whole the same numbers
    // would be added in the same order.
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

/// Adds squares; what was not measured is NaN and adds nothing.
#[inline(always)]
fn square<V: F64x8>(sum: V, error: V) -> V {
    let error = error.if_equal(error, error, V::splat(0.0));
    sum.add_product(error, error)
}

/// The outputs of `samples` from `first` on; NaN from where on the run leaves the finite numbers.
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
    // The run stopped at the end of the block in which it left the numbers: what was not simulated is zeros still.
    if whole.go()[0].is_none() {
        let end = outputs.iter().position(|y| !y.is_finite());
        outputs[end.unwrap_or(0)..].fill(f64::NAN);
    }
    outputs
}

#[cfg(test)]
mod tests;
