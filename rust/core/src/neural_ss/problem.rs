//! The model's free run as a least-squares problem.

use std::cell::{Ref, RefCell};

use super::free_run::{FreeRuns, Run, Trajectory};
use super::network::{Network, Scratch};
use super::sensitivities::{Columns, Recursion, Sensitivities};
use super::shape::Shape;
use super::single::MOST_STATES;
use crate::Monitor;
use crate::data::total_weight;
use crate::gram::Gram;
use crate::lm::Problem;
use crate::monitor::Limit;
use crate::simd::{self, Lanes};

/// A state beyond this many of its standard deviations has diverged.
// States are scaled to unit variance on the training inputs.
const DIVERGED: f64 = 1e3;

/// One experiment in scaled units.
#[derive(Clone, Debug)]
pub(super) struct Experiment {
    /// Inputs, delayed by nk.
    // Sample by sample, inputs side by side; y and its weights likewise, so an index is a sample.
    pub v: Vec<f64>,
    /// Outputs, NaN if unknown.
    pub y: Vec<f64>,
    /// A weight for each output; empty if all count alike.
    pub weights: Vec<f64>,
}

impl Experiment {
    /// The weight of output `i`.
    pub fn weight(&self, i: usize) -> f64 {
        self.weights.get(i).copied().unwrap_or(1.0)
    }
}

/// Simulations at one point, with the data that the normal equations need.
#[derive(Debug)]
struct Attempt {
    // By it the normal equations find the accepted trial, if two were simulated.
    theta: Vec<f64>,
    network: Network,
    scratch: Scratch,
    runs: Vec<Trajectory>,
}

/// The last simulations: one or, if two at once pay, two. Others may read them between two calls.
#[derive(Debug)]
// In a cell: the minimiser holds the problem while its caller (`Referee`) is told of an accepted step and reads that
// step's runs, without simulating them again.
pub(super) struct Attempts(RefCell<Vec<Attempt>>);

impl Attempts {
    pub fn new(network: &Network, experiments: &[Experiment]) -> Self {
        let runs = |e: &Experiment| Trajectory::new(network, e.y.len());
        let attempt = || Attempt {
            theta: Vec::new(),
            network: network.clone(),
            scratch: Scratch::new(network.shape),
            runs: experiments.iter().map(runs).collect(),
        };
        let count = if pays(network, experiments) { 2 } else { 1 };
        Self(RefCell::new((0..count).map(|_| attempt()).collect()))
    }

    /// The runs at these parameters, experiment by experiment; they must be among the last simulations.
    pub fn at(&self, theta: &[f64]) -> Ref<'_, [Trajectory]> {
        Ref::map(self.0.borrow(), |attempts| {
            // By value: bitwise equal parameters have equal runs.
            let same = attempts.iter().find(|attempt| attempt.theta == theta);
            same.unwrap_or(&attempts[0]).runs.as_slice()
        })
    }

    fn are_two(&self) -> bool {
        self.0.borrow().len() == 2
    }
}

/// Most bytes for which a second run is worth its memory.
const MOST_TOGETHER: usize = 1 << 30;
/// Most groups of hidden units with which a run leaves room for a second one: more fill the waiting times themselves.
const MOST_GROUPS: usize = 2;

/// Whether a second run beside the first takes hardly any extra time. That needs the widest registers; with narrower
/// ones it is no faster than one run after the other.
fn pays(network: &Network, experiments: &[Experiment]) -> bool {
    let nx = network.shape.nx;
    let samples: usize = experiments.iter().map(|e| e.y.len()).sum();
    let bytes = size_of::<f64>() * (nx + 1) + size_of::<Lanes>() * network.groups();
    // The shapes of `free_run::together`, whose registers let two runs overlap.
    let small = nx <= MOST_STATES && network.groups() <= MOST_GROUPS;
    // With AVX2 two runs together take as long as one after the other: 16 registers hold only one of them.
    small && samples * bytes <= MOST_TOGETHER && simd::level() == Ok(simd::Level::Avx512)
}

/// The weight decay of each parameter.
#[derive(Clone, Debug)]
pub(super) struct Decay(Vec<f64>);

impl Decay {
    /// `decay/2 (|E|^2 + |Wx|^2 + |Wu|^2 + |G|^2 + .1 |bh|^2)`: the weight decay's part of the cost.
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
    /// Number of known outputs, each counted by its weight.
    samples: f64,
    attempts: &'a Attempts,
    gram: Gram,
    columns: Vec<usize>,
    buffers: Sensitivities,
    held: Vec<(usize, f64)>,
}

impl<'a> Training<'a> {
    pub fn new(
        experiments: &'a [Experiment],
        network: Network,
        decay: f64,
        attempts: &'a Attempts,
        monitor: &'a Monitor,
    ) -> Self {
        let shape = network.shape;
        let columns = Columns::new(shape);
        let weight = |e: &Experiment| match &e.weights[..] {
            [] => e.y.iter().filter(|y| !y.is_nan()).count() as f64,
            weights => total_weight(weights, &e.y),
        };
        Self {
            experiments,
            monitor,
            decay: Decay(
                (0..shape.parameters())
                    .map(|i| decay * shape.decay(i))
                    .collect(),
            ),
            samples: experiments.iter().map(weight).sum(),
            attempts,
            // No past rows: here the recursion is of states, in `Sensitivities`, and a row is a function of them.
            gram: Gram::new(columns.room, 0),
            columns: columns.of_theta(),
            buffers: Sensitivities::new(shape),
            held: shape.held(),
            network,
        }
    }

    fn shape(&self) -> Shape {
        self.network.shape
    }

    /// Repeats the runs at parameters that have run before, even after a stop request.
    pub fn rerun(&mut self, theta: &[f64]) -> Option<()> {
        // The stored runs may belong to a later trial that was rejected or stopped.
        let [cost] = self.simulate([theta], f64::INFINITY, &Monitor::default());
        cost.map(drop)
    }

    /// Costs, below `limit`, of the free runs at several points; the runs are stored.
    fn simulate<const RUNS: usize>(
        &mut self,
        thetas: [&[f64]; RUNS],
        limit: f64,
        monitor: &Monitor,
    ) -> [Option<f64>; RUNS] {
        let (nx, own) = (self.shape().nx, self.columns.len());
        // `None` is a failed run: it is passed on from experiment to experiment.
        let mut limits = thetas.map(|theta| {
            Some(Limit {
                before: 0.0,
                samples: self.samples,
                penalty: self.decay.penalty(theta),
                limit,
            })
        });
        let mut attempts = self.attempts.0.borrow_mut();
        let Some(attempts) = attempts.first_chunk_mut::<RUNS>() else {
            return [None; RUNS];
        };
        for (attempt, theta) in attempts.iter_mut().zip(thetas) {
            attempt.network.load(&theta[..own]);
            attempt.theta.clear();
            attempt.theta.extend_from_slice(theta);
        }
        for (i, data) in self.experiments.iter().enumerate() {
            let mut left = limits.into_iter();
            let sums = FreeRuns {
                runs: attempts.each_mut().map(|attempt| Run {
                    network: &attempt.network,
                    // theta, then the initial state of each experiment.
                    state: &attempt.theta[own + i * nx..][..nx],
                    run: &mut attempt.runs[i],
                    scratch: &mut attempt.scratch,
                    limit: left.next().flatten(),
                }),
                v: &data.v,
                y: &data.y,
                weights: &data.weights,
                bound: DIVERGED,
                monitor,
            }
            .go();
            for (limit, sum) in limits.iter_mut().zip(sums) {
                // The cost of this experiment is subtracted from the limit for the next ones.
                *limit = limit.zip(sum).map(|(limit, sum)| limit.after(sum));
            }
        }
        limits.map(|limit| limit.map(|limit| limit.cost(0.0)))
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
        // All experiments share theta, so its sums add up; each state has its own rows and columns. J'J is full for
        // theta and block-diagonal for the states.
        let place = |i: usize| if i < own { i } else { i + experiment * nx };
        let (sums, width) = self.gram.finish();
        // The cost is 1/(2N) sum e^2, with N the sum of the known outputs' weights.
        let scale = 1.0 / self.samples;
        for i in 0..own + nx {
            let a = column(i);
            // The error is the last column that counts, so its row is below all others. Other pairs are looked up in
            // the lower triangle, in the order of a row's columns, not of theta's.
            jte[place(i)] += sums[at.error * width + a] * scale;
            let row = &mut jtj[place(i) * n..][..n];
            for j in 0..=i {
                let b = column(j);
                row[place(j)] += sums[a.max(b) * width + a.min(b)] * scale;
            }
        }
    }

    /// Removes held parameters from the system: their step is zero.
    fn hold(&self, jtj: &mut [f64], jte: &mut [f64]) {
        let n = jte.len();
        for &(i, _) in &self.held {
            // A row and column of the unit matrix and no gradient: the step is 0 for every damping, and the others are
            // not affected. Removing them would shrink the system and change every index.
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
        self.cost_below(theta, f64::INFINITY)
    }

    fn cost_below(&mut self, theta: &[f64], limit: f64) -> Option<f64> {
        let [cost] = self.simulate([theta], limit, self.monitor);
        cost
    }

    fn takes_two(&self) -> bool {
        self.attempts.are_two()
    }

    fn costs_below(&mut self, thetas: [&[f64]; 2], limit: f64) -> [Option<f64>; 2] {
        // Each run has the bits of a single run.
        self.simulate(thetas, limit, self.monitor)
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
                run: &self.attempts.at(theta)[i],
                v: &data.v,
                y: &data.y,
                weights: &data.weights,
                buffers: &mut self.buffers,
                rows: &mut self.gram,
                // The slopes of saturated units do not show in a sum of squares, so no tanh is recomputed.
                exact: false,
                monitor: self.monitor,
            });
            self.scatter(i, jtj, jte);
        }
        for (i, (t, decay)) in theta.iter().zip(&self.decay.0).enumerate() {
            // Weight decay as residuals sqrt(decay) t: decay on the diagonal of J'J, -decay t in J'e. The states have
            // none.
            jtj[i * n + i] += decay;
            jte[i] -= decay * t;
        }
        self.hold(jtj, jte);
    }
}

#[cfg(test)]
mod tests {
    use super::super::output::OutputFunction;
    use super::super::tests::noise;
    use super::*;
    use crate::laws::{check_gradient, check_sum, weights};

    #[test]
    fn puts_weights_on_cost_and_normal_equations_alike() {
        // with up to four states rows are written block by block
        for (nx, hidden) in [(2, 3), (4, 15), (5, 8)] {
            let shape = Shape {
                nx,
                nk: 1,
                inputs: 2,
                hidden,
                integrator: false,
            };
            let output = OutputFunction::Abs { width: 0.3 };
            let samples = 150;
            let (v, mut y) = (noise(2 * samples, 1), noise(samples, 2));
            y[..4].fill(f64::NAN);
            y[90..111].fill(f64::NAN);
            let parameters = shape.parameters() + 2 * nx;
            let theta: Vec<f64> = noise(parameters, 3).iter().map(|t| 0.15 * t).collect();
            let experiments = |weights: &[f64]| {
                let experiment = |weights: Vec<f64>| Experiment {
                    v: v.clone(),
                    y: y.clone(),
                    weights,
                };
                [experiment(weights.to_vec()), experiment(Vec::new())]
            };
            let network = Network::new(shape, output, &theta[..shape.parameters()]);
            let monitor = Monitor::default();
            let drawn = experiments(&weights(samples, 1));
            let attempts = Attempts::new(&network, &drawn);
            let mut weighted = Training::new(&drawn, network.clone(), 1e-3, &attempts, &monitor);
            check_gradient(&mut weighted, &theta);
            let part = |k: usize| k % 7 < 3;
            let of = |inside: f64, outside: f64| {
                let weight = |k| if part(k) { inside } else { outside };
                experiments(&(0..samples).map(weight).collect::<Vec<f64>>())
            };
            let (tripled, plain, mut only) = (of(3.0, 1.0), of(1.0, 1.0), of(1.0, 0.0));
            only[1].weights = vec![0.0; samples];
            let attempts = [&tripled, &plain, &only].map(|e| Attempts::new(&network, e));
            let problem =
                |e, i: usize| Training::new(e, network.clone(), 0.0, &attempts[i], &monitor);
            let mut whole = problem(&tripled, 0);
            let (plain, part) = (problem(&plain, 1), problem(&only, 2));
            let (total, all, of_part) = (whole.samples, plain.samples, part.samples);
            assert_eq!(total, all + 2.0 * of_part);
            check_sum(
                &theta,
                (&mut whole, total),
                &mut [(plain, all, 1.0), (part, of_part, 2.0)],
            );
        }
    }
}
