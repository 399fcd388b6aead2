//! One thread's plants and memory: terms and costs of controllers over all plants and references. Runs go one after the
//! other, or side by side with sums accumulated as they run.

use std::cell::OnceCell;

use sewfast_control::{AnyController, AnyDesign, Controller};

use super::cost::{Course, Excess, Measure, SMOOTHING, Terms, Weights};
use super::{Aggregate, Extent, LoadLimit, LoadStep, Task};
use crate::closed_loop::batch::{
    BatchLoop, InLanes, MOST, Sums, Tally, WithKind, are_of_a_kind, of_a_kind,
};
use crate::closed_loop::{KernelPlant, Lead, Outcome, Plant, Run, Signals};
use crate::metrics::Edge;
use crate::search::Judgement;
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};
use crate::speed::Encoder;
use crate::{Monitor, Result};

/// Largest minus smallest value of all references.
fn span(references: &[&[f64]]) -> f64 {
    let all = || references.iter().flat_map(|r| r.iter().copied());
    all().fold(f64::MIN, f64::max) - all().fold(f64::MAX, f64::min)
}

#[derive(Clone, Debug)]
pub(super) struct Bench<P> {
    plants: Vec<P>,
    measures: Vec<Measure>,
    weights: Weights,
    run: Run,
    batch: Batch,
}

/// How many candidates are best judged at once.
pub(super) const TOGETHER: usize = MOST;

impl<P: Plant + Clone> Bench<P> {
    pub(super) fn new(task: &Task<'_, P>) -> Result<Self> {
        let (u_min, u_max) = task.start.limits();
        let weights = task.cost.weights(span(task.references), u_max - u_min)?;
        let longest = (0..task.runs()).map(|k| task.signals(0, k).reference.len());
        let longest = longest.max().unwrap_or(0);
        let measure = |r: &&[f64]| {
            let measure = Measure::needed(r, &weights);
            match task.constraints.overshoot {
                Some(_) => measure.with_overshoot(),
                None => measure,
            }
        };
        Ok(Self {
            plants: task.plants.to_vec(),
            measures: task.references.iter().map(measure).collect(),
            weights,
            run: Run::with_capacity(longest),
            batch: Batch::default(),
        })
    }

    /// The same, but with every term computed.
    pub(super) fn with_all_terms(mut self, task: &Task<'_, P>) -> Self {
        self.measures = task.references.iter().map(|r| Measure::all(r)).collect();
        self
    }

    /// The same, but with the overshoot computed in any case.
    pub(super) fn with_overshoot(mut self) -> Self {
        self.measures = self
            .measures
            .into_iter()
            .map(Measure::with_overshoot)
            .collect();
        self
    }

    /// The same, with the penalty of overshoot rounded over the whole limit: for two of four searches on a part, as with none one position of
    /// eight plants ended in a dearer basin, and with all one axis cost 5.7 % more.
    pub(super) fn smoothed(mut self) -> Self {
        self.weights.rounding = 1.0;
        self
    }

    pub(super) fn weights(&self) -> &Weights {
        &self.weights
    }

    /// How good a controller is.
    pub(super) fn judge_one(
        &mut self,
        task: &Task<'_, P>,
        design: &AnyDesign<f64>,
        monitor: &Monitor,
    ) -> Judgement {
        let trial = (*design, Judgement::HOPELESS);
        let judged = self.judge(task, Extent::Whole, &[trial], monitor);
        judged.first().copied().unwrap_or(Judgement::HOPELESS)
    }

    /// How good controllers are, each with the judgement it has to beat; hopeless if a run diverges or on a stop.
    ///
    /// The work on a controller ends as soon as it cannot beat that any more: its cost is then a lower bound.
    pub(super) fn judge(
        &mut self,
        task: &Task<'_, P>,
        extent: Extent,
        trials: &[(AnyDesign<f64>, Judgement)],
        monitor: &Monitor,
    ) -> Vec<Judgement> {
        let weights = self.weights;
        let designs = trials.iter().map(|(design, _)| design);
        let loops: Vec<_> = designs.map(|d| task.constraints.of_loops(d)).collect();
        let mut totals = vec![Total::default(); trials.len()];
        let mut judgements = vec![Judgement::HOPELESS; trials.len()];
        let designs = trials.iter().map(|(design, _)| *design).collect();
        self.each_run(task, extent, designs, monitor, |i, plant, run, terms| {
            let Some((terms, share)) = terms else {
                judgements[i] = Judgement::HOPELESS;
                return false;
            };
            let total = &mut totals[i];
            total.take(task, plant, &terms);
            total.own += share * weights.of(&terms) / task.alike(run);
            let excess = total.excess(task, loops[i]);
            judgements[i] = Judgement {
                violation: excess.sum,
                cost: total.lower_bound(task),
                excess: excess.largest,
            };
            // Later runs can only increase either.
            !trials[i].1.beats(&judgements[i])
        });
        judgements
    }

    /// What each controller does over all plants and references; `None` if a run diverges or on a stop.
    pub(super) fn records(
        &mut self,
        task: &Task<'_, P>,
        designs: &[AnyDesign<f64>],
        monitor: &Monitor,
    ) -> Vec<Option<Record>> {
        let weights = self.weights;
        let mut means = vec![Some(Mean::default()); designs.len()];
        let (whole, all) = (Extent::Whole, designs.to_vec());
        self.each_run(task, whole, all, monitor, |i, plant, run, terms| {
            let (Some((terms, _)), Some(mean)) = (terms, &mut means[i]) else {
                means[i] = None;
                return false;
            };
            mean.go_to(plant, task);
            mean.total.take(task, plant, &terms);
            mean.total.own += weights.of(&terms) / task.alike(run);
            mean.own = mean.own.plus(&terms, 1.0 / task.alike(run));
            true
        });
        let recorded = |(mean, design): (Option<Mean>, &AnyDesign<f64>)| {
            let mut mean = mean?;
            mean.go_to(task.plants.len(), task);
            Some(Record {
                cost: mean.total.lower_bound(task),
                violation: mean
                    .total
                    .excess(task, task.constraints.of_loops(design))
                    .sum,
                largest: mean.total.largest,
                terms: match task.aggregate {
                    Aggregate::Mean => mean.sum,
                    Aggregate::Worst => mean.worst,
                },
            })
        };
        means.into_iter().zip(designs).map(recorded).collect()
    }

    /// Runs every controller over the extent's runs on every plant. `take` gets the controller's index, the plant, the run and its terms
    /// with their share (`None` if the run diverges or on a stop), and returns whether to go on with that controller.
    fn each_run(
        &mut self,
        task: &Task<'_, P>,
        extent: Extent,
        designs: Vec<AnyDesign<f64>>,
        monitor: &Monitor,
        mut take: impl FnMut(usize, usize, usize, Option<(Terms, f64)>) -> bool,
    ) {
        let made = designs.iter().map(AnyDesign::controller).enumerate();
        let mut open: Vec<_> = made.filter_map(|(i, made)| Some((i, made.ok()?))).collect();
        let leads = Leads::taken_from(&mut open, task);
        for plant in 0..self.plants.len() {
            for run in 0..task.runs() {
                let Some(share) = task.share(extent, plant, run) else {
                    continue;
                };
                let signals = leads.signals(task, plant, run);
                let mut all = self
                    .several(task, (plant, run), signals, &mut open, monitor)
                    .into_iter();
                let mut next = || Some((all.next()??, share));
                open.retain(|(i, _)| take(*i, plant, run, next()));
            }
        }
    }

    /// The terms of one run with each controller on one plant: side by side if plant and controllers allow it.
    fn several(
        &mut self,
        task: &Task<'_, P>,
        (plant, run): (usize, usize),
        signals: Signals<'_>,
        open: &mut [(usize, AnyController<f64>)],
        monitor: &Monitor,
    ) -> Vec<Option<Terms>> {
        let controllers: Vec<&AnyController<f64>> = open.iter().map(|(_, c)| c).collect();
        match self.plants[plant].known() {
            Some(known) if Batch::take(&controllers) => {
                let course = Runs {
                    known,
                    signals,
                    encoder: task.encoder.as_ref(),
                    load: task.loads.get(run),
                    measure: run.checked_sub(task.loads.len()).map(|r| self.measures[r]),
                };
                self.batch.terms(&course, &controllers, monitor)
            }
            _ => open
                .iter_mut()
                .map(|(_, controller)| self.run(task, (plant, run), signals, controller, monitor))
                .collect(),
        }
    }

    /// What each plant does under the load steps, the worst over all of them; `None` if a run diverges or on a stop.
    pub(super) fn loaded(
        &mut self,
        task: &Task<'_, P>,
        design: &AnyDesign<f64>,
        monitor: &Monitor,
    ) -> Option<Vec<LoadLimit>> {
        let mut controller = design.controller().ok()?;
        let mut all = Vec::with_capacity(self.plants.len());
        for plant in 0..self.plants.len() {
            let mut worst = Terms::default();
            for run in 0..task.loads.len() {
                let signals = task.signals(plant, run);
                let terms = self.run(task, (plant, run), signals, &mut controller, monitor);
                worst = worst.max(&terms?);
            }
            all.push(LoadLimit {
                recovery: worst.recovery,
                load: worst.load,
            });
        }
        Some(all)
    }

    /// The terms of one run on one plant; `None` if it diverges or on a stop.
    fn run(
        &mut self,
        task: &Task<'_, P>,
        (plant, run): (usize, usize),
        signals: Signals<'_>,
        controller: &mut AnyController<f64>,
        monitor: &Monitor,
    ) -> Option<Terms> {
        let (plant, encoder) = (&mut self.plants[plant], task.encoder.as_ref());
        self.run
            .record_with(plant, controller, signals, encoder, monitor);
        if self.run.outcome != Outcome::Completed || monitor.stopped() {
            return None;
        }
        let ts = controller.ts();
        if let Some(load) = task.loads.get(run) {
            return Some(load.terms(&self.run, ts));
        }
        let measure = &self.measures[run - task.loads.len()];
        Some(measure.of(signals.reference, &self.run, controller.limits(), ts))
    }
}

/// The ways of the references through a feedforward that all candidates share; it is taken once for all of them.
struct Leads(Vec<OnceCell<Option<Lead>>>, Option<AnyController<f64>>);

impl Leads {
    /// Takes feedforward and ramp from controllers that share them; none from others, which then run one by one.
    fn taken_from<P>(open: &mut [(usize, AnyController<f64>)], task: &Task<'_, P>) -> Self {
        let pids: Option<Vec<_>> = open.iter().map(|(_, c)| c.pid()).collect();
        let first = pids.as_ref().and_then(|pids| pids.first().copied());
        let shared = first.filter(|first| {
            let all = pids.iter().flatten();
            Lead::has_feedforward(first) && all.into_iter().all(|c| Lead::is_shared(c, first))
        });
        let Some(way) = shared.cloned() else {
            return Self(Vec::new(), None);
        };
        for (_, controller) in open {
            let rest = controller
                .pid()
                .map(|pid| AnyDesign::from(pid.without_lead()));
            if let Some(rest) = rest.and_then(|rest| rest.controller().ok()) {
                *controller = rest;
            }
        }
        Self(vec![OnceCell::new(); task.runs()], Some(way.into()))
    }

    /// The signals of a plant's run.
    fn signals<'a, P>(&'a self, task: &Task<'a, P>, plant: usize, run: usize) -> Signals<'a> {
        let signals = task.signals(plant, run);
        let (Some(cell), Some(way)) = (self.0.get(run), &self.1) else {
            return signals;
        };
        // without a ramp nothing depends on the first measurement
        let lead = cell.get_or_init(|| Lead::of(way, signals, || 0.0));
        lead.as_ref().map_or(signals, |lead| lead.signals(signals))
    }
}

/// The costs of a controller so far.
#[derive(Clone, Copy, Debug, Default)]
struct Total {
    plant: usize,
    finished: f64,
    worst: f64,
    own: f64,
    /// The largest of each term over all runs.
    largest: Terms,
    /// The largest excess under a load step.
    late: Excess,
}

impl Total {
    fn go_to(&mut self, plant: usize) {
        if plant != self.plant {
            self.finished += self.own;
            self.worst = self.worst.max(self.own);
            (self.plant, self.own) = (plant, 0.0);
        }
    }

    /// Takes the terms of a run on a plant, but not what it costs.
    fn take<P>(&mut self, task: &Task<'_, P>, plant: usize, terms: &Terms) {
        self.go_to(plant);
        self.largest = self.largest.max(terms);
        self.late = self.late.worse(task.constraints.of_load(plant, terms));
    }

    /// The excess of the runs so far, with that of the linear loops.
    fn excess<P>(&self, task: &Task<'_, P>, loops: Excess) -> Excess {
        let runs = task.constraints.of_runs(&self.largest);
        loops.and(self.late).and(runs)
    }

    fn lower_bound<P>(&self, task: &Task<'_, P>) -> f64 {
        match task.aggregate {
            Aggregate::Mean => (self.finished + self.own) / task.plants.len() as f64,
            Aggregate::Worst => self.worst.max(self.own),
        }
    }
}

/// What a controller does over all plants and references.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Record {
    /// The cost that is tuned for.
    pub cost: f64,
    /// Sum of the relative violations of the constraints.
    pub violation: f64,
    /// The largest of each term over all runs, as the constraints limit it.
    pub largest: Terms,
    /// The mean of each term, over the plants as the task aggregates them.
    pub terms: Terms,
}

/// The terms of a controller so far, with what they cost: a mean of costs, as a cost of mean terms would let an overshoot
/// in one run be made up for in another.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    total: Total,
    sum: Terms,
    worst: Terms,
    own: Terms,
}

impl Mean {
    fn go_to<P>(&mut self, plant: usize, task: &Task<'_, P>) {
        if plant != self.total.plant {
            self.sum = self.sum.plus(&self.own, 1.0 / task.plants.len() as f64);
            self.worst = self.worst.max(&self.own);
            self.own = Terms::default();
            self.total.go_to(plant);
        }
    }
}

// Runs that go side by side: their terms come from sums accumulated as they run.

/// What several controllers are run on.
struct Runs<'a> {
    known: KernelPlant<'a>,
    signals: Signals<'a>,
    encoder: Option<&'a Encoder>,
    /// The load step of the runs, or else ...
    load: Option<&'a LoadStep<'a>>,
    /// ... what is measured in them.
    measure: Option<Measure>,
}

/// The memory of runs that go side by side.
#[derive(Clone, Debug, Default)]
struct Batch {
    tallies: Vec<Tally>,
    /// The outputs of one lane.
    y: Vec<f64>,
}

impl Batch {
    /// Whether controllers can run side by side and gain by it: several of one kind.
    fn take(controllers: &[&AnyController<f64>]) -> bool {
        let ts = controllers.first().map(|c| c.ts());
        let alike = controllers.iter().all(|c| Some(c.ts()) == ts);
        controllers.len() > 1 && alike && are_of_a_kind(controllers)
    }

    /// The terms of each controller's run; `None` if it diverges or on a stop.
    fn terms(
        &mut self,
        runs: &Runs<'_>,
        controllers: &[&AnyController<f64>],
        monitor: &Monitor,
    ) -> Vec<Option<Terms>> {
        of_a_kind(controllers, OfKind(self, runs, monitor)).unwrap_or_default()
    }

    fn some(
        &mut self,
        runs: &Runs<'_>,
        controllers: &[&impl InLanes],
        monitor: &Monitor,
    ) -> Vec<Option<Terms>> {
        let kept = match runs.measure.map(|m| m.course()) {
            Some(Course::Nothing) => 0,
            _ => runs.signals.reference.len(),
        };
        self.tallies.resize_with(MOST / LANES, Tally::default);
        let groups = controllers.chunks(LANES);
        let used = groups.len();
        for (tally, group) in self.tallies.iter_mut().zip(groups) {
            tally.begin(group, kept);
        }
        let lanes = BatchLoop {
            known: runs.known,
            controllers,
            signals: runs.signals,
            encoder: runs.encoder,
            monitor,
        };
        let outcomes = lanes.run(&mut self.tallies[..used]);
        if monitor.stopped() {
            return vec![None; controllers.len()];
        }
        let ts = controllers[0].ts();
        let overshoots = self.overshoots(runs, ts, used);
        (0..controllers.len())
            .map(|i| {
                let ran = outcomes[i] == Outcome::Completed;
                ran.then(|| self.lane(runs, i, ts, &overshoots))
            })
            .collect()
    }

    /// The terms of the run in lane `i`.
    fn lane(&mut self, runs: &Runs<'_>, i: usize, ts: f64, overshoots: &[Lanes]) -> Terms {
        let (tally, reference) = (&self.tallies[i / LANES], runs.signals.reference);
        let sums = tally.sums(i % LANES);
        if let Some(load) = runs.load {
            tally.copy_outputs(i % LANES, &mut self.y);
            return load.of(&self.y, sums.largest, ts);
        }
        let terms = summed(&sums, reference.len());
        match runs.measure.map(|m| (m, m.course())) {
            Some((measure, Course::All)) => {
                tally.copy_outputs(i % LANES, &mut self.y);
                measure.shaped(terms, reference, &self.y, ts)
            }
            Some((_, Course::Overshoot(_))) => Terms {
                overshoot: overshoots[i / LANES].0[i % LANES],
                ..terms
            },
            _ => terms,
        }
    }

    /// Overshoots of all lanes, if nothing else is needed from the course of the outputs.
    fn overshoots(&self, runs: &Runs<'_>, ts: f64, used: usize) -> Vec<Lanes> {
        let Some(Course::Overshoot(edge)) = runs.measure.map(|m| m.course()) else {
            return Vec::new();
        };
        let of = |tally: &Tally| {
            simd::run(Overshoots {
                y: &tally.y,
                edge,
                half: (SMOOTHING / ts / 2.0).floor() as usize,
            })
        };
        self.tallies[..used].iter().map(of).collect()
    }
}

/// Judges controllers of whatever kind it is given.
struct OfKind<'a, 'b>(&'a mut Batch, &'a Runs<'b>, &'a Monitor);

impl WithKind for OfKind<'_, '_> {
    type Output = Vec<Option<Terms>>;

    fn with<C: InLanes>(self, controllers: &[&C]) -> Self::Output {
        let Self(batch, runs, monitor) = self;
        let some = controllers.chunks(MOST);
        some.flat_map(|some| batch.some(runs, some, monitor))
            .collect()
    }
}

/// The terms that follow from sums, in the order of operations of [`Measure::of`].
fn summed(sums: &Sums, samples: usize) -> Terms {
    let n = samples as f64;
    let rms = |sum: f64, n: usize| (sum / n.max(1) as f64).sqrt();
    Terms {
        tracking: rms(sums.error, samples),
        chatter: rms(sums.change, samples - 1),
        effort: rms(sums.command, samples),
        saturation: (n - sums.inside) / n,
        u_max: sums.largest,
        ..Terms::default()
    }
}

/// [`Edge::overshoot_percent`] after [`smooth`](crate::metrics::smooth), for eight outputs.
struct Overshoots<'a> {
    y: &'a [Lanes],
    edge: Edge,
    half: usize,
}

impl Kernel for Overshoots<'_> {
    type Output = Lanes;

    #[inline(always)]
    fn run<V: F64x8>(self) -> Lanes {
        let Self { y, edge, half } = self;
        let falls = edge.high < edge.low;
        let whole = 2 * half + 1;
        let start = V::splat(if falls { f64::INFINITY } else { -f64::INFINITY });
        // The mean of a full window grows with its sum, so only the largest sum is divided, on a falling edge the least.
        let (mut extreme, mut any) = (start, false);
        let mut highest = V::splat(0.0);
        for k in edge.start..=edge.end {
            let window = &y[k.saturating_sub(half)..y.len().min(k + half + 1)];
            let mut sum = V::splat(0.0);
            for group in window {
                sum = sum.add(V::load(&group.0));
            }
            if window.len() < whole {
                highest = highest.at_least_each(share(&edge, sum, window.len()));
            } else if falls {
                (extreme, any) = (extreme.at_most_each(sum), true);
            } else {
                (extreme, any) = (extreme.at_least_each(sum), true);
            }
        }
        if any {
            highest = highest.at_least_each(share(&edge, extreme, whole));
        }
        let excess = highest.sub(V::splat(1.0)).at_least(0.0);
        let mut percent = Lanes::ZERO;
        V::splat(100.0).mul(excess).store(&mut percent.0);
        percent
    }
}

/// Where the mean of a window lies between the edge's levels.
#[inline(always)]
fn share<V: F64x8>(edge: &Edge, sum: V, samples: usize) -> V {
    let mean = sum.div(V::splat(samples as f64));
    mean.sub(V::splat(edge.low))
        .div(V::splat(edge.high - edge.low))
}
