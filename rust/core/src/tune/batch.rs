//! Terms of runs that go side by side, from sums that are taken as they run.

use sewfast_control::{AnyController, Controller};

use super::LoadStep;
use super::cost::{Course, Measure, SMOOTHING, Terms};
use crate::Monitor;
use crate::closed_loop::batch::{
    BatchLoop, InLanes, MOST, Sums, Tally, WithKind, are_of_a_kind, of_a_kind,
};
use crate::closed_loop::{KernelPlant, Outcome, Signals};
use crate::encoder::Encoder;
use crate::metrics::Edge;
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};

/// What several controllers are run on.
pub(super) struct Runs<'a> {
    pub known: KernelPlant<'a>,
    pub signals: Signals<'a>,
    pub encoder: Option<&'a Encoder>,
    /// The load step that the runs are about, else ...
    pub load: Option<&'a LoadStep<'a>>,
    /// ... what is measured of them.
    pub measure: Option<Measure>,
}

/// The memory of runs that go side by side.
#[derive(Clone, Debug, Default)]
pub(super) struct Batch {
    tallies: Vec<Tally>,
    /// The outputs of one lane.
    y: Vec<f64>,
}

impl Batch {
    /// Whether controllers can be run side by side, and had better be: several of one kind.
    pub fn take(controllers: &[&AnyController<f64>]) -> bool {
        let ts = controllers.first().map(|c| c.ts());
        let alike = controllers.iter().all(|c| Some(c.ts()) == ts);
        controllers.len() > 1 && alike && are_of_a_kind(controllers)
    }

    /// The terms of each controller's run; `None` where it diverges or on a stop.
    pub fn terms(
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

    /// Overshoots of all lanes, where nothing else of the outputs' course is asked for.
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

/// The terms that sums tell, in the order of operations of [`Measure::of`].
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

/// [`Edge::overshoot_percent`] after [`smooth`](crate::metrics::smooth), of eight outputs.
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
        // The mean of a whole window grows with its sum: only the largest sum, of a fall the least, has to be divided.
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
