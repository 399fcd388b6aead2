//! Gains of the filter and the smoother under white jerk, and their two passes.

use nalgebra::{Matrix3, Vector3};

/// Riccati steps until the gains count as constant, whatever they do.
const MAX_TRANSIENT: usize = 50_000;

/// What the innovations say about the noises: `sum ln s`, `sum e^2/s` and their number.
pub(super) struct Innovations {
    pub log_variance: f64,
    pub square: f64,
    pub n: f64,
}

/// One sample's gains: the filter's, the smoother's, and the innovation's variance.
#[derive(Clone, Copy)]
struct Gain {
    filter: Vector3<f64>,
    smoother: Matrix3<f64>,
    variance: f64,
}

/// Gains from the first sample until they stop changing; the last one holds from then on.
pub(super) struct Gains(Vec<Gain>);

impl Gains {
    pub fn new(q: f64, r: f64, counts: &[f64]) -> Self {
        let (f, noise) = (transition(), jerk(q));
        let mut p = prior(counts, r);
        let mut gains: Vec<Gain> = Vec::new();
        while gains.len() < counts.len().min(MAX_TRANSIENT) {
            let variance = p[(0, 0)] + r;
            let filter: Vector3<f64> = p.column(0) / variance;
            // Joseph's form keeps the covariance positive where the subtraction would cancel.
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

    /// Runs the filter and gathers its innovations; the first three only find the state.
    pub fn innovations(&self, counts: &[f64]) -> Innovations {
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
    pub fn smooth(&self, counts: &[f64], factor: f64) -> Vec<f64> {
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

pub(super) fn transition() -> Matrix3<f64> {
    Matrix3::new(1.0, 1.0, 0.5, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0)
}

/// Covariance that white jerk of intensity `q` adds in one sample.
pub(super) fn jerk(q: f64) -> Matrix3<f64> {
    let (a, b, c) = (1.0 / 20.0, 1.0 / 8.0, 1.0 / 6.0);
    Matrix3::new(a, b, c, b, 1.0 / 3.0, 0.5, c, 0.5, 1.0) * q
}

/// The first position is known to one count; speed and acceleration are as wide as the largest step.
pub(super) fn prior(counts: &[f64], r: f64) -> Matrix3<f64> {
    let step = counts
        .windows(2)
        .map(|w| (w[1] - w[0]).abs())
        .fold(1.0, f64::max);
    Matrix3::from_diagonal(&Vector3::new(r, step * step, step * step))
}

/// `C = P(k|k) F' P(k+1|k)^-1`, from `P(k+1|k)` and `F P(k|k)`.
fn smoother(predicted: &Matrix3<f64>, ahead: &Matrix3<f64>) -> Matrix3<f64> {
    let solved = predicted.cholesky().map(|factor| factor.solve(ahead));
    // A covariance that rounding has made singular carries nothing back; it cannot be reached with q > 0.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equals_the_dense_least_squares_solution() {
        // The smoother's mean minimises sum (c - x1)^2/r + sum w' Q^-1 w + prior, solved here all at once.
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
}
