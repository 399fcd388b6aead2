//! Training in free run: many starts in parallel, each by Levenberg-Marquardt; the best free run is chosen.

use super::network::{Network, Shape};
use super::problem::{Experiment, FreeRun};
use super::scaling::Scaling;
use super::{NeuralOE, draw, free_run};
use crate::data::window;
use crate::guard;
use crate::lagged::{Lagged, STATE_SAMPLES};
use crate::linear::LinearModel;
use crate::lm::{self, Damping, Outcome, Termination};
use crate::random::Random;
use crate::{Error, Monitor, Record, Result, arx, starts};

/// Where a free run starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InitialState {
    /// Past outputs zero: a machine at rest.
    Zero,
    /// The first `na` outputs are taken as measured; the run starts after them.
    Measured,
    /// Parameters of the fit, one set per experiment.
    Estimated,
}

/// What to train, and how.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Past outputs.
    pub na: usize,
    /// Past values of each input.
    pub nb: usize,
    /// Delay in samples.
    pub nk: usize,
    /// Hidden units.
    pub hidden: usize,
    /// Gives the network a bypass that starts as this model; `None` for no bypass.
    pub linear: Option<LinearModel>,
    /// Scaling; `None` for the means and standard deviations of the training data.
    pub scaling: Option<Scaling>,
    /// The output saturates at the training output's range, whose width is first multiplied by `1 + saturate`.
    pub saturate: Option<f64>,
    /// Where each experiment's free run starts.
    pub initial_state: InitialState,
    /// Weight of `1/2 (|W1|^2 + |w2|^2 + .1 |b1|^2)` beside J; 1e-8 or less on much data.
    pub weight_decay: f64,
    /// Iterations of each start.
    pub max_iterations: usize,
    /// Number of starts.
    pub starts: usize,
    /// Parameters in scaled units from which the starts begin, one after the other; `None` to draw them.
    pub initial_theta: Option<Vec<f64>>,
    /// Seed of the starts; start `i` draws from stream `i`.
    pub seed: u64,
    /// Threads; 0 for as many as the machine has. The result does not depend on it.
    pub threads: usize,
}

/// A trained network and how it was trained.
#[derive(Clone, Debug)]
pub struct NeuralFit {
    /// The chosen model.
    pub model: NeuralOE,
    /// `J = 1/(2N) sum e^2` in scaled units, free run, on the training data, without weight decay.
    pub cost: f64,
    /// The same on the validation data, if there are any.
    pub validation_cost: Option<f64>,
    /// Iterations of the chosen start.
    pub iterations: usize,
    /// Steps tried by it.
    pub trials: usize,
    /// How the chosen start ended.
    pub termination: Termination,
    /// J of the chosen start, at its beginning and after each accepted step.
    pub trace: Vec<f64>,
    /// Which start was chosen.
    pub start: usize,
    /// The score of each start: J on the validation data, else on the training data; infinite for a failed one.
    pub start_costs: Vec<f64>,
    /// Dead starts that were drawn again.
    pub discarded: usize,
    /// Whether the chosen model passed the [`guard`](crate::guard) on the training data; false only if no start did.
    pub sound: bool,
    /// Models of all starts with a finite cost, those that passed the guard first, each part best first.
    pub models: Vec<NeuralOE>,
    /// Past outputs of each training experiment, newest first, in the data's unit.
    pub initial_states: Vec<Vec<f64>>,
}

/// First damping, the best of .01, .1 and 1 by training cost on one simulated drive, where of 12 random starts 9, 10
/// and 11 ended within 1.3 of the noise floor. On other drives expect two of three.
const FIRST_MU: f64 = 1.0;
/// A start with more than this share of its samples on a limit has no slope to learn from.
const DEAD_SHARE: f64 = 0.9;

/// Trains `settings.starts` networks in free run and chooses by J on the validation data, else on the training data.
///
/// With validation data each start keeps its best iterate on them, and a start that diverges there is never chosen. A
/// start is dead if its free run is not finite, lies on a limit almost throughout or ends no better than a constant
/// output. It is drawn again from its own stream and counted in `discarded`.
///
/// A start whose model does not pass the guard is chosen only if none does.
///
/// # Errors
/// `ErrorKind::Data` and `ErrorKind::Setting` for data or settings that cannot be trained; `ErrorKind::Fit` if every start failed.
pub fn fit(
    records: &[Record],
    validation: &[Record],
    settings: &Settings,
    monitor: &Monitor,
) -> Result<NeuralFit> {
    let training = Training::new(records, validation, settings, monitor)?;
    monitor.set_total((settings.starts * settings.max_iterations) as u64);
    let results = starts::run_all(settings.starts, settings.threads, monitor, |start| {
        training.run(start)
    });
    training.chosen(results)
}

/// The data that all starts share.
pub(super) struct Training<'a> {
    pub settings: &'a Settings,
    monitor: &'a Monitor,
    records: Vec<Record<'a>>,
    pub shape: Shape,
    scaling: Scaling,
    pub limits: (f64, f64),
    experiments: Vec<Experiment>,
    pub validation: Vec<Experiment>,
    linear: Option<Vec<f64>>,
    constant_cost: f64,
}

/// One trained start.
struct Trained {
    theta: Vec<f64>,
    cost: f64,
    validation_cost: Option<f64>,
    outcome: Outcome,
    trace: Vec<f64>,
    discarded: usize,
    sound: bool,
}

impl<'a> Training<'a> {
    fn new(
        records: &[Record<'a>],
        validation: &[Record],
        settings: &'a Settings,
        monitor: &'a Monitor,
    ) -> Result<Self> {
        let lags = arx::check(records, settings.na, settings.nb, settings.nk)?;
        check(settings)?;
        let shape = Shape::new(lags, settings.hidden, settings.linear.is_some())?;
        check_initial(settings, shape)?;
        check_records(records, validation, shape)?;
        let scaling = settings
            .scaling
            .clone()
            .unwrap_or_else(|| Scaling::of(records));
        scaling.check(lags.channels)?;
        let linear = settings.linear.as_ref();
        let bypass = linear
            .map(|l| draw::bypass(l, &scaling, shape))
            .transpose()?;
        let scaled = |r: &Record| Experiment::new(r, &scaling, lags.na, settings.initial_state);
        let mut experiments: Vec<Experiment> = records.iter().map(scaled).collect();
        let validation: Vec<Experiment> = validation.iter().map(scaled).collect();
        check_starts(&experiments, &validation, lags.na)?;
        if let (Some(linear), InitialState::Estimated) = (linear, settings.initial_state) {
            for (experiment, record) in experiments.iter_mut().zip(records) {
                // the run begins at the first measured sample, which may come after a gap
                let first = experiment.first;
                let u = &record.u[first * record.channels..];
                let state =
                    linear.estimate_initial_state(u, record.channels, &record.y[first..])?;
                experiment.state = state.iter().map(|&y| scaling.output(y)).collect();
            }
        }
        Ok(Self {
            settings,
            monitor,
            records: records.to_vec(),
            shape,
            limits: limits(&experiments, settings.saturate),
            constant_cost: constant_cost(&experiments),
            validation,
            experiments,
            scaling,
            linear: bypass,
        })
    }

    /// Trains one start, drawn again while it is dead.
    fn run(&self, start: usize) -> Option<Trained> {
        if let Some(theta) = &self.settings.initial_theta {
            let mut problem = self.problem();
            let parameters = self.shape.parameters();
            let theta = problem.start(&theta[start * parameters..][..parameters]);
            return self.train(&mut problem, theta);
        }
        let mut random = Random::stream(self.settings.seed, start as u64);
        let train = || {
            let mut problem = self.problem();
            let (theta, dead) = self.drawn(&mut problem, &mut random)?;
            Some((self.train(&mut problem, theta)?, dead))
        };
        let has_learnt = |t: &Trained| starts::has_learnt(t.cost, self.constant_cost);
        let (trained, discarded) =
            starts::learnt(starts::MOST_TRAININGS, self.monitor, train, has_learnt)?;
        Some(Trained {
            discarded,
            ..trained
        })
    }

    fn problem(&self) -> FreeRun<'_> {
        let network = Network::zero(self.shape, self.limits);
        let estimated = self.settings.initial_state == InitialState::Estimated;
        FreeRun::new(
            &self.experiments,
            network,
            estimated,
            self.settings.weight_decay,
            self.monitor,
        )
    }

    /// Parameters with a usable free run, and how many draws had none.
    fn drawn(&self, problem: &mut FreeRun, random: &mut Random) -> Option<(Vec<f64>, usize)> {
        starts::drawn(self.monitor, || {
            let theta = match &self.linear {
                Some(bypass) => draw::beside(bypass, self.shape, random),
                None => self.warm(draw::small(self.shape, random)),
            };
            let theta = problem.start(&theta);
            let runs = lm::Problem::cost(problem, &theta).is_some();
            (runs && problem.clipped_share() <= DEAD_SHARE).then_some(theta)
        })
    }

    /// The draw with its output layer fitted to predict one step ahead.
    fn warm(&self, mut theta: Vec<f64>) -> Vec<f64> {
        let mut network = Network::zero(self.shape, self.limits);
        network.load(&theta);
        let [_, second, _, _] = self.shape.offsets();
        if let Some(output) = draw::output_layer(&network, &self.experiments) {
            theta[second..second + output.len()].copy_from_slice(&output);
        }
        theta
    }

    fn train(&self, problem: &mut FreeRun, theta: Vec<f64>) -> Option<Trained> {
        let settings = lm::Settings {
            max_iterations: self.settings.max_iterations,
            damping: Damping::Identity,
            mu: FIRST_MU,
            ..lm::Settings::default()
        };
        let own = self.shape.parameters();
        let mut referee = Referee::new(self);
        let mut costs = Vec::with_capacity(settings.max_iterations + 1);
        let outcome = lm::minimize(problem, theta, &settings, self.monitor, |theta, cost| {
            costs.push((cost, theta[..own].to_vec()));
            referee.judge(theta, &theta[..own], cost);
        });
        let trace: Vec<f64> = costs
            .iter()
            .map(|(cost, t)| cost - problem.penalty(t))
            .collect();
        let spare = self.settings.max_iterations - outcome.iterations;
        self.monitor.advance(spare as u64);
        let (_, validation_cost, theta, cost) = referee.best.take()?;
        Some(Trained {
            sound: self.passes(&theta),
            cost: cost - problem.penalty(&theta),
            theta,
            validation_cost,
            outcome,
            trace,
            discarded: 0,
        })
    }

    /// The guard's verdict, independent of the monitor: a trained model is judged even after a stop request.
    fn passes(&self, theta: &[f64]) -> bool {
        let linear = self.settings.linear.as_slice();
        let monitor = Monitor::default();
        self.model(theta)
            .is_ok_and(|model| guard::verdict(&model, &self.records, linear, &monitor) == Ok(None))
    }

    fn chosen(&self, results: Vec<Option<Trained>>) -> Result<NeuralFit> {
        let score = |t: &Option<Trained>| {
            t.as_ref()
                .map_or(f64::INFINITY, |t| starts::score(t.validation_cost, t.cost))
        };
        let start_costs: Vec<f64> = results.iter().map(score).collect();
        let order = starts::ranked(&start_costs, |i| {
            results[i].as_ref().is_some_and(|t| t.sound)
        });
        let models = order
            .iter()
            .filter_map(|&i| results[i].as_ref().map(|t| self.model(&t.theta)));
        let models = models.collect::<Result<Vec<_>>>()?;
        let discarded = results.iter().flatten().map(|t| t.discarded).sum();
        let start = *order.first().ok_or_else(starts::none_left)?;
        let best = results
            .into_iter()
            .nth(start)
            .flatten()
            .ok_or_else(starts::none_left)?;
        let stopped = self.monitor.stopped();
        Ok(NeuralFit {
            model: models[0].clone(),
            cost: best.cost,
            validation_cost: best.validation_cost,
            iterations: best.outcome.iterations,
            trials: best.outcome.trials,
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
            initial_states: self.states(&best.theta),
        })
    }

    fn model(&self, theta: &[f64]) -> Result<NeuralOE> {
        let own = theta[..self.shape.parameters()].to_vec();
        NeuralOE::new(self.shape, own, self.scaling.clone(), self.limits)
    }

    fn states(&self, theta: &[f64]) -> Vec<Vec<f64>> {
        let na = self.shape.lags.na;
        let estimated = theta[self.shape.parameters()..].chunks_exact(na);
        let restored = |state: &[f64]| state.iter().map(|&y| self.scaling.restored(y)).collect();
        match self.settings.initial_state {
            InitialState::Estimated => estimated.map(restored).collect(),
            _ => self
                .experiments
                .iter()
                .map(|e| restored(&e.state))
                .collect(),
        }
    }
}

/// The training output's range, its width multiplied by `1 + widened`, in scaled units.
fn limits(experiments: &[Experiment], widened: Option<f64>) -> (f64, f64) {
    let Some(widened) = widened else {
        return (f64::NEG_INFINITY, f64::INFINITY);
    };
    let outputs = experiments.iter().flat_map(|e| &e.y);
    let (low, high) = outputs.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &y| {
        (l.min(y), h.max(y))
    });
    let margin = 0.5 * widened * (high - low);
    (low - margin, high + margin)
}

/// J of the best constant output.
fn constant_cost(experiments: &[Experiment]) -> f64 {
    let simulated = || {
        experiments
            .iter()
            .flat_map(|e| (e.first..e.y.len()).map(move |k| (e.weight(k), e.y[k])))
    };
    let outputs = || simulated().filter(|(_, y)| !y.is_nan());
    let count: f64 = outputs().map(|(w, _)| w).sum();
    let mean = outputs().map(|(w, y)| w * y).sum::<f64>() / count;
    let squares = outputs().map(|(w, y)| w * ((y - mean) * (y - mean)));
    0.5 * squares.sum::<f64>() / count
}

fn check(settings: &Settings) -> Result<()> {
    starts::check(settings.max_iterations, settings.starts)?;
    let sound = settings.weight_decay >= 0.0 && settings.weight_decay.is_finite();
    if !sound {
        return Err(Error::setting(format!(
            "expected a weight decay of 0 or more, got {}; 1e-8 is usual",
            settings.weight_decay
        )));
    }
    match settings.saturate {
        Some(widened) if !(widened >= 0.0 && widened.is_finite()) => Err(Error::setting(format!(
            "expected saturate of 0 or more, got {widened}; .2 widens the output's range by 20 %"
        ))),
        _ => Ok(()),
    }
}

/// Refuses initial parameters that do not match the shape and the number of starts.
fn check_initial(settings: &Settings, shape: Shape) -> Result<()> {
    let Some(theta) = &settings.initial_theta else {
        return Ok(());
    };
    let finite = theta.iter().filter(|t| t.is_finite()).count();
    if theta.len() != finite || finite != settings.starts * shape.parameters() {
        return Err(Error::setting(format!(
            "expected an initial_theta of {} starts with {} finite numbers each for this shape, got {} numbers of which {finite} are finite; take them from the theta of models of the same orders",
            settings.starts,
            shape.parameters(),
            theta.len()
        )));
    }
    Ok(())
}

fn check_records(records: &[Record], validation: &[Record], shape: Shape) -> Result<()> {
    let (least, channels) = (shape.lags.na + 1, shape.lags.channels);
    for record in records.iter().chain(validation) {
        if record.len() < least || record.channels != channels {
            return Err(Error::data(format!(
                "expected {least} or more samples of {channels} inputs in every experiment, got {} of {}; leave that experiment out",
                record.len(),
                record.channels
            )));
        }
    }
    let (samples, parameters) = (
        records.iter().map(Record::measured).sum::<usize>(),
        shape.parameters(),
    );
    if samples <= parameters {
        return Err(Error::data(format!(
            "expected more than {parameters} samples for as many parameters, got {samples} measured; record longer or use fewer hidden units"
        )));
    }
    Ok(())
}

/// Refuses experiments without a sample left to simulate.
fn check_starts(experiments: &[Experiment], validation: &[Experiment], na: usize) -> Result<()> {
    match experiments
        .iter()
        .chain(validation)
        .find(|e| e.weight_from(e.first) == 0.0)
    {
        None => Ok(()),
        Some(_) => Err(Error::data(format!(
            "expected {na} measured outputs in a row and one after them, got none in an experiment; start at rest or estimate the initial state, or leave that experiment out"
        ))),
    }
}

/// Keeps the best iterate of a start: on the validation data, else on the training data.
struct Referee<'t> {
    training: &'t Training<'t>,
    network: Network,
    /// Score, validation J, all parameters, cost.
    best: Option<(f64, Option<f64>, Vec<f64>, f64)>,
}

impl<'t> Referee<'t> {
    fn new(training: &'t Training<'t>) -> Self {
        let network = Network::zero(training.shape, training.limits);
        Self {
            training,
            network,
            best: None,
        }
    }

    fn judge(&mut self, all: &[f64], theta: &[f64], cost: f64) {
        self.network.load(theta);
        let validation = (!self.training.validation.is_empty()).then(|| self.validation_cost());
        let score = validation.unwrap_or(cost);
        if self.best.as_ref().is_none_or(|b| score < b.0) {
            self.best = Some((score, validation, all.to_vec(), cost));
        }
    }

    /// J over all validation experiments; infinite if one diverges.
    fn validation_cost(&self) -> f64 {
        let scores = self.training.validation.iter().map(|e| self.score(e));
        let (sum, samples) = scores.fold((0.0, 0.0), |(sum, n), (s, m)| (sum + s, n + m));
        let cost = 0.5 * sum / samples;
        if cost.is_nan() { f64::INFINITY } else { cost }
    }

    /// Sum of squared errors, and of the weights of the measured samples in it.
    fn score(&self, experiment: &Experiment) -> (f64, f64) {
        let lags = self.network.shape.lags;
        let estimated = self.training.settings.initial_state == InitialState::Estimated;
        let half = (experiment.measured() / 2).max(1);
        let (first, skipped) = if estimated {
            let known = window(&experiment.y, STATE_SAMPLES.min(half));
            (0, known.unwrap_or(experiment.y.len()))
        } else {
            (experiment.first, experiment.first)
        };
        let state = match estimated {
            true => {
                let u = &experiment.u[..skipped * lags.channels];
                self.network
                    .estimate_initial_state(u, lags.channels, &experiment.y[..skipped])
            }
            false => Ok(experiment.state.clone()),
        };
        let Ok(state) = state else {
            return (f64::INFINITY, 1.0);
        };
        let samples = experiment.y.len() - first;
        let run = free_run::outputs(&self.network, &experiment.u, first, &state, samples);
        if run.last().is_none_or(|y| y.is_nan()) {
            return (f64::INFINITY, 1.0);
        }
        let squares = experiment.squares_from(skipped, &run[skipped - first..]);
        (squares, experiment.weight_from(skipped))
    }
}
