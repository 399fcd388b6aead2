//! The two-degree-of-freedom PID controller (paper Eq. 9, Fig. 16), one sample at a time.

use crate::controller::{check_limits, limited};
use crate::gains::sample_time;
use crate::{Real, Refused, Standard};

/// The settings of a [`Pid`]; symbols as in docs/CONVENTIONS.md.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings<T> {
    /// Gains in standard form.
    pub gains: Standard<T>,
    /// Share of the reference taken out of the proportional term: set-point weight `1 - alpha`.
    pub alpha: T,
    /// Share of the reference taken out of the derivative term: set-point weight `1 - beta`.
    pub beta: T,
    /// The derivative is filtered with time constant `Td/N`; infinite for no filter.
    pub n: T,
    /// Time constant of back-calculation \[s\]; 0 for conditional integration, infinite for no anti-windup.
    pub tt: T,
    /// Lower limit of the output \[u\].
    pub u_min: T,
    /// Upper limit of the output \[u\].
    pub u_max: T,
    /// Largest change of the output \[u/s\].
    pub slew: T,
    /// Sample time \[s\].
    pub ts: T,
}

impl<T: Real> Settings<T> {
    /// Gains at a sample time; one degree of freedom, no filter, no limits, conditional integration.
    pub fn new(gains: Standard<T>, ts: T) -> Self {
        Self {
            gains,
            alpha: T::ZERO,
            beta: T::ZERO,
            n: T::INFINITY,
            tt: T::ZERO,
            u_min: -T::INFINITY,
            u_max: T::INFINITY,
            slew: T::INFINITY,
            ts,
        }
    }

    /// `Ts/Tt`; 0 for conditional integration, which does not track.
    pub fn tracking(&self) -> T {
        if self.tt == T::ZERO {
            T::ZERO
        } else {
            self.ts / self.tt
        }
    }

    pub(crate) fn checked(self) -> Result<Self, Refused> {
        self.gains.checked()?;
        sample_time(self.ts)?;
        let unless = Refused::unless;
        for (name, x) in [("alpha", self.alpha), ("beta", self.beta)] {
            unless(x.is_finite(), name, "a finite number", x.to_f64())?;
        }
        let above_0 = "a number above 0, or inf";
        unless(self.n > T::ZERO, "N", above_0, self.n.to_f64())?;
        unless(self.slew > T::ZERO, "slew", above_0, self.slew.to_f64())?;
        let tracks = self.tt == T::ZERO || self.tt >= self.ts;
        unless(
            tracks,
            "Tt",
            "0, a time of Ts or more, or inf",
            self.tt.to_f64(),
        )?;
        check_limits((self.u_min, self.u_max))?;
        Ok(self)
    }
}

/// The gains of one sample, in the form that the step uses.
#[derive(Clone, Copy, Debug)]
pub struct Terms<T> {
    /// Proportional gain.
    pub kp: T,
    /// Integral gain per sample, `Kp Ts/Ti`.
    pub ki: T,
    /// Gain on the difference of the derivative's input, `Kp Td/(Td/N + Ts)`.
    pub kd: T,
    /// Pole of the derivative's filter, `(Td/N)/(Td/N + Ts)`.
    pub pole: T,
    /// Gain on the rate, `Kp Td`.
    rate: T,
}

impl<T: Real> Terms<T> {
    /// From `Kp`, `Kp Ts/Ti`, `Td` with the filter's `N` at sample time `ts`.
    pub(crate) fn new(kp: T, ki: T, td: T, n: T, ts: T) -> Self {
        let filter = td / n;
        Self {
            kp,
            ki,
            kd: kp * td / (filter + ts),
            pole: filter / (filter + ts),
            rate: kp * td,
        }
    }

    /// The constant gains of the settings.
    pub(crate) fn constant(settings: &Settings<T>) -> Self {
        let Settings { gains, n, ts, .. } = *settings;
        Self::new(gains.kp, gains.kp * ts / gains.ti, gains.td, n, ts)
    }
}

#[cfg(test)]
impl Terms<f64> {
    /// Whether all agree within the relative tolerance `parts`; bit for bit if that is 0.
    pub(crate) fn close_to(&self, other: &Self, parts: f64) -> bool {
        let all = |t: &Self| [t.kp, t.ki, t.kd, t.pole, t.rate];
        let mut pairs = all(self).into_iter().zip(all(other));
        pairs.all(|(a, b)| (a - b).abs() <= parts * b.abs())
    }
}

/// `u = Kp (e + (1/Ti) int e dt + Td de/dt) - Kp (alpha r + beta Td dr/dt)`, `e = r - y`, plus feedforward, limited.
#[derive(Clone, Debug)]
pub struct Pid<T> {
    settings: Settings<T>,
    /// The gains at the last sample.
    terms: Terms<T>,
    /// Share of the excess taken from the integral in one sample, `Ts/Tt`.
    tracking: T,
    /// Integral term \[u\].
    integral: T,
    /// Derivative term \[u\].
    derivative: T,
    /// Reference at the last sample.
    r: T,
    /// Error at the last sample.
    e: T,
    /// Output at the last sample \[u\].
    u: T,
    /// The operator's command in manual.
    manual: Option<T>,
    /// Whether `r` and `e` belong to a sample.
    started: bool,
    /// Whether a command was given without a sample: the slew limit then starts from it.
    held: bool,
}

impl<T: Real> Pid<T> {
    /// A controller at rest.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn new(settings: Settings<T>) -> Result<Self, Refused> {
        let settings = settings.checked()?;
        let mut pid = Self {
            settings,
            terms: Terms::constant(&settings),
            tracking: settings.tracking(),
            integral: T::ZERO,
            derivative: T::ZERO,
            r: T::ZERO,
            e: T::ZERO,
            u: T::ZERO,
            manual: None,
            started: false,
            held: false,
        };
        pid.reset();
        Ok(pid)
    }

    /// Back to the state before the first sample, in automatic. The slew limit starts from an output of 0 or the
    /// nearest limit.
    pub fn reset(&mut self) {
        self.integral = T::ZERO;
        self.derivative = T::ZERO;
        self.u = T::ZERO.limit(self.settings.u_min, self.settings.u_max);
        self.manual = None;
        self.started = false;
        self.held = false;
    }

    /// From reference `r` and filtered output `y` to the command.
    ///
    /// For any input the command is finite, within the limits, and no further from the last one than the slew rate
    /// allows. If it would not be finite, as after a lost measurement, state and output stay unchanged.
    pub fn step(&mut self, r: T, y: T) -> T {
        // x + (-0) is x for every x, even for -0
        self.step_by(self.terms, r, y, -T::ZERO)
    }

    /// [`step`](Self::step) with the gains of this sample and a command added before the limits.
    ///
    /// Every branch costs the same arithmetic: unused results are computed and dropped.
    pub(crate) fn step_by(&mut self, terms: Terms<T>, r: T, y: T, feedforward: T) -> T {
        let Settings { alpha, beta, .. } = self.settings;
        let e = r - y;
        let rate_input = e - beta * r;
        let change = rate_input - (self.e - beta * self.r);
        let change = if self.started { change } else { T::ZERO };
        let derivative = terms.pole * self.derivative + terms.kd * change;
        let integral = self.integral + terms.ki * e;
        let proportional = terms.kp * (e - alpha * r);
        let wanted = proportional + integral + derivative + feedforward;
        if !(wanted.is_finite() && rate_input.is_finite()) {
            if rate_input.is_finite() && feedforward.is_finite() {
                self.begin_again(r, e);
            }
            return self.hold();
        }
        self.u = self.limited(self.manual.unwrap_or(wanted));
        let kept = self.without_windup(terms.ki, integral, self.u - wanted);
        let bumpless = self.u - proportional - derivative - feedforward;
        let automatic = self.manual.is_none();
        self.integral = if automatic { kept } else { bumpless };
        self.derivative = derivative;
        (self.terms, self.r, self.e, self.started) = (terms, r, e, true);
        self.u
    }

    /// Finite inputs gave a result that is not, so the memory is to blame: it holds a measurement near the largest
    /// number, or newer settings magnify it. If kept, it would hold the command for ever. The derivative starts over at
    /// this sample, and an integral term that is not finite becomes the last command.
    #[cold]
    fn begin_again(&mut self, r: T, e: T) {
        (self.r, self.e, self.started) = (r, e, true);
        self.derivative = T::ZERO;
        if !self.integral.is_finite() {
            self.integral = self.u;
        }
    }

    /// A sample without measurement: command and memory stay; in manual the operator's command still applies.
    pub(crate) fn hold(&mut self) -> T {
        self.held = true;
        if let Some(manual) = self.manual {
            let u = self.limited(manual);
            self.integral += u - self.u;
            self.u = u;
        }
        self.u
    }

    /// New settings from the next sample on, without a bump: the integral term absorbs the change of the proportional
    /// and derivative terms. The derivative's memory represents the same rate as before.
    pub(crate) fn change(&mut self, settings: Settings<T>, terms: Terms<T>) {
        if self.started {
            let before = self.terms;
            let shown = |alpha: T| self.e - alpha * self.r;
            let rescaled = self.derivative * (terms.rate / before.rate);
            let known = before.rate != T::ZERO && rescaled.is_finite();
            let derivative = if known { rescaled } else { T::ZERO };
            let proportional =
                before.kp * shown(self.settings.alpha) - terms.kp * shown(settings.alpha);
            self.integral += proportional + (self.derivative - derivative);
            self.derivative = derivative;
        } else if !self.held {
            self.u = T::ZERO.limit(settings.u_min, settings.u_max);
        }
        self.tracking = settings.tracking();
        (self.settings, self.terms) = (settings, terms);
    }

    /// Adds to the integral term what another part of the command loses, once there was a sample.
    pub(crate) fn absorb(&mut self, change: T) {
        let kept = self.integral + change;
        if self.started && kept.is_finite() {
            self.integral = kept;
        }
    }

    /// Whether there was a sample.
    pub(crate) fn is_started(&self) -> bool {
        self.started
    }

    /// The operator's command from the next sample on, within the limits; the integral term tracks it.
    ///
    /// # Errors
    /// A command that is not finite.
    pub fn set_manual(&mut self, u: T) -> Result<(), Refused> {
        Refused::unless(u.is_finite(), "manual", "a finite command", u.to_f64())?;
        self.manual = Some(u);
        Ok(())
    }

    /// Back to the controller's command, starting from the operator's.
    pub fn set_automatic(&mut self) {
        self.manual = None;
    }

    /// Whether the command is the operator's.
    pub fn is_manual(&self) -> bool {
        self.manual.is_some()
    }

    /// The gains of the last sample; the constant ones if there were no others.
    pub fn terms(&self) -> Terms<T> {
        self.terms
    }

    /// The output of the last step.
    pub fn output(&self) -> T {
        self.u
    }

    /// The reference at the last sample.
    pub(crate) fn reference(&self) -> T {
        self.r
    }

    /// The settings.
    pub fn settings(&self) -> &Settings<T> {
        &self.settings
    }

    /// The only path to the command.
    fn limited(&self, wanted: T) -> T {
        let Settings {
            u_min,
            u_max,
            slew,
            ts,
            ..
        } = self.settings;
        limited(wanted, self.u, (u_min, u_max), slew * ts)
    }

    /// The integral to keep when the limits moved the output by `excess`.
    ///
    /// Conditional integration still lets the integral move away from the limit; otherwise it could stay there for ever.
    fn without_windup(&self, ki: T, integral: T, excess: T) -> T {
        let pushes_on = (integral - self.integral) * excess < T::ZERO;
        let tracked = integral + self.tracking * excess;
        let (free, none) = (excess == T::ZERO, ki == T::ZERO);
        let tracks = self.settings.tt != T::ZERO;
        if free | none {
            integral
        } else if tracks {
            tracked
        } else if pushes_on {
            self.integral
        } else {
            integral
        }
    }
}

#[cfg(test)]
mod tests;
