//! Load steps: what a loop does when a disturbance sets in while a reference is held.

use super::cost::Terms;
use crate::closed_loop::{Run, Signals, check_reference};
use crate::{Error, Result};

/// A reference that is held, and a command after the limits that sets in [u].
#[derive(Clone, Copy, Debug)]
pub struct LoadStep<'a> {
    /// The reference \[y\], including the way up to the held value.
    pub reference: &'a [f64],
    /// The disturbance \[u\]; it sets in at its first value other than 0.
    pub disturbance: &'a [f64],
    /// Deviation up to which the output counts as recovered \[y\].
    pub band: f64,
    /// Samples of the moving mean over which deviations are taken: 1 for none; one turn, if the load varies over the turn.
    pub mean: usize,
}

/// The most that a loop may do under the load steps; infinite for no limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoadLimit {
    /// Recovery \[ms\].
    pub recovery: f64,
    /// Rms deviation \[y\].
    pub load: f64,
}

impl<'a> LoadStep<'a> {
    /// # Errors
    /// `ErrorKind::Data` for signals that are empty, not finite, of different lengths or without a disturbance,
    /// `ErrorKind::Setting` for a band that is not above 0 or a mean over no sample.
    pub(super) fn check(&self) -> Result<()> {
        check_reference(self.reference)?;
        if self.disturbance.len() != self.reference.len()
            || self.disturbance.iter().any(|d| !d.is_finite())
            || self.begin() == self.reference.len()
        {
            return Err(Error::data(format!(
                "expected a finite load step as long as its reference, {} samples, that comes on in it, got {} samples",
                self.reference.len(),
                self.disturbance.len()
            )));
        }
        if !(self.band > 0.0 && self.band.is_finite() && self.mean > 0) {
            return Err(Error::setting(format!(
                "expected a band above 0 and a mean over one sample or more for a load step, got {} and {}",
                self.band, self.mean
            )));
        }
        Ok(())
    }

    pub(super) fn signals(&self) -> Signals<'a> {
        Signals {
            disturbance: Some(self.disturbance),
            ..Signals::new(self.reference)
        }
    }

    /// When the load sets in [samples].
    fn begin(&self) -> usize {
        let on = self.disturbance.iter().position(|d| *d != 0.0);
        on.unwrap_or(self.disturbance.len())
    }

    /// Recovery, rms deviation and largest command of a run.
    pub(super) fn terms(&self, run: &Run, ts: f64) -> Terms {
        self.of(&run.y, run.largest_command(), ts)
    }

    /// The same from the outputs and the largest `|u|`. Recovery is the last time that the deviation was outside the
    /// band, or all the remaining time if it stays outside.
    pub(super) fn of(&self, y: &[f64], u_max: f64, ts: f64) -> Terms {
        let begin = self.begin();
        let off = |k: usize| y[k] - self.reference[k];
        let first = (begin + 1).saturating_sub(self.mean);
        let mut sum: f64 = (first..begin).map(off).sum();
        let (mut squares, mut last) = (0.0, begin);
        for k in begin..y.len() {
            sum += off(k);
            let several = self.mean.min(k + 1);
            let mean = sum / several as f64;
            squares += mean * mean;
            if mean.abs() > self.band {
                last = k + 1;
            }
            if k + 1 >= self.mean {
                sum -= off(k + 1 - self.mean);
            }
        }
        Terms {
            recovery: 1e3 * ts * (last - begin) as f64,
            load: (squares / (y.len() - begin) as f64).sqrt(),
            u_max,
            ..Terms::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(y: Vec<f64>) -> Run {
        Run {
            u: vec![-2.0; y.len()],
            y,
            ..Run::default()
        }
    }

    #[test]
    fn recovery_ends_with_the_last_deviation_beyond_the_band() {
        let disturbance: Vec<f64> = (0..10).map(|k| f64::from(u8::from(k >= 4))).collect();
        let step = LoadStep {
            reference: &[100.0; 10],
            disturbance: &disturbance,
            band: 1.0,
            mean: 1,
        };
        step.check().unwrap();
        let y = [
            50.0, 100.0, 100.0, 100.0, 100.0, 97.0, 99.5, 102.0, 100.5, 100.0,
        ];
        let terms = step.terms(&run(y.to_vec()), 1e-3);
        assert_eq!((terms.recovery, terms.u_max), (4.0, 2.0));
        let squares: f64 = [0.0, 9.0, 0.25, 4.0, 0.25, 0.0].iter().sum();
        assert!((terms.load - (squares / 6.0).sqrt()).abs() < 1e-12);
        // The mean of two: 0, -1.5, -1.75, .75, 1.25, .25 from the load on.
        let smooth = LoadStep { mean: 2, ..step };
        assert_eq!(smooth.terms(&run(y.to_vec()), 1e-3).recovery, 5.0);
        let never = step.terms(&run(vec![0.0; 10]), 1e-3);
        assert_eq!((never.recovery, never.load), (6.0, 100.0));
    }

    #[test]
    fn load_steps_that_make_no_sense_are_refused() {
        let good = LoadStep {
            reference: &[1.0; 3],
            disturbance: &[0.0, 1.0, 1.0],
            band: 1.0,
            mean: 1,
        };
        let refused = |step: LoadStep<'_>| step.check().unwrap_err().message;
        for disturbance in [&[0.0; 3][..], &[1.0; 2], &[0.0, f64::NAN, 1.0]] {
            let bad = LoadStep {
                disturbance,
                ..good
            };
            assert!(refused(bad).contains("comes on"));
        }
        assert!(refused(LoadStep { band: 0.0, ..good }).contains("band"));
        assert!(refused(LoadStep { mean: 0, ..good }).contains("mean"));
        let empty = LoadStep {
            reference: &[],
            ..good
        };
        assert!(empty.check().is_err());
    }
}
