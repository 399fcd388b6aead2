//! [`GreyBox`]: the motor's equations as a model, with a small network for what they leave unexplained.
//!
//! The network is an additional load, in units of the command. For speed `w` and drive `x`, with `tanh` units,
//!
//! ```text
//! load += command_scale sum_i c_i tanh(b_i + p_i w / speed_scale + q_i x / command_scale)
//! ```
//!
//! held over a sample. The states are speed, drive and previous command, in units of the scales. An output belongs to the end of its
//! sample, so it depends on the command `v(k) = u(k - nk)`, where `nk` is one sample plus the whole samples of the delay. Terms that
//! depend on the shaft angle are excluded: a record of the speed does not say at which angle it begins.

use super::motor::{self, Motor};
use super::{DELAY, Dual, Equations, ORDERS, PARAMETERS, Run, Turn, check, varies};
use crate::closed_loop::{KernelPlant, Known, Plant};
use crate::embedded::Embedded;
use crate::lagged::finite;
use crate::linearised::Linearised;
use crate::model::{ClonePlant, Model, RunAndRows};
use crate::neural::Nothing;
use crate::simd::{self, F64x8, Kernel};
use crate::{Error, Result};

/// Speed, drive, previous command.
const STATES: usize = 3;
/// States that a measurement corrects: speed and drive.
const FILTERED: usize = 2;
/// Weights of a unit: `b`, `p`, `q`, `c`.
const WEIGHTS: usize = 4;
/// Most units: whatever needs more is no residual of a motor.
pub const MOST_UNITS: usize = 6;
/// Weight of an initial state's distance from what the first outputs say, relative to a squared error.
const PRIOR: f64 = 1e-2;
const STATE_STEPS: usize = 20;

/// The settings of a grey box apart from theta.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Values in the order of [`PARAMETERS`]; theta replaces those of the free parameters.
    pub values: [f64; PARAMETERS.len()],
    /// Indices of the free parameters.
    pub free: Vec<usize>,
    /// Sample time \[s\].
    pub sample_time: f64,
    /// Integration steps per sample.
    pub steps: usize,
    /// Whether an output is the mean speed over its sample, as from a difference of counts.
    pub mean: bool,
    /// One unit of the output \[rad/s\].
    pub unit: f64,
    /// Scale of the speed \[rad/s\].
    pub speed_scale: f64,
    /// Scale of command and drive.
    pub command_scale: f64,
    /// Residual variance of the free run, in the output's unit squared.
    pub residual_variance: f64,
    /// Variance that each sample adds to the states, in squares of the scales.
    pub process_noise: f64,
}

/// A motor, with a network for what its equations leave unexplained.
#[derive(Clone, Debug)]
pub struct GreyBox {
    frame: Frame,
    network: Vec<[f64; WEIGHTS]>,
}

impl GreyBox {
    /// A model from its parameters: the free ones of the motor, then `[b, p, q, c]` of each unit.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for parameters that no motor has, scales that are not above 0, or a wrong number of weights.
    pub fn new(mut frame: Frame, theta: &[f64]) -> Result<Self> {
        let network = theta.get(frame.free.len()..).unwrap_or_default();
        if theta.len() < frame.free.len()
            || network.len() % WEIGHTS != 0
            || network.len() > WEIGHTS * MOST_UNITS
        {
            return Err(Error::setting(format!(
                "expected {} parameters of the motor and {WEIGHTS} of each of at most {MOST_UNITS} units in theta, got {}; \
                 identify the model again",
                frame.free.len(),
                theta.len()
            )));
        }
        let scales = [
            ("unit", frame.unit),
            ("speed_scale", frame.speed_scale),
            ("command_scale", frame.command_scale),
            ("residual_variance", frame.residual_variance),
        ];
        if let Some((name, value)) = scales.iter().find(|(_, v)| !(v.is_finite() && *v > 0.0)) {
            return Err(Error::setting(format!(
                "expected {name} above 0, got {value}; identify the model again"
            )));
        }
        if !(frame.process_noise.is_finite() && frame.process_noise >= 0.0)
            || network.iter().any(|w| !w.is_finite())
        {
            return Err(Error::setting(
                "expected finite weights and a process noise from 0 on, got others; identify the model again",
            ));
        }
        for (place, value) in frame.free.iter().zip(theta) {
            if let Some(one) = frame.values.get_mut(*place) {
                *one = *value;
            }
        }
        let network = network.as_chunks::<WEIGHTS>().0.to_vec();
        let made = Self { frame, network };
        check(&made.run(), &[])?;
        let turns = (0..PARAMETERS.len()).any(|j| varies(j) && made.frame.values[j] != 0.0);
        if turns || made.frame.free.iter().any(|&j| varies(j) || j == DELAY) {
            return Err(Error::setting(
                "expected a motor without loads over the turn and with a fixed delay, got others; leave load_1, load_2, \
                 inertia_2, cogging, torque_ripple and eccentricity out",
            ));
        }
        Ok(made)
    }

    /// All settings apart from theta.
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// Units of the network.
    pub fn units(&self) -> usize {
        self.network.len()
    }

    /// Samples from a command to the output in which it is first seen.
    pub fn nk(&self) -> usize {
        1 + self.delay().floor() as usize
    }

    /// The delay \[samples\].
    fn delay(&self) -> f64 {
        self.frame.values[DELAY] / self.frame.sample_time
    }

    fn run(&self) -> Run<'_> {
        let frame = &self.frame;
        Run {
            theta: &frame.values,
            free: &frame.free,
            sample_time: frame.sample_time,
            steps: frame.steps,
            speed: 0.0,
            mean: frame.mean,
            angle: None,
            orders: [0; ORDERS],
        }
    }

    fn check(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<()> {
        if channels != 1 || state.len() != STATES {
            return Err(Error::data(format!(
                "expected u of shape (N, 1) and {STATES} states, got (N, {channels}) and {}; a motor has one command",
                state.len()
            )));
        }
        if u.iter().chain(state).any(|v| !v.is_finite()) {
            return Err(Error::data(
                "expected finite inputs and states, got NaN or infinity; cut or repair that part of the recording",
            ));
        }
        Ok(())
    }

    /// The acting commands; before the first sample they hold their first value.
    fn acting(&self, u: &[f64]) -> Vec<f64> {
        let nk = self.nk();
        (0..u.len()).map(|k| u[k.saturating_sub(nk)]).collect()
    }

    /// The states of the free run, sample by sample, row by row.
    ///
    /// # Errors
    /// As [`Model::simulate`].
    pub fn states(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<Vec<f64>> {
        self.check(u, channels, state)?;
        let stepper = Stepper::<0>::new(self, false);
        let mut at = Moving::at(self, state);
        let mut found = Vec::with_capacity(STATES * u.len());
        for v in self.acting(u) {
            found.extend(at.state(self));
            stepper.step(&mut at, &Dual::constant(v));
        }
        finite(found)
    }

    /// The free run with derivatives: by theta, then by the states; at most `N` in all.
    fn carried<const N: usize>(&self, v: &[f64], state: &[f64]) -> RunAndRows {
        simd::run(Carried::<N>(self, v, state))
    }
}

/// The motor's state with its derivatives.
#[derive(Clone, Copy, Debug)]
struct Moving<const N: usize> {
    w: Dual<N>,
    x: Dual<N>,
    before: Dual<N>,
}

impl<const N: usize> Moving<N> {
    fn at(model: &GreyBox, state: &[f64]) -> Self {
        let frame = &model.frame;
        Self {
            w: Dual::constant(frame.speed_scale * state[0]),
            x: Dual::constant(frame.command_scale * state[1]),
            before: Dual::constant(frame.command_scale * state[2]),
        }
    }

    /// With derivatives by the states, from index `place` on.
    fn seeded(mut self, model: &GreyBox, place: usize) -> Self {
        self.w.by[place] = model.frame.speed_scale;
        self.x.by[place + 1] = model.frame.command_scale;
        self.before.by[place + 2] = model.frame.command_scale;
        self
    }

    fn state(&self, model: &GreyBox) -> [f64; STATES] {
        let frame = &model.frame;
        [
            self.w.value / frame.speed_scale,
            self.x.value / frame.command_scale,
            self.before.value / frame.command_scale,
        ]
    }
}

/// Steps by one sample with [`Equations`].
#[derive(Clone, Debug)]
pub(super) struct Stepper<const N: usize> {
    pub equations: Equations<N>,
    pub turn: Turn<N>,
    pub network: Vec<[Dual<N>; WEIGHTS]>,
    pub frame: Frame,
    /// Fraction of a sample in the command's delay.
    pub part: f64,
}

impl<const N: usize> Stepper<N> {
    /// With or without derivatives by theta.
    fn new(model: &GreyBox, by_theta: bool) -> Self {
        let frame = &model.frame;
        let step = frame.sample_time / frame.steps as f64;
        let run = Run {
            free: if by_theta { &frame.free } else { &[] },
            ..model.run()
        };
        let equations = Equations::new(&run, step);
        let mut next = frame.free.len();
        let mut weight = |value: f64| {
            let mut dual = Dual::constant(value);
            if by_theta {
                dual.by[next] = 1.0;
                next += 1;
            }
            dual
        };
        Self {
            turn: equations.at(0.0, 0.0),
            equations,
            network: model
                .network
                .iter()
                .map(|unit| unit.map(&mut weight))
                .collect(),
            frame: frame.clone(),
            part: model.delay().fract(),
        }
    }

    /// The network's load, in units of the command.
    #[inline(always)]
    fn residual(&self, w: &Dual<N>, x: &Dual<N>) -> Dual<N> {
        let (speed, drive) = (
            w.scaled(1.0 / self.frame.speed_scale),
            x.scaled(1.0 / self.frame.command_scale),
        );
        let mut sum = Dual::ZERO;
        for [b, p, q, c] in &self.network {
            let argument = b.plus(1.0, &p.times(&speed)).plus(1.0, &q.times(&drive));
            let value = argument.value.tanh();
            sum = sum.plus(1.0, &c.times(&argument.through(value, 1.0 - value * value)));
        }
        sum.scaled(self.frame.command_scale)
    }

    /// Advances by a sample in which `now` comes to act; returns the output that follows.
    #[inline(always)]
    fn step(&self, at: &mut Moving<N>, now: &Dual<N>) -> Dual<N> {
        let mut turn = self.turn;
        if !self.network.is_empty() {
            turn.load = turn.load.plus(1.0, &self.residual(&at.w, &at.x));
        }
        let steps = self.frame.steps;
        let mut mean = Dual::ZERO;
        for j in 0..steps {
            let old = (self.part * steps as f64 - j as f64).clamp(0.0, 1.0);
            let command = now.scaled(1.0 - old).plus(old, &at.before);
            let (drive, speed) = self.equations.advanced(&turn, &at.x, &at.w, &command);
            mean = mean.plus(0.5, &at.w).plus(0.5, &speed);
            (at.x, at.w) = (drive, speed);
        }
        at.before = *now;
        let mean = mean.scaled(1.0 / steps as f64);
        let output = if self.frame.mean { mean } else { at.w };
        output.scaled(1.0 / self.frame.unit)
    }
}

struct Carried<'a, const N: usize>(&'a GreyBox, &'a [f64], &'a [f64]);

impl<const N: usize> Kernel for Carried<'_, N> {
    type Output = RunAndRows;

    #[inline(always)]
    fn run<V: F64x8>(self) -> RunAndRows {
        let Self(model, v, state) = self;
        let stepper = Stepper::<N>::new(model, N > 0);
        let columns = model.frame.free.len() + WEIGHTS * model.network.len();
        let mut at = Moving::<N>::at(model, state);
        let mut rows = Vec::new();
        if N > 0 {
            at = at.seeded(model, columns);
            rows.reserve(v.len() * (columns + STATES));
        }
        let mut run = Vec::with_capacity(v.len());
        for &v in v {
            let y = stepper.step(&mut at, &Dual::constant(v));
            run.push(y.value);
            if N > 0 {
                rows.extend_from_slice(&y.by[..columns + STATES]);
            }
        }
        (run, rows)
    }
}

/// Speed and drive with their covariance, corrected by measured outputs (extended Kalman filter: Anderson and Moore 1979, section 8.2).
struct Filter<'a> {
    model: &'a GreyBox,
    stepper: Stepper<STATES>,
    state: [f64; STATES],
    covariance: [[f64; FILTERED]; FILTERED],
}

impl Filter<'_> {
    /// The predicted output, the scaled speed and drive that follow, and the state that follows, each with derivatives.
    fn step(&self, v: f64) -> (Dual<STATES>, [Dual<STATES>; FILTERED], Moving<STATES>) {
        let mut at = Moving::at(self.model, &self.state).seeded(self.model, 0);
        let y = self.stepper.step(&mut at, &Dual::constant(v));
        let frame = &self.model.frame;
        let scaled = [
            at.w.scaled(1.0 / frame.speed_scale),
            at.x.scaled(1.0 / frame.command_scale),
        ];
        (y, scaled, at)
    }

    /// Corrects the state by one output; NaN is skipped.
    fn measure(&mut self, v: f64, y: f64) {
        if y.is_nan() {
            return;
        }
        let (predicted, ..) = self.step(v);
        let row = [predicted.by[0], predicted.by[1]];
        let p = self.covariance;
        let gain = [0, 1].map(|i| p[i][0] * row[0] + p[i][1] * row[1]);
        let spread = self.model.frame.residual_variance + row[0] * gain[0] + row[1] * gain[1];
        for i in 0..FILTERED {
            self.state[i] += gain[i] * (y - predicted.value) / spread;
            for j in 0..FILTERED {
                self.covariance[i][j] -= gain[i] * gain[j] / spread;
            }
        }
    }

    fn advance(&mut self, v: f64) {
        let (_, next, at) = self.step(v);
        let p = self.covariance;
        let through = |a: &Dual<STATES>, b: &Dual<STATES>| -> f64 {
            (0..FILTERED)
                .flat_map(|i| (0..FILTERED).map(move |j| (i, j)))
                .map(|(i, j)| a.by[i] * p[i][j] * b.by[j])
                .sum()
        };
        for i in 0..FILTERED {
            for j in 0..FILTERED {
                self.covariance[i][j] = through(&next[i], &next[j]);
            }
            self.covariance[i][i] += self.model.frame.process_noise;
        }
        self.state = at.state(self.model);
    }
}

impl Model for GreyBox {
    fn theta(&self) -> Vec<f64> {
        let motor = self.frame.free.iter().map(|&j| self.frame.values[j]);
        motor
            .chain(self.network.iter().flatten().copied())
            .collect()
    }

    fn rest_state(&self) -> Vec<f64> {
        vec![0.0; STATES]
    }

    fn simulate(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<Vec<f64>> {
        self.check(u, channels, state)?;
        finite(self.carried::<0>(&self.acting(u), state).0)
    }

    fn predict(
        &self,
        u: &[f64],
        channels: usize,
        y: &[f64],
        state: &[f64],
        horizon: usize,
    ) -> Result<Vec<f64>> {
        self.check(u, channels, state)?;
        if y.len() != u.len() || y.iter().any(|v| v.is_infinite()) {
            return Err(Error::data(format!(
                "expected {} measured outputs, finite or NaN where none was measured, got {}; give u and y the same number \
                 of samples",
                u.len(),
                y.len()
            )));
        }
        if horizon == 0 {
            return Err(Error::setting(
                "expected a horizon of 1 step or more, got 0; 1 is one-step prediction",
            ));
        }
        let v = self.acting(u);
        let noise = self.frame.process_noise;
        let mut filter = Filter {
            model: self,
            stepper: Stepper::new(self, false),
            state: [state[0], state[1], state[2]],
            covariance: [[noise, 0.0], [0.0, noise]],
        };
        let plain = Stepper::<0>::new(self, false);
        let ahead = |state: &[f64], v: &[f64]| {
            let mut at = Moving::at(self, state);
            v.iter()
                .map(|v| plain.step(&mut at, &Dual::constant(*v)).value)
                .last()
        };
        // the first samples have no measured output a horizon before them
        let first = horizon.min(u.len()) - usize::from(!u.is_empty());
        let mut found = self.carried::<0>(&v[..first], state).0;
        for k in 0..u.len() - first {
            found.extend(ahead(&filter.state, &v[k..k + first + 1]));
            filter.measure(v[k], y[k]);
            filter.advance(v[k]);
        }
        finite(found)
    }

    /// Speed and drive by least squares, close to what the first outputs say about them.
    fn estimate_state(&self, u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<f64>> {
        self.check(u, channels, &[0.0; STATES])?;
        let known: Vec<f64> = y.iter().copied().filter(|v| v.is_finite()).collect();
        if known.is_empty() || y.len() != u.len() {
            return Err(Error::data(
                "expected measured outputs to estimate the initial state from, one per input, got none; give 20 or so",
            ));
        }
        let frame = &self.frame;
        let v = self.acting(u);
        let first = &known[..known.len().min(3)];
        let level = frame.unit * first.iter().sum::<f64>() / first.len() as f64;
        let drive = (v[0] - frame.values[0] * level) / frame.command_scale;
        let prior = [level / frame.speed_scale, drive];
        // a step of one scale weighs as much as the output change it makes
        let weight = PRIOR * (frame.speed_scale / frame.unit).powi(2);
        let plain = Self {
            network: self.network.clone(),
            frame: Frame {
                free: Vec::new(),
                ..frame.clone()
            },
        };
        let at = |z: [f64; FILTERED]| [z[0], z[1], v[0] / frame.command_scale];
        let cost = |z: [f64; FILTERED]| -> f64 {
            let run = plain.carried::<0>(&v, &at(z)).0;
            let errors = run.iter().zip(y).filter(|(_, y)| !y.is_nan());
            errors.map(|(run, y)| (y - run).powi(2)).sum::<f64>()
                + weight * ((z[0] - prior[0]).powi(2) + (z[1] - prior[1]).powi(2))
        };
        let (mut z, mut damping) = (prior, 0.0);
        let mut now = cost(z);
        for _ in 0..STATE_STEPS {
            let (run, rows) = plain.slopes(&v, &at(z));
            let mut matrix = [[weight, 0.0], [0.0, weight]];
            let mut slope = [weight * (prior[0] - z[0]), weight * (prior[1] - z[1])];
            for ((run, y), row) in run.iter().zip(y).zip(rows.chunks_exact(plain.columns())) {
                let row = &row[row.len() - STATES..];
                if y.is_nan() {
                    continue;
                }
                for i in 0..FILTERED {
                    slope[i] += row[i] * (y - run);
                    for j in 0..FILTERED {
                        matrix[i][j] += row[i] * row[j];
                    }
                }
            }
            let [[a, b], [_, d]] = matrix;
            let (a, d) = (a * (1.0 + damping), d * (1.0 + damping));
            let size = a * d - b * b;
            if !(size > 0.0 && now.is_finite()) {
                break;
            }
            let trial = [
                z[0] + (d * slope[0] - b * slope[1]) / size,
                z[1] + (a * slope[1] - b * slope[0]) / size,
            ];
            let after = cost(trial);
            if after < now {
                let done = now - after <= 1e-12 * now;
                (z, now, damping) = (trial, after, 0.1 * damping);
                if done {
                    break;
                }
            } else {
                damping = f64::max(8.0 * damping, 1e-3);
            }
        }
        finite(at(z).to_vec())
    }

    fn jacobian(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<RunAndRows> {
        self.check(u, channels, state)?;
        let (run, rows) = self.slopes(&self.acting(u), state);
        Ok((finite(run)?, finite(rows)?))
    }

    fn linearise(&self, u: &[f64], state: &[f64]) -> Result<Linearised> {
        self.check(u, u.len(), state)?;
        const INPUT: usize = STATES;
        let mut at = Moving::<{ STATES + 1 }>::at(self, state).seeded(self, 0);
        let mut v = Dual::constant(u[0]);
        v.by[INPUT] = 1.0;
        let y = Stepper::new(self, false).step(&mut at, &v);
        let frame = &self.frame;
        let next = [
            at.w.scaled(1.0 / frame.speed_scale),
            at.x.scaled(1.0 / frame.command_scale),
            at.before.scaled(1.0 / frame.command_scale),
        ];
        Ok(Linearised {
            a: next.iter().flat_map(|z| z.by[..STATES].to_vec()).collect(),
            b: next.iter().map(|z| z.by[INPUT]).collect(),
            c: y.by[..STATES].to_vec(),
            d: vec![y.by[INPUT]],
            states: STATES,
            inputs: 1,
        })
    }

    fn plant(&self, ts: f64) -> Result<Box<dyn ClonePlant + '_>> {
        let same = (ts - self.frame.sample_time).abs() <= 1e-9 * self.frame.sample_time;
        if !same {
            return Err(Error::setting(format!(
                "expected the sample time that the motor was identified at, {} s, got {ts} s",
                self.frame.sample_time
            )));
        }
        Ok(Box::new(GreyBoxPlant {
            motor: Motor::of(&Stepper::new(self, false), self.nk() - 1),
            sample_time: self.frame.sample_time,
            at: motor::Moving::at_rest(),
            pending: vec![0.0; self.nk() - 1],
            output: 0.0,
            position: 0.0,
        }))
    }

    fn embedded(&self, _scaled: bool) -> Result<Embedded> {
        Err(Error::setting(
            "expected a linear model or a network to deploy, got a kind that has no form for microcontrollers; identify \
             with model oe, neural-oe or neural-ss",
        ))
    }
}

impl GreyBox {
    fn columns(&self) -> usize {
        self.frame.free.len() + WEIGHTS * self.network.len() + STATES
    }

    /// The free run and its derivatives by theta and the states.
    fn slopes(&self, v: &[f64], state: &[f64]) -> RunAndRows {
        match self.columns() {
            0..=4 => self.carried::<4>(v, state),
            5..=16 => self.carried::<16>(v, state),
            17..=28 => self.carried::<28>(v, state),
            _ => self.carried::<48>(v, state),
        }
    }
}

/// A grey box as a plant in a loop.
#[derive(Clone, Debug)]
struct GreyBoxPlant {
    motor: Motor,
    sample_time: f64,
    at: motor::Moving<f64>,
    /// Commands that have not acted yet, newest first.
    pending: Vec<f64>,
    output: f64,
    position: f64,
}

impl Plant for GreyBoxPlant {
    fn reset(&mut self) {
        self.at = motor::Moving::at_rest();
        self.pending.fill(0.0);
        (self.output, self.position) = (0.0, 0.0);
    }

    fn output(&self) -> f64 {
        self.output
    }

    fn position(&self) -> f64 {
        self.position
    }

    fn advance(&mut self, u: f64) {
        let mut due = u;
        if !self.pending.is_empty() {
            self.pending.rotate_right(1);
            due = std::mem::replace(&mut self.pending[0], u);
        }
        let (output, moved) = self.motor.step(&mut self.at, due, f64::tanh, &mut Nothing);
        self.output = output;
        self.position += moved;
    }

    fn known(&self) -> Option<KernelPlant<'_>> {
        Some(KernelPlant::new(
            Known::Motor(&self.motor),
            self.sample_time,
        ))
    }
}

#[cfg(test)]
mod tests;
