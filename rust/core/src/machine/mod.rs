//! The virtual sewing machine: a physical model of drive, crank and load.
//!
//! Equations, parameters and derived figures are in `docs/CONVENTIONS.md`; the equations also in [`dynamics`], the
//! values and their spread in [`parameters`]. Here the machine is advanced, sample by sample and regime by regime.

mod dynamics;
mod parameters;

use std::f64::consts::TAU;

use crate::closed_loop::Plant;
use crate::speed::Encoder;
use crate::{Error, Result};
use dynamics::{Dynamics, Regime, Shaft, State};

pub use parameters::{Entry, Parameters, Spread};

/// The sample time of the machine [s].
pub const SAMPLE_TIME: f64 = 1e-3;

/// Integration steps per sample.
const STEPS: u32 = 4;

/// Substeps of such a step if a second mass swings behind a shaft: at 400 Hz its frequency is accurate to .1 %.
const SHAFT_STEPS: u32 = 6;

/// Pieces into which a step is cut if it passes an event or the narrow zone around the current's change of sign.
const PIECES: u32 = 8;

/// Half the width, in current ripples, of the zone around zero current; a step that crosses it is cut.
const ZONE: f64 = 4.0;

/// Fraction of that zone by which the current may move in an uncut step.
const STRIDE: f64 = 0.2;

/// Changes of regime after which the rest of a piece is integrated without further events.
const EVENTS_PER_PIECE: u32 = 8;

const RPM: f64 = 60.0 / TAU;

/// The virtual sewing machine, stepped sample by sample.
///
/// ```
/// use sewfast_core::machine::{Machine, Parameters};
/// let mut machine = Machine::new(Parameters::default())?;
/// for _ in 0..2000 {
///     machine.advance(3.0);
/// }
/// assert!((machine.speed_rpm() - 1310.0).abs() < 60.0);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Machine {
    parameters: Parameters,
    dynamics: Dynamics,
    encoder: Encoder,
    steps: u32,
    state: State,
    turns: f64,
    regime: Regime,
    voltage: f64,
    /// Constant load torque \[N m\].
    load: f64,
    /// The second mass; `None` if the machine is rigid.
    shaft: Option<Shaft>,
}

impl Machine {
    /// A machine at rest.
    ///
    /// # Errors
    /// As [`Parameters::validated`].
    pub fn new(parameters: Parameters) -> Result<Self> {
        let parameters = parameters.validated()?;
        let counts_per_unit = parameters.counts_per_rev / 60.0;
        let mut machine = Self {
            parameters,
            dynamics: Dynamics::new(&parameters),
            encoder: match parameters.quantisation != 0.0 {
                true => Encoder::new(counts_per_unit, parameters.encoder_phase),
                false => Encoder::ideal(counts_per_unit),
            },
            steps: STEPS,
            state: State::new(0.0, 0.0, 0.0),
            turns: 0.0,
            regime: Regime {
                motion: 0.0,
                limited: 0.0,
            },
            voltage: 0.0,
            load: 0.0,
            shaft: Shaft::new(&parameters),
        };
        machine.reset();
        Ok(machine)
    }

    /// The parameters.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Back to rest at the initial crank angle, counter at zero.
    pub fn reset(&mut self) {
        let angle = self.parameters.initial_angle;
        self.state = State::new(0.0, 0.0, angle);
        self.turns = 0.0;
        self.voltage = 0.0;
        self.regime = Regime {
            motion: 0.0,
            limited: 0.0,
        };
        if let Some(shaft) = &mut self.shaft {
            shaft.reset();
        }
        self.dynamics.load = self.load;
        self.settle();
    }

    /// Loads the shaft with a constant torque \[N m\] from now on, including after resets; 0 removes it.
    ///
    /// It brakes if it has the sign of the speed, and turns the machine backwards if nothing holds it.
    ///
    /// # Errors
    /// A setting error if `torque` is not finite.
    pub fn set_load(&mut self, torque: f64) -> Result<()> {
        if !torque.is_finite() {
            return Err(Error::setting(format!(
                "expected a finite load torque [N m], got {torque}; 0 takes the load off"
            )));
        }
        self.load = torque;
        self.dynamics.load = torque + self.shaft.map_or(0.0, |shaft| shaft.torque);
        self.settle();
        Ok(())
    }

    /// Everything that changes from sample to sample, the load, and the shaft's state if there is one; for [`Machine::recall`].
    pub fn memory(&self) -> [f64; 11] {
        let State {
            current,
            speed,
            angle,
            ..
        } = self.state;
        let Regime { motion, limited } = self.regime;
        let (turns, voltage, load) = (self.turns, self.voltage, self.load);
        let [twist, far, torque] = self.shaft.map_or([0.0; 3], |shaft| shaft.memory());
        [
            current, speed, angle, turns, motion, limited, voltage, load, twist, far, torque,
        ]
    }

    /// Continues from the [`Machine::memory`] of a machine with the same parameters.
    ///
    /// # Errors
    /// A setting error if a value is not finite.
    pub fn recall(&mut self, memory: [f64; 11]) -> Result<()> {
        if let Some(value) = memory.iter().find(|value| !value.is_finite()) {
            return Err(Error::setting(format!(
                "expected a machine's memory of finite values, got {value}; take it from Machine::memory"
            )));
        }
        let [
            current,
            speed,
            angle,
            turns,
            motion,
            limited,
            voltage,
            load,
            twist,
            far,
            torque,
        ] = memory;
        self.state = State::new(current, speed, angle);
        self.regime = Regime { motion, limited };
        (self.turns, self.voltage) = (turns, voltage);
        self.load = load;
        self.dynamics.load = load + torque;
        if let Some(shaft) = &mut self.shaft {
            shaft.recall([twist, far, torque]);
        }
        Ok(())
    }

    /// True speed [RPM].
    pub fn speed_rpm(&self) -> f64 {
        self.state.speed * RPM
    }

    /// Motor current [A].
    pub fn current(&self) -> f64 {
        self.state.current
    }

    /// Speed integrated since the reset [RPM s]: turns times 60.
    pub fn position(&self) -> f64 {
        let angle = self.state.angle - self.parameters.initial_angle;
        (self.turns + angle / TAU) * 60.0
    }

    /// The encoder, which counts [`Machine::position`].
    pub fn encoder(&self) -> &Encoder {
        &self.encoder
    }

    /// The encoder's counter; a whole number unless quantisation is off.
    pub fn counts(&self) -> f64 {
        self.encoder.count(self.position())
    }

    /// Holds the command `u` [V] for one sample time.
    pub fn advance(&mut self, u: f64) {
        let p = &self.parameters;
        let mean = u.clamp(-p.u_limit, p.u_limit) * p.amplifier_gain;
        self.voltage = mean.clamp(-p.bus_voltage, p.bus_voltage);
        if self.regime.limited != 0.0 {
            self.settle();
        }
        let h = SAMPLE_TIME / f64::from(self.steps);
        match self.shaft {
            None => (0..self.steps).for_each(|_| self.substep(h)),
            Some(shaft) => self.swing(shaft, h / f64::from(SHAFT_STEPS)),
        }
        self.unwind();
    }

    /// A sample of both masses. The shaft's torque, taken in the middle of a step, acts on the crank as a load through
    /// the whole step: a leapfrog scheme of second order.
    #[cold]
    fn swing(&mut self, mut shaft: Shaft, h: f64) {
        for _ in 0..self.steps * SHAFT_STEPS {
            shaft.twist(self.state.speed, 0.5 * h);
            self.dynamics.load = self.load + shaft.torque;
            if self.regime.motion == 0.0 {
                self.settle();
            }
            self.substep(h);
            shaft.turn(h);
            shaft.twist(self.state.speed, 0.5 * h);
        }
        self.shaft = Some(shaft);
    }

    /// From the present state on, counts and true speed [RPM] at the instants at which `u[k]` starts to act.
    ///
    /// # Errors
    /// A data error if `u` is not finite.
    pub fn run(&mut self, u: &[f64]) -> Result<(Vec<f64>, Vec<f64>)> {
        if let Some(k) = u.iter().position(|value| !value.is_finite()) {
            return Err(Error::data(format!(
                "expected finite commands [V], got {} at sample {k}; repair or cut the signal",
                u[k]
            )));
        }
        let sample = |&u: &f64| {
            let measured = (self.counts(), self.speed_rpm());
            self.advance(u);
            measured
        };
        Ok(u.iter().map(sample).unzip())
    }

    /// Removes whole turns from the angle, to keep its precision, and recomputes its sine and cosine.
    fn unwind(&mut self) {
        let State {
            current,
            speed,
            mut angle,
            ..
        } = self.state;
        if angle.abs() > 16.0 {
            let turns = (angle / TAU).floor();
            self.turns += turns;
            angle -= turns * TAU;
        }
        self.state = State::new(current, speed, angle);
    }

    #[inline(always)]
    fn after(&self, h: f64) -> State {
        self.dynamics
            .step(&self.state, h, self.voltage, self.regime)
    }

    #[inline(always)]
    fn substep(&mut self, h: f64) {
        let next = self.after(h);
        if self.margin(&next) >= 0.0 && !self.hops_over_ripple(&next) {
            self.state = next;
        } else {
            (0..PIECES).for_each(|_| self.piece(h / f64::from(PIECES)));
        }
    }

    /// True if the current moves by much of the narrow zone in which the dead-time error changes its sign.
    #[inline(always)]
    fn hops_over_ripple(&self, next: &State) -> bool {
        let (now, then) = (self.state.current, next.current);
        let zone = ZONE * self.parameters.ripple_current;
        (then - now).abs() > STRIDE * zone && (now * then < 0.0 || now.abs().min(then.abs()) < zone)
    }

    /// One piece of a step, from event to event.
    #[cold]
    fn piece(&mut self, h: f64) {
        let mut left = h;
        for _ in 0..EVENTS_PER_PIECE {
            let next = self.after(left);
            if self.margin(&next) >= 0.0 {
                self.state = next;
                return;
            }
            let passed = self.locate(left);
            self.state = self.after(passed);
            self.settle();
            left -= passed;
        }
        self.state = self.after(left);
        self.settle();
    }

    /// Distance to the regime's end, negative after it: the least of its guards.
    #[inline(always)]
    fn margin(&self, x: &State) -> f64 {
        let Regime { motion, limited } = self.regime;
        let d = &self.dynamics;
        if motion != 0.0 && limited == 0.0 {
            return (motion * x.speed).min(d.current_limit - x.current.abs());
        }
        let crank = d.crank(x);
        let motion_left = match motion == 0.0 {
            true => d.dry_friction(0.0) - (crank.motor_constant * x.current - crank.load).abs(),
            false => motion * x.speed,
        };
        let current_left = match limited == 0.0 {
            true => d.current_limit - x.current.abs(),
            false => limited * d.driving_voltage(&crank, x.current, x.speed, self.voltage),
        };
        motion_left.min(current_left)
    }

    /// The time just after the regime's end, within `h`, by the Illinois variant of false position.
    fn locate(&self, h: f64) -> f64 {
        let margin = |t: f64| self.margin(&self.after(t));
        let (mut low, mut high) = ((0.0, self.margin(&self.state).max(0.0)), (h, margin(h)));
        for _ in 0..30 {
            if high.0 - low.0 <= 1e-12 * h {
                break;
            }
            let t = (low.0 * high.1 - high.0 * low.1) / (high.1 - low.1);
            let value = margin(t);
            if value < 0.0 {
                high = (t, value);
                low.1 *= 0.5;
            } else {
                low = (t, value);
                high.1 *= 0.5;
            }
        }
        high.0
    }

    /// Puts the state on the boundary that it has passed and chooses the next regime.
    fn settle(&mut self) {
        let (d, x) = (&self.dynamics, &mut self.state);
        let crank = d.crank(x);
        if self.regime.limited == 0.0 && x.current.abs() >= d.current_limit {
            x.current = d.current_limit.copysign(x.current);
            self.regime.limited = x.current.signum();
        }
        let drive = d.driving_voltage(&crank, x.current, x.speed, self.voltage);
        if self.regime.limited * drive < 0.0 {
            self.regime.limited = 0.0;
        }
        if self.regime.motion * x.speed <= 0.0 {
            x.speed = 0.0;
            let torque = crank.motor_constant * x.current - crank.load;
            let holds = torque.abs() <= d.dry_friction(0.0);
            self.regime.motion = if holds { 0.0 } else { torque.signum() };
        }
    }
}

impl Plant for Machine {
    fn reset(&mut self) {
        Machine::reset(self);
    }

    fn output(&self) -> f64 {
        self.speed_rpm()
    }

    fn position(&self) -> f64 {
        Machine::position(self)
    }

    fn advance(&mut self, u: f64) {
        Machine::advance(self, u);
    }

    fn encoder(&self) -> Option<&Encoder> {
        Some(Machine::encoder(self))
    }
}

/// Small-signal model around a steady speed, with load, inertia and torque at their means over the turn.
///
/// `dx/dt = A x + B u` with `x = (current, speed)` in A and rad/s, `u` in V:
///
/// ```text
/// A = [ -(R + R_dead)/L   -K/L            ]    B = [ gain/L ]
///     [  K/J              -(b + b_dry)/J  ]        [ 0      ]
/// ```
/// `R_dead` and `b_dry` are the slopes of the dead-time voltage and of dry friction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Linearisation {
    /// Command that holds the speed [V].
    pub command: f64,
    /// Current at that speed [A].
    pub current: f64,
    /// Static gain [RPM/V].
    pub gain: f64,
    /// The slower and the faster time constant [s].
    pub time_constants: [f64; 2],
}

impl Machine {
    /// Linearises around `speed_rpm`.
    ///
    /// # Errors
    /// A setting error at standstill, beyond the drive's limits, and if the time constants are complex.
    pub fn linearise(&self, speed_rpm: f64) -> Result<Linearisation> {
        let (p, d) = (&self.parameters, &self.dynamics);
        let speed = speed_rpm / RPM;
        let friction = d.dry_friction(speed) * speed.signum() + p.viscous_friction * speed;
        let current = friction / p.motor_constant;
        let voltage = p.motor_constant * speed + d.voltage_drop(current);
        let command = voltage / p.amplifier_gain;
        let reachable = command.abs() <= p.u_limit && voltage.abs() <= p.bus_voltage;
        if speed == 0.0 || !reachable || current.abs() > p.current_limit || !command.is_finite() {
            return Err(Error::setting(format!(
                "expected a steady speed other than 0 that the machine reaches, got {speed_rpm} RPM \
                 ({command} V, {current} A); choose a speed nearer to 1500 RPM"
            )));
        }
        let (dead_slope, dry_slope) = d.slopes(current, speed);
        let electrical = (p.resistance + dead_slope) / p.inductance;
        // the shaft to a second mass is treated as stiff
        let inertia = p.inertia + p.load_inertia;
        let mechanical = (p.viscous_friction + dry_slope) / inertia;
        let coupling = p.motor_constant * p.motor_constant / (p.inductance * inertia);
        let determinant = electrical * mechanical + coupling;
        let half = 0.5 * (electrical + mechanical);
        let root = half * half - determinant;
        if root < 0.0 {
            return Err(Error::setting(format!(
                "expected real time constants, got an oscillation at {speed_rpm} RPM; lower the inductance or \
                 raise the resistance"
            )));
        }
        let fast = half + root.sqrt();
        let gain = p.amplifier_gain * p.motor_constant / (p.inductance * inertia * determinant);
        Ok(Linearisation {
            command,
            current,
            gain: gain * RPM,
            time_constants: [fast / determinant, 1.0 / fast],
        })
    }
}

#[cfg(test)]
mod tests;
