//! Loops of many controllers around one plant, side by side in the processor's registers.
//!
//! A lane does the operations of a loop that runs alone, in the same order: on one level both give the same bits.

mod average;
mod controllers;
mod tally;

#[cfg(test)]
mod tests;

use sewfast_control::Controller;

use super::known::{Beside, Known};
use super::{Outcome, RUNAWAY, Signals, WATCHED};
use crate::Monitor;
use crate::encoder::Encoder;
use crate::simd::{self, Eight, Kernel, LANES};
pub(super) use controllers::Controllers;
pub(crate) use tally::{Sums, Tally};

/// Loops that run side by side at most: two groups, of which one computes while the other waits for its results.
pub(crate) const MOST: usize = 2 * LANES;

/// What takes note of the samples of a group of lanes.
pub(crate) trait Notes {
    /// Reference, command after the limits, true output and filtered feedback of a sample.
    fn put<V: Eight>(&mut self, k: usize, r: f64, u: V, y: V, feedback: V);
}

/// The loops of some controllers around one plant, from rest.
pub(crate) struct Lanes<'a> {
    pub known: Known<'a>,
    /// At least one, with constant gains and one sample time; at most [`MOST`].
    pub controllers: &'a [&'a Controller<f64>],
    pub signals: Signals<'a>,
    /// The encoder; `None` for ideal feedback.
    pub encoder: Option<&'a Encoder>,
    pub monitor: &'a Monitor,
}

impl Lanes<'_> {
    /// Whether a controller can be run in a lane.
    pub fn take(controller: &Controller<f64>) -> bool {
        controller.numbers().is_some()
    }

    /// Runs them; `notes` has an entry for every eight controllers. How each run ended stands in its place.
    ///
    /// Notes of a lane after its end mean nothing.
    pub fn run(self, notes: &mut [impl Notes]) -> [Outcome; MOST] {
        let usual = self.known.lags.regressors() == 4;
        match (notes, usual) {
            ([one], true) => simd::run(Grouped::<_, 1, 4>(self, [one])),
            ([one], false) => simd::run(Grouped::<_, 1, 0>(self, [one])),
            ([one, other, ..], true) => simd::run(Grouped::<_, 2, 4>(self, [one, other])),
            ([one, other, ..], false) => simd::run(Grouped::<_, 2, 0>(self, [one, other])),
            ([], _) => [Outcome::Completed; MOST],
        }
    }
}

/// `G` groups of loops around a plant with `N` regressors, 0 for any number.
struct Grouped<'a, S, const G: usize, const N: usize>(Lanes<'a>, [&'a mut S; G]);

impl<S: Notes, const G: usize, const N: usize> Kernel for Grouped<'_, S, G, N> {
    type Output = [Outcome; MOST];

    #[inline(always)]
    fn run<V: Eight>(self) -> Self::Output {
        let Self(lanes, notes) = self;
        let mut groups: [_; G] = std::array::from_fn(|g| Loops::<V>::new(&lanes, g));
        let mut ends = Ends::new(lanes.controllers.len());
        let signals = lanes.signals;
        for (k, &r) in signals.reference.iter().enumerate() {
            if k % WATCHED == 0 && lanes.monitor.stopped() {
                ends.note(ends.running, Outcome::Interrupted(k));
                return ends.outcomes;
            }
            for g in 0..G {
                ends.note(groups[g].measure() << (LANES * g), Outcome::Diverged(k));
                groups[g].decide(&signals, k, r, notes[g]);
                // A group's decisions are one long chain of operations; the next group's plants keep the processor
                // busy meanwhile.
                let next = (g + 1) % G;
                if next == 0 || k > 0 {
                    groups[next].plants.advance::<V, N>(groups[next].applied);
                }
            }
            if ends.running == 0 {
                return ends.outcomes;
            }
        }
        ends.outcomes
    }
}

/// Which lanes still run, and how the others ended.
struct Ends {
    running: u32,
    outcomes: [Outcome; MOST],
}

impl Ends {
    fn new(lanes: usize) -> Self {
        Self {
            running: (1 << lanes) - 1,
            outcomes: [Outcome::Completed; MOST],
        }
    }

    /// Those of `lanes` that ran until now have ended.
    #[inline(always)]
    fn note(&mut self, lanes: u32, outcome: Outcome) {
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
struct Loops<'a, V> {
    plants: Beside<'a>,
    controllers: Controllers<V>,
    /// With counts per sample and unit of speed.
    encoder: Option<(&'a Encoder, f64)>,
    /// Counters at the last sample.
    before: V,
    measured: V,
    /// What reaches the plants.
    applied: V,
}

impl<'a, V: Eight> Loops<'a, V> {
    #[inline(always)]
    fn new(lanes: &Lanes<'a>, group: usize) -> Self {
        let own = &lanes.controllers[LANES * group..];
        let ts = own[0].settings().ts;
        let per_speed = |encoder: &Encoder| ts * encoder.counts_per_unit();
        let encoder = lanes.encoder.map(|encoder| (encoder, per_speed(encoder)));
        let zero = V::splat(0.0);
        Self {
            plants: Beside::new(lanes.known),
            controllers: Controllers::new(own),
            encoder,
            before: encoder.map_or(zero, |(encoder, _)| encoder.counts(zero)),
            measured: zero,
            applied: zero,
        }
    }

    /// Measures; gives the lanes whose outputs have left all bounds.
    #[inline(always)]
    fn measure(&mut self) -> u32 {
        let y: V = self.plants.output();
        let mut sound = y.size().are_less(V::splat(RUNAWAY));
        self.measured = y;
        if let Some((encoder, per_speed)) = self.encoder {
            let now = encoder.counts(self.plants.position::<V>());
            self.measured = now.sub(self.before).div(V::splat(per_speed));
            self.before = now;
            sound &= self.measured.size().are_less(V::splat(f64::INFINITY));
        }
        u32::from(!sound)
    }

    /// Decides on the commands.
    #[inline(always)]
    fn decide(&mut self, signals: &Signals<'_>, k: usize, r: f64, notes: &mut impl Notes) {
        let y = self.plants.output();
        let added = signals.feedforward_at(k);
        let u = self.controllers.step(k == 0, r, self.measured, added);
        notes.put(k, r, u, y, self.controllers.filtered);
        self.applied = match signals.disturbance_at(k) {
            None => u,
            Some(added) => u.add(V::splat(added)),
        };
    }
}
