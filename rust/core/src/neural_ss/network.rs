//! The model's equations in scaled units: one step, and the slopes of one step.

use super::output::OutputFunction;
use super::shape::Shape;
use super::tanh::tanh;
use crate::simd::{Eight, Group, LANES};

/// The weights laid out for the kernels: hidden units in groups of eight, missing ones with weights of zero.
#[derive(Clone, Debug)]
pub(super) struct Network {
    pub shape: Shape,
    pub output: OutputFunction,
    /// For each group its weights for states and inputs, and the bias.
    first: Vec<Group>,
    /// For each state and each output its weights for the groups: `[E; G]`.
    pub second: Vec<Group>,
    /// `[A B; C D]` row by row.
    linear: Vec<f64>,
    /// `c`.
    constant: Vec<f64>,
    /// For each hidden unit the products of its weights that stand beside `1 - h^2` in the slopes.
    products: Vec<Group>,
    /// The linear part of the slopes: `[A; C]` in the order of `products`.
    base: Vec<Group>,
}

/// What a step needs room for, and leaves behind.
#[derive(Clone, Debug)]
pub(super) struct Scratch {
    /// States and inputs of the step, then 1.
    pub arguments: Vec<f64>,
    /// Hidden outputs.
    pub hidden: Vec<Group>,
    /// The next state.
    pub next: Vec<f64>,
    /// The sums `s`, before the output function.
    pub sums: Vec<f64>,
    /// `1 - h^2`.
    pub rises: Vec<Group>,
    /// `dx+/dx`, then `ds/dx`, row by row.
    pub slopes: Vec<Group>,
}

impl Scratch {
    pub fn new(shape: Shape) -> Self {
        let groups = shape.hidden.div_ceil(LANES);
        let slopes = ((shape.nx + shape.outputs) * shape.nx).div_ceil(LANES);
        let mut arguments = vec![0.0; shape.arguments() + 1];
        arguments[shape.arguments()] = 1.0;
        Self {
            arguments,
            hidden: vec![Group::ZERO; groups],
            next: vec![0.0; shape.nx],
            sums: vec![0.0; shape.outputs],
            rises: vec![Group::ZERO; groups],
            slopes: vec![Group::ZERO; slopes],
        }
    }

    /// Takes up state and inputs of a step.
    #[inline(always)]
    pub fn set(&mut self, x: &[f64], v: &[f64]) {
        let (states, rest) = self.arguments.split_at_mut(x.len());
        states.copy_from_slice(x);
        rest[..v.len()].copy_from_slice(v);
    }

    /// Derivative `i` of the slopes, row by row.
    #[inline(always)]
    pub fn slope(&self, i: usize) -> f64 {
        self.slopes[i / LANES].0[i % LANES]
    }
}

impl Network {
    /// A network with the weights `theta`, which has `shape.parameters()` values.
    pub fn new(shape: Shape, output: OutputFunction, theta: &[f64]) -> Self {
        let groups = shape.hidden.div_ceil(LANES);
        let (rows, width) = (shape.nx + shape.outputs, shape.arguments());
        let slopes = (rows * shape.nx).div_ceil(LANES);
        let mut network = Self {
            shape,
            output,
            first: vec![Group::ZERO; groups * (width + 1)],
            second: vec![Group::ZERO; rows * groups],
            linear: vec![0.0; rows * width],
            constant: vec![0.0; shape.outputs],
            products: vec![Group::ZERO; shape.hidden * slopes],
            base: vec![Group::ZERO; slopes],
        };
        network.load(theta);
        network
    }

    /// Groups of hidden units.
    #[inline(always)]
    pub fn groups(&self) -> usize {
        self.shape.hidden.div_ceil(LANES)
    }

    /// Takes the weights from `theta`.
    pub fn load(&mut self, theta: &[f64]) {
        let Shape {
            nx,
            inputs: nu,
            outputs: ny,
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
        for q in 0..nx + ny {
            let row = &mut self.linear[q * width..][..width];
            let (states, inputs) = match q.checked_sub(nx) {
                None => (&left[q * nx..][..nx], &right[q * nu..][..nu]),
                Some(p) => (&lower_left[p * nx..][..nx], &lower_right[p * nu..][..nu]),
            };
            row[..nx].copy_from_slice(states);
            row[nx..].copy_from_slice(inputs);
        }
        self.constant.copy_from_slice(&theta[parts.constant]);
        self.multiply(wx);
    }

    /// Fills what only the slopes need.
    fn multiply(&mut self, wx: &[f64]) {
        let (nx, width, groups) = (self.shape.nx, self.shape.arguments(), self.groups());
        let slopes = self.base.len();
        for q in 0..nx + self.shape.outputs {
            for j in 0..nx {
                let (group, lane) = ((q * nx + j) / LANES, (q * nx + j) % LANES);
                self.base[group].0[lane] = self.linear[q * width + j];
                for i in 0..self.shape.hidden {
                    let weight = self.second[q * groups + i / LANES].0[i % LANES];
                    self.products[i * slopes + group].0[lane] = weight * wx[i * nx + j];
                }
            }
        }
    }

    /// `h = tanh(Wx x + Wu v + bh)`, `x+ = A x + B v + E h`, `s = C x + D v + c + G h`.
    #[inline(always)]
    pub fn step<V: Eight>(&self, scratch: &mut Scratch) {
        let Scratch {
            arguments,
            hidden,
            next,
            sums,
            ..
        } = scratch;
        let (nx, width) = (self.shape.nx, self.shape.arguments());
        for (hidden, weights) in hidden.iter_mut().zip(self.first.chunks_exact(width + 1)) {
            let mut z = V::load(&weights[width].0);
            // The states come last: everything else is ready before they are known.
            for (weights, value) in weights[..width].iter().zip(&*arguments).rev() {
                z = z.add_product(V::load(&weights.0), V::splat(*value));
            }
            tanh(z).store(&mut hidden.0);
        }
        let rows = self
            .linear
            .chunks_exact(width)
            .zip(self.second.chunks_exact(hidden.len()));
        let outputs = next
            .iter_mut()
            .zip(std::iter::repeat(&0.0))
            .chain(sums.iter_mut().zip(&self.constant));
        for ((out, constant), (linear, weights)) in outputs.zip(rows) {
            let mut sum = V::splat(0.0);
            for (weights, hidden) in weights.iter().zip(&*hidden) {
                sum = sum.add_product(V::load(&weights.0), V::load(&hidden.0));
            }
            let direct = linear[nx..]
                .iter()
                .zip(&arguments[nx..])
                .fold(*constant, |d, (w, v)| d + w * v);
            let direct = linear[..nx]
                .iter()
                .zip(&arguments[..nx])
                .fold(direct, |d, (w, x)| d + w * x);
            *out = direct + sum.sum();
        }
    }

    /// `1 - h^2`, and with it `dx+/dx = A + E diag(1 - h^2) Wx` and `ds/dx = C + G diag(1 - h^2) Wx`.
    #[inline(always)]
    pub fn slopes<V: Eight>(&self, hidden: &[Group], rises: &mut [Group], slopes: &mut [Group]) {
        for (rise, hidden) in rises.iter_mut().zip(hidden) {
            let h = V::load(&hidden.0);
            V::splat(1.0).sub(h.mul(h)).store(&mut rise.0);
        }
        let count = slopes.len();
        for (g, slope) in slopes.iter_mut().enumerate() {
            // Two sums side by side: one alone would wait for each product.
            let (mut even, mut odd) = (V::load(&self.base[g].0), V::splat(0.0));
            for (i, products) in self.products.chunks_exact(count).enumerate() {
                let rise = V::splat(rises[i / LANES].0[i % LANES]);
                let product = V::load(&products[g].0);
                if i % 2 == 0 {
                    even = even.add_product(rise, product);
                } else {
                    odd = odd.add_product(rise, product);
                }
            }
            even.add(odd).store(&mut slope.0);
        }
    }
}
