//! The machine's equations of motion within one regime, and one integration step of them; the elastic shaft; sine and cosine with
//! the same bits on every platform.
//!
//! With crank angle `th`, speed `w`, current `i`, mean inverter voltage `v` and `K(th)` torque per current:
//!
//! ```text
//! L di/dt = v - V_dead s(i / i_ripple) - R i - K(th) w            s(x) = x / sqrt(1 + x^2)
//! J(th) dw/dt + J'(th) w^2 / 2 = K(th) i - load(th) - load - friction(w)
//! friction(w) = sign(w) (T_coulomb + T_stribeck / (1 + (w / w_stribeck)^2)) + b w
//! ```
//!
//! A regime fixes the sign of the friction, standstill, and whether the current is held at its limit. Within a regime
//! the equations are smooth, so a step keeps its order. [`super::Machine`] changes regimes at events.

use super::parameters::Parameters;

/// Current [A], speed [rad/s] and crank angle [rad].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    pub current: f64,
    pub speed: f64,
    pub angle: f64,
    /// Sine and cosine of the angle, rotated from step to step.
    direction: (f64, f64),
}

impl State {
    pub fn new(current: f64, speed: f64, angle: f64) -> Self {
        Self {
            current,
            speed,
            angle,
            direction: sin_cos(angle),
        }
    }
}

/// Which smooth piece of the physics applies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Regime {
    /// The sign of the motion that friction opposes; 0 at standstill.
    pub motion: f64,
    /// The side on which the drive holds the current at its limit; 0 if it does not.
    pub limited: f64,
}

/// The quantities that depend on the crank angle.
#[derive(Clone, Copy, Debug)]
pub struct Crank {
    /// Torque per current and back-EMF per speed.
    pub motor_constant: f64,
    /// `J(th)`.
    inertia: f64,
    /// `J'(th) / 2`.
    half_slope: f64,
    /// `load(th) + load`.
    pub load: f64,
}

impl Crank {
    /// The same after a small turn `e`, to first order.
    #[inline(always)]
    fn turned((at, slopes): &(Self, Self), e: f64) -> Self {
        Self {
            motor_constant: at.motor_constant + e * slopes.motor_constant,
            inertia: at.inertia + e * slopes.inertia,
            half_slope: at.half_slope + e * slopes.half_slope,
            load: at.load + e * slopes.load,
        }
    }
}

/// The quantities that stay the same within a step.
struct Held {
    voltage: f64,
    /// 0 if the drive holds the current.
    per_inductance: f64,
    /// The dead-time voltage over the inductance.
    dead: f64,
    /// 0 at standstill, else 1.
    moves: f64,
    coulomb: f64,
    stribeck: f64,
}

/// The equations' constants, precomputed.
#[derive(Clone, Copy, Debug)]
pub struct Dynamics {
    dead_voltage: f64,
    ripple_squared: f64,
    pub resistance: f64,
    per_inductance: f64,
    pub current_limit: f64,
    inertia: f64,
    inertia_wave: [f64; 2],
    motor_constant: f64,
    ripple_wave: [f64; 2],
    load_first: [f64; 2],
    load_second: [f64; 2],
    /// Load torque in addition to the crank's \[N m\].
    pub load: f64,
    coulomb_torque: f64,
    /// Stribeck torque times the square of its speed, and that square.
    stribeck: [f64; 2],
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
            ripple_squared: p.ripple_current.powi(2),
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
            stribeck: [
                p.stribeck_torque * p.stribeck_speed.powi(2),
                p.stribeck_speed.powi(2),
            ],
            viscous_friction: p.viscous_friction,
        }
    }

    /// The quantities that depend on the angle.
    #[inline(always)]
    pub fn crank(&self, x: &State) -> Crank {
        self.crank_with_slopes(x.direction).0
    }

    /// The quantities that depend on the angle, from its sine and cosine, and their derivatives; harmonics 2 and 4 come
    /// from the first by doubling.
    #[inline(always)]
    fn crank_with_slopes(&self, (s1, c1): (f64, f64)) -> (Crank, Crank) {
        let (s2, c2) = (2.0 * s1 * c1, (c1 - s1) * (c1 + s1));
        let (s4, c4) = (2.0 * s2 * c2, (c2 - s2) * (c2 + s2));
        let ([kc, ks], [jc, js]) = (self.ripple_wave, self.inertia_wave);
        let ([c, s], [cc, ss]) = (self.load_first, self.load_second);
        let (wave, half_slope) = (jc * c2 + js * s2, js * c2 - jc * s2);
        (
            Crank {
                motor_constant: self.motor_constant + kc * c4 + ks * s4,
                inertia: self.inertia + wave,
                half_slope,
                load: (c * c1 + s * s1) + (cc * c2 + ss * s2) + self.load,
            },
            Crank {
                motor_constant: 4.0 * (ks * c4 - kc * s4),
                inertia: 2.0 * half_slope,
                half_slope: -2.0 * wave,
                load: (s * c1 - c * s1) + 2.0 * (ss * c2 - cc * s2),
            },
        )
    }

    /// Voltage that drives the current up: mean inverter voltage minus dead time, resistance and back-EMF.
    pub fn driving_voltage(&self, crank: &Crank, current: f64, speed: f64, voltage: f64) -> f64 {
        (voltage - crank.motor_constant * speed) - self.voltage_drop(current)
    }

    /// The part of the mean inverter voltage lost to resistance and dead time.
    pub fn voltage_drop(&self, current: f64) -> f64 {
        self.resistance * current + self.dead_time(self.dead_voltage, current)
    }

    /// `most s(current / i_ripple)`, as two halves that do not wait for each other.
    #[inline(always)]
    fn dead_time(&self, most: f64, current: f64) -> f64 {
        let square = self.ripple_squared + current * current;
        square.sqrt() * (most * current / square)
    }

    /// Magnitude of dry friction at `speed`.
    pub fn dry_friction(&self, speed: f64) -> f64 {
        self.coulomb_torque + self.stribeck[0] / (self.stribeck[1] + speed * speed)
    }

    /// The quantities that stay the same within a step.
    #[inline(always)]
    fn held(&self, voltage: f64, Regime { motion, limited }: Regime) -> Held {
        let per_inductance = (1.0 - limited.abs()) * self.per_inductance;
        Held {
            voltage,
            per_inductance,
            dead: self.dead_voltage * per_inductance,
            moves: motion.abs(),
            coulomb: motion * self.coulomb_torque,
            stribeck: motion * self.stribeck[0],
        }
    }

    /// `(di/dt, dw/dt)`, ordered so that the operations on current and speed come last.
    #[inline(always)]
    fn rates(&self, held: &Held, crank: &Crank, current: f64, speed: f64) -> (f64, f64) {
        let driven = (held.voltage - crank.motor_constant * speed) - self.resistance * current;
        let square = speed * speed;
        let torque = (crank.motor_constant * current - crank.load)
            - (self.viscous_friction * speed + held.coulomb)
            - crank.half_slope * square;
        (
            driven * held.per_inductance - self.dead_time(held.dead, current),
            (torque - held.stribeck / (self.stribeck[1] + square)) * (held.moves / crank.inertia),
        )
    }

    /// One step of Nystroem's fourth-order method for `y'' = f(y, y')` with `y' = (i, w)`.
    ///
    /// Unlike the classical Runge-Kutta method it shares one angle between its two middle stages (Hairer, Norsett and
    /// Wanner 1993, II.14). All three angles are known in advance except for the turn by the acceleration: that is of
    /// second order in `h`, so its square can be dropped without losing an order.
    #[inline(always)]
    pub fn step(&self, x: &State, h: f64, voltage: f64, regime: Regime) -> State {
        let (i, w, half) = (x.current, x.speed, 0.5 * h);
        let held = self.held(voltage, regime);
        let rates = |crank: &Crank, i: f64, w: f64| self.rates(&held, crank, i, w);
        let onward = turn(half * w);
        let near = turned(x.direction, onward);
        let far = turned(near, onward);
        let (at_near, at_far) = (self.crank_with_slopes(near), self.crank_with_slopes(far));
        let (i1, w1) = rates(&self.crank(x), i, w);
        let middle = Crank::turned(&at_near, 0.25 * h * half * w1);
        let (i2, w2) = rates(&middle, i + half * i1, w + half * w1);
        let (i3, w3) = rates(&middle, i + half * i2, w + half * w2);
        let end = Crank::turned(&at_far, h * half * w3);
        let (i4, w4) = rates(&end, i + h * i3, w + h * w3);
        let sixth = h / 6.0;
        let further = h * sixth * ((w1 + w2) + w3);
        State {
            current: i + sixth * ((i1 + i4) + 2.0 * (i2 + i3)),
            speed: w + sixth * ((w1 + w4) + 2.0 * (w2 + w3)),
            angle: x.angle + (h * w + further),
            direction: turned(far, turn(further)),
        }
    }

    /// The slope of the dead-time voltage over the current [ohm], and of dry friction over the speed [N m s/rad].
    pub fn slopes(&self, current: f64, speed: f64) -> (f64, f64) {
        let square = self.ripple_squared + current * current;
        let [stribeck, speed_squared] = self.stribeck;
        (
            self.dead_voltage * self.ripple_squared / square.powf(1.5),
            -2.0 * stribeck * speed.abs() / (speed_squared + speed * speed).powi(2),
        )
    }
}

// A second mass behind an elastic shaft, driven by the crank.
//
// With the twist `e = crank - load` in rad, the play `B` and `e' = e - clamp(e, -B/2, B/2)`:
//
// ```text
// torque = c e' + d de/dt   where e' is not 0, else 0; never against the side on which the shaft bears
// J dw/dt = torque
// ```

/// The load mass and the shaft to it.
#[derive(Clone, Copy, Debug)]
pub struct Shaft {
    per_inertia: f64,
    stiffness: f64,
    damping: f64,
    /// Half of the play [rad].
    play: f64,
    /// [rad]
    angle: f64,
    /// Speed of the load [rad/s].
    speed: f64,
    /// Torque on the crank as a load, on the load as a drive [N m].
    pub torque: f64,
}

impl Shaft {
    /// `None` without a second mass.
    pub fn new(p: &Parameters) -> Option<Self> {
        (p.load_inertia > 0.0).then(|| Self {
            per_inertia: 1.0 / p.load_inertia,
            stiffness: p.shaft_stiffness,
            damping: p.shaft_damping,
            play: 0.5 * p.shaft_backlash,
            angle: 0.0,
            speed: 0.0,
            torque: 0.0,
        })
    }

    /// At rest, without twist.
    pub fn reset(&mut self) {
        self.recall([0.0; 3]);
    }

    /// The state.
    pub fn memory(&self) -> [f64; 3] {
        [self.angle, self.speed, self.torque]
    }

    /// Continues from that state.
    pub fn recall(&mut self, [angle, speed, torque]: [f64; 3]) {
        (self.angle, self.speed, self.torque) = (angle, speed, torque);
    }

    /// Twists the shaft for `h` by the difference of both speeds; its torque is the one at the end.
    pub fn twist(&mut self, crank_speed: f64, h: f64) {
        let rate = crank_speed - self.speed;
        self.angle += h * rate;
        let bent = self.angle - self.angle.clamp(-self.play, self.play);
        let torque = self.stiffness * bent + self.damping * rate;
        self.torque = match self.play > 0.0 {
            false => torque,
            // within the play nothing bears, and neither side pulls
            true if bent == 0.0 => 0.0,
            true => (torque * bent.signum()).max(0.0).copysign(bent),
        };
    }

    /// Turns the load under the torque for `h`.
    pub fn turn(&mut self, h: f64) {
        self.speed += h * self.per_inertia * self.torque;
    }
}

/// 2/pi, and pi/2 in two parts whose products with small integers are exact (Cody and Waite 1980).
const PER_QUADRANT: f64 = std::f64::consts::FRAC_2_PI;
const QUADRANT: [f64; 2] = [1.570_796_326_734_125_6, 6.077_100_506_506_192e-11];

/// Adding this rounds a double to the nearest integer and leaves that integer in its low bits.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// `(sin x, cos x)` for `|x|` below 1e5, to a few units of the last place.
///
/// Minimax polynomials of fdlibm on `[-pi/4, pi/4]`; arithmetic only, so the bits are the same on every platform.
#[inline(always)]
fn sin_cos(x: f64) -> (f64, f64) {
    let rounded = x * PER_QUADRANT + ROUND;
    let (whole, quadrant) = (rounded - ROUND, rounded.to_bits());
    let r = (x - whole * QUADRANT[0]) - whole * QUADRANT[1];
    let (s, c) = kernel(r);
    let odd = quadrant & 1 != 0;
    let (s, c) = if odd { (c, s) } else { (s, c) };
    (negate(s, quadrant), negate(c, quadrant.wrapping_add(1)))
}

/// The largest turn for which the series below are exact to rounding: the next terms are `e^9/9!` and `e^10/10!`.
const SMALL_TURN: f64 = 0.07;

/// Sine and versine `1 - cos e` of a turn; for a small one in a third of the time of [`sin_cos`].
#[inline(always)]
fn turn(e: f64) -> (f64, f64) {
    if e.abs() > SMALL_TURN {
        let (sine, cosine) = sin_cos(e);
        return (sine, 1.0 - cosine);
    }
    let e2 = e * e;
    let e4 = e2 * e2;
    let sine = (1.0 - e2 * (1.0 / 6.0)) + e4 * (1.0 / 120.0 - e2 * (1.0 / 5_040.0));
    let versine = (0.5 - e2 * (1.0 / 24.0)) + e4 * (1.0 / 720.0 - e2 * (1.0 / 40_320.0));
    (e * sine, e2 * versine)
}

/// `(sin(x + e), cos(x + e))` from `(sin x, cos x)` and the [`turn`] by `e`.
#[inline(always)]
fn turned((s, c): (f64, f64), (sine, versine): (f64, f64)) -> (f64, f64) {
    (s + (c * sine - s * versine), c - (s * sine + c * versine))
}

/// Changes the sign of `value` if bit 1 of `quadrant` is set.
#[inline(always)]
fn negate(value: f64, quadrant: u64) -> f64 {
    f64::from_bits(value.to_bits() ^ ((quadrant & 2) << 62))
}

/// Sine and cosine on `[-pi/4, pi/4]`, summed in pairs so that the processor can overlap them.
#[inline(always)]
fn kernel(r: f64) -> (f64, f64) {
    let z = r * r;
    let z2 = z * z;
    let s = (-1.666_666_666_666_663_2e-1 + z * 8.333_333_333_322_49e-3)
        + z2 * ((-1.984_126_982_985_795e-4 + z * 2.755_731_370_707_006_8e-6)
            + z2 * (-2.505_076_025_340_686_3e-8 + z * 1.589_690_995_211_55e-10));
    let c = (4.166_666_666_666_66e-2 + z * -1.388_888_888_887_411e-3)
        + z2 * ((2.480_158_728_947_673e-5 + z * -2.755_731_435_139_066_3e-7)
            + z2 * (2.087_572_321_298_175e-9 + z * -1.135_964_755_778_819_5e-11));
    (r + r * z * s, 1.0 - 0.5 * z + z2 * c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_by_any_angle() {
        for k in -4_000..4_000 {
            let (x, e) = (f64::from(k) * 0.003_7, f64::from(k % 97) * 1e-3);
            let (s, c) = turned(sin_cos(x), turn(e));
            assert!(
                (s - (x + e).sin()).abs() < 1e-15 && (c - (x + e).cos()).abs() < 1e-15,
                "{e} from {x}"
            );
        }
    }

    #[test]
    fn agrees_with_the_standard_library() {
        for k in -20_000..20_000 {
            let x = f64::from(k) * 0.003_7;
            let (s, c) = sin_cos(x);
            assert!(
                (s - x.sin()).abs() < 1e-15 && (c - x.cos()).abs() < 1e-15,
                "at {x}"
            );
        }
    }
}
