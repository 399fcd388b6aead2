//! The sensitivity recursion for up to four states, a block of samples at a time. Everything that the
//! columns share is prepared for all samples of the block; then each group of columns passes over them with its states
//! in registers.
//!
//! With `X(k) = dx(k)/dtheta`, `F = dx+/dx` and `f'` the slope of the output function,
//!
//! ```text
//!   X(k+1) = F(k) X(k) + dx+/dtheta(k)         NX x p,  a column a parameter
//!   dy(k)  = f'(k) (ds/dx(k) X(k) + ds/dtheta(k))
//! ```
//!
//! Columns are independent: eight of them, for all NX states, are NX registers (`[V; NX]`), and F is the same for all columns. So the
//! loops are exchanged. First everything that depends on the sample alone, for a block of 32 samples (`Block`):
//!
//! ```text
//!   slopes     F and f' ds/dx, NX (NX + 1) numbers a sample      broadcast while a column passes
//!   rises      1 - h^2                                           feeds the two below
//!   weighted   E diag(1 - h^2)    group, sample, state           dx+/dtheta of Wx, Wu, bh
//!   direct     f' G diag(1 - h^2) group, sample                  ds/dtheta of the same
//!   spaced     | 0 .. 0 | x v |   one run of zeros a sample      dx+/dtheta of [A B]: row q of A is (x v) shifted by q rows
//! ```
//!
//! Then one or two groups of columns pass over the 32 samples. A `Source` is what a kind of columns adds: weights of an
//! argument (`OfArgument`), a row of E (`OfUnits`: it moves state q only), `[A B x0]` (`OfStates`). A source returns
//! `None` if it adds nothing, so no zeros are added. Ownership: `Sensitivities` owns X between blocks, `Block` the
//! block's numbers, the caller the rows (`Rows`).
//!
//! Why it exists: compared with the general recursion, sample by sample, a training of 3 states and 15 units takes 5 % less by the least
//! and 11 % by the median of 7 runs (processor time, Zen 4; the recursion alone takes 150 instead of 166 ns a sample on an Intel Xeon).
//! With 32 registers two groups at once fill the latency of the products, by count of operations; a Zen 4 shows no gain
//! (`state_space_training_8`, least and median of 80 alike). Processors whose units are as wide as the registers have not been measured.

use super::network::{Network, rises_of};
use super::sensitivities::{Recursion, Sensitivities, weigh};
use super::shape::Shape;
use crate::simd::{F64x8, LANES, Lanes};

/// Samples of a block: what all groups of columns read then stays in the first-level cache.
pub(super) const BLOCK: usize = 32;
/// Most states of a small model.
pub(super) const MOST_STATES: usize = 4;
/// Number of groups that hold the slopes of one sample.
const SLOPES: usize = ((MOST_STATES + 1) * MOST_STATES).div_ceil(LANES);

/// What the columns have in common, for each sample of a block.
#[derive(Clone, Debug)]
pub(super) struct Block {
    /// `dx+/dx`, then `f' ds/dx`, row by row.
    // Fixed sizes for the most states: 20 numbers in three groups a sample, 6 kB a block.
    slopes: Box<[[Lanes; SLOPES]; BLOCK]>,
    /// `1 - h^2`.
    rises: Vec<Lanes>,
    /// States, inputs and 1, one after the other.
    // By argument, then by sample: a group of columns reads one argument along the block.
    arguments: Vec<[f64; BLOCK]>,
    /// `E diag(1 - h^2)`: for each group and sample the rows of all states.
    // By group first: a group's columns pass over all samples and read nothing of the others.
    weighted: Vec<Lanes>,
    /// `f' G diag(1 - h^2)` for each group.
    direct: Vec<[Lanes; BLOCK]>,
    /// `f'` and the error.
    outputs: [(f64, f64); BLOCK],
    /// Offset of the sample's row or, if it has none, of the next row.
    // Unknown outputs have no rows: the row of such a sample is written to the place of the next one, which overwrites
    // it.
    places: [usize; BLOCK],
    /// States and inputs of a sample, after as many zeros as the columns of `[A B]` may be away from them.
    //   sample k   | 0 .. 0, nx width + 8 of them | x v |
    // Column i, in the order of [A B x0], moves state q by argument i - q width, if that exists. So eight columns are
    // one load, `width` numbers further left for each next state, with zeros if a column belongs to another row.
    // Columns beyond x v, including x0, read the zeros of the next sample.
    spaced: Vec<f64>,
    /// Distance from one sample's states to the next one's.
    space: usize,
}

impl Block {
    pub fn new(shape: Shape) -> Self {
        let groups = shape.hidden.div_ceil(LANES);
        // Zeros for nx - 1 rows before the numbers, and after them for the rows and x0 of the previous sample.
        let space = (shape.nx + 1) * shape.arguments() + LANES;
        Self {
            slopes: Box::new([[Lanes::ZERO; SLOPES]; BLOCK]),
            rises: vec![Lanes::ZERO; BLOCK * groups],
            arguments: vec![[1.0; BLOCK]; shape.arguments() + 1],
            weighted: vec![Lanes::ZERO; groups * BLOCK * shape.nx],
            direct: vec![[Lanes::ZERO; BLOCK]; groups],
            outputs: [(0.0, 0.0); BLOCK],
            places: [0; BLOCK],
            spaced: vec![0.0; (BLOCK + 1) * space],
            space,
        }
    }

    /// Sets the states and inputs of sample `k`.
    #[inline(always)]
    fn set(&mut self, k: usize, x: &[f64], v: &[f64]) {
        // The numbers end where sample k + 1's space begins; the zeros were written once and stay.
        let spaced = &mut self.spaced[(k + 1) * self.space - x.len() - v.len()..];
        let values = x.iter().chain(v);
        for ((value, argument), spaced) in values.zip(&mut self.arguments).zip(spaced) {
            argument[k] = *value;
            *spaced = *value;
        }
    }
}

/// What a group of columns adds at a sample: `f' ds/dtheta`, and `dx+/dtheta` for each state; `None` is zero.
#[derive(Clone, Copy)]
struct Gains<V, const NX: usize> {
    // The compiler resolves these `Option`s: for a kind of columns each is always or never present, so the code neither
    // tests them nor adds zeros.
    direct: Option<V>,
    next: [Option<V>; NX],
}

/// A kind of columns.
trait Source<const NX: usize>: Copy {
    fn gains<V: F64x8>(&self, k: usize) -> Gains<V, NX>;
}

/// Weights of one argument on a group of hidden units.
#[derive(Clone, Copy)]
struct OfArgument<'a, const NX: usize> {
    argument: &'a [f64; BLOCK],
    weighted: &'a [[Lanes; NX]; BLOCK],
    direct: &'a [Lanes; BLOCK],
}

impl<const NX: usize> Source<NX> for OfArgument<'_, NX> {
    #[inline(always)]
    fn gains<V: F64x8>(&self, k: usize) -> Gains<V, NX> {
        // dx+_q/dW = E_q (1 - h^2) c, eight units at once.
        let argument = V::splat(self.argument[k]);
        let mut next = [None; NX];
        for (next, weighted) in next.iter_mut().zip(&self.weighted[k]) {
            *next = Some(argument.mul(V::load(&weighted.0)));
        }
        let direct = Some(argument.mul(V::load(&self.direct[k].0)));
        Gains { direct, next }
    }
}

/// Row `Q` of E, for a group of hidden units.
#[derive(Clone, Copy)]
struct OfUnits<'a, const Q: usize> {
    /// Hidden outputs from this group on, and the number of groups.
    hidden: &'a [Lanes],
    groups: usize,
}

impl<const NX: usize, const Q: usize> Source<NX> for OfUnits<'_, Q> {
    #[inline(always)]
    fn gains<V: F64x8>(&self, k: usize) -> Gains<V, NX> {
        let mut next = [None; NX];
        // Q is a constant, so the only state that moves is known at compile time.
        if let Some(next) = next.get_mut(Q) {
            *next = Some(V::load(&self.hidden[k * self.groups].0));
        }
        Gains { direct: None, next }
    }
}

/// A group of `[A B x0]`.
#[derive(Clone, Copy)]
struct OfStates<'a> {
    /// States and inputs between zeros, from this group's position for the first state.
    spaced: &'a [f64],
    space: usize,
    width: usize,
}

impl<const NX: usize> Source<NX> for OfStates<'_> {
    #[inline(always)]
    fn gains<V: F64x8>(&self, k: usize) -> Gains<V, NX> {
        let mut next = [None; NX];
        // State NX - 1 - q: one row up in [A B] is `width` numbers further right in the zeros.
        for (q, next) in next.iter_mut().rev().enumerate() {
            let start = k * self.space + q * self.width;
            *next = Some(V::first(&self.spaced[start..]));
        }
        Gains { direct: None, next }
    }
}

impl Block {
    /// `E diag(1 - h^2)` and `f' G diag(1 - h^2)` of all samples.
    #[inline(always)]
    fn weigh<V: F64x8, const NX: usize>(&mut self, network: &Network, count: usize) {
        let groups = self.direct.len();
        // [group][sample][state] as arrays of known length: no index is checked within the loops.
        let (weighted, _) = self.weighted.as_chunks_mut::<NX>();
        let (weighted, _) = weighted.as_chunks_mut::<BLOCK>();
        for (g, (weighted, direct)) in weighted.iter_mut().zip(&mut self.direct).enumerate() {
            let mut weights = [V::splat(0.0); NX];
            for (q, weight) in weights.iter_mut().enumerate() {
                *weight = V::load(&network.second[q * groups + g].0);
            }
            let outward = V::load(&network.second[NX * groups + g].0);
            for k in 0..count.min(BLOCK) {
                let rise = V::load(&self.rises[k * groups + g].0);
                for (weighted, weight) in weighted[k].iter_mut().zip(weights) {
                    weight.mul(rise).store(&mut weighted.0);
                }
                let steepness = V::splat(self.outputs[k].0);
                outward.mul(steepness).mul(rise).store(&mut direct[k].0);
            }
        }
    }

    /// `dx+/dx` and `f' ds/dx` of all samples.
    #[inline(always)]
    fn incline<V: F64x8, const NX: usize>(&mut self, network: &Network, count: usize) {
        let used = (NX * (NX + 1)).div_ceil(LANES);
        let rises = self.rises.chunks_exact(network.groups());
        for (slopes, rises) in self.slopes[..count].iter_mut().zip(rises) {
            network.slopes::<V>(rises, &mut slopes[..used]);
        }
        for (slopes, (steepness, _)) in self.slopes.iter_mut().zip(self.outputs).take(count) {
            // The output function is usually the identity.
            if steepness != 1.0 {
                for at in NX * NX..NX * (NX + 1) {
                    slopes[at / LANES].0[at % LANES] *= steepness;
                }
            }
        }
    }

    /// Passes all groups of a kind over the block, as many at a time as registers allow.
    #[inline(always)]
    fn pass_all<V: F64x8, const NX: usize, S: Source<NX>>(
        &self,
        count: usize,
        states: &mut [[Lanes; NX]],
        source: impl Fn(usize) -> S,
        start: impl Fn(usize) -> usize,
        rows: &mut [f64],
    ) {
        let mut i = 0;
        // In the order of the columns: a group of fewer than eight writes over the next one's first columns. Counted
        // for 3 states: a group is 12 fused operations a sample, 6 cycles on two units, but its chain of three takes
        // 12. With 32 registers a second group fits into that; with 16 there is no room. If a register is processed in
        // halves (Zen 4), one group fills the 12 cycles by itself. The condition is a constant.
        while V::TILE_ROWS == LANES && i + 2 <= states.len() {
            let sources = [source(i), source(i + 1)];
            let starts = [start(i), start(i + 1)];
            self.pass::<V, NX, 2>(count, &mut states[i..i + 2], sources, starts, rows);
            i += 2;
        }
        while i < states.len() {
            let (sources, starts) = ([source(i)], [start(i)]);
            self.pass::<V, NX, 1>(count, &mut states[i..=i], sources, starts, rows);
            i += 1;
        }
    }

    /// The columns of row `Q` of E; `first` is the first of them.
    #[inline(always)]
    fn pass_row<V: F64x8, const NX: usize, const Q: usize>(
        &self,
        part: &Part,
        states: &mut [[Lanes; NX]],
        first: usize,
        rows: &mut [f64],
    ) {
        // This model has no such row, and no code is generated for it.
        if Q >= NX {
            return;
        }
        let groups = states.len();
        let source = |g: usize| OfUnits::<Q> {
            hidden: &part.hidden[g..],
            groups,
        };
        let start = |g: usize| first + g * LANES;
        self.pass_all::<V, NX, _>(part.sums.len(), states, source, start, rows);
    }

    /// Passes `GROUPS` groups of columns over the block; their parts of the rows begin at `starts`.
    #[inline(always)]
    fn pass<V: F64x8, const NX: usize, const GROUPS: usize>(
        &self,
        count: usize,
        states: &mut [[Lanes; NX]],
        sources: [impl Source<NX>; GROUPS],
        starts: [usize; GROUPS],
        rows: &mut [f64],
    ) {
        // X of these columns: loaded once, kept in registers for 32 samples, stored once. Sample by sample, each of the
        // 18 groups of 155 parameters would go through memory at every sample.
        let mut x = [[V::splat(0.0); NX]; GROUPS];
        for (x, states) in x.iter_mut().zip(&*states) {
            for (x, state) in x.iter_mut().zip(states) {
                *x = V::load(&state.0);
            }
        }
        for k in 0..count.min(BLOCK) {
            let slopes = &self.slopes[k];
            // A broadcast load; all groups of columns read the same few cache lines.
            let slope = |i: usize| slopes[i / LANES].0[i % LANES];
            let mut sums = [[None; NX]; GROUPS];
            for g in 0..GROUPS {
                let gains = sources[g].gains::<V>(k);
                let mut sum = gains.direct;
                for (j, x) in x[g].iter().enumerate() {
                    // dy = direct + sum_j (f' ds/dx_j) X_j, before X moves.
                    sum = Some(plus(sum, V::splat(slope(NX * NX + j)), *x));
                }
                if let (Some(sum), Some(row)) = (sum, rows.get_mut(self.places[k] + starts[g]..)) {
                    sum.write(row);
                }
                sums[g] = gains.next;
            }
            // X+_q = gains_q + sum_j F_qj X_j. Slopes in the outer loop, groups in the inner one: a slope is broadcast
            // once for all groups. The results stay in `sums` because all of X is needed until the last row is done.
            for at in 0..NX * NX {
                let (q, j) = (at / NX, at % NX);
                let slope = V::splat(slope(at));
                for g in 0..GROUPS {
                    sums[g][q] = Some(plus(sums[g][q], slope, x[g][j]));
                }
            }
            for (x, sums) in x.iter_mut().zip(sums) {
                for (x, sum) in x.iter_mut().zip(sums) {
                    if let Some(sum) = sum {
                        *x = sum;
                    }
                }
            }
        }
        for (x, states) in x.iter().zip(states) {
            for (x, state) in x.iter().zip(states) {
                x.store(&mut state.0);
            }
        }
    }
}

/// `sum + slope x`, or `slope x` if there is no sum yet.
#[inline(always)]
fn plus<V: F64x8>(sum: Option<V>, slope: V, x: V) -> V {
    match sum {
        Some(sum) => sum.add_product(slope, x),
        None => slope.mul(x),
    }
}

impl Recursion<'_> {
    /// The whole run, block by block.
    #[inline(always)]
    pub(super) fn blocks<V: F64x8, const NX: usize>(self) {
        let Self {
            network,
            run,
            v,
            y,
            weights,
            buffers,
            rows,
            exact,
            monitor,
        } = self;
        let (groups, inputs) = (network.groups(), network.shape.inputs);
        for start in (0..run.sums.len()).step_by(BLOCK) {
            let count = BLOCK.min(run.sums.len() - start);
            // Effective at every second block, as 32 divides 64.
            if !buffers.look(start, monitor) {
                return;
            }
            let samples = start..start + count;
            // The free run's results for these samples; only 1 - h^2 is computed again.
            let part = Part {
                states: &run.states[samples.start * NX..samples.end * NX],
                hidden: &run.hidden[samples.start * groups..samples.end * groups],
                sums: &run.sums[samples.clone()],
                v: &v[samples.start * inputs..samples.end * inputs],
                y: &y[samples.clone()],
            };
            let width = rows.width();
            let known = buffers.prepare_block::<V, NX>(network, &part, width, exact);
            let room = rows.room(count);
            // In the order of the columns: groups write beyond their end, over what comes next.
            buffers.pass_arguments::<V, NX>(count, room);
            buffers.pass_units::<V, NX>(&part, room);
            buffers.pass_rest::<V, NX>(&part, room);
            if let Some(weights) = weights.get(samples) {
                // Unknown outputs have no rows, so their weights are skipped.
                let known = weights.iter().zip(part.y).filter(|(_, y)| !y.is_nan());
                weigh(known.map(|(w, _)| *w), room, width);
            }
            rows.keep(known);
        }
    }
}

/// The simulation's results for a block, with its inputs and measured outputs.
struct Part<'a> {
    states: &'a [f64],
    hidden: &'a [Lanes],
    sums: &'a [f64],
    v: &'a [f64],
    y: &'a [f64],
}

impl Sensitivities {
    /// Computes all that the columns have in common; returns how many samples have a row.
    #[inline(always)]
    fn prepare_block<V: F64x8, const NX: usize>(
        &mut self,
        network: &Network,
        part: &Part,
        width: usize,
        exact: bool,
    ) -> usize {
        let (groups, inputs) = (network.groups(), network.shape.inputs);
        let Self { block, scratch, .. } = self;
        let mut known = 0;
        for (k, (s, y)) in part.sums.iter().zip(part.y).enumerate().take(BLOCK) {
            let (value, steepness) = network.output.value_and_slope(*s);
            block.outputs[k] = (steepness, y - value);
            // The last one may be a row beyond those that are kept: `room` is for all of the block's samples.
            block.places[k] = known * width;
            known += usize::from(!y.is_nan());
        }
        let arguments = part.states.chunks_exact(NX);
        let arguments = arguments.zip(part.v.chunks_exact(inputs));
        for (k, (x, v)) in arguments.enumerate().take(BLOCK) {
            block.set(k, x, v);
            // Per sample, for a Jacobian that leaves the core; a training takes the block's stored h at once.
            if exact {
                scratch.set(x, v);
                network.rises::<V>(&scratch.arguments, &mut block.rises[k * groups..][..groups]);
            }
        }
        if !exact {
            rises_of::<V>(part.hidden, &mut block.rises);
        }
        block.incline::<V, NX>(network, part.sums.len());
        block.weigh::<V, NX>(network, part.sums.len());
        known
    }

    /// The columns of the hidden units' weights for states and inputs, and of their biases.
    #[inline(always)]
    fn pass_arguments<V: F64x8, const NX: usize>(&mut self, count: usize, rows: &mut [f64]) {
        let (block, hidden) = (&self.block, self.columns.shape.hidden);
        let groups = block.direct.len();
        let (weighted, _) = block.weighted.as_chunks::<NX>();
        let (weighted, _) = weighted.as_chunks::<BLOCK>();
        // Column group i: argument i / groups, units of group i mod groups.
        let source = |i: usize| OfArgument {
            argument: &block.arguments[i / groups],
            weighted: &weighted[i % groups],
            direct: &block.direct[i % groups],
        };
        // Kinds of units follow each other without gaps, so a row is short; groups within a kind are eight apart.
        let start = |i: usize| i / groups * hidden + i % groups * LANES;
        let (states, _) = self.states.as_chunks_mut::<NX>();
        let states = &mut states[..block.arguments.len() * groups];
        block.pass_all::<V, NX, _>(count, states, source, start, rows);
    }

    /// The columns of E.
    #[inline(always)]
    fn pass_units<V: F64x8, const NX: usize>(&mut self, part: &Part, rows: &mut [f64]) {
        let (states, _) = self.states.as_chunks_mut::<NX>();
        let groups = self.block.direct.len();
        let states = &mut states[self.block.arguments.len() * groups..];
        for (q, states) in states.chunks_exact_mut(groups).take(NX).enumerate() {
            let first = (self.block.arguments.len() + q) * self.columns.shape.hidden;
            // The row as a constant: the compiler then knows which state a column moves.
            match q {
                0 => self.block.pass_row::<V, NX, 0>(part, states, first, rows),
                1 => self.block.pass_row::<V, NX, 1>(part, states, first, rows),
                2 => self.block.pass_row::<V, NX, 2>(part, states, first, rows),
                _ => self.block.pass_row::<V, NX, 3>(part, states, first, rows),
            }
        }
    }

    /// The columns of G, of `[A B x0]` and of `[C D c]`, and the error.
    #[inline(always)]
    fn pass_rest<V: F64x8, const NX: usize>(&mut self, part: &Part, rows: &mut [f64]) {
        let (columns, block) = (self.columns, &self.block);
        let groups = block.direct.len();
        for (k, h) in part.hidden.chunks_exact(groups).enumerate().take(BLOCK) {
            let steepness = V::splat(block.outputs[k].0);
            let row = &mut rows[block.places[k] + columns.direct..];
            for (g, h) in h.iter().enumerate() {
                // ds/dG = h: no recursion, so no pass.
                let part = V::load(&h.0).mul(steepness);
                part.write(&mut row[g * LANES..]);
            }
        }
        let width = columns.shape.arguments();
        let source = |i: usize| OfStates {
            spaced: &block.spaced[block.space - NX * width + i * LANES..],
            space: block.space,
            width,
        };
        let start = |i: usize| columns.linear + i * LANES;
        let (states, _) = self.states.as_chunks_mut::<NX>();
        let states = &mut states[(block.arguments.len() + NX) * groups..];
        block.pass_all::<V, NX, _>(part.sums.len(), states, source, start, rows);
        for k in 0..part.sums.len().min(BLOCK) {
            let (steepness, error) = block.outputs[k];
            let row = &mut rows[block.places[k] + columns.sums..];
            let (sums, rest) = row.split_at_mut(columns.error - columns.sums);
            for (sum, argument) in sums.iter_mut().zip(&block.arguments) {
                // ds/d[C D c] = the arguments, the last of which is 1.
                *sum = steepness * argument[k];
            }
            rest[0] = error;
        }
    }
}
