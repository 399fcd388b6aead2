//! Exact derivatives of the free run by the forward recursion, eight columns at a time.
//!
//! With `X = dx/d(theta, x0)`: `X(k+1) = (dx+/dx) X(k) + dx+/dtheta` and `dy(k) = f'(s) ((ds/dx) X(k) + ds/dtheta)`,
//! all at the states and hidden outputs stored by the simulation.
//!
//! With `h = tanh(Wx x + Wu v + bh)` and `R = diag(1 - h^2)` the slopes are `dx+/dx = A + E R Wx` and `ds/dx = C + G R Wx`, and the
//! columns of theta come in kinds with one rule each:
//!
//! | columns | dx+/dtheta | ds/dtheta |
//! |---|---|---|
//! | Wx, Wu, bh: argument c of unit i | `E_i r_i c` | `G_i r_i c` |
//! | row q of E: unit i | `h_i` in state q | 0 |
//! | G: unit i | 0 (no recursion) | `h_i` |
//! | row q of [A B]: argument c | `c` in state q | 0 |
//! | x0 | 0, begins as the unit matrix | 0 |
//! | [C D c] | 0 (no recursion) | argument |
//!
//! In a row they are sorted by kind, with the hidden units side by side (`Columns`), so eight columns share every
//! scalar factor. Adjacent parts may overlap when written: a group with missing last units writes zeros over the next
//! group's first columns, which come later. Models of one output and up to four states process a block of samples at a
//! time (`super::single`); all others go sample by sample here.

use super::free_run::Trajectory;
use super::network::{Network, Scratch, rises_of, unrolled};
use super::shape::Shape;
use super::single::Block;
use crate::Monitor;
use crate::gram::{Gram, forget};
use crate::simd::{F64x8, Kernel, LANES, Lanes};

/// Samples between two checks of the monitor, and of sensitivities that have almost decayed.
const LOOK: usize = 64;

/// Order of the parameters' columns in a row: all hidden units for each state, for each input and for the bias, then for each row of E,
/// then for each row of G; then `[A B]` row by row, the initial state, `[C D c]` row by row, the error.
#[derive(Clone, Copy, Debug)]
pub(super) struct Columns {
    pub(super) shape: Shape,
    /// First column of G.
    pub direct: usize,
    /// First column of `[A B]`.
    pub linear: usize,
    /// First column of the initial state.
    pub state: usize,
    /// First column of `[C D c]`.
    pub sums: usize,
    /// Column of the error.
    pub error: usize,
    /// Numbers for which a row must have room: some are written beyond its end.
    pub room: usize,
}

impl Columns {
    pub fn new(shape: Shape) -> Self {
        let (nx, ny, width) = (shape.nx, shape.outputs, shape.arguments());
        //   | Wx Wu bh: width + 1 kinds | E: nx kinds | G: ny kinds | [A B] | x0 | [C D c] | error |      a kind is all hidden units
        let direct = (width + 1 + nx) * shape.hidden;
        let linear = direct + ny * shape.hidden;
        let state = linear + nx * width;
        let sums = state + nx;
        let error = sums + ny * (width + 1);
        // The last group of [A B x0] is written whole and may end beyond the error.
        let room = (error + 1).max(linear + (nx * width + nx).next_multiple_of(LANES));
        Self {
            shape,
            direct,
            linear,
            state,
            sums,
            error,
            room,
        }
    }

    /// For each entry of theta its column.
    pub fn of_theta(&self) -> Vec<usize> {
        let Shape {
            nx,
            inputs: nu,
            outputs: ny,
            hidden,
            ..
        } = self.shape;
        // theta is A, B, E, Wx, Wu, bh, C, D, c, G; a row's columns are ordered by their common factors: for a weight
        // of the hidden layer by argument, then by unit. So Wx, unit by unit in theta, is transposed here, and A and B
        // are interleaved.
        let width = nx + nu;
        let mut columns = Vec::with_capacity(self.shape.parameters());
        columns.extend((0..nx).flat_map(|q| (0..nx).map(move |j| self.linear + q * width + j)));
        columns
            .extend((0..nx).flat_map(|q| (0..nu).map(move |j| self.linear + q * width + nx + j)));
        columns.extend((0..nx * hidden).map(|i| (width + 1) * hidden + i));
        columns.extend((0..hidden).flat_map(|i| (0..nx).map(move |j| j * hidden + i)));
        columns.extend((0..hidden).flat_map(|i| (0..nu).map(move |j| (nx + j) * hidden + i)));
        columns.extend((0..hidden).map(|i| width * hidden + i));
        columns.extend((0..ny).flat_map(|p| (0..nx).map(move |j| self.sums + p * (width + 1) + j)));
        columns.extend(
            (0..ny).flat_map(|p| (0..nu).map(move |j| self.sums + p * (width + 1) + nx + j)),
        );
        columns.extend((0..ny).map(|p| self.sums + p * (width + 1) + width));
        columns.extend((0..ny * hidden).map(|i| self.direct + i));
        columns
    }
}

/// Receives the rows.
pub(super) trait Rows {
    /// Numbers from one row to the next.
    fn width(&self) -> usize;
    /// Room for `count` rows: up to a block, or one sample's.
    fn room(&mut self, count: usize) -> &mut [f64];
    /// Called when the rows are written.
    fn keep(&mut self, count: usize);
}

impl Rows for Gram {
    fn width(&self) -> usize {
        Gram::width(self)
    }

    fn room(&mut self, count: usize) -> &mut [f64] {
        Gram::room(self, count)
    }

    fn keep(&mut self, count: usize) {
        Gram::keep(self, count);
    }
}

/// The recursion with its buffers.
#[derive(Clone, Debug)]
pub(super) struct Sensitivities {
    pub(super) columns: Columns,
    /// `X` in groups of columns: for each group the rows of all states.
    //   states   | Wx, Wu, bh by argument and group | E by row and group | [A B x0] by eights |     nx groups for each
    // Eight columns with all their states are contiguous: the part of X that one step reads and writes. G and [C D c]
    // move no state and have no X.
    pub(super) states: Vec<Lanes>,
    /// `dx+/d[A B x0]`, in groups like `states`.
    // Zeros except for the argument in the column's own state, which is overwritten in the same place at every sample.
    pub(super) linear: Vec<Lanes>,
    /// `[E; f' G] diag(1 - h^2)`.
    pub(super) weighted: Vec<Lanes>,
    /// `f' ds/dx` of the outputs that are known.
    pub(super) outward: Vec<f64>,
    /// Buffer for one group of columns of the states.
    moved: Vec<Lanes>,
    pub(super) scratch: Scratch,
    pub(super) block: Block,
    /// The known outputs of a sample: index, slope of the output function, error.
    known: Vec<(usize, f64, f64)>,
}

impl Sensitivities {
    pub fn new(shape: Shape) -> Self {
        let (nx, groups) = (shape.nx, shape.hidden.div_ceil(LANES));
        let small = (nx * shape.arguments() + nx).div_ceil(LANES);
        let hidden = (shape.arguments() + 1 + nx) * groups;
        Self {
            columns: Columns::new(shape),
            states: vec![Lanes::ZERO; (hidden + small) * nx],
            linear: vec![Lanes::ZERO; small * nx],
            weighted: vec![Lanes::ZERO; (nx + shape.outputs) * groups],
            outward: vec![0.0; nx * shape.outputs],
            moved: vec![Lanes::ZERO; nx],
            scratch: Scratch::new(shape),
            block: Block::new(shape),
            known: Vec::with_capacity(shape.outputs),
        }
    }

    /// Before the first sample the states depend on themselves only.
    fn reset(&mut self) {
        let Shape { nx, .. } = self.columns.shape;
        let first = self.states.len() - self.linear.len();
        self.states.fill(Lanes::ZERO);
        for q in 0..nx {
            // dx(0)/dx0 = 1, in the columns after [A B].
            let column = self.columns.state - self.columns.linear + q;
            self.states[first + column / LANES * nx + q].0[column % LANES] = 1.0;
        }
    }
}

/// The recursion over one run, as a kernel. A stop request ends it early.
pub(super) struct Recursion<'a> {
    pub network: &'a Network,
    pub run: &'a Trajectory,
    pub v: &'a [f64],
    /// Measured outputs; an output that is NaN has no row.
    pub y: &'a [f64],
    /// Weights of the outputs; a written row is multiplied by the root of its weight. Empty if all count alike.
    pub weights: &'a [f64],
    pub buffers: &'a mut Sensitivities,
    pub rows: &'a mut dyn Rows,
    /// Whether the slopes of saturated units keep their digits; their arguments are then computed again.
    pub exact: bool,
    pub monitor: &'a Monitor,
}

impl Kernel for Recursion<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        self.buffers.reset();
        let Shape { nx, outputs, .. } = self.network.shape;
        // The sizes that are trained most use the block pass; `super::single` states its gain.
        match (outputs, nx) {
            (1, 1) => self.blocks::<V, 1>(),
            (1, 2) => self.blocks::<V, 2>(),
            (1, 3) => self.blocks::<V, 3>(),
            (1, 4) => self.blocks::<V, 4>(),
            _ => unrolled!(nx, self.samples::<V>),
        }
    }
}

impl Recursion<'_> {
    /// `NX` states; 0 for any number.
    #[inline(always)]
    fn samples<V: F64x8, const NX: usize>(self) {
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
        let Shape {
            inputs, outputs, ..
        } = network.shape;
        let nx = if NX == 0 { network.shape.nx } else { NX };
        let hidden = run.hidden.chunks_exact(network.groups());
        let samples = run
            .states
            .chunks_exact(nx)
            .zip(v.chunks_exact(inputs))
            .zip(hidden);
        let sums = run.sums.chunks_exact(outputs).zip(y.chunks_exact(outputs));
        for (k, (((x, v), h), (s, y))) in samples.zip(sums).enumerate() {
            if !buffers.look(k, monitor) {
                return;
            }
            buffers.scratch.set(x, v);
            // First everything that the columns share, then the columns: with 155 parameters X is 18 groups of three
            // registers, which here pass through memory at every sample. `super::single` keeps them in registers.
            buffers.prepare::<V>(network, h, (s, y), exact);
            let count = buffers.known.len();
            let width = rows.width();
            // A row for each known output: an unknown output takes part in the recursion but has no row.
            let room = rows.room(count);
            buffers.advance::<V, NX>(network, h, room, width);
            if let Some(weights) = weights.get(k * outputs..(k + 1) * outputs) {
                let known = buffers.known.iter().map(|&(p, ..)| weights[p]);
                weigh(known, room, width);
            }
            rows.keep(count);
        }
    }
}

/// Multiplies each of the rows, `width` numbers apart, by the root of its weight.
// Not inlined: hardly any training has weights, and without them the kernels stay unchanged.
#[inline(never)]
pub(super) fn weigh(weights: impl Iterator<Item = f64>, rows: &mut [f64], width: usize) {
    for (row, weight) in rows.chunks_mut(width).zip(weights) {
        // sum w j j' = sum (sqrt(w) j)(sqrt(w) j)'. X itself is not weighted, as the recursion continues from it.
        let root = weight.sqrt();
        row.iter_mut().for_each(|value| *value *= root);
    }
}

impl Sensitivities {
    /// Every `LOOK` samples: clears what has almost decayed; false if the monitor requests a stop.
    #[inline(always)]
    pub(super) fn look(&mut self, k: usize, monitor: &Monitor) -> bool {
        if !k.is_multiple_of(LOOK) {
            return true;
        }
        // Sensitivities to the initial state decay for ever; with denormal numbers each operation would take a hundred
        // times as long.
        for states in &mut self.states {
            states.0.iter_mut().for_each(forget);
        }
        !monitor.stopped()
    }

    /// Computes all that the columns have in common.
    #[inline(always)]
    fn prepare<V: F64x8>(
        &mut self,
        network: &Network,
        h: &[Lanes],
        (s, y): (&[f64], &[f64]),
        exact: bool,
    ) {
        let Scratch {
            arguments,
            rises,
            slopes,
            ..
        } = &mut self.scratch;
        let (nx, width) = (network.shape.nx, network.shape.arguments());
        self.known.clear();
        for (p, (s, y)) in s.iter().zip(y).enumerate() {
            let (value, slope) = network.output.value_and_slope(*s);
            // f' and the error of each known output; s and f' are those of the free run.
            if !y.is_nan() {
                self.known.push((p, slope, y - value));
            }
        }
        // 1 - h^2 loses its digits if h is near 1. In training that is far below the resolution of the sum of squares;
        // in a Jacobian that leaves the core it would be wrong.
        if exact {
            network.rises::<V>(arguments, rises);
        } else {
            rises_of::<V>(h, rises);
        }
        network.slopes::<V>(rises, slopes);
        for (row, outward) in self.known.iter().zip(self.outward.chunks_exact_mut(nx)) {
            for (j, outward) in outward.iter_mut().enumerate() {
                let at = (nx + row.0) * nx + j;
                // Row nx + p of the slopes is ds_p/dx.
                *outward = row.1 * slopes[at / LANES].0[at % LANES];
            }
        }
        // E diag(1 - h^2) and f' G diag(1 - h^2): common to all weights of a hidden unit, so computed once a sample,
        // not once a column.
        let groups = rises.len();
        let of_outputs = self
            .known
            .iter()
            .map(|&(p, steepness, _)| (nx + p, steepness));
        for (row, steepness) in (0..nx).map(|q| (q, 1.0)).chain(of_outputs) {
            let weights = &network.second[row * groups..][..groups];
            let weighted = &mut self.weighted[row * groups..][..groups];
            for ((weighted, weight), rise) in weighted.iter_mut().zip(weights).zip(&*rises) {
                let weight = V::load(&weight.0).mul(V::splat(steepness));
                weight.mul(V::load(&rise.0)).store(&mut weighted.0);
            }
        }
        // The argument in row q of [A B] moves state q: column q width + c, row q.
        for q in 0..nx {
            for (c, value) in arguments[..width].iter().enumerate() {
                let column = q * width + c;
                self.linear[column / LANES * nx + q].0[column % LANES] = *value;
            }
        }
    }

    /// Writes the sample's rows and takes `X` to the next sample.
    #[inline(always)]
    fn advance<V: F64x8, const NX: usize>(
        &mut self,
        network: &Network,
        h: &[Lanes],
        rows: &mut [f64],
        stride: usize,
    ) {
        let nx = if NX == 0 { network.shape.nx } else { NX };
        let (groups, hidden) = (h.len(), network.shape.hidden);
        let width = network.shape.arguments();
        // [E; f' G] diag(1 - h^2): rows of the states, then of those outputs that are known in this sample.
        let (of_states, of_outputs) = self.weighted.split_at(nx * groups);
        // F broadcast once for all columns: NX^2 registers, at most 16 of 32.
        let mut onward = [[V::splat(0.0); NX]; NX];
        for (i, slope) in onward.as_flattened_mut().iter_mut().enumerate() {
            *slope = V::splat(self.scratch.slope(i));
        }
        let slopes = Slopes::<V, NX> {
            onward,
            scratch: &self.scratch,
            outward: &self.outward,
            known: &self.known,
        };
        let moved = &mut self.moved;
        let mut states = self.states.chunks_exact_mut(nx);
        // Wx, Wu, bh: the weighted rows of all units times each argument c, the last of which is 1.
        for (c, argument) in self.scratch.arguments.iter().enumerate() {
            let argument = V::splat(*argument);
            for g in 0..groups {
                let Some(x) = states.next() else { return };
                let place = (c * hidden + g * LANES, stride);
                slopes.advance(
                    x,
                    moved,
                    rows,
                    place,
                    |p| argument.mul(V::load(&of_outputs[p * groups + g].0)),
                    |q| argument.mul(V::load(&of_states[q * groups + g].0)),
                );
            }
        }
        // E: h_i moves only state q for unit i of row q.
        for row in 0..nx {
            for (g, h) in h.iter().enumerate() {
                let Some(x) = states.next() else { return };
                let start = (width + 1 + row) * hidden + g * LANES;
                let place = (start, stride);
                let own = |q: usize| {
                    if q == row {
                        V::load(&h.0)
                    } else {
                        V::splat(0.0)
                    }
                };
                slopes.advance(x, moved, rows, place, |_| V::splat(0.0), own);
            }
        }
        // G comes between E and [A B] in a row, and its groups write beyond their end as the others do: this order must
        // be kept.
        slopes.write_direct(h, rows, stride, self.columns.direct, hidden);
        // [A B x0]: `linear` has the argument in the row of the column's own state.
        for (i, linear) in self.linear.chunks_exact(nx).enumerate() {
            let Some(x) = states.next() else { return };
            let start = self.columns.linear + i * LANES;
            let place = (start, stride);
            slopes.advance(
                x,
                moved,
                rows,
                place,
                |_| V::splat(0.0),
                |q| V::load(&linear[q].0),
            );
        }
        slopes.write_sums(rows, stride, &self.columns);
    }
}

/// The slopes of one sample.
struct Slopes<'a, V, const NX: usize> {
    /// `dx+/dx` in registers, if the number of states is a constant.
    // Empty if NX is 0: the general step then reads `scratch`.
    onward: [[V; NX]; NX],
    scratch: &'a Scratch,
    outward: &'a [f64],
    known: &'a [(usize, f64, f64)],
}

impl<V: F64x8, const NX: usize> Slopes<'_, V, NX> {
    /// Writes one group of columns into the rows, from `start` on, and advances its `X` by one step. `direct(p)` and
    /// `next(q)` are `f' ds/dtheta` and `dx+/dtheta`.
    #[inline(always)]
    fn advance(
        &self,
        x: &mut [Lanes],
        moved: &mut [Lanes],
        rows: &mut [f64],
        (start, stride): (usize, usize),
        direct: impl Fn(usize) -> V,
        next: impl Fn(usize) -> V,
    ) {
        let nx = x.len();
        // dy = f' (ds/dx X + ds/dtheta), with X before the step.
        let outward = self.outward.chunks_exact(nx);
        // Each known output has its own row, `stride` numbers apart.
        for (row, ((p, ..), outward)) in self.known.iter().zip(outward).enumerate() {
            let sum = outward.iter().zip(&*x).fold(direct(*p), |sum, (slope, x)| {
                sum.add_product(V::splat(*slope), V::load(&x.0))
            });
            sum.write(&mut rows[start + row * stride..]);
        }
        // All states are read before one is written: the new ones go to a buffer first.
        if NX == 0 {
            for (q, moved) in moved.iter_mut().enumerate() {
                let sum = x.iter().enumerate().fold(next(q), |sum, (j, x)| {
                    let slope = V::splat(self.scratch.slope(q * nx + j));
                    sum.add_product(slope, V::load(&x.0))
                });
                sum.store(&mut moved.0);
            }
            x.copy_from_slice(moved);
            return;
        }
        let mut old = [V::splat(0.0); NX];
        for (old, x) in old.iter_mut().zip(&*x) {
            *old = V::load(&x.0);
        }
        for (q, (x, slopes)) in x.iter_mut().zip(&self.onward).enumerate() {
            let sum = slopes
                .iter()
                .zip(&old)
                .fold(next(q), |sum, (slope, old)| sum.add_product(*slope, *old));
            sum.store(&mut x.0);
        }
    }

    /// The columns of G.
    #[inline(always)]
    fn write_direct(
        &self,
        h: &[Lanes],
        rows: &mut [f64],
        stride: usize,
        first: usize,
        hidden: usize,
    ) {
        let outputs = self.scratch.sums.len();
        for (row, &(own, steepness, _)) in rows.chunks_exact_mut(stride).zip(self.known) {
            for p in 0..outputs {
                for (g, h) in h.iter().enumerate() {
                    // ds_p/dG_q = h if p = q, else 0.
                    let factor = if p == own { steepness } else { 0.0 };
                    let place = &mut row[first + p * hidden + g * LANES..];
                    V::load(&h.0).mul(V::splat(factor)).write(place);
                }
            }
        }
    }

    /// The columns of `[C D c]` and the error.
    #[inline(always)]
    fn write_sums(&self, rows: &mut [f64], stride: usize, columns: &Columns) {
        let arguments = &self.scratch.arguments;
        for (row, &(own, steepness, error)) in rows.chunks_exact_mut(stride).zip(self.known) {
            // [C D c] row by row, each as wide as the arguments including their 1.
            let sums = row[columns.sums..columns.error].chunks_exact_mut(arguments.len());
            for (p, sums) in sums.enumerate() {
                let factor = if p == own { steepness } else { 0.0 };
                for (sum, argument) in sums.iter_mut().zip(arguments) {
                    *sum = factor * argument;
                }
            }
            row[columns.error] = error;
        }
    }
}
