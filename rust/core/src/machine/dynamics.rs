//! The machine's equations of motion within one regime, and one integration step of them.
//!
//! With crank angle `th`, speed `w`, current `i`, mean inverter voltage `v` and `K(th)` torque per current:
//!
//! ```text
//! L di/dt = v - V_dead s(i / i_ripple) - R i - K(th) w            s(x) = x / sqrt(1 + x^2)
//! J(th) dw/dt + J'(th) w^2 / 2 = K(th) i - load(th) - load - friction(w)
//! friction(w) = sign(w) (T_coulomb + T_stribeck / (1 + (w / w_stribeck)^2)) + b w
//! ```
//!
//! A regime fixes the sign of the friction, standstill and the hold of the current at its limit; within it
//! the equations are smooth, so that a step keeps its order. [`super::Machine`] changes regimes at events.

use super::parameters::Parameters;
use super::trigonometry::{sin_cos, turned_by};

/// Current [A], speed [rad/s] and crank angle [rad].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    pub current: f64,
    pub speed: f64,
    pub angle: f64,
}

/// Which of the smooth pieces of the physics holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Regime {
    /// The sign of the motion that friction opposes; 0 at standstill.
    pub motion: f64,
    /// The side on which the drive holds the current at its limit; 0 where it does not.
    pub limited: f64,
}

/// What depends on the crank angle.
#[derive(Clone, Copy, Debug)]
pub struct Crank {
    /// Torque per current and back-EMF per speed.
    pub motor_constant: f64,
    /// `J(th)`.
    pub inertia: f64,
    /// `J'(th) / 2`.
    half_slope: f64,
    /// `load(th) + load`.
    pub load: f64,
}

/// The equations' constants, worked out once.
#[derive(Clone, Copy, Debug)]
pub struct Dynamics {
    pub dead_voltage: f64,
    per_ripple: f64,
    pub resistance: f64,
    per_inductance: f64,
    pub current_limit: f64,
    inertia: f64,
    inertia_wave: [f64; 2],
    motor_constant: f64,
    ripple_wave: [f64; 2],
    load_first: [f64; 2],
    load_second: [f64; 2],
    /// Load torque beside that of the crank \[N m\].
    pub load: f64,
    coulomb_torque: f64,
    stribeck_torque: f64,
    per_stribeck_squared: f64,
    viscous_friction: f64,
}

/// `amplitude cos(order (th - angle))` as coefficients of `cos(order th)` and `sin(order th)`.
fn wave(amplitude: f64, order: f64, angle: f64) -> [f64; 2] {
    let (sin, cos) = sin_cos(order * angle);
    [amplitude * cos, amplitude * sin]
}

impl Dynamics {
    pub fn new(p: &Parameters) -> Self {
        let varying = p.angle_dependence;
        let inertia_wave = varying * p.inertia * p.inertia_variation;
        let ripple = varying * p.motor_constant * p.torque_ripple;
        Self {
            dead_voltage: p.dead_time * p.pwm_frequency * p.bus_voltage,
            per_ripple: 1.0 / p.ripple_current,
            resistance: p.resistance,
            per_inductance: 1.0 / p.inductance,
            current_limit: p.current_limit,
            inertia: p.inertia,
            inertia_wave: wave(inertia_wave, 2.0, p.inertia_angle),
            motor_constant: p.motor_constant,
            ripple_wave: wave(ripple, 4.0, p.torque_ripple_angle),
            load_first: wave(varying * p.load_first, 1.0, p.load_first_angle),
            load_second: wave(varying * p.load_second, 2.0, p.load_second_angle),
            load: 0.0,
            coulomb_torque: p.coulomb_torque,
            stribeck_torque: p.stribeck_torque,
            per_stribeck_squared: p.stribeck_speed.powi(-2),
            viscous_friction: p.viscous_friction,
        }
    }

    /// What depends on the angle.
    #[inline(always)]
    pub fn crank(&self, angle: f64) -> Crank {
        self.crank_at(sin_cos(angle))
    }

    /// What depends on the angle with this sine and cosine; the harmonics 2 and 4 come from them by doubling.
    #[inline(always)]
    fn crank_at(&self, (s1, c1): (f64, f64)) -> Crank {
        let (s2, c2) = (2.0 * s1 * c1, (c1 - s1) * (c1 + s1));
        let (s4, c4) = (2.0 * s2 * c2, (c2 - s2) * (c2 + s2));
        let [jc, js] = self.inertia_wave;
        Crank {
            motor_constant: self.motor_constant
                + self.ripple_wave[0] * c4
                + self.ripple_wave[1] * s4,
            inertia: self.inertia + jc * c2 + js * s2,
            half_slope: js * c2 - jc * s2,
            load: (self.load_first[0] * c1 + self.load_first[1] * s1)
                + (self.load_second[0] * c2 + self.load_second[1] * s2)
                + self.load,
        }
    }

    /// Voltage that drives the current up: mean inverter voltage less dead time, resistance and back-EMF.
    #[inline(always)]
    pub fn driving_voltage(&self, crank: &Crank, current: f64, speed: f64, voltage: f64) -> f64 {
        let x = current * self.per_ripple;
        let sign = x / (1.0 + x * x).sqrt();
        (voltage - crank.motor_constant * speed)
            - (self.resistance * current + self.dead_voltage * sign)
    }

    /// Dry friction at `speed`, without its sign.
    #[inline(always)]
    pub fn dry_friction(&self, speed: f64) -> f64 {
        self.coulomb_torque
            + self.stribeck_torque / (1.0 + speed * speed * self.per_stribeck_squared)
    }

    /// `(di/dt, dw/dt)`.
    #[inline(always)]
    fn rates(
        &self,
        crank: &Crank,
        current: f64,
        speed: f64,
        voltage: f64,
        regime: Regime,
    ) -> (f64, f64) {
        let drive = self.driving_voltage(crank, current, speed, voltage);
        let friction = regime.motion * self.dry_friction(speed) + self.viscous_friction * speed;
        let torque = crank.motor_constant * current
            - crank.load
            - crank.half_slope * speed * speed
            - friction;
        (
            drive * ((1.0 - regime.limited.abs()) * self.per_inductance),
            regime.motion.abs() * torque / crank.inertia,
        )
    }

    /// One step of Nystroem's fourth-order method for `y'' = f(y, y')` with `y' = (i, w)`.
    ///
    /// Against the classical Runge-Kutta method it shares one angle between its two middle stages
    /// (Hairer, Norsett and Wanner 1993, II.14). All three angles are known at once but for the little that the
    /// acceleration turns them by: their sines need not wait for each other.
    #[inline(always)]
    pub fn step(&self, x: &State, h: f64, voltage: f64, regime: Regime) -> State {
        let (i, w, half) = (x.current, x.speed, 0.5 * h);
        let rates = |crank: &Crank, i: f64, w: f64| self.rates(crank, i, w, voltage, regime);
        let (near, far) = (x.angle + half * w, x.angle + h * w);
        let (at_near, at_far) = (sin_cos(near), sin_cos(far));
        let (i1, w1) = rates(&self.crank(x.angle), i, w);
        let middle = self.crank_at(turned_by(at_near, near, 0.25 * h * half * w1));
        let (i2, w2) = rates(&middle, i + half * i1, w + half * w1);
        let (i3, w3) = rates(&middle, i + half * i2, w + half * w2);
        let end = self.crank_at(turned_by(at_far, far, h * half * w3));
        let (i4, w4) = rates(&end, i + h * i3, w + h * w3);
        let sixth = h / 6.0;
        State {
            current: i + sixth * (i1 + 2.0 * (i2 + i3) + i4),
            speed: w + sixth * (w1 + 2.0 * (w2 + w3) + w4),
            angle: x.angle + h * (w + sixth * (w1 + w2 + w3)),
        }
    }

    /// The slope of the dead-time voltage over the current [ohm], and of dry friction over the speed [N m s/rad].
    pub fn slopes(&self, current: f64, speed: f64) -> (f64, f64) {
        let x = current * self.per_ripple;
        let fall = 1.0 + speed * speed * self.per_stribeck_squared;
        (
            self.dead_voltage * self.per_ripple / (1.0 + x * x).powf(1.5),
            -2.0 * self.stribeck_torque * speed.abs() * self.per_stribeck_squared / (fall * fall),
        )
    }
}
