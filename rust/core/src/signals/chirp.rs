//! Chirp: a sine whose frequency, amplitude and offset sweep over the signal.

use std::f64::consts::TAU;

use super::{below_nyquist, finite, samples};
use crate::{Error, Result};

/// How the frequency goes from start to end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sweep {
    /// `f = f0 + (f1 - f0) t/T`.
    Linear,
    /// `f = f0 (f1/f0)^(t/T)`: the same time for every octave.
    Logarithmic,
}

/// `offset(t) + amplitude(t) sin(phase + 2 pi int f dt)`; offset and amplitude are ramps.
///
/// With growing amplitude it is the paper's chirp Lo-Hi, with shrinking amplitude its Hi-Lo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chirp {
    /// Length of the signal (s).
    pub duration: f64,
    /// Frequency at the start (Hz).
    pub f_start: f64,
    /// Frequency at the end (Hz); it may be the lower one.
    pub f_end: f64,
    /// Amplitude at the start.
    pub amplitude_start: f64,
    /// Amplitude at the end.
    pub amplitude_end: f64,
    /// Offset at the start.
    pub offset_start: f64,
    /// Offset at the end.
    pub offset_end: f64,
    /// The way of the frequency.
    pub sweep: Sweep,
    /// Phase at the start (rad); -pi/2 starts at the lowest point.
    pub phase: f64,
}

impl Chirp {
    /// The sampled signal.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for values that are not finite, a frequency below 0 or not below half the sampling
    /// frequency, 0 Hz in a logarithmic sweep, or a length outside 1 to [`super::MAX_SAMPLES`] samples.
    pub fn generate(&self, ts: f64) -> Result<Vec<f64>> {
        let n = samples("duration", self.duration, ts)?;
        self.check(ts)?;
        Ok((0..n).map(|k| self.at(k as f64 * ts)).collect())
    }

    fn check(&self, ts: f64) -> Result<()> {
        finite(&[
            ("amplitude_start", self.amplitude_start),
            ("amplitude_end", self.amplitude_end),
            ("offset_start", self.offset_start),
            ("offset_end", self.offset_end),
            ("phase", self.phase),
        ])?;
        below_nyquist("f_start", self.f_start, ts)?;
        below_nyquist("f_end", self.f_end, ts)?;
        if self.sweep == Sweep::Logarithmic && self.f_start.min(self.f_end) <= 0.0 {
            return Err(Error::setting(format!(
                "expected frequencies above 0 Hz in a logarithmic sweep, got {} to {} Hz; start above 0 or sweep linearly",
                self.f_start, self.f_end
            )));
        }
        Ok(())
    }

    fn at(&self, t: f64) -> f64 {
        let share = t / self.duration;
        let ramp = |start: f64, end: f64| start + (end - start) * share;
        let angle = self.phase + TAU * self.cycles(t);
        ramp(self.offset_start, self.offset_end)
            + ramp(self.amplitude_start, self.amplitude_end) * angle.sin()
    }

    /// Cycles since the start: the integral of the frequency.
    fn cycles(&self, t: f64) -> f64 {
        let (f0, f1, share) = (self.f_start, self.f_end, t / self.duration);
        match self.sweep {
            Sweep::Linear => t * (f0 + 0.5 * (f1 - f0) * share),
            // expm1 keeps the limit f1 -> f0 exact.
            Sweep::Logarithmic => match (f1 / f0).ln() {
                0.0 => f0 * t,
                octaves => f0 * self.duration * (octaves * share).exp_m1() / octaves,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHIRP: Chirp = Chirp {
        duration: 20.0,
        f_start: 0.1,
        f_end: 3.0,
        amplitude_start: 1.0,
        amplitude_end: 2.0,
        offset_start: 0.0,
        offset_end: 5.0,
        sweep: Sweep::Linear,
        phase: 0.0,
    };

    #[test]
    fn sweeps_through_the_stated_frequencies() {
        for sweep in [Sweep::Linear, Sweep::Logarithmic] {
            let chirp = Chirp { sweep, ..CHIRP };
            let frequency = |t: f64| (chirp.cycles(t + 1e-5) - chirp.cycles(t - 1e-5)) / 2e-5;
            assert!((frequency(0.0) - 0.1).abs() < 1e-5);
            assert!((frequency(20.0) - 3.0).abs() < 1e-5);
        }
        let log = Chirp {
            sweep: Sweep::Logarithmic,
            ..CHIRP
        };
        let middle = (log.cycles(10.0 + 1e-5) - log.cycles(10.0 - 1e-5)) / 2e-5;
        assert!((middle - 0.3f64.sqrt()).abs() < 1e-5);
    }

    #[test]
    fn a_sweep_without_width_is_a_sine() {
        for sweep in [Sweep::Linear, Sweep::Logarithmic] {
            let sine = Chirp {
                f_end: 0.1,
                amplitude_end: 1.0,
                offset_end: 0.0,
                sweep,
                ..CHIRP
            };
            let u = sine.generate(0.01).unwrap();
            let error = |(k, v): (usize, &f64)| (v - (TAU * 0.1 * k as f64 * 0.01).sin()).abs();
            assert!(u.iter().enumerate().map(error).all(|e| e < 1e-12));
        }
    }

    #[test]
    fn refuses_frequencies_that_sampling_cannot_show() {
        let at = |f_end: f64, sweep| {
            Chirp {
                f_end,
                sweep,
                ..CHIRP
            }
            .generate(1e-3)
        };
        assert!(at(500.0, Sweep::Linear).is_err());
        assert!(at(499.0, Sweep::Linear).is_ok());
        assert!(at(-1.0, Sweep::Linear).is_err());
        assert!(at(0.0, Sweep::Linear).is_ok());
        assert!(at(0.0, Sweep::Logarithmic).is_err());
        assert!(at(f64::NAN, Sweep::Linear).is_err());
    }
}
