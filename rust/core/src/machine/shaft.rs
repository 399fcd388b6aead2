//! A second mass behind an elastic shaft, which turns with the crank.
//!
//! With the twist `e = crank - load` in rad, the play `B` and `e' = e - clamp(e, -B/2, B/2)`:
//!
//! ```text
//! torque = c e' + d de/dt   where e' is not 0, else 0; never against the side on which the shaft bears
//! J dw/dt = torque
//! ```

use super::parameters::Parameters;

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
    /// Of the load [rad/s].
    speed: f64,
    /// On the crank as a load, on the load as a drive [N m].
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

    /// What changes.
    pub fn memory(&self) -> [f64; 3] {
        [self.angle, self.speed, self.torque]
    }

    /// Goes on from there.
    pub fn recall(&mut self, [angle, speed, torque]: [f64; 3]) {
        (self.angle, self.speed, self.torque) = (angle, speed, torque);
    }

    /// Lets the shaft twist for `h` by the difference of both speeds; its torque is that at the end.
    pub fn twist(&mut self, crank_speed: f64, h: f64) {
        let rate = crank_speed - self.speed;
        self.angle += h * rate;
        let bent = self.angle - self.angle.clamp(-self.play, self.play);
        let torque = self.stiffness * bent + self.damping * rate;
        self.torque = match self.play > 0.0 {
            false => torque,
            // between both sides nothing bears, and neither side pulls
            true if bent == 0.0 => 0.0,
            true => (torque * bent.signum()).max(0.0).copysign(bent),
        };
    }

    /// The load under the torque for `h`.
    pub fn turn(&mut self, h: f64) {
        self.speed += h * self.per_inertia * self.torque;
    }
}
