//! A controller and a plant in closed loop, with encoder, feedback filter and limits. Begin reading at `Run::through`.

pub(crate) mod batch;
mod kernel_plant;
mod lead;
mod plants;

pub use kernel_plant::KernelPlant;
pub(crate) use kernel_plant::Known;
pub(crate) use lead::Lead;
pub use plants::{LaggedPlant, StatePlant, Varied};

use sewfast_control::{AnyController, Controller, PidController, Refused};

use crate::random::Random;
use crate::simd::{self, F64x8, Kernel};
use crate::speed::Encoder;
use crate::{Error, Monitor, Result};
use batch::{Controllers, InLanes, LaneController};
use kernel_plant::{AnyOrder, ScalarMotor, ScalarPlant, SecondOrder};

/// A plant that a controller can be closed around: one input, one output, stepped sample by sample.
pub trait Plant {
    /// Back to rest; position back to zero.
    fn reset(&mut self);
    /// The true output at this instant, in its unit.
    fn output(&self) -> f64;
    /// The integral of the output over time [unit s]: what an encoder sees.
    fn position(&self) -> f64;
    /// Holds `u` for one sample time.
    fn advance(&mut self, u: f64);
    /// The encoder that the plant brings along; `None` if it has none.
    fn encoder(&self) -> Option<&Encoder> {
        None
    }
    /// The plant as kernels know it; `None` if it can only step itself.
    fn known(&self) -> Option<KernelPlant<'_>> {
        None
    }
}

/// An encoder for plants that bring none: `floor(position * counts_per_unit + phase)`; `None` for 0 counts.
///
/// `counts_per_unit` is counts per output unit and second: 1572/60 for speed in RPM and 1,572 counts per turn.
///
/// # Errors
/// `ErrorKind::Setting` for counts that are negative or not finite, or a phase outside 0 to 1.
pub fn encoder(counts_per_unit: f64, phase: f64) -> Result<Option<Encoder>> {
    // Written so that NaN is refused.
    if !(counts_per_unit >= 0.0 && counts_per_unit.is_finite() && (0.0..1.0).contains(&phase)) {
        return Err(Error::setting(format!(
            "expected counts per unit of 0 or more and a phase from 0 to below 1, got {counts_per_unit} and {phase}; \
             give 0 counts for feedback without quantisation"
        )));
    }
    Ok((counts_per_unit > 0.0).then(|| Encoder::new(counts_per_unit, phase)))
}

/// Counts of the plant's encoder, else of the loop's, extrapolated by the time `since` at the present output; `None`
/// without an encoder.
#[inline(always)]
pub(crate) fn counts(
    plant: &(impl Plant + ?Sized),
    encoder: Option<&Encoder>,
    since: f64,
) -> Option<f64> {
    let encoder = plant.encoder().or(encoder)?;
    // With `since` = -Ts, before the first sample: the counter is assumed to have run at this output until now. The
    // first difference then gives the output's speed, not 0.
    let position = plant.position() + since * plant.output();
    Some(encoder.count(position))
}

/// The first measurement of a plant that has been reset.
fn first_measured(
    plant: &(impl Plant + ?Sized),
    encoder: Option<&Encoder>,
    signals: Signals<'_>,
) -> f64 {
    // at rest the counter has stood, and the speed from it is 0 as well
    let counted = plant.encoder().or(encoder).is_some();
    let y = if counted { 0.0 } else { plant.output() };
    signals.noise_at(0).map_or(y, |added| y + added)
}

/// Reference, feedforward, disturbance and measurement noise of a run, sample by sample.
#[derive(Clone, Copy, Debug)]
pub struct Signals<'a> {
    /// The output that is asked for \[y\].
    pub reference: &'a [f64],
    /// What the controller gets in its place \[y\]: the expected measurement, where a feedforward knows it.
    pub setpoint: Option<&'a [f64]>,
    /// A command added before the limits \[u\].
    pub feedforward: Option<&'a [f64]>,
    /// A command added after the limits, unseen by the controller \[u\].
    pub disturbance: Option<&'a [f64]>,
    /// Added to the measurement, so not part of the true output \[y\].
    pub noise: Option<&'a [f64]>,
}

impl<'a> Signals<'a> {
    /// A reference alone.
    pub fn new(reference: &'a [f64]) -> Self {
        Self {
            reference,
            setpoint: None,
            feedforward: None,
            disturbance: None,
            noise: None,
        }
    }

    /// # Errors
    /// `ErrorKind::Data` for signals that are empty, not finite or of different lengths.
    pub(crate) fn check(&self) -> Result<()> {
        check_reference(self.reference)?;
        let beside = [
            ("setpoint", self.setpoint),
            ("feedforward", self.feedforward),
            ("disturbance", self.disturbance),
            ("noise", self.noise),
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

    /// What the controller gets at sample `k`, of which the reference is `r`.
    #[inline(always)]
    fn setpoint_at(&self, k: usize, r: f64) -> f64 {
        self.setpoint.map_or(r, |given| at(given, k))
    }

    /// The command added at sample `k` before the limits.
    #[inline(always)]
    fn feedforward_at(&self, k: usize) -> Option<f64> {
        self.feedforward.map(|added| at(added, k))
    }

    /// The command added at sample `k` after the limits.
    #[inline(always)]
    fn disturbance_at(&self, k: usize) -> Option<f64> {
        self.disturbance.map(|added| at(added, k))
    }

    /// The noise added to the measurement of sample `k`.
    #[inline(always)]
    fn noise_at(&self, k: usize) -> Option<f64> {
        self.noise.map(|added| at(added, k))
    }
}

/// White noise of a given standard deviation; a seed gives the same numbers on every platform.
pub fn white_noise(deviation: f64, samples: usize, seed: u64) -> Vec<f64> {
    let mut random = Random::stream(seed, NOISE);
    (0..samples).map(|_| deviation * random.normal()).collect()
}

/// The stream from which noise is drawn: independent of the random numbers of the search.
const NOISE: u64 = 0x6e6f_6973_6531;

#[inline(always)]
fn at(signal: &[f64], k: usize) -> f64 {
    signal.get(k).copied().unwrap_or(0.0)
}

/// # Errors
/// `ErrorKind::Data` at the first value that is not finite.
fn check_finite(name: &str, signal: &[f64]) -> Result<()> {
    match signal.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(k) => Err(Error::data(format!(
            "expected finite values in the {name}, got {} at sample {k}; fill or cut it there",
            signal[k]
        ))),
    }
}

/// How a run ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outcome {
    /// The whole reference was run.
    #[default]
    Completed,
    /// The output was not finite, or beyond all bounds, at this sample; the record ends before it.
    Diverged(usize),
    /// A stop was requested; the record ends before this sample.
    Interrupted(usize),
}

/// No drive's output is that large in any unit.
// Not infinity: a loop that grows by 10 % a sample takes 7,000 samples to get there, and its squares overflow half way.
const RUNAWAY: f64 = 1e15;
/// Samples between two checks for a stop request: a few milliseconds of work.
const WATCHED: usize = 2048;

/// The record of a run; entry `k` is the sample `k`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Run {
    /// Command after the limits.
    pub u: Vec<f64>,
    /// True output.
    pub y: Vec<f64>,
    /// Measured output after the feedback filter.
    pub feedback: Vec<f64>,
    /// How the run ended.
    pub outcome: Outcome,
}

impl Run {
    /// An empty record with room for `samples`.
    pub fn with_capacity(samples: usize) -> Self {
        let room = || Vec::with_capacity(samples);
        Self {
            u: room(),
            y: room(),
            feedback: room(),
            outcome: Outcome::Completed,
        }
    }

    /// Runs the loop from rest over `reference` into this record and reuses its memory.
    ///
    /// The output is measured by the plant's encoder, else by `encoder`, else ideally. If kernels know the plant,
    /// `plant` and `controller` stay unchanged. Order within a sample: measure, filter, control, limit, apply.
    pub fn record(
        &mut self,
        plant: &mut (impl Plant + ?Sized),
        controller: &mut AnyController<f64>,
        reference: &[f64],
        encoder: Option<&Encoder>,
        monitor: &Monitor,
    ) {
        let signals = Signals::new(reference);
        self.record_with(plant, controller, signals, encoder, monitor);
    }

    /// [`record`](Self::record) with further signals beside the reference; a shorter signal continues with 0.
    ///
    /// A controller with feedforward gets the reference early by its preview; at the end the last value stays.
    pub fn record_with(
        &mut self,
        plant: &mut (impl Plant + ?Sized),
        controller: &mut AnyController<f64>,
        signals: Signals<'_>,
        encoder: Option<&Encoder>,
        monitor: &Monitor,
    ) {
        // The way of the reference through a feedforward depends on no later measurement: it is taken before the loop,
        // which then is that of a PID alone.
        if let Some(lead) = Lead::of(controller, signals, || {
            plant.reset();
            first_measured(plant, encoder, signals)
        }) {
            let (mut rest, signals) = (lead.rest.clone().into(), lead.signals(signals));
            return self.record_with(plant, &mut rest, signals, encoder, monitor);
        }
        match plant.known() {
            // The whole loop in one kernel: controller, encoder and plant are compiled for one processor, with no call
            // per sample.
            Some(known) => simd::run(ScalarLoop {
                run: self,
                known,
                controller,
                signals,
                encoder,
                monitor,
            }),
            // Plants that only step themselves (the virtual machine, a state-space model): this loop is compiled for
            // the baseline, and such a plant has kernels of its own inside.
            None => self.fill(plant, controller, signals, encoder, monitor),
        }
    }

    #[inline(always)]
    fn fill(
        &mut self,
        plant: &mut (impl Plant + ?Sized),
        controller: &mut impl LoopController,
        signals: Signals<'_>,
        encoder: Option<&Encoder>,
        monitor: &Monitor,
    ) {
        // All memory at once: a call that could grow a vector, even if it never happens, spills the registers at every
        // sample. Inlined into both callers: the kernel of `ScalarLoop`, which has that processor's registers, and the
        // path for plants that step themselves.
        let samples = signals.reference.len();
        self.u.resize(samples, 0.0);
        self.y.resize(samples, 0.0);
        self.feedback.resize(samples, 0.0);
        let (end, outcome) = self.through(plant, controller, signals, encoder, monitor);
        self.u.truncate(end);
        self.y.truncate(end);
        self.feedback.truncate(end);
        self.outcome = outcome;
    }

    /// Runs over the reference, for which the record has room; returns the number of samples run and how the run ended.
    #[inline(always)]
    fn through(
        &mut self,
        plant: &mut (impl Plant + ?Sized),
        controller: &mut impl LoopController,
        signals: Signals<'_>,
        encoder: Option<&Encoder>,
        monitor: &Monitor,
    ) -> (usize, Outcome) {
        let samples = signals.reference.len();
        // Slices of the loop's length: the compiler then knows that every k is in bounds.
        let commands = &mut self.u[..samples];
        let (outputs, feedback) = (&mut self.y[..samples], &mut self.feedback[..samples]);
        plant.reset();
        controller.reset();
        let ts = controller.ts();
        // The difference of the counts, divided by Ts and the counts per unit, is the mean speed over the last sample
        // time. An encoder gives no more.
        let scale = plant.encoder().or(encoder).map(Encoder::counts_per_unit);
        let per_speed = ts * scale.unwrap_or(1.0);
        let mut before = counts(plant, encoder, -ts);
        for (k, &r) in signals.reference.iter().enumerate() {
            let (y, now) = (plant.output(), counts(plant, encoder, 0.0));
            let measured = match (before, now) {
                (Some(before), Some(now)) => (now - before) / per_speed,
                _ => y,
            };
            let measured = signals
                .noise_at(k)
                .map_or(measured, |added| measured + added);
            // The count is kept, not the position: an encoder does not recover later what it has rounded off.
            before = now;
            // Written so that NaN ends the run. The measurement is tested too: with many counts per unit the counter
            // overflows before the output does.
            if !(y.abs() < RUNAWAY && measured.is_finite()) {
                return (k, Outcome::Diverged(k));
            }
            // A power of two makes the remainder a mask; a check is an atomic read.
            if k % WATCHED == 0 && monitor.stopped() {
                return (k, Outcome::Interrupted(k));
            }
            // The command is held until the next sample, so it acts on y(k+1) at the earliest: a plant has a delay of 1
            // or more.
            let r = signals.setpoint_at(k, r);
            let u = controller.decide(k == 0, r, measured, signals.feedforward_at(k));
            commands[k] = u;
            outputs[k] = y;
            feedback[k] = controller.filtered();
            // After the controller and its limits: neither the anti-windup nor the record sees the disturbance.
            plant.advance(signals.disturbance_at(k).map_or(u, |added| u + added));
        }
        (samples, Outcome::Completed)
    }

    /// The largest `|u|`; 0 for an empty record.
    pub fn largest_command(&self) -> f64 {
        self.u.iter().fold(0.0, |most, u| f64::max(most, u.abs()))
    }
}

// --- A loop that runs alone, in the arithmetic of a lane ---
//
// The controller is the lanes' own code with one number in place of eight ([`Constant`]): one law, one order of
// operations. It knows at compile time what the general controller has to test at every sample, and takes 43 ns instead
// of 53 (`closed_loop` of the kernels' example, Zen 4, 16 %; no gain with an encoder's moving average of 8). A
// schedule, and whatever else a lane cannot hold, uses the general controller.

/// What a loop asks of its controller.
trait LoopController {
    /// Back to the state before the first sample.
    fn reset(&mut self);
    /// Sample time \[s\].
    fn ts(&self) -> f64;
    /// From reference and measured output to the command.
    // The loop passes `first`: lanes keep no flag of their own, and the general controller does not need it.
    fn decide(&mut self, first: bool, r: f64, measured: f64, feedforward: Option<f64>) -> f64;
    /// The filtered feedback of the last sample.
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
        // Two calls, because adding 0 changes -0: -0 + 0 is 0. A lane without feedforward adds nothing either.
        match feedforward {
            None => self.step(r, measured),
            Some(added) => self.step_with(r, measured, added),
        }
    }

    fn filtered(&self) -> f64 {
        Controller::filtered(self)
    }
}

/// A controller with constant gains as a lane computes it: parts that it does not have are not computed, and all of it
/// is inlined into the caller.
struct Constant<'a> {
    // Kept for a reset: `numbers` holds the running states.
    controller: &'a PidController<f64>,
    numbers: Controllers<f64>,
}

impl<'a> Constant<'a> {
    #[inline(always)]
    fn new(controller: &'a PidController<f64>) -> Self {
        Self {
            controller,
            // One lane of one: `Arithmetic for f64` loads the first of the eight numbers, which are equal.
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
struct ScalarLoop<'a> {
    run: &'a mut Run,
    known: KernelPlant<'a>,
    controller: &'a AnyController<f64>,
    signals: Signals<'a>,
    encoder: Option<&'a Encoder>,
    monitor: &'a Monitor,
}

impl Kernel for ScalarLoop<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        let constant = self.controller.pid().filter(|pid| pid.fits(pid));
        let (form, lags) = match self.known.equations {
            Known::Lagged(form, lags) => (form, lags),
            Known::Motor(motor) => {
                let plant = ScalarMotor::<V>::new(self.known, motor);
                let mut controller = self.controller.clone();
                return match constant {
                    Some(pid) => self.around(plant, &mut Constant::new(pid)),
                    None => self.around(plant, &mut controller),
                };
            }
        };
        // All three branches give the same bits; the choice only changes the time (16 % and 6.7 %, see above and
        // `kernel_plant`).
        if let Some(pid) = constant {
            if SecondOrder::takes(&self.known) {
                let plant = ScalarPlant::<V, SecondOrder>::new(self.known, form, lags);
                self.around(plant, &mut Constant::new(pid));
            } else {
                let plant = ScalarPlant::<V, AnyOrder>::new(self.known, form, lags);
                self.around(plant, &mut Constant::new(pid));
            }
        } else {
            let plant = ScalarPlant::<V, AnyOrder>::new(self.known, form, lags);
            // A copy: the caller's controller stays unchanged, as does the plant.
            let mut controller = self.controller.clone();
            self.around(plant, &mut controller);
        }
    }
}

impl ScalarLoop<'_> {
    #[inline(always)]
    fn around(self, mut plant: impl Plant, controller: &mut impl LoopController) {
        // Compiled once per pair of plant and controller: `fill` is inlined with both, so parts that they do not have
        // cost nothing.
        let (signals, encoder) = (self.signals, self.encoder);
        self.run
            .fill(&mut plant, controller, signals, encoder, self.monitor);
    }
}

// --- Entries ---

/// Runs `controller` on `plant` over `reference`, from rest.
///
/// # Errors
/// As for [`closed_loop_with`].
pub fn closed_loop(
    plant: &mut (impl Plant + ?Sized),
    controller: &mut AnyController<f64>,
    reference: &[f64],
    encoder: Option<&Encoder>,
    monitor: &Monitor,
) -> Result<Run> {
    closed_loop_with(plant, controller, Signals::new(reference), encoder, monitor)
}

/// Runs `controller` on `plant` under `signals`, from rest.
///
/// # Errors
/// `ErrorKind::Data` for signals that are empty, not finite or of different lengths. A loop that diverges or is stopped
/// is an [`Outcome`], not an error.
pub fn closed_loop_with(
    plant: &mut (impl Plant + ?Sized),
    controller: &mut AnyController<f64>,
    signals: Signals<'_>,
    encoder: Option<&Encoder>,
    monitor: &Monitor,
) -> Result<Run> {
    signals.check()?;
    let mut run = Run::with_capacity(signals.reference.len());
    run.record_with(plant, controller, signals, encoder, monitor);
    Ok(run)
}

/// Refuses a reference that cannot be run.
///
/// # Errors
/// `ErrorKind::Data` for a reference that is empty or not finite.
pub fn check_reference(reference: &[f64]) -> Result<()> {
    if reference.is_empty() {
        return Err(Error::data(
            "expected a reference with samples, got an empty one",
        ));
    }
    check_finite("reference", reference)
}

impl From<Refused> for Error {
    fn from(refused: Refused) -> Self {
        Self::setting(format!("{refused}; change that setting"))
    }
}

#[cfg(test)]
mod tests;
