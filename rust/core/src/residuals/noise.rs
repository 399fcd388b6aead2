//! The noise in a residual as an autoregression: its order, innovations, and the power that it gives to other columns.

use nalgebra::{DMatrix, DVector};

use super::columns::{Columns, squared};
use super::number;
use crate::gram::Gram;
use crate::linear::{companion, is_stable, poles, polynomial};

/// The largest order, orders per decade of samples, and samples for each.
const LARGEST_ORDER: usize = 40;
const ORDERS_PER_DECADE: f64 = 10.0;
const SAMPLES_PER_ORDER: usize = 20;
/// Least share of an innovation in the power of a series: below it a series is a sum of exponentials, and rounding.
const LEAST: f64 = 1e-14;
/// Distance from the unit circle of a pole that is on it: its noise has no variance otherwise.
const ON_THE_CIRCLE: f64 = 1e-7;

/// `e(k) = sum_i a[i] e(k-1-i) + w(k)`, `w` white.
#[derive(Clone, Debug)]
pub struct Noise {
    /// Coefficients; none: white.
    pub(super) a: Vec<f64>,
    /// Variance of `w`.
    pub innovation: f64,
    /// Variance of `e`.
    pub variance: f64,
}

impl Noise {
    /// White noise of a variance.
    pub fn white(variance: f64) -> Self {
        Self {
            a: Vec::new(),
            innovation: variance,
            variance,
        }
    }

    /// Least squares over the samples that are known, the order by Akaike's criterion, or by Schwarz's if `sparing`: for a series that is
    /// white unless there is strong evidence. Parameters estimated on these samples cost a degree of freedom each (`spent`).
    pub fn fit(series: &[Vec<f64>], known: &[Vec<bool>], spent: f64, sparing: bool) -> Self {
        let n: usize = known.iter().map(|k| number(k)).sum();
        let pairs = series.iter().flatten().zip(known.iter().flatten());
        let squares: f64 = pairs.filter(|(_, k)| **k).map(|(e, _)| e * e).sum();
        let variance = squares / (n as f64 - spent).max(0.5 * n as f64).max(1.0);
        let longest = known.iter().map(|k| number(k)).max().unwrap_or(0);
        let order = LARGEST_ORDER
            .min((ORDERS_PER_DECADE * (longest.max(1) as f64).log10()) as usize)
            .min(longest / SAMPLES_PER_ORDER);
        if order == 0 || squares <= 0.0 {
            return Self::white(variance);
        }
        let price = if sparing { (n as f64).ln() } else { 2.0 };
        let (a, share) = autoregression(series, known, order, price);
        Self {
            a,
            innovation: variance * share,
            variance,
        }
    }

    /// Where `w(k)` depends on known values only.
    pub(super) fn known(&self, known: &[bool]) -> Vec<bool> {
        let p = self.a.len();
        let mut length = 0;
        let whole = |k: &bool| {
            length = if *k { length + 1 } else { 0 };
            length > p
        };
        known.iter().map(whole).collect()
    }

    /// `w(k)` of every column, with zeros before the first sample.
    pub(super) fn whitened(&self, columns: &Columns) -> Columns {
        let n = columns.len();
        let width = columns.width();
        let mut found = columns.clone().into_values();
        for k in 0..n {
            let row = &mut found[k * width..][..width];
            for (a, back) in self.a.iter().zip((0..k).rev()) {
                add(row, -a, columns.row(back));
            }
        }
        Columns::new(found, n)
    }

    /// `Z' R Z` over all experiments, `R` the covariance matrix of the noise; `Z` is zero where a sample does not count.
    ///
    /// `R = H'H innovation` with the response `H` of the noise's filter to the innovations of all times. `H Z` is the filter run
    /// backwards: `v(k) = z(k) + sum_i a[i] v(k+1+i)`, before the first sample without input. A filter that is not stable has the spectrum
    /// of the stable one with its poles mirrored.
    pub(super) fn power_of(&self, mut columns: Vec<Columns>) -> DMatrix<f64> {
        let (a, innovation) = self.stable();
        for z in &mut columns {
            let width = z.width();
            for k in (0..z.len()).rev() {
                let (row, next) = z.row_and_next(k);
                for (a, next) in a.iter().zip(next.chunks_exact(width.max(1))) {
                    add(row, *a, next);
                }
            }
        }
        let mut power = squared(&columns);
        let (decay, p) = (decayed(&a), a.len());
        for z in columns.iter().filter(|_| p > 0) {
            let first = DMatrix::from_fn(
                p,
                z.width(),
                |i, j| {
                    if i < z.len() { z.row(i)[j] } else { 0.0 }
                },
            );
            power += first.tr_mul(&(&decay * &first));
        }
        power * innovation
    }

    /// Coefficients with the same spectrum and every pole inside the unit circle, and their innovation's variance.
    fn stable(&self) -> (Vec<f64>, f64) {
        let negative: Vec<f64> = self.a.iter().map(|a| -a).collect();
        if is_stable(&negative, 0.0) {
            return (self.a.clone(), self.innovation);
        }
        // |1 - p/z| = |p| |1 - 1/(p' z)| on the circle
        let mut gain = 1.0;
        let inside = poles(&negative).into_iter().map(|p| {
            let radius = p.norm();
            if radius < 1.0 {
                return p;
            }
            gain *= radius;
            p * ((1.0 / radius).min(1.0 - ON_THE_CIRCLE) / radius)
        });
        let inside = polynomial(&inside.collect::<Vec<_>>());
        let a = inside.iter().map(|a| -a).collect();
        (a, self.innovation / (gain * gain))
    }
}

fn add(row: &mut [f64], factor: f64, other: &[f64]) {
    row.iter_mut()
        .zip(other)
        .for_each(|(v, o)| *v += factor * o);
}

/// `P` with `x'Px` the power of the filter's output without input, after the outputs `x`, the last one first.
///
/// With the companion matrix `C`, `P = sum_j C'^j e e' C^j` from j = 1 on, `e` the first unit vector. The sum is doubled until it stays.
fn decayed(a: &[f64]) -> DMatrix<f64> {
    let p = a.len();
    let mut c = companion(&a.iter().map(|a| -a).collect::<Vec<_>>());
    let first = c.clone();
    let mut sum = DMatrix::zeros(p, p);
    if p == 0 {
        return sum;
    }
    sum[(0, 0)] = 1.0;
    // 2^40 samples: whoever decays more slowly has no end
    for _ in 0..40 {
        let more = c.tr_mul(&(&sum * &c));
        let ended = more.amax() <= f64::EPSILON * sum.amax();
        sum += more;
        if ended {
            break;
        }
        c = &c * &c;
    }
    first.tr_mul(&(sum * &first))
}

/// Coefficients of the best order, and the innovation's share of the variance.
fn autoregression(
    series: &[Vec<f64>],
    known: &[Vec<bool>],
    order: usize,
    price: f64,
) -> (Vec<f64>, f64) {
    let (sums, n) = products_of_lags(series, known, order);
    let (mut best, mut found) = (f64::INFINITY, (Vec::new(), 1.0));
    if n < 2 * (order + 1) || sums[(0, 0)] <= 0.0 {
        return found;
    }
    let n = n as f64;
    for p in 0..=order {
        let right = sums.view((1, 0), (p, 1)).column(0).into_owned();
        let Some(a) = solved(sums.view((1, 1), (p, p)).into_owned(), &right) else {
            break;
        };
        let left = ((sums[(0, 0)] - a.dot(&right)) / sums[(0, 0)]).max(LEAST);
        let criterion = n * left.ln() + price * p as f64;
        if criterion < best {
            best = criterion;
            let share = left * n / (n - p as f64).max(1.0);
            found = (a.as_slice().to_vec(), share.min(1.0));
        }
    }
    found
}

/// Sums of `e(k-i) e(k-j)` over windows of known samples, and the number of windows.
pub(crate) fn products_of_lags(
    series: &[Vec<f64>],
    known: &[Vec<bool>],
    order: usize,
) -> (DMatrix<f64>, usize) {
    let mut gram = Gram::new(order + 1, 0);
    let mut n = 0;
    for (e, known) in series.iter().zip(known) {
        let mut length = 0;
        for (k, is_known) in known.iter().enumerate() {
            length = if *is_known { length + 1 } else { 0 };
            if length > order {
                let window = e[k - order..=k].iter().rev();
                gram.add(|row| row.iter_mut().zip(window).for_each(|(v, e)| *v = *e));
                n += 1;
            }
        }
    }
    (gram.matrix(), n)
}

fn solved(mut matrix: DMatrix<f64>, right: &DVector<f64>) -> Option<DVector<f64>> {
    let n = matrix.nrows();
    if n == 0 {
        return Some(DVector::zeros(0));
    }
    let ridge = 1e-12 * matrix.trace() / n as f64;
    for i in 0..n {
        matrix[(i, i)] += ridge;
    }
    matrix.lu().solve(right)
}
