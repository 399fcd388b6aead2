//! A loop that runs alone, in the arithmetic of a lane.
//!
//! The controller is the lanes' own code with one number in place of eight ([`Constant`]): one law, one order of operations. It knows at
//! compile time what the general controller asks at every sample, and takes 43 ns where that takes 53 (`closed_loop` of the kernels' example,
//! Zen 4, 16 %; with an encoder's moving average of 8 it gains nothing). A schedule, or whatever else a lane cannot hold, goes through the
//! general controller.

use sewfast_control::{AnyController, Controller, PidController};

use super::batch::{Controllers, InLanes, LaneController};
use super::kernel_plant::{AnyOrder, KernelPlant, ScalarPlant, SecondOrder};
use super::{Plant, Run, Signals};
use crate::Monitor;
use crate::simd::{F64x8, Kernel};
use crate::speed::Encoder;

/// What a loop asks of its controller.
pub(super) trait LoopController {
    /// Back to the state before the first sample.
    fn reset(&mut self);
    /// Sample time \[s\].
    fn ts(&self) -> f64;
    /// From reference and measured output to the command.
    // `first` is the loop's to say: lanes keep no flag of their own, and the general controller does not need it.
    fn decide(&mut self, first: bool, r: f64, measured: f64, feedforward: Option<f64>) -> f64;
    /// The feedback after its filter, at the last sample.
    fn filtered(&self) -> f64;
}

impl LoopController for AnyController<f64> {
    fn reset(&mut self) {
        Controller::reset(self);
    }

    fn ts(&self) -> f64 {
        Controller::ts(self)
    }

    fn decide(&mut self, _first: bool, r: f64, measured: f64, feedforward: Option<f64>) -> f64 {
        // Two calls, as adding 0 is not nothing: -0 + 0 is 0, and a lane without feedforward adds none either.
        match feedforward {
            None => self.step(r, measured),
            Some(added) => self.step_with(r, measured, added),
        }
    }

    fn filtered(&self) -> f64 {
        Controller::filtered(self)
    }
}

/// A controller with constant gains as a lane computes it: what it does not have is not computed, and all of it is
/// compiled into its caller.
pub(super) struct Constant<'a> {
    // Kept for a reset: numbers under way are no settings.
    controller: &'a PidController<f64>,
    numbers: Controllers<f64>,
}

impl<'a> Constant<'a> {
    #[inline(always)]
    pub fn new(controller: &'a PidController<f64>) -> Self {
        Self {
            controller,
            // One lane of one: `Arithmetic for f64` loads the first of eight equal numbers.
            numbers: Controllers::new(&[controller]),
        }
    }
}

impl LoopController for Constant<'_> {
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
        self.numbers.take(first, measured);
        self.numbers.decide(first, r, feedforward)
    }

    #[inline(always)]
    fn filtered(&self) -> f64 {
        self.numbers.filtered
    }
}

/// A loop around a plant that kernels know: all of it is compiled for one processor.
pub(super) struct ScalarLoop<'a> {
    pub run: &'a mut Run,
    pub known: KernelPlant<'a>,
    pub controller: &'a AnyController<f64>,
    pub signals: Signals<'a>,
    pub encoder: Option<&'a Encoder>,
    pub monitor: &'a Monitor,
}

impl Kernel for ScalarLoop<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        // Three ways to the same bits, so that what is chosen shows in the time only (16 % and 6.7 %, see above and
        // `kernel_plant`).
        let constant = self.controller.pid().filter(|pid| pid.fits());
        if let Some(pid) = constant {
            if SecondOrder::takes(&self.known) {
                let plant = ScalarPlant::<V, SecondOrder>::new(self.known);
                self.around(plant, &mut Constant::new(pid));
            } else {
                let plant = ScalarPlant::<V, AnyOrder>::new(self.known);
                self.around(plant, &mut Constant::new(pid));
            }
        } else {
            let plant = ScalarPlant::<V, AnyOrder>::new(self.known);
            // A copy: the caller's controller stays as it was, as the plant does.
            let mut controller = self.controller.clone();
            self.around(plant, &mut controller);
        }
    }
}

impl ScalarLoop<'_> {
    #[inline(always)]
    fn around(self, mut plant: impl Plant, controller: &mut impl LoopController) {
        // Compiled once for each pair of plant and controller: `fill` is inlined with both, and what one of them does
        // not have leaves no trace.
        let (signals, encoder) = (self.signals, self.encoder);
        self.run
            .fill(&mut plant, controller, signals, encoder, self.monitor);
    }
}
