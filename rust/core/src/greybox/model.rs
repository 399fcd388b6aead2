//! [`GreyBox`]: the motor's equations as a model, with a small network for what they leave unexplained.
//!
//! The network is an additional load, in units of the command. For speed `w` and drive `x`, with `tanh` units,
//!
//! ```text
//! load += command_scale sum_i c_i tanh(b_i + p_i w / speed_scale + q_i x / command_scale)
//! ```
//!
//! held over a sample. The states are speed, drive and previous command, in units of the scales. An output belongs to the end of its
//! sample, so it depends on the command `v(k) = u(k - nk)`, where `nk` is one sample plus the whole samples of the delay.
//!
//! If the output is a position, it is the fourth state, in units of the output. It then also says at which angle a record begins, which a
//! speed does not: gravity (`load_1`) is allowed, and the friction and the controller of a joint ([`JOINT`]).

use super::filter::Filter;
use super::motor::{self, Motor};
use super::stepper::{Moving, Stepper};
use super::{DELAY, Dual, FIRST_OVER_THE_TURN, ORDERS, PARAMETERS, Run, check, varies};
use crate::closed_loop::{KernelPlant, Known, Plant};
use crate::embedded::Embedded;
use crate::lagged::{check_predicted, finite};
use crate::linearised::Linearised;
use crate::model::{ClonePlant, Model, RunAndRows};
use crate::neural::Nothing;
use crate::simd::{self, F64x8, Kernel};
use crate::{Error, Result};
use nalgebra::{DMatrix, DVector};

/// Names of the parameters of a joint beyond those of a motor, in their order after [`PARAMETERS`]; 0 for none.
pub const JOINT: [&str; 18] = [
    "k_l",
    "k_q",
    "damping",
    "dead_band",
    "reach",
    "k_m",
    "k_g",
    "creep",
    "exponent",
    "k_mm",
    "settling",
    "rate",
    "play",
    "load_share",
    "rub_share",
    "cogging_c",
    "cogging_s",
    "cogging_order",
];
pub(super) const K_L: usize = 0;
pub(super) const K_Q: usize = 1;
pub(super) const DAMPING: usize = 2;
pub(super) const DEAD_BAND: usize = 3;
pub(super) const REACH: usize = 4;
pub(super) const K_M: usize = 5;
pub(super) const K_G: usize = 6;
pub(super) const CREEP: usize = 7;
pub(super) const EXPONENT: usize = 8;
pub(super) const K_MM: usize = 9;
pub(super) const SETTLING: usize = 10;
pub(super) const RATE: usize = 11;
pub(super) const PLAY: usize = 12;
pub(super) const LOAD_SHARE: usize = 13;
pub(super) const RUB_SHARE: usize = 14;
pub(super) const COGGING: [usize; 3] = [15, 16, 17];

/// Parameters of a joint that may be negative.
const SIGNED: [&str; 4] = ["k_q", "damping", "cogging_c", "cogging_s"];

/// Most states: speed, drive, previous command; the position if it is the output; with a rate limit or play the controller's
/// setpoint, and position and speed of the load.
pub(super) const STATES: usize = 7;
pub(super) const POSITION: usize = 3;
pub(super) const SHOWN: usize = 5;
/// Places of the states that a measurement corrects: all but the previous command.
pub(super) const FILTERED: [usize; 6] = [0, 1, 3, 4, 5, 6];
/// Weights of a unit: `b`, `p`, `q`, `c`.
pub(super) const WEIGHTS: usize = 4;
/// The first parameter of a joint.
pub(super) const OF_JOINT: usize = PARAMETERS.len();
/// Places of the load once per turn, which is gravity if the position is known.
pub(super) const GRAVITY: [usize; 2] = [FIRST_OVER_THE_TURN, FIRST_OVER_THE_TURN + 1];
/// Most units: whatever needs more is no residual of a motor.
pub const MOST_UNITS: usize = 6;
/// Weight of an initial state's distance from what the first outputs say, relative to a squared error.
const PRIOR: f64 = 1e-2;
const STATE_STEPS: usize = 20;
/// Samples over which the first outputs say a speed.
const SLOPE: usize = 4;

/// The settings of a grey box apart from theta.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Values in the order of [`PARAMETERS`]; theta replaces those of the free parameters.
    pub values: [f64; PARAMETERS.len()],
    /// Values in the order of [`JOINT`].
    pub joint: [f64; JOINT.len()],
    /// Indices of the free parameters, those of a joint after those of the motor.
    pub free: Vec<usize>,
    /// Sample time \[s\].
    pub sample_time: f64,
    /// Integration steps per sample.
    pub steps: usize,
    /// Whether an output is the mean speed over its sample, as from a difference of counts.
    pub mean: bool,
    /// Whether the output is the position, else the speed.
    pub position: bool,
    /// One unit of the output \[rad/s, or rad\].
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
    pub(super) frame: Frame,
    pub(super) network: Vec<[f64; WEIGHTS]>,
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
        for (&place, value) in frame.free.iter().zip(theta) {
            let (values, joint) = (&mut frame.values, &mut frame.joint);
            if let Some(one) = values.iter_mut().chain(joint).nth(place) {
                *one = *value;
            }
        }
        let network = network.as_chunks::<WEIGHTS>().0.to_vec();
        let made = Self { frame, network };
        made.check_frame()?;
        Ok(made)
    }

    fn check_frame(&self) -> Result<()> {
        let frame = &self.frame;
        let last = OF_JOINT + JOINT.len();
        if let Some(j) = frame.free.iter().find(|&&j| j >= last) {
            return Err(Error::setting(format!(
                "expected places of parameters from 0 to {}, got {j}",
                last - 1
            )));
        }
        let motor: Vec<usize> = frame
            .free
            .iter()
            .copied()
            .filter(|&j| j < OF_JOINT)
            .collect();
        // the angle of a run is given or integrated, that of a model is a state
        check(
            &Run {
                angle: Some(&[]),
                free: &motor,
                ..self.run()
            },
            &[],
        )?;
        let excluded = |j: usize| varies(j) && !(frame.position && GRAVITY.contains(&j));
        let turns = (0..PARAMETERS.len()).any(|j| excluded(j) && frame.values[j] != 0.0);
        if turns
            || motor
                .iter()
                .any(|&j| excluded(j) || j == DELAY && !frame.position)
        {
            return Err(Error::setting(
                "expected a motor without loads over the turn and with a fixed delay, got others; leave load_1, load_2, \
                 inertia_2, cogging, torque_ripple and eccentricity out",
            ));
        }
        let joint = (frame.joint != [0.0; JOINT.len()]) || motor.len() < frame.free.len();
        if joint && !frame.position {
            return Err(Error::setting(
                "expected a position as the output of a joint, got a speed; leave k_l, k_q and the controller out",
            ));
        }
        for (&value, name) in frame.joint.iter().zip(JOINT) {
            if !value.is_finite() || value < 0.0 && !SIGNED.contains(&name) {
                return Err(Error::setting(format!(
                    "expected a finite number from 0 on as {name}, got {value}"
                )));
            }
        }
        if [LOAD_SHARE, RUB_SHARE]
            .iter()
            .any(|&j| frame.joint[j] >= 1.0)
            || self.has(PLAY) && frame.joint[LOAD_SHARE] == 0.0
        {
            return Err(Error::setting(
                "expected a part of inertia and friction behind the play, above 0 and below 1, got others; leave the play out",
            ));
        }
        Ok(())
    }

    /// States of this model.
    pub fn order(&self) -> usize {
        match self.frame.position {
            true if self.has(RATE) || self.has(PLAY) => STATES,
            position => POSITION + usize::from(position),
        }
    }

    /// Whether a term of a joint is there, or sought.
    pub(super) fn has(&self, term: usize) -> bool {
        self.frame.joint[term] != 0.0 || self.frame.free.contains(&(OF_JOINT + term))
    }

    /// Places of the states that a fit of pieces estimates: what is in motion when a piece begins.
    pub(super) fn begun(&self) -> &'static [usize] {
        const BEGUN: [usize; 5] = [0, POSITION, 4, SHOWN, 6];
        &BEGUN[..self.order() - 2]
    }

    /// Whether a constant command moves the output on and on.
    pub fn integrates(&self) -> bool {
        self.frame.position && self.frame.joint[K_Q] == 0.0
    }

    /// Places of the states that a measurement corrects.
    pub(super) fn filtered(&self) -> &'static [usize] {
        &FILTERED[..self.order() - 1]
    }

    /// The scales of the states.
    pub(super) fn scales(&self) -> [f64; STATES] {
        let frame = &self.frame;
        [
            frame.speed_scale,
            frame.command_scale,
            frame.command_scale,
            frame.unit,
            frame.command_scale,
            frame.unit,
            frame.speed_scale,
        ]
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
    pub(super) fn delay(&self) -> f64 {
        self.frame.values[DELAY] / self.frame.sample_time
    }

    pub(super) fn run(&self) -> Run<'_> {
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
        if channels != 1 || state.len() != self.order() {
            return Err(Error::data(format!(
                "expected u of shape (N, 1) and {} states, got (N, {channels}) and {}; a motor has one command",
                self.order(),
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
        let mut found = Vec::with_capacity(self.order() * u.len());
        for v in self.acting(u) {
            found.extend(&at.state(self)[..self.order()]);
            stepper.step(&mut at, &Dual::constant(v));
        }
        finite(found)
    }

    /// The free run with derivatives: by theta, then by the states; at most `N` in all.
    fn carried<const N: usize>(&self, v: &[f64], state: &[f64]) -> RunAndRows {
        simd::run(Carried::<N>(self, v, state))
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
            rows.reserve(v.len() * (columns + model.order()));
        }
        let mut run = Vec::with_capacity(v.len());
        for &v in v {
            let y = stepper.step(&mut at, &Dual::constant(v));
            run.push(y.value);
            if N > 0 {
                rows.extend_from_slice(&y.by[..columns + model.order()]);
            }
        }
        (run, rows)
    }
}

impl Model for GreyBox {
    fn theta(&self) -> Vec<f64> {
        let frame = &self.frame;
        let all: Vec<f64> = frame.values.iter().chain(&frame.joint).copied().collect();
        let free = frame.free.iter().map(|&j| all[j]);
        free.chain(self.network.iter().flatten().copied()).collect()
    }

    fn rest_state(&self) -> Vec<f64> {
        vec![0.0; self.order()]
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
        check_predicted(y, u.len(), horizon)?;
        match self.order() {
            0..=4 => self.predicted::<4>(u, y, state, horizon),
            _ => self.predicted::<STATES>(u, y, state, horizon),
        }
    }

    /// The states by least squares, close to what the first outputs say about them.
    fn estimate_state(&self, u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<f64>> {
        self.check(u, channels, &self.rest_state())?;
        self.state_at(0, u, y)
    }

    fn jacobian(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<RunAndRows> {
        self.check(u, channels, state)?;
        let (run, rows) = self.slopes(&self.acting(u), state);
        Ok((finite(run)?, finite(rows)?))
    }

    fn linearise(&self, u: &[f64], state: &[f64]) -> Result<Linearised> {
        self.check(u, u.len(), state)?;
        const INPUT: usize = STATES;
        let order = self.order();
        let mut at = Moving::<{ STATES + 1 }>::at(self, state).seeded(self, 0);
        let mut v = Dual::constant(u[0]);
        v.by[INPUT] = 1.0;
        let y = Stepper::new(self, false).step(&mut at, &v);
        let next = &at.scaled(self)[..order];
        Ok(Linearised {
            a: next.iter().flat_map(|z| z.by[..order].to_vec()).collect(),
            b: next.iter().map(|z| z.by[INPUT]).collect(),
            c: y.by[..order].to_vec(),
            d: vec![y.by[INPUT]],
            states: order,
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
        self.frame.free.len() + WEIGHTS * self.network.len() + self.order()
    }

    /// Predictions from a filter with derivatives by `N` states or fewer.
    fn predicted<const N: usize>(
        &self,
        u: &[f64],
        y: &[f64],
        state: &[f64],
        horizon: usize,
    ) -> Result<Vec<f64>> {
        let v = self.acting(u);
        let noise = self.frame.process_noise;
        let mut filter = Filter::<N> {
            model: self,
            stepper: Stepper::new(self, false),
            state: std::array::from_fn(|j| state.get(j).copied().unwrap_or(0.0)),
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| if i == j { noise } else { 0.0 })
            }),
        };
        let plain = Stepper::<0>::new(self, false);
        let ahead = |state: &[f64], v: &[f64]| {
            let mut at = Moving::at(self, &state[..self.order()]);
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

    /// The command that acted last before a sample.
    fn before(&self, first: usize, u: &[f64]) -> f64 {
        self.acting(&u[..first.max(1)])[first.saturating_sub(1)]
    }

    /// The free run from a sample on, with what was commanded before it.
    pub(super) fn run_from(&self, first: usize, u: &[f64], state: &[f64]) -> Result<Vec<f64>> {
        self.check(u, 1, state)?;
        let state = self.begun_at(first, u, state);
        finite(self.carried::<0>(&self.acting(u)[first..], &state).0)
    }

    /// The same with its derivatives.
    pub(super) fn slopes_from(&self, first: usize, u: &[f64], state: &[f64]) -> Result<RunAndRows> {
        self.check(u, 1, state)?;
        let state = self.begun_at(first, u, state);
        let (run, rows) = self.slopes(&self.acting(u)[first..], &state);
        Ok((finite(run)?, finite(rows)?))
    }

    fn begun_at(&self, first: usize, u: &[f64], state: &[f64]) -> Vec<f64> {
        let mut state = state.to_vec();
        state[2] = self.before(first, u) / self.frame.command_scale;
        state
    }

    /// The states at a sample by least squares, close to what the first outputs say about them.
    pub(super) fn state_at(&self, first: usize, u: &[f64], y: &[f64]) -> Result<Vec<f64>> {
        let known: Vec<f64> = y.iter().copied().filter(|v| v.is_finite()).collect();
        if known.is_empty() || first + y.len() != u.len() {
            return Err(Error::data(
                "expected measured outputs to estimate the initial state from, one per input, got none; give 20 or so",
            ));
        }
        let (frame, scales, places) = (&self.frame, self.scales(), self.filtered());
        let v = &self.acting(u)[first..];
        let few = &known[..known.len().min(3)];
        let level = frame.unit * few.iter().sum::<f64>() / few.len() as f64;
        // a step of one scale weighs as much as the output change it makes
        let mut weight = [PRIOR * (frame.speed_scale / frame.unit).powi(2); STATES];
        let mut prior = [
            level,
            v[0] - frame.values[0] * level,
            v[0],
            0.0,
            0.0,
            0.0,
            0.0,
        ];
        if frame.position {
            weight = weight.map(|w| w * frame.sample_time.powi(2));
            (weight[POSITION], weight[SHOWN]) = (PRIOR, PRIOR);
            let voltage = v[0] - frame.joint[K_Q] * level;
            let reach = match frame.joint[REACH] {
                0.0 => f64::INFINITY,
                reach => reach,
            };
            prior = [
                0.0,
                voltage.clamp(-reach, reach),
                v[0],
                level,
                v[0],
                level,
                0.0,
            ];
        }
        let mut prior: [f64; STATES] = std::array::from_fn(|j| prior[j] / scales[j]);
        prior[2] = self.before(first, u) / scales[2];
        let plain = Self {
            network: self.network.clone(),
            frame: Frame {
                free: Vec::new(),
                ..frame.clone()
            },
        };
        let off = |z: &[f64; STATES]| {
            places
                .iter()
                .map(|&j| weight[j] * (z[j] - prior[j]).powi(2))
                .sum::<f64>()
        };
        let cost = |z: &[f64; STATES]| -> f64 {
            let run = plain.carried::<0>(v, &z[..self.order()]).0;
            let errors = run.iter().zip(y).filter(|(_, y)| !y.is_nan());
            errors.map(|(run, y)| (y - run).powi(2)).sum::<f64>() + off(z)
        };
        // at standstill friction holds a joint, and no derivative says how fast it may have been
        let mut moving = prior;
        if frame.position && known.len() > SLOPE {
            moving[0] = (known[SLOPE] - known[0]) / (SLOPE as f64 * frame.sample_time) * frame.unit
                / scales[0];
        }
        let (mut z, mut damping) = (prior, 0.0);
        let mut now = cost(&z);
        let other = cost(&moving);
        if other < now {
            (z, now) = (moving, other);
        }
        let n = places.len();
        for _ in 0..STATE_STEPS {
            let (run, rows) = plain.slopes(v, &z[..self.order()]);
            let mut matrix =
                DMatrix::from_fn(n, n, |i, j| if i == j { weight[places[i]] } else { 0.0 });
            let mut slope = DVector::from_fn(n, |i, _| {
                weight[places[i]] * (prior[places[i]] - z[places[i]])
            });
            for ((run, y), row) in run.iter().zip(y).zip(rows.chunks_exact(plain.columns())) {
                let row = &row[row.len() - self.order()..];
                if y.is_nan() {
                    continue;
                }
                for (i, &a) in places.iter().enumerate() {
                    slope[i] += row[a] * (y - run);
                    for (j, &b) in places.iter().enumerate() {
                        matrix[(i, j)] += row[a] * row[b];
                    }
                }
            }
            for i in 0..n {
                matrix[(i, i)] *= 1.0 + damping;
            }
            let Some(step) = matrix.cholesky().map(|root| root.solve(&slope)) else {
                break;
            };
            if !now.is_finite() {
                break;
            }
            let mut trial = z;
            for (i, &place) in places.iter().enumerate() {
                trial[place] += step[i];
            }
            let after = cost(&trial);
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
        finite(z[..self.order()].to_vec())
    }

    /// The free run and its derivatives by theta and the states.
    fn slopes(&self, v: &[f64], state: &[f64]) -> RunAndRows {
        match self.columns() {
            0..=4 => self.carried::<4>(v, state),
            5..=12 => self.carried::<12>(v, state),
            13..=20 => self.carried::<20>(v, state),
            21..=28 => self.carried::<28>(v, state),
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
