//! The alpha-beta observer: speed from a position that is never formed.
//!
//! The tracker of a position `p(k) = p(k-1) + Ts y(k)` with position and speed as its state (Benedict and Bordner 1962),
//!
//! ```text
//! r(k) = p(k) - x(k-1) - Ts v(k-1)        innovation
//! x(k) = x(k-1) + Ts v(k-1) + a r(k)
//! v(k) = v(k-1) + b/Ts r(k)
//! ```
//!
//! leaves `p(k) - x(k) = (1 - a) r(k)` behind, so that the innovation follows from itself and from the measured speed:
//! `r(k) = (1 - a) r(k-1) + Ts (y(k) - v(k-1))`. With `s = r/Ts` neither a position nor the sample time is left:
//!
//! ```text
//! s(k) = (1 - a) s(k-1) + y(k) - v(k-1)
//! v(k) = v(k-1) + b s(k)
//! ```
//!
//! Critically damped: both poles at `theta = exp(-Ts/time)`, `1 - a = theta^2`, `b = (1 - theta)^2`.

use crate::gains::sample_time;
use crate::real::one_minus_exp;
use crate::{Real, Refused};

/// Speed out of a measured speed, without error where the speed is constant.
#[derive(Clone, Debug)]
pub struct Observer<T> {
    /// `1 - a`.
    keep: T,
    /// `b`.
    gain: T,
    /// `v`.
    speed: T,
    /// `s`.
    innovation: T,
    on: bool,
    started: bool,
}

impl<T: Real> Observer<T> {
    /// An observer of time constant `time` \[s\] at sample time `ts` \[s\]; 0 passes its input through.
    ///
    /// # Errors
    /// A time that is negative or not finite, a sample time that is not above 0.
    pub fn new(time: T, ts: T) -> Result<Self, Refused> {
        sample_time(ts)?;
        let holds = time >= T::ZERO && time.is_finite();
        let expected = "a finite time of 0 s or more";
        Refused::unless(holds, "observer_time", expected, time.to_f64())?;
        let step = one_minus_exp(ts / time);
        let pole = T::ONE - step;
        Ok(Self {
            keep: pole * pole,
            gain: step * step,
            speed: T::ZERO,
            innovation: T::ZERO,
            on: time > T::ZERO,
            started: false,
        })
    }

    /// Forgets everything; the next sample sets the speed.
    pub fn reset(&mut self) {
        self.started = false;
    }

    /// Takes a measured speed, gives the observed one.
    pub fn step(&mut self, y: T) -> T {
        let (from, left) = if self.started {
            (self.speed, self.innovation)
        } else {
            (y, T::ZERO)
        };
        let innovation = self.keep * left + (y - from);
        let speed = from + self.gain * innovation;
        (self.speed, self.innovation) = if self.on {
            (speed, innovation)
        } else {
            (y, T::ZERO)
        };
        self.started = true;
        self.speed
    }

    /// `1 - a` and `b`; `None` where it passes its input through.
    pub(crate) fn weights(&self) -> Option<(T, T)> {
        self.on.then_some((self.keep, self.gain))
    }

    /// This observer's settings with the memory of `other`, so that its output goes on where that one's was.
    pub(crate) fn after(mut self, other: &Self) -> Self {
        self.speed = other.speed;
        self.innovation = if self.on { other.innovation } else { T::ZERO };
        self.started = other.started;
        self
    }
}

#[cfg(test)]
mod tests;
