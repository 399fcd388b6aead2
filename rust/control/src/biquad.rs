//! Biquads: notches, low passes and lead-lags in series, for machines with a shaft that swings.
//!
//! A section is a fraction of second order whose gain at standstill is 1,
//!
//! ```text
//! H(s) = (1 + n1 s + n2 s^2)/(1 + d1 s + d2 s^2)
//! ```
//!
//! sampled by the bilinear transform `s = k (1 - q)/(1 + q)`, `q = 1/z`. Each pair of zeros and of poles has the `k` that keeps its own
//! frequency (prewarping: `k = w/tan(w Ts/2)`). With `N1 = n1 k`, `N2 = n2 k^2`, and `D1`, `D2` alike,
//!
//! ```text
//! H(q) = (1 + N1 + N2 + 2 (1 - N2) q + (1 - N1 + N2) q^2)/(1 + D1 + D2 + 2 (1 - D2) q + (1 - D1 + D2) q^2)
//!      = 1 + (1 - q) (c0 + c1 q)/(1 + a1 q + a2 q^2)
//! ```
//!
//! The second line holds because numerator and denominator agree at `q = 1`. A section is computed in this form:
//! transposed direct form II on the change of its input, where `d` is the output minus the input,
//!
//! ```text
//! d(k)  = c0 (x(k) - x(k-1)) + s1(k-1),    y(k) = x(k) + d(k)
//! s1(k) = c1 (x(k) - x(k-1)) - a1 d(k) + s2(k-1)
//! s2(k) = -a2 d(k)
//! ```
//!
//! So the gain at standstill is 1 to the bit, however single precision rounds the coefficients. A section at rest has
//! zeros in its memory at any level of the signal, so it can be added, removed or changed there without a bump.

use core::f64::consts::PI;

use crate::{Real, Refused};

/// The most sections in series.
pub const BIQUADS: usize = 4;

/// A second-order section at a sample time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Biquad<T> {
    /// Step response at the step's own sample, minus 1.
    pub c0: T,
    /// The same a sample later, before the poles.
    pub c1: T,
    /// Coefficient of `q` in the denominator.
    pub a1: T,
    /// Coefficient of `q^2` in the denominator.
    pub a2: T,
}

impl<T: Real> Biquad<T> {
    /// Passes its input through.
    pub const NONE: Self = Self {
        c0: T::ZERO,
        c1: T::ZERO,
        a1: T::ZERO,
        a2: T::ZERO,
    };

    /// Removes a swing at `frequency` \[Hz\]: the gain there is `depth`, and the band in which a deep notch attenuates
    /// by 3 dB or more is `width` times the frequency.
    ///
    /// `H(s) = (s^2 + depth width w s + w^2)/(s^2 + width w s + w^2)`.
    ///
    /// # Errors
    /// A frequency that is not between 0 and half the sample rate, a depth outside 0 to 1, a width that is not above 0.
    pub fn notch(frequency: f64, depth: f64, width: f64, ts: f64) -> Result<Self, Refused> {
        let holds = (0.0..=1.0).contains(&depth);
        Refused::unless(holds, "depth", "a gain from 0 to 1", depth)?;
        positive("width", width)?;
        let damping = 0.5 * width;
        Self::second_order(
            (frequency, depth * damping, "frequency"),
            (frequency, damping, "frequency"),
            ts,
        )
    }

    /// Zeros and poles at separate frequencies \[Hz\], each with its damping: the inverse of a shaft's anti-resonance
    /// and resonance.
    ///
    /// # Errors
    /// A frequency that is not between 0 and half the sample rate, a damping below 0, poles without damping.
    pub fn resonance(
        zero_frequency: f64,
        zero_damping: f64,
        pole_frequency: f64,
        pole_damping: f64,
        ts: f64,
    ) -> Result<Self, Refused> {
        let holds = zero_damping >= 0.0 && zero_damping.is_finite();
        let expected = "a finite number of 0 or more";
        Refused::unless(holds, "zero_damping", expected, zero_damping)?;
        positive("pole_damping", pole_damping)?;
        Self::second_order(
            (zero_frequency, zero_damping, "zero_frequency"),
            (pole_frequency, pole_damping, "pole_frequency"),
            ts,
        )
    }

    /// Second-order low pass, `H(s) = w^2/(s^2 + 2 damping w s + w^2)`.
    ///
    /// # Errors
    /// A frequency \[Hz\] that is not between 0 and half the sample rate, a damping that is not above 0.
    pub fn low_pass(frequency: f64, damping: f64, ts: f64) -> Result<Self, Refused> {
        positive("damping", damping)?;
        let t = tangent("frequency", frequency, ts)?;
        Self::sampled((0.0, 0.0), (2.0 * damping / t, 1.0 / (t * t)))
    }

    /// `H(s) = (1 + s/zero)/(1 + s/pole)`, both \[Hz\]: a lead if the zero is lower, a lag if the pole is.
    ///
    /// # Errors
    /// A frequency that is not between 0 and half the sample rate.
    pub fn lead_lag(zero: f64, pole: f64, ts: f64) -> Result<Self, Refused> {
        let n1 = 1.0 / tangent("zero", zero, ts)?;
        let d1 = 1.0 / tangent("pole", pole, ts)?;
        // of first order: the fraction above would have an additional pole and zero at -1
        Self {
            c0: T::from_f64((n1 - d1) / (1.0 + d1)),
            a1: T::from_f64((1.0 - d1) / (1.0 + d1)),
            ..Self::NONE
        }
        .checked()
    }

    fn second_order(
        zeros: (f64, f64, &'static str),
        poles: (f64, f64, &'static str),
        ts: f64,
    ) -> Result<Self, Refused> {
        let part = |(frequency, damping, name): (f64, f64, &'static str)| {
            let t = tangent(name, frequency, ts)?;
            Ok((2.0 * damping / t, 1.0 / (t * t)))
        };
        Self::sampled(part(zeros)?, part(poles)?)
    }

    /// From `N1`, `N2` and `D1`, `D2`.
    fn sampled((n1, n2): (f64, f64), (d1, d2): (f64, f64)) -> Result<Self, Refused> {
        let d0 = 1.0 + d1 + d2;
        let (first, second) = ((n1 - d1) / d0, (n2 - d2) / d0);
        let rounded = T::from_f64;
        Self {
            c0: rounded(first + second),
            c1: rounded(first - second),
            a1: rounded(2.0 * (1.0 - d2) / d0),
            a2: rounded((1.0 - d1 + d2) / d0),
        }
        .checked()
    }

    /// The section, if it is stable: `|a2| < 1`, `|a1| < 1 + a2` (Jury).
    fn checked(self) -> Result<Self, Refused> {
        let Self { c0, c1, a1, a2 } = self;
        for c in [c0, c1] {
            Refused::unless(c.is_finite(), NAME, "finite coefficients", c.to_f64())?;
        }
        let inside = |a: T, most: T| a < most && -a < most;
        let expected = "poles inside the unit circle";
        Refused::unless(inside(a2, T::ONE), NAME, expected, a2.to_f64())?;
        Refused::unless(inside(a1, T::ONE + a2), NAME, expected, a1.to_f64())?;
        Ok(self)
    }
}

const NAME: &str = "biquads";

fn positive(name: &'static str, value: f64) -> Result<(), Refused> {
    let holds = value > 0.0 && value.is_finite();
    Refused::unless(holds, name, "a finite number above 0", value)
}

/// `tan(pi frequency Ts)`, for a frequency between 0 and half the sample rate.
///
/// From the series of sine and cosine, as there is no tangent without the standard library; up to a quarter turn 12
/// terms are exact to double precision.
fn tangent(name: &'static str, frequency: f64, ts: f64) -> Result<f64, Refused> {
    let x = PI * frequency * ts;
    let holds = x > 0.0 && frequency * ts < 0.5;
    let expected = "a frequency above 0 and below half the sample rate";
    Refused::unless(holds, name, expected, frequency)?;
    let series = |first: f64| {
        (1..=12).rev().fold(1.0, |sum, i| {
            let at = 2.0 * f64::from(i) + first;
            1.0 - x * x / (at * (at - 1.0)) * sum
        })
    };
    let (sine, cosine) = (x * series(1.0), series(0.0));
    let value = sine / cosine;
    // frequencies of subnormal size, or so near the half that the cosine vanishes
    let holds = value > 0.0 && (1.0 / (value * value)).is_finite();
    Refused::unless(holds, name, expected, frequency)?;
    Ok(value)
}

/// Up to [`BIQUADS`] sections in series; without any the input passes through.
///
/// ```
/// use sewfast_control::{Biquad, Cascade};
///
/// let notch = Biquad::<f64>::notch(60.0, 0.1, 0.5, 1e-3)?;
/// let low_pass = Biquad::low_pass(250.0, 0.7, 1e-3)?;
/// assert_eq!(Cascade::new(&[notch, low_pass])?.sections().len(), 2);
/// # Ok::<(), sewfast_control::Refused>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Cascade<T> {
    sections: [Biquad<T>; BIQUADS],
    length: usize,
}

impl<T: Real> Cascade<T> {
    /// No section.
    pub const NONE: Self = Self {
        sections: [Biquad::NONE; BIQUADS],
        length: 0,
    };

    /// A cascade of these sections, in this order.
    ///
    /// # Errors
    /// More than [`BIQUADS`], one that is not stable, coefficients that are not finite.
    pub fn new(sections: &[Biquad<T>]) -> Result<Self, Refused> {
        let mut cascade = Self::NONE;
        let count = sections.len();
        match cascade.sections.get_mut(..count) {
            Some(room) => room.copy_from_slice(sections),
            None => Refused::unless(false, NAME, "at most 4 sections", count as f64)?,
        }
        for section in sections {
            section.checked()?;
        }
        cascade.length = count;
        Ok(cascade)
    }

    /// The sections in their order.
    pub fn sections(&self) -> &[Biquad<T>] {
        self.sections.get(..self.length).unwrap_or_default()
    }

    /// Where sections that are added during a run begin at rest: at the output of the `last` ones or, if they magnify a
    /// step, at the `standing` input.
    ///
    /// The two differ by what filters and former sections hold back, and by rounding at rest: a lag and an observer come to rest some
    /// units in the last place away from their input. From the standing input this difference reaches the output unchanged; from the
    /// other place it is multiplied by the gain: a lead of 1e5 would make a bump of the last place.
    pub(crate) fn origin(&self, last: T, standing: Option<T>) -> T {
        let magnified = standing.filter(|x| x.is_finite() && self.magnifies());
        magnified.unwrap_or(last)
    }

    /// Passes a jump of the input, caused by new settings of a filter, through unchanged if the sections magnify a
    /// step, for the same reason.
    pub(crate) fn carry(&self, memory: &mut Memory<T>, jump: Option<T>) {
        let jump = jump.unwrap_or(T::ZERO);
        // adding 0 would turn -0 into 0
        if jump.is_finite() && jump != T::ZERO && self.magnifies() {
            for state in &mut memory.states {
                state.x += jump;
            }
        }
    }

    /// Whether the first response to a step is larger than the step.
    fn magnifies(&self) -> bool {
        let each = self.sections().iter();
        let gain = each.fold(T::ONE, |gain, section| gain * (T::ONE + section.c0));
        gain > T::ONE || gain < -T::ONE
    }

    /// Whether there are no sections.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }
}

impl<T: PartialEq> PartialEq for Cascade<T> {
    fn eq(&self, other: &Self) -> bool {
        self.sections.get(..self.length) == other.sections.get(..other.length)
    }
}

/// The memory of a section.
#[derive(Clone, Copy, Debug)]
struct State<T> {
    /// Input at the last sample.
    x: T,
    s1: T,
    s2: T,
}

/// The memory of a cascade for one signal; the sections come with each sample.
#[derive(Clone, Debug)]
pub(crate) struct Memory<T> {
    states: [State<T>; BIQUADS],
    pub(crate) started: bool,
}

impl<T: Real> Memory<T> {
    /// Before the first sample.
    pub(crate) fn new() -> Self {
        let rest = State {
            x: T::ZERO,
            s1: T::ZERO,
            s2: T::ZERO,
        };
        Self {
            states: [rest; BIQUADS],
            started: false,
        }
    }

    /// At rest, as after a signal of constant `x`.
    pub(crate) fn rest_at(&mut self, x: T) {
        let (s1, s2) = (T::ZERO, T::ZERO);
        self.states.fill(State { x, s1, s2 });
        self.started = true;
    }

    /// The next sample of the signal through `sections`.
    pub(crate) fn step(&mut self, sections: &[Biquad<T>], x: T) -> T {
        let each = sections.iter().zip(&mut self.states);
        each.fold(x, |x, (section, state)| {
            let Biquad { c0, c1, a1, a2 } = *section;
            let change = x - state.x;
            let d = c0 * change + state.s1;
            *state = State {
                x,
                s1: c1 * change - a1 * d + state.s2,
                s2: -(a2 * d),
            };
            x + d
        })
    }
}

#[cfg(test)]
pub(crate) mod tests;
