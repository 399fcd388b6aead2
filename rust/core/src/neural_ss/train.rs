//! Training in free run: many starts in parallel, each by Levenberg-Marquardt; the best free run is chosen.

use super::draw::{self, Realisation};
use super::free_run::Trajectory;
use super::friction::{self, Friction};
use super::integrated::{Leak, Speed};
use super::network::Network;
use super::output::OutputFunction;
use super::problem::{self, Attempts, Experiment};
use super::records::{check_records, constant_cost, scaling};
use super::referee::{Referee, statistics};
use super::shape::{Scaling, Shape};
use super::state::{self, Statistics};
use super::{NeuralSS, kalman};
use crate::guard;
use crate::linear::LinearModel;
use crate::lm::{self, Damping, Outcome, Problem, Termination};
use crate::random::Random;
use crate::{Error, Monitor, Record, Result, starts};

/// What to train, and how.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Number of states.
    pub nx: usize,
    /// Delay in samples.
    pub nk: usize,
    /// Hidden units.
    pub hidden: usize,
    /// A model of order nx at which the starts begin; without it they begin at random states.
    pub linear: Option<LinearModel>,
    /// Models to be trained further, of this shape and output and with the same scaling: start `first_start + i` begins
    /// at the i-th. If there are any, nothing is drawn, `linear` is not used, and there are as many starts as models.
    pub initial: Vec<NeuralSS>,
    /// Output function, its parameters in scaled units.
    pub output: OutputFunction,
    /// Whether the last state is the sum of a function of the others.
    pub integrator: bool,
    /// Weight of `1/2 (|E|^2 + |Wx|^2 + |Wu|^2 + |G|^2 + .1 |bh|^2)` beside J; 1e-8 or less on much data.
    pub weight_decay: f64,
    /// Standard deviation of a hidden unit's argument at the start, without its bias: .3 to 1.
    pub hidden_scale: f64,
    /// Iterations of each start.
    pub max_iterations: usize,
    /// Number of starts.
    pub starts: usize,
    /// Number of the first start: starts may be spread over several calls.
    pub first_start: usize,
    /// Seed of the starts; start `i` draws from stream `i`.
    pub seed: u64,
    /// Threads; 0 for as many as the machine has. The result does not depend on it.
    pub threads: usize,
    /// Whether each start's model has to pass the [`guard`](crate::guard) on the training data. Pieces of records that
    /// are shorter than the drive's memory say little there: it is better to test a chosen model on whole records.
    pub guard: bool,
}

/// A trained model and how it was trained.
#[derive(Clone, Debug)]
pub struct NeuralSSFit {
    /// The chosen model.
    pub model: NeuralSS,
    /// `J = 1/(2N) sum e^2` in scaled units, free run, on the training data, without weight decay.
    pub cost: f64,
    /// The same on the validation data, if there are any.
    pub validation_cost: Option<f64>,
    /// Iterations of the chosen start.
    pub iterations: usize,
    /// How the chosen start ended.
    pub termination: Termination,
    /// J of the chosen start, at its beginning and after each accepted step.
    pub trace: Vec<f64>,
    /// Which start was chosen, counted from `first_start`.
    pub start: usize,
    /// The score of each start: J on the validation data, else on the training data; infinite for a failed one.
    pub start_costs: Vec<f64>,
    /// Dead starts that were drawn again.
    pub discarded: usize,
    /// Whether the chosen model passed the guard or was not tested; false only if no start passed.
    pub sound: bool,
    /// Models of all starts with a finite cost, those that passed the guard first, each part best first.
    pub models: Vec<NeuralSS>,
    /// The model of each start, in the order of the starts.
    pub start_models: Vec<Option<NeuralSS>>,
    /// Whether each start's model passed the guard; true for all if they were not tested.
    pub sounds: Vec<bool>,
    /// Initial state of each training experiment, in scaled units.
    pub initial_states: Vec<Vec<f64>>,
}

/// First damping.
const FIRST_MU: f64 = 1e-2;
/// Relative reduction of the cost that counts as none.
const NO_REDUCTION: f64 = 1e-7;
/// Growth of the sensitivities' squares in one step that counts as an explosion. Tested for positions, for which it was
/// measured: there friction that overshoots standstill explodes.
const MOST_GROWTH: f64 = 1e3;
/// Share of a position's starts that first train a network of its speed.
const BY_SPEED: f64 = 0.6;
/// Share of its other starts that begin with an estimate of its friction, if one shows.
const WITH_FRICTION: f64 = 0.7;
/// One in so many iterations of a position goes to its speed or its recent motion.
const FIRST_PART: usize = 3;
/// Samples of an experiment from which its state is first estimated.
const STATE_SAMPLES: usize = 2_000;
/// Share of the output's variance that a linear model is assumed to leave unexplained while it starts.
const LINEAR_RESIDUAL: f64 = 0.1;

/// Trains `settings.starts` models in free run and chooses by J on the validation data, else on the training data.
///
/// With validation data each start keeps its best iterate on them. A start is dead if its free run diverges or ends no
/// better than a constant output. It is drawn again from its own stream and counted in `discarded`. With the guard, a
/// start whose model does not pass is chosen only if none does.
///
/// # Errors
/// `ErrorKind::Data` and `ErrorKind::Setting` for data or settings that cannot be trained; `ErrorKind::Fit` if every start failed.
pub fn fit(
    records: &[Record],
    validation: &[Record],
    settings: &Settings,
    monitor: &Monitor,
) -> Result<NeuralSSFit> {
    let task = Task::new(records, validation, settings, monitor)?;
    monitor.set_total((settings.starts * settings.max_iterations) as u64);
    let results = starts::run_all(settings.starts, settings.threads, monitor, |start| {
        task.run(settings.first_start + start)
    });
    task.chosen(results)
}

/// The data that all starts share.
struct Task<'a> {
    settings: &'a Settings,
    monitor: &'a Monitor,
    records: &'a [Record<'a>],
    shape: Shape,
    scaling: Scaling,
    experiments: Vec<Experiment>,
    validation: Vec<Experiment>,
    linear: Option<Realisation>,
    constant_cost: f64,
}

/// One trained start.
struct Trained {
    model: NeuralSS,
    states: Vec<Vec<f64>>,
    cost: f64,
    validation_cost: Option<f64>,
    outcome: Outcome,
    trace: Vec<f64>,
    discarded: usize,
    sound: bool,
}

impl<'a> Task<'a> {
    fn new(
        records: &'a [Record<'a>],
        validation: &[Record],
        settings: &'a Settings,
        monitor: &'a Monitor,
    ) -> Result<Self> {
        let first = records
            .first()
            .ok_or_else(|| Error::data("expected one experiment or more, got none"))?;
        let shape = Shape {
            nx: settings.nx,
            nk: settings.nk,
            inputs: first.channels,
            hidden: settings.hidden,
            integrator: settings.integrator,
        }
        .checked()?;
        check(settings)?;
        check_records(records, validation, shape)?;
        let scaling = match settings.initial.first() {
            Some(model) => model.scaling().clone(),
            None => scaling(records, settings.output)?,
        };
        check_initial(settings, shape, &scaling)?;
        let scaled = |r: &Record| Experiment {
            v: scaling.delayed_inputs(r.u, shape.nk),
            y: scaling.outputs(r.y),
            weights: r.weights.unwrap_or_default().to_vec(),
        };
        let experiments: Vec<Experiment> = records.iter().map(scaled).collect();
        let linear = settings.linear.as_ref();
        Ok(Self {
            settings,
            monitor,
            records,
            shape,
            constant_cost: constant_cost(&experiments),
            validation: validation.iter().map(scaled).collect(),
            linear: linear
                .map(|l| Realisation::of(l, shape, &scaling, &experiments))
                .transpose()?,
            experiments,
            scaling,
        })
    }

    /// Trains one start, drawn again while it is dead.
    fn run(&self, start: usize) -> Option<Trained> {
        let mut random = Random::stream(self.settings.seed, start as u64);
        let train = || {
            let network = Network::new(
                self.shape,
                self.settings.output,
                &vec![0.0; self.shape.parameters()],
            );
            let attempts = Attempts::new(&network, &self.experiments);
            let decay = self.settings.weight_decay;
            let mut problem =
                problem::Training::new(&self.experiments, network, decay, &attempts, self.monitor);
            if let Some((theta, taken)) = self.by_speed(&mut problem, &mut random, &attempts) {
                return Some((self.train(&mut problem, theta, &attempts, taken)?, 0));
            }
            let (theta, dead) = self.drawn(&mut problem, start, &mut random)?;
            let (theta, taken) = self.by_recent_motion(&mut problem, theta, &attempts);
            Some((self.train(&mut problem, theta, &attempts, taken)?, dead))
        };
        // models to be trained further are not drawn, so another training would end the same
        let trainings = match self.settings.initial.is_empty() {
            true => starts::MOST_TRAININGS,
            false => 1,
        };
        let has_learnt = |t: &Trained| starts::has_learnt(t.cost, self.constant_cost);
        let (trained, discarded) = starts::learnt(trainings, self.monitor, train, has_learnt)?;
        Some(Trained {
            discarded,
            ..trained
        })
    }

    /// Parameters with a usable free run, and how many draws had none.
    fn drawn(
        &self,
        problem: &mut problem::Training,
        start: usize,
        random: &mut Random,
    ) -> Option<(Vec<f64>, usize)> {
        if let Some(model) = self.settings.initial.get(start - self.settings.first_start) {
            let theta = self.resumed(model);
            return problem.cost(&theta).map(|_| (theta, 0));
        }
        if let Some(theta) = self
            .with_friction(random)
            .filter(|theta| problem.cost(theta).is_some())
        {
            return Some((theta, 0));
        }
        starts::drawn(self.monitor, || {
            let theta = match &self.linear {
                Some(linear) => Some(self.begun(linear, random)),
                None => draw::small(self.shape, &self.experiments, random)
                    .map(|linear| self.begun(&linear, random)),
            };
            theta.filter(|theta| problem.cost(theta).is_some())
        })
    }

    /// A position's start from an estimate of its dry friction; `None` if the draw is against it, or if no friction shows.
    fn with_friction(&self, random: &mut Random) -> Option<Vec<f64>> {
        let is_position = self.shape.integrator && self.shape.nx > 1;
        if !is_position || random.between(0.0, 1.0) >= WITH_FRICTION {
            return None;
        }
        let found = Friction::estimated(self.shape, &self.experiments, random)?;
        let theta = found.theta(self.shape, self.settings.hidden_scale, random);
        let network = Network::new(self.shape, self.settings.output, &theta);
        Some(with_states(
            theta,
            &network,
            &unit_prior(self.shape),
            &self.experiments,
        ))
    }

    /// A position's start that first trains a network of its speed, as many of its starts do: the parameters from which
    /// they go on, and the iterations used. `None` for the other starts, or if that training fails.
    fn by_speed(
        &self,
        problem: &mut problem::Training,
        random: &mut Random,
        attempts: &Attempts,
    ) -> Option<(Vec<f64>, usize)> {
        let is_linear = self.settings.output == OutputFunction::Linear;
        if !self.shape.integrator || !is_linear || !self.settings.initial.is_empty() {
            return None;
        }
        let speed = Speed::new(&self.experiments, self.shape)?;
        if random.between(0.0, 1.0) >= BY_SPEED {
            return None;
        }
        let linear = draw::small(speed.shape, &speed.experiments, random)?;
        let theta = draw::beside(&linear, speed.shape, self.settings.hidden_scale, random);
        let prior = unit_prior(speed.shape);
        let network = Network::new(speed.shape, OutputFunction::Linear, &theta);
        let theta = with_states(theta, &network, &prior, &speed.experiments);
        let iterations = self.settings.max_iterations / FIRST_PART;
        let theta = self.descended(&speed.experiments, network, theta, iterations)?;
        let theta = self.with_positions(problem, speed.integrated(&theta, self.shape), attempts)?;
        Some((theta, iterations))
    }

    /// Trains a position by its recent motion first; returns the parameters from which it goes on, and the iterations used.
    fn by_recent_motion(
        &self,
        problem: &mut problem::Training,
        theta: Vec<f64>,
        attempts: &Attempts,
    ) -> (Vec<f64>, usize) {
        if !self.shape.integrator || !self.settings.initial.is_empty() {
            return (theta, 0);
        }
        let iterations = self.settings.max_iterations / FIRST_PART;
        let found = self.leaking(theta.clone(), iterations);
        let found = found.and_then(|theta| self.with_positions(problem, theta, attempts));
        (found.unwrap_or(theta), iterations)
    }

    /// The parameters after training on the outputs filtered by [`Leak`].
    fn leaking(&self, mut theta: Vec<f64>, iterations: usize) -> Option<Vec<f64>> {
        let leak = Leak::new(&self.experiments, friction::pace(&self.experiments)?)?;
        leak.entered(&mut theta, self.shape);
        let own = self.shape.parameters();
        let network = Network::new(self.shape, self.settings.output, &theta[..own]);
        let mut theta = self.descended(&leak.experiments, network, theta, iterations)?;
        leak.left(&mut theta, self.shape);
        Some(theta)
    }

    /// The parameters after `iterations` on these experiments; `None` if no free run is finite.
    fn descended(
        &self,
        experiments: &[Experiment],
        network: Network,
        theta: Vec<f64>,
        iterations: usize,
    ) -> Option<Vec<f64>> {
        let attempts = Attempts::new(&network, experiments);
        let decay = self.settings.weight_decay;
        let mut problem =
            problem::Training::new(experiments, network, decay, &attempts, self.monitor);
        let settings = self.descent(iterations);
        let outcome = lm::minimize(&mut problem, theta, &settings, self.monitor, |_, _| ());
        self.monitor
            .advance((iterations - outcome.iterations) as u64);
        outcome.cost.is_finite().then_some(outcome.theta)
    }

    /// With initial positions at which the free run has no mean error; `None` if it diverges.
    fn with_positions(
        &self,
        problem: &mut problem::Training,
        mut theta: Vec<f64>,
        attempts: &Attempts,
    ) -> Option<Vec<f64>> {
        let (nx, own) = (self.shape.nx, self.shape.parameters());
        problem.cost(&theta)?;
        let reach = theta[self.shape.parts().c.end - 1];
        let missed = |(run, e): (&Trajectory, &Experiment)| {
            let errors = run.sums.iter().zip(&e.y).filter(|(_, y)| !y.is_nan());
            let (n, sum) = errors.fold((0.0, 0.0), |(n, sum), (s, y)| (n + 1.0, sum + y - s));
            sum / f64::max(n, 1.0)
        };
        let missed: Vec<f64> = attempts
            .at(&theta)
            .iter()
            .zip(&self.experiments)
            .map(missed)
            .collect();
        for (state, missed) in theta[own..].chunks_exact_mut(nx).zip(missed) {
            state[nx - 1] += missed / reach;
        }
        problem.cost(&theta).map(|_| theta)
    }

    /// A hidden layer beside the linear equations, with initial states at which the linear equations fit the experiments best.
    fn begun(&self, linear: &Realisation, random: &mut Random) -> Vec<f64> {
        let network = Network::new(self.shape, self.settings.output, &linear.theta(self.shape));
        let theta = draw::beside(linear, self.shape, self.settings.hidden_scale, random);
        with_states(theta, &network, &unit_prior(self.shape), &self.experiments)
    }

    /// A model to be trained further, with its states on the experiments.
    fn resumed(&self, model: &NeuralSS) -> Vec<f64> {
        let network = Network::new(self.shape, self.settings.output, model.theta());
        with_states(
            model.theta().to_vec(),
            &network,
            model.statistics(),
            &self.experiments,
        )
    }

    fn train(
        &self,
        problem: &mut problem::Training,
        theta: Vec<f64>,
        attempts: &Attempts,
        taken: usize,
    ) -> Option<Trained> {
        let settings = self.descent(self.settings.max_iterations - taken);
        let mut referee = Referee::new(
            problem.network.clone(),
            &self.experiments,
            attempts,
            &self.validation,
            self.monitor,
        );
        let mut costs = Vec::with_capacity(settings.max_iterations.min(1000) + 1);
        let decay = problem.decay.clone();
        let outcome = lm::minimize(problem, theta, &settings, self.monitor, |theta, cost| {
            let error = cost - decay.penalty(theta);
            costs.push(error);
            referee.judge(theta, cost, error);
        });
        let spare = settings.max_iterations - outcome.iterations;
        self.monitor.advance(spare as u64);
        let best = referee.best.take()?;
        self.finished(problem, best.theta, attempts)
            .map(|(model, states, sound)| Trained {
                cost: best.cost,
                model,
                states,
                validation_cost: best.validation_cost,
                outcome,
                trace: costs,
                discarded: 0,
                sound,
            })
    }

    fn descent(&self, max_iterations: usize) -> lm::Settings {
        lm::Settings {
            max_iterations,
            damping: Damping::Identity,
            mu: FIRST_MU,
            reduction_tolerance: NO_REDUCTION,
            most_growth: match self.shape.integrator {
                true => MOST_GROWTH,
                false => f64::INFINITY,
            },
            ..lm::Settings::default()
        }
    }

    /// The model with the statistics of its training run, its initial states and the guard's verdict.
    fn finished(
        &self,
        problem: &mut problem::Training,
        theta: Vec<f64>,
        attempts: &Attempts,
    ) -> Option<(NeuralSS, Vec<Vec<f64>>, bool)> {
        let own = self.shape.parameters();
        let states: Vec<Vec<f64>> = theta[own..]
            .chunks_exact(self.shape.nx)
            .map(<[f64]>::to_vec)
            .collect();
        let network = Network::new(self.shape, self.settings.output, &theta[..own]);
        problem.rerun(&theta)?;
        let runs = attempts.at(&theta);
        let mut statistics = statistics(&network, &self.experiments, &runs);
        statistics.process_noise = kalman::process_noise(
            &network,
            &statistics,
            &self.experiments,
            &states,
            self.monitor,
        );
        let model = NeuralSS::new(
            self.shape,
            self.settings.output,
            theta[..own].to_vec(),
            self.scaling.clone(),
            statistics,
        );
        let model = model.ok()?;
        let sound = !self.settings.guard || self.passes(&model);
        Some((model, states, sound))
    }

    /// The guard's verdict, independent of the monitor: a trained model is judged even after a stop request.
    fn passes(&self, model: &NeuralSS) -> bool {
        let (linear, monitor) = (self.settings.linear.as_slice(), Monitor::default());
        guard::verdict(model, self.records, linear, &monitor) == Ok(None)
    }

    fn chosen(&self, mut results: Vec<Option<Trained>>) -> Result<NeuralSSFit> {
        results.resize_with(self.settings.starts, || None);
        let score = |t: &Option<Trained>| {
            t.as_ref()
                .map_or(f64::INFINITY, |t| starts::score(t.validation_cost, t.cost))
        };
        let start_costs: Vec<f64> = results.iter().map(score).collect();
        let is_sound = |t: &Option<Trained>| t.as_ref().is_some_and(|t| t.sound);
        let sounds: Vec<bool> = results.iter().map(is_sound).collect();
        let order = starts::ranked(&start_costs, |i| sounds[i]);
        let model = |t: &Option<Trained>| t.as_ref().map(|t| t.model.clone());
        let start_models: Vec<_> = results.iter().map(model).collect();
        let models = order
            .iter()
            .filter_map(|&i| start_models[i].clone())
            .collect();
        let discarded = results.iter().flatten().map(|t| t.discarded).sum();
        let start = *order.first().ok_or_else(starts::none_left)?;
        let best = results.swap_remove(start).ok_or_else(starts::none_left)?;
        let stopped = self.monitor.stopped();
        Ok(NeuralSSFit {
            model: best.model,
            cost: best.cost,
            validation_cost: best.validation_cost,
            iterations: best.outcome.iterations,
            termination: if stopped {
                Termination::Interrupted
            } else {
                best.outcome.termination
            },
            trace: best.trace,
            start,
            start_costs,
            discarded,
            sound: best.sound,
            models,
            start_models,
            sounds,
            initial_states: best.states,
        })
    }
}

/// Statistics before there is a run: states are scaled to unit variance.
fn unit_prior(shape: Shape) -> Statistics {
    let nx = shape.nx;
    let unit = (0..nx * nx).map(|i| f64::from(u8::from(i % (nx + 1) == 0)));
    Statistics {
        state_mean: vec![0.0; nx],
        state_covariance: unit.collect(),
        residual_variance: LINEAR_RESIDUAL,
        process_noise: 0.0,
    }
}

/// The parameters, followed by the initial states at which `network` fits the experiments best.
fn with_states(
    mut theta: Vec<f64>,
    network: &Network,
    prior: &Statistics,
    experiments: &[Experiment],
) -> Vec<f64> {
    for Experiment { v, y, .. } in experiments {
        let samples = STATE_SAMPLES.min(y.len());
        let (v, y) = (&v[..samples * network.shape.inputs], &y[..samples]);
        let mean = std::slice::from_ref(&prior.state_mean);
        let state = state::update(network, prior, v, y, mean);
        theta.extend(state.unwrap_or_else(|| prior.state_mean.clone()));
    }
    theta
}

fn check(settings: &Settings) -> Result<()> {
    starts::check(settings.max_iterations, settings.starts)?;
    let decays = settings.weight_decay >= 0.0 && settings.weight_decay.is_finite();
    if !decays {
        return Err(Error::setting(format!(
            "expected a weight decay of 0 or more, got {}; 1e-3 is usual on few data, 1e-8 on many",
            settings.weight_decay
        )));
    }
    let spreads = settings.hidden_scale > 0.0 && settings.hidden_scale.is_finite();
    if !spreads {
        return Err(Error::setting(format!(
            "expected a hidden scale above 0, got {}; .3 to 1 is usual",
            settings.hidden_scale
        )));
    }
    Ok(())
}

/// Refuses models to be trained further that are of different kinds, or not as many as starts.
fn check_initial(settings: &Settings, shape: Shape, scaling: &Scaling) -> Result<()> {
    let initial = &settings.initial;
    let alike = |m: &NeuralSS| {
        m.shape() == shape && m.output() == settings.output && m.scaling() == scaling
    };
    if initial.is_empty() || (initial.len() == settings.starts && initial.iter().all(alike)) {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected {} initial models, one for each start, all of {shape:?} with one scaling and output function, got {} models or others; train different models apart",
        settings.starts,
        initial.len()
    )))
}
