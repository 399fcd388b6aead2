//! A motor's equations with unknown parameters, in units of the command, and their sensitivities.
//!
//! Command and speed are the only measurements needed, so torques are expressed as the command `x` that makes them (the
//! command across the winding's resistance), and every parameter can be identified from a record. With speed `w`
//! \[rad/s\] and shaft angle `th`:
//!
//! ```text
//! tau dx/dt = v - drop x / sqrt(x^2 + ripple^2) - x - k_e g(th) w,          |x| <= limit
//! k_a(th) dw/dt = x g(th) - offset - load(th) - k_b w - k_a'(th) w^2 / 2 - friction
//! friction = sign(w) (k_s + (k_t + k_d sign(w)) / (1 + (w / w_s)^2)), and what holds the shaft at standstill
//! v = u (1 - sag u x) with u late by the delay: a supply of finite resistance, which gives the current u x / (R u_0)
//! load(th) = load_1c cos th + load_1s sin th + load_2c cos 2 th + load_2s sin 2 th + cogging of up to three orders
//! g(th) = 1 + torque_ripple_c cos n th + torque_ripple_s sin n th
//! k_a(th) = k_a + inertia_2c cos 2 th + inertia_2s sin 2 th
//! ```
//!
//! An eccentric encoder shows `w (1 + eccentric_c cos th + eccentric_s sin th)`.
//!
//! A joint ([`JOINT`]) also has a load on its gears, and a controller of its own if `k_q` is not 0: `u` is then a
//! position command, and the loop gain of the controller is the unit of everything:
//!
//! ```text
//! friction += k_l |x g(th) + offset + load(th)| + k_m |x g(th)| + k_g |offset + load(th)| + k_mm (x g(th))^2
//! 1 / (1 + (w / w_s)^2) becomes exp(-|w / w_s|^exponent) if the exponent is not 0
//! v = (e - dead_band sign e) - damping w, |v| <= reach,    e = u - k_q q, 0 if |e| <= dead_band
//! ```
//!
//! Friction of a joint need not hold it quite: as far as it is large enough, speed falls off with the time constant
//! `creep + settling` to `creep` times the acceleration that the other forces alone would give.
//!
//! With a resistance R \[command/A\], a motor constant K and G volts per unit of command, `k_e = K/G`, `k_a = J R/K`,
//! `k_b = B R/K`, `k_s = T R/K`. Derivatives are carried along as dual numbers (Griewank and Walther 2008, chapter 3):
//! one more parameter adds a column but no code.

mod filter;
mod model;
mod motor;
mod normal;
mod pieces;
mod play;
mod start;
mod stepper;

pub use model::{Frame, GreyBox, JOINT, MOST_UNITS};
pub(crate) use motor::{Motor, Moving, tanh_of_one};
pub use normal::{Current, Measured, Normal, normal};
pub use pieces::{Descent, Fit, Pieces};
pub use start::{Smoothing, regressed, waves};

use crate::simd::{self, F64x8, Kernel};
use crate::{Error, Monitor, Result};

/// Names of the parameters, in their order.
pub const PARAMETERS: [&str; 30] = [
    "k_e",
    "k_b",
    "k_a",
    "tau",
    "drop",
    "ripple",
    "k_s",
    "offset",
    "k_t",
    "w_s",
    "load_1c",
    "load_1s",
    "load_2c",
    "load_2s",
    "inertia_2c",
    "inertia_2s",
    "delay",
    "limit",
    "k_d",
    "sag",
    "eccentric_c",
    "eccentric_s",
    "cogging_1c",
    "cogging_1s",
    "cogging_2c",
    "cogging_2s",
    "cogging_3c",
    "cogging_3s",
    "torque_ripple_c",
    "torque_ripple_s",
];

/// Loads and inertia, once and twice per turn.
const FIRST_OVER_THE_TURN: usize = 10;
const LAST_OVER_THE_TURN: usize = 15;
const DELAY: usize = 16;
const LIMIT: usize = 17;
const UNEVEN: usize = 18;
const SAG: usize = 19;
const ECCENTRIC: usize = 20;
/// The first of the two coefficients of each order in [`Run::orders`].
const WAVES: usize = 22;

/// Number of orders: those of cogging, and one of the torque ripple.
pub const ORDERS: usize = 4;

/// Whether a parameter describes a variation over the turn.
fn varies(place: usize) -> bool {
    (FIRST_OVER_THE_TURN..=LAST_OVER_THE_TURN).contains(&place) || place >= ECCENTRIC
}

/// Most Newton steps for the voltage drop; the function is monotone, and the start is the previous value.
const NEWTON: usize = 3;

/// Relative to the ripple: after a step below this, one more step (convergence is quadratic) has all digits.
const NEWTON_TOLERANCE: f64 = 1e-7;

/// A value with its derivatives with respect to `N` parameters.
#[derive(Clone, Copy, Debug)]
struct Dual<const N: usize> {
    value: f64,
    by: [f64; N],
}

impl<const N: usize> Dual<N> {
    const ZERO: Self = Self::constant(0.0);

    const fn constant(value: f64) -> Self {
        Self {
            value,
            by: [0.0; N],
        }
    }

    /// The result of a function of `self` with this value and slope.
    #[inline(always)]
    fn through(self, value: f64, slope: f64) -> Self {
        Self {
            value,
            by: self.by.map(|d| d * slope),
        }
    }

    /// `self + factor other`.
    #[inline(always)]
    fn plus(mut self, factor: f64, other: &Self) -> Self {
        self.value += factor * other.value;
        for (d, o) in self.by.iter_mut().zip(&other.by) {
            *d += factor * o;
        }
        self
    }

    #[inline(always)]
    fn times(self, other: &Self) -> Self {
        let mut by = [0.0; N];
        for (d, (a, b)) in by.iter_mut().zip(self.by.iter().zip(&other.by)) {
            *d = a * other.value + self.value * b;
        }
        Self {
            value: self.value * other.value,
            by,
        }
    }

    #[inline(always)]
    fn scaled(self, factor: f64) -> Self {
        self.through(self.value * factor, factor)
    }

    #[inline(always)]
    fn inverse(self) -> Self {
        let value = 1.0 / self.value;
        self.through(value, -value * value)
    }
}

/// What is simulated.
#[derive(Clone, Copy, Debug)]
pub struct Run<'a> {
    /// Values in the order of [`PARAMETERS`]; `limit` may be infinite.
    pub theta: &'a [f64; PARAMETERS.len()],
    /// Indices of the parameters for which derivatives are wanted.
    pub free: &'a [usize],
    /// Sample time \[s\].
    pub sample_time: f64,
    /// Integration steps per sample.
    pub steps: usize,
    /// Speed at the first sample \[rad/s\].
    pub speed: f64,
    /// Whether the output is the mean speed over the previous sample, as from a difference of counts.
    pub mean: bool,
    /// Shaft angle at the samples \[rad\]; integrated from zero if unknown.
    pub angle: Option<&'a [f64]>,
    /// Repetitions per turn of cogging, and of the torque ripple; 0 for none.
    pub orders: [u32; ORDERS],
}

/// The result of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Speed \[rad/s\], (N).
    pub speed: Vec<f64>,
    /// The command across the resistance, R i, (N).
    pub drive: Vec<f64>,
    /// Derivatives of the speed, row by row, (N, free).
    pub speed_by: Vec<f64>,
    /// Derivatives of the drive, (N, free).
    pub drive_by: Vec<f64>,
}

/// Speed and drive at every sample, before its command acts.
///
/// # Errors
/// Setting errors for parameters outside their range, for a fit of variations over the turn without an angle, and for
/// too many parameters; data errors for commands that are not finite or an angle of another length; a fit error after a
/// stop request.
pub fn run(task: Run<'_>, u: &[f64], monitor: &Monitor) -> Result<Found> {
    check(&task, u)?;
    let found = match task.free.len() {
        0 => simd::run(Carried::<0>(task, u, monitor)),
        1..=4 => simd::run(Carried::<4>(task, u, monitor)),
        5..=8 => simd::run(Carried::<8>(task, u, monitor)),
        9..=12 => simd::run(Carried::<12>(task, u, monitor)),
        13..=16 => simd::run(Carried::<16>(task, u, monitor)),
        17..=20 => simd::run(Carried::<20>(task, u, monitor)),
        _ => simd::run(Carried::<32>(task, u, monitor)),
    };
    if monitor.stopped() {
        return Err(Error::fit(
            "expected to be left alone, got a request to stop",
        ));
    }
    Ok(found)
}

fn check(task: &Run<'_>, u: &[f64]) -> Result<()> {
    for (j, (&value, name)) in task.theta.iter().zip(PARAMETERS).enumerate() {
        let infinite = name == "limit" && value == f64::INFINITY;
        let positive = ["k_a", "ripple", "w_s", "limit"].contains(&name);
        let not_negative = ["tau", "delay"].contains(&name);
        if !(value.is_finite() || infinite)
            || positive && value <= 0.0
            || not_negative && value < 0.0
        {
            let sign = if positive {
                "above 0"
            } else if not_negative {
                "from 0 on"
            } else {
                "that is finite"
            };
            return Err(Error::setting(format!(
                "expected a number {sign} as {name}, parameter {j} of theta, got {value}"
            )));
        }
    }
    if let Some(j) = task.free.iter().find(|&&j| j >= PARAMETERS.len()) {
        return Err(Error::setting(format!(
            "expected places of parameters from 0 to {}, got {j}",
            PARAMETERS.len() - 1
        )));
    }
    if task.free.len() > PARAMETERS.len() {
        return Err(Error::setting(format!(
            "expected each parameter once, got {} places",
            task.free.len()
        )));
    }
    if task.angle.is_none() && task.free.iter().any(|&j| varies(j)) {
        return Err(Error::setting(
            "expected the shaft's angle for derivatives by what varies over the turn, got none; pass angle",
        ));
    }
    let order = |j: usize| j >= WAVES && task.orders[(j - WAVES) / 2] == 0;
    if let Some(&j) = task.free.iter().find(|&&j| order(j)) {
        return Err(Error::setting(format!(
            "expected in orders how often {} repeats per turn, got 0",
            PARAMETERS[j]
        )));
    }
    if !(task.sample_time.is_finite()
        && task.sample_time > 0.0
        && (1..=10_000).contains(&task.steps))
    {
        return Err(Error::setting(format!(
            "expected a sample time above 0 s and 1 to 10,000 steps, got {} s and {}",
            task.sample_time, task.steps
        )));
    }
    if task.theta[DELAY] / task.sample_time >= 1e9 {
        return Err(Error::setting(format!(
            "expected a delay below a billion samples, got {} s",
            task.theta[DELAY]
        )));
    }
    if !task.speed.is_finite() || u.iter().any(|u| !u.is_finite()) {
        return Err(Error::data(
            "expected a finite speed and finite commands, got others; cut gaps out",
        ));
    }
    match task.angle {
        Some(angle) if angle.len() != u.len() || angle.iter().any(|a| !a.is_finite()) => {
            Err(Error::data(format!(
                "expected {} finite angles, one per command, got {}",
                u.len(),
                angle.len()
            )))
        }
        _ => Ok(()),
    }
}

/// The parameters, as dual numbers.
#[derive(Clone, Debug)]
struct Equations<const N: usize> {
    k_e: Dual<N>,
    k_b: Dual<N>,
    k_a: Dual<N>,
    drop: Dual<N>,
    ripple: Dual<N>,
    k_s: Dual<N>,
    offset: Dual<N>,
    k_t: Dual<N>,
    per_w_s: Dual<N>,
    turn: [Dual<N>; LAST_OVER_THE_TURN - FIRST_OVER_THE_TURN + 1],
    limit: Option<Dual<N>>,
    /// Terms that few motors need: `None` costs nothing.
    uneven: Option<Dual<N>>,
    sag: Option<Dual<N>>,
    eccentric: Option<[Dual<N>; 2]>,
    waves: [Option<Wave<N>>; ORDERS],
    /// Friction of gears per load that they carry.
    k_l: Option<Dual<N>>,
    /// The same per drive, per load from outside, and per square of the drive.
    directional: Option<[Dual<N>; 3]>,
    /// Of a friction that does not hold quite, over half a step and a whole one.
    soft: Option<[Soft<N>; 2]>,
    /// Exponent of the fall of the friction with speed.
    exponent: Option<Dual<N>>,
    inner: Option<Inner<N>>,
    /// Fraction of the way to its goal that the drive covers in a step, `1 - exp(-h / tau)`.
    share: Dual<N>,
    /// Weight of the start in the drive's mean over a step.
    memory: Dual<N>,
    /// Response to the goal's change over a step, beyond the response to a goal held at its value in the middle:
    /// `1/2 - tau/h + exp(-h/tau) (1/2 + tau/h)`, one half without a lag. Without this term drive and current would be
    /// those of half a step earlier.
    bend: Dual<N>,
    step: f64,
}

/// A drive's own controller, whose loop gain is 1 command per command.
#[derive(Clone, Copy, Debug)]
struct Inner<const N: usize> {
    /// Commands per rad or metre.
    k_q: Dual<N>,
    damping: Dual<N>,
    dead_band: Option<Dual<N>>,
    reach: Option<Dual<N>>,
}

impl<const N: usize> Inner<N> {
    /// Its output at a position and speed, and how the output changes over `time` at this speed.
    #[inline(always)]
    fn output(&self, u: &Dual<N>, q: &Dual<N>, w: &Dual<N>, time: f64) -> (Dual<N>, Dual<N>) {
        let mut error = u.plus(-1.0, &self.k_q.times(q));
        let mut change = self.k_q.times(w).scaled(-time);
        if let Some(dead_band) = &self.dead_band {
            if error.value.abs() > dead_band.value {
                error = error.plus(-error.value.signum(), dead_band);
            } else {
                (error, change) = (Dual::ZERO, Dual::ZERO);
            }
        }
        let output = error.plus(-1.0, &self.damping.times(w));
        match &self.reach {
            Some(reach) if output.value.abs() > reach.value => {
                (reach.scaled(output.value.signum()), Dual::ZERO)
            }
            _ => (output, change),
        }
    }
}

/// Where friction is large enough, the speed after a time is `keep` of that before, and `gain` of the other forces' change.
#[derive(Clone, Copy, Debug)]
struct Soft<const N: usize> {
    keep: Dual<N>,
    gain: Dual<N>,
}

impl<const N: usize> Soft<N> {
    /// An implicit step, which stays stable for any time constant.
    fn over(time: f64, creep: &Dual<N>, settling: &Dual<N>) -> Self {
        let constant = creep.plus(1.0, settling);
        let share = constant.plus(1.0, &Dual::constant(time)).inverse();
        Self {
            keep: constant.times(&share),
            gain: creep.times(&share),
        }
    }
}

/// `c cos(order th) + s sin(order th)`.
#[derive(Clone, Copy, Debug)]
struct Wave<const N: usize> {
    order: f64,
    c: Dual<N>,
    s: Dual<N>,
}

impl<const N: usize> Wave<N> {
    /// Its mean while the shaft turns by `turned` around `angle`: a wave that repeats several times in a sample cancels.
    #[inline(always)]
    fn mean(&self, angle: f64, turned: f64) -> Dual<N> {
        let (s, c) = (self.order * angle).sin_cos();
        let half = 0.5 * self.order * turned;
        let share = if half.abs() > 1e-4 {
            half.sin() / half
        } else {
            1.0
        };
        self.c.scaled(share * c).plus(share * s, &self.s)
    }
}

/// The quantities that depend on the angle.
#[derive(Clone, Copy, Debug)]
struct Turn<const N: usize> {
    per_inertia: Dual<N>,
    half_slope: Dual<N>,
    load: Dual<N>,
    /// Torque per current, and back-EMF per speed, relative to their means.
    gain: Option<Dual<N>>,
}

impl<const N: usize> Equations<N> {
    fn new(task: &Run<'_>, step: f64) -> Self {
        let one = |j: usize| {
            let mut dual = Dual::constant(task.theta[j]);
            if let Some(place) = task.free.iter().position(|&free| free == j) {
                dual.by[place] = 1.0;
            }
            dual
        };
        let some = |j: usize| task.theta[j] != 0.0 || task.free.contains(&j);
        let tau = one(3);
        // a lag far below the step counts as none; its derivative is then 0, not infinite
        let lag = tau.scaled(1.0 / step);
        let half = Dual::constant(0.5);
        let (share, memory, bend) = if lag.value > 1e-3 {
            let left = (-1.0 / lag.value).exp();
            let share = lag.through(1.0 - left, -left / (lag.value * lag.value));
            let bend = half.plus(-1.0, &lag).plus(
                1.0,
                &lag.through(left, left / (lag.value * lag.value))
                    .times(&half.plus(1.0, &lag)),
            );
            (share, share.times(&lag), bend)
        } else {
            (Dual::constant(1.0), lag, half.plus(-1.0, &lag))
        };
        Self {
            k_e: one(0),
            k_b: one(1),
            k_a: one(2),
            drop: one(4),
            ripple: one(5),
            k_s: one(6),
            offset: one(7),
            k_t: one(8),
            per_w_s: one(9).inverse(),
            turn: std::array::from_fn(|j| one(FIRST_OVER_THE_TURN + j)),
            limit: task.theta[LIMIT].is_finite().then(|| one(LIMIT)),
            uneven: some(UNEVEN).then(|| one(UNEVEN)),
            sag: some(SAG).then(|| one(SAG)),
            eccentric: (some(ECCENTRIC) || some(ECCENTRIC + 1))
                .then(|| [one(ECCENTRIC), one(ECCENTRIC + 1)]),
            waves: std::array::from_fn(|j| {
                (task.orders[j] > 0).then(|| Wave {
                    order: f64::from(task.orders[j]),
                    c: one(WAVES + 2 * j),
                    s: one(WAVES + 2 * j + 1),
                })
            }),
            k_l: None,
            directional: None,
            soft: None,
            exponent: None,
            inner: None,
            share,
            memory,
            bend,
            step,
        }
    }

    /// For a sample in which the shaft turns by `turned` around `angle`.
    #[inline(always)]
    fn at(&self, angle: f64, turned: f64) -> Turn<N> {
        let (s1, c1) = angle.sin_cos();
        let (s2, c2) = (2.0 * s1 * c1, (c1 - s1) * (c1 + s1));
        let [first_c, first_s, second_c, second_s, c, s] = &self.turn;
        let inertia = self.k_a.plus(c2, c).plus(s2, s);
        // an inertia stays positive, whatever a search tries
        let least = 0.05 * self.k_a.value;
        let inertia = if inertia.value > least {
            inertia
        } else {
            Dual::constant(least)
        };
        let [cogging @ .., ripple] = &self.waves;
        let load = self
            .offset
            .plus(c1, first_c)
            .plus(s1, first_s)
            .plus(c2, second_c)
            .plus(s2, second_s);
        Turn {
            per_inertia: inertia.inverse(),
            half_slope: Dual::ZERO.plus(-s2, c).plus(c2, s),
            load: cogging
                .iter()
                .flatten()
                .fold(load, |load, wave| load.plus(1.0, &wave.mean(angle, turned))),
            gain: ripple.map(|wave| Dual::constant(1.0).plus(1.0, &wave.mean(angle, turned))),
        }
    }

    /// The speed that an encoder shows at an angle.
    #[inline(always)]
    fn seen(&self, speed: Dual<N>, angle: f64) -> Dual<N> {
        match &self.eccentric {
            Some([c, s]) => {
                let (sin, cos) = angle.sin_cos();
                let factor = Dual::constant(1.0).plus(cos, c).plus(sin, s);
                speed.times(&factor)
            }
            None => speed,
        }
    }

    /// The magnitude of dry friction against a motion in this direction.
    #[inline(always)]
    fn dry(&self, speed: &Dual<N>, direction: f64) -> Dual<N> {
        if self.k_t.value == 0.0 && self.k_t.by == [0.0; N] && self.uneven.is_none() {
            return self.k_s;
        }
        let bump = match &self.uneven {
            Some(k_d) => self.k_t.plus(direction, k_d),
            None => self.k_t,
        };
        let ratio = speed.times(&self.per_w_s);
        let shape = match &self.exponent {
            Some(exponent) => fall(&ratio, exponent),
            None => ratio
                .times(&ratio)
                .plus(1.0, &Dual::constant(1.0))
                .inverse(),
        };
        self.k_s.plus(1.0, &bump.times(&shape))
    }

    /// The speed after `time` under a drive; terms that depend on the speed are taken at `middle`.
    ///
    /// Dry friction slows the shaft, at most to standstill: if it could take more than the speed without friction, the
    /// result is 0. This is Moreau's scheme (Acary and Brogliato 2008), which sticks and breaks away without events.
    #[inline(always)]
    fn moved(
        &self,
        turn: &Turn<N>,
        from: &Dual<N>,
        drive: &Dual<N>,
        middle: &Dual<N>,
        time: f64,
    ) -> Dual<N> {
        let torque = turn.gain.map_or(*drive, |gain| drive.times(&gain));
        let smooth = torque
            .plus(-1.0, &turn.load)
            .plus(-1.0, &self.k_b.times(middle))
            .plus(-1.0, &turn.half_slope.times(&middle.times(middle)));
        let free = from.plus(time, &smooth.times(&turn.per_inertia));
        let mut dry = self.dry(middle, free.value.signum());
        if let Some(k_l) = &self.k_l {
            let carried = torque.plus(1.0, &turn.load);
            dry = dry.plus(carried.value.signum(), &k_l.times(&carried));
        }
        if let Some([k_m, k_g, k_mm]) = &self.directional {
            dry = dry
                .plus(torque.value.signum(), &k_m.times(&torque))
                .plus(turn.load.value.signum(), &k_g.times(&turn.load))
                .plus(1.0, &k_mm.times(&torque.times(&torque)));
        }
        let most = dry.times(&turn.per_inertia).scaled(time);
        if let Some([half, whole]) = &self.soft {
            let soft = if time < self.step { half } else { whole };
            let held = from
                .times(&soft.keep)
                .plus(1.0, &free.plus(-1.0, from).times(&soft.gain));
            let taken = free.value - held.value;
            if taken.abs() <= most.value {
                return held;
            }
            return free.plus(-taken.signum(), &most);
        } else if free.value.abs() <= most.value {
            return Dual::ZERO;
        }
        free.plus(-free.value.signum(), &most)
    }

    /// The drive after a step towards `goal`, which changes by `change` during the step, and the drive's mean;
    /// `x + share drop(x) = x_0 + share (goal - x_0) + bend change`.
    #[inline(always)]
    fn driven(&self, from: &Dual<N>, goal: &Dual<N>, change: &Dual<N>) -> (Dual<N>, Dual<N>) {
        let aim = from
            .plus(1.0, &self.share.times(&goal.plus(-1.0, from)))
            .plus(1.0, &self.bend.times(change));
        let mut after = aim;
        let mut taken = Dual::ZERO;
        if self.drop.value != 0.0 || self.drop.by != [0.0; N] {
            let (share, drop, ripple) = (self.share.value, self.drop.value, self.ripple.value);
            let mut x = from.value;
            // one root and one division per iteration, in a dependency chain through every sample of the run
            let (most, square) = (share * drop, ripple * ripple);
            for _ in 0..NEWTON {
                let per_root = 1.0 / (x * x + square).sqrt();
                let slope = 1.0 + most * square * (per_root * per_root * per_root);
                let by = (x + most * x * per_root - aim.value) / slope.max(0.1);
                x -= by;
                if by.abs() < NEWTON_TOLERANCE * ripple {
                    break;
                }
            }
            // one more step, carrying derivatives, makes them exact: those of an implicit function
            let root = (x * x + ripple * ripple).sqrt();
            let by_ripple = -x * ripple / (root * root * root);
            let shape = self.ripple.through(x / root, by_ripple);
            let taken_at = self.drop.times(&shape);
            let slope = 1.0 + share * drop * ripple * ripple / (root * root * root);
            after = Dual::constant(x).plus(
                1.0 / slope.max(0.1),
                &aim.plus(-1.0, &Dual::constant(x))
                    .plus(-1.0, &self.share.times(&taken_at)),
            );
            taken = aim.plus(-1.0, &after).times(&self.share.inverse());
        }
        let steady = goal.plus(-1.0, &taken);
        let mean = steady.plus(1.0, &self.memory.times(&from.plus(-1.0, &steady)));
        (self.limited(after), self.limited(mean))
    }

    #[inline(always)]
    fn limited(&self, drive: Dual<N>) -> Dual<N> {
        match &self.limit {
            Some(limit) if drive.value.abs() > limit.value => limit.scaled(drive.value.signum()),
            _ => drive,
        }
    }

    /// Drive and speed after a step at this command, from position `q`.
    #[inline(always)]
    fn advanced(
        &self,
        turn: &Turn<N>,
        x: &Dual<N>,
        w: &Dual<N>,
        q: &Dual<N>,
        u: &Dual<N>,
    ) -> (Dual<N>, Dual<N>) {
        let middle = self.moved(turn, w, x, w, 0.5 * self.step);
        let k_e = turn.gain.map_or(self.k_e, |gain| self.k_e.times(&gain));
        let mut voltage = *u;
        let mut change = k_e.times(&w.plus(-1.0, &middle)).scaled(2.0);
        if let Some(inner) = &self.inner {
            let half = q.plus(0.25 * self.step, w).plus(0.25 * self.step, &middle);
            let (output, by) = inner.output(u, &half, &middle, self.step);
            (voltage, change) = (output, change.plus(1.0, &by));
        }
        if let Some(sag) = &self.sag {
            voltage = voltage.plus(-1.0, &sag.times(x).times(&u.times(u)));
        }
        let goal = voltage.plus(-1.0, &k_e.times(&middle));
        let (after, mean) = self.driven(x, &goal, &change);
        (after, self.moved(turn, w, &mean, &middle, self.step))
    }
}

/// `exp(-|ratio|^exponent)`.
#[inline(always)]
fn fall<const N: usize>(ratio: &Dual<N>, exponent: &Dual<N>) -> Dual<N> {
    let size = ratio.value.abs();
    let power = size.powf(exponent.value);
    let value = (-power).exp();
    if size == 0.0 || value == 0.0 {
        return Dual::constant(value);
    }
    let slope = -value * power;
    ratio
        .through(value, slope * exponent.value / ratio.value)
        .plus(slope * size.ln(), &exponent.through(0.0, 1.0))
}

/// Samples between two checks for a stop request: a few milliseconds.
const BETWEEN_LOOKS: usize = 1000;

struct Carried<'a, const N: usize>(Run<'a>, &'a [f64], &'a Monitor);

impl<const N: usize> Kernel for Carried<'_, N> {
    type Output = Found;

    #[inline(always)]
    fn run<V: F64x8>(self) -> Found {
        let Self(task, u, monitor) = self;
        let (n, m) = (u.len(), task.free.len());
        let step = task.sample_time / task.steps as f64;
        let is = Equations::<N>::new(&task, step);
        let mut found = Found {
            speed: Vec::with_capacity(n),
            drive: Vec::with_capacity(n),
            speed_by: Vec::with_capacity(n * m),
            drive_by: Vec::with_capacity(n * m),
        };
        let delay = task.theta[DELAY] / task.sample_time;
        let (whole, part) = (delay.floor() as usize, delay.fract());
        let late = task.free.iter().position(|&j| j == DELAY);
        let at = |k: usize, back: usize| u[k.saturating_sub(back)];
        let mut w = Dual::<N>::constant(task.speed);
        let mut x = match u.first() {
            Some(&first) => is.limited(Dual::constant(first).plus(-1.0, &is.k_e.times(&w))),
            None => return found,
        };
        let mut shown = w;
        let mut angle = 0.0;
        for k in 0..n {
            if k % BETWEEN_LOOKS == 0 && monitor.stopped() {
                break;
            }
            found.speed.push(shown.value);
            found.drive.push(x.value);
            found.speed_by.extend_from_slice(&shown.by[..m]);
            found.drive_by.extend_from_slice(&x.by[..m]);
            let (from, turned) = match task.angle {
                Some(known) => (known[k], known[(k + 1).min(n - 1)] - known[k]),
                None => (angle, w.value * task.sample_time),
            };
            let middle = from + 0.5 * turned;
            let turn = is.at(middle, turned);
            let (now, before) = (at(k, whole), at(k, whole + 1));
            let mut mean = Dual::ZERO;
            for j in 0..task.steps {
                // a delayed command changes within a step: its mean over the step acts
                let old = part * task.steps as f64 - j as f64;
                let mut command = Dual::constant(now + old.clamp(0.0, 1.0) * (before - now));
                if let (Some(place), true) = (late, (0.0..1.0).contains(&old)) {
                    command.by[place] = (before - now) / step;
                }
                let (drive, speed) = is.advanced(&turn, &x, &w, &Dual::ZERO, &command);
                mean = mean.plus(0.5, &w).plus(0.5, &speed);
                (x, w) = (drive, speed);
            }
            let mean = mean.scaled(1.0 / task.steps as f64);
            angle += mean.value * task.sample_time;
            shown = if task.mean {
                is.seen(mean, middle)
            } else {
                is.seen(w, from + turned)
            };
        }
        found
    }
}

#[cfg(test)]
mod tests;
