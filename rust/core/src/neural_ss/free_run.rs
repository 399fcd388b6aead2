//! Free runs in scaled units, one or two side by side; and the model stepped sample by sample for a closed loop.
//!
//! A run waits for its own last state: a tanh and two sums. A second run fits into the waiting times. Models of
//! up to four states and up to 16 hidden units step entirely in registers: at 2.5 GHz with AVX-512 one run
//! takes 47 ns a sample, the general step 50, and two side by side 63 (docs/PERFORMANCE.md).

use super::network::{Network, Scratch, copy, unrolled};
use super::shape::Scaling;
use super::{NeuralSS, state};
use crate::model::Model;
use crate::monitor::Limit;
use crate::simd::{self, F64x8, Kernel, Lanes};
use crate::{Error, Monitor, Result};

/// Samples between two checks of bound and limit.
// At this rate a diverged run costs at most 64 extra samples, and the check costs nothing.
const BLOCK: usize = 64;
/// Samples between two checks of the monitor.
const LOOK: usize = 64 * BLOCK;

/// The results of a simulation, sample by sample.
#[derive(Clone, Debug)]
pub(super) struct Trajectory {
    // Sample by sample, as the recursion of the sensitivities reads them: it has no tanh and no step of its own.
    pub states: Vec<f64>,
    pub hidden: Vec<Lanes>,
    /// Sums before the output function.
    pub sums: Vec<f64>,
}

impl Trajectory {
    pub fn new(network: &Network, samples: usize) -> Self {
        let nx = network.shape.nx;
        Self {
            states: vec![0.0; samples * nx],
            hidden: vec![Lanes::ZERO; samples * network.groups()],
            sums: vec![0.0; samples],
        }
    }
}

/// One network's run.
pub(super) struct Run<'a> {
    pub network: &'a Network,
    pub state: &'a [f64],
    /// Receives its results.
    pub run: &'a mut Trajectory,
    pub scratch: &'a mut Scratch,
    /// `None` if the run has already failed elsewhere.
    pub limit: Option<Limit>,
}

/// Free runs of networks of one shape over the same inputs, as a kernel.
pub(super) struct FreeRuns<'a, const RUNS: usize> {
    pub runs: [Run<'a>; RUNS],
    pub v: &'a [f64],
    /// Measured outputs, NaN if unknown; empty if nothing is measured.
    pub y: &'a [f64],
    /// A weight for each of them; empty if all count alike.
    pub weights: &'a [f64],
    /// Bound on the magnitude of every state.
    pub bound: f64,
    pub monitor: &'a Monitor,
}

impl<const RUNS: usize> FreeRuns<'_, RUNS> {
    /// Sums of squared errors, 0 without measured outputs; `None` if a run leaves the bound, is stopped, or can no
    /// longer stay below its limit.
    pub fn go(self) -> [Option<f64>; RUNS] {
        simd::run(self)
    }
}

/// A single run without measured outputs; false if its states are not finite or it is stopped.
pub(super) fn alone(
    network: &Network,
    v: &[f64],
    state: &[f64],
    run: &mut Trajectory,
    scratch: &mut Scratch,
    monitor: &Monitor,
) -> bool {
    let run = Run {
        network,
        state,
        run,
        scratch,
        limit: Some(Limit::NONE),
    };
    let runs = FreeRuns {
        runs: [run],
        v,
        y: &[],
        weights: &[],
        bound: f64::MAX,
        monitor,
    };
    runs.go()[0].is_some()
}

impl<const RUNS: usize> Kernel for FreeRuns<'_, RUNS> {
    type Output = [Option<f64>; RUNS];

    #[inline(always)]
    fn run<V: F64x8>(self) -> Self::Output {
        unrolled!(self.runs[0].network.shape.nx, self.samples::<V>)
    }
}

impl<const RUNS: usize> FreeRuns<'_, RUNS> {
    /// `NX` states; 0 for any number.
    #[inline(always)]
    fn samples<V: F64x8, const NX: usize>(mut self) -> [Option<f64>; RUNS] {
        let inputs = self.runs[0].network.shape.inputs;
        let samples = self.v.len() / inputs;
        let mut sums = [0.0; RUNS];
        for run in &mut self.runs {
            // The state of the next sample is in `next`, before the first sample as after every other.
            run.scratch.next.copy_from_slice(run.state);
        }
        for start in (0..samples).step_by(BLOCK) {
            // 4,096 samples, some tenths of a millisecond.
            if start % LOOK == 0 && self.monitor.stopped() {
                return [None; RUNS];
            }
            let end = samples.min(start + BLOCK);
            let v = &self.v[start * inputs..end * inputs];
            // All together, or a single one if the other has failed. A limit of `None` marks a failed run.
            if self.runs.iter().all(|run| run.limit.is_some()) {
                advance::<V, NX, RUNS>(&mut self.runs, start, v, inputs);
            } else if let Some(run) = self.runs.iter_mut().find(|run| run.limit.is_some()) {
                advance::<V, NX, 1>(std::array::from_mut(run), start, v, inputs);
            } else {
                break;
            }
            for (run, sum) in self.runs.iter_mut().zip(&mut sums) {
                run.conclude(start, end, (self.y, self.weights), sum, self.bound);
            }
        }
        let mut reached = [None; RUNS];
        for (reached, (run, sum)) in reached.iter_mut().zip(self.runs.iter().zip(sums)) {
            // Without a limit an overflowed sum does not end the run, but it is no cost.
            *reached = run.limit.map(|_| sum).filter(|sum| sum.is_finite());
        }
        reached
    }
}

/// A block of all runs.
#[inline(always)]
fn advance<V: F64x8, const NX: usize, const RUNS: usize>(
    runs: &mut [Run; RUNS],
    start: usize,
    v: &[f64],
    inputs: usize,
) {
    let network = runs[0].network;
    // More groups fill the waiting times themselves, and their hidden outputs do not fit into registers beside the
    // loads of the weights.
    match (NX, network.groups()) {
        (1.., 1) => together::<V, NX, 1, RUNS>(runs, start, v, inputs),
        (1.., 2) => together::<V, NX, 2, RUNS>(runs, start, v, inputs),
        _ => {
            for (k, v) in v.chunks_exact(inputs).enumerate() {
                // In turn, sample by sample, so that two runs overlap here, too.
                for run in &mut *runs {
                    run.step::<V, NX>(start + k, v);
                }
            }
        }
    }
}

/// A block of models of `NX` states and `GROUPS` groups of hidden units, side by side.
#[inline(always)]
fn together<V: F64x8, const NX: usize, const GROUPS: usize, const RUNS: usize>(
    runs: &mut [Run; RUNS],
    start: usize,
    v: &[f64],
    inputs: usize,
) {
    // States as scalars: each is broadcast for the next argument, and sums over lanes give scalars.
    let mut x = [[0.0; NX]; RUNS];
    for (x, run) in x.iter_mut().zip(&*runs) {
        x.copy_from_slice(&run.scratch.next);
    }
    for (k, v) in v.chunks_exact(inputs).enumerate() {
        for r in 0..RUNS {
            let Run { network, run, .. } = &mut runs[r];
            // Slices of known length: only the sample's index is checked.
            let (states, _) = run.states.as_chunks_mut();
            let (hidden, _) = run.hidden.as_chunks_mut();
            states[start + k] = x[r];
            run.sums[start + k] =
                network.step_small::<V, NX, GROUPS>(&mut x[r], v, &mut hidden[start + k]);
        }
    }
    for (x, run) in x.iter().zip(runs) {
        run.scratch.next.copy_from_slice(x);
    }
}

impl Run<'_> {
    /// Sample `k`.
    #[inline(always)]
    fn step<V: F64x8, const NX: usize>(&mut self, k: usize, v: &[f64]) {
        let nx = if NX == 0 { self.network.shape.nx } else { NX };
        let (groups, scratch) = (self.network.groups(), &mut *self.scratch);
        let x = &mut self.run.states[k * nx..][..nx];
        let h = &mut self.run.hidden[k * groups..][..groups];
        // Stored before the step: the trajectory has the state to which a sample's output belongs.
        copy(x, &scratch.next[..nx]);
        scratch.set(x, v);
        let (arguments, next) = (&scratch.arguments, &mut scratch.next);
        self.run.sums[k] = self.network.step::<V, NX>(arguments, h, next);
    }

    /// Measures a block: adds its squared errors, and ends the run if it cannot win any more.
    fn conclude(
        &mut self,
        start: usize,
        end: usize,
        (y, weights): (&[f64], &[f64]),
        sum: &mut f64,
        bound: f64,
    ) {
        let Some(limit) = self.limit else { return };
        let (nx, output) = (self.network.shape.nx, self.network.output);
        if let Some(y) = y.get(start..end) {
            // One sum in the order of the samples: after the run, off its chain, over numbers in the cache.
            let pairs = self.run.sums[start..end].iter().zip(y);
            match weights.get(start..end) {
                None => {
                    for (s, y) in pairs.filter(|(_, y)| !y.is_nan()) {
                        *sum += (y - output.value(*s)).powi(2);
                    }
                }
                Some(weights) => {
                    for ((s, y), w) in pairs.zip(weights).filter(|((_, y), _)| !y.is_nan()) {
                        *sum += w * (y - output.value(*s)).powi(2);
                    }
                }
            }
        }
        let states = &self.run.states[start * nx..end * nx];
        // NaN is not within the bound either. Every state is tested, not only the output: a state can grow unseen until
        // the output is lost.
        let sound = states
            .iter()
            .fold(true, |sound, x| sound & (x.abs() <= bound));
        // A sum of squares only grows, so a partial one decides.
        if !sound || limit.is_reached(*sum) {
            self.limit = None;
        }
    }
}

/// The model stepped sample by sample, for a closed loop.
#[derive(Clone, Debug)]
pub struct Stepper {
    network: Network,
    scaling: Scaling,
    rest: Vec<f64>,
    scratch: Scratch,
    /// Inputs that have not acted yet, the oldest at `oldest`: nk rows.
    // A ring of nk rows in scaled units: an input comes out nk samples later.
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
        // Without delay the output of a sample would depend on the input decided from it.
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

    /// Back to rest, after inputs of zero.
    pub fn reset(&mut self) {
        let inputs = self.network.shape.inputs;
        for (i, waiting) in self.waiting.iter_mut().enumerate() {
            *waiting = self.scaling.input(i % inputs, 0.0);
        }
        self.oldest = 0;
        self.scratch.next.copy_from_slice(&self.rest);
        // One step ahead: the sum of sample 0 is needed before its input is known.
        self.advance_state();
    }

    /// The output at this sample, in the data's unit.
    pub fn output(&self) -> f64 {
        let scaled = self.network.output.value(self.scratch.sum);
        self.scaling.restored(scaled)
    }

    /// Holds the inputs for one sample time and advances to the next sample.
    pub fn advance(&mut self, u: &[f64]) {
        let inputs = self.network.shape.inputs;
        let place = &mut self.waiting[self.oldest * inputs..][..inputs];
        for (j, (waiting, u)) in place.iter_mut().zip(u).enumerate() {
            *waiting = self.scaling.input(j, *u);
        }
        // The entry after the newest is the oldest.
        self.oldest = (self.oldest + 1) % self.network.shape.nk;
        self.advance_state();
    }

    fn advance_state(&mut self) {
        let inputs = self.network.shape.inputs;
        // The oldest pending input acts now: it advances the state, and the output of the sample follows.
        let v = &self.waiting[self.oldest * inputs..][..inputs];
        simd::run(state::Next {
            network: &self.network,
            scratch: &mut self.scratch,
            v,
        });
    }
}

#[cfg(test)]
mod tests;
