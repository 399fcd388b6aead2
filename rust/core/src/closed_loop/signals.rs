//! What acts on a loop from outside.

use super::check_reference;
use crate::{Error, Result};

/// Reference, feedforward and disturbance of a run, sample by sample.
#[derive(Clone, Copy, Debug)]
pub struct Signals<'a> {
    /// What the output shall be \[y\].
    pub reference: &'a [f64],
    /// A command that is added before the limits \[u\].
    pub feedforward: Option<&'a [f64]>,
    /// A command that is added behind the limits, unseen by the controller \[u\].
    pub disturbance: Option<&'a [f64]>,
}

impl<'a> Signals<'a> {
    /// A reference alone.
    pub fn new(reference: &'a [f64]) -> Self {
        Self {
            reference,
            feedforward: None,
            disturbance: None,
        }
    }

    /// # Errors
    /// `ErrorKind::Data` for signals that are empty, not finite or of different lengths.
    pub(crate) fn check(&self) -> Result<()> {
        check_reference(self.reference)?;
        let beside = [
            ("feedforward", self.feedforward),
            ("disturbance", self.disturbance),
        ];
        for (name, signal) in beside {
            let Some(signal) = signal else { continue };
            if signal.len() != self.reference.len() {
                return Err(Error::data(format!(
                    "expected a {name} as long as the reference, {} samples, got {}; give one value a sample",
                    self.reference.len(),
                    signal.len()
                )));
            }
            check_finite(name, signal)?;
        }
        Ok(())
    }

    /// The command that is added at sample `k` before the limits.
    #[inline(always)]
    pub(super) fn feedforward_at(&self, k: usize) -> Option<f64> {
        self.feedforward.map(|added| at(added, k))
    }

    /// The command that is added at sample `k` behind the limits.
    #[inline(always)]
    pub(super) fn disturbance_at(&self, k: usize) -> Option<f64> {
        self.disturbance.map(|added| at(added, k))
    }
}

#[inline(always)]
fn at(signal: &[f64], k: usize) -> f64 {
    signal.get(k).copied().unwrap_or(0.0)
}

/// # Errors
/// `ErrorKind::Data` at the first value that is not finite.
pub(super) fn check_finite(name: &str, signal: &[f64]) -> Result<()> {
    match signal.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(k) => Err(Error::data(format!(
            "expected finite values in the {name}, got {} at sample {k}; fill or cut it there",
            signal[k]
        ))),
    }
}
