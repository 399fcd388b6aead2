//! The network's free run as a least-squares problem.

use super::free_run::{FreeRuns, Run};
use super::network::{Network, Shape};
use super::scaling::Scaling;
use super::sensitivities::Recursion;
use super::train::InitialState;
use crate::data::{total_weight, weighted_squares};
use crate::gram::Gram;
use crate::lm::Problem;
use crate::monitor::Limit;
use crate::simd::{self, LANES, Lanes};
use crate::{Monitor, Record};

/// A free run beyond this many scales has diverged.
// Scaled outputs are of size 1: no fit begins at such values, and a run that reaches them does not return. It ends with
// the block in which this is detected.
const DIVERGED: f64 = 1e4;

/// One experiment in scaled units.
#[derive(Clone, Debug)]
pub(super) struct Experiment {
    pub u: Vec<f64>,
    /// NaN for unmeasured samples.
    pub y: Vec<f64>,
    /// Weights of the samples; empty if all count alike.
    pub weights: Vec<f64>,
    /// First simulated sample.
    pub first: usize,
    /// Past outputs before it; a guess if they are estimated.
    pub state: Vec<f64>,
}

impl Experiment {
    pub fn new(record: &Record, scaling: &Scaling, na: usize, kind: InitialState) -> Self {
        let y: Vec<f64> = record.y.iter().map(|&y| scaling.output(y)).collect();
        let (first, state) = match kind {
            // Zero in the data's unit: a machine at rest.
            InitialState::Zero => (0, vec![scaling.output(0.0); na]),
            InitialState::Measured => after_measured(&y, na),
            // From the first measured sample on: a state before a gap would have no effect on the cost.
            InitialState::Estimated => (record.first_measured(), vec![first_level(&y); na]),
        };
        Self {
            u: scaling.inputs(record.u),
            weights: record.weights.map_or(Vec::new(), <[f64]>::to_vec),
            y,
            first,
            state,
        }
    }

    /// The past outputs before the first sample: the experiment's own, or the parameters from `place` on.
    fn state_in<'t>(&'t self, theta: &'t [f64], place: Option<usize>) -> &'t [f64] {
        match place {
            Some(place) => &theta[place..][..self.state.len()],
            None => &self.state,
        }
    }

    /// Number of simulated samples.
    pub fn samples(&self) -> usize {
        self.y.len() - self.first
    }

    /// The weight of sample `k`.
    pub fn weight(&self, k: usize) -> f64 {
        self.weights.get(k).copied().unwrap_or(1.0)
    }

    /// Weights of the samples from `from` on; empty if all count alike.
    fn weights_from(&self, from: usize) -> &[f64] {
        self.weights.get(from..).unwrap_or_default()
    }

    /// Sum of the weights of the measured samples from `from` on: their number if all count alike.
    pub fn weight_from(&self, from: usize) -> f64 {
        let y = &self.y[from..];
        match self.weights_from(from) {
            [] => y.iter().filter(|y| !y.is_nan()).count() as f64,
            weights => total_weight(weights, y),
        }
    }

    /// Weighted sum of squared errors of a run over the samples from `from` on.
    pub fn squares_from(&self, from: usize, run: &[f64]) -> f64 {
        match self.weights_from(from) {
            [] => squared_errors(&self.y[from..], run),
            weights => weighted_squares(weights, &self.y[from..], run),
        }
    }

    /// Number of simulated samples whose output was measured.
    pub fn measured(&self) -> usize {
        self.y[self.first..].iter().filter(|y| !y.is_nan()).count()
    }
}

/// Over the measured samples, with eight sums side by side, as a single one would wait for each addition.
fn squared_errors(measured: &[f64], run: &[f64]) -> f64 {
    let square = |(y, run): (&f64, &f64)| {
        let error = y - run;
        if error.is_nan() { 0.0 } else { error * error }
    };
    // For validation, once per iterate: no kernel, the compiler's own vectorisation is enough.
    let (groups, rest) = measured.as_chunks::<LANES>();
    let (runs, rest_run) = run.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for (y, run) in groups.iter().zip(runs) {
        for (sum, pair) in sums.iter_mut().zip(y.iter().zip(run)) {
            *sum += square(pair);
        }
    }
    let rest: f64 = rest.iter().zip(rest_run).map(square).sum();
    sums.iter().sum::<f64>() + rest
}

/// The first sample after `na` measured ones in a row, and these, newest first; the end of the record if there is none.
fn after_measured(y: &[f64], na: usize) -> (usize, Vec<f64>) {
    // `na` measured outputs in a row are a past; the run begins after them.
    let mut pasts = y.windows(na).enumerate();
    match pasts.find(|(_, past)| past.iter().all(|y| !y.is_nan())) {
        Some((k, past)) => (k + na, past.iter().rev().copied().collect()),
        None => (y.len(), vec![0.0; na]),
    }
}

/// Mean of the first five measured outputs.
fn first_level(y: &[f64]) -> f64 {
    // Five, to average noise; a guess that the fit then moves.
    let first = || y.iter().filter(|y| !y.is_nan()).take(5);
    first().sum::<f64>() / first().count() as f64
}

/// Most samples for which a second run, at 72 bytes a sample, is worth its memory.
const MOST_TOGETHER: usize = 16_000_000;

/// Whether a second run beside the first takes hardly any extra time, because the first one's dependency chain leaves
/// the processor waiting.
fn pays(shape: Shape, experiments: &[Experiment]) -> bool {
    let samples: usize = experiments.iter().map(Experiment::samples).sum();
    // More groups already overlap within one run; more past outputs need more registers than two runs have. On the
    // baseline a run is limited by its number of operations (139 cycles, two side by side 234).
    let short = shape.groups() == 1 && shape.lags.na <= 2 && samples <= MOST_TOGETHER;
    short && simd::level() != Ok(simd::Level::Baseline)
}

/// A simulation with the data that the Jacobian pass needs.
struct Attempt {
    // By it `sensitivities` finds the accepted trial: two may have been simulated, and either may be accepted.
    theta: Vec<f64>,
    network: Network,
    /// Outputs and hidden outputs, experiment by experiment.
    // Memory for the whole record, kept from trial to trial: per sample 8 bytes for outputs, 64 for a group of hidden
    // outputs.
    runs: Vec<Vec<f64>>,
    hidden: Vec<Vec<Lanes>>,
}

impl Attempt {
    fn new(network: Network, experiments: &[Experiment]) -> Self {
        let groups = network.shape.groups();
        let all = || experiments.iter().map(Experiment::samples);
        Self {
            theta: Vec::new(),
            network,
            runs: all().map(|samples| vec![0.0; samples]).collect(),
            hidden: all()
                .map(|samples| vec![Lanes::ZERO; samples * groups])
                .collect(),
        }
    }
}

/// Parameters: theta, then, if they are estimated, the past outputs of each experiment.
pub(super) struct FreeRun<'a> {
    experiments: &'a [Experiment],
    monitor: &'a Monitor,
    shape: Shape,
    estimated: bool,
    decay: f64,
    /// Number of measured samples, each counted by its weight.
    samples: f64,
    /// The last simulations: one or, if two at once pay, two.
    attempts: Vec<Attempt>,
    // Rows and sums of one experiment: cleared, filled and added to the system for each experiment in turn.
    gram: Gram,
    columns: Vec<usize>,
}

impl<'a> FreeRun<'a> {
    pub fn new(
        experiments: &'a [Experiment],
        network: Network,
        estimated: bool,
        decay: f64,
        monitor: &'a Monitor,
    ) -> Self {
        let shape = network.shape;
        let attempts = if pays(shape, experiments) { 2 } else { 1 };
        Self {
            experiments,
            monitor,
            estimated,
            decay,
            samples: experiments.iter().map(|e| e.weight_from(e.first)).sum(),
            attempts: (0..attempts)
                .map(|_| Attempt::new(network.clone(), experiments))
                .collect(),
            gram: shape.gram(estimated),
            columns: shape.columns(),
            shape,
        }
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// `theta` followed by the experiments' own states if those are parameters.
    pub fn start(&self, theta: &[f64]) -> Vec<f64> {
        let states = self
            .experiments
            .iter()
            .flat_map(|e| e.state.iter().copied());
        let kept = if self.estimated { usize::MAX } else { 0 };
        theta.iter().copied().chain(states.take(kept)).collect()
    }

    /// The weight decay's part of the cost: `decay/2 (|W1|^2 + |w2|^2 + .1 |b1|^2)`.
    pub fn penalty(&self, theta: &[f64]) -> f64 {
        let weighted = |(i, t): (usize, &f64)| self.decay_of(i) * t * t;
        0.5 * theta.iter().enumerate().map(weighted).sum::<f64>()
    }

    /// The decay of a parameter: all of it for weights, a part for biases, none for the linear part and the constant.
    fn decay_of(&self, parameter: usize) -> f64 {
        let [bias, second, constant, _] = self.shape().offsets();
        // By the start of each part of theta; linear part and constant follow the data without decay.
        match parameter {
            i if i < bias => self.decay,
            i if i < second => 0.1 * self.decay,
            i if i < constant => self.decay,
            _ => 0.0,
        }
    }

    /// Share of the last simulation's samples that lie on a limit.
    pub fn clipped_share(&self) -> f64 {
        let Attempt { network, runs, .. } = &self.attempts[0];
        let outputs = runs.iter().flatten();
        let clipped = outputs.filter(|&&y| network.is_clipped(y)).count();
        clipped as f64 / runs.iter().map(Vec::len).sum::<usize>() as f64
    }

    /// Costs, below `limit`, of the free runs at several points; their outputs are stored.
    fn simulate<const RUNS: usize>(
        &mut self,
        thetas: [&[f64]; RUNS],
        limit: f64,
    ) -> [Option<f64>; RUNS] {
        // A limit of `None` marks a failed run: it is passed on from experiment to experiment, and its free runs end
        // before their first block.
        let mut limits = thetas.map(|theta| {
            Some(Limit {
                before: 0.0,
                samples: self.samples,
                penalty: self.penalty(theta),
                limit,
            })
        });
        for (attempt, theta) in self.attempts.iter_mut().zip(thetas) {
            // Uses the first part of theta; `state_in` reads the states after it.
            attempt.network.load(theta);
            attempt.theta.clear();
            attempt.theta.extend_from_slice(theta);
        }
        for (experiment, data) in self.experiments.iter().enumerate() {
            let place = self.state_at(experiment);
            let Some(attempts) = self.attempts.first_chunk_mut::<RUNS>() else {
                return [None; RUNS];
            };
            let mut left = limits.into_iter();
            let sums = FreeRuns {
                runs: attempts.each_mut().map(|attempt| Run {
                    network: &attempt.network,
                    state: data.state_in(&attempt.theta, place),
                    outputs: &mut attempt.runs[experiment],
                    hidden: &mut attempt.hidden[experiment],
                    limit: left.next().flatten(),
                }),
                u: &data.u,
                first: data.first,
                y: &data.y[data.first..],
                weights: data.weights_from(data.first),
                bound: DIVERGED,
                monitor: Some(self.monitor),
            }
            .go();
            for (limit, sum) in limits.iter_mut().zip(sums) {
                // The cost is a sum over experiments: the cost of each is subtracted from the limit for the next.
                *limit = limit.zip(sum).map(|(limit, sum)| limit.after(sum));
            }
        }
        limits.map(|limit| limit.map(|limit| limit.cost(0.0)))
    }

    /// Index of an experiment's own state among the parameters.
    fn state_at(&self, experiment: usize) -> Option<usize> {
        let lags = self.shape().lags;
        self.estimated
            .then(|| self.shape().parameters() + experiment * lags.na)
    }

    fn sensitivities(&mut self, theta: &[f64], experiment: usize) {
        let (shape, data) = (self.shape(), &self.experiments[experiment]);
        let place = self.state_at(experiment);
        let attempts = &self.attempts;
        // By the contract of `Problem` only called at the parameters of a successful cost, so the run is stored.
        let same = attempts.iter().find(|attempt| attempt.theta == theta);
        let attempt = same.unwrap_or(&attempts[0]);
        self.gram.clear();
        if self.estimated {
            for i in 0..shape.lags.na {
                // dy(-1-i)/d(state i) = 1: the recursion begins with the unit matrix in the columns of the state.
                self.gram.past_mut(i + 1)[shape.state_column() + i] = 1.0;
            }
        }
        Recursion {
            network: &attempt.network,
            u: &data.u,
            first: data.first,
            state: data.state_in(theta, place),
            run: &attempt.runs[experiment],
            hidden: Some(&attempt.hidden[experiment]),
            y: &data.y[data.first..],
            weights: data.weights_from(data.first),
            rows: &mut self.gram,
            monitor: Some(self.monitor),
        }
        .go();
    }

    /// Adds the experiment's sums to the system.
    fn scatter(&mut self, experiment: usize, jtj: &mut [f64], jte: &mut [f64]) {
        let (shape, n) = (self.shape(), jte.len());
        let (na, first_state) = (shape.lags.na, shape.state_column());
        let error = shape.error_column();
        let states = if self.estimated { na } else { 0 };
        let own = shape.parameters();
        let column = |i: usize| {
            if i < own {
                self.columns[i]
            } else {
                first_state + i - own
            }
        };
        // All experiments share theta, so their sums add up. Each has its own columns for its state: J'J has blocks of
        // zeros between different experiments.
        let place = |i: usize| if i < own { i } else { i + experiment * na };
        let (sums, width) = self.gram.finish();
        // The cost is 1/(2N) sum e^2, with N the sum of the weights of all experiments.
        let scale = 1.0 / self.samples;
        for i in 0..own + states {
            let a = column(i);
            // Only the lower triangle of the sums exists, in the order of a row's columns: the larger index is the row.
            jte[place(i)] += sums[a.max(error) * width + a.min(error)] * scale;
            for j in 0..=i {
                let b = column(j);
                jtj[place(i) * n + place(j)] += sums[a.max(b) * width + a.min(b)] * scale;
            }
        }
    }
}

impl Problem for FreeRun<'_> {
    fn parameters(&self) -> usize {
        let states = if self.estimated {
            self.experiments.len() * self.shape().lags.na
        } else {
            0
        };
        self.shape().parameters() + states
    }

    fn cost(&mut self, theta: &[f64]) -> Option<f64> {
        self.cost_below(theta, f64::INFINITY)
    }

    fn cost_below(&mut self, theta: &[f64], limit: f64) -> Option<f64> {
        let [cost] = self.simulate([theta], limit);
        cost
    }

    fn takes_two(&self) -> bool {
        self.attempts.len() == 2
    }

    fn costs_below(&mut self, thetas: [&[f64]; 2], limit: f64) -> [Option<f64>; 2] {
        // One pass over the inputs with both networks; each run has the bits of a single run.
        self.simulate(thetas, limit)
    }

    fn normal_equations(&mut self, theta: &[f64], jtj: &mut [f64], jte: &mut [f64]) {
        jtj.fill(0.0);
        jte.fill(0.0);
        for experiment in 0..self.experiments.len() {
            self.sensitivities(theta, experiment);
            self.scatter(experiment, jtj, jte);
        }
        for (i, t) in theta.iter().enumerate() {
            let decay = self.decay_of(i);
            // The penalty decay/2 t^2 is one more residual sqrt(decay) t each: its J'J is decay, its J'e -decay t.
            jtj[i * theta.len() + i] += decay;
            jte[i] -= decay * t;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagged::Lags;
    use crate::laws::{check_gradient, check_sum, weights};
    use crate::random::Random;

    #[test]
    fn puts_weights_on_cost_and_normal_equations_alike() {
        // the usual shape has its own kernel
        for (na, nb, hidden) in [(2, 2, 8), (1, 2, 3), (3, 1, 11)] {
            let lags = Lags::new(na, nb, 1, 1).unwrap();
            let shape = Shape::new(lags, hidden, true).unwrap();
            let mut random = Random::new(3);
            let mut drawn = |n: usize| (0..n).map(|_| random.between(-0.3, 0.3)).collect();
            let (u, mut y): (Vec<f64>, Vec<f64>) = (drawn(300), drawn(300));
            y[..4].fill(f64::NAN);
            y[150..180].fill(f64::NAN);
            let theta: Vec<f64> = drawn(shape.parameters() + 2 * na);
            let limits = (f64::NEG_INFINITY, f64::INFINITY);
            let scaling = Scaling {
                u_mean: vec![0.0],
                u_scale: vec![1.0],
                y_mean: 0.0,
                y_scale: 1.0,
            };
            let record = Record::with_gaps(&u, 1, &y).unwrap();
            let experiments = |weights: &[f64]| {
                let weighted = record.with_weights(weights).unwrap();
                let kind = InitialState::Estimated;
                [weighted, record].map(|r| Experiment::new(&r, &scaling, na, kind))
            };
            let monitor = Monitor::default();
            fn problem<'a>(
                experiments: &'a [Experiment],
                network: Network,
                decay: f64,
                monitor: &'a Monitor,
            ) -> FreeRun<'a> {
                FreeRun::new(experiments, network, true, decay, monitor)
            }
            let network = || Network::zero(shape, limits);
            let drawn = experiments(&weights(300, 1));
            let mut weighted = problem(&drawn, network(), 1e-3, &monitor);
            check_gradient(&mut weighted, &theta);
            let other: Vec<f64> = theta.iter().map(|t| 0.9 * t).collect();
            if weighted.takes_two() {
                let costs = weighted.costs_below([&theta, &other], f64::INFINITY);
                assert_eq!(costs, [&theta, &other].map(|t| weighted.cost(t)));
            }
            let part = |k: usize| k % 7 < 3;
            let tripled: Vec<f64> = (0..300).map(|k| if part(k) { 3.0 } else { 1.0 }).collect();
            let only: Vec<f64> = (0..300).map(|k| f64::from(u8::from(part(k)))).collect();
            let (tripled, plain) = (experiments(&tripled), experiments(&[1.0; 300]));
            let mut only = experiments(&only);
            only[1].weights = vec![0.0; 300];
            let mut whole = problem(&tripled, network(), 0.0, &monitor);
            let plain = problem(&plain, network(), 0.0, &monitor);
            let part = problem(&only, network(), 0.0, &monitor);
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
