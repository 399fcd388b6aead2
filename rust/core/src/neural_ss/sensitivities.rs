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
//! group's first columns, which come later. Models of up to four states process a block of samples at a
//! time (`super::single`); all others go sample by sample here.

use super::free_run::Trajectory;
use super::network::{Network, Scratch, rises_of};
use super::shape::Shape;
use super::single::Block;
use crate::Monitor;
use crate::gram::{Gram, forget};
use crate::simd::{F64x8, Kernel, LANES, Lanes};

/// Samples between two checks of the monitor, and of sensitivities that have almost decayed.
const LOOK: usize = 64;

/// Order of the parameters' columns in a row: all hidden units for each state, for each input and for the bias, then for each row of E,
/// then for G; then `[A B]` row by row, the initial state, `[C D c]`, the error.
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
        let (nx, width) = (shape.nx, shape.arguments());
        //   | Wx Wu bh: width + 1 kinds | E: nx kinds | G | [A B] | x0 | [C D c] | error |      a kind is all hidden units
        let direct = (width + 1 + nx) * shape.hidden;
        let linear = direct + shape.hidden;
        let state = linear + nx * width;
        let sums = state + nx;
        let error = sums + width + 1;
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
        columns.extend(self.sums..self.error);
        columns.extend(self.direct..self.linear);
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
    /// `f' ds/dx`.
    pub(super) outward: Vec<f64>,
    /// Buffer for one group of columns of the states.
    moved: Vec<Lanes>,
    pub(super) scratch: Scratch,
    pub(super) block: Block,
    /// Slope of the output function and error of a sample whose output is known.
    known: Option<(f64, f64)>,
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
            weighted: vec![Lanes::ZERO; (nx + 1) * groups],
            outward: vec![0.0; nx],
            moved: vec![Lanes::ZERO; nx],
            scratch: Scratch::new(shape),
            block: Block::new(shape),
            known: None,
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
        // The sizes that are trained most use the block pass; `super::single` states its gain.
        match self.network.shape.nx {
            1 => self.blocks::<V, 1>(),
            2 => self.blocks::<V, 2>(),
            3 => self.blocks::<V, 3>(),
            4 => self.blocks::<V, 4>(),
            _ => self.samples::<V>(),
        }
    }
}

impl Recursion<'_> {
    #[inline(always)]
    fn samples<V: F64x8>(self) {
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
        let Shape { nx, inputs, .. } = network.shape;
        let hidden = run.hidden.chunks_exact(network.groups());
        let samples = run
            .states
            .chunks_exact(nx)
            .zip(v.chunks_exact(inputs))
            .zip(hidden);
        for (k, (((x, v), h), (s, y))) in samples.zip(run.sums.iter().zip(y)).enumerate() {
            if !buffers.look(k, monitor) {
                return;
            }
            buffers.scratch.set(x, v);
            // First everything that the columns share, then the columns: X passes through memory at every sample, while
            // `super::single` keeps it in registers.
            buffers.prepare::<V>(network, h, (*s, *y), exact);
            // An unknown output takes part in the recursion but has no row.
            let count = usize::from(buffers.known.is_some());
            let width = rows.width();
            let room = rows.room(count);
            buffers.advance::<V>(network, h, room);
            weigh(weights.get(k).copied().into_iter(), room, width);
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
        (s, y): (f64, f64),
        exact: bool,
    ) {
        let Scratch {
            arguments,
            rises,
            slopes,
            ..
        } = &mut self.scratch;
        let (nx, width) = (network.shape.nx, network.shape.arguments());
        // f' and the error of a known output; s and f' are those of the free run.
        let (value, steepness) = network.output.value_and_slope(s);
        self.known = (!y.is_nan()).then_some((steepness, y - value));
        // 1 - h^2 loses its digits if h is near 1. In training that is far below the resolution of the sum of squares;
        // in a Jacobian that leaves the core it would be wrong.
        if exact {
            network.rises::<V>(arguments, rises);
        } else {
            rises_of::<V>(h, rises);
        }
        network.slopes::<V>(rises, slopes);
        for (j, outward) in self.outward.iter_mut().enumerate() {
            // The last row of the slopes is ds/dx.
            let at = nx * nx + j;
            *outward = steepness * slopes[at / LANES].0[at % LANES];
        }
        // E diag(1 - h^2) and f' G diag(1 - h^2): common to all weights of a hidden unit, so computed once a sample,
        // not once a column.
        let groups = network.groups();
        let of_output = (nx, steepness);
        for (row, steepness) in (0..nx).map(|q| (q, 1.0)).chain([of_output]) {
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

    /// Writes the sample's row, if its output is known, and takes `X` to the next sample.
    #[inline(always)]
    fn advance<V: F64x8>(&mut self, network: &Network, h: &[Lanes], row: &mut [f64]) {
        let (nx, groups, hidden) = (network.shape.nx, h.len(), network.shape.hidden);
        let width = network.shape.arguments();
        // [E; f' G] diag(1 - h^2): rows of the states, then of the output.
        let (of_states, of_output) = self.weighted.split_at(nx * groups);
        let mut step = Step {
            scratch: &self.scratch,
            outward: &self.outward,
            moved: &mut self.moved,
            row,
        };
        let zero = V::splat(0.0);
        let mut states = self.states.chunks_exact_mut(nx);
        // Wx, Wu, bh: the weighted rows of all units times each argument c, the last of which is 1.
        for (c, argument) in self.scratch.arguments.iter().enumerate() {
            let argument = V::splat(*argument);
            for g in 0..groups {
                let Some(x) = states.next() else { return };
                let direct = argument.mul(V::load(&of_output[g].0));
                let next = |q: usize| argument.mul(V::load(&of_states[q * groups + g].0));
                step.advance(x, c * hidden + g * LANES, direct, next);
            }
        }
        // E: h_i moves only state q for unit i of row q.
        for row in 0..nx {
            for (g, h) in h.iter().enumerate() {
                let Some(x) = states.next() else { return };
                let own = |q: usize| if q == row { V::load(&h.0) } else { zero };
                step.advance(x, (width + 1 + row) * hidden + g * LANES, zero, own);
            }
        }
        // G comes between E and [A B] in a row, and its groups write beyond their end as the others do: this order must
        // be kept.
        if let Some((steepness, _)) = self.known {
            for (g, h) in h.iter().enumerate() {
                let place = &mut step.row[self.columns.direct + g * LANES..];
                V::load(&h.0).mul(V::splat(steepness)).write(place);
            }
        }
        // [A B x0]: `linear` has the argument in the row of the column's own state.
        for (i, linear) in self.linear.chunks_exact(nx).enumerate() {
            let Some(x) = states.next() else { return };
            let own = |q: usize| V::load(&linear[q].0);
            step.advance(x, self.columns.linear + i * LANES, zero, own);
        }
        if let Some((steepness, error)) = self.known {
            let sums = &mut step.row[self.columns.sums..];
            for (sum, argument) in sums.iter_mut().zip(&self.scratch.arguments) {
                *sum = steepness * argument;
            }
            step.row[self.columns.error] = error;
        }
    }
}

/// The step of one sample.
struct Step<'a> {
    scratch: &'a Scratch,
    outward: &'a [f64],
    moved: &'a mut [Lanes],
    /// Empty if the output is unknown.
    row: &'a mut [f64],
}

impl Step<'_> {
    /// Writes one group of columns into the row, from `start` on, and advances its `X` by one step. `direct` and
    /// `next(q)` are `f' ds/dtheta` and `dx+/dtheta`.
    #[inline(always)]
    fn advance<V: F64x8>(
        &mut self,
        x: &mut [Lanes],
        start: usize,
        direct: V,
        next: impl Fn(usize) -> V,
    ) {
        let nx = x.len();
        // dy = f' (ds/dx X + ds/dtheta), with X before the step.
        if !self.row.is_empty() {
            let pairs = self.outward.iter().zip(&*x);
            let sum = pairs.fold(direct, |sum, (slope, x)| {
                sum.add_product(V::splat(*slope), V::load(&x.0))
            });
            sum.write(&mut self.row[start..]);
        }
        // All states are read before one is written: the new ones go to a buffer first.
        for (q, moved) in self.moved.iter_mut().enumerate() {
            let sum = x.iter().enumerate().fold(next(q), |sum, (j, x)| {
                let slope = V::splat(self.scratch.slope(q * nx + j));
                sum.add_product(slope, V::load(&x.0))
            });
            sum.store(&mut moved.0);
        }
        x.copy_from_slice(self.moved);
    }
}
