//! Plants that kernels know, and their steps in registers.
//!
//! A lagged model in a loop is its regressor and its position. A single loop ([`ScalarPlant`]) holds them as numbers,
//! and the lanes of a network are its hidden units. Eight loops ([`BatchPlant`]) hold them as [`Lanes`], one loop per
//! lane. Both do the same operations in the same order, so a controller gets the same cost from either.
//!
//! Why kernels know plants at all: through [`Plant`] alone, a call per sample that the compiler cannot inline, a loop
//! takes 61 to 64 ns a sample instead of 43 (`closed_loop` of the kernels' example, Zen 4). [`SecondOrder`], two
//! outputs and two inputs in registers, takes 43 and [`AnyOrder`] 46 (6.7 %).

use std::marker::PhantomData;

use super::Plant;
use crate::lagged::{Form, Lags};
use crate::neural::Meanwhile;
use crate::simd::{F64x8, Lanes};

/// A plant whose equations kernels know: a lagged model with a gain on its output and extra delay on its input.
#[derive(Clone, Copy, Debug)]
pub struct KernelPlant<'a> {
    pub(super) form: &'a Form,
    pub(super) lags: Lags,
    pub(super) ts: f64,
    pub(super) gain: f64,
    /// Samples of input delay in addition to the model's own.
    pub(super) delay: usize,
}

impl KernelPlant<'_> {
    /// Samples between a command and its first appearance in the regressor.
    fn lead(&self) -> usize {
        // The model's nk = 1 is the sample that every loop has: a command decided at k is in the regressor of y(k+1).
        // Only delay beyond that has to be waited for.
        self.delay + self.lags.nk - 1
    }
}

/// One plant inside a kernel that compiles the whole loop for one processor; `R` holds its regressor.
pub(super) struct ScalarPlant<'a, V, R> {
    known: KernelPlant<'a>,
    regressor: R,
    position: f64,
    // The level is in the type: `Plant` has no room for it, and a network's step has to know its registers.
    level: PhantomData<V>,
}

impl<'a, V: F64x8, R: Regressor> ScalarPlant<'a, V, R> {
    #[inline(always)]
    pub fn new(known: KernelPlant<'a>) -> Self {
        Self {
            known,
            regressor: R::at_rest(&known),
            position: 0.0,
            level: PhantomData,
        }
    }
}

impl<V: F64x8, R: Regressor> Plant for ScalarPlant<'_, V, R> {
    #[inline(always)]
    fn reset(&mut self) {
        self.regressor = R::at_rest(&self.known);
        self.position = 0.0;
    }

    #[inline(always)]
    fn output(&self) -> f64 {
        // The gain of a variation multiplies the measured output, not the fed-back one: the model's own past outputs
        // stay in its range.
        self.known.gain * self.regressor.newest()
    }

    #[inline(always)]
    fn position(&self) -> f64 {
        self.known.gain * self.position
    }

    #[inline(always)]
    fn advance(&mut self, u: f64) {
        let before = self.regressor.newest();
        self.regressor.take(u);
        let y = self.regressor.output::<V>(self.known.form);
        // Trapezoidal rule: between samples the output is taken to change linearly.
        self.position += self.known.ts * (before + y) / 2.0;
        self.regressor.put(y);
    }
}

/// What the next output of one plant depends on.
pub(super) trait Regressor {
    fn at_rest(known: &KernelPlant<'_>) -> Self;
    /// The newest output.
    fn newest(&self) -> f64;
    /// Shifts a command in.
    fn take(&mut self, u: f64);
    /// The next output.
    fn output<V: F64x8>(&self, form: &Form) -> f64;
    /// Shifts that output in.
    fn put(&mut self, y: f64);
}

/// Any number of outputs and inputs.
pub(super) struct AnyOrder {
    /// Past outputs, newest first, then the inputs of the regressor.
    phi: Vec<f64>,
    /// Past inputs, newest first.
    inputs: Vec<f64>,
    past: usize,
    lead: usize,
}

impl Regressor for AnyOrder {
    #[inline(always)]
    fn at_rest(known: &KernelPlant<'_>) -> Self {
        let (lags, lead) = (known.lags, known.lead());
        Self {
            phi: vec![0.0; lags.regressors()],
            inputs: vec![0.0; lead + lags.nb],
            past: lags.na,
            lead,
        }
    }

    #[inline(always)]
    fn newest(&self) -> f64 {
        self.phi[0]
    }

    #[inline(always)]
    fn take(&mut self, u: f64) {
        shift(&mut self.inputs, u);
        //   inputs   u(k) u(k-1) .. u(k-lead) .. u(k-lead-nb+1)      newest first
        //   phi      y(k) .. y(k-na+1) | u(k-lead) .. u(k-lead-nb+1)
        // The whole input part is copied, not shifted: with nb = 2 that is two numbers.
        let inputs = &mut self.phi[self.past..];
        let due = &self.inputs[self.lead..][..inputs.len()];
        // A loop by hand: for a length unknown at compile time `copy_from_slice` calls memcpy, which spills the
        // registers.
        let mut i = due.len();
        while i > 0 {
            i -= 1;
            inputs[i] = due[i];
        }
    }

    #[inline(always)]
    fn output<V: F64x8>(&self, form: &Form) -> f64 {
        match form {
            Form::Linear(model) => model.next(&self.phi),
            Form::Network(network) => network.next::<V, 0>(&self.phi),
        }
    }

    #[inline(always)]
    fn put(&mut self, y: f64) {
        shift(&mut self.phi[..self.past], y);
    }
}

/// Two outputs and two inputs, the newest input being the last command: all stay in registers.
pub(super) struct SecondOrder([f64; 4]);

impl SecondOrder {
    /// Whether a plant has exactly that many, and no extra delay.
    pub fn takes(known: &KernelPlant<'_>) -> bool {
        (known.lags.na, known.lags.regressors(), known.lead()) == (2, 4, 0)
    }
}

impl Regressor for SecondOrder {
    #[inline(always)]
    fn at_rest(_known: &KernelPlant<'_>) -> Self {
        Self([0.0; 4])
    }

    #[inline(always)]
    fn newest(&self) -> f64 {
        self.0[0]
    }

    #[inline(always)]
    fn take(&mut self, u: f64) {
        // phi = [y(k), y(k-1), u(k), u(k-1)]: the command is the newest input, as there is no extra delay. The compiler
        // splits an array by value into four registers; a slice would be memory, written and read back within the
        // dependency chain.
        self.0 = [self.0[0], self.0[1], u, self.0[2]];
    }

    #[inline(always)]
    fn output<V: F64x8>(&self, form: &Form) -> f64 {
        match form {
            Form::Linear(model) => model.next(&self.0),
            Form::Network(network) => network.next::<V, 4>(&self.0),
        }
    }

    #[inline(always)]
    fn put(&mut self, y: f64) {
        self.0 = [y, self.0[0], self.0[2], self.0[3]];
    }
}

/// Puts a value in front of a few others.
#[inline(always)]
fn shift(newest_first: &mut [f64], value: f64) {
    // By hand for the same reason: `rotate_right` and `copy_within` are calls.
    let mut i = newest_first.len();
    while i > 1 {
        i -= 1;
        newest_first[i] = newest_first[i - 1];
    }
    newest_first[0] = value;
}

/// Eight runs of one plant, side by side.
pub(super) struct BatchPlant<'a> {
    pub known: KernelPlant<'a>,
    /// Past outputs, newest first, then the inputs of the regressor.
    // Entry by entry, eight loops each: `phi[c].0[i]` is entry c of loop i. A broadcast weight then multiplies all
    // loops at once.
    phi: Vec<Lanes>,
    /// Inputs that have not reached the regressor yet, the next one at `next`.
    // A ring, because delays can be long and only one entry is due. The regressor is short: shifting it keeps its
    // indices known to the compiler.
    waiting: Vec<Lanes>,
    next: usize,
    position: Lanes,
}

impl<'a> BatchPlant<'a> {
    /// At rest.
    pub fn new(known: KernelPlant<'a>) -> Self {
        Self {
            known,
            phi: vec![Lanes::ZERO; known.lags.regressors()],
            waiting: vec![Lanes::ZERO; known.lead()],
            next: 0,
            position: Lanes::ZERO,
        }
    }

    #[inline(always)]
    pub fn output<V: F64x8>(&self) -> V {
        V::splat(self.known.gain).mul(V::load(&self.phi[0].0))
    }

    #[inline(always)]
    pub fn position<V: F64x8>(&self) -> V {
        V::splat(self.known.gain).mul(V::load(&self.position.0))
    }

    /// Holds a command in each lane for one sample time; `N` is 4 for two outputs and two inputs in the regressor, 0
    /// for any number. `meanwhile` is other work to interleave.
    #[inline(always)]
    pub fn advance<V: F64x8, const N: usize>(&mut self, u: V, meanwhile: &mut impl Meanwhile) {
        let due = self.delayed(u);
        // For the usual model these are compile-time constants: the network's loops over phi are unrolled, and its
        // weights are addressed without a multiplication.
        let (na, n) = if N == 4 {
            (2, 4)
        } else {
            (self.known.lags.na, self.phi.len())
        };
        let phi = &mut self.phi[..n];
        push_eight(&mut phi[na..], due);
        // Read before the step and kept in a register: the position needs the output at both ends of the sample.
        let newest = V::load(&phi[0].0);
        let y = match self.known.form {
            Form::Linear(model) => model.next_in_lanes::<V>(phi),
            Form::Network(network) => network.next_in_lanes::<V, N>(phi, meanwhile),
        };
        let moved = V::splat(self.known.ts).mul(newest.add(y));
        // Times 1/2 gives the same bits as the scalar loop's division by 2 and spares the divider, which tanh needs.
        let moved = moved.mul(V::splat(0.5));
        V::load(&self.position.0)
            .add(moved)
            .store(&mut self.position.0);
        push_eight(&mut phi[..na], y);
    }

    #[inline(always)]
    fn delayed<V: F64x8>(&mut self, u: V) -> V {
        let Some(place) = self.waiting.get_mut(self.next) else {
            return u;
        };
        let due = V::load(&place.0);
        u.store(&mut place.0);
        self.next += 1;
        if self.next == self.waiting.len() {
            self.next = 0;
        }
        due
    }
}

#[inline(always)]
fn push_eight<V: F64x8>(newest_first: &mut [Lanes], value: V) {
    let mut i = newest_first.len();
    while i > 1 {
        i -= 1;
        let older = V::load(&newest_first[i - 1].0);
        older.store(&mut newest_first[i].0);
    }
    value.store(&mut newest_first[0].0);
}
