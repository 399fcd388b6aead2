//! The guard: tests whether a trained model also holds beyond its record. Begin reading at `verdict`.
//!
//! A model that fits its record can still run away on other inputs, or have two equilibria instead of the drive's one
//! and stay at the wrong one. Runs over inputs a quarter larger, from other initial states, and over the record's
//! blocks in other orders show that. They need whole records: within a short block a slow drive forgets nothing.
//! Results are measured in widths of the output's range, so one set of bounds serves every drive. If the drive itself
//! is slow, so are its linear models, and the bounds are relaxed to what these do in the same runs.

use crate::data::window;
use crate::lagged::{Lagged, STATE_SAMPLES};
use crate::linear::LinearModel;
use crate::{Error, ErrorKind, Monitor, Record, Result};

/// Most samples of an experiment that are used, from its beginning.
const LONGEST: usize = 20_000;
/// Factor by which inputs are enlarged around their means.
const ENLARGED: f64 = 1.25;
/// How far beyond the training output's range enlarged inputs may drive a run, in widths.
const ROOM: f64 = 1.0;
/// The same for the training's own inputs, in their order or in another.
const ROOM_AT_HOME: f64 = 0.5;
/// How far beyond the range a model with past outputs is started.
const BESIDE: f64 = 0.25;
/// Largest mean distance, over the last tenth, between runs from different states.
const FORGOTTEN: f64 = 0.2;
/// Blocks into which an input is cut for another order.
const BLOCKS: usize = 8;
/// Strides through the blocks, coprime to their number.
const STEPS: [usize; 2] = [3, 5];
/// Least samples of a block: shorter experiments are not tested with another order.
const SHORTEST_BLOCK: usize = 100;
/// Mean distance in the second halves of the blocks that is always allowed.
const REMEMBERED: f64 = 0.03;
/// Largest mean distance that linear models can justify beyond that, unless a linear model itself exceeds it. Values of
/// an output at unrelated times are about a third of its range apart.
const MOST_REMEMBERED: f64 = 0.3;
/// Largest ratio to the linear models' results.
const MORE: f64 = 1.5;

/// Why a model is not sound.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unsound {
    /// The free run over the record itself goes far beyond its range, or is not finite.
    Record,
    /// Larger inputs drive it far beyond what they would do to the drive.
    Larger,
    /// Runs from different states do not come together.
    State,
    /// Inputs of the record's own size in another order drive it beyond the range.
    Away,
    /// Its output in a block depends on earlier blocks, for longer than the drive remembers.
    Order,
}

impl Unsound {
    /// The reason, worded to follow "the model".
    pub fn reason(self) -> &'static str {
        match self {
            Self::Record => "runs away on its own record",
            Self::Larger => "runs away on inputs a quarter larger",
            Self::State => "does not forget its initial state",
            Self::Away => "runs away on its inputs in another order",
            Self::Order => "depends on the order of its inputs",
        }
    }
}

/// A model that can be guarded. All values are in the data's units except the state, which is the model's own.
pub trait Guarded {
    /// Number of inputs.
    fn inputs(&self) -> usize;

    /// The state before these first samples.
    ///
    /// # Errors
    /// `ErrorKind::Fit` if no state has a finite free run.
    fn first_state(&self, u: &[f64], y: &[f64]) -> Result<Vec<f64>>;

    /// Free run, time first.
    ///
    /// # Errors
    /// `ErrorKind::Fit` for a run that leaves the finite numbers, or is stopped.
    fn free_run(&self, u: &[f64], state: &[f64], monitor: &Monitor) -> Result<Vec<f64>>;

    /// Two states on either side of those met in training, in which the outputs ranged from `low` to `high`.
    fn states_beside(&self, low: f64, high: f64) -> [Vec<f64>; 2];

    /// Whether a state is integrated: it is then never forgotten, and depends on all earlier inputs.
    fn integrates(&self) -> bool {
        false
    }

    /// Whether the outputs come from a sensor that does not see the sign.
    fn is_rectified(&self) -> bool {
        false
    }
}

impl<M: Lagged> Guarded for M {
    fn inputs(&self) -> usize {
        self.lags().channels
    }

    fn first_state(&self, u: &[f64], y: &[f64]) -> Result<Vec<f64>> {
        self.estimate_initial_state(u, self.lags().channels, y)
    }

    fn free_run(&self, u: &[f64], state: &[f64], _: &Monitor) -> Result<Vec<f64>> {
        self.simulate(u, self.lags().channels, state)
    }

    fn states_beside(&self, low: f64, high: f64) -> [Vec<f64>; 2] {
        let room = BESIDE * (high - low);
        [low - room, high + room].map(|y| vec![y; self.lags().na])
    }
}

/// A linear model with which another model is compared; rectified like the sensor if that does not see the sign.
struct Yardstick<'a> {
    model: &'a LinearModel,
    rectified: bool,
}

impl Guarded for Yardstick<'_> {
    fn inputs(&self) -> usize {
        self.model.inputs()
    }

    fn first_state(&self, u: &[f64], y: &[f64]) -> Result<Vec<f64>> {
        self.model.first_state(u, y)
    }

    fn free_run(&self, u: &[f64], state: &[f64], monitor: &Monitor) -> Result<Vec<f64>> {
        let mut run = self.model.free_run(u, state, monitor)?;
        if self.rectified {
            run.iter_mut().for_each(|y| *y = y.abs());
        }
        Ok(run)
    }

    fn states_beside(&self, low: f64, high: f64) -> [Vec<f64>; 2] {
        self.model.states_beside(low, high)
    }
}

/// Why `model` is not sound on these records; `None` if it is.
///
/// The bounds are those of a drive that forgets quickly or, if larger, 1.5 times the worst of the `linear` models of
/// the same records. Without linear models the order of the inputs is tested less strictly. An integrated state need
/// not forget; it only has to move at a speed like that of its record.
///
/// # Errors
/// `ErrorKind::Data` for records that do not fit the model, `ErrorKind::Setting` for linear models that do not,
/// `ErrorKind::Fit` if a stop was requested.
pub fn verdict<M: Guarded>(
    model: &M,
    records: &[Record],
    linear: &[LinearModel],
    monitor: &Monitor,
) -> Result<Option<Unsound>> {
    check(model, records, linear)?;
    let task = Task {
        records,
        range: Range::of(records)?,
        by_level: !linear.is_empty(),
        monitor,
    };
    let Some(found) = task.distances(model)? else {
        return Ok(Some(Unsound::Record));
    };
    let integrates = model.integrates();
    if linear.is_empty() {
        return Ok(found.verdict(None, integrates));
    }
    // most models are sound without a look at the linear ones
    let mut known = Distances::default();
    if found.verdict(Some(&known), integrates).is_none() {
        return Ok(None);
    }
    for linear in linear {
        let yardstick = Yardstick {
            model: linear,
            rectified: model.is_rectified(),
        };
        if let Some(its) = task.distances(&yardstick)?.filter(Distances::are_finite) {
            known = known.or_larger(&its);
        }
    }
    Ok(found.verdict(Some(&known), integrates))
}

fn check<M: Guarded>(model: &M, records: &[Record], linear: &[LinearModel]) -> Result<()> {
    let inputs = model.inputs();
    if records.is_empty() {
        return Err(Error::data("expected one experiment or more, got none"));
    }
    if let Some(record) = records.iter().find(|r| r.channels != inputs) {
        return Err(Error::data(format!(
            "expected {inputs} inputs in every experiment, got {}; give the records that the model was trained on",
            record.channels
        )));
    }
    if linear.iter().any(|l| l.lags().channels != inputs) {
        return Err(Error::setting(format!(
            "expected linear models of {inputs} inputs, as the model has, got others; leave them out"
        )));
    }
    Ok(())
}

/// The range of the output.
struct Range {
    low: f64,
    high: f64,
}

impl Range {
    /// Unknown outputs do not count.
    fn of(records: &[Record]) -> Result<Self> {
        let (low, high) = extremes(records.iter().flat_map(|r| r.y));
        if low < high {
            return Ok(Self { low, high });
        }
        Err(Error::data(
            "expected an output that changes, got a constant or no known value; excite the drive",
        ))
    }

    fn width(&self) -> f64 {
        self.high - self.low
    }

    /// How far values go beyond the range, in widths.
    fn beyond<'a>(&self, values: impl Iterator<Item = &'a f64>) -> f64 {
        let (low, high) = extremes(values);
        (self.low - low).max(high - self.high).max(0.0) / self.width()
    }
}

/// Smallest and largest value.
fn extremes<'a>(values: impl Iterator<Item = &'a f64>) -> (f64, f64) {
    let wider = |(low, high): (f64, f64), v: &f64| (low.min(*v), high.max(*v));
    values.fold((f64::INFINITY, f64::NEG_INFINITY), wider)
}

/// Results of a model's runs in widths of the output's range; each is the largest over experiments.
#[derive(Clone, Copy, Debug, Default)]
struct Distances {
    /// Beyond the range, on the record itself.
    record: f64,
    /// Beyond the range, on enlarged inputs.
    larger: f64,
    /// On these, the changes from sample to sample beyond those in the record, in widths of their range.
    faster: f64,
    /// Distance left at the end between runs from other states and the one over the record.
    state: f64,
    /// Beyond the range, with the inputs in another order.
    away: f64,
    /// Mean distance, in the second halves of blocks, from the run in the record's order.
    order: f64,
}

impl Distances {
    fn or_larger(&self, other: &Self) -> Self {
        Self {
            record: self.record.max(other.record),
            larger: self.larger.max(other.larger),
            faster: self.faster.max(other.faster),
            state: self.state.max(other.state),
            away: self.away.max(other.away),
            order: self.order.max(other.order),
        }
    }

    fn are_finite(&self) -> bool {
        let sum = self.record + self.larger + self.faster + self.state + self.away + self.order;
        sum.is_finite()
    }

    /// The first bound that is exceeded; `known` are the results of the linear models, if there are any.
    fn verdict(&self, known: Option<&Self>, integrates: bool) -> Option<Unsound> {
        let linear = known.copied().unwrap_or_default();
        let within = |found: f64, bound: f64, linear: f64| found <= bound.max(MORE * linear);
        if !integrates && !within(self.record, ROOM_AT_HOME, linear.record) {
            return Some(Unsound::Record);
        }
        // a position may be driven anywhere, if its speeds are like those of its record
        let stays = within(self.larger, ROOM, linear.larger)
            || (integrates && within(self.faster, ROOM, linear.faster));
        if !stays {
            return Some(Unsound::Larger);
        }
        if integrates {
            return None;
        }
        if !within(self.state, FORGOTTEN, linear.state) {
            return Some(Unsound::State);
        }
        if !within(self.away, ROOM_AT_HOME, linear.away) {
            return Some(Unsound::Away);
        }
        let remembered = known.map_or(MOST_REMEMBERED, |linear| {
            (MORE * linear.order).min(MOST_REMEMBERED.max(linear.order))
        });
        let holds = self.order <= REMEMBERED + remembered;
        (!holds).then_some(Unsound::Order)
    }
}

/// The records, with all that is common to every model.
struct Task<'a> {
    records: &'a [Record<'a>],
    range: Range,
    /// Whether blocks are also sorted by their level, which leads a slow drive far away.
    by_level: bool,
    monitor: &'a Monitor,
}

impl Task<'_> {
    /// Over all experiments; `None` if a free run over one of them is not finite.
    fn distances<M: Guarded>(&self, model: &M) -> Result<Option<Distances>> {
        let mut all = Distances::default();
        for record in self.records {
            let Some(its) = self.distances_in(model, record)? else {
                return Ok(None);
            };
            all = all.or_larger(&its);
        }
        Ok(Some(all))
    }

    fn distances_in<M: Guarded>(&self, model: &M, r: &Record) -> Result<Option<Distances>> {
        let inputs = r.channels;
        let u = &r.u[..r.len().min(LONGEST) * inputs];
        let first = window(r.y, STATE_SAMPLES).unwrap_or(r.len());
        let Some(state) = self.found(model.first_state(&r.u[..first * inputs], &r.y[..first]))?
        else {
            return Ok(None);
        };
        let run = |u: &[f64], state: &[f64]| self.found(model.free_run(u, state, self.monitor));
        let Some(usual) = run(u, &state)? else {
            return Ok(None);
        };
        let mut its = Distances {
            record: self.range.beyond(usual.iter()),
            ..Distances::default()
        };
        let outside = f64::INFINITY;
        let larger = run(&enlarged(u, inputs), &state)?;
        let beyond = |run: &Vec<f64>| self.range.beyond(run.iter());
        its.larger = larger.as_ref().map_or(outside, beyond);
        its.faster = larger.map_or(outside, |run| faster(&run, &usual, r.y));
        for state in model.states_beside(self.range.low, self.range.high) {
            let left = run(u, &state)?.map_or(outside, |other| self.left(&other, &usual));
            its.state = its.state.max(left);
        }
        for order in orders(u, inputs, self.by_level) {
            let other = run(&rearranged(u, inputs, &order.blocks), &state)?;
            let away = other.as_ref().map_or(outside, beyond);
            its.away = its.away.max(away);
            if order.by_step {
                let apart = |run: Vec<f64>| self.apart(&run, &usual, &order.blocks);
                its.order = its.order.max(other.map_or(outside, apart));
            }
        }
        Ok(Some(its))
    }

    /// The result of a run: `None` if its values are not finite, an error if it was stopped.
    fn found<T>(&self, result: Result<T>) -> Result<Option<T>> {
        if self.monitor.stopped() {
            return Err(Error::fit(
                "expected to run a model beside its record, got a stop; ask again",
            ));
        }
        match result {
            Ok(found) => Ok(Some(found)),
            Err(error) if error.kind == ErrorKind::Fit => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Mean distance of two runs over their last tenth.
    fn left(&self, run: &[f64], usual: &[f64]) -> f64 {
        let from = usual.len() - usual.len().div_ceil(10);
        self.mean_distance(run[from..].iter().zip(&usual[from..]))
    }

    /// Mean distance in the second halves of the blocks of a run over rearranged inputs.
    fn apart(&self, run: &[f64], usual: &[f64], blocks: &[usize]) -> f64 {
        let length = run.len() / BLOCKS;
        let second = |block: usize| block * length + length / 2..(block + 1) * length;
        let pairs = blocks.iter().enumerate().flat_map(|(place, &block)| {
            let (own, other) = (&run[second(place)], &usual[second(block)]);
            own.iter().zip(other)
        });
        self.mean_distance(pairs)
    }

    /// In widths of the range.
    fn mean_distance<'a>(&self, pairs: impl Iterator<Item = (&'a f64, &'a f64)>) -> f64 {
        let (sum, count) = pairs.fold((0.0, 0.0), |(sum, n), (a, b)| {
            (sum + (a - b).abs(), n + 1.0)
        });
        sum / (count * self.range.width())
    }
}

/// How far a run's changes from sample to sample exceed those of the record, in widths of their range.
///
/// Noise makes the measured changes larger than the true ones, and a model that moves too fast makes its own too
/// large: the narrower range counts.
fn faster(run: &[f64], usual: &[f64], measured: &[f64]) -> f64 {
    let changes = |run: &[f64]| -> Vec<f64> {
        let changes = run.iter().zip(&run[1..]).map(|(now, next)| next - now);
        changes.filter(|change| !change.is_nan()).collect()
    };
    let range = |run: &[f64]| {
        let (low, high) = extremes(changes(run).iter());
        Range { low, high }
    };
    let (own, known) = (range(usual), range(measured));
    let is_narrower = known.width() > 0.0 && known.width() < own.width();
    let usual = if is_narrower { known } else { own };
    usual.beyond(changes(run).iter()).max(0.0)
}

/// The inputs, a quarter larger around their means.
fn enlarged(u: &[f64], channels: usize) -> Vec<f64> {
    let samples = (u.len() / channels) as f64;
    let mean = |j: usize| u.iter().skip(j).step_by(channels).sum::<f64>() / samples;
    let means: Vec<f64> = (0..channels).map(mean).collect();
    let enlarge = |(i, u): (usize, &f64)| {
        let mean = means[i % channels];
        mean + ENLARGED * (u - mean)
    };
    u.iter().enumerate().map(enlarge).collect()
}

/// An order of an input's blocks.
struct Order {
    blocks: Vec<usize>,
    /// Whether the blocks are shuffled by a stride, not sorted.
    by_step: bool,
}

/// The blocks shuffled and, with `by_level`, sorted by the mean of each input, rising and falling. The record as it is
/// may miss a false equilibrium just beside the data, but a longer stay at an end of the range leads there. Empty for
/// inputs too short to be cut.
fn orders(u: &[f64], channels: usize, by_level: bool) -> Vec<Order> {
    let length = u.len() / channels / BLOCKS;
    if length < SHORTEST_BLOCK {
        return Vec::new();
    }
    let mut orders: Vec<Order> = STEPS
        .iter()
        .map(|step| Order {
            blocks: (0..BLOCKS).map(|i| (i + 1) * step % BLOCKS).collect(),
            by_step: true,
        })
        .collect();
    let level = |block: usize, j: usize| -> f64 {
        let values = &u[block * length * channels..(block + 1) * length * channels];
        values.iter().skip(j).step_by(channels).sum()
    };
    for j in (0..channels).filter(|_| by_level) {
        let levels: Vec<f64> = (0..BLOCKS).map(|block| level(block, j)).collect();
        let mut rising: Vec<usize> = (0..BLOCKS).collect();
        rising.sort_by(|&a, &b| levels[a].total_cmp(&levels[b]));
        let falling = rising.iter().rev().copied().collect();
        orders.extend([rising, falling].map(|blocks| Order {
            blocks,
            by_step: false,
        }));
    }
    orders
}

/// The inputs with their blocks in this order.
fn rearranged(u: &[f64], channels: usize, blocks: &[usize]) -> Vec<f64> {
    let size = u.len() / channels / BLOCKS * channels;
    let block = |&i: &usize| &u[i * size..(i + 1) * size];
    blocks.iter().flat_map(block).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagged::Lags;
    use crate::neural::{self, NeuralOE};
    use crate::random::Random;

    /// A model whose free run is an arbitrary function of inputs and a state.
    struct Any<F> {
        run: F,
        integrates: bool,
    }

    impl<F: Fn(&[f64], f64) -> Vec<f64>> Guarded for Any<F> {
        fn inputs(&self) -> usize {
            1
        }

        fn first_state(&self, _: &[f64], y: &[f64]) -> Result<Vec<f64>> {
            Ok(vec![y[0]])
        }

        fn free_run(&self, u: &[f64], state: &[f64], _: &Monitor) -> Result<Vec<f64>> {
            let run = (self.run)(u, state[0]);
            match run.iter().all(|y| y.is_finite()) {
                true => Ok(run),
                false => Err(Error::fit("not finite")),
            }
        }

        fn states_beside(&self, low: f64, high: f64) -> [Vec<f64>; 2] {
            [low, high].map(|y| vec![y])
        }

        fn integrates(&self) -> bool {
            self.integrates
        }
    }

    /// Levels that are held for 50 samples.
    fn levels(samples: usize, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        let steps: Vec<f64> = (0..samples.div_ceil(50))
            .map(|_| random.between(-1.0, 1.0))
            .collect();
        (0..samples).map(|k| steps[k / 50]).collect()
    }

    fn lag(pole: f64) -> LinearModel {
        LinearModel::new(vec![-pole], vec![1.0 - pole], 1, 1, 0.0).unwrap()
    }

    fn asked<M: Guarded>(
        model: &M,
        u: &[f64],
        y: &[f64],
        linear: &[LinearModel],
    ) -> Option<Unsound> {
        let record = Record::with_gaps(u, 1, y).unwrap();
        verdict(model, &[record], linear, &Monitor::default()).unwrap()
    }

    #[test]
    fn passes_a_model_that_forgets_as_its_drive_does() {
        let u = levels(2_000, 1);
        let y = lag(0.9).simulate(&u, 1, &[0.0]).unwrap();
        assert_eq!(asked(&lag(0.9), &u, &y, &[]), None);
        assert_eq!(asked(&lag(0.9), &u, &y, &[lag(0.9)]), None);
        let mut gaps = y.clone();
        gaps[..300].fill(f64::NAN);
        assert_eq!(asked(&lag(0.9), &u, &gaps, &[lag(0.9)]), None);
    }

    #[test]
    fn a_slow_drive_is_given_the_time_that_its_linear_model_needs() {
        let u = levels(1_500, 2);
        let y = lag(0.9995).simulate(&u, 1, &[0.0]).unwrap();
        assert_eq!(asked(&lag(0.9995), &u, &y, &[]), Some(Unsound::State));
        assert_eq!(asked(&lag(0.9996), &u, &y, &[lag(0.9995)]), None);
        assert_eq!(
            asked(&lag(0.9995), &u, &y, &[lag(0.9)]),
            Some(Unsound::State)
        );
    }

    #[test]
    fn refuses_what_runs_away() {
        let u = levels(2_000, 3);
        let y = lag(0.9).simulate(&u, 1, &[0.0]).unwrap();
        assert_eq!(asked(&lag(1.7), &u, &y, &[]), Some(Unsound::Record));
        assert_eq!(
            asked(&lag(1.001), &u, &y, &[lag(0.9)]),
            Some(Unsound::Record)
        );
        let largest = u.iter().fold(0.0_f64, |m, u| m.max(u.abs()));
        let beyond = |u: &[f64], _: f64| -> Vec<f64> {
            let kick = |u: &f64| if u.abs() > 1.1 * largest { 9.0 } else { *u };
            u.iter().map(kick).collect()
        };
        let model = Any {
            run: beyond,
            integrates: false,
        };
        assert_eq!(asked(&model, &u, &u, &[lag(0.1)]), Some(Unsound::Larger));
        // a linear model that goes as far justifies it
        let far = LinearModel::new(vec![0.0], vec![9.0], 1, 0, 0.0).unwrap();
        assert_eq!(asked(&model, &u, &u, &[far]), None);
    }

    #[test]
    fn refuses_a_network_of_which_the_start_decides_where_it_rests() {
        let shape = neural::Shape::new(Lags::new(1, 1, 1, 1).unwrap(), 1, true).unwrap();
        let scaling = neural::Scaling {
            u_mean: vec![0.0],
            u_scale: vec![1.0],
            y_mean: 0.0,
            y_scale: 1.0,
        };
        let limits = (f64::NEG_INFINITY, f64::INFINITY);
        let network = |hidden: f64| {
            let theta = vec![4.0, 0.0, 0.0, hidden, 0.0, 0.7, 0.1];
            NeuralOE::new(shape, theta, scaling.clone(), limits).unwrap()
        };
        let u: Vec<f64> = (0..600).map(|k| (k as f64 * 0.05).sin()).collect();
        let sound = |model: &NeuralOE| {
            let y = model.simulate(&u, 1, &[0.02]).unwrap();
            asked(model, &u, &y, &[lag(0.7)])
        };
        assert_eq!(sound(&network(0.0)), None);
        assert_eq!(sound(&network(1.0)), Some(Unsound::State));
    }

    /// Counts up at high inputs and down at low ones, and otherwise stays.
    fn latched(u: &[f64], start: f64) -> Vec<f64> {
        let mut latch = start.signum();
        let next = |u: &f64| {
            latch = if u.abs() > 0.8 { u.signum() } else { latch };
            0.5 * u + 0.2 * latch
        };
        u.iter().map(next).collect()
    }

    #[test]
    fn refuses_what_depends_on_blocks_long_past() {
        // it latches in one sample of three thousand and is released in another: at its end the record has forgotten its start
        let mut u: Vec<f64> = levels(8_000, 4).iter().map(|u| 0.5 * u).collect();
        u[2_100] = 1.0;
        u[5_100] = -1.0;
        let y = latched(&u, -1.0);
        let model = Any {
            run: latched,
            integrates: false,
        };
        assert_eq!(asked(&model, &u, &y, &[lag(0.5)]), Some(Unsound::Order));
        // it cannot be distinguished from a drive that remembers as long
        let long = LinearModel::new(vec![-0.9997], vec![0.005], 1, 1, 0.0).unwrap();
        assert_eq!(asked(&model, &u, &y, &[long]), None);
    }

    #[test]
    fn an_integrator_has_only_to_move_at_a_like_speed() {
        let u: Vec<f64> = (0..3_000).map(|k| (k as f64 * 0.1).sin()).collect();
        let position = |gain: fn(f64) -> f64| {
            move |u: &[f64], start: f64| -> Vec<f64> {
                let mut y = start;
                u.iter()
                    .map(|u| {
                        y += gain(*u);
                        y
                    })
                    .collect()
            }
        };
        // friction that is exceeded on one side only: on larger inputs it drifts away, as the drive would
        let drifts = position(|u| if u > 1.05 { 1.5 } else { u });
        let bolts = position(|u| if u > 1.05 { 30.0 } else { u });
        let y = drifts(&u, 0.0);
        let at = |integrates| Any {
            run: drifts,
            integrates,
        };
        assert_eq!(asked(&at(true), &u, &y, &[]), None);
        assert_eq!(asked(&at(false), &u, &y, &[]), Some(Unsound::Larger));
        let bolting = Any {
            run: bolts,
            integrates: true,
        };
        assert_eq!(asked(&bolting, &u, &y, &[]), Some(Unsound::Larger));
        // a model that runs away on the record itself must not set its own bounds
        let grows = |u: &[f64], start: f64| -> Vec<f64> {
            let grown = |k: usize| start + (k as f64 * 0.01).exp();
            (0..u.len()).map(grown).collect()
        };
        let growing = Any {
            run: grows,
            integrates: true,
        };
        assert_eq!(asked(&growing, &u, &y, &[]), Some(Unsound::Larger));
    }

    #[test]
    fn hears_a_stop_and_refuses_what_does_not_fit() {
        let u = levels(1_000, 5);
        let record = Record::new(&u, 1, &u).unwrap();
        let ask = |linear: &[LinearModel], monitor: &Monitor| {
            verdict(&lag(0.5), &[record], linear, monitor)
                .unwrap_err()
                .kind
        };
        let stopped = Monitor::default();
        stopped.request_stop();
        assert_eq!(ask(&[], &stopped), ErrorKind::Fit);
        let two = LinearModel::new(vec![0.0], vec![1.0, 1.0], 2, 0, 0.0).unwrap();
        assert_eq!(ask(&[two], &Monitor::default()), ErrorKind::Setting);
        let still = Record::new(&u, 1, &[1.0; 1_000]).unwrap();
        let pairs = Record::new(&u, 2, &u[..500]).unwrap();
        for bad in [&[still][..], &[pairs], &[]] {
            let found = verdict(&lag(0.5), bad, &[], &Monitor::default());
            assert_eq!(found.unwrap_err().kind, ErrorKind::Data);
        }
    }

    #[test]
    fn enlarges_each_input_about_its_mean() {
        assert_eq!(enlarged(&[0.0, 5.0, 4.0, 5.0], 2), [-0.5, 5.0, 4.5, 5.0]);
    }

    #[test]
    fn rearranges_whole_blocks_and_loses_none() {
        let samples = BLOCKS * SHORTEST_BLOCK;
        let u: Vec<f64> = (0..2 * samples).map(|i| (i * 7 % 23) as f64).collect();
        let found = orders(&u, 2, true);
        assert_eq!(found.len(), STEPS.len() + 2 * 2);
        for order in &found {
            let mut blocks = order.blocks.clone();
            blocks.sort_unstable();
            assert_eq!(blocks, (0..BLOCKS).collect::<Vec<_>>());
            let other = rearranged(&u, 2, &order.blocks);
            assert_ne!(other, u);
            assert_eq!(
                other[..2 * SHORTEST_BLOCK],
                u[2 * SHORTEST_BLOCK * order.blocks[0]..][..2 * SHORTEST_BLOCK]
            );
        }
        assert!(orders(&u, 2, false).iter().all(|order| order.by_step));
        assert!(orders(&u[..2 * samples - 2], 2, true).is_empty());
    }
}
