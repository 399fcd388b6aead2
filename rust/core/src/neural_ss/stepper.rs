//! The model one sample at a time.

use super::network::{Network, Scratch};
use super::scaling::Scaling;
use super::{NeuralSS, state};
use crate::{Error, Result, simd};

/// The model from sample to sample, for a loop that is closed around it.
#[derive(Clone, Debug)]
pub struct Stepper {
    network: Network,
    scaling: Scaling,
    rest: Vec<f64>,
    scratch: Scratch,
    /// Inputs that are still to act, the oldest at `oldest`: nk rows.
    waiting: Vec<f64>,
    oldest: usize,
}

impl Stepper {
    /// `model` at rest.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a model without delay.
    pub fn new(model: &NeuralSS) -> Result<Self> {
        let shape = model.shape();
        if shape.nk == 0 {
            return Err(Error::setting(
                "expected a model with a delay nk of 1 or more, got 0: the command is decided after the output is \
                 measured; identify it again with nk = 1",
            ));
        }
        let mut stepper = Self {
            network: model.network.clone(),
            scaling: model.scaling.clone(),
            rest: model.rest_state(),
            scratch: Scratch::new(shape),
            waiting: vec![0.0; shape.nk * shape.inputs],
            oldest: 0,
        };
        stepper.reset();
        Ok(stepper)
    }

    /// Back to rest, with inputs of zero before.
    pub fn reset(&mut self) {
        let inputs = self.network.shape.inputs;
        for (i, waiting) in self.waiting.iter_mut().enumerate() {
            *waiting = self.scaling.input(i % inputs, 0.0);
        }
        self.oldest = 0;
        self.scratch.next.copy_from_slice(&self.rest);
        self.advance_state();
    }

    /// Output `p` at this sample, in the data's unit.
    pub fn output(&self, p: usize) -> f64 {
        let scaled = self.network.output.value(self.scratch.sums[p]);
        self.scaling.restored(p, scaled)
    }

    /// Holds the inputs for one sample time, which brings the next sample.
    pub fn advance(&mut self, u: &[f64]) {
        let inputs = self.network.shape.inputs;
        let place = &mut self.waiting[self.oldest * inputs..][..inputs];
        for (j, (waiting, u)) in place.iter_mut().zip(u).enumerate() {
            *waiting = self.scaling.input(j, *u);
        }
        self.oldest = (self.oldest + 1) % self.network.shape.nk;
        self.advance_state();
    }

    fn advance_state(&mut self) {
        let inputs = self.network.shape.inputs;
        let v = &self.waiting[self.oldest * inputs..][..inputs];
        simd::run(state::Next {
            network: &self.network,
            scratch: &mut self.scratch,
            v,
        });
    }
}
