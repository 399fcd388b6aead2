//! The model's free run as a least-squares problem.

use std::cell::RefCell;

use super::network::{Network, Scratch, copy, unrolled};
use super::sensitivities::{Columns, Recursion, Sensitivities};
use super::shape::Shape;
use crate::Monitor;
use crate::gram::Gram;
use crate::lm::Problem;
use crate::simd::{self, Eight, Group, Kernel};

/// A state beyond this many of its standard deviations has diverged.
const DIVERGED: f64 = 1e3;
/// Samples between two looks at the monitor.
const LOOK: usize = 4096;

/// One experiment in scaled units.
#[derive(Clone, Debug)]
pub(super) struct Experiment {
    /// Inputs, delayed by nk.
    pub v: Vec<f64>,
    /// Outputs, NaN where not known.
    pub y: Vec<f64>,
}

/// What a simulation leaves behind, sample by sample.
#[derive(Clone, Debug)]
pub(super) struct Trajectory {
    pub states: Vec<f64>,
    pub hidden: Vec<Group>,
    /// Sums before the output function.
    pub sums: Vec<f64>,
}

impl Trajectory {
    pub fn new(network: &Network, samples: usize) -> Self {
        let Shape { nx, outputs, .. } = network.shape;
        Self {
            states: vec![0.0; samples * nx],
            hidden: vec![Group::ZERO; samples * network.groups()],
            sums: vec![0.0; samples * outputs],
        }
    }
}

/// A free run as a kernel; `None` where it leaves the bound or is stopped.
pub(super) struct FreeRun<'a> {
    pub network: &'a Network,
    pub v: &'a [f64],
    pub state: &'a [f64],
    pub run: &'a mut Trajectory,
    pub scratch: &'a mut Scratch,
    /// No state may be larger.
    pub bound: f64,
    pub monitor: &'a Monitor,
}

impl Kernel for FreeRun<'_> {
    type Output = Option<()>;

    #[inline(always)]
    fn run<V: Eight>(self) -> Option<()> {
        unrolled!(self.network.shape.nx, self.samples::<V>)
    }
}

impl FreeRun<'_> {
    /// `NX` states; 0 stands for any number.
    #[inline(always)]
    fn samples<V: Eight, const NX: usize>(self) -> Option<()> {
        let Self {
            network,
            v,
            state,
            run,
            scratch,
            bound,
            monitor,
        } = self;
        let Shape {
            inputs, outputs, ..
        } = network.shape;
        let nx = if NX == 0 { network.shape.nx } else { NX };
        scratch.next.copy_from_slice(state);
        let kept = run
            .states
            .chunks_exact_mut(nx)
            .zip(run.hidden.chunks_exact_mut(network.groups()))
            .zip(run.sums.chunks_exact_mut(outputs));
        for (k, (v, ((x, h), s))) in v.chunks_exact(inputs).zip(kept).enumerate() {
            // NaN is no number within the bound either.
            let sound = scratch.next[..nx].iter().all(|x| x.abs() <= bound);
            if !sound || (k % LOOK == 0 && monitor.stopped()) {
                return None;
            }
            copy(x, &scratch.next[..nx]);
            scratch.set(x, v);
            network.step::<V, NX>(&scratch.arguments, h, &mut scratch.next, s);
        }
        Some(())
    }
}

/// The weight decay of each parameter.
#[derive(Clone, Debug)]
pub(super) struct Decay(Vec<f64>);

impl Decay {
    /// `decay/2 (|E|^2 + |Wx|^2 + |Wu|^2 + |G|^2 + .1 |bh|^2)`: the part of the cost that is not the squared error.
    pub fn penalty(&self, theta: &[f64]) -> f64 {
        let weighted = self.0.iter().zip(theta).map(|(decay, t)| decay * t * t);
        0.5 * weighted.sum::<f64>()
    }
}

/// Parameters: theta, then the initial state of each experiment.
pub(super) struct Training<'a> {
    experiments: &'a [Experiment],
    monitor: &'a Monitor,
    pub network: Network,
    pub decay: Decay,
    /// Known outputs.
    samples: f64,
    /// The last simulation, which others may look at between two calls.
    runs: &'a RefCell<Vec<Trajectory>>,
    gram: Gram,
    columns: Vec<usize>,
    buffers: Sensitivities,
    scratch: Scratch,
    held: Vec<(usize, f64)>,
}

impl<'a> Training<'a> {
    pub fn new(
        experiments: &'a [Experiment],
        network: Network,
        decay: f64,
        runs: &'a RefCell<Vec<Trajectory>>,
        monitor: &'a Monitor,
    ) -> Self {
        let shape = network.shape;
        let columns = Columns::new(shape);
        let known = experiments
            .iter()
            .flat_map(|e| &e.y)
            .filter(|y| !y.is_nan());
        Self {
            experiments,
            monitor,
            decay: Decay(
                (0..shape.parameters())
                    .map(|i| decay * shape.decay(i))
                    .collect(),
            ),
            samples: known.count() as f64,
            runs,
            gram: Gram::new(columns.room, 0),
            columns: columns.of_theta(),
            buffers: Sensitivities::new(shape),
            scratch: Scratch::new(shape),
            held: shape.held(),
            network,
        }
    }

    fn shape(&self) -> Shape {
        self.network.shape
    }

    /// Runs once more at parameters that have run before, whatever the monitor says.
    pub fn rerun(&mut self, theta: &[f64]) -> Option<()> {
        self.network.load(&theta[..self.columns.len()]);
        let free = Monitor::default();
        (0..self.experiments.len()).try_for_each(|i| self.simulate(theta, i, &free).map(drop))
    }

    /// Sum of squared errors of the free run, which is stored.
    fn simulate(&mut self, theta: &[f64], experiment: usize, monitor: &Monitor) -> Option<f64> {
        let nx = self.shape().nx;
        let data = &self.experiments[experiment];
        let run = &mut self.runs.borrow_mut()[experiment];
        simd::run(FreeRun {
            network: &self.network,
            v: &data.v,
            state: &theta[self.columns.len() + experiment * nx..][..nx],
            run,
            scratch: &mut self.scratch,
            bound: DIVERGED,
            monitor,
        })?;
        let output = self.network.output;
        let known = run.sums.iter().zip(&data.y).filter(|(_, y)| !y.is_nan());
        let sum: f64 = known.map(|(s, y)| (y - output.value(*s)).powi(2)).sum();
        sum.is_finite().then_some(sum)
    }

    /// Adds the experiment's sums to the system.
    fn scatter(&mut self, experiment: usize, jtj: &mut [f64], jte: &mut [f64]) {
        let (n, own, nx) = (jte.len(), self.columns.len(), self.shape().nx);
        let at = Columns::new(self.shape());
        let column = |i: usize| {
            if i < own {
                self.columns[i]
            } else {
                at.state + i - own
            }
        };
        let place = |i: usize| if i < own { i } else { i + experiment * nx };
        let (sums, width) = self.gram.finish();
        let scale = 1.0 / self.samples;
        for i in 0..own + nx {
            let a = column(i);
            jte[place(i)] += sums[at.error * width + a] * scale;
            let row = &mut jtj[place(i) * n..][..n];
            for j in 0..=i {
                let b = column(j);
                row[place(j)] += sums[a.max(b) * width + a.min(b)] * scale;
            }
        }
    }

    /// Held parameters are taken out of the system: their step is zero.
    fn hold(&self, jtj: &mut [f64], jte: &mut [f64]) {
        let n = jte.len();
        for &(i, _) in &self.held {
            jte[i] = 0.0;
            for j in 0..n {
                jtj[i * n + j] = 0.0;
                jtj[j * n + i] = 0.0;
            }
            jtj[i * n + i] = 1.0;
        }
    }
}

impl Problem for Training<'_> {
    fn parameters(&self) -> usize {
        self.columns.len() + self.experiments.len() * self.shape().nx
    }

    fn cost(&mut self, theta: &[f64]) -> Option<f64> {
        self.network.load(&theta[..self.columns.len()]);
        let mut sum = 0.0;
        for experiment in 0..self.experiments.len() {
            sum += self.simulate(theta, experiment, self.monitor)?;
        }
        Some(0.5 * sum / self.samples + self.decay.penalty(theta))
    }

    fn normal_equations(&mut self, theta: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
        let (own, n) = (self.columns.len(), theta.len());
        self.network.load(&theta[..own]);
        jtj.fill(0.0);
        jte.fill(0.0);
        for (i, data) in self.experiments.iter().enumerate() {
            self.gram.clear();
            simd::run(Recursion {
                network: &self.network,
                run: &self.runs.borrow()[i],
                v: &data.v,
                y: &data.y,
                buffers: &mut self.buffers,
                rows: &mut self.gram,
                exact: false,
                monitor: self.monitor,
            });
            self.scatter(i, jtj, jte);
        }
        for (i, (t, decay)) in theta.iter().zip(&self.decay.0).enumerate() {
            jtj[i * n + i] += decay;
            jte[i] -= decay * t;
        }
        self.hold(jtj, jte);
    }
}
