//! The two-degree-of-freedom PID controller (paper Eq. 9, Fig. 16), one sample at a time.

use crate::gains::sample_time;
use crate::{Real, Refused, Standard};

/// What a [`Pid`] is made from; symbols as in docs/CONVENTIONS.md.
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

    fn checked(self) -> Result<Self, Refused> {
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
        let (low, high) = (self.u_min, self.u_max);
        unless(
            low < T::INFINITY,
            "u_min",
            "a finite limit or -inf",
            low.to_f64(),
        )?;
        unless(high > low, "u_max", "a limit above u_min", high.to_f64())?;
        Ok(self)
    }
}

/// `u = Kp (e + (1/Ti) int e dt + Td de/dt) - Kp (alpha r + beta Td dr/dt)`, `e = r - y`, limited.
#[derive(Clone, Debug)]
pub struct Pid<T> {
    settings: Settings<T>,
    /// Integral gain per sample, `Kp Ts/Ti`.
    ki: T,
    /// Gain on the difference of the derivative's input, `Kp Td/(Td/N + Ts)`.
    kd: T,
    /// Pole of the derivative's filter, `(Td/N)/(Td/N + Ts)`.
    pole: T,
    /// Share of the excess taken from the integral in one sample, `Ts/Tt`.
    tracking: T,
    /// Integral term \[u\].
    integral: T,
    /// Derivative term \[u\].
    derivative: T,
    /// The derivative's input at the last sample, `(1 - beta) r - y`.
    rate_input: T,
    /// Output at the last sample \[u\].
    u: T,
    started: bool,
}

impl<T: Real> Pid<T> {
    /// A controller at rest.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn new(settings: Settings<T>) -> Result<Self, Refused> {
        let Settings {
            gains, n, tt, ts, ..
        } = settings.checked()?;
        let filter = gains.td / n;
        let mut pid = Self {
            settings,
            ki: gains.kp * ts / gains.ti,
            kd: gains.kp * gains.td / (filter + ts),
            pole: filter / (filter + ts),
            tracking: if tt == T::ZERO { T::ZERO } else { ts / tt },
            integral: T::ZERO,
            derivative: T::ZERO,
            rate_input: T::ZERO,
            u: T::ZERO,
            started: false,
        };
        pid.reset();
        Ok(pid)
    }

    /// Back to the state before the first sample; the output, from which slew counts, is 0 or the limit next to it.
    pub fn reset(&mut self) {
        self.integral = T::ZERO;
        self.derivative = T::ZERO;
        self.u = T::ZERO.limit(self.settings.u_min, self.settings.u_max);
        self.started = false;
    }

    /// From reference `r` and filtered output `y` to the command.
    ///
    /// Where the command would not be finite, as after a lost measurement, state and output stay as they are.
    pub fn step(&mut self, r: T, y: T) -> T {
        let Settings {
            gains, alpha, beta, ..
        } = self.settings;
        let e = r - y;
        let rate_input = e - beta * r;
        let derivative = self.derivative_for(rate_input);
        let integral = self.integral + self.ki * e;
        let wanted = gains.kp * (e - alpha * r) + integral + derivative;
        if !(wanted.is_finite() && rate_input.is_finite()) {
            return self.u;
        }
        self.u = self.limited(wanted);
        self.integral = self.without_windup(integral, self.u - wanted);
        self.derivative = derivative;
        self.rate_input = rate_input;
        self.started = true;
        self.u
    }

    /// The output of the last step.
    pub fn output(&self) -> T {
        self.u
    }

    /// The settings it was made from.
    pub fn settings(&self) -> &Settings<T> {
        &self.settings
    }

    fn derivative_for(&self, rate_input: T) -> T {
        let change = if self.started {
            rate_input - self.rate_input
        } else {
            T::ZERO
        };
        self.pole * self.derivative + self.kd * change
    }

    fn limited(&self, wanted: T) -> T {
        let Settings {
            u_min,
            u_max,
            slew,
            ts,
            ..
        } = self.settings;
        let change = slew * ts;
        wanted
            .limit(u_min, u_max)
            .limit(self.u - change, self.u + change)
    }

    /// The integral to keep when the limits moved the output by `excess`.
    ///
    /// Conditional integration still lets the integral move away from the limit, or it could stay there for ever.
    fn without_windup(&self, integral: T, excess: T) -> T {
        let pushes_on = (integral - self.integral) * excess < T::ZERO;
        if excess == T::ZERO || self.ki == T::ZERO {
            integral
        } else if self.settings.tt != T::ZERO {
            integral + self.tracking * excess
        } else if pushes_on {
            self.integral
        } else {
            integral
        }
    }
}

#[cfg(test)]
mod tests;
