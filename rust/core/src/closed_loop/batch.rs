//! Loops of many controllers around one plant, side by side in the processor's registers. Begin reading at `turn`.
//!
//! A search judges many controllers on the same plant and reference. Their loops are independent, so each gets a lane.
//!
//! ```text
//!   lane        0    1    2  ..  7      one F64x8: u, y, integral, .. of eight loops
//!   group g     controllers 8g .. 8g+7  Loops: plants (phi, position), controllers (gains, states), counters
//!   BatchLoop   up to 4 groups          one pass over the reference, sample by sample
//! ```
//!
//! One group alone would mostly wait: a sample is a dependency chain of some 230 cycles (encoder, filter, controller, network), in which
//! the units have work for some 130. So groups take turns half a round apart. While group g decides, the plants of the group that decided
//! half a round ago step; the three stages of a `Decision` are interleaved with the hidden units of that step:
//!
//! ```text
//!   4 groups, one sample:   decide 0 | step 2'     decide 1 | step 3'     decide 2 | step 0     decide 3 | step 1
//!                           (' of the sample before)
//! ```
//!
//! Measured on 64 candidates (`candidates` and `candidates_encoded` of the kernels' example, Zen 4, least of 60 calls,
//! each variant removed in turn): taking turns saves 11 to 14 % with encoder and filter, 0 % without; a regressor of
//! known length (`N` = 4) 14 to 17 %; averages of one length 4 to 6 %.
//!
//! Ownership: `BatchLoop` borrows plant, controllers and signals; a group owns the states of its eight loops for the
//! run; the caller owns the notes, one per group.
//!
//! A lane does the operations of a single loop in the same order: on the same level it gives the bits of
//! [`Run::record`](super::Run::record).

mod controllers;

#[cfg(test)]
mod tests;

use super::kernel_plant::{BatchPlant, KernelPlant};
use super::{Outcome, RUNAWAY, Signals, WATCHED};
use crate::Monitor;
use crate::neural::{Meanwhile, Nothing};
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};
use crate::speed::Encoder;
pub(super) use controllers::Controllers;
pub(crate) use controllers::{InLanes, LaneController, WithKind, are_of_a_kind, of_a_kind};

/// Most loops side by side: four groups, of which one computes while the others wait for results.
pub(crate) const MOST: usize = 4 * LANES;

/// Receives the samples of a group of lanes.
pub(crate) trait Notes {
    /// Reference, command after the limits, true output and filtered feedback of a sample.
    fn put<V: F64x8>(&mut self, k: usize, r: f64, u: V, y: V, feedback: V);
}

/// The loops of some controllers around one plant, from rest.
pub(crate) struct BatchLoop<'a, C> {
    pub known: KernelPlant<'a>,
    /// From 1 to [`MOST`]; all fit in lanes and have the same sample time.
    pub controllers: &'a [&'a C],
    pub signals: Signals<'a>,
    /// The encoder; `None` for ideal feedback.
    pub encoder: Option<&'a Encoder>,
    pub monitor: &'a Monitor,
}

impl<C: InLanes> BatchLoop<'_, C> {
    /// Runs the loops; `notes` has an entry for every eight controllers. Entry i of the result is how run i ended.
    ///
    /// Notes of a lane after its end are meaningless.
    pub fn run(self, notes: &mut [impl Notes]) -> [Outcome; MOST] {
        // For the usual model the loops over the regressor are unrolled. Each further constant would add a copy of the
        // whole batch for each kind of controller, level and notes.
        if self.known.is_second_order() {
            simd::run(Grouped::<_, _, 4>(self, notes))
        } else {
            simd::run(Grouped::<_, _, 0>(self, notes))
        }
    }
}

/// Groups of loops around a plant; `N` is 4 for two outputs and two inputs in its regressor, 0 for any number.
struct Grouped<'a, 'b, C, S, const N: usize>(BatchLoop<'a, C>, &'b mut [S]);

impl<C: InLanes, S: Notes, const N: usize> Kernel for Grouped<'_, '_, C, S, N> {
    type Output = [Outcome; MOST];

    #[inline(always)]
    fn run<V: F64x8>(self) -> Self::Output {
        let Self(lanes, notes) = self;
        // on the heap: one pointer then reaches all of a group
        let mut groups = Vec::with_capacity(notes.len());
        for g in 0..notes.len() {
            groups.push(Loops::<V, C::Lanes<V>>::new(&lanes, g));
        }
        let mut ends = Ends::new(lanes.controllers.len());
        let signals = &lanes.signals;
        for (k, &r) in signals.reference.iter().enumerate() {
            if k % WATCHED == 0 && lanes.monitor.stopped() {
                ends.note(ends.running, Outcome::Interrupted(k));
                return ends.outcomes;
            }
            for (g, notes) in notes.iter_mut().enumerate() {
                let now = Now { k, r, g, signals };
                turn::<_, _, _, N>(&mut groups, notes, &mut ends, now);
            }
            // All have diverged, as happens when a search begins with wild gains: skip the rest of the reference.
            if ends.running == 0 {
                return ends.outcomes;
            }
        }
        ends.outcomes
    }
}

/// A sample of a group of loops.
#[derive(Clone, Copy)]
struct Now<'a> {
    k: usize,
    r: f64,
    g: usize,
    signals: &'a Signals<'a>,
}

/// One group decides while the plants of the group that decided half a round ago step: each has time until its result
/// is needed. A single group does one after the other.
#[inline(always)]
fn turn<V: F64x8, C: LaneController<V>, S: Notes, const N: usize>(
    groups: &mut [Loops<'_, V, C>],
    notes: &mut S,
    ends: &mut Ends,
    now: Now<'_>,
) {
    //   groups   4         3         2        1
    //   g        0 1 2 3   0 1 2     0 1      0
    //   due      2 3 0 1   2 0 1     1 0      0: decides and steps at once
    // The due group decided half a round ago. For the lower half of g that was in the sample before, so at k = 0 there
    // is nothing to step. Each group thus steps once between two of its decisions.
    let half = groups.len() / 2;
    let begun = now.k > 0 || now.g >= half;
    let due = if now.g < half {
        now.g + groups.len() - half
    } else {
        now.g - half
    };
    // Disjoint borrows: one group's decision and another's step are interleaved, and the compiler must know that
    // neither changes the other.
    if let Ok([loops, due]) = groups.get_disjoint_mut([now.g, due]) {
        let mut decision = Decision::new(loops, notes, ends, now);
        if begun {
            // The plants' step leads and the decision fills its gaps: tanh has the divisions, which are the longest waits.
            due.plants.advance::<V, N>(due.applied, &mut decision);
        }
        decision.finish();
    } else if let [loops] = groups {
        Decision::new(loops, notes, ends, now).finish();
        loops.plants.advance::<V, N>(loops.applied, &mut Nothing);
    }
}

/// Which lanes still run, and how the others ended.
struct Ends {
    // 64 bits for 32 lanes: `1 << 32` has to exist.
    running: u64,
    outcomes: [Outcome; MOST],
}

impl Ends {
    fn new(lanes: usize) -> Self {
        Self {
            running: (1 << lanes) - 1,
            outcomes: [Outcome::Completed; MOST],
        }
    }

    /// Marks those of `lanes` that were running as ended.
    #[inline(always)]
    fn note(&mut self, lanes: u64, outcome: Outcome) {
        // Only the first end counts. A lane that has ended computes on: masking it would cost all lanes a selection in
        // every operation.
        let ended = lanes & self.running;
        if ended != 0 {
            self.running &= !ended;
            for (lane, place) in self.outcomes.iter_mut().enumerate() {
                if ended >> lane & 1 == 1 {
                    *place = outcome;
                }
            }
        }
    }
}

/// Eight loops.
struct Loops<'a, V, C> {
    plants: BatchPlant<'a>,
    controllers: C,
    /// With counts per unit of speed in one sample.
    encoder: Option<(&'a Encoder, f64)>,
    /// Counters at the last sample.
    // Between two turns of a group these are in memory while another group has the registers: 4 groups hold some 30
    // values each.
    before: V,
    measured: V,
    /// The commands that reach the plants.
    applied: V,
}

impl<'a, V: F64x8, C: LaneController<V>> Loops<'a, V, C> {
    #[inline(always)]
    fn new<K: InLanes<Lanes<V> = C>>(lanes: &BatchLoop<'a, K>, group: usize) -> Self {
        let own = &lanes.controllers[LANES * group..];
        let ts = own[0].ts();
        let per_speed = |encoder: &Encoder| ts * encoder.counts_per_unit();
        let encoder = lanes.encoder.map(|encoder| (encoder, per_speed(encoder)));
        let zero = V::splat(0.0);
        Self {
            plants: BatchPlant::new(lanes.known),
            controllers: K::in_lanes::<V>(own),
            encoder,
            // The plant rests at position 0 and speed 0, so one sample ago the counter was the same.
            before: encoder.map_or(zero, |(encoder, _)| encoder.counts(zero)),
            measured: zero,
            applied: zero,
        }
    }

    /// Measures the outputs; returns the lanes whose outputs are beyond all bounds.
    #[inline(always)]
    fn measure(&mut self, signals: &Signals<'_>, k: usize) -> u64 {
        let y: V = self.plants.output();
        // The test of `Run::through`, one bit per lane; NaN is not below.
        let mut sound = y.abs().are_less(V::splat(RUNAWAY));
        self.measured = y;
        if let Some((encoder, per_speed)) = self.encoder {
            let now = encoder.counts(self.plants.position::<V>());
            self.measured = now.sub(self.before).div(V::splat(per_speed));
            self.before = now;
            sound &= self.measured.abs().are_less(V::splat(f64::INFINITY));
        }
        if let Some(added) = signals.noise_at(k) {
            self.measured = self.measured.add(V::splat(added));
        }
        // The last group's bits beyond its controllers belong to no loop: `Ends::running` begins with them cleared.
        u64::from(!sound)
    }

    /// Decides on the commands.
    #[inline(always)]
    fn decide(&mut self, signals: &Signals<'_>, k: usize, r: f64, notes: &mut impl Notes) {
        let y = self.plants.output();
        let u =
            self.controllers
                .decide(k == 0, signals.setpoint_at(k, r), signals.feedforward_at(k));
        // As in `Run::through`, the command as decided; the disturbance is added afterwards.
        notes.put(k, r, u, y, self.controllers.filtered());
        self.applied = match signals.disturbance_at(k) {
            None => u,
            Some(added) => u.add(V::splat(added)),
        };
    }
}

/// All that a group of loops does in a sample except its plants' steps, in stages: while a stage waits for its numbers,
/// the processor goes on with another group's plants.
struct Decision<'a, 'b, V, C, S> {
    loops: &'a mut Loops<'b, V, C>,
    notes: &'a mut S,
    ends: &'a mut Ends,
    now: Now<'a>,
    stage: usize,
}

impl<'a, 'b, V: F64x8, C: LaneController<V>, S: Notes> Decision<'a, 'b, V, C, S> {
    #[inline(always)]
    fn new(
        loops: &'a mut Loops<'b, V, C>,
        notes: &'a mut S,
        ends: &'a mut Ends,
        now: Now<'a>,
    ) -> Self {
        Self {
            loops,
            notes,
            ends,
            now,
            stage: 0,
        }
    }

    /// Runs the remaining stages.
    #[inline(always)]
    fn finish(&mut self) {
        while self.stage < STAGES {
            self.go();
        }
    }
}

/// Stages of a [`Decision`].
const STAGES: usize = 3;

impl<V: F64x8, C: LaneController<V>, S: Notes> Meanwhile for Decision<'_, '_, V, C, S> {
    #[inline(always)]
    fn go(&mut self) {
        let Now { k, r, g, signals } = self.now;
        // Three chains: the encoder and its division; average, lag and observer; controller, limits and sums. In the
        // step of a network with one group of hidden units two of them are interleaved, with more groups all three; a
        // linear model's step is too short for any.
        match self.stage {
            0 => {
                // Shift the group's lanes to their place among the bits of all loops.
                let runaway = self.loops.measure(signals, k) << (LANES * g);
                self.ends.note(runaway, Outcome::Diverged(k));
            }
            1 => self.loops.controllers.take(k == 0, self.loops.measured),
            2 => self.loops.decide(signals, k, r, self.notes),
            _ => return,
        }
        self.stage += 1;
    }
}

/// Sums over one run, in the order of its samples.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Sums {
    /// Of `(r - y)^2`.
    pub error: f64,
    /// Of `u^2`.
    pub command: f64,
    /// Of the squared change of `u` from sample to sample.
    pub change: f64,
    /// Samples within the limits.
    pub inside: f64,
    /// Largest `|u|`.
    pub largest: f64,
}

/// Sums over eight runs, and their outputs if they are kept.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Tally {
    low: Lanes,
    high: Lanes,
    error: Lanes,
    command: Lanes,
    change: Lanes,
    inside: Lanes,
    largest: Lanes,
    last: Lanes,
    /// Outputs of all samples, or empty.
    pub y: Vec<Lanes>,
}

impl Default for Tally {
    /// Nothing yet.
    fn default() -> Self {
        let zero = Lanes::ZERO;
        Self {
            low: zero,
            high: zero,
            error: zero,
            command: zero,
            change: zero,
            inside: zero,
            largest: zero,
            last: zero,
            y: Vec::new(),
        }
    }
}

impl Tally {
    /// Starts over for runs of these controllers; `kept` is the number of samples whose outputs are kept.
    pub fn begin(&mut self, controllers: &[&impl InLanes], kept: usize) {
        // Reuse the memory of the last run: a search calls this for every group of candidates, and 8 numbers a sample
        // are 256 kB at 4,000 samples.
        let mut y = std::mem::take(&mut self.y);
        y.resize(kept, Lanes::ZERO);
        *self = Self {
            y,
            ..Self::default()
        };
        for (i, controller) in controllers.iter().take(LANES).enumerate() {
            (self.low.0[i], self.high.0[i]) = controller.limits();
        }
    }

    /// The outputs of a lane, if they were kept.
    pub fn copy_outputs(&self, lane: usize, y: &mut Vec<f64>) {
        y.clear();
        y.extend(self.y.iter().map(|group| group.0[lane]));
    }

    /// The sums of a lane.
    pub fn sums(&self, lane: usize) -> Sums {
        Sums {
            error: self.error.0[lane],
            command: self.command.0[lane],
            change: self.change.0[lane],
            inside: self.inside.0[lane],
            largest: self.largest.0[lane],
        }
    }
}

impl Notes for Tally {
    #[inline(always)]
    fn put<V: F64x8>(&mut self, k: usize, r: f64, u: V, y: V, _feedback: V) {
        let zero = V::splat(0.0);
        // The first command is no change: before it the loop was at rest, not at 0.
        let last = if k == 0 { u } else { V::load(&self.last.0) };
        let change = u.sub(last);
        // Multiply and add, not fused: on every level a lane's sums then equal those of its loop, sample by sample.
        let off = V::splat(r).sub(y);
        add(&mut self.error, off.mul(off));
        add(&mut self.command, u.mul(u));
        add(&mut self.change, change.mul(change));
        // Samples are counted as 1.0: exact up to 2^53, and no integer registers are needed.
        let below = u.if_less(V::load(&self.high.0), V::splat(1.0), zero);
        add(
            &mut self.inside,
            V::load(&self.low.0).if_less(u, below, zero),
        );
        let largest = V::load(&self.largest.0).at_least_each(u.abs());
        largest.store(&mut self.largest.0);
        u.store(&mut self.last.0);
        if let Some(place) = self.y.get_mut(k) {
            y.store(&mut place.0);
        }
    }
}

#[inline(always)]
fn add<V: F64x8>(sum: &mut Lanes, value: V) {
    V::load(&sum.0).add(value).store(&mut sum.0);
}
