//! Identified models, one sample at a time, in memory of the caller: a plant model beside the controller, on the processor.
//!
//! The arithmetic is plain `+ - * /`, in one order, without fused multiply-add: the C written by `sewfast deploy` has the same bits. In
//! double precision they also equal those of the free run on a computer's baseline (`SEWFAST_CPU=baseline`). Exceptions
//! are state-space models with more than four states or an output function: these agree to rounding.
//!
//! ```
//! use sewfast_control::model::{Equation, Linear, Model, Orders};
//!
//! let lag = Equation::Linear(Linear { a: &[-0.9], b: &[0.2], offset: 0.0 });
//! let orders = Orders { na: 1, nb: 1, nk: 1, inputs: 1 };
//! let mut memory = [0.0; 4];
//! let mut model = Model::new(orders, lag, None, &mut memory)?;
//! model.begin(&[0.0], &[1.0]);
//! let y: f64 = (0..200).map(|_| model.step(&[1.0])).last().unwrap_or(0.0);
//! assert!((y - 2.0).abs() < 1e-6);
//! # Ok::<(), sewfast_control::Refused>(())
//! ```

mod output;
pub mod tanh;

use core::mem::swap;

pub use output::Output;

use crate::{Real, Refused};

/// Hidden units summed side by side, like the lanes of a computer.
const LANES: usize = 8;

/// `y(k) = -sum a(i) y(k-1-i) + sum b(j nb + i) u_j(k-nk-i) + offset`.
#[derive(Clone, Copy, Debug)]
pub struct Linear<'a, T> {
    /// Denominator after the leading 1, `na`.
    pub a: &'a [T],
    /// Numerators, one input after the other, `inputs * nb`.
    pub b: &'a [T],
    /// The output's change per sample without any input.
    pub offset: T,
}

/// `y(k) = b2 + direct phi + sum w2(i) tanh(b1(i) + w1(i) phi)`, clipped to its limits.
///
/// `phi` has the last `na` outputs, the newest first, then `nb` values of each input.
#[derive(Clone, Copy, Debug)]
pub struct Network<'a, T> {
    /// Row by row, `hidden * (na + inputs * nb)`.
    pub w1: &'a [T],
    /// `hidden`.
    pub b1: &'a [T],
    /// `hidden`.
    pub w2: &'a [T],
    /// The constant.
    pub b2: T,
    /// As `phi`.
    pub direct: &'a [T],
    /// Lowest and highest output.
    pub limits: (T, T),
}

/// `h = tanh(Wx x + Wu v + bh)`, `x+ = A x + B v + E h`, `y = f(C x + D v + c + G h)`; matrices row by row.
#[derive(Clone, Copy, Debug)]
pub struct StateSpace<'a, T> {
    /// `nx * nx`.
    pub a: &'a [T],
    /// `nx * inputs`.
    pub b: &'a [T],
    /// `nx * hidden`.
    pub e: &'a [T],
    /// `hidden * nx`.
    pub wx: &'a [T],
    /// `hidden * inputs`.
    pub wu: &'a [T],
    /// `hidden`.
    pub bh: &'a [T],
    /// `nx`.
    pub c: &'a [T],
    /// `inputs`.
    pub d: &'a [T],
    /// The constant.
    pub constant: T,
    /// `hidden`.
    pub g: &'a [T],
    /// `f`.
    pub output: Output<T>,
}

/// A model's equation.
#[derive(Clone, Copy, Debug)]
pub enum Equation<'a, T> {
    /// A difference equation.
    Linear(Linear<'a, T>),
    /// A network on past outputs and inputs.
    Network(Network<'a, T>),
    /// State equations beside a network.
    States(StateSpace<'a, T>),
}

/// `(u - u_mean)/u_scale` before the equation and `y y_scale + y_mean` after it.
#[derive(Clone, Copy, Debug)]
pub struct Scaling<'a, T> {
    /// Subtracted from each input.
    pub u_mean: &'a [T],
    /// Each input is then divided by it.
    pub u_scale: &'a [T],
    /// Added to the scaled output.
    pub y_mean: T,
    /// The equation's output is multiplied by it.
    pub y_scale: T,
}

/// A model's sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Orders {
    /// Past outputs, or states.
    pub na: usize,
    /// Values of each input at once; 1 for state equations.
    pub nb: usize,
    /// Samples from an input to its effect.
    pub nk: usize,
    /// Inputs.
    pub inputs: usize,
}

/// A model and its memory.
#[derive(Debug)]
pub struct Model<'a, T> {
    orders: Orders,
    equation: Equation<'a, T>,
    scaling: Option<Scaling<'a, T>>,
    /// Past outputs, the newest first, or states; in scaled units if there is a scaling.
    state: &'a mut [T],
    /// For each input its last `nk + nb` values, the newest first.
    waiting: &'a mut [T],
    /// Hidden units' outputs, then the next state; of state equations only.
    hidden: &'a mut [T],
    next: &'a mut [T],
}

impl<'a, T: Real> Model<'a, T> {
    /// Size of a model's memory, in numbers.
    pub fn room(orders: Orders, equation: &Equation<'_, T>) -> usize {
        let more = match equation {
            Equation::States(s) => s.bh.len() + orders.na,
            _ => 0,
        };
        orders.na + orders.inputs * (orders.nk + orders.nb) + more
    }

    /// A model in `memory`, which has room for at least [`room`](Self::room) numbers; all of them are 0 before the first sample.
    ///
    /// # Errors
    /// Too little memory, or a number of coefficients that does not match the orders.
    pub fn new(
        orders: Orders,
        equation: Equation<'a, T>,
        scaling: Option<Scaling<'a, T>>,
        memory: &'a mut [T],
    ) -> Result<Self, Refused> {
        let fits = equation.fits(orders)
            && scaling.is_none_or(|s| {
                s.u_mean.len() == orders.inputs && s.u_scale.len() == orders.inputs
            });
        Refused::unless(
            fits,
            "model",
            "as many coefficients as the orders ask for",
            0.0,
        )?;
        let (given, units) = (memory.len(), equation.hidden_memory());
        let parts = memory
            .split_at_mut_checked(orders.na)
            .and_then(|(state, rest)| {
                let (waiting, rest) =
                    rest.split_at_mut_checked(orders.inputs * (orders.nk + orders.nb))?;
                let (hidden, rest) = rest.split_at_mut_checked(units)?;
                let next = rest.get_mut(..if units > 0 { orders.na } else { 0 })?;
                Some((state, waiting, hidden, next))
            });
        let Some((state, waiting, hidden, next)) = parts else {
            let expected = "a memory as large as room() says";
            return Err(Refused {
                name: "memory",
                expected,
                received: given as f64,
            });
        };
        let model = Self {
            orders,
            equation,
            scaling,
            state,
            waiting,
            hidden,
            next,
        };
        model.state.fill(T::ZERO);
        model.waiting.fill(T::ZERO);
        Ok(model)
    }

    /// Sets the memory before the first sample: `state` (past outputs in their unit, the newest first, or states), and
    /// past inputs of constant `u`. Missing values are 0.
    pub fn begin(&mut self, state: &[T], u: &[T]) {
        let lagged = !matches!(self.equation, Equation::States(_));
        let scaling = self.scaling;
        for (i, place) in self.state.iter_mut().enumerate() {
            let value = state.get(i).copied().unwrap_or(T::ZERO);
            *place = match scaling {
                Some(s) if lagged => (value - s.y_mean) / s.y_scale,
                _ => value,
            };
        }
        for j in 0..self.orders.inputs {
            let value = u.get(j).copied().unwrap_or(T::ZERO);
            self.window(j).fill(scaled(scaling, j, value));
        }
    }

    /// The last values of input `j`.
    fn window(&mut self, j: usize) -> &mut [T] {
        let width = self.orders.nk + self.orders.nb;
        let start = j.wrapping_mul(width);
        let window = self.waiting.get_mut(start..start.wrapping_add(width));
        window.unwrap_or_default()
    }

    /// Takes the inputs of this sample, which act `nk` samples later, and returns its output.
    pub fn step(&mut self, u: &[T]) -> T {
        let scaling = self.scaling;
        for j in 0..self.orders.inputs {
            let value = u.get(j).copied().unwrap_or(T::ZERO);
            push(self.window(j), scaled(scaling, j, value));
        }
        let y = match &self.equation {
            Equation::Linear(linear) => linear.output(self.orders, self.state, self.waiting),
            Equation::Network(network) => network.output(self.orders, self.state, self.waiting),
            Equation::States(states) => {
                let y = states.advance(
                    self.orders,
                    self.state,
                    self.waiting,
                    self.hidden,
                    self.next,
                );
                for (x, next) in self.state.iter_mut().zip(self.next.iter()) {
                    *x = *next;
                }
                y
            }
        };
        if !matches!(self.equation, Equation::States(_)) {
            push(self.state, y);
        }
        match scaling {
            Some(s) => y * s.y_scale + s.y_mean,
            None => y,
        }
    }
}

/// Row `i` of a matrix; empty if there is none. Chunked slices would panic for a width of 0.
fn row<T>(matrix: &[T], i: usize, width: usize) -> &[T] {
    let start = i.wrapping_mul(width);
    let row = matrix.get(start..start.wrapping_add(width));
    row.unwrap_or_default()
}

fn scaled<T: Real>(scaling: Option<Scaling<'_, T>>, j: usize, u: T) -> T {
    let parts = scaling.and_then(|s| Some((*s.u_mean.get(j)?, *s.u_scale.get(j)?)));
    match parts {
        Some((mean, scale)) => (u - mean) / scale,
        None => u,
    }
}

/// Puts the newest value first; the oldest is lost.
fn push<T>(window: &mut [T], newest: T) {
    let mut carried = newest;
    for place in window {
        swap(place, &mut carried);
    }
}

/// The part of the inputs' windows that acts now, input by input: `nb` values from `nk` on.
fn acting<T: Copy>(orders: Orders, waiting: &[T]) -> impl DoubleEndedIterator<Item = T> + '_ {
    let width = orders.nk + orders.nb;
    (0..orders.inputs).flat_map(move |j| {
        let acting = row(waiting, j, width).get(orders.nk..);
        acting.unwrap_or_default().iter().copied()
    })
}

/// Products of hidden units and their weights, summed like eight lanes, with `first` in the first lane.
fn lanes<T: Real>(products: impl Iterator<Item = T>, first: T) -> T {
    let mut v = [T::ZERO; LANES];
    v[0] = first;
    let mut lane = 0;
    for product in products {
        if let Some(sum) = v.get_mut(lane) {
            *sum += product;
        }
        lane = if lane + 1 < LANES { lane + 1 } else { 0 };
    }
    ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
}

impl<T: Real> Equation<'_, T> {
    fn fits(&self, orders: Orders) -> bool {
        let Orders { na, nb, inputs, .. } = orders;
        let width = na + nb * inputs;
        match self {
            Self::Linear(m) => m.a.len() == na && m.b.len() == nb * inputs,
            Self::Network(m) => {
                let hidden = m.b1.len();
                m.w1.len() == hidden * width && m.w2.len() == hidden && m.direct.len() == width
            }
            Self::States(m) => {
                let hidden = m.bh.len();
                let outer = m.a.len() == na * na && m.b.len() == na * inputs && nb == 1;
                let inner = m.wx.len() == hidden * na && m.wu.len() == hidden * inputs;
                let last = m.c.len() == na && m.d.len() == inputs && m.g.len() == hidden;
                outer && inner && last && m.e.len() == na * hidden && hidden > 0
            }
        }
    }

    fn hidden_memory(&self) -> usize {
        match self {
            Self::States(m) => m.bh.len(),
            _ => 0,
        }
    }
}

impl<T: Real> Linear<'_, T> {
    fn output(&self, orders: Orders, past: &[T], waiting: &[T]) -> T {
        let driven = self.b.iter().zip(acting(orders, waiting));
        let moved = driven.fold(self.offset, |sum, (b, u)| sum + *b * u);
        self.a
            .iter()
            .zip(past)
            .fold(moved, |sum, (a, y)| sum - *a * *y)
    }
}

impl<T: Real> Network<'_, T> {
    fn output(&self, orders: Orders, past: &[T], waiting: &[T]) -> T {
        let width = self.direct.len();
        // the newest output last: on a computer all other terms are ready before it is known
        let affine = |bias: T, weights: &[T]| {
            let phi = acting(orders, waiting)
                .rev()
                .chain(past.iter().rev().copied());
            let products = weights.iter().rev().zip(phi);
            products.fold(bias, |sum, (w, x)| sum + *w * x)
        };
        let units = self.b1.iter().zip(self.w2).enumerate();
        let hidden =
            units.map(|(i, (bias, w2))| *w2 * affine(*bias, row(self.w1, i, width)).tanh());
        let y = lanes(hidden, affine(self.b2, self.direct));
        y.limit(self.limits.0, self.limits.1)
    }
}

impl<T: Real> StateSpace<'_, T> {
    fn advance(
        &self,
        orders: Orders,
        x: &[T],
        waiting: &[T],
        hidden: &mut [T],
        next: &mut [T],
    ) -> T {
        let affine = |constant: T, inputs: &[T], states: &[T]| {
            let driven = inputs.iter().zip(acting(orders, waiting));
            let driven = driven.fold(constant, |sum, (w, v)| sum + *w * v);
            states
                .iter()
                .zip(x)
                .fold(driven, |sum, (w, x)| sum + *w * *x)
        };
        let (nx, nu) = (orders.na, orders.inputs);
        for (i, (h, bias)) in hidden.iter_mut().zip(self.bh).enumerate() {
            *h = affine(*bias, row(self.wu, i, nu), row(self.wx, i, nx)).tanh();
        }
        let beside = |weights: &[T]| {
            let products = weights.iter().zip(hidden.iter()).map(|(w, h)| *w * *h);
            lanes(products, T::ZERO)
        };
        for (i, next) in next.iter_mut().enumerate() {
            let e = row(self.e, i, self.bh.len());
            *next = affine(T::ZERO, row(self.b, i, nu), row(self.a, i, nx)) + beside(e);
        }
        let sum = affine(self.constant, self.d, self.c) + beside(self.g);
        self.output.value(sum)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORDERS: Orders = Orders {
        na: 1,
        nb: 1,
        nk: 2,
        inputs: 2,
    };

    #[test]
    fn delays_each_input_and_holds_what_was_before() {
        let linear = Linear {
            a: &[-0.5],
            b: &[1.0, 10.0],
            offset: 0.25,
        };
        let mut memory = [f64::NAN; 7];
        let mut model = Model::new(ORDERS, Equation::Linear(linear), None, &mut memory).unwrap();
        model.begin(&[4.0], &[1.0, 2.0]);
        let y = [[0.0, 0.0], [0.0, 0.0], [3.0, 0.0]].map(|u| model.step(&u));
        assert_eq!(y, [23.25, 32.875, 16.6875]);
    }

    #[test]
    fn refuses_too_little_memory_and_uneven_coefficients() {
        let linear = Linear {
            a: &[-0.5],
            b: &[1.0],
            offset: 0.0,
        };
        let name = |orders, room: usize| {
            let mut memory = [0.0; 7];
            let made = Model::new(orders, Equation::Linear(linear), None, &mut memory[..room]);
            made.map(|_| ()).unwrap_err().name
        };
        assert_eq!(name(ORDERS, 7), "model");
        assert_eq!(
            name(
                Orders {
                    inputs: 1,
                    ..ORDERS
                },
                3
            ),
            "memory"
        );
    }

    #[test]
    fn a_network_is_its_sum_within_its_limits() {
        let network = Network {
            w1: &[0.5, -0.25],
            b1: &[0.1],
            w2: &[2.0],
            b2: 0.3,
            direct: &[0.2, 0.4],
            limits: (-1.0, 1.5),
        };
        let orders = Orders {
            na: 1,
            nb: 1,
            nk: 0,
            inputs: 1,
        };
        let scaling = Scaling {
            u_mean: &[1.0],
            u_scale: &[2.0],
            y_mean: 5.0,
            y_scale: 10.0,
        };
        let mut memory = [0.0; 2];
        let equation = Equation::Network(network);
        let mut model = Model::new(orders, equation, Some(scaling), &mut memory).unwrap();
        model.begin(&[7.0], &[0.0]);
        let (y0, v): (f64, f64) = (0.2, 0.5);
        let sum = 0.3 + 0.2 * y0 + 0.4 * v + 2.0 * (0.1 + 0.5 * y0 - 0.25 * v).tanh();
        assert!((model.step(&[2.0]) - (10.0 * sum + 5.0)).abs() < 1e-14);
        assert_eq!(model.step(&[100.0]), 20.0);
    }
}
