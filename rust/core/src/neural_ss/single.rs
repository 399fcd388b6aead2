//! The sensitivity recursion for one output and up to four states: all slopes of a sample stay in registers.

use super::network::Network;
use super::sensitivities::Sensitivities;
use crate::simd::{Eight, Group, LANES};

/// The slopes of one sample: `dx+/dx` and `f' ds/dx`.
struct Slopes<V, const NX: usize> {
    onward: [[V; NX]; NX],
    outward: [V; NX],
}

impl<V: Eight, const NX: usize> Slopes<V, NX> {
    #[inline(always)]
    fn of(buffers: &Sensitivities) -> Self {
        let zero = V::splat(0.0);
        let (mut onward, mut outward) = ([[zero; NX]; NX], [zero; NX]);
        for (q, onward) in onward.iter_mut().enumerate() {
            for (j, slope) in onward.iter_mut().enumerate() {
                *slope = V::splat(buffers.scratch.slope(q * NX + j));
            }
        }
        for (outward, slope) in outward.iter_mut().zip(&buffers.outward) {
            *outward = V::splat(*slope);
        }
        Self { onward, outward }
    }

    /// Takes one group of columns of `X` a step on and gives its part of the row; `direct` and `next` are
    /// `f' ds/dtheta` and `dx+/dtheta`.
    #[inline(always)]
    fn advance(&self, x: &mut [Group; NX], direct: V, next: [V; NX]) -> V {
        let mut old = next;
        for (old, x) in old.iter_mut().zip(&*x) {
            *old = V::load(&x.0);
        }
        let mut row = direct;
        for (slope, old) in self.outward.iter().zip(&old) {
            row = row.add_product(*slope, *old);
        }
        for ((x, next), slopes) in x.iter_mut().zip(next).zip(&self.onward) {
            let mut sum = next;
            for (slope, old) in slopes.iter().zip(&old) {
                sum = sum.add_product(*slope, *old);
            }
            sum.store(&mut x.0);
        }
        row
    }
}

impl Sensitivities {
    /// Writes the sample's row and takes `X` to the next sample; `steepness` is the slope of the output function.
    #[inline(always)]
    pub(super) fn advance_single<V: Eight, const NX: usize>(
        &mut self,
        network: &Network,
        h: &[Group],
        (steepness, error): (f64, f64),
        row: &mut [f64],
    ) {
        let (groups, hidden) = (h.len(), network.shape.hidden);
        let slopes = Slopes::<V, NX>::of(self);
        let columns = self.columns;
        let (states, _) = self.states.as_chunks_mut::<NX>();
        let (linear, _) = self.linear.as_chunks::<NX>();
        let arguments = &self.scratch.arguments;
        let of_arguments = groups * arguments.len();
        let (by_argument, rest) = states.split_at_mut(of_arguments);
        let (by_unit, by_linear) = rest.split_at_mut(NX * groups);
        let zero = V::splat(0.0);
        // In the order of the columns: where a group has fewer than eight units, it writes over the next one's first.
        for (c, (x, argument)) in by_argument
            .chunks_exact_mut(groups)
            .zip(arguments)
            .enumerate()
        {
            let argument = V::splat(*argument);
            for (g, x) in x.iter_mut().enumerate() {
                let mut next = [zero; NX];
                for (q, next) in next.iter_mut().enumerate() {
                    *next = argument.mul(V::load(&self.weighted[q * groups + g].0));
                }
                let direct = argument.mul(V::load(&self.weighted[NX * groups + g].0));
                let part = slopes.advance(x, direct, next);
                part.write(&mut row[c * hidden + g * LANES..]);
            }
        }
        for (q, x) in by_unit.chunks_exact_mut(groups).enumerate() {
            let first = (arguments.len() + q) * hidden;
            for (g, (x, h)) in x.iter_mut().zip(h).enumerate() {
                let mut next = [zero; NX];
                next[q] = V::load(&h.0);
                let part = slopes.advance(x, zero, next);
                part.write(&mut row[first + g * LANES..]);
            }
        }
        for (g, h) in h.iter().enumerate() {
            let part = V::load(&h.0).mul(V::splat(steepness));
            part.write(&mut row[columns.direct + g * LANES..]);
        }
        for (i, (x, linear)) in by_linear.iter_mut().zip(linear).enumerate() {
            let mut next = [zero; NX];
            for (next, linear) in next.iter_mut().zip(linear) {
                *next = V::load(&linear.0);
            }
            let part = slopes.advance(x, zero, next);
            part.write(&mut row[columns.linear + i * LANES..]);
        }
        for (sum, argument) in row[columns.sums..columns.error].iter_mut().zip(arguments) {
            *sum = steepness * argument;
        }
        row[columns.error] = error;
    }
}
