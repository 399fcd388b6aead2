//! The extended Kalman filter: states that follow the measured outputs (Anderson and Moore 1979, section 8.2).

use super::network::{Network, Scratch};
use super::problem::Experiment;
use super::shape::Shape;
use super::state::{Statistics, step_with_slopes};
use crate::Monitor;
use crate::simd::{self, F64x8, Kernel};

/// Powers of ten from which the process noise is chosen.
const EXPONENTS: std::ops::RangeInclusive<i32> = -8..=2;
/// Where the search starts.
const FIRST_EXPONENT: i32 = -3;
/// Most samples used by it: more do not change a power of ten.
const MOST_SAMPLES: usize = 20_000;

/// A filter over one record, as a kernel. `each(k, s, x)` receives the sum predicted for sample `k`, before its
/// output counts, and the state corrected by it.
pub(super) struct Filter<'a, F> {
    pub network: &'a Network,
    pub prior: &'a Statistics,
    /// Process noise, relative to the prior's covariance.
    pub process: f64,
    pub state: &'a [f64],
    pub v: &'a [f64],
    /// Measured outputs; NaN is skipped.
    pub y: &'a [f64],
    // A closure: the noise search sums up errors, an estimate keeps states, and neither stores the other's data.
    pub each: F,
}

impl<F: FnMut(usize, f64, &[f64])> Kernel for Filter<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        let Self {
            network,
            prior,
            process,
            state,
            v,
            y,
            mut each,
        } = self;
        let Shape { nx, inputs, .. } = network.shape;
        // Q = process P0, with P0 the covariance of the states in training: only one number to choose, with the states'
        // scales right.
        let noise: Vec<f64> = prior.state_covariance.iter().map(|c| process * c).collect();
        let mut memory = Memory {
            // The first state is as uncertain as one step would make it.
            covariance: noise.clone(),
            x: state.to_vec(),
            room: vec![0.0; nx * nx],
            row: vec![0.0; nx],
            gain: vec![0.0; nx],
        };
        let mut scratch = Scratch::new(network.shape);
        for (k, (v, y)) in v.chunks_exact(inputs).zip(y).enumerate() {
            scratch.next.copy_from_slice(&memory.x);
            // s and ds/dx at the predicted state.
            step_with_slopes::<V>(network, &mut scratch, v);
            let predicted = scratch.sum;
            if !y.is_nan() {
                memory.measure(network, &scratch, *y, prior.residual_variance);
            }
            each(k, predicted, &memory.x);
            // A second step, from the corrected state: gives f and F there.
            scratch.next.copy_from_slice(&memory.x);
            step_with_slopes::<V>(network, &mut scratch, v);
            memory.advance(&scratch, &noise);
        }
    }
}

struct Memory {
    x: Vec<f64>,
    covariance: Vec<f64>,
    // F P, the gain's numerator P H', and H: kept from sample to sample, so a step allocates nothing.
    room: Vec<f64>,
    row: Vec<f64>,
    gain: Vec<f64>,
}

impl Memory {
    /// Uses an output.
    fn measure(&mut self, network: &Network, scratch: &Scratch, y: f64, noise: f64) {
        let nx = self.x.len();
        let (value, steepness) = network.output.value_and_slope(scratch.sum);
        //   H = f' ds/dx,  K = P H'/S,  S = H P H' + R,  e = y - yhat
        for (j, row) in self.row.iter_mut().enumerate() {
            *row = steepness * scratch.slope(nx * nx + j);
        }
        // P H', needed for both the gain and the new covariance.
        for (i, gain) in self.gain.iter_mut().enumerate() {
            *gain = (0..nx)
                .map(|j| self.covariance[i * nx + j] * self.row[j])
                .sum();
        }
        // S: the expected square of the error.
        let spread = noise
            + self
                .row
                .iter()
                .zip(&self.gain)
                .map(|(r, g)| r * g)
                .sum::<f64>();
        let innovation = (y - value) / spread;
        // x + K e and P - K S K' = P - (P H')(P H')'/S, symmetric by construction: entries (i, j) and (j, i) are the
        // same product. R > 0 keeps S above 0.
        for i in 0..nx {
            self.x[i] += self.gain[i] * innovation;
            for j in 0..nx {
                self.covariance[i * nx + j] -= self.gain[i] * self.gain[j] / spread;
            }
        }
    }

    /// `x+ = f(x)`, `P+ = F P F' + Q`.
    fn advance(&mut self, scratch: &Scratch, noise: &[f64]) {
        let nx = self.x.len();
        self.x.copy_from_slice(&scratch.next);
        for q in 0..nx {
            for j in 0..nx {
                self.room[q * nx + j] = (0..nx)
                    .map(|i| scratch.slope(q * nx + i) * self.covariance[i * nx + j])
                    .sum();
            }
        }
        for q in 0..nx {
            // (F P) F' + Q, one half of it, then mirrored: rounding cannot make it unsymmetric.
            for r in 0..=q {
                let sum: f64 = (0..nx)
                    .map(|j| self.room[q * nx + j] * scratch.slope(r * nx + j))
                    .sum();
                self.covariance[q * nx + r] = sum + noise[q * nx + r];
                self.covariance[r * nx + q] = self.covariance[q * nx + r];
            }
        }
    }
}

/// The power of ten with the least one-step error on these experiments, by descent over the exponents.
pub(super) fn process_noise(
    network: &Network,
    prior: &Statistics,
    experiments: &[Experiment],
    states: &[Vec<f64>],
    monitor: &Monitor,
) -> f64 {
    // Infinite if out of range or if a stop was requested.
    let error = |exponent: i32| match EXPONENTS.contains(&exponent) && !monitor.stopped() {
        true => one_step_error(network, prior, experiments, states, 10f64.powi(exponent)),
        false => f64::INFINITY,
    };
    let (mut at, mut least) = (FIRST_EXPONENT, error(FIRST_EXPONENT));
    // Over the power of ten the error has a single valley: go down from the first guess, then up from the best so far.
    for direction in [-1, 1] {
        loop {
            let next = error(at + direction);
            if next.is_nan() || next >= least {
                break;
            }
            (at, least) = (at + direction, next);
        }
    }
    10f64.powi(at)
}

/// Sum of squared one-step errors, relative to the residual variance.
fn one_step_error(
    network: &Network,
    prior: &Statistics,
    experiments: &[Experiment],
    states: &[Vec<f64>],
    process: f64,
) -> f64 {
    let inputs = network.shape.inputs;
    let (mut left, mut sum) = (MOST_SAMPLES, 0.0);
    for (experiment, state) in experiments.iter().zip(states) {
        // The first 20,000 samples over all experiments.
        let samples = left.min(experiment.y.len());
        left -= samples;
        let y = &experiment.y[..samples];
        simd::run(Filter {
            network,
            prior,
            process,
            state,
            v: &experiment.v[..samples * inputs],
            y,
            each: |k: usize, s: f64, _: &[f64]| {
                let error = y[k] - network.output.value(s);
                if !y[k].is_nan() {
                    sum += error * error / prior.residual_variance;
                }
            },
        });
    }
    if sum.is_finite() { sum } else { f64::INFINITY }
}
