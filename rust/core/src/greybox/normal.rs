//! The normal equations of a motor's fit, from whitened residuals and their derivatives.
//!
//! Each sample's row holds the derivatives and, last, simulated minus measured. A finite filter (`filter[l]` for the row `l` samples
//! before) whitens the rows' errors before they are summed. Samples that are not used are rows of zeros.

use super::{Found, Run, run};
use crate::gram::Gram;
use crate::simd::{self, F64x8, Kernel};
use crate::{Error, Monitor, Result};

/// The measurements that a run is compared with.
#[derive(Clone, Copy, Debug)]
pub struct Measured<'a> {
    /// Speed \[rad/s\], (N).
    pub speed: &'a [f64],
    /// Whether a sample counts, (N).
    pub used: &'a [bool],
    /// The whitening filter of the speed errors.
    pub filter: &'a [f64],
    /// The motor's current, if it was measured.
    pub current: Option<Current<'a>>,
}

/// Measured currents; the model's current is the drive over a resistance.
#[derive(Clone, Copy, Debug)]
pub struct Current<'a> {
    /// Current \[A\], (N).
    pub samples: &'a [f64],
    /// The whitening filter of the current errors.
    pub filter: &'a [f64],
    /// Command per ampere.
    pub resistance: f64,
}

/// A cost and its derivatives by the free parameters, then by the resistance if a current is measured.
#[derive(Clone, Debug, PartialEq)]
pub struct Normal {
    /// `e'e`.
    pub cost: f64,
    /// `J'e`, (n).
    pub gradient: Vec<f64>,
    /// `J'J` row by row, (n, n).
    pub matrix: Vec<f64>,
}

/// The normal equations at the parameters of a run.
///
/// # Errors
/// As [`run`]; data errors for lengths that differ, a setting error for a resistance that is not above 0.
pub fn normal(
    task: Run<'_>,
    u: &[f64],
    measured: Measured<'_>,
    monitor: &Monitor,
) -> Result<Normal> {
    let n = u.len();
    let lengths = [measured.speed.len(), measured.used.len()];
    let others = measured.current.map_or(n, |c| c.samples.len());
    if lengths != [n, n] || others != n {
        return Err(Error::data(format!(
            "expected {n} speeds, uses and currents, one per command, got {lengths:?} and {others}"
        )));
    }
    if let Some(c) = measured.current
        && !(c.resistance.is_finite() && c.resistance > 0.0)
    {
        return Err(Error::setting(format!(
            "expected a resistance above 0, got {}",
            c.resistance
        )));
    }
    let filters = [Some(measured.filter), measured.current.map(|c| c.filter)];
    if filters.into_iter().flatten().any(<[f64]>::is_empty) {
        return Err(Error::setting(
            "expected filters of a tap or more, got none; [1] filters nothing",
        ));
    }
    let found = run(task, u, monitor)?;
    let m = task.free.len();
    let parameters = m + usize::from(measured.current.is_some());
    let mut gram = Gram::new(parameters + 1, 0);
    simd::run(Sum(&found, m, measured, &mut gram));
    let sums = gram.matrix();
    let gradient = sums.view((0, parameters), (parameters, 1));
    let matrix = sums.view((0, 0), (parameters, parameters));
    Ok(Normal {
        cost: sums[(parameters, parameters)],
        gradient: gradient.iter().copied().collect(),
        matrix: matrix.iter().copied().collect(),
    })
}

struct Sum<'a>(&'a Found, usize, Measured<'a>, &'a mut Gram);

impl Kernel for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        let Self(found, m, measured, gram) = self;
        let by_resistance = usize::from(measured.current.is_some());
        let error = m + by_resistance;
        summed(gram, measured.used, measured.filter, |k, row| {
            row[..m].copy_from_slice(&found.speed_by[k * m..][..m]);
            row[error] = found.speed[k] - measured.speed[k];
        });
        if let Some(current) = measured.current {
            let per = 1.0 / current.resistance;
            summed(gram, measured.used, current.filter, |k, row| {
                for (value, by) in row.iter_mut().zip(&found.drive_by[k * m..][..m]) {
                    *value = per * by;
                }
                row[m] = -per * per * found.drive[k];
                row[error] = per * found.drive[k] - current.samples[k];
            });
        }
    }
}

/// Adds filtered rows; `write` fills a row of zeros.
#[inline(always)]
fn summed(gram: &mut Gram, used: &[bool], filter: &[f64], write: impl Fn(usize, &mut [f64])) {
    let width = gram.width();
    let lags = filter.len();
    let mut past = vec![0.0; lags * width];
    for (k, &used) in used.iter().enumerate() {
        let newest = k % lags;
        let row = &mut past[newest * width..][..width];
        row.fill(0.0);
        if used {
            write(k, row);
        }
        gram.add(|sum| {
            sum.fill(0.0);
            for (lag, gain) in filter.iter().enumerate() {
                let at = (newest + lags - lag) % lags;
                for (value, old) in sum.iter_mut().zip(&past[at * width..][..width]) {
                    *value += gain * old;
                }
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::PARAMETERS;
    use super::*;

    const FREE: [usize; 3] = [0, 2, 6];

    fn theta() -> [f64; PARAMETERS.len()] {
        let mut theta = [0.0; PARAMETERS.len()];
        (theta[0], theta[2], theta[3], theta[6]) = (0.02, 0.005, 0.004, 0.2);
        (theta[5], theta[9], theta[17]) = (1.0, 1.0, f64::INFINITY);
        theta
    }

    fn task<'a>(theta: &'a [f64; PARAMETERS.len()], free: &'a [usize]) -> Run<'a> {
        Run {
            theta,
            free,
            sample_time: 0.001,
            steps: 2,
            speed: 0.0,
            mean: true,
            angle: None,
            orders: [0; crate::greybox::ORDERS],
        }
    }

    /// The sums, by an explicit matrix of rows.
    #[test]
    fn the_sums_are_those_of_the_rows() {
        let (theta, n) = (theta(), 150);
        let u: Vec<f64> = (0..n).map(|k| if k < 70 { 5.0 } else { -3.0 }).collect();
        let speed: Vec<f64> = (0..n).map(|k| k as f64).collect();
        let samples: Vec<f64> = (0..n).map(|k| 0.01 * k as f64).collect();
        let used: Vec<bool> = (0..n).map(|k| k % 7 != 0).collect();
        let measured = Measured {
            speed: &speed,
            used: &used,
            filter: &[0.5, -0.3, 0.1],
            current: Some(Current {
                samples: &samples,
                filter: &[2.0, -1.0],
                resistance: 0.8,
            }),
        };
        let none = Monitor::default();
        let found = normal(task(&theta, &FREE), &u, measured, &none).unwrap();
        let of = run(task(&theta, &FREE), &u, &none).unwrap();
        let filtered = |rows: Vec<[f64; 5]>, filter: &[f64]| -> Vec<[f64; 5]> {
            let at = |k: usize, j: usize| if used[k] { rows[k][j] } else { 0.0 };
            let one = |k: usize, j: usize| -> f64 {
                let lags = filter.iter().enumerate().take(k + 1);
                lags.map(|(lag, gain)| gain * at(k - lag, j)).sum()
            };
            (0..n).map(|k| std::array::from_fn(|j| one(k, j))).collect()
        };
        let speeds = (0..n).map(|k| {
            let by = &of.speed_by[3 * k..];
            [by[0], by[1], by[2], 0.0, of.speed[k] - speed[k]]
        });
        let currents = (0..n).map(|k| {
            let (by, x) = (&of.drive_by[3 * k..], of.drive[k]);
            let off = x / 0.8 - samples[k];
            [by[0] / 0.8, by[1] / 0.8, by[2] / 0.8, -x / 0.64, off]
        });
        let mut rows = filtered(speeds.collect(), &[0.5, -0.3, 0.1]);
        rows.extend(filtered(currents.collect(), &[2.0, -1.0]));
        let sum = |i: usize, j: usize| rows.iter().map(|r| r[i] * r[j]).sum::<f64>();
        let near = |a: f64, b: f64| assert!((a - b).abs() <= 1e-9 * b.abs().max(1.0), "{a} {b}");
        near(found.cost, sum(4, 4));
        for i in 0..4 {
            near(found.gradient[i], sum(i, 4));
            (0..4).for_each(|j| near(found.matrix[4 * i + j], sum(i, j)));
        }
    }

    #[test]
    fn lengths_that_differ_are_refused() {
        let (theta, none) = (theta(), Monitor::default());
        let measured = Measured {
            speed: &[0.0; 3],
            used: &[true; 4],
            filter: &[1.0],
            current: None,
        };
        assert!(normal(task(&theta, &[]), &[1.0; 4], measured, &none).is_err());
        let current = Some(Current {
            samples: &[0.0; 4],
            filter: &[1.0],
            resistance: 0.0,
        });
        let measured = Measured {
            speed: &[0.0; 4],
            current,
            ..measured
        };
        let refused = normal(task(&theta, &[]), &[1.0; 4], measured, &none).unwrap_err();
        assert!(refused.message.contains("resistance"));
    }
}
