//! A start for a position: speed, input and dry friction by least squares, without a linear model.
//!
//! Linear models say little about a drive that often stands still: what holds it there is not viscous friction. While
//! it moves,
//!
//! `v+ = a v + b u + d - c sign(v)`,
//!
//! and three positions, `m` samples apart, show how the speed changed. This is the integral form of the equation error:
//! the longer `m`, the less noise matters (Ljung 1999, section 7.3). At rest friction balances the drive:
//! `v+ = z - c sat(z/c)` with `z = a v + b u + d`, and a hidden unit of slope `1/c` stands for `sat`.

use nalgebra::{DMatrix, DVector};

use super::draw;
use super::problem::Experiment;
use super::shape::{Shape, root_mean_square};
use crate::random::Random;

/// Part of its standard deviation that a position moves within [`pace`] samples.
const STROKE: f64 = 0.25;
/// Samples `m`, in units of the pace: long windows average noise, short ones follow quick motions.
const WINDOWS: (f64, f64) = (0.25, 2.0);
/// Motion slower than this, relative to the root mean square of the speed, may be noise.
const SLOW: f64 = 0.05;
/// Least number of windows with motion per estimated parameter.
const ENOUGH: usize = 10;

/// Samples in which a position moves by a quarter of its standard deviation; `None` if it never does.
pub(super) fn pace(experiments: &[Experiment]) -> Option<usize> {
    let longest = experiments.iter().map(|e| e.y.len()).max()? / 4;
    let known = experiments
        .iter()
        .flat_map(|e| &e.y)
        .filter(|y| !y.is_nan());
    let (count, sum, squares) =
        known.fold((0.0, 0.0, 0.0), |(n, s, q), y| (n + 1.0, s + y, q + y * y));
    let variance: f64 = squares / count - (sum / count) * (sum / count);
    let moved = |m: usize| {
        let pairs = experiments
            .iter()
            .flat_map(|e| e.y.iter().zip(e.y.iter().skip(m)));
        let steps = pairs.map(|(y, later)| later - y).filter(|d| !d.is_nan());
        let (n, squares) = steps.fold((0.0, 0.0), |(n, q), d| (n + 1.0, q + d * d));
        squares > STROKE * STROKE * variance * n
    };
    let halves = (0..usize::BITS)
        .map(|i| 1_usize << i)
        .take_while(|m| *m <= longest);
    halves.into_iter().find(|m| moved(*m))
}

/// `v+ = a v + b u + d - c sign(v)` in scaled units of output and input, per sample.
#[derive(Clone, Debug)]
pub(super) struct Friction {
    a: f64,
    b: Vec<f64>,
    c: f64,
    d: f64,
    /// Root mean square of the speed.
    speed: f64,
}

impl Friction {
    /// The estimate over windows of a random length; `None` if nothing moves or no dry friction shows.
    pub fn estimated(
        shape: Shape,
        experiments: &[Experiment],
        random: &mut Random,
    ) -> Option<Self> {
        let share = random.between(WINDOWS.0.ln(), WINDOWS.1.ln()).exp();
        let m = ((share * pace(experiments)? as f64).round() as usize).max(1);
        let speeds = |e: &Experiment| -> Vec<[f64; 2]> {
            let windows =
                e.y.iter()
                    .zip(e.y.iter().skip(m))
                    .zip(e.y.iter().skip(2 * m));
            windows
                .map(|((y, later), last)| [(later - y) / m as f64, (last - later) / m as f64])
                .collect()
        };
        let speeds: Vec<Vec<[f64; 2]>> = experiments.iter().map(speeds).collect();
        let speed = root_mean_square(speeds.iter().flatten().map(|v| v[0]));
        let width = shape.inputs + 3;
        let (mut left, mut right) = (DMatrix::zeros(width, width), DVector::zeros(width));
        let mut moving = 0;
        for (e, speeds) in experiments.iter().zip(&speeds) {
            let pushes = triangular_means(&e.v, shape.inputs, m);
            for ([before, after], push) in speeds.iter().zip(pushes.chunks_exact(shape.inputs)) {
                let moves = before.abs().min(after.abs()) > SLOW * speed && before * after > 0.0;
                if !moves {
                    continue;
                }
                let ends = [-before.signum(), 1.0];
                let row = [0.5 * (before + after)]
                    .into_iter()
                    .chain(push.iter().copied())
                    .chain(ends);
                let row = DVector::from_iterator(width, row);
                left.ger(1.0, &row, &row, 1.0);
                right.axpy((after - before) / m as f64, &row, 1.0);
                moving += 1;
            }
        }
        if moving < ENOUGH * width {
            return None;
        }
        let found = left.cholesky()?.solve(&right);
        let estimate = Self {
            a: 1.0 + found[0],
            b: found.rows(1, shape.inputs).iter().copied().collect(),
            c: found[width - 2],
            d: found[width - 1],
            speed,
        };
        let brakes = estimate.c > 0.0 && estimate.a > 0.0 && estimate.a < 1.0;
        (brakes && found.iter().all(|v| v.is_finite())).then_some(estimate)
    }

    /// The parameters: the first state is the speed, the last one the position. The first hidden unit is the friction,
    /// the second one the constant; further states and units hardly affect the rest yet.
    pub fn theta(&self, shape: Shape, scale: f64, random: &mut Random) -> Vec<f64> {
        let (nx, last, speed) = (shape.nx, shape.nx - 1, self.speed);
        let parts = shape.parts();
        let mut theta = vec![0.0; shape.parameters()];
        draw::hide(&mut theta, shape, scale, random);
        theta[parts.g.clone()].iter_mut().for_each(|g| *g *= speed);
        for state in 1..last {
            let pole = random.between(draw::POLES.0, draw::POLES.1);
            theta[parts.a.start + state * nx + state] = pole;
            theta[parts.b.start + state * shape.inputs..][..shape.inputs]
                .fill_with(|| (1.0 - pole * pole).sqrt() * random.normal());
        }
        // the next speed moves the speed state, the position and, in the same sample, the output
        theta[parts.a.start] = self.a;
        theta[parts.a.start + last * nx] = self.a * speed;
        theta[parts.c.start] = self.a * speed;
        theta[parts.c.start + last] = 1.0;
        for (j, b) in self.b.iter().enumerate() {
            theta[parts.b.start + j] = b / speed;
            theta[parts.b.start + last * shape.inputs + j] = *b;
            theta[parts.d.start + j] = *b;
            theta[parts.wu.start + j] = b / self.c;
        }
        self.reach(&mut theta, shape, 0, -self.c);
        theta[parts.wx.start..][..nx].fill(0.0);
        theta[parts.wx.start] = self.a * speed / self.c;
        theta[parts.bh.start] = self.d / self.c;
        if shape.hidden > 1 {
            self.reach(&mut theta, shape, 1, self.d / f64::tanh(1.0));
            theta[parts.wx.start + nx..][..nx].fill(0.0);
            theta[parts.wu.start + shape.inputs..][..shape.inputs].fill(0.0);
            theta[parts.bh.start + 1] = 1.0;
        }
        shape.hold(&mut theta);
        theta
    }

    /// Makes a unit of output 1 change the next speed by `size`.
    fn reach(&self, theta: &mut [f64], shape: Shape, unit: usize, size: f64) {
        let parts = shape.parts();
        theta[parts.e.start + unit] = size / self.speed;
        theta[parts.e.start + (shape.nx - 1) * shape.hidden + unit] = size;
        theta[parts.g.start + unit] = size;
    }
}

/// Triangularly weighted means of the inputs: they drive the difference of the speeds of two windows of `m` samples.
fn triangular_means(v: &[f64], inputs: usize, m: usize) -> Vec<f64> {
    let samples = v.len() / inputs;
    let summed = |values: &[f64]| {
        let mut sums = vec![0.0; inputs];
        sums.reserve(values.len());
        for (i, value) in values.iter().enumerate() {
            sums.push(sums[i] + value);
        }
        sums
    };
    let double = summed(&summed(v));
    let at = |k: usize, j: usize| double[k * inputs + j];
    let mean = |k: usize, j: usize| {
        (at(k + 2 * m + 2, j) - 2.0 * at(k + m + 2, j) + at(k + 2, j)) / (m * m) as f64
    };
    let windows = samples.saturating_sub(2 * m);
    (0..windows * inputs)
        .map(|i| mean(i / inputs, i % inputs))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn position(nx: usize) -> Shape {
        Shape {
            nx,
            nk: 1,
            inputs: 1,
            hidden: 2,
            integrator: true,
        }
    }

    /// A carriage with one input, pushed to and fro against dry friction; its position in scaled units.
    fn carriage(a: f64, b: f64, c: f64, d: f64) -> Experiment {
        let (mut speed, mut position) = (0.0, 0.0);
        let v: Vec<f64> = (0..6000)
            .map(|k| (k as f64 * 0.011).sin() + 0.5 * (k as f64 * 0.0037).sin())
            .collect();
        let y = v.iter().map(|v| {
            let z: f64 = a * speed + b * v + d;
            speed = z - z.clamp(-c, c);
            position += speed;
            position
        });
        Experiment {
            y: y.collect(),
            v,
            weights: Vec::new(),
        }
    }

    #[test]
    fn finds_the_friction_of_a_carriage() {
        let shape = position(2);
        let experiments = [carriage(0.995, 1e-3, 2e-4, 3e-5)];
        for seed in 0..8 {
            let found = Friction::estimated(shape, &experiments, &mut Random::new(seed)).unwrap();
            for (value, truth) in [(found.a, 0.995), (found.b[0], 1e-3)] {
                assert!((value / truth - 1.0).abs() < 0.05, "{found:?}");
            }
            assert!((found.c / 2e-4 - 1.0).abs() < 0.3, "{found:?}");
        }
    }

    #[test]
    fn starts_near_the_carriage() {
        use super::super::network::Network;
        use super::super::output::OutputFunction;
        use super::super::problem::{Attempts, Training};
        use crate::Monitor;
        use crate::lm::Problem;
        let shape = position(3);
        let truth = Friction {
            a: 0.995,
            b: vec![1e-3],
            c: 2e-4,
            d: 3e-5,
            speed: 0.05,
        };
        let experiments = [carriage(truth.a, truth.b[0], truth.c, truth.d)];
        let mut theta = truth.theta(shape, 1.0, &mut Random::new(1));
        let network = Network::new(shape, OutputFunction::Linear, &theta);
        theta.extend([0.0; 3]);
        let attempts = Attempts::new(&network, &experiments);
        let monitor = Monitor::default();
        let cost = Training::new(&experiments, network, 0.0, &attempts, &monitor)
            .cost(&theta)
            .unwrap();
        let y = &experiments[0].y;
        let mean = y.iter().sum::<f64>() / y.len() as f64;
        let constant =
            y.iter().map(|y| 0.5 * (y - mean) * (y - mean)).sum::<f64>() / y.len() as f64;
        assert!(cost < 0.05 * constant, "{cost} of {constant}");
    }

    #[test]
    fn estimates_nothing_where_nothing_moves() {
        let shape = position(2);
        for y in [vec![0.0; 400], vec![f64::NAN; 400], vec![1.0; 2]] {
            let v = vec![0.5; y.len()];
            let experiments = [Experiment {
                v,
                y,
                weights: Vec::new(),
            }];
            assert!(Friction::estimated(shape, &experiments, &mut Random::new(0)).is_none());
        }
    }
}
