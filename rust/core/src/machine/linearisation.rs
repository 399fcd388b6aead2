//! The machine's small signals about a steady speed.

use super::{Machine, RPM};
use crate::{Error, Result};

/// Small signals about a steady speed, with load, inertia and torque at their means over the turn.
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
    /// Small signals about `speed_rpm`.
    ///
    /// # Errors
    /// A setting error at standstill, beyond the drive's limits and where the time constants are complex.
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
        // the shaft to a second mass is taken as stiff
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
