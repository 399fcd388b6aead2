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
use crate::greybox::{Motor, Moving, tanh_of_one};
use crate::lagged::{Form, Lags};
use crate::neural::{Meanwhile, Nothing};
use crate::simd::{F64x8, Lanes};

/// Equations that kernels know.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Known<'a> {
    Lagged(&'a Form, Lags),
    Motor(&'a Motor),
}

/// A plant whose equations kernels know, with a gain on its output and extra delay on its input.
#[derive(Clone, Copy, Debug)]
pub struct KernelPlant<'a> {
    pub(super) equations: Known<'a>,
    pub(super) ts: f64,
    pub(super) gain: f64,
    /// Samples of input delay in addition to the model's own.
    pub(super) delay: usize,
}

impl<'a> KernelPlant<'a> {
    pub(crate) fn new(equations: Known<'a>, ts: f64) -> Self {
        Self {
            equations,
            ts,
            gain: 1.0,
            delay: 0,
        }
    }

    /// Samples between a command and its first effect on the equations.
    fn lead(&self) -> usize {
        // The model's nk = 1 is the sample that every loop has: a command decided at k is in the regressor of y(k+1).
        // Only delay beyond that has to be waited for.
        self.delay
            + match self.equations {
                Known::Lagged(_, lags) => lags.nk - 1,
                Known::Motor(motor) => motor.whole(),
            }
    }

    /// Whether the equations have two outputs and two inputs in their regressor: the usual model.
    pub(super) fn is_second_order(&self) -> bool {
        matches!(self.equations, Known::Lagged(_, lags) if (lags.na, lags.regressors()) == (2, 4))
    }
}

/// One plant inside a kernel that compiles the whole loop for one processor; `R` holds its regressor.
pub(super) struct ScalarPlant<'a, V, R> {
    known: KernelPlant<'a>,
    form: &'a Form,
    regressor: R,
    position: f64,
    // The level is in the type: `Plant` has no room for it, and a network's step has to know its registers.
    level: PhantomData<V>,
}

impl<'a, V: F64x8, R: Regressor> ScalarPlant<'a, V, R> {
    #[inline(always)]
    pub fn new(known: KernelPlant<'a>, form: &'a Form, lags: Lags) -> Self {
        Self {
            known,
            form,
            regressor: R::at_rest(lags, known.lead()),
            position: 0.0,
            level: PhantomData,
        }
    }
}

impl<V: F64x8, R: Regressor> Plant for ScalarPlant<'_, V, R> {
    #[inline(always)]
    fn reset(&mut self) {
        self.regressor.rest();
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
        let y = self.regressor.output::<V>(self.form);
        // Trapezoidal rule: between samples the output is taken to change linearly.
        self.position += self.known.ts * (before + y) / 2.0;
        self.regressor.put(y);
    }
}

/// What the next output of one plant depends on.
pub(super) trait Regressor {
    fn at_rest(lags: Lags, lead: usize) -> Self;
    fn rest(&mut self);
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
    fn at_rest(lags: Lags, lead: usize) -> Self {
        Self {
            phi: vec![0.0; lags.regressors()],
            inputs: vec![0.0; lead + lags.nb],
            past: lags.na,
            lead,
        }
    }

    #[inline(always)]
    fn rest(&mut self) {
        self.phi.fill(0.0);
        self.inputs.fill(0.0);
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
        known.is_second_order() && known.lead() == 0
    }
}

impl Regressor for SecondOrder {
    #[inline(always)]
    fn at_rest(_lags: Lags, _lead: usize) -> Self {
        Self([0.0; 4])
    }

    #[inline(always)]
    fn rest(&mut self) {
        self.0 = [0.0; 4];
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

/// One motor inside a kernel that compiles the whole loop for one processor.
pub(super) struct ScalarMotor<'a, V> {
    known: KernelPlant<'a>,
    motor: &'a Motor,
    at: Moving<f64>,
    /// Commands that have not acted yet, newest first.
    waiting: Vec<f64>,
    output: f64,
    position: f64,
    level: PhantomData<V>,
}

impl<'a, V: F64x8> ScalarMotor<'a, V> {
    #[inline(always)]
    pub fn new(known: KernelPlant<'a>, motor: &'a Motor) -> Self {
        Self {
            known,
            motor,
            at: Moving::at_rest(),
            waiting: vec![0.0; known.lead()],
            output: 0.0,
            position: 0.0,
            level: PhantomData,
        }
    }
}

impl<V: F64x8> Plant for ScalarMotor<'_, V> {
    #[inline(always)]
    fn reset(&mut self) {
        self.at = Moving::at_rest();
        self.waiting.fill(0.0);
        (self.output, self.position) = (0.0, 0.0);
    }

    #[inline(always)]
    fn output(&self) -> f64 {
        self.known.gain * self.output
    }

    #[inline(always)]
    fn position(&self) -> f64 {
        self.known.gain * self.position
    }

    #[inline(always)]
    fn advance(&mut self, u: f64) {
        let due = match self.waiting.last() {
            Some(due) => *due,
            None => u,
        };
        if !self.waiting.is_empty() {
            shift(&mut self.waiting, u);
        }
        let (output, moved) = self
            .motor
            .step(&mut self.at, due, tanh_of_one::<V>, &mut Nothing);
        self.output = output;
        self.position += moved;
    }
}

/// Numbers in [`BatchPlant::phi`] for a motor: output, speed, drive, command of the last sample, position, setpoint, the load's position and speed.
const OF_MOTOR: usize = 8;

/// Eight runs of one plant, side by side.
pub(super) struct BatchPlant<'a> {
    pub known: KernelPlant<'a>,
    /// Past outputs, newest first, then the inputs of the regressor; or what a motor remembers, its output first.
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
            phi: match known.equations {
                Known::Lagged(_, lags) => vec![Lanes::ZERO; lags.regressors()],
                Known::Motor(_) => vec![Lanes::ZERO; OF_MOTOR],
            },
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
        let (form, lags) = match self.known.equations {
            Known::Lagged(form, lags) => (form, lags),
            // the caller takes N = 0 for a motor: it need not be compiled for any other
            Known::Motor(motor) if N == 0 => return self.turn::<V>(motor, due, meanwhile),
            Known::Motor(_) => return,
        };
        // For the usual model these are compile-time constants: the network's loops over phi are unrolled, and its
        // weights are addressed without a multiplication.
        let (na, n) = if N == 4 {
            (2, 4)
        } else {
            (lags.na, self.phi.len())
        };
        let phi = &mut self.phi[..n];
        push_eight(&mut phi[na..], due);
        // Read before the step and kept in a register: the position needs the output at both ends of the sample.
        let newest = V::load(&phi[0].0);
        let y = match form {
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
    fn turn<V: F64x8>(&mut self, motor: &Motor, due: V, meanwhile: &mut impl Meanwhile) {
        let [output, w, x, before, q, setpoint, shown, v] = &mut self.phi[..] else {
            return;
        };
        let mut at = Moving {
            w: V::load(&w.0),
            x: V::load(&x.0),
            before: V::load(&before.0),
            q: V::load(&q.0),
            setpoint: V::load(&setpoint.0),
            shown: V::load(&shown.0),
            v: V::load(&v.0),
        };
        let (y, moved) = motor.step(&mut at, due, V::tanh, meanwhile);
        at.w.store(&mut w.0);
        at.x.store(&mut x.0);
        at.before.store(&mut before.0);
        at.q.store(&mut q.0);
        at.setpoint.store(&mut setpoint.0);
        at.shown.store(&mut shown.0);
        at.v.store(&mut v.0);
        y.store(&mut output.0);
        let position = V::load(&self.position.0).add(moved);
        position.store(&mut self.position.0);
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
