//! Sines: the chirp, whose frequency, amplitude and offset sweep over the signal, and the random-phase multisine, all
//! harmonics of a band with equal amplitude; and the crest factor.

use std::f64::consts::TAU;

use super::{below_nyquist, finite, not_negative, ordered, samples};
use crate::random::Random;
use crate::{Error, Result};

/// How the frequency changes from start to end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sweep {
    /// `f = f0 + (f1 - f0) t/T`.
    Linear,
    /// `f = f0 (f1/f0)^(t/T)`: the same time for every octave.
    Logarithmic,
}

/// `offset(t) + amplitude(t) sin(phase + 2 pi int f dt)`; offset and amplitude are ramps.
///
/// With growing amplitude it is the paper's chirp Lo-Hi, with shrinking amplitude the paper's Hi-Lo.
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
    /// How the frequency changes.
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

/// Most samples times harmonics that are summed: a few seconds of work.
const MAX_TERMS: usize = 1_000_000_000;
/// Samples between exact restarts of the rotating phasor, which bounds its rounding error.
const RESTART: usize = 256;

/// `offset + g sum_h cos(2 pi h k/N + phi_h)` over the harmonics `h` of `1/duration` in the band, with uniform random phases.
///
/// The signal is periodic with its `N` samples. `g` makes the largest deviation from `offset` equal to `amplitude`.
/// Random phases give a crest factor near `sqrt(2 ln N)`, about 2.5 to 3.5 (Pintelon and Schoukens 2012, section 5.3).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Multisine {
    /// Length of the signal and its period (s).
    pub duration: f64,
    /// Lower end of the band (Hz).
    pub f_low: f64,
    /// Upper end of the band (Hz).
    pub f_high: f64,
    /// Largest deviation from the offset.
    pub amplitude: f64,
    /// Mean.
    pub offset: f64,
}

impl Multisine {
    /// The sampled signal for `seed`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for values that are not finite or out of order, a band without a harmonic or up to half the
    /// sampling frequency, or more than samples x harmonics = 1e9.
    pub fn generate(&self, ts: f64, seed: u64) -> Result<Vec<f64>> {
        let n = samples("duration", self.duration, ts)?;
        let harmonics = self.harmonics(n, ts)?;
        let mut random = Random::new(seed);
        let mut sum = vec![0.0; n];
        for harmonic in harmonics {
            add_cosine(&mut sum, harmonic, random.between(0.0, TAU));
        }
        let peak = sum.iter().fold(0.0f64, |peak, v| peak.max(v.abs()));
        // Three or more samples of a harmonic below N/2 cannot all be zero.
        let gain = self.amplitude / peak;
        let scaled = |v: f64| self.offset + (gain * v).clamp(-self.amplitude, self.amplitude);
        Ok(sum.into_iter().map(scaled).collect())
    }

    fn harmonics(&self, n: usize, ts: f64) -> Result<std::ops::RangeInclusive<usize>> {
        not_negative(&[("amplitude", self.amplitude), ("f_low", self.f_low)])?;
        finite(&[("offset", self.offset)])?;
        ordered(("f_low", self.f_low), ("f_high", self.f_high))?;
        below_nyquist("f_high", self.f_high, ts)?;
        let period = n as f64 * ts;
        // A band edge that is a harmonic up to rounding counts as one.
        let first = ((self.f_low * period * (1.0 - 1e-12)).ceil() as usize).max(1);
        let last = (self.f_high * period * (1.0 + 1e-12)).floor() as usize;
        let last = last.min((n - 1) / 2);
        if first > last {
            return Err(Error::setting(format!(
                "expected a harmonic of {} Hz between {} and {} Hz, got none; widen the band or lengthen the signal",
                1.0 / period,
                self.f_low,
                self.f_high
            )));
        }
        let terms = n.saturating_mul(last - first + 1);
        if terms > MAX_TERMS {
            return Err(Error::setting(format!(
                "expected at most {MAX_TERMS} samples x harmonics, got {terms}; narrow the band or shorten the signal"
            )));
        }
        Ok(first..=last)
    }
}

/// Adds `cos(2 pi h k/N + phase)` by a rotating phasor.
fn add_cosine(sum: &mut [f64], harmonic: usize, phase: f64) {
    let n = sum.len();
    let (turn_sin, turn_cos) = (TAU * harmonic as f64 / n as f64).sin_cos();
    for (block, values) in sum.chunks_mut(RESTART).enumerate() {
        let cycles = (harmonic * block * RESTART % n) as f64 / n as f64;
        let (mut sin, mut cos) = (phase + TAU * cycles).sin_cos();
        for value in values {
            *value += cos;
            (sin, cos) = (
                sin * turn_cos + cos * turn_sin,
                cos * turn_cos - sin * turn_sin,
            );
        }
    }
}

/// Ratio of the largest deviation from the mean to the root mean square of the deviations; 1 for a constant signal.
///
/// # Errors
/// `ErrorKind::Data` for no samples or values that are not finite.
pub fn crest_factor(signal: &[f64]) -> Result<f64> {
    if signal.is_empty() || signal.iter().any(|v| !v.is_finite()) {
        return Err(Error::data(
            "expected one finite sample or more, got none or one that is not finite; repair the signal",
        ));
    }
    let n = signal.len() as f64;
    let mean = signal.iter().map(|v| v / n).sum::<f64>();
    let peak = signal
        .iter()
        .fold(0.0f64, |peak, v| peak.max((v - mean).abs()));
    if peak == 0.0 {
        return Ok(1.0);
    }
    let square = signal
        .iter()
        .map(|v| ((v - mean) / peak).powi(2))
        .sum::<f64>();
    Ok((n / square).sqrt())
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

    const MULTISINE: Multisine = Multisine {
        duration: 2.0,
        f_low: 1.0,
        f_high: 5.0,
        amplitude: 3.0,
        offset: 4.0,
    };

    fn power(signal: &[f64], harmonic: usize) -> f64 {
        let angle = |k: usize| TAU * (harmonic * k % signal.len()) as f64 / signal.len() as f64;
        let pairs = signal.iter().enumerate();
        let (re, im) = pairs.fold((0.0, 0.0), |(re, im), (k, v)| {
            (re + v * angle(k).cos(), im + v * angle(k).sin())
        });
        (re * re + im * im) / (signal.len() as f64).powi(2)
    }

    #[test]
    fn has_equal_power_in_its_band_and_none_outside() {
        let signal = MULTISINE.generate(1e-3, 1).unwrap();
        let inside = power(&signal, 2);
        assert!(inside > 0.01);
        for harmonic in 1..40 {
            let expected = if (2..=10).contains(&harmonic) {
                inside
            } else {
                0.0
            };
            assert!(
                (power(&signal, harmonic) - expected).abs() < 1e-12,
                "{harmonic}"
            );
        }
    }

    #[test]
    fn reaches_its_amplitude_and_not_more() {
        for seed in 0..20 {
            let signal = MULTISINE.generate(1e-3, seed).unwrap();
            let peak = signal
                .iter()
                .fold(0.0f64, |peak, v| peak.max((v - 4.0).abs()));
            assert!((peak - 3.0).abs() < 1e-14);
            let crest = crest_factor(&signal).unwrap();
            assert!((1.5..4.5).contains(&crest), "{crest}");
        }
    }

    #[test]
    fn knows_the_crest_factors_of_plain_signals() {
        assert_eq!(crest_factor(&[1.0, -1.0, 1.0, -1.0]).unwrap(), 1.0);
        assert_eq!(crest_factor(&[2.0, 2.0]).unwrap(), 1.0);
        let sine: Vec<f64> = (0..1000)
            .map(|k| 5.0 + (TAU * k as f64 / 1000.0).sin())
            .collect();
        assert!((crest_factor(&sine).unwrap() - 2f64.sqrt()).abs() < 1e-9);
        assert!(crest_factor(&[]).is_err());
    }

    #[test]
    fn refuses_a_band_without_harmonics_and_endless_work() {
        let bad = [
            Multisine {
                f_low: 1.1,
                f_high: 1.2,
                ..MULTISINE
            },
            Multisine {
                f_high: 500.0,
                ..MULTISINE
            },
            Multisine {
                f_low: 6.0,
                ..MULTISINE
            },
            Multisine {
                amplitude: -1.0,
                ..MULTISINE
            },
            Multisine {
                duration: 2000.0,
                f_high: 499.0,
                ..MULTISINE
            },
            Multisine {
                duration: 1e-3,
                ..MULTISINE
            },
        ];
        for multisine in bad {
            assert!(multisine.generate(1e-3, 0).is_err(), "{multisine:?}");
        }
    }
}
