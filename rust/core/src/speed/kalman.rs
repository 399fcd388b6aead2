//! Kalman filter on the position with a Rauch-Tung-Striebel smoother: the search for its noise intensities, its gains
//! under white jerk, its two passes.

use nalgebra::{Matrix3, Vector3};

use super::ripple::{MAX_ORDERS, Noises, Turn, with_ripple};
use super::{Scale, check};
use crate::{Error, Result};

/// Variance of a position known to one count (count^2).
const QUANTISATION: f64 = 1.0 / 12.0;
/// Samples of each of the eight blocks that represent a long record.
const BLOCK: usize = 4_096;
/// Searched decimal exponents of the white-jerk intensity (count^2/sample^5).
const SEARCH: (f64, f64) = (-16.0, 4.0);
/// Accuracy of the search in decades; a tenth of a decade moves the bandwidth by 4 %.
const TOLERANCE: f64 = 0.02;

/// Smoothed speed of a motion whose jerk is white noise, observed by counts (Belanger et al., Int. J. Robotics Research
/// 17, 1998, use the same kind of model for encoders).
///
/// The state is position, speed and acceleration in counts and samples:
/// `x(k+1) = F x(k) + w`, `F = [1 1 1/2; 0 1 1; 0 0 1]`, `cov w = q [1/20 1/8 1/6; 1/8 1/3 1/2; 1/6 1/2 1]`,
/// `c(k) = x_1(k) + v`, `var v = 1/12` for whole counts. A backward pass then uses the counts that came later
/// (Rauch, Tung and Striebel, AIAA Journal 3, 1965). The gains soon become constant, so both passes cost a few
/// operations per sample.
///
/// If `q` is not given it maximises the likelihood of the innovations. Counts that are not whole numbers come from an
/// ideal encoder or another sensor: then `var v` is estimated as well.
///
/// With `ripple_orders`, whole counts are also tried with a load that repeats over the turn (`ripple.rs`); the more
/// likely of the two models smooths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Kalman<'a> {
    /// Intensity of the white jerk (unit^2/s^3); `None` to estimate it.
    pub process_noise: Option<f64>,
    /// Multiples of the shaft's turn at which the load may repeat; if empty, ripple counts as white jerk.
    pub ripple_orders: &'a [u32],
    /// Counts of one turn of the shaft.
    pub counts_per_rev: f64,
}

impl Default for Kalman<'_> {
    fn default() -> Self {
        Self {
            process_noise: None,
            ripple_orders: &[],
            counts_per_rev: 1.0,
        }
    }
}

impl Kalman<'_> {
    /// The smoothed speed of `counts`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a process noise or counts per turn that are not finite and above zero, or orders that
    /// are zero, repeated or more than 6; `ErrorKind::Data` for fewer than 5 counts, or counts that cannot be used.
    pub fn smooth(&self, counts: &[f64], scale: Scale) -> Result<Vec<f64>> {
        check(counts, 5)?;
        let turn = self.turn()?;
        let q = self.given(scale)?;
        // Relative to the first, so that a large count costs no digits.
        let relative: Vec<f64> = counts.iter().map(|c| c - counts[0]).collect();
        let (blocks, factor) = (blocks(&relative), scale.per_count());
        let (jerk, rounding) = noises(&blocks, q);
        if !turn.orders.is_empty() && is_whole(counts) {
            let start = Noises {
                jerk,
                rounding,
                wander: 0.0,
            };
            let plain = cost(&blocks, jerk);
            let found = with_ripple(&relative, &blocks, turn, start, q.is_some(), plain, factor);
            if let Some(speed) = found {
                return Ok(speed);
            }
        }
        Ok(Gains::new(jerk, rounding, &relative).smooth(&relative, factor))
    }

    fn turn(&self) -> Result<Turn<'_>> {
        let (orders, counts_per_rev) = (self.ripple_orders, self.counts_per_rev);
        let repeated = |i: usize| orders[..i].contains(&orders[i]) || orders[i] == 0;
        if orders.len() > MAX_ORDERS || (0..orders.len()).any(repeated) {
            return Err(Error::setting(format!(
                "expected up to {MAX_ORDERS} different ripple_orders from 1, got {orders:?}; leave some out"
            )));
        }
        if !(counts_per_rev.is_finite() && counts_per_rev > 0.0) {
            return Err(Error::setting(format!(
                "expected counts_per_rev finite and above 0, got {counts_per_rev}; give the encoder's"
            )));
        }
        Ok(Turn {
            orders,
            counts_per_rev,
        })
    }

    fn given(&self, scale: Scale) -> Result<Option<f64>> {
        let usable = |q: f64| q.is_finite() && q > 0.0;
        match self.process_noise {
            Some(q) if !usable(q) || !usable(scale.jerk_in_counts(q)) => {
                Err(Error::setting(format!(
                    "expected process_noise finite and above 0 unit^2/s^3, got {q}; leave it out to have it found"
                )))
            }
            q => Ok(q.map(|q| scale.jerk_in_counts(q))),
        }
    }
}

/// The parts of a record from which the noises are estimated: all of it, or eight blocks spread evenly over a long one.
fn blocks(counts: &[f64]) -> Vec<&[f64]> {
    const BLOCKS: usize = 8;
    if counts.len() <= BLOCKS * BLOCK {
        return vec![counts];
    }
    let first = |i: usize| i * (counts.len() - BLOCK) / (BLOCKS - 1);
    (0..BLOCKS)
        .map(|i| &counts[first(i)..first(i) + BLOCK])
        .collect()
}

fn is_whole(counts: &[f64]) -> bool {
    counts.iter().all(|c| c.fract() == 0.0)
}

/// `-2 ln` of the likelihood of whole counts.
fn cost(blocks: &[&[f64]], q: f64) -> f64 {
    let fit = innovations(blocks, q, QUANTISATION);
    fit.log_variance + fit.square
}

/// Process noise and measurement noise (count^2/sample^5, count^2).
fn noises(blocks: &[&[f64]], q: Option<f64>) -> (f64, f64) {
    if let Some(q) = q {
        return (q, QUANTISATION);
    }
    if blocks.iter().all(|counts| is_whole(counts)) {
        let exponent = minimise(|x| cost(blocks, 10f64.powf(x)));
        return (10f64.powf(exponent), QUANTISATION);
    }
    // With var v = 1 the likelihood is largest for the scale `square / n`, which is substituted in this cost.
    let fit = |exponent: f64| innovations(blocks, 10f64.powf(exponent), 1.0);
    let exponent = minimise(|x| {
        let fit = fit(x);
        fit.log_variance + fit.n * (fit.square / fit.n).max(f64::MIN_POSITIVE).ln()
    });
    let best = fit(exponent);
    // An exactly resting or linear motion leaves no innovation; the speed does not depend on the scale.
    let noise = (best.square / best.n).max(1e-12);
    (10f64.powf(exponent) * noise, noise)
}

/// The minimum of `cost` over the searched exponents: a coarse grid, then golden sections around its best point.
fn minimise(cost: impl Fn(f64) -> f64) -> f64 {
    let best = grid(SEARCH.0, SEARCH.1, 2.0, &cost);
    golden(best - 2.0, best + 2.0, TOLERANCE, &cost)
}

fn innovations(blocks: &[&[f64]], q: f64, r: f64) -> Innovations {
    let of = |counts: &&[f64]| Gains::new(q, r, counts).innovations(counts);
    let add = |a: Innovations, b: Innovations| Innovations {
        log_variance: a.log_variance + b.log_variance,
        square: a.square + b.square,
        n: a.n + b.n,
    };
    let none = Innovations {
        log_variance: 0.0,
        square: 0.0,
        n: 0.0,
    };
    blocks.iter().map(of).fold(none, add)
}

// Gains of the filter and the smoother under white jerk, and their two passes.

/// Riccati steps after which the gains count as constant in any case.
const MAX_TRANSIENT: usize = 50_000;

/// Statistics of the innovations for the noises: `sum ln s`, `sum e^2/s` and their number.
struct Innovations {
    log_variance: f64,
    square: f64,
    n: f64,
}

/// One sample's gains: the filter's, the smoother's, and the innovation's variance.
#[derive(Clone, Copy)]
struct Gain {
    filter: Vector3<f64>,
    smoother: Matrix3<f64>,
    variance: f64,
}

/// Gains from the first sample until they become constant; the last one holds from then on.
struct Gains(Vec<Gain>);

impl Gains {
    fn new(q: f64, r: f64, counts: &[f64]) -> Self {
        let (f, noise) = (transition(), jerk(q));
        let mut p = prior(counts, r);
        let mut gains: Vec<Gain> = Vec::new();
        while gains.len() < counts.len().min(MAX_TRANSIENT) {
            let variance = p[(0, 0)] + r;
            let filter: Vector3<f64> = p.column(0) / variance;
            // Joseph's form keeps the covariance positive where the plain subtraction would cancel.
            let mut keep = Matrix3::identity();
            keep.set_column(0, &(keep.column(0) - filter));
            let updated = keep * p * keep.transpose() + filter * filter.transpose() * r;
            let ahead = f * updated;
            p = ahead * f.transpose() + noise;
            p = (p + p.transpose()) * 0.5;
            let smoother = smoother(&p, &ahead);
            let gain = Gain {
                filter,
                smoother,
                variance,
            };
            let settled = gains.last().is_some_and(|last| settled(last, &gain));
            gains.push(gain);
            if settled {
                break;
            }
        }
        Self(gains)
    }

    fn at(&self, k: usize) -> &Gain {
        &self.0[k.min(self.0.len() - 1)]
    }

    /// Runs the filter and collects its innovations; the first three only determine the state.
    fn innovations(&self, counts: &[f64]) -> Innovations {
        let mut sum = Innovations {
            log_variance: 0.0,
            square: 0.0,
            n: 0.0,
        };
        let mut x = Vector3::new(counts[0], 0.0, 0.0);
        for (k, c) in counts.iter().enumerate() {
            let gain = self.at(k);
            let e = c - x[0];
            if k >= 3 {
                sum.square += e * e / gain.variance;
            }
            x = predict(&(x + gain.filter * e));
        }
        let transient = self.0.len().min(counts.len());
        let early = self.0[..transient]
            .iter()
            .skip(3)
            .map(|g| g.variance.ln())
            .sum::<f64>();
        let late = (counts.len() - transient) as f64 * self.at(transient).variance.ln();
        sum.log_variance = early + late;
        sum.n = counts.len() as f64 - 3.0;
        sum
    }

    /// Forward filter, backward smoother; the speed times `factor`.
    fn smooth(&self, counts: &[f64], factor: f64) -> Vec<f64> {
        let mut filtered = Vec::with_capacity(counts.len());
        let mut x = Vector3::zeros();
        for (k, c) in counts.iter().enumerate() {
            let updated = x + self.at(k).filter * (c - x[0]);
            filtered.push(updated);
            x = predict(&updated);
        }
        let mut speed = vec![0.0; counts.len()];
        let mut later = filtered[counts.len() - 1];
        speed[counts.len() - 1] = factor * later[1];
        for k in (0..counts.len() - 1).rev() {
            later = filtered[k] + self.at(k).smoother * (later - predict(&filtered[k]));
            speed[k] = factor * later[1];
        }
        speed
    }
}

fn transition() -> Matrix3<f64> {
    Matrix3::new(1.0, 1.0, 0.5, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0)
}

/// Covariance that white jerk of intensity `q` adds in one sample.
fn jerk(q: f64) -> Matrix3<f64> {
    let (a, b, c) = (1.0 / 20.0, 1.0 / 8.0, 1.0 / 6.0);
    Matrix3::new(a, b, c, b, 1.0 / 3.0, 0.5, c, 0.5, 1.0) * q
}

/// The first position is known to one count; speed and acceleration are as uncertain as the largest step.
fn prior(counts: &[f64], r: f64) -> Matrix3<f64> {
    let step = counts
        .windows(2)
        .map(|w| (w[1] - w[0]).abs())
        .fold(1.0, f64::max);
    Matrix3::from_diagonal(&Vector3::new(r, step * step, step * step))
}

/// `C = P(k|k) F' P(k+1|k)^-1`, from `P(k+1|k)` and `F P(k|k)`.
fn smoother(predicted: &Matrix3<f64>, ahead: &Matrix3<f64>) -> Matrix3<f64> {
    let solved = predicted.cholesky().map(|factor| factor.solve(ahead));
    // A covariance made singular by rounding carries nothing back; this cannot happen with q > 0.
    solved.map_or_else(Matrix3::zeros, |c| c.transpose())
}

fn settled(last: &Gain, gain: &Gain) -> bool {
    let same = |a: f64, b: f64| (a - b).abs() <= 1e-10 * b.abs();
    same(last.variance, gain.variance)
        && last
            .filter
            .iter()
            .zip(&gain.filter)
            .all(|(a, b)| same(*a, *b))
}

fn predict(x: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(x[0] + x[1] + 0.5 * x[2], x[1] + x[2], x[2])
}

// Searches along a line, for the intensities here and for those of the ripple.

/// The point of the grid `from, from + step, .. <= to` with the least cost.
pub(super) fn grid(from: f64, to: f64, step: f64, cost: impl Fn(f64) -> f64) -> f64 {
    let count = ((to - from) / step).round() as usize;
    let points = (0..=count).map(|i| from + i as f64 * step);
    let costs = points.map(|x| (x, cost(x)));
    costs
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map_or(from, |best| best.0)
}

/// The least cost between `a` and `b` by golden sections, to `tolerance`.
pub(super) fn golden(mut a: f64, mut b: f64, tolerance: f64, cost: impl Fn(f64) -> f64) -> f64 {
    let golden = 0.5 * (5f64.sqrt() - 1.0);
    let (mut x1, mut x2) = (b - golden * (b - a), a + golden * (b - a));
    let (mut f1, mut f2) = (cost(x1), cost(x2));
    while b - a > tolerance {
        if f1 < f2 {
            (b, x2, f2) = (x2, x1, f1);
            x1 = b - golden * (b - a);
            f1 = cost(x1);
        } else {
            (a, x1, f1) = (x1, x2, f2);
            x2 = a + golden * (b - a);
            f2 = cost(x2);
        }
    }
    0.5 * (a + b)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::difference;
    use super::*;
    use crate::random::Random;

    /// The chirp's response of 490/((.252 s + 1)(.0074 s + 1)) with a ripple over the turn: counts and speed [RPM].
    fn plant(quantise: bool) -> (Vec<f64>, Vec<f64>, Scale) {
        let scale = Scale::new(1e-3, 26.2).unwrap();
        let (mut slow, mut fast, mut position, mut before) = (0.0f64, 0.0f64, 0.3f64, 0.0f64);
        let (mut counts, mut speed) = (Vec::new(), Vec::new());
        for i in 0..200_000 {
            let t = f64::from(i) * 1e-4;
            let share = t / 20.0;
            let angle = std::f64::consts::TAU * t * (0.1 + 1.45 * share);
            let u = 1.0 + 4.2 * share - (0.5 + 4.1 * share) * angle.cos();
            let turn = std::f64::consts::TAU * position / 1572.0;
            let v = fast + 8.0 * turn.sin() * (fast / 500.0).min(1.0);
            if i % 10 == 0 {
                counts.push(if quantise { position.floor() } else { position });
                speed.push(0.5 * (before + v));
            }
            before = v;
            position += v * 26.2 * 1e-4;
            slow += 1e-4 * (490.0 * u - slow) / 0.252;
            fast += 1e-4 * (slow - fast) / 0.0074;
        }
        (counts, speed, scale)
    }

    fn rms(a: &[f64], b: &[f64]) -> f64 {
        let square = |(a, b): (&f64, &f64)| (a - b).powi(2);
        (a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64).sqrt()
    }

    #[test]
    fn finds_the_speed_of_a_chirp_within_one_rpm() {
        let (counts, truth, scale) = plant(true);
        let kalman = Kalman::default().smooth(&counts, scale).unwrap();
        let raw = difference(&counts, scale).unwrap();
        assert!(rms(&kalman, &truth) < 1.0, "{}", rms(&kalman, &truth));
        assert!(rms(&raw, &truth) > 10.0);
    }

    #[test]
    fn follows_an_exact_position_closely() {
        let (counts, truth, scale) = plant(false);
        let kalman = Kalman::default().smooth(&counts, scale).unwrap();
        assert!(rms(&kalman, &truth) < 0.1, "{}", rms(&kalman, &truth));
    }

    #[test]
    fn rests_at_standstill_and_after_it() {
        let scale = Scale::new(1e-3, 26.2).unwrap();
        let still = Kalman::default().smooth(&[7.0; 2000], scale).unwrap();
        assert!(still.iter().all(|v| v.abs() < 1e-6));
        let mut position = 0.0f64;
        let mut moving = vec![0.0; 3000];
        for k in 0..3000 {
            position += 52.4 * (f64::from(k) / 600.0).sin().abs();
            moving.push(position.floor());
        }
        moving.extend(std::iter::repeat_n(position.floor(), 2000));
        let speed = Kalman::default().smooth(&moving, scale).unwrap();
        assert!(speed[..2900].iter().all(|v| v.abs() < 1.0));
        assert!(speed[6200..].iter().all(|v| v.abs() < 1.0));
    }

    #[test]
    fn recovers_the_noise_that_made_the_motion() {
        let mut random = Random::new(3);
        let root = jerk(1e-4).cholesky().unwrap().l();
        let mut x = Vector3::zeros();
        let counts: Vec<f64> = (0..50_000)
            .map(|_| {
                let w = Vector3::from_fn(|_, _| random.normal());
                x = transition() * x + root * w;
                x[2] *= 0.999;
                x[0] + 0.5 * random.normal()
            })
            .collect();
        let (q, noise) = noises(&[&counts], None);
        assert!((noise - 0.25).abs() < 0.02, "{noise}");
        assert!((q.log10() + 4.0).abs() < 0.15, "{q}");
    }

    #[test]
    fn refuses_a_process_noise_without_meaning() {
        let scale = Scale::new(1e-3, 26.2).unwrap();
        for q in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let kalman = Kalman {
                process_noise: Some(q),
                ..Kalman::default()
            };
            assert!(kalman.smooth(&[0.0; 9], scale).is_err());
        }
        assert!(Kalman::default().smooth(&[0.0; 4], scale).is_err());
    }

    #[test]
    fn equals_the_dense_least_squares_solution() {
        // The smoother's mean minimises sum (c - x1)^2/r + sum w' Q^-1 w + prior, solved here as one system.
        let (q, r) = (1e-3, 1.0 / 12.0);
        let counts = [0.0, 1.0, 3.0, 4.0, 8.0, 11.0, 15.0, 16.0];
        let smooth = Gains::new(q, r, &counts).smooth(&counts, 1.0);
        let n = 3 * counts.len();
        let (f, w) = (transition(), jerk(q).try_inverse().unwrap());
        let (mut a, mut b) = (nalgebra::DMatrix::zeros(n, n), nalgebra::DVector::zeros(n));
        let mut add = |i: usize, j: usize, m: Matrix3<f64>| {
            let mut block = a.fixed_view_mut::<3, 3>(3 * i, 3 * j);
            block += m;
        };
        add(0, 0, prior(&counts, r).try_inverse().unwrap());
        for (k, c) in counts.iter().enumerate() {
            let mut seen = Matrix3::zeros();
            seen[(0, 0)] = 1.0 / r;
            add(k, k, seen);
            b[3 * k] = c / r;
        }
        for k in 0..counts.len() - 1 {
            add(k, k, f.transpose() * w * f);
            add(k + 1, k + 1, w);
            add(k, k + 1, -f.transpose() * w);
            add(k + 1, k, -w * f);
        }
        let dense = a.lu().solve(&b).unwrap();
        for (k, v) in smooth.iter().enumerate() {
            assert!(
                (v - dense[3 * k + 1]).abs() < 1e-8,
                "{k}: {v} {}",
                dense[3 * k + 1]
            );
        }
    }

    #[test]
    fn find_the_lowest_point() {
        let cost = |x: f64| (x - 1.3).powi(2);
        assert_eq!(grid(-4.0, 4.0, 2.0, cost), 2.0);
        assert!((golden(-2.0, 4.0, 1e-3, cost) - 1.3).abs() < 1e-3);
    }
}
