//! The network in scaled units: weights in groups of eight hidden units, one step and its derivatives.

use crate::gram::Gram;
use crate::lagged::{Lagged, Lags};
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};
use crate::{Error, Result};

/// Determines the length and the order of the parameter vector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Orders.
    pub lags: Lags,
    /// Number of hidden units.
    pub hidden: usize,
    /// Whether the regressor also reaches the output directly.
    pub bypass: bool,
}

/// More hidden units than this are a typing error.
const MOST_HIDDEN: usize = 1_000;

impl Shape {
    /// A checked shape.
    ///
    /// # Errors
    /// `ErrorKind::Setting` unless `hidden` is from 1 to 1,000.
    pub fn new(lags: Lags, hidden: usize, bypass: bool) -> Result<Self> {
        if hidden == 0 || hidden > MOST_HIDDEN {
            return Err(Error::setting(format!(
                "expected 1 to {MOST_HIDDEN} hidden units, got {hidden}; 8 is a good beginning"
            )));
        }
        Ok(Self {
            lags,
            hidden,
            bypass,
        })
    }

    /// Length of theta.
    pub fn parameters(&self) -> usize {
        let direct = if self.bypass {
            self.lags.regressors()
        } else {
            0
        };
        self.hidden * (self.lags.regressors() + 2) + 1 + direct
    }

    /// Where `b1`, `w2`, `b2` and `linear` begin in theta.
    pub(crate) fn offsets(&self) -> [usize; 4] {
        //   theta   | W1, unit by unit | b1 | w2 | b2 | linear, with a bypass |
        let bias = self.hidden * self.lags.regressors();
        let (second, constant) = (bias + self.hidden, bias + 2 * self.hidden);
        [bias, second, constant, constant + 1]
    }

    /// Groups of hidden units; missing units have weights of zero.
    pub(super) fn groups(&self) -> usize {
        self.hidden.div_ceil(LANES)
    }

    /// For each entry of theta its column in a sensitivity row. A row holds all hidden units for each regressor, then
    /// for `b1`, then for `w2`; then `b2`, `linear`, the error and the past outputs.
    pub(super) fn columns(&self) -> Vec<usize> {
        let (n_phi, hidden) = (self.lags.regressors(), self.hidden);
        // theta has W1 unit by unit, a row has it regressor by regressor: eight adjacent columns are then eight units
        // with a common scalar factor. After W1 both have the same order.
        let first = (0..hidden).flat_map(|i| (0..n_phi).map(move |c| c * hidden + i));
        let others = n_phi * hidden..self.error_column();
        first.chain(others).collect()
    }

    /// Column of `b2`.
    pub(super) fn tail(&self) -> usize {
        // W1 has n_phi kinds of columns, then come b1 and w2; each kind has a column for every unit.
        (self.lags.regressors() + 2) * self.hidden
    }

    /// Column of the error.
    pub(super) fn error_column(&self) -> usize {
        self.parameters()
    }

    /// Column of the first past output.
    pub(super) fn state_column(&self) -> usize {
        // After the error: if past outputs are no parameters, the summed columns end with the error and J'J is as small
        // as theta.
        self.error_column() + 1
    }

    /// Groups from column `b2` to the last one.
    pub(super) fn tail_groups(&self) -> usize {
        (self.state_column() + self.lags.na - self.tail()).div_ceil(LANES)
    }

    /// A buffer for sensitivity rows of this shape, which are written in whole groups. Past outputs enter its sums if
    /// they are `estimated`.
    pub(super) fn gram(&self, estimated: bool) -> Gram {
        let states = if estimated { self.lags.na } else { 0 };
        // Groups are written whole: the last one ends beyond the last column, as do those of the last kind of hidden
        // units if there are fewer than eight units.
        let written = self.tail() + self.tail_groups() * LANES;
        let units = (self.lags.regressors() + 1) * self.hidden + self.groups() * LANES;
        Gram::with_room(
            self.state_column() + states,
            written.max(units),
            self.lags.na,
        )
    }
}

/// The weights laid out for the kernels, and the limits of the output.
#[derive(Clone, Debug)]
pub struct Network {
    /// Shape.
    pub shape: Shape,
    /// Lowest and highest output; infinite if it does not saturate.
    pub limits: (f64, f64),
    saturates: bool,
    /// For each group its weights for the regressor; after the last one, in the first lane, those of the bypass, whose
    /// bias is the constant.
    //   first    group 0: | phi_1 | phi_2 | .. | phi_n |   group 1: ..   direct: | linear_1, 0 .. | ..
    //   bias     group 0, group 1, ..                                     direct: | b2, 0 .. |
    //   second   group 0, group 1, ..                                     a lane is a hidden unit
    // The bypass is stored like a group in which only lane 0 is not zero. Its argument starts the sum to which second
    // times h is added, so `sum` gives the output at once. A missing unit has zero weights: tanh(0) = 0 adds nothing,
    // and its gradient is overwritten or never read.
    pub(super) first: Vec<Lanes>,
    pub(super) bias: Vec<Lanes>,
    pub(super) second: Vec<Lanes>,
    pub(super) linear: Vec<f64>,
}

impl Network {
    /// A network with all weights zero.
    pub fn zero(shape: Shape, limits: (f64, f64)) -> Self {
        let (groups, n_phi) = (shape.groups(), shape.lags.regressors());
        Self {
            shape,
            limits,
            saturates: limits.0 > f64::NEG_INFINITY || limits.1 < f64::INFINITY,
            first: vec![Lanes::ZERO; (groups + 1) * n_phi],
            bias: vec![Lanes::ZERO; groups + 1],
            second: vec![Lanes::ZERO; groups],
            linear: vec![0.0; n_phi],
        }
    }

    /// Loads the weights from `theta`, which has `shape.parameters()` values.
    pub fn load(&mut self, theta: &[f64]) {
        let n_phi = self.shape.lags.regressors();
        let [bias, second, constant, linear] = self.shape.offsets();
        for i in 0..self.shape.hidden {
            // Only existing units: the lanes after them are zero since `zero`.
            let (group, lane) = (i / LANES, i % LANES);
            for c in 0..n_phi {
                self.first[group * n_phi + c].0[lane] = theta[i * n_phi + c];
            }
            self.bias[group].0[lane] = theta[bias + i];
            self.second[group].0[lane] = theta[second + i];
        }
        let groups = self.shape.groups();
        self.bias[groups].0[0] = theta[constant];
        if self.shape.bypass {
            self.linear.copy_from_slice(&theta[linear..linear + n_phi]);
            let direct = &mut self.first[groups * n_phi..];
            for (direct, linear) in direct.iter_mut().zip(&self.linear) {
                direct.0[0] = *linear;
            }
        }
    }

    /// The arguments of a group of hidden units for the regressor `phi` with its first entry replaced by `newest`.
    ///
    /// The newest output comes last: all other terms are ready before it is known.
    #[inline(always)]
    fn argument<V: F64x8>(&self, group: usize, newest: f64, phi: &[f64]) -> V {
        let weights = &self.first[group * phi.len()..][..phi.len()];
        // From the oldest to the newest: inputs come after outputs in phi, so the order is inputs, older outputs,
        // newest. In a free run only the last product waits for the last sample.
        let older = weights.iter().zip(phi).skip(1).rev();
        let sum =
            |sum: V, (w, value): (&Lanes, &f64)| sum.add_product(V::load(&w.0), V::splat(*value));
        let z = older.fold(V::load(&self.bias[group].0), sum);
        sum(z, (&weights[0], &newest))
    }

    /// The output for the regressor `phi` with its first entry replaced by `newest`; `hidden` receives the outputs of
    /// each group of hidden units.
    #[inline(always)]
    pub(crate) fn step<V: F64x8>(
        &self,
        newest: f64,
        phi: &[f64],
        mut hidden: impl FnMut(usize, V),
    ) -> f64 {
        // The lanes are summed once, after all groups.
        let mut sum = self.argument::<V>(self.second.len(), newest, phi);
        for (group, second) in self.second.iter().enumerate() {
            let h = self.argument::<V>(group, newest, phi).tanh();
            sum = sum.add_product(V::load(&second.0), h);
            hidden(group, h);
        }
        self.limited(sum.sum())
    }

    /// The output, clipped to its limits.
    #[inline(always)]
    pub(super) fn limited(&self, output: f64) -> f64 {
        // A branch: clipping to infinite limits would add two operations to the free run's dependency chain, while a
        // predicted branch is free.
        if self.saturates {
            output.clamp(self.limits.0, self.limits.1)
        } else {
            output
        }
    }

    /// True if the output lies on a limit; its slope is then zero.
    #[inline(always)]
    pub(super) fn is_clipped(&self, output: f64) -> bool {
        // A value on the limit counts as beyond it: there the output no longer follows the weights, and a clipped run
        // lies exactly there.
        output <= self.limits.0 || output >= self.limits.1
    }

    /// Whether the output has a limit.
    pub(super) fn saturates(&self) -> bool {
        self.saturates
    }

    /// A group's outputs `h` and `1 - h^2`, the latter exact to its last digits.
    #[inline(always)]
    pub(super) fn unit<V: F64x8>(&self, group: usize, phi: &[f64]) -> (V, V) {
        let argument = self.argument::<V>(group, phi[0], phi);
        // `rise` takes an exponential beside the quotients of tanh. It is for derivatives that leave the core, in which
        // 1 - h^2 must keep its digits in saturation. Training uses `steep`.
        (argument.tanh(), argument.rise())
    }

    /// The outputs of all hidden units for the regressor `phi`.
    pub(super) fn hidden(&self, phi: &[f64], hidden: &mut [Lanes]) {
        simd::run(Once {
            network: self,
            phi,
            hidden,
            slope: &mut [],
        });
    }
}

/// One step: output, hidden outputs and, if there is room for them, slopes with respect to past outputs.
struct Once<'a> {
    network: &'a Network,
    phi: &'a [f64],
    hidden: &'a mut [Lanes],
    slope: &'a mut [f64],
}

impl Kernel for Once<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<V: F64x8>(self) -> f64 {
        let Self {
            network,
            phi,
            hidden,
            slope,
        } = self;
        let output = network.step::<V>(phi[0], phi, |group, h| {
            if let Some(hidden) = hidden.get_mut(group) {
                h.store(&mut hidden.0);
            }
        });
        // y = limit for any regressor: no slope.
        if network.is_clipped(output) {
            slope.fill(0.0);
            return output;
        }
        if !slope.is_empty() {
            slope.copy_from_slice(&network.linear[..slope.len()]);
            for (group, second) in network.second.iter().enumerate() {
                // dy/dphi_c = linear_c + sum over units of w2 (1 - h^2) W1_c, for as many entries as requested.
                let steep = V::load(&second.0).mul(network.unit::<V>(group, phi).1);
                let weights = &network.first[group * phi.len()..];
                for (slope, w) in slope.iter_mut().zip(weights) {
                    *slope += steep.mul(V::load(&w.0)).sum();
                }
            }
        }
        output
    }
}

impl Lagged for Network {
    fn lags(&self) -> Lags {
        self.shape.lags
    }

    fn output(&self, phi: &[f64]) -> f64 {
        self.output_and_slope(phi, &mut [])
    }

    fn output_and_slope(&self, phi: &[f64], slope: &mut [f64]) -> f64 {
        simd::run(Once {
            network: self,
            phi,
            hidden: &mut [],
            slope,
        })
    }
}

/// Entry `entry` of the regressor's input part for the samples from `start` on; before the first sample inputs hold
/// their first value.
#[inline]
pub(super) fn input_entry(lags: Lags, u: &[f64], start: usize, entry: usize, out: &mut [f64]) {
    let (channel, lag) = (entry / lags.nb, lags.nk + entry % lags.nb);
    // Sample k takes u(k - lag); before sample 0 that is the first input.
    let held = lag.saturating_sub(start).min(out.len());
    let (before, known) = out.split_at_mut(held);
    before.fill(u[channel]);
    let from = (start + held).saturating_sub(lag);
    // A single input is contiguous and can be copied. Several are interleaved sample by sample.
    if lags.channels == 1 {
        known.copy_from_slice(&u[from..from + known.len()]);
        return;
    }
    let rows = u[from * lags.channels..].chunks_exact(lags.channels);
    for (out, row) in known.iter_mut().zip(rows) {
        *out = row[channel];
    }
}

/// The outputs `back` samples earlier, for the samples of the run from `start` on; `state` holds those before the run,
/// newest first.
#[inline]
pub(super) fn output_entry(run: &[f64], state: &[f64], start: usize, back: usize, out: &mut [f64]) {
    let held = back.saturating_sub(start).min(out.len());
    let (before, known) = out.split_at_mut(held);
    for (i, out) in before.iter_mut().enumerate() {
        // state[m] is y(first - 1 - m), `back` samples before sample start + i of the run.
        *out = state[back - 1 - start - i];
    }
    let from = (start + held).saturating_sub(back);
    known.copy_from_slice(&run[from..from + known.len()]);
}

// --- In a loop: for eight regressors side by side, and for one ---
//
// In [`Network::next_in_lanes`] a lane is a loop, hidden units come one after the other, and a weight is broadcast. In
// [`Network::next`] there is one loop and a lane is a hidden unit, as in a free run. The eight partial sums of the
// former correspond to the eight lanes of the latter's sum: both add in the same order and give the same bits.
//
// Loops use plain counters: calls that the compiler does not inline, as some of iterators, spill the wide registers. A
// regressor of known length (`N` = 4) takes 14 to 17 % off a candidate (Zen 4, `candidates` of the kernels' example).

impl Network {
    /// The outputs for eight regressors, one per lane; each has the bits that [`next`](Self::next) gives for it.
    ///
    /// `N` is the number of regressors, 0 for any. A part of `meanwhile` is done after each hidden unit.
    #[inline(always)]
    pub(crate) fn next_in_lanes<V: F64x8, const N: usize>(
        &self,
        phi: &[Lanes],
        meanwhile: &mut impl Meanwhile,
    ) -> V {
        let n = if N == 0 { phi.len() } else { N };
        let phi = &phi[..n];
        // One sum for each position of a unit in its group, like the lanes of a register of units: sums[i] over all
        // groups is lane i of `next`'s sum. The bypass starts lane 0.
        let mut sums = [V::splat(0.0); LANES];
        sums[0] = self.direct::<V>(phi);
        for group in 0..self.second.len() {
            // the indices of the sums are compile-time constants, so the sums stay in registers; missing units add nothing
            self.four::<V, 0>(group, &phi[..n], &mut sums);
            meanwhile.go();
            // Units 5 to 8, if there are any. Units 1 to 4 of the last group are always computed: pairs share a
            // division and must be the pairs of `next`.
            if self.shape.hidden - group * LANES > 4 {
                self.four::<V, 4>(group, &phi[..n], &mut sums);
            }
            meanwhile.go();
        }
        // Then the sums are added in the order in which `F64x8::sum` adds lanes.
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
        // Without a bypass its weights are zero: skipping these n products, here and in `direct`, leaves the bits unchanged.
        if self.shape.bypass {
            sum = together::<V>(sum, &self.first[groups * n..][..n], phi);
        }
        for group in 0..groups {
            let z = V::load(&self.bias[group].0);
            let z = together::<V>(z, &self.first[group * n..][..n], phi);
            let second = V::load(&self.second[group].0);
            // Not `tanh`: this quotient has the operations of four units for eight loops.
            sum = sum.add_product(second, z.tanh_as_of_four());
        }
        self.limited(sum.sum())
    }

    /// Adds the contribution of the four hidden units of a group from `FIRST` on.
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
        // Four arguments, then four tanh: while one unit waits the three others compute, and pairs share a division.
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

    /// The bypass: its constant and its linear part.
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

/// Work independent of the network's step: each call does a part of it, and nothing once all is done.
///
/// A processor holds about a hundred waiting operations. Parts interleaved with hidden units leave room for the units'
/// own.
pub(crate) trait Meanwhile {
    fn go(&mut self);
}

/// No other work.
pub(crate) struct Nothing;

impl Meanwhile for Nothing {
    #[inline(always)]
    fn go(&mut self) {}
}

/// The argument of one hidden unit for eight regressors, the newest output last.
#[inline(always)]
fn argument<V: F64x8>(bias: f64, weights: &[Lanes], unit: usize, phi: &[Lanes]) -> V {
    // The weights are laid out with units in lanes. One of the group's numbers is broadcast here, so both ways share
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

/// Adds in the order of [`F64x8::sum`].
#[inline(always)]
fn in_halves<V: F64x8>(v: [V; LANES]) -> V {
    let even = v[0].add(v[4]).add(v[2].add(v[6]));
    even.add(v[1].add(v[5]).add(v[3].add(v[7])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_the_regressor_sample_by_sample() {
        let u: Vec<f64> = (0..60).map(f64::from).collect();
        for channels in [1, 2, 3] {
            let lags = Lags::new(2, 3, 2, channels).unwrap();
            let samples = u.len() / channels;
            for (start, count) in [(0, 3), (0, 20), (1, 1), (2, 9), (3, 1), (11, 9)] {
                for entry in 0..3 * channels {
                    let mut out = vec![f64::NAN; count];
                    input_entry(lags, &u, start, entry, &mut out);
                    let mut phi = vec![0.0; 3 * channels];
                    for (k, out) in out.iter().enumerate() {
                        assert!(start + k < samples);
                        lags.write_inputs(&u, start + k, &mut phi);
                        assert_eq!(*out, phi[entry]);
                    }
                }
            }
        }
    }

    #[test]
    fn takes_outputs_before_the_run_from_its_state() {
        let (run, state) = ([10.0, 11.0, 12.0, 13.0, 14.0], [9.0, 8.0, 7.0]);
        let taken = |start: usize, back: usize, count: usize| {
            let mut out = vec![f64::NAN; count];
            output_entry(&run, &state, start, back, &mut out);
            out
        };
        assert_eq!(taken(0, 1, 5), [9.0, 10.0, 11.0, 12.0, 13.0]);
        assert_eq!(taken(0, 3, 4), [7.0, 8.0, 9.0, 10.0]);
        assert_eq!(taken(0, 3, 2), [7.0, 8.0]);
        assert_eq!(taken(1, 3, 3), [8.0, 9.0, 10.0]);
        assert_eq!(taken(3, 2, 2), [11.0, 12.0]);
    }
}
