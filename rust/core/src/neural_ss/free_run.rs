//! Free runs in scaled units, one or two side by side, and the model sample by sample for a loop that is closed around it.
//!
//! A run waits for its own last state: a tanh and two sums. A second one fits into the waiting. Models of one output, up to four states and
//! up to 16 hidden units step without leaving the registers: at 2.5 GHz with AVX-512 one run takes 47 ns a sample, by the general step
//! 50, and two side by side 63 (docs/PERFORMANCE.md).

use super::network::{Network, Scratch, copy, unrolled};
use super::shape::{Scaling, Shape};
use super::{NeuralSS, state};
use crate::monitor::Limit;
use crate::simd::{self, F64x8, Kernel, Lanes};
use crate::{Error, Monitor, Result};

/// Samples between two looks at bound and limit.
// Looked at that often, a run that has diverged costs 64 samples more, and the look nothing.
const BLOCK: usize = 64;
/// Samples between two looks at the monitor.
const LOOK: usize = 64 * BLOCK;

/// What a simulation leaves behind, sample by sample.
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
        let Shape { nx, outputs, .. } = network.shape;
        Self {
            states: vec![0.0; samples * nx],
            hidden: vec![Lanes::ZERO; samples * network.groups()],
            sums: vec![0.0; samples * outputs],
        }
    }
}

/// One network's run.
pub(super) struct Run<'a> {
    pub network: &'a Network,
    pub state: &'a [f64],
    /// What it leaves behind.
    pub run: &'a mut Trajectory,
    pub scratch: &'a mut Scratch,
    /// None where it has already failed elsewhere.
    pub limit: Option<Limit>,
}

/// Free runs of networks of one shape over the same inputs, as a kernel.
pub(super) struct FreeRuns<'a, const RUNS: usize> {
    pub runs: [Run<'a>; RUNS],
    pub v: &'a [f64],
    /// Measured outputs, NaN where not known; empty where nothing is measured.
    pub y: &'a [f64],
    /// A weight for each of them; none where all count alike.
    pub weights: &'a [f64],
    /// No state may be larger.
    pub bound: f64,
    pub monitor: &'a Monitor,
}

impl<const RUNS: usize> FreeRuns<'_, RUNS> {
    /// Sums of squared errors, 0 without a measure; none where a run leaves the bound, is stopped, or can no longer
    /// stay below its limit.
    pub fn go(self) -> [Option<f64>; RUNS] {
        simd::run(self)
    }
}

/// A run by itself, of which nothing is asked but finite states; false where they are not, or it is stopped.
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
    /// `NX` states; 0 stands for any number.
    #[inline(always)]
    fn samples<V: F64x8, const NX: usize>(mut self) -> [Option<f64>; RUNS] {
        let inputs = self.runs[0].network.shape.inputs;
        let samples = self.v.len() / inputs;
        let mut sums = [0.0; RUNS];
        for run in &mut self.runs {
            // The state of the sample to come stands in `next`, before the first as behind every other.
            run.scratch.next.copy_from_slice(run.state);
        }
        for start in (0..samples).step_by(BLOCK) {
            // 4,096 samples, some tenth of a millisecond.
            if start % LOOK == 0 && self.monitor.stopped() {
                return [None; RUNS];
            }
            let end = samples.min(start + BLOCK);
            let v = &self.v[start * inputs..end * inputs];
            // All together, or one alone: of two, one can have failed. A limit that is None marks it.
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
            // A sum that overflowed, where no limit was set to end it, is no cost.
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
    // More groups fill the waiting by themselves, and their hidden outputs do not fit into registers beside the weights'
    // loads.
    match (NX, network.shape.outputs, network.groups()) {
        (1.., 1, 1) => together::<V, NX, 1, RUNS>(runs, start, v, inputs),
        (1.., 1, 2) => together::<V, NX, 2, RUNS>(runs, start, v, inputs),
        _ => {
            for (k, v) in v.chunks_exact(inputs).enumerate() {
                // Sample by sample in turn, so that two runs overlap here, too.
                for run in &mut *runs {
                    run.step::<V, NX>(start + k, v);
                }
            }
        }
    }
}

/// A block of models of one output, `NX` states and `GROUPS` groups of hidden units, side by side.
#[inline(always)]
fn together<V: F64x8, const NX: usize, const GROUPS: usize, const RUNS: usize>(
    runs: &mut [Run; RUNS],
    start: usize,
    v: &[f64],
    inputs: usize,
) {
    // States as scalars: each is spread over the lanes for the next argument, and sums of lanes give scalars.
    let mut x = [[0.0; NX]; RUNS];
    for (x, run) in x.iter_mut().zip(&*runs) {
        x.copy_from_slice(&run.scratch.next);
    }
    for (k, v) in v.chunks_exact(inputs).enumerate() {
        for r in 0..RUNS {
            let Run { network, run, .. } = &mut runs[r];
            // Places of known length: no index is checked but the sample's.
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
        let Shape { nx, outputs, .. } = self.network.shape;
        let nx = if NX == 0 { nx } else { NX };
        let (groups, scratch) = (self.network.groups(), &mut *self.scratch);
        let x = &mut self.run.states[k * nx..][..nx];
        let h = &mut self.run.hidden[k * groups..][..groups];
        let s = &mut self.run.sums[k * outputs..][..outputs];
        // Kept before it is stepped: the trajectory has the state that a sample's output belongs to.
        copy(x, &scratch.next[..nx]);
        scratch.set(x, v);
        self.network
            .step::<V, NX>(&scratch.arguments, h, &mut scratch.next, s);
    }

    /// Measures a block: adds its squared errors, and ends the run where it cannot win.
    fn conclude(
        &mut self,
        start: usize,
        end: usize,
        (y, weights): (&[f64], &[f64]),
        sum: &mut f64,
        bound: f64,
    ) {
        let Some(limit) = self.limit else { return };
        let Shape { nx, outputs, .. } = self.network.shape;
        let output = self.network.output;
        let (first, behind) = (start * outputs, end * outputs);
        if let Some(y) = y.get(first..behind) {
            // One sum in the order of the samples: behind the run and off its chain, over numbers that are in the cache.
            let pairs = self.run.sums[first..behind].iter().zip(y);
            match weights.get(first..behind) {
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
        // NaN is no number within the bound either.
        // Any state beyond the bound, not the output alone: a state can grow unseen until the output is lost.
        let sound = states
            .iter()
            .fold(true, |sound, x| sound & (x.abs() <= bound));
        // A sum of squares only grows, so that a partial one decides.
        if !sound || limit.is_reached(*sum) {
            self.limit = None;
        }
    }
}

/// The model from sample to sample, for a loop that is closed around it.
#[derive(Clone, Debug)]
pub struct Stepper {
    network: Network,
    scaling: Scaling,
    rest: Vec<f64>,
    scratch: Scratch,
    /// Inputs that are still to act, the oldest at `oldest`: nk rows.
    // A ring of nk rows in scaled units: what is put in comes out nk samples later.
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
        // Without delay the output of a sample would need the input that is decided from it.
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
        // One step ahead: the sums of sample 0 are wanted before its input is.
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
        // The place behind the newest is the oldest.
        self.oldest = (self.oldest + 1) % self.network.shape.nk;
        self.advance_state();
    }

    fn advance_state(&mut self) {
        let inputs = self.network.shape.inputs;
        // With the oldest of the inputs that wait: the state goes on by it, and the output of the sample follows.
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
