//! The motion of a grey box over one sample, with derivatives by theta and by the states.

use super::model::{
    COGGING, CREEP, DAMPING, DEAD_BAND, EXPONENT, Frame, GRAVITY, K_G, K_L, K_M, K_MM, K_Q,
    LOAD_SHARE, OF_JOINT, PLAY, RATE, REACH, RUB_SHARE, SETTLING,
};
use super::model::{GreyBox, POSITION, SHOWN, STATES, WEIGHTS};
use super::play::{Play, side_of};
use super::{DELAY, Dual, Equations, Inner, Run, Soft, Turn};

/// The motor's state with its derivatives; the position stays 0 if it is not the output.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moving<const N: usize> {
    pub w: Dual<N>,
    pub x: Dual<N>,
    pub before: Dual<N>,
    pub q: Dual<N>,
    /// What the controller goes for, with a limit of its rate.
    pub setpoint: Dual<N>,
    /// Position and speed of a load behind play.
    pub shown: Dual<N>,
    pub v: Dual<N>,
}

impl<const N: usize> Moving<N> {
    pub fn at(model: &GreyBox, state: &[f64]) -> Self {
        let scales = model.scales();
        let one = |j: usize| Dual::constant(scales[j] * state.get(j).copied().unwrap_or(0.0));
        Self {
            w: one(0),
            x: one(1),
            before: one(2),
            q: one(POSITION),
            setpoint: one(4),
            shown: one(SHOWN),
            v: one(6),
        }
    }

    /// With derivatives by the states, from index `place` on.
    pub fn seeded(mut self, model: &GreyBox, place: usize) -> Self {
        let states = [
            &mut self.w,
            &mut self.x,
            &mut self.before,
            &mut self.q,
            &mut self.setpoint,
            &mut self.shown,
            &mut self.v,
        ];
        for (j, (state, scale)) in states.into_iter().zip(model.scales()).enumerate() {
            if j < model.order() {
                state.by[place + j] = scale;
            }
        }
        self
    }

    pub fn states(&self) -> [Dual<N>; STATES] {
        [
            self.w,
            self.x,
            self.before,
            self.q,
            self.setpoint,
            self.shown,
            self.v,
        ]
    }

    /// The states in units of their scales.
    pub fn scaled(&self, model: &GreyBox) -> [Dual<N>; STATES] {
        let (scales, states) = (model.scales(), self.states());
        std::array::from_fn(|j| states[j].scaled(1.0 / scales[j]))
    }

    pub fn state(&self, model: &GreyBox) -> [f64; STATES] {
        let (scales, states) = (model.scales(), self.states());
        std::array::from_fn(|j| states[j].value / scales[j])
    }
}

/// Steps by one sample with [`Equations`].
#[derive(Clone, Debug)]
pub(super) struct Stepper<const N: usize> {
    pub equations: Equations<N>,
    pub turn: Turn<N>,
    pub network: Vec<[Dual<N>; WEIGHTS]>,
    /// Loads over the angle: gravity and cogging.
    pub by_angle: Vec<ByAngle<N>>,
    /// Most change of the controller's setpoint per second.
    pub rate: Option<Dual<N>>,
    pub play: Option<Play<N>>,
    pub frame: Frame,
    /// Fraction of a sample in the command's delay.
    pub part: f64,
    /// Place of the delay among the free parameters.
    pub late: Option<usize>,
}

/// `c cos(order q) + s sin(order q)`.
#[derive(Clone, Copy, Debug)]
pub(super) struct ByAngle<const N: usize> {
    pub order: Dual<N>,
    pub c: Dual<N>,
    pub s: Dual<N>,
}

/// A setpoint's mean and end over a time in which it goes for a command at a limited rate.
#[inline(always)]
fn ramped<const N: usize>(
    rate: &Dual<N>,
    from: &Dual<N>,
    command: &Dual<N>,
    time: &Dual<N>,
) -> (Dual<N>, Dual<N>) {
    let (left, most) = (command.plus(-1.0, from), rate.times(time));
    if left.value.abs() <= most.value {
        return (*command, *command);
    }
    let change = most.scaled(side_of(&left));
    (from.plus(0.5, &change), from.plus(1.0, &change))
}

impl<const N: usize> ByAngle<N> {
    #[inline(always)]
    fn added_to(&self, load: &Dual<N>, q: &Dual<N>) -> Dual<N> {
        let angle = self.order.times(q);
        let (sin, cos) = angle.value.sin_cos();
        load.plus(1.0, &self.c.times(&angle.through(cos, -sin)))
            .plus(1.0, &self.s.times(&angle.through(sin, cos)))
    }
}

impl<const N: usize> Stepper<N> {
    /// With or without derivatives by theta.
    pub fn new(model: &GreyBox, by_theta: bool) -> Self {
        let frame = &model.frame;
        let step = frame.sample_time / frame.steps as f64;
        let run = Run {
            free: if by_theta { &frame.free } else { &[] },
            ..model.run()
        };
        let mut equations = Equations::new(&run, step);
        let joint = |j: usize| {
            let mut dual = Dual::constant(frame.joint[j]);
            if let Some(place) = run.free.iter().position(|&free| free == OF_JOINT + j) {
                dual.by[place] = 1.0;
            }
            dual
        };
        let some = |j: usize| frame.joint[j] != 0.0 || run.free.contains(&(OF_JOINT + j));
        equations.k_l = some(K_L).then(|| joint(K_L));
        let directional = [K_M, K_G, K_MM];
        equations.directional = directional
            .iter()
            .any(|&j| some(j))
            .then(|| directional.map(joint));
        let (creep, settling) = (joint(CREEP), joint(SETTLING));
        equations.soft = (some(CREEP) || some(SETTLING))
            .then(|| [0.5 * step, step].map(|time| Soft::over(time, &creep, &settling)));
        equations.exponent = some(EXPONENT).then(|| joint(EXPONENT));
        equations.inner = some(K_Q).then(|| Inner {
            k_q: joint(K_Q),
            damping: joint(DAMPING),
            dead_band: some(DEAD_BAND).then(|| joint(DEAD_BAND)),
            reach: (frame.joint[REACH] > 0.0).then(|| joint(REACH)),
        });
        let [c, s, ..] = equations.turn;
        let mut by_angle = Vec::new();
        let pulls = GRAVITY
            .iter()
            .any(|&j| frame.values[j] != 0.0 || run.free.contains(&j));
        if pulls {
            (equations.turn[0], equations.turn[1]) = (Dual::ZERO, Dual::ZERO);
            let order = Dual::constant(1.0);
            by_angle.push(ByAngle { order, c, s });
        }
        if COGGING.iter().any(|&j| some(j)) {
            let [c, s, order] = COGGING.map(joint);
            by_angle.push(ByAngle { order, c, s });
        }
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
            by_angle,
            rate: (frame.joint[RATE] > 0.0).then(|| joint(RATE)),
            play: some(PLAY)
                .then(|| Play::new(&equations, [PLAY, LOAD_SHARE, RUB_SHARE].map(joint))),
            equations,
            network: model
                .network
                .iter()
                .map(|unit| unit.map(&mut weight))
                .collect(),
            frame: frame.clone(),
            part: model.delay().fract(),
            late: run.free.iter().position(|&j| j == DELAY),
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
    pub fn step(&self, at: &mut Moving<N>, now: &Dual<N>) -> Dual<N> {
        let mut turn = self.turn;
        if !self.network.is_empty() {
            turn.load = turn.load.plus(1.0, &self.residual(&at.w, &at.x));
        }
        let steps = self.frame.steps;
        let step = self.equations.step;
        let mut mean = Dual::ZERO;
        for j in 0..steps {
            let left = self.part * steps as f64 - j as f64;
            let old = left.clamp(0.0, 1.0);
            let (mut held, mut given) = (at.before, *now);
            let shifts = self.late.filter(|_| (0.0..1.0).contains(&left));
            if let Some(rate) = &self.rate {
                let mut before = Dual::constant(old * step);
                if let Some(place) = shifts {
                    before.by[place] = 1.0;
                }
                let after = Dual::constant(step).plus(-1.0, &before);
                let (mean, end) = ramped(rate, &at.setpoint, &held, &before);
                held = mean;
                (given, at.setpoint) = ramped(rate, &end, &given, &after);
            }
            let mut command = given.scaled(1.0 - old).plus(old, &held);
            if let Some(place) = shifts {
                command.by[place] += (held.value - given.value) / step;
            }
            let mut turn = turn;
            if !self.by_angle.is_empty() {
                let q = at.q.plus(0.5 * step, &at.w);
                for wave in &self.by_angle {
                    turn.load = wave.added_to(&turn.load, &q);
                }
            }
            let equations = &self.equations;
            if let Some(play) = &self.play {
                play.step(equations, &turn, at, &command);
                continue;
            }
            let (drive, speed) = equations.advanced(&turn, &at.x, &at.w, &at.q, &command);
            if self.frame.position {
                at.q = at.q.plus(0.5 * step, &at.w).plus(0.5 * step, &speed);
            } else {
                mean = mean.plus(0.5, &at.w).plus(0.5, &speed);
            }
            (at.x, at.w) = (drive, speed);
        }
        at.before = *now;
        let output = match &self.frame {
            frame if frame.position && self.play.is_some() => at.shown,
            frame if frame.position => at.q,
            frame if frame.mean => mean.scaled(1.0 / steps as f64),
            _ => at.w,
        };
        output.scaled(1.0 / self.frame.unit)
    }
}
