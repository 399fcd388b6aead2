//! The network for eight regressors side by side.

use super::Network;
use crate::simd::tanh::tanh;
use crate::simd::{Eight, Group, LANES};

impl Network {
    /// The outputs for eight regressors, lane by lane; each to the bit what [`step`](Self::step) gives for it.
    ///
    /// `N` is the number of regressors, 0 for any.
    #[inline(always)]
    pub(crate) fn beside<V: Eight, const N: usize>(&self, phi: &[Group]) -> V {
        let n = if N == 0 { phi.len() } else { N };
        let phi = &phi[..n];
        let mut sums = [V::splat(0.0); LANES];
        sums[0] = self.direct::<V>(phi);
        for (group, (bias, second)) in self.bias.iter().zip(&self.second).enumerate() {
            let weights = &self.first[group * n..][..n];
            let units = (self.shape.hidden - group * LANES).min(LANES);
            for (unit, sum) in sums.iter_mut().enumerate().take(units) {
                let z = argument::<V>(bias.0[unit], weights, unit, phi);
                *sum = sum.add_product(V::splat(second.0[unit]), tanh(z));
            }
        }
        let output = in_halves(sums);
        if self.saturates {
            output.at_least(self.limits.0).at_most(self.limits.1)
        } else {
            output
        }
    }

    /// What reaches the output past the hidden units.
    #[inline(always)]
    fn direct<V: Eight>(&self, phi: &[Group]) -> V {
        let constant = V::splat(self.bias[self.second.len()].0[0]);
        if !self.shape.bypass {
            return constant;
        }
        let mut sum = constant;
        for c in (1..phi.len()).rev().chain([0]) {
            sum = sum.add_product(V::splat(self.linear[c]), V::load(&phi[c].0));
        }
        sum
    }
}

/// The argument of one hidden unit, the newest output last.
#[inline(always)]
fn argument<V: Eight>(bias: f64, weights: &[Group], unit: usize, phi: &[Group]) -> V {
    let mut z = V::splat(bias);
    for c in (1..phi.len()).rev().chain([0]) {
        z = z.add_product(V::splat(weights[c].0[unit]), V::load(&phi[c].0));
    }
    z
}

/// The sums of [`Eight::sum`], in its order.
#[inline(always)]
fn in_halves<V: Eight>(v: [V; LANES]) -> V {
    let even = v[0].add(v[4]).add(v[2].add(v[6]));
    even.add(v[1].add(v[5]).add(v[3].add(v[7])))
}
