//! The model's equations in scaled units: one step, and the slopes of one step.
//!
//! ```text
//!   h  = tanh(Wx x + Wu v + bh)          a lane is a hidden unit, eight to a group
//!   x+ = A x + B v + E h                 [E; G] h: sums over lanes, a row at a time
//!   s  = C x + D v + c + G h
//! ```
//!
//! [`Network::step`] takes any sizes. [`Network::step_small`] takes sizes known at compile time: without it a run takes 10
//! % longer (`state_space_run` of the kernels' example, Zen 4, least and median of 200), a training the same time.

use super::output::OutputFunction;
use super::shape::Shape;
use crate::simd::{F64x8, LANES, Lanes};

/// The weights laid out for the kernels: hidden units in groups of eight, missing units with weights of zero.
#[derive(Clone, Debug)]
pub(super) struct Network {
    pub shape: Shape,
    pub output: OutputFunction,
    /// For each group its weights for states and inputs, and the bias.
    //   group 0: | x_1 | .. | x_nx | v_1 | .. | v_nu | 1 |   group 1: ..        eight units each
    // The bias is the weight of an argument that is 1.
    first: Vec<Lanes>,
    /// For each state and the output its weights for the groups: `[E; G]`.
    pub second: Vec<Lanes>,
    /// `[A B; C D]` row by row.
    linear: Vec<f64>,
    /// `c`.
    constant: f64,
    /// For each group of slopes, the weight products that multiply each hidden unit's `1 - h^2`.
    // (dx+/dx)_qj = A_qj + sum over units of E_qi (1 - h_i^2) Wx_ij. With E_qi Wx_ij formed once per theta, a lane is
    // an entry (q, j) and a unit's 1 - h^2 is broadcast: no sum over lanes is left. This takes nx (nx + 1) numbers a
    // unit.
    products: Vec<Lanes>,
    /// The linear part of the slopes: `[A; C]` in the order of `products`.
    base: Vec<Lanes>,
    /// For each argument its column of `[A B 0; C D c]`, if that has no more rows than a group has lanes.
    // Here a lane is a row: [A B; C D] [x; v] for all rows is one product per argument, without a sum over lanes.
    columns: Vec<Lanes>,
}

/// The buffers of a step, and its results.
#[derive(Clone, Debug)]
pub(super) struct Scratch {
    /// States and inputs of the step, then 1.
    // One vector: a product with [A B] or with a row of [Wx Wu bh] is then one pass.
    pub arguments: Vec<f64>,
    /// Hidden outputs.
    pub hidden: Vec<Lanes>,
    /// The next state.
    pub next: Vec<f64>,
    /// The sum `s`, before the output function.
    pub sum: f64,
    /// `1 - h^2`.
    pub rises: Vec<Lanes>,
    /// `dx+/dx`, then `ds/dx`, row by row.
    pub slopes: Vec<Lanes>,
}

impl Scratch {
    pub fn new(shape: Shape) -> Self {
        let groups = shape.hidden.div_ceil(LANES);
        let slopes = ((shape.nx + 1) * shape.nx).div_ceil(LANES);
        let mut arguments = vec![0.0; shape.arguments() + 1];
        arguments[shape.arguments()] = 1.0;
        Self {
            arguments,
            hidden: vec![Lanes::ZERO; groups],
            next: vec![0.0; shape.nx],
            sum: 0.0,
            rises: vec![Lanes::ZERO; groups],
            slopes: vec![Lanes::ZERO; slopes],
        }
    }

    /// Sets state and inputs of a step.
    #[inline(always)]
    pub fn set(&mut self, x: &[f64], v: &[f64]) {
        let (states, inputs) = self.arguments.split_at_mut(x.len());
        copy(states, x);
        copy(&mut inputs[..v.len()], v);
    }

    /// Continues from the state after the last step, with the inputs of the next one.
    #[inline(always)]
    pub fn go_on(&mut self, v: &[f64]) {
        let (states, inputs) = self.arguments.split_at_mut(self.next.len());
        copy(states, &self.next);
        copy(&mut inputs[..v.len()], v);
    }

    /// Derivative `i` of the slopes, row by row.
    #[inline(always)]
    pub fn slope(&self, i: usize) -> f64 {
        self.slopes[i / LANES].0[i % LANES]
    }
}

/// A copy of a few numbers, for which a call would take longer than the copy.
#[inline(always)]
pub(super) fn copy(to: &mut [f64], from: &[f64]) {
    // `copy_from_slice` calls memcpy if the length is not known at compile time.
    match (to, from) {
        ([to], [from]) => *to = *from,
        ([to, a], [from, b]) => (*to, *a) = (*from, *b),
        ([to, a, c], [from, b, d]) => (*to, *a, *c) = (*from, *b, *d),
        (to, from) => to.copy_from_slice(from),
    }
}

/// `1 - h^2` from hidden outputs: fast, and exact to 1e-16.
#[inline(always)]
pub(super) fn rises_of<V: F64x8>(hidden: &[Lanes], rises: &mut [Lanes]) {
    // d tanh(z)/dz = 1 - tanh(z)^2 evaluates no function. Near h = 1 the difference has an absolute error of 1e-16, but
    // no relative precision.
    for (rise, hidden) in rises.iter_mut().zip(hidden) {
        let h = V::load(&hidden.0);
        V::splat(1.0).sub(h.mul(h)).store(&mut rise.0);
    }
}

/// Calls a method for a constant number of states, so that its loops are unrolled; 0 stands for any other number.
macro_rules! unrolled {
    ($nx:expr, $this:ident.$method:ident::<$V:ty>) => {
        match $nx {
            1 => $this.$method::<$V, 1>(),
            2 => $this.$method::<$V, 2>(),
            3 => $this.$method::<$V, 3>(),
            4 => $this.$method::<$V, 4>(),
            _ => $this.$method::<$V, 0>(),
        }
    };
}
pub(super) use unrolled;

impl Network {
    /// A network with the weights `theta`, which has `shape.parameters()` values.
    pub fn new(shape: Shape, output: OutputFunction, theta: &[f64]) -> Self {
        let groups = shape.hidden.div_ceil(LANES);
        let (rows, width) = (shape.nx + 1, shape.arguments());
        let slopes = (rows * shape.nx).div_ceil(LANES);
        let mut network = Self {
            shape,
            output,
            first: vec![Lanes::ZERO; groups * (width + 1)],
            second: vec![Lanes::ZERO; rows * groups],
            linear: vec![0.0; rows * width],
            constant: 0.0,
            products: vec![Lanes::ZERO; slopes * groups * LANES],
            base: vec![Lanes::ZERO; slopes],
            columns: vec![Lanes::ZERO; width + 1],
        };
        network.load(theta);
        network
    }

    /// Groups of hidden units.
    #[inline(always)]
    pub fn groups(&self) -> usize {
        self.shape.hidden.div_ceil(LANES)
    }

    /// Loads the weights from `theta`.
    pub fn load(&mut self, theta: &[f64]) {
        let Shape {
            nx,
            inputs: nu,
            hidden,
            ..
        } = self.shape;
        let (parts, width, groups) = (self.shape.parts(), nx + nu, self.groups());
        let (wx, wu, bh) = (&theta[parts.wx], &theta[parts.wu], &theta[parts.bh]);
        for i in 0..hidden {
            let group = &mut self.first[i / LANES * (width + 1)..][..width + 1];
            let weights = wx[i * nx..][..nx].iter().chain(&wu[i * nu..][..nu]);
            for (group, weight) in group.iter_mut().zip(weights.chain([&bh[i]])) {
                group.0[i % LANES] = *weight;
            }
        }
        // Rows of E, then of G: units after the last one keep their zeros.
        let second = theta[parts.e]
            .chunks_exact(hidden)
            .chain(theta[parts.g].chunks_exact(hidden));
        for (row, weights) in self.second.chunks_exact_mut(groups).zip(second) {
            for (group, weights) in row.iter_mut().zip(weights.chunks(LANES)) {
                group.0[..weights.len()].copy_from_slice(weights);
            }
        }
        let (left, right) = (&theta[parts.a], &theta[parts.b]);
        let (lower_left, lower_right) = (&theta[parts.c], &theta[parts.d]);
        // [A B] and [C D] row by row, with states and inputs side by side as in `arguments`.
        for (q, row) in self.linear.chunks_exact_mut(width).enumerate() {
            let (states, inputs) = match q < nx {
                true => (&left[q * nx..][..nx], &right[q * nu..][..nu]),
                false => (lower_left, lower_right),
            };
            row[..nx].copy_from_slice(states);
            row[nx..].copy_from_slice(inputs);
        }
        self.constant = theta[parts.constant.start];
        // After E, G and [A B; C D], from which the products are made.
        self.multiply(wx);
        // A lane per row; only `step_small` reads these.
        if nx < LANES {
            for (q, row) in self.linear.chunks_exact(width).enumerate() {
                for (column, weight) in self.columns.iter_mut().zip(row) {
                    column.0[q] = *weight;
                }
            }
            self.columns[width].0[nx] = self.constant;
        }
    }

    /// Computes the weights that only the slopes need.
    fn multiply(&mut self, wx: &[f64]) {
        let (nx, width, groups) = (self.shape.nx, self.shape.arguments(), self.groups());
        for q in 0..=nx {
            for j in 0..nx {
                // Entry (q, j) of [dx+/dx; ds/dx] row by row, eight to a group; `products` has a group of entries for
                // each unit.
                let (group, lane) = ((q * nx + j) / LANES, (q * nx + j) % LANES);
                self.base[group].0[lane] = self.linear[q * width + j];
                for i in 0..self.shape.hidden {
                    let weight = self.second[q * groups + i / LANES].0[i % LANES];
                    self.products[group * groups * LANES + i].0[lane] = weight * wx[i * nx + j];
                }
            }
        }
    }

    /// The argument of a group of hidden units for `[x, v, 1]`.
    #[inline(always)]
    fn argument<V: F64x8>(&self, group: usize, states: &[f64], inputs: &[f64]) -> V {
        let width = states.len() + inputs.len();
        // The states come last: all other terms are ready before they are known.
        let (of_states, of_inputs) = self.first[group * width..][..width].split_at(states.len());
        // The bias is the last of the inputs' weights; its input is 1.
        let mut z = V::splat(0.0);
        for (weights, value) in of_inputs.iter().zip(inputs) {
            z = z.add_product(V::load(&weights.0), V::splat(*value));
        }
        for (weights, value) in of_states.iter().zip(states) {
            z = z.add_product(V::load(&weights.0), V::splat(*value));
        }
        z
    }

    /// `1 - h^2` to its last digits, for `[x, v, 1]`; [`rises_of`] is faster, but less exact in saturation.
    #[inline(always)]
    pub fn rises<V: F64x8>(&self, arguments: &[f64], rises: &mut [Lanes]) {
        let (states, inputs) = arguments.split_at(self.shape.nx);
        for (g, rises) in rises.iter_mut().enumerate() {
            self.argument::<V>(g, states, inputs)
                .rise()
                .store(&mut rises.0);
        }
    }

    /// `h = tanh(Wx x + Wu v + bh)`, `x+ = A x + B v + E h`, and returns
    /// `s = C x + D v + c + G h`, for `[x, v, 1]`.
    #[inline(always)]
    pub fn step<V: F64x8, const NX: usize>(
        &self,
        arguments: &[f64],
        hidden: &mut [Lanes],
        next: &mut [f64],
    ) -> f64 {
        let nx = if NX == 0 { self.shape.nx } else { NX };
        let (states, inputs) = arguments.split_at(nx);
        for (g, hidden) in hidden.iter_mut().enumerate() {
            self.argument::<V>(g, states, inputs)
                .tanh()
                .store(&mut hidden.0);
        }
        for (q, next) in next[..nx].iter_mut().enumerate() {
            // `next` is not `states`: all rows use the same x.
            *next = self.row::<V>(q, states, inputs, hidden);
        }
        self.constant + self.row::<V>(nx, states, inputs, hidden)
    }

    /// [`Network::step`] for constant numbers of states and groups: advances `x` by one step, with
    /// everything in registers. Returns the sum `s`.
    #[inline(always)]
    pub fn step_small<V: F64x8, const NX: usize, const GROUPS: usize>(
        &self,
        x: &mut [f64; NX],
        v: &[f64],
        hidden: &mut [Lanes; GROUPS],
    ) -> f64 {
        let width = NX + v.len();
        let mut units = [V::splat(0.0); GROUPS];
        for (g, unit) in units.iter_mut().enumerate() {
            // The states come last: all other terms are ready before they are known.
            let weights = &self.first[g * (width + 1)..][..width + 1];
            *unit = affine::<V, NX>(weights, x, v);
            *unit = unit.tanh();
            unit.store(&mut hidden[g].0);
        }
        // The linear part of all rows at once, a lane per row: it is computed while the tanh is pending.
        let mut linear = Lanes::ZERO;
        affine::<V, NX>(&self.columns[..width + 1], x, v).store(&mut linear.0);
        let mut sum = 0.0;
        // A sum over lanes for each state and the output: NX + 1 sums side by side, so the chain waits for one.
        for q in 0..=NX {
            let weights = &self.second[q * GROUPS..][..GROUPS];
            // E h or G h of one row: groups are added lane by lane before the lanes are summed.
            let mut row = V::load(&weights[0].0).mul(units[0]);
            for (weights, unit) in weights.iter().zip(units).skip(1) {
                row = row.add_product(V::load(&weights.0), unit);
            }
            sum = linear.0[q] + row.sum();
            // The last row is the output; its sum is returned.
            if let Some(x) = x.get_mut(q) {
                *x = sum;
            }
        }
        sum
    }

    /// A row of `[A B; C D] [x; v] + [E; G] h`.
    #[inline(always)]
    fn row<V: F64x8>(&self, q: usize, x: &[f64], v: &[f64], hidden: &[Lanes]) -> f64 {
        let width = self.shape.arguments();
        let weights = &self.second[q * hidden.len()..][..hidden.len()];
        let mut sum = V::splat(0.0);
        for (weights, hidden) in weights.iter().zip(hidden) {
            sum = sum.add_product(V::load(&weights.0), V::load(&hidden.0));
        }
        let (of_states, of_inputs) = self.linear[q * width..][..width].split_at(x.len());
        // Inputs first, then the states, which are known last.
        let product = |sum: f64, (w, v): (&f64, &f64)| sum + w * v;
        let direct = of_inputs.iter().zip(v).fold(0.0, product);
        // The sum over lanes comes last: it takes longer than the few products of the linear part.
        of_states.iter().zip(x).fold(direct, product) + sum.sum()
    }

    /// `dx+/dx = A + E diag(1 - h^2) Wx` and `ds/dx = C + G diag(1 - h^2) Wx` from `rises`, `1 - h^2`.
    #[inline(always)]
    pub fn slopes<V: F64x8>(&self, rises: &[Lanes], slopes: &mut [Lanes]) {
        let products = self.products.chunks_exact(self.groups() * LANES);
        // slope_at = base_at + sum over units of product_at,i (1 - h_i^2): lanes are entries, a unit's number is broadcast.
        for ((slope, base), products) in slopes.iter_mut().zip(&self.base).zip(products) {
            // Two sums side by side: a single one would wait for each product. Four samples side by side, with their
            // products loaded once, gained less than 1 % of a training (Zen 4).
            let (mut even, mut odd) = (V::load(&base.0), V::splat(0.0));
            let (products, _) = products.as_chunks::<LANES>();
            for (rises, products) in rises.iter().zip(products) {
                for lane in (0..LANES).step_by(2) {
                    let (left, right) =
                        (V::load(&products[lane].0), V::load(&products[lane + 1].0));
                    even = even.add_product(V::splat(rises.0[lane]), left);
                    odd = odd.add_product(V::splat(rises.0[lane + 1]), right);
                }
            }
            even.add(odd).store(&mut slope.0);
        }
    }
}

/// The sum of the columns times `[x, v, 1]`, the states last.
#[inline(always)]
fn affine<V: F64x8, const NX: usize>(columns: &[Lanes], x: &[f64; NX], v: &[f64]) -> V {
    let (of_states, rest) = columns.split_at(NX);
    let (of_inputs, constant) = rest.split_at(v.len());
    // The constant, the inputs, then the states, which are known last.
    let mut sum = V::load(&constant[0].0);
    for (column, value) in of_inputs.iter().zip(v) {
        sum = sum.add_product(V::load(&column.0), V::splat(*value));
    }
    for (column, value) in of_states.iter().zip(x) {
        sum = sum.add_product(V::load(&column.0), V::splat(*value));
    }
    sum
}
