//! Moving averages, one in each lane.

use crate::simd::{Choice, LANES};

/// Eight of [`sewfast_control::filter::MovingAverage`].
pub(super) struct Averages<V> {
    /// Room for the longest; beyond a lane's own length there are zeros, which a sum does not feel.
    slots: Vec<V>,
    lengths: V,
    /// The length of all, where it is the same.
    common: bool,
    /// Where the next sample goes.
    next: usize,
    /// The same by lane, where lengths differ.
    nexts: V,
}

impl<V: Choice> Averages<V> {
    #[inline(always)]
    pub fn new(lengths: [usize; LANES]) -> Self {
        let longest = lengths.into_iter().max().unwrap_or(1);
        Self {
            slots: vec![V::splat(0.0); longest],
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
            // the lag that follows makes the same of -0 and of 0
            return x;
        }
        if first {
            for j in 0..self.slots.len() {
                let place = V::splat(j as f64);
                self.slots[j] = place.if_less(self.lengths, x, V::splat(0.0));
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
        self.slots[self.next] = x;
        let next = self.next + 1;
        self.next = if next < self.slots.len() { next } else { 0 };
        let mut sum = V::splat(0.0);
        for j in 0..self.slots.len() {
            sum = sum.add(self.slots[j]);
        }
        sum
    }

    /// The sum where lengths differ.
    #[inline(always)]
    fn apart(&mut self, x: V) -> V {
        let mut sum = V::splat(0.0);
        for j in 0..self.slots.len() {
            let kept = self.nexts.if_equal(V::splat(j as f64), x, self.slots[j]);
            self.slots[j] = kept;
            sum = sum.add(kept);
        }
        let next = self.nexts.add(V::splat(1.0));
        self.nexts = next.if_less(self.lengths, next, V::splat(0.0));
        sum
    }
}
