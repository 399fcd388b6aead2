//! Sums of what runs in lanes were like.

use sewfast_control::Controller;

use super::Notes;
use crate::simd::{Eight, Group, LANES};

/// Sums over one run, in the order of its samples.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Sums {
    /// Of `(r - y)^2`.
    pub error: f64,
    /// Of `u^2`.
    pub command: f64,
    /// Of the squared change of `u` from sample to sample.
    pub change: f64,
    /// Samples between the limits.
    pub inside: f64,
    /// Largest `|u|`.
    pub largest: f64,
}

/// Sums over eight runs, and their outputs where they are kept.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Tally {
    low: Group,
    high: Group,
    error: Group,
    command: Group,
    change: Group,
    inside: Group,
    largest: Group,
    last: Group,
    /// Outputs of all samples, or of none.
    pub y: Vec<Group>,
}

impl Default for Tally {
    /// Nothing yet.
    fn default() -> Self {
        let zero = Group::ZERO;
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
    /// Begins anew, for runs of these controllers whose outputs of so many samples are kept.
    pub fn begin(&mut self, controllers: &[&Controller<f64>], kept: usize) {
        let mut y = std::mem::take(&mut self.y);
        y.resize(kept, Group::ZERO);
        *self = Self {
            y,
            ..Self::default()
        };
        for (i, controller) in controllers.iter().take(LANES).enumerate() {
            let settings = controller.settings();
            (self.low.0[i], self.high.0[i]) = (settings.u_min, settings.u_max);
        }
    }

    /// The outputs of a lane, where they were kept.
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
    fn put<V: Eight>(&mut self, k: usize, r: f64, u: V, y: V, _feedback: V) {
        let zero = V::splat(0.0);
        let last = if k == 0 { u } else { V::load(&self.last.0) };
        let change = u.sub(last);
        let off = V::splat(r).sub(y);
        add(&mut self.error, off.mul(off));
        add(&mut self.command, u.mul(u));
        add(&mut self.change, change.mul(change));
        let below = u.if_less(V::load(&self.high.0), V::splat(1.0), zero);
        add(
            &mut self.inside,
            V::load(&self.low.0).if_less(u, below, zero),
        );
        let largest = V::load(&self.largest.0).at_least_each(u.size());
        largest.store(&mut self.largest.0);
        u.store(&mut self.last.0);
        if let Some(place) = self.y.get_mut(k) {
            y.store(&mut place.0);
        }
    }
}

#[inline(always)]
fn add<V: Eight>(sum: &mut Group, value: V) {
    V::load(&sum.0).add(value).store(&mut sum.0);
}
