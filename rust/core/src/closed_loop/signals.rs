//! What acts on a loop from outside.

use sewfast_control::Controller;

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
    pub(super) fn check(&self) -> Result<()> {
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

    /// The controller's command at sample `k`.
    pub(super) fn command(
        &self,
        controller: &mut Controller<f64>,
        k: usize,
        r: f64,
        y: f64,
    ) -> f64 {
        match self.feedforward {
            None => controller.step(r, y),
            Some(added) => controller.step_with(r, y, at(added, k)),
        }
    }

    /// What reaches the plant of a command.
    pub(super) fn disturbed(&self, k: usize, u: f64) -> f64 {
        self.disturbance.map_or(u, |added| u + at(added, k))
    }
}

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
