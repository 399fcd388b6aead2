//! Plants to close a loop around: identified models, variations for robust tuning.

use super::{KernelPlant, Known, Plant};
use crate::lagged::{Form, Lagged, Lags};
use crate::neural_ss::{NeuralSS, Stepper};
use crate::speed::Encoder;
use crate::{Error, Result};

/// A lagged model as a plant; it keeps its regressor from sample to sample.
#[derive(Clone, Debug)]
pub struct LaggedPlant<'a, M> {
    // Two forms of the same model: `form` in the data's units, which kernels know, and `model` itself if it has no such form.
    model: &'a M,
    form: Option<Form>,
    /// Past outputs, newest first, then the inputs of the regressor.
    phi: Vec<f64>,
    /// Past inputs, newest first.
    inputs: Vec<f64>,
    lags: Lags,
    position: f64,
    ts: f64,
}

impl<'a, M: Lagged> LaggedPlant<'a, M> {
    /// `model` at rest: zero past outputs and inputs. `ts` \[s\] is the sample time it was identified at.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a model with several inputs or without delay, or an unusable sample time.
    pub fn new(model: &'a M, ts: f64) -> Result<Self> {
        let lags = model.lags();
        if lags.channels != 1 {
            return Err(Error::setting(format!(
                "expected a model with one input to close a loop around, got {}; identify it from the command alone",
                lags.channels
            )));
        }
        if lags.nk == 0 {
            return Err(Error::setting(
                "expected a model with a delay nk of 1 or more, got 0: the command is decided after the output is \
                 measured; identify it again with nk = 1",
            ));
        }
        if !(ts > 0.0 && ts.is_finite()) {
            return Err(Error::setting(format!(
                "expected a sample time above 0, got {ts}"
            )));
        }
        Ok(Self {
            model,
            form: model.form(),
            phi: vec![0.0; lags.regressors()],
            // From the newest command to the oldest one in the regressor.
            inputs: vec![0.0; lags.nk + lags.nb - 1],
            lags,
            position: 0.0,
            ts,
        })
    }
}

impl<M: Lagged> Plant for LaggedPlant<'_, M> {
    fn reset(&mut self) {
        self.phi.fill(0.0);
        self.inputs.fill(0.0);
        self.position = 0.0;
    }

    fn output(&self) -> f64 {
        self.phi[0]
    }

    fn position(&self) -> f64 {
        self.position
    }

    fn advance(&mut self, u: f64) {
        let Lags { na, nk, .. } = self.lags;
        push(&mut self.inputs, u);
        self.phi[na..].copy_from_slice(&self.inputs[nk - 1..]);
        // `form` is used here too, if there is one: a plant stepped by itself and one inside a kernel then differ by
        // rounding only, not by how the scaling is applied.
        let y = match &self.form {
            Some(form) => form.output(&self.phi),
            None => self.model.output(&self.phi),
        };
        // Trapezoidal rule: between samples the output is taken to change linearly.
        self.position += self.ts * (self.phi[0] + y) / 2.0;
        push(&mut self.phi[..na], y);
    }

    fn known(&self) -> Option<KernelPlant<'_>> {
        let equations = Known::Lagged(self.form.as_ref()?, self.lags);
        Some(KernelPlant::new(equations, self.ts))
    }
}

fn push(newest_first: &mut [f64], value: f64) {
    newest_first.rotate_right(1);
    newest_first[0] = value;
}

/// A state-space model as a plant.
#[derive(Clone, Debug)]
pub struct StatePlant {
    stepper: Stepper,
    position: f64,
    ts: f64,
}

impl StatePlant {
    /// `model` at rest, after inputs of zero. `ts` \[s\] is the sample time it was identified at.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a model with several inputs or without delay, or an unusable sample time.
    pub fn new(model: &NeuralSS, ts: f64) -> Result<Self> {
        let inputs = model.shape().inputs;
        if inputs != 1 {
            return Err(Error::setting(format!(
                "expected a model with one input to close a loop around, got {inputs}; identify it from the command alone"
            )));
        }
        if !(ts > 0.0 && ts.is_finite()) {
            return Err(Error::setting(format!(
                "expected a sample time above 0, got {ts}"
            )));
        }
        // The stepper begins at the model's rest for input 0, which need not be output 0.
        Ok(Self {
            stepper: Stepper::new(model)?,
            position: 0.0,
            ts,
        })
    }
}

impl Plant for StatePlant {
    fn reset(&mut self) {
        self.stepper.reset();
        self.position = 0.0;
    }

    fn output(&self) -> f64 {
        self.stepper.output()
    }

    fn position(&self) -> f64 {
        self.position
    }

    fn advance(&mut self, u: f64) {
        let before = self.output();
        self.stepper.advance(&[u]);
        // Trapezoidal rule: between samples the output is taken to change linearly.
        self.position += self.ts * (before + self.output()) / 2.0;
    }
}

/// Longest extra delay of a [`Varied`] plant, in samples.
const LONGEST_DELAY: usize = 16;

/// Another plant with its gain scaled and its input delayed: a variation that a tuned controller must tolerate.
#[derive(Clone, Debug)]
pub struct Varied<P> {
    plant: P,
    gain: f64,
    delay: usize,
    pending: [f64; LONGEST_DELAY],
    next: usize,
}

impl<P: Plant> Varied<P> {
    /// `plant` with its output multiplied by `gain` and its input delayed by `delay` samples.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a gain that is not above 0 or a delay above 16 samples.
    pub fn new(plant: P, gain: f64, delay: usize) -> Result<Self> {
        if !(gain > 0.0 && gain.is_finite() && delay <= LONGEST_DELAY) {
            return Err(Error::setting(format!(
                "expected a gain above 0 and a delay of at most {LONGEST_DELAY} samples, got {gain} and {delay}; gains \
                 of 0.8 to 1.25 and delays of 0 to 2 ms are customary"
            )));
        }
        Ok(Self {
            plant,
            gain,
            delay,
            pending: [0.0; LONGEST_DELAY],
            next: 0,
        })
    }

    fn delayed(&mut self, u: f64) -> f64 {
        if self.delay == 0 {
            return u;
        }
        // A ring of `delay` entries: the entry read is `delay` samples old, and the newest takes its place.
        let due = std::mem::replace(&mut self.pending[self.next], u);
        self.next = (self.next + 1) % self.delay;
        due
    }
}

impl<P: Plant> Plant for Varied<P> {
    fn reset(&mut self) {
        self.plant.reset();
        self.pending.fill(0.0);
        self.next = 0;
    }

    fn output(&self) -> f64 {
        self.gain * self.plant.output()
    }

    fn position(&self) -> f64 {
        // The integral of the scaled output: an encoder counts what it would count on that machine.
        self.gain * self.plant.position()
    }

    fn advance(&mut self, u: f64) {
        let due = self.delayed(u);
        self.plant.advance(due);
    }

    fn encoder(&self) -> Option<&Encoder> {
        self.plant.encoder()
    }

    /// For nested variations, the product of the gains and the sum of the delays.
    fn known(&self) -> Option<KernelPlant<'_>> {
        let known = self.plant.known()?;
        Some(KernelPlant {
            // Passed on to the kernels, which apply it to all lanes: a search over variations is as fast as over one
            // plant.
            gain: self.gain * known.gain,
            delay: self.delay + known.delay,
            ..known
        })
    }
}
