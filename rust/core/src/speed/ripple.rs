//! Kalman smoother for a shaft whose load repeats over the turn.
//!
//! To the white jerk of [`super::Kalman`] it adds an acceleration `sum_h A_h cos(h th) + B_h sin(h th)` with slowly
//! wandering amplitudes, as from cranks, unbalance and torque ripple. The counts give the angle `th` accurately enough,
//! so the model stays linear: the order-tracking filter of Vold and Leuridan (SAE 931288, 1993), applied to the
//! acceleration. Without it a smoother would have to choose between the ripple and the counts' rounding.

use std::f64::consts::TAU;

use super::kalman::{golden, grid};

/// Samples stored for the backward pass: bounds the memory for any length.
const CHUNK: usize = 8_192;
/// Initial variance of the amplitudes over their growth per sample: as if they had wandered for a million samples.
const MEMORY: f64 = 1e6;

/// The orders of the shaft that repeat, and the counts of one turn.
#[derive(Clone, Copy, Debug)]
pub(super) struct Turn<'a> {
    pub orders: &'a [u32],
    pub counts_per_rev: f64,
}

/// Intensities per sample: of the jerk, of the amplitudes' wandering, of the counts' rounding.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noises {
    pub jerk: f64,
    pub wander: f64,
    pub rounding: f64,
}

/// The rows of the transition matrix for position and speed; all other rows are those of the identity.
#[derive(Clone, Copy)]
struct Rows<const N: usize> {
    position: [f64; N],
    speed: [f64; N],
}

impl<const N: usize> Rows<N> {
    /// For a turn by `by` from angle `from` within one sample: mean acceleration for the speed, its first moment for the position.
    fn new(orders: &[u32], from: f64, by: f64) -> Self {
        let mut rows = Self {
            position: [0.0; N],
            speed: [0.0; N],
        };
        rows.position[..3].copy_from_slice(&[1.0, 1.0, 0.5]);
        rows.speed[..3].copy_from_slice(&[0.0, 1.0, 1.0]);
        for (i, &order) in orders.iter().enumerate() {
            let order = f64::from(order);
            let (sin, cos) = (order * (from + by / 3.0)).sin_cos();
            rows.position[3 + 2 * i] = 0.5 * cos;
            rows.position[4 + 2 * i] = 0.5 * sin;
            let (sin, cos) = (order * (from + by / 2.0)).sin_cos();
            let mean = sinc(0.5 * order * by);
            rows.speed[3 + 2 * i] = mean * cos;
            rows.speed[4 + 2 * i] = mean * sin;
        }
        rows
    }

    /// Rows for every sample except the last, which has no successor.
    fn along(turn: Turn<'_>, counts: &[f64]) -> Vec<Self> {
        let angle = |c: f64| TAU * c / turn.counts_per_rev;
        let row = |w: &[f64]| Self::new(turn.orders, angle(w[0]), angle(w[1] - w[0]));
        counts.windows(2).map(row).collect()
    }
}

fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-4 { 1.0 } else { x.sin() / x }
}

/// Mean and covariance of position, speed, acceleration and the amplitudes.
#[derive(Clone)]
struct State<const N: usize> {
    x: [f64; N],
    p: [[f64; N]; N],
}

/// The data of one sample that the backward pass needs.
struct Trace<const N: usize> {
    gain: [f64; N],
    of_speed: [f64; N],
    innovation: f64,
    speed: f64,
}

impl<const N: usize> State<N> {
    fn new(counts: &[f64], noises: Noises) -> Self {
        let step = counts.windows(2).map(|w| (w[1] - w[0]).abs());
        let wide = step.fold(1.0, f64::max).powi(2);
        let mut state = Self {
            x: [0.0; N],
            p: [[0.0; N]; N],
        };
        state.x[0] = counts.first().copied().unwrap_or(0.0);
        for i in 0..N {
            state.p[i][i] = match i {
                0 => noises.rounding,
                1 | 2 => wide,
                _ => noises.wander * MEMORY,
            };
        }
        state
    }

    /// Uses one count; returns `-2 ln` of its likelihood up to a constant.
    fn update(&mut self, count: f64, rounding: f64) -> (Trace<N>, f64) {
        let variance = self.p[0][0] + rounding;
        let e = count - self.x[0];
        let trace = Trace {
            gain: self.p[0].map(|p| p / variance),
            of_speed: self.p[1],
            innovation: e / variance,
            speed: self.x[1],
        };
        let seen = self.p[0];
        for i in 0..N {
            self.x[i] += trace.gain[i] * e;
            for (p, s) in self.p[i].iter_mut().zip(&seen) {
                *p -= trace.gain[i] * s;
            }
        }
        (trace, variance.ln() + e * e / variance)
    }

    fn predict(&mut self, rows: &Rows<N>, noises: Noises) {
        let (f, g) = (&rows.position, &rows.speed);
        let pf: [f64; N] = std::array::from_fn(|i| dot(&self.p[i], f));
        let pg: [f64; N] = std::array::from_fn(|i| dot(&self.p[i], g));
        (self.x[0], self.x[1]) = (dot(f, &self.x), dot(g, &self.x));
        for j in 2..N {
            (self.p[0][j], self.p[j][0]) = (pf[j], pf[j]);
            (self.p[1][j], self.p[j][1]) = (pg[j], pg[j]);
        }
        let q = noises.jerk;
        let cross = dot(f, &pg) + q / 8.0;
        self.p[0][0] = dot(f, &pf) + q / 20.0;
        self.p[1][1] = dot(g, &pg) + q / 3.0;
        (self.p[0][1], self.p[1][0]) = (cross, cross);
        for i in 0..2 {
            let with_acceleration = q / if i == 0 { 6.0 } else { 2.0 };
            self.p[i][2] += with_acceleration;
            self.p[2][i] += with_acceleration;
        }
        self.p[2][2] += q;
        for i in 3..N {
            self.p[i][i] += noises.wander;
        }
    }
}

fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    (0..N).map(|i| a[i] * b[i]).sum()
}

/// `-2 ln` likelihood of the blocks, without the first three counts of each, which only determine the state.
fn cost<const N: usize>(blocks: &[(&[f64], Vec<Rows<N>>)], noises: Noises) -> f64 {
    let mut sum = 0.0;
    for (counts, rows) in blocks {
        let mut state = State::new(counts, noises);
        for (k, count) in counts.iter().enumerate() {
            let (_, cost) = state.update(*count, noises.rounding);
            sum += if k < 3 { 0.0 } else { cost };
            if let Some(rows) = rows.get(k) {
                state.predict(rows, noises);
            }
        }
    }
    sum
}

/// Estimates the wandering, and the jerk unless it is given, by maximum likelihood; also returns `-2 ln` of the likelihood.
///
/// The search starts from the jerk of the model without ripple, which is larger.
fn fit<const N: usize>(
    blocks: &[&[f64]],
    turn: Turn<'_>,
    start: Noises,
    jerk_is_given: bool,
) -> (Noises, f64) {
    let blocks: Vec<(&[f64], Vec<Rows<N>>)> = blocks
        .iter()
        .map(|&counts| (counts, Rows::along(turn, counts)))
        .collect();
    let at = |jerk: f64, wander: f64| Noises {
        jerk: 10f64.powf(jerk),
        wander: 10f64.powf(wander),
        ..start
    };
    let of = |jerk: f64, wander: f64| cost::<N>(&blocks, at(jerk, wander));
    let mut jerk = start.jerk.log10();
    let mut wander = grid(jerk - 8.0, jerk, 2.0, |w| of(jerk, w));
    if !jerk_is_given {
        jerk = golden(jerk - 4.0, jerk + 0.5, 0.1, |j| of(j, wander));
    }
    wander = golden(wander - 2.0, wander + 2.0, 0.1, |w| of(jerk, w));
    if !jerk_is_given {
        jerk = golden(jerk - 1.0, jerk + 1.0, 0.05, |j| of(j, wander));
    }
    (at(jerk, wander), of(jerk, wander))
}

/// Smoothed speed times `factor`: forward filter, then the adjoint of Bryson and Frazier (1963) backwards.
///
/// Long records are run in chunks: the first pass keeps the state at each chunk's start, and the backward pass reruns
/// each chunk from there.
fn smooth<const N: usize>(counts: &[f64], turn: Turn<'_>, noises: Noises, factor: f64) -> Vec<f64> {
    let mut starts = vec![State::<N>::new(counts, noises)];
    for first in (0..counts.len()).step_by(CHUNK) {
        let mut state = starts[starts.len() - 1].clone();
        run(&mut state, counts, first, turn, noises);
        starts.push(state);
    }
    let mut speed = vec![0.0; counts.len()];
    let mut adjoint = [0.0; N];
    for (i, first) in (0..counts.len()).step_by(CHUNK).enumerate().rev() {
        let (tape, rows) = run(&mut starts[i].clone(), counts, first, turn, noises);
        for (k, trace) in tape.iter().enumerate().rev() {
            let mut ahead = [0.0; N];
            if let Some(rows) = rows.get(k) {
                ahead = transposed(rows, &adjoint);
            }
            adjoint = ahead;
            adjoint[0] += trace.innovation - dot(&trace.gain, &ahead);
            speed[first + k] = factor * (trace.speed + dot(&trace.of_speed, &adjoint));
        }
    }
    speed
}

/// Runs the filter over the chunk that starts at `first`; leaves the predicted state of the next chunk.
fn run<const N: usize>(
    state: &mut State<N>,
    counts: &[f64],
    first: usize,
    turn: Turn<'_>,
    noises: Noises,
) -> (Vec<Trace<N>>, Vec<Rows<N>>) {
    let end = (first + CHUNK).min(counts.len());
    let rows = Rows::along(turn, &counts[first..(end + 1).min(counts.len())]);
    let mut tape = Vec::with_capacity(end - first);
    for (k, count) in counts[first..end].iter().enumerate() {
        tape.push(state.update(*count, noises.rounding).0);
        if let Some(rows) = rows.get(k) {
            state.predict(rows, noises);
        }
    }
    (tape, rows)
}

/// `F' adjoint`.
fn transposed<const N: usize>(rows: &Rows<N>, adjoint: &[f64; N]) -> [f64; N] {
    std::array::from_fn(|j| {
        let own = if j < 2 { 0.0 } else { adjoint[j] };
        rows.position[j] * adjoint[0] + rows.speed[j] * adjoint[1] + own
    })
}

/// The largest number of orders.
pub(super) const MAX_ORDERS: usize = 6;

/// Smoothed speed with ripple, or `None` if the model without ripple explains the counts as well.
///
/// Each amplitude must gain `ln n` in `-2 ln` likelihood (Schwarz 1978).
pub(super) fn with_ripple(
    counts: &[f64],
    blocks: &[&[f64]],
    turn: Turn<'_>,
    start: Noises,
    jerk_is_given: bool,
    plain_cost: f64,
    factor: f64,
) -> Option<Vec<f64>> {
    let n: usize = blocks.iter().map(|counts| counts.len()).sum();
    let penalty = 2.0 * turn.orders.len() as f64 * (n as f64).ln();
    macro_rules! sized {
        ($n:literal) => {{
            let (noises, cost) = fit::<$n>(blocks, turn, start, jerk_is_given);
            (cost + penalty < plain_cost).then(|| smooth::<$n>(counts, turn, noises, factor))
        }};
    }
    match turn.orders.len() {
        1 => sized!(5),
        2 => sized!(7),
        3 => sized!(9),
        4 => sized!(11),
        5 => sized!(13),
        6 => sized!(15),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Kalman, Scale};
    use super::*;

    const TURN: Turn<'_> = Turn {
        orders: &[1, 3],
        counts_per_rev: 400.0,
    };

    /// Counts of a shaft under an acceleration that repeats over the turn, and its speed per sample.
    fn shaft(samples: usize, ripple: f64) -> (Vec<f64>, Vec<f64>) {
        const STEPS: usize = 50;
        let (mut position, mut v) = (0.4, 8.0);
        let (mut counts, mut speed) = (Vec::new(), Vec::new());
        for i in 0..samples * STEPS {
            let k = i as f64 / STEPS as f64;
            let th = TAU * position / TURN.counts_per_rev;
            let trend = 0.01 * (k / 700.0).sin();
            let a = trend + ripple * ((th + 0.3).sin() + 0.7 * (3.0 * th).cos());
            if i % STEPS == 0 {
                counts.push(f64::floor(position));
                speed.push(v);
            }
            v += a / STEPS as f64;
            position += (v - 0.5 * a / STEPS as f64) / STEPS as f64;
        }
        (counts, speed)
    }

    fn rms(a: &[f64], b: &[f64]) -> f64 {
        let square = |(a, b): (&f64, &f64)| (a - b).powi(2);
        (a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64).sqrt()
    }

    #[test]
    fn without_amplitudes_it_is_the_plain_smoother_across_chunks() {
        let (counts, _) = shaft(2 * CHUNK + 100, 0.0);
        let counts: Vec<f64> = counts.iter().map(|c| c - counts[0]).collect();
        let q = 1e-6;
        let noises = Noises {
            jerk: q,
            wander: 1e-30,
            rounding: 1.0 / 12.0,
        };
        let ripple = smooth::<7>(&counts, TURN, noises, 1.0);
        let plain = Kalman {
            process_noise: Some(q),
            ..Kalman::default()
        };
        let plain = plain
            .smooth(&counts, Scale::new(1.0, 1.0).unwrap())
            .unwrap();
        let worst = ripple.iter().zip(&plain).map(|(a, b)| (a - b).abs());
        let worst = worst.fold(0.0, f64::max);
        assert!(worst < 1e-6, "{worst}");
    }

    #[test]
    fn finds_a_speed_that_repeats_over_the_turn() {
        let (counts, truth) = shaft(20_000, 0.05);
        let scale = Scale::new(1.0, 1.0).unwrap();
        let with = |orders| Kalman {
            ripple_orders: orders,
            counts_per_rev: TURN.counts_per_rev,
            ..Kalman::default()
        };
        let error = |orders| rms(&with(orders).smooth(&counts, scale).unwrap(), &truth);
        let (plain, ripple) = (error(&[]), error(TURN.orders));
        assert!(ripple < 0.5 * plain, "{ripple} {plain}");
    }

    #[test]
    fn leaves_a_smooth_motion_to_the_plain_smoother_and_refuses_orders_without_meaning() {
        let (counts, _) = shaft(5_000, 0.0);
        let scale = Scale::new(1.0, 1.0).unwrap();
        let with = |orders, counts_per_rev| Kalman {
            ripple_orders: orders,
            counts_per_rev,
            ..Kalman::default()
        };
        let plain = with(&[], 400.0).smooth(&counts, scale).unwrap();
        assert_eq!(with(&[1, 3], 400.0).smooth(&counts, scale).unwrap(), plain);
        for orders in [&[0][..], &[1, 1], &[1, 2, 3, 4, 5, 6, 7]] {
            assert!(with(orders, 400.0).smooth(&counts, scale).is_err());
        }
        assert!(with(&[1], 0.0).smooth(&counts, scale).is_err());
    }
}
