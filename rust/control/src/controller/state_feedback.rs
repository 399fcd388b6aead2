//! State feedback with an observer, integral action and reference feedforward, one sample at a time.
//!
//! The plant is a difference equation of up to four states in observer form, whose first state is the output
//! (Astrom and Wittenmark, Computer-Controlled Systems, 3rd ed. 1997, section 3.4):
//!
//! ```text
//! x1(k+1) = -a1 x1(k) + x2(k) + b1 u(k)
//! x2(k+1) = -a2 x1(k) + x3(k) + b2 u(k)      y(k) = x1(k)
//!   ..
//! ```
//!
//! The controller is the current estimator with the law of Franklin, Powell and Workman (Digital Control of Dynamic Systems,
//! 3rd ed. 1998, chapter 8):
//!
//! ```text
//! x'   = x + l (y - x1)                           correction by the measurement
//! u    = kr (r + lead dr/dt) - k x' + q           then limited
//! q    = q + ki (r - y)                           integral action
//! x    = A x' + b u                               prediction by the model
//! ```
//!
//! The prediction uses the limited command, so the observer knows what the plant received. The integral is held while it would push
//! further beyond a limit. `kr` makes the output of the model equal the reference without help from the integral.

mod design;
#[cfg(test)]
mod tests;

use crate::controller::{check_limits, limited};
use crate::{Controller, Ramp, Real, Refused};

pub use design::{Weights, lqg};

/// The largest number of states.
pub const STATES: usize = 4;

/// The numbers of a [`StateFeedback`]; unused states have zeros.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StateDesign<T> {
    /// Denominator of the plant without its leading 1.
    pub a: [T; STATES],
    /// Numerator of the plant \[y/u\], from `z^-1` on.
    pub b: [T; STATES],
    /// Gains on the states \[u/y\].
    pub k: [T; STATES],
    /// Gains of the observer on `y - x1`.
    pub l: [T; STATES],
    /// The states while the output rests at 1.
    pub rest: [T; STATES],
    /// Gain on the reference \[u/y\].
    pub kr: T,
    /// Gain on the sum of errors, per sample \[u/y\].
    pub ki: T,
    /// The reference is extrapolated by this time at its present rate \[s\].
    pub lead: T,
    /// Largest change of the ramped reference \[y/s\]; infinite for none.
    pub r_rate: T,
    /// Lower limit of the command \[u\].
    pub u_min: T,
    /// Upper limit of the command \[u\].
    pub u_max: T,
    /// Largest change of the command \[u/s\]; infinite for none.
    pub slew: T,
    /// Sample time \[s\].
    pub ts: T,
    /// The design parameters of the gains; a step does not use them.
    pub weights: Weights<T>,
}

/// Numbers of a [`StateDesign`] sent to a device: those of the step, without the sample time.
pub const NUMBERS: usize = 5 * STATES + 7;

impl<T: Real> StateDesign<T> {
    /// # Errors
    /// The first number that is outside its range.
    pub fn check(&self) -> Result<(), Refused> {
        for (name, numbers) in [
            ("den", &self.a),
            ("num", &self.b),
            ("K", &self.k),
            ("L", &self.l),
            ("rest", &self.rest),
            ("Kr", &[self.kr, self.ki, self.lead, T::ZERO]),
        ] {
            for x in numbers {
                Refused::unless(x.is_finite(), name, "finite numbers", x.to_f64())?;
            }
        }
        Ramp::new(self.r_rate, self.ts)?;
        let above_0 = "a number above 0, or inf";
        Refused::unless(self.slew > T::ZERO, "slew", above_0, self.slew.to_f64())?;
        check_limits((self.u_min, self.u_max))
    }

    /// a, b, k, l, rest, then kr, ki, lead, `r_rate`, `u_min`, `u_max`, slew: the order in which a device receives them.
    pub fn numbers(&self) -> [T; NUMBERS] {
        let vectors = [self.a, self.b, self.k, self.l, self.rest];
        let rest = [
            self.kr,
            self.ki,
            self.lead,
            self.r_rate,
            self.u_min,
            self.u_max,
            self.slew,
        ];
        let mut all = [T::ZERO; NUMBERS];
        let given = vectors.as_flattened().iter().chain(&rest);
        for (place, number) in all.iter_mut().zip(given) {
            *place = *number;
        }
        all
    }

    /// The index among [`numbers`](Self::numbers) of a setting named by [`check`](Self::check).
    pub(crate) fn place_of(name: &str) -> u32 {
        let places = ["den", "num", "K", "L", "rest"];
        let vectors = (0..).step_by(STATES).zip(places);
        let singles = (20..).zip(["Kr", "Ki", "lead", "r_rate", "u_min", "u_max", "slew"]);
        let mut all = vectors.chain(singles);
        all.find(|(_, known)| *known == name).map_or(0, |(k, _)| k)
    }

    /// The inverse of [`numbers`](Self::numbers): `next` returns them one by one; `None` if they end too early.
    pub fn from_numbers(mut next: impl FnMut() -> Option<T>, ts: T) -> Option<Self> {
        let mut vectors = [[T::ZERO; STATES]; 5];
        for place in vectors.as_flattened_mut() {
            *place = next()?;
        }
        let [a, b, k, l, rest] = vectors;
        Some(Self {
            a,
            b,
            k,
            l,
            rest,
            kr: next()?,
            ki: next()?,
            lead: next()?,
            r_rate: next()?,
            u_min: next()?,
            u_max: next()?,
            slew: next()?,
            ts,
            weights: Weights::NONE,
        })
    }
}

impl StateDesign<f64> {
    /// Rounded to single precision.
    pub fn single(&self) -> StateDesign<f32> {
        let vector = |x: [f64; STATES]| x.map(|x| x as f32);
        StateDesign {
            a: vector(self.a),
            b: vector(self.b),
            k: vector(self.k),
            l: vector(self.l),
            rest: vector(self.rest),
            kr: self.kr as f32,
            ki: self.ki as f32,
            lead: self.lead as f32,
            r_rate: self.r_rate as f32,
            u_min: self.u_min as f32,
            u_max: self.u_max as f32,
            slew: self.slew as f32,
            ts: self.ts as f32,
            weights: Weights {
                rho: self.weights.rho as f32,
                integral: self.weights.integral as f32,
                noise: self.weights.noise as f32,
                reference: self.weights.reference as f32,
            },
        }
    }
}

/// State feedback with an observer, and its state.
#[derive(Clone, Debug)]
pub struct StateFeedback<T> {
    design: StateDesign<T>,
    ramp: Ramp<T>,
    /// `lead` \[samples\].
    lead: T,
    /// States predicted for the next sample.
    x: [T; STATES],
    /// Integral term \[u\].
    q: T,
    /// Reference at the last sample; infinite before the first.
    r: T,
    /// Command at the last sample \[u\].
    u: T,
    /// Observed output at the last sample.
    observed: T,
    started: bool,
}

impl<T: Real> StateFeedback<T> {
    /// A controller at rest.
    ///
    /// # Errors
    /// The first number that is outside its range.
    pub fn new(design: StateDesign<T>) -> Result<Self, Refused> {
        design.check()?;
        let mut made = Self {
            ramp: Ramp::new(design.r_rate, design.ts)?,
            lead: design.lead / design.ts,
            x: [T::ZERO; STATES],
            q: T::ZERO,
            r: T::INFINITY,
            u: T::ZERO,
            observed: T::ZERO,
            started: false,
            design,
        };
        made.reset();
        Ok(made)
    }

    /// Back to the state before the first sample. The slew limit starts from a command of 0 or the nearest limit.
    pub fn reset(&mut self) {
        let StateDesign { u_min, u_max, .. } = self.design;
        self.ramp.reset();
        self.x = [T::ZERO; STATES];
        (self.q, self.r, self.observed) = (T::ZERO, T::INFINITY, T::ZERO);
        self.u = T::ZERO.limit(u_min, u_max);
        self.started = false;
    }

    /// From reference and measured output to the command; `feedforward` is added before the limits.
    ///
    /// Without a finite measurement the command stays, and the observer continues by the model. Without a finite
    /// reference or feedforward the command stays, but the observer is still corrected.
    pub fn step_with(&mut self, r: T, y: T, feedforward: T) -> T {
        let StateDesign {
            k, l, rest, kr, ki, ..
        } = self.design;
        if !y.is_finite() {
            if self.started {
                self.predict(self.x);
            }
            return self.u;
        }
        let r = self.ramp.step(r, y);
        if !self.started {
            // assume that the plant has rested at the first measurement
            self.x = rest.map(|x| x * y);
        }
        let before = if self.r.is_finite() { self.r } else { r };
        let innovation = y - self.x[0];
        let mut x = self.x;
        for (x, gain) in x.iter_mut().zip(l) {
            *x += gain * innovation;
        }
        let [k1, k2, k3, k4] = k;
        let fed_back = (k1 * x[0] + k2 * x[1]) + (k3 * x[2] + k4 * x[3]);
        let aimed = r + self.lead * (r - before);
        let wanted = (kr * aimed - fed_back) + self.q + feedforward;
        self.observed = x[0];
        if wanted.is_finite() {
            let StateDesign {
                u_min,
                u_max,
                slew,
                ts,
                ..
            } = self.design;
            self.u = limited(wanted, self.u, (u_min, u_max), slew * ts);
            let (excess, change) = (self.u - wanted, ki * (r - y));
            let pushes_on = change * excess < T::ZERO;
            self.q = if pushes_on { self.q } else { self.q + change };
            self.predict(x);
        } else if r.is_finite() && feedforward.is_finite() {
            self.begin_again(y);
        } else {
            self.predict(x);
        }
        if r.is_finite() {
            self.r = r;
        }
        self.started = true;
        self.u
    }

    /// The states at the next sample, from the present ones and the command.
    fn predict(&mut self, x: [T; STATES]) {
        let StateDesign { a, b, .. } = self.design;
        let [x1, x2, x3, x4] = x;
        let shifted = [x2, x3, x4, T::ZERO];
        let numbers = shifted.into_iter().zip(a).zip(b);
        for (x, ((shifted, a), b)) in self.x.iter_mut().zip(numbers) {
            *x = (shifted - a * x1) + b * self.u;
        }
    }

    /// Finite inputs gave a result that is not, so the memory is to blame: it holds a measurement near the largest number. The observer
    /// starts over as if the plant had rested at `y`, and an integral term that is not finite becomes 0.
    #[cold]
    fn begin_again(&mut self, y: T) {
        self.x = self.design.rest.map(|x| x * y);
        if !self.q.is_finite() {
            self.q = T::ZERO;
        }
    }

    /// The observed output of the last step.
    pub fn filtered(&self) -> T {
        self.observed
    }

    /// The design.
    pub fn design(&self) -> &StateDesign<T> {
        &self.design
    }
}

impl<T: Real> Controller<T> for StateFeedback<T> {
    fn reset(&mut self) {
        self.reset();
    }

    fn step_with(&mut self, r: T, y: T, feedforward: T) -> T {
        self.step_with(r, y, feedforward)
    }

    fn filtered(&self) -> T {
        self.observed
    }

    fn ts(&self) -> T {
        self.design.ts
    }

    fn limits(&self) -> (T, T) {
        (self.design.u_min, self.design.u_max)
    }
}
