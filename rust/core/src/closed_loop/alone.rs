//! A loop that runs alone, in the arithmetic of a lane.
//!
//! The controller is the lanes' own code with one number in place of eight ([`Constant`]): one law, one order of operations. It knows at
//! compile time what the general controller asks at every sample, and takes 43 ns where that takes 53 (`closed_loop` of the kernels' example,
//! Zen 4, 16 %; with an encoder's moving average of 8 it gains nothing). A schedule, or whatever else a lane cannot hold, goes through the
//! general controller.

use sewfast_control::Controller;

use super::lanes::Controllers;

/// What a loop asks of its controller.
pub(super) trait Decides {
    /// Back to the state before the first sample.
    fn reset(&mut self);
    /// Sample time \[s\].
    fn ts(&self) -> f64;
    /// From reference and measured output to the command.
    fn decide(&mut self, first: bool, r: f64, measured: f64, feedforward: Option<f64>) -> f64;
    /// The feedback after its filter, at the last sample.
    fn filtered(&self) -> f64;
}

impl Decides for Controller<f64> {
    fn reset(&mut self) {
        self.reset();
    }

    fn ts(&self) -> f64 {
        self.settings().ts
    }

    fn decide(&mut self, _first: bool, r: f64, measured: f64, feedforward: Option<f64>) -> f64 {
        match feedforward {
            None => self.step(r, measured),
            Some(added) => self.step_with(r, measured, added),
        }
    }

    fn filtered(&self) -> f64 {
        self.filtered()
    }
}

/// A controller with constant gains as a lane computes it: what it does not have is not computed, and all of it is
/// compiled into its caller.
pub(super) struct Constant<'a> {
    controller: &'a Controller<f64>,
    numbers: Controllers<f64>,
}

impl<'a> Constant<'a> {
    #[inline(always)]
    pub fn new(controller: &'a Controller<f64>) -> Self {
        Self {
            controller,
            numbers: Controllers::new(&[controller]),
        }
    }
}

impl Decides for Constant<'_> {
    #[inline(always)]
    fn reset(&mut self) {
        self.numbers = Controllers::new(&[self.controller]);
    }

    #[inline(always)]
    fn ts(&self) -> f64 {
        self.controller.settings().ts
    }

    #[inline(always)]
    fn decide(&mut self, first: bool, r: f64, measured: f64, feedforward: Option<f64>) -> f64 {
        self.numbers.step(first, r, measured, feedforward)
    }

    #[inline(always)]
    fn filtered(&self) -> f64 {
        self.numbers.filtered
    }
}
