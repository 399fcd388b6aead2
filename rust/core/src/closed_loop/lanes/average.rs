//! Moving averages, one in each lane.

use crate::simd::{Eight, Group, LANES};

/// Eight of [`sewfast_control::filter::MovingAverage`].
pub(super) struct Averages<V> {
    /// Room for the longest; beyond a lane's own length there are zeros, which a sum does not feel.
    slots: Vec<Group>,
    lengths: V,
    /// The length of all, where it is the same.
    common: bool,
    /// Where the next sample goes.
    next: usize,
    /// The same by lane, where lengths differ.
    nexts: V,
}

impl<V: Eight> Averages<V> {
    #[inline(always)]
    pub fn new(lengths: [usize; LANES]) -> Self {
        let longest = lengths.into_iter().max().unwrap_or(1);
        Self {
            slots: vec![Group::ZERO; longest],
            lengths: V::load(&lengths.map(|n| n as f64)),
            common: lengths == [longest; LANES],
            next: 0,
            nexts: V::splat(0.0),
        }
    }

    /// Takes samples, gives the averages; the first fill the memory.
    #[inline(always)]
    pub fn step(&mut self, first: bool, x: V) -> V {
        if self.common && self.slots.len() == 1 {
            // what a sum of one that begins with 0 makes of -0
            return V::splat(0.0).add(x);
        }
        if first {
            for (j, slot) in self.slots.iter_mut().enumerate() {
                let inside = V::splat(j as f64).if_less(self.lengths, x, V::splat(0.0));
                inside.store(&mut slot.0);
            }
        }
        let sum = if self.common {
            self.alike(x)
        } else {
            self.apart(x)
        };
        sum.div(self.lengths)
    }

    /// The sum where all have one length.
    #[inline(always)]
    fn alike(&mut self, x: V) -> V {
        x.store(&mut self.slots[self.next].0);
        let next = self.next + 1;
        self.next = if next < self.slots.len() { next } else { 0 };
        let mut sum = V::splat(0.0);
        for slot in &self.slots {
            sum = sum.add(V::load(&slot.0));
        }
        sum
    }

    /// The sum where lengths differ.
    #[inline(always)]
    fn apart(&mut self, x: V) -> V {
        let mut sum = V::splat(0.0);
        for (j, slot) in self.slots.iter_mut().enumerate() {
            let kept = self.nexts.if_equal(V::splat(j as f64), x, V::load(&slot.0));
            kept.store(&mut slot.0);
            sum = sum.add(kept);
        }
        let next = self.nexts.add(V::splat(1.0));
        self.nexts = next.if_less(self.lengths, next, V::splat(0.0));
        sum
    }
}
