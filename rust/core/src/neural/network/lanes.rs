//! The network in a loop: for eight regressors side by side, and for one.
//!
//! In [`Network::next_in_lanes`] a lane is a loop, hidden units come one after the other, and a weight is spread over the lanes. In
//! [`Network::next`] there is one loop and a lane is a hidden unit, as in a free run. So eight sums of units side by side stand for the
//! eight lanes of one sum: both add in the same order, and a loop has the same bits in either.
//!
//! Loops count by hand: the calls of an iterator that the compiler leaves would empty the wide registers. A regressor of known length
//! (`N` = 4) takes 14 to 17 % off a candidate (Zen 4, `candidates` of the kernels' example).

use super::Network;
use crate::simd::{F64x8, LANES, Lanes};

impl Network {
    /// The outputs for eight regressors, lane by lane; each to the bit what [`next`](Self::next) gives for it.
    ///
    /// `N` is the number of regressors, 0 for any. Some of other work is done after each hidden unit.
    #[inline(always)]
    pub(crate) fn next_in_lanes<V: F64x8, const N: usize>(
        &self,
        phi: &[Lanes],
        meanwhile: &mut impl Meanwhile,
    ) -> V {
        let n = if N == 0 { phi.len() } else { N };
        let phi = &phi[..n];
        // One sum for each place of a unit in its group, as a register of units has a lane for each: sums[i] of all
        // groups is lane i of `next`'s sum, and the direct way begins lane 0.
        let mut sums = [V::splat(0.0); LANES];
        sums[0] = self.direct::<V>(phi);
        for group in 0..self.second.len() {
            // places of the sums that the compiler knows, so that they stay in registers; units that are missing add nothing
            self.four::<V, 0>(group, &phi[..n], &mut sums);
            meanwhile.go();
            // Units 5 to 8 where there are any: units 1 to 4 of a last group are computed even if fewer are there, since
            // pairs share a division and have to be the pairs of `next`.
            if self.shape.hidden - group * LANES > 4 {
                self.four::<V, 4>(group, &phi[..n], &mut sums);
            }
            meanwhile.go();
        }
        // Then the lanes are added, as `F64x8::sum` adds those of one register.
        let output = in_halves(sums);
        if self.saturates {
            output.at_least(self.limits.0).at_most(self.limits.1)
        } else {
            output
        }
    }

    /// The output for the regressor `phi` alone; `N` is the number of regressors, 0 for any.
    #[inline(always)]
    pub(crate) fn next<V: F64x8, const N: usize>(&self, phi: &[f64]) -> f64 {
        let n = if N == 0 { phi.len() } else { N };
        let (phi, groups) = (&phi[..n], self.second.len());
        let mut sum = V::load(&self.bias[groups].0);
        // Without a bypass its weights are zeros: n products less, here and in `direct`, and so the same bits.
        if self.shape.bypass {
            sum = together::<V>(sum, &self.first[groups * n..][..n], phi);
        }
        for group in 0..groups {
            let z = V::load(&self.bias[group].0);
            let z = together::<V>(z, &self.first[group * n..][..n], phi);
            let second = V::load(&self.second[group].0);
            // Not `tanh`: the quotient of two, as four units of eight loops have it.
            sum = sum.add_product(second, z.tanh_as_of_four());
        }
        self.limited(sum.sum())
    }

    /// Adds what the hidden units from `FIRST` on give, four of one group.
    #[inline(always)]
    fn four<V: F64x8, const FIRST: usize>(
        &self,
        group: usize,
        phi: &[Lanes],
        sums: &mut [V; LANES],
    ) {
        let weights = &self.first[group * phi.len()..][..phi.len()];
        let (bias, second) = (&self.bias[group].0, &self.second[group].0);
        let argument = |unit: usize| argument::<V>(bias[unit], weights, unit, phi);
        // Four arguments, then four tanh: what one unit waits for is filled by the three others, and pairs share a division.
        let z = [
            argument(FIRST),
            argument(FIRST + 1),
            argument(FIRST + 2),
            argument(FIRST + 3),
        ];
        let h = V::tanh_of_four(z);
        for i in 0..4 {
            let place = &mut sums[FIRST + i];
            *place = place.add_product(V::splat(second[FIRST + i]), h[i]);
        }
    }

    /// What reaches the output past the hidden units.
    #[inline(always)]
    fn direct<V: F64x8>(&self, phi: &[Lanes]) -> V {
        let groups = self.second.len();
        if !self.shape.bypass {
            return V::splat(self.bias[groups].0[0]);
        }
        let weights = &self.first[groups * phi.len()..][..phi.len()];
        argument(self.bias[groups].0[0], weights, 0, phi)
    }
}

/// Work that has nothing to do with a step of the network: a part of it at each call, and none when all is done.
///
/// A processor holds about a hundred operations that wait for their numbers. Parts that stand between hidden units leave
/// room for those of the units.
pub(crate) trait Meanwhile {
    fn go(&mut self);
}

/// Nothing to do meanwhile.
pub(crate) struct Nothing;

impl Meanwhile for Nothing {
    #[inline(always)]
    fn go(&mut self) {}
}

/// The argument of one hidden unit for eight regressors, the newest output last.
#[inline(always)]
fn argument<V: F64x8>(bias: f64, weights: &[Lanes], unit: usize, phi: &[Lanes]) -> V {
    // The weights are laid out with units in lanes. Of such a group one number is spread here, so that both ways share
    // one layout and one cache line.
    let (mut z, mut c) = (V::splat(bias), phi.len());
    while c > 0 {
        c -= 1;
        z = z.add_product(V::splat(weights[c].0[unit]), V::load(&phi[c].0));
    }
    z
}

/// The arguments of eight hidden units for one regressor, the newest output last.
#[inline(always)]
fn together<V: F64x8>(bias: V, weights: &[Lanes], phi: &[f64]) -> V {
    let (mut z, mut c) = (bias, phi.len());
    while c > 0 {
        c -= 1;
        z = z.add_product(V::load(&weights[c].0), V::splat(phi[c]));
    }
    z
}

/// The sums of [`F64x8::sum`], in its order.
#[inline(always)]
fn in_halves<V: F64x8>(v: [V; LANES]) -> V {
    let even = v[0].add(v[4]).add(v[2].add(v[6]));
    even.add(v[1].add(v[5]).add(v[3].add(v[7])))
}
