//! Plants that kernels know, and their steps in registers.

use std::marker::PhantomData;

use super::Plant;
use crate::lagged::{Form, Lags};
use crate::simd::{Eight, Group};

/// A plant whose equations kernels know: a lagged model, its output multiplied, its input held back.
#[derive(Clone, Copy, Debug)]
pub struct Known<'a> {
    pub(super) form: &'a Form,
    pub(super) lags: Lags,
    pub(super) ts: f64,
    pub(super) gain: f64,
    /// Samples by which the input is held back beyond the model's own delay.
    pub(super) delay: usize,
}

impl Known<'_> {
    /// Samples between a command and its first appearance in the regressor.
    fn lead(&self) -> usize {
        self.delay + self.lags.nk - 1
    }
}

/// One plant inside a kernel, where the whole loop is compiled for one processor; `N` is the number of regressors, 0 for any.
pub(super) struct Alone<'a, V, const N: usize> {
    known: Known<'a>,
    /// Past outputs, newest first, then the inputs of the regressor.
    phi: Vec<f64>,
    /// Past inputs, newest first.
    inputs: Vec<f64>,
    position: f64,
    level: PhantomData<V>,
}

impl<'a, V: Eight, const N: usize> Alone<'a, V, N> {
    #[inline(always)]
    pub fn new(known: Known<'a>) -> Self {
        Self {
            known,
            phi: vec![0.0; known.lags.regressors()],
            inputs: vec![0.0; known.lead() + known.lags.nb],
            position: 0.0,
            level: PhantomData,
        }
    }
}

impl<V: Eight, const N: usize> Plant for Alone<'_, V, N> {
    #[inline(always)]
    fn reset(&mut self) {
        self.phi.fill(0.0);
        self.inputs.fill(0.0);
        self.position = 0.0;
    }

    #[inline(always)]
    fn output(&self) -> f64 {
        self.known.gain * self.phi[0]
    }

    #[inline(always)]
    fn position(&self) -> f64 {
        self.known.gain * self.position
    }

    #[inline(always)]
    fn advance(&mut self, u: f64) {
        let (na, lead) = (self.known.lags.na, self.known.lead());
        shift(&mut self.inputs, u);
        let (outputs, inputs) = self.phi.split_at_mut(na);
        let due = &self.inputs[lead..][..inputs.len()];
        // not a call to copy a few numbers
        let mut i = due.len();
        while i > 0 {
            i -= 1;
            inputs[i] = due[i];
        }
        let newest = outputs[0];
        let y = match self.known.form {
            Form::Linear(model) => model.next(&self.phi),
            Form::Network(network) => network.next::<V, N>(&self.phi),
        };
        self.position += self.known.ts * (newest + y) / 2.0;
        shift(&mut self.phi[..na], y);
    }
}

/// Puts a value in front of a few others.
#[inline(always)]
fn shift(newest_first: &mut [f64], value: f64) {
    let mut i = newest_first.len();
    while i > 1 {
        i -= 1;
        newest_first[i] = newest_first[i - 1];
    }
    newest_first[0] = value;
}

/// Eight runs of one plant, side by side.
pub(super) struct Beside<'a> {
    pub known: Known<'a>,
    /// Past outputs, newest first, then the inputs of the regressor.
    phi: Vec<Group>,
    /// Inputs that are still to reach the regressor, the next one at `next`.
    waiting: Vec<Group>,
    next: usize,
    position: Group,
}

impl<'a> Beside<'a> {
    /// At rest.
    pub fn new(known: Known<'a>) -> Self {
        Self {
            known,
            phi: vec![Group::ZERO; known.lags.regressors()],
            waiting: vec![Group::ZERO; known.lead()],
            next: 0,
            position: Group::ZERO,
        }
    }

    #[inline(always)]
    pub fn output<V: Eight>(&self) -> V {
        V::splat(self.known.gain).mul(V::load(&self.phi[0].0))
    }

    #[inline(always)]
    pub fn position<V: Eight>(&self) -> V {
        V::splat(self.known.gain).mul(V::load(&self.position.0))
    }

    /// Holds a command in each lane for one sample time; `N` is the number of regressors, 0 for any.
    #[inline(always)]
    pub fn advance<V: Eight, const N: usize>(&mut self, u: V) {
        let na = self.known.lags.na;
        let due = self.delayed(u);
        push_eight(&mut self.phi[na..], due);
        let newest = V::load(&self.phi[0].0);
        let y = match self.known.form {
            Form::Linear(model) => model.beside::<V>(&self.phi),
            Form::Network(network) => network.beside::<V, N>(&self.phi),
        };
        let moved = V::splat(self.known.ts).mul(newest.add(y));
        // a product with 1/2 is as exact as the quotient
        let moved = moved.mul(V::splat(0.5));
        V::load(&self.position.0)
            .add(moved)
            .store(&mut self.position.0);
        push_eight(&mut self.phi[..na], y);
    }

    #[inline(always)]
    fn delayed<V: Eight>(&mut self, u: V) -> V {
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
fn push_eight<V: Eight>(newest_first: &mut [Group], value: V) {
    let mut i = newest_first.len();
    while i > 1 {
        i -= 1;
        let older = V::load(&newest_first[i - 1].0);
        older.store(&mut newest_first[i].0);
    }
    value.store(&mut newest_first[0].0);
}
