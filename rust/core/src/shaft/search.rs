//! The search for a machine: from which starts it is fitted, with how many shafts, and which of them are plausible.
//!
//! Starts of shafts are the poles and zeros of rational fits, which need no start themselves, and the places where the response is most
//! above that of the machine so far. Every start is followed a little, and the best ones to the end.

use std::f64::consts::TAU;

use nalgebra::{Complex, DMatrix, DVector};

use super::{Lines, RIGID, SHAFT, back, fit, response};
use crate::linear::poles;
use crate::{Monitor, Result};

/// Error that a resonance has to explain to be accepted, in mean squared errors of a frequency.
const CLEAR: f64 = 100.0;
/// Rational fits that give starts: of the machine's order, and one order higher.
const ORDERS: usize = 2;
/// Iterations of a rational fit, each weighted by the one before.
const ROUNDS: usize = 12;
/// Delays tried for a start \[samples\].
const DELAYS: [f64; 8] = [0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0];
/// Least lag of a start \[samples\].
const FAST: f64 = 0.3;
/// Evaluations for every start, how many of the best are followed, and their evaluations.
const BEGIN: usize = 12;
const FOLLOWED: usize = 4;
const TO_THE_END: usize = 200;
/// Squared errors over their mean, summed over as many lines as a shaft needs, above which a second shaft is searched; noise gives 16
/// with a standard deviation of 6.
const LIFTED: f64 = 50.0;
/// Damping ratio from which two poles do not count as a resonance.
const DAMPED: f64 = 0.5;
/// Limits of the ratio of load to motor inertia of a shaft.
const RATIOS: (f64, f64) = (0.03, 30.0);
/// Factor around antiresonance and resonance, and the least number of lines within it: two for each of the shaft's parameters, half of
/// them around either. Fewer can be explained by many spurious shafts.
const NEAR: f64 = 1.4;
const SHOWN: usize = 8;
/// Starts for a resonance beyond the measured range, relative to the highest frequency and as ratios of its frequencies; and the largest
/// one accepted, relative to the sample rate.
const BEYOND: [f64; 3] = [1.05, 1.3, 1.8];
const RATIOS_BEYOND: [f64; 2] = [0.6, 0.85];
const FARTHEST: f64 = 1.0;

/// A machine that was fitted.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// Sum of the squared residuals; infinite where nothing converged.
    pub cost: f64,
    /// Its parameters, the lowest resonance first.
    pub theta: Vec<f64>,
    /// Their covariance, row by row.
    pub covariance: Vec<f64>,
}

/// The machine that explains the lines best, and the frequency of a resonance beyond them \[Hz\], estimated from its flank.
///
/// `resonance`: whether there is a shaft; none: it is accepted if it explains clearly more. A second shaft has to satisfy the same.
///
/// # Errors
/// `ErrorKind::Setting` for no lines, other numbers of values or deviations, or a frequency or deviation that is not above 0;
/// `ErrorKind::Fit` on a stop.
pub fn search(
    lines: Lines<'_>,
    resonance: Option<bool>,
    monitor: &Monitor,
) -> Result<(Fitted, Option<f64>)> {
    lines.check()?;
    let search = Search { lines, monitor };
    let starts = search.rigid_starts();
    let rigid = starts.iter().map(|x| search.solved(x, TO_THE_END));
    let rigid = least(rigid.collect::<Result<_>>()?).expect("there are starts");
    if resonance == Some(false) {
        return Ok((rigid, None));
    }
    let mut best = &rigid;
    let one = search.best_shaft(search.first_starts(&rigid)?)?;
    let accepted = |found: &&Fitted| resonance == Some(true) || search.is_better(found, &rigid);
    if let Some(found) = one.as_ref().filter(accepted) {
        best = found;
    }
    let two = search.best_shaft(search.second_starts(&rigid, one.as_ref())?)?;
    if let Some(found) = two.as_ref().filter(|found| search.is_better(found, best)) {
        best = found;
    }
    let beyond = match best.theta.len() {
        RIGID => search.beyond(&rigid)?,
        _ => None,
    };
    Ok((best.clone(), beyond))
}

fn least(found: Vec<Fitted>) -> Option<Fitted> {
    found.into_iter().min_by(|a, b| a.cost.total_cmp(&b.cost))
}

/// Frequency \[rad/s\] and damping of a pair of poles or zeros.
type Swing = (f64, f64);

struct Search<'a> {
    lines: Lines<'a>,
    monitor: &'a Monitor,
}

impl Search<'_> {
    fn solved(&self, start: &[f64], evaluations: usize) -> Result<Fitted> {
        let found = fit(self.lines, start, evaluations, self.monitor)?;
        Ok(in_order(Fitted {
            cost: 2.0 * found.cost,
            theta: found.theta,
            covariance: found.covariance,
        }))
    }

    /// The response of a machine at the lines.
    fn at_lines(&self, theta: &[f64]) -> Result<Vec<Complex<f64>>> {
        let Lines {
            hertz, ts, counted, ..
        } = self.lines;
        response(theta, hertz, ts, counted)
    }

    /// Sum of squares per degree of freedom; infinite where none is left, as such a fit says nothing about errors.
    fn usual(&self, fitted: &Fitted) -> f64 {
        match (2 * self.lines.hertz.len()).saturating_sub(fitted.theta.len()) {
            0 => f64::INFINITY,
            free => fitted.cost / free as f64,
        }
    }

    /// Whether the shaft explains clearly more, relative to its own remaining error.
    fn is_better(&self, shaft: &Fitted, rigid: &Fitted) -> bool {
        rigid.cost - shaft.cost > CLEAR * self.usual(shaft)
    }

    /// Starts with a corner where the gain has fallen to .7, and lags beyond it.
    fn rigid_starts(&self) -> Vec<Vec<f64>> {
        let size: Vec<f64> = self.lines.value.iter().map(|v| v.norm()).collect();
        let count = (size.len() / 50).max(3).min(size.len());
        let k = size[..count].iter().copied().fold(0.0, f64::max);
        let below = size
            .iter()
            .position(|&v| v < k * std::f64::consts::FRAC_1_SQRT_2);
        let t = 1.0 / (TAU * self.lines.hertz[below.unwrap_or(size.len() - 1)]);
        let start =
            |(fast, delay): (f64, f64)| vec![k.ln(), (t + fast).ln(), (t * fast).ln(), delay];
        let fast = [0.03 * t, 0.3 * t].into_iter();
        fast.flat_map(|fast| [0.1, 1.5].map(|delay| (fast, delay)))
            .map(start)
            .collect()
    }

    /// Starts from rational fits, and where the response is most above the rigid machine's.
    fn first_starts(&self, rigid: &Fitted) -> Result<Vec<Vec<f64>>> {
        let ratio = self.ratio(&self.at_lines(&rigid.theta)?);
        let mut starts = self.rational_starts(rigid, 1);
        for place in peaks(&ratio).into_iter().take(4) {
            starts.extend(self.starts_at(rigid, &ratio, self.lines.hertz[place]));
        }
        Ok(starts)
    }

    /// Starts from rational fits, and where the response is above that of one shaft, the latter over as many lines as a shaft needs.
    fn second_starts(&self, rigid: &Fitted, shaft: Option<&Fitted>) -> Result<Vec<Vec<f64>>> {
        let mut starts = self.rational_starts(rigid, 2);
        let Some(shaft) = shaft else {
            return Ok(starts);
        };
        let model = self.at_lines(&shaft.theta)?;
        let usual = self.usual(shaft).max(1e-300);
        let Lines { value, sigma, .. } = self.lines;
        let off: Vec<f64> = (0..value.len())
            .map(|k| ((value[k] - model[k]) / sigma[k]).norm_sqr() / usual)
            .collect();
        let unexplained = |k: usize| {
            let end = (k + SHOWN / 2).min(off.len());
            off[k.saturating_sub(SHOWN / 2)..end].iter().sum::<f64>() > LIFTED
        };
        let ratio = self.ratio(&model);
        for place in peaks(&ratio)
            .into_iter()
            .filter(|&k| unexplained(k))
            .take(4)
        {
            starts.extend(self.starts_at(shaft, &ratio, self.lines.hertz[place]));
        }
        Ok(starts)
    }

    fn ratio(&self, model: &[Complex<f64>]) -> Vec<f64> {
        let pairs = self.lines.value.iter().zip(model);
        pairs.map(|(v, m)| v.norm() / m.norm()).collect()
    }

    /// Starts from the poles and zeros of rational fits. Every choice of oscillating poles and zeros in the measured range is one, if
    /// each antiresonance is below its resonance.
    fn rational_starts(&self, rigid: &Fitted, shafts: usize) -> Vec<Vec<f64>> {
        let mut starts = Vec::new();
        for order in (2 + 2 * shafts..).take(ORDERS) {
            let (num, den) = self.rational(order);
            let (zeros, poles) = (self.swinging(&num), self.swinging(&den));
            for resonances in choices(&poles, shafts) {
                for antiresonances in choices(&zeros, shafts) {
                    let pairs = || resonances.iter().zip(&antiresonances);
                    if pairs().all(|(r, a)| is_ratio(r.0, a.0)) {
                        let logs = |(r, a): (&Swing, &Swing)| [r.0, r.1, a.0, a.1].map(f64::ln);
                        let shafts: Vec<f64> = pairs().flat_map(logs).collect();
                        starts.extend(self.with_lags(&rigid.theta, &shafts));
                    }
                }
            }
        }
        starts
    }

    /// The machine with a shaft at a place, its antiresonance at the valley before it or close by.
    fn starts_at(&self, fitted: &Fitted, ratio: &[f64], place: f64) -> Vec<Vec<f64>> {
        let hertz = self.lines.hertz;
        let left = (0..hertz.len()).filter(|&k| hertz[k] > 0.3 * place && hertz[k] < 0.98 * place);
        let valley = left.min_by(|&a, &b| ratio[a].total_cmp(&ratio[b]));
        let valley = valley.map_or(0.75 * place, |k| hertz[k]);
        let start = |antiresonance: f64| {
            let shaft = [TAU * place, 0.03, TAU * antiresonance, 0.03].map(f64::ln);
            self.with_lags(&fitted.theta, &[&fitted.theta[RIGID..], &shaft].concat())
        };
        [valley, 0.75 * place].into_iter().flat_map(start).collect()
    }

    /// These shafts with the lags of a fit, and with the gain, lags and delay that fit best.
    ///
    /// Divided by the shafts, the response is `K / (1 + a1 s + a2 s^2)`, whose inverse is linear in its coefficients; a few values of
    /// the delay are tried. Holding the command delays by half a sample, a mean over a sample by another half.
    fn with_lags(&self, fitted: &[f64], shafts: &[f64]) -> Vec<Vec<f64>> {
        let Lines {
            hertz,
            value,
            sigma,
            ts,
            counted,
        } = self.lines;
        let laplace = |k: usize| Complex::new(0.0, TAU * hertz[k]);
        let shape = |s: Complex<f64>| {
            let one = |x: &[f64]| {
                let [wr, zr, wa, za] = [0, 1, 2, 3].map(|i| x[i].exp());
                let (up, down) = (
                    s * s + s * (2.0 * za * wa) + wa * wa,
                    s * s + s * (2.0 * zr * wr) + wr * wr,
                );
                up / down * (wr / wa).powi(2)
            };
            shafts
                .chunks_exact(SHAFT)
                .map(one)
                .product::<Complex<f64>>()
        };
        let shapes: Vec<_> = (0..hertz.len()).map(|k| shape(laplace(k))).collect();
        let mut best: (f64, Option<Vec<f64>>) = (f64::INFINITY, None);
        for delay in DELAYS {
            let late = (delay + if counted { 1.0 } else { 0.5 }) * ts;
            let inverse = |k: usize| shapes[k] * (-laplace(k) * late).exp() / value[k];
            let weight = |k: usize| value[k].norm() / (sigma[k] * inverse(k).norm());
            let row = |k: usize, j: usize| laplace(k).powi(j as i32) * weight(k);
            let Some((x, left)) = solved(hertz.len(), 3, row, |k| inverse(k) * weight(k)) else {
                continue;
            };
            // with lags below 0, a delay stands for a lag that it is not
            if left < best.0 && x.iter().all(|c| *c > 0.0) {
                let least = FAST * ts;
                let (a1, a2) = ((x[1] / x[0]).max(least), (x[2] / x[0]).max(least * least));
                let lags = [-x[0].ln(), a1.ln(), a2.ln(), delay];
                best = (left, Some([&lags[..], shafts].concat()));
            }
        }
        let kept = [&fitted[..RIGID], shafts].concat();
        std::iter::once(kept).chain(best.1).collect()
    }

    /// Numerator and denominator of a rational fit, in powers of a delay of one sample.
    ///
    /// The equation error is linear in the coefficients. Weighted by the denominator of the fit before, it approaches the output error
    /// (C. K. Sanathanan, J. Koerner, *IEEE Trans. Automatic Control* 8, 1963); the best iterate is returned.
    fn rational(&self, order: usize) -> (Vec<f64>, Vec<f64>) {
        let Lines {
            hertz,
            value,
            sigma,
            ts,
            ..
        } = self.lines;
        let n = hertz.len();
        let q: Vec<_> = hertz.iter().map(|&f| back(f, ts)).collect();
        let at = |c: &[f64], q: Complex<f64>| {
            let zero = Complex::new(0.0, 0.0);
            c.iter().rev().fold(zero, |sum, &c| sum * q + c)
        };
        let column = |k: usize, j: usize| match j < order + 2 {
            true => q[k].powi(j as i32 + 1),
            false => -value[k] * q[k].powi((j - order - 1) as i32),
        };
        let mut weight: Vec<f64> = sigma.iter().map(|s| 1.0 / s).collect();
        let mut best = (f64::INFINITY, vec![0.0], vec![1.0]);
        for _ in 0..ROUNDS {
            let row = |k: usize, j: usize| column(k, j) * weight[k];
            let Some((x, _)) = least_norm(n, 2 * order + 2, row, |k| value[k] * weight[k]) else {
                break;
            };
            let (up, down) = x.split_at(order + 2);
            let num: Vec<f64> = std::iter::once(0.0).chain(up.iter().copied()).collect();
            let den: Vec<f64> = std::iter::once(1.0).chain(down.iter().copied()).collect();
            let mut cost = 0.0;
            for k in 0..n {
                let below = at(&den, q[k]);
                weight[k] = 1.0 / (sigma[k] * below.norm().max(1e-12));
                cost += ((at(&num, q[k]) / below - value[k]) / sigma[k]).norm_sqr();
            }
            if cost < best.0 {
                best = (cost, num, den);
            }
        }
        (best.1, best.2)
    }

    /// Frequency and damping of the roots that a shaft could have, in ascending order.
    fn swinging(&self, coefficients: &[f64]) -> Vec<Swing> {
        let Lines { hertz, ts, .. } = self.lines;
        let Some(first) = coefficients.iter().position(|c| *c != 0.0) else {
            return Vec::new();
        };
        let monic: Vec<f64> = coefficients[first + 1..]
            .iter()
            .map(|c| c / coefficients[first])
            .collect();
        let inside = TAU * hertz[0]..TAU * hertz[hertz.len() - 1];
        let mut found: Vec<Swing> = poles(&monic)
            .into_iter()
            .filter(|root| root.im > 0.0 && root.norm() > 1e-3)
            .map(|root| root.ln() / ts)
            .map(|s| (s.norm(), (s.re.abs() / s.norm()).max(1e-3)))
            .filter(|(w, z)| inside.contains(w) && *z < DAMPED)
            .collect();
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found
    }

    /// The best fit from these starts with plausible shafts.
    fn best_shaft(&self, starts: Vec<Vec<f64>>) -> Result<Option<Fitted>> {
        let begun = starts.iter().map(|x| self.solved(x, BEGIN));
        let mut begun = begun.collect::<Result<Vec<_>>>()?;
        begun.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        let ended = begun.iter().take(FOLLOWED);
        let mut found = ended
            .map(|start| self.solved(&start.theta, TO_THE_END))
            .collect::<Result<Vec<_>>>()?;
        found.retain(|fitted| self.is_plausible(&fitted.theta));
        Ok(least(found))
    }

    /// Whether each pair of zeros and poles is a plausible shaft within the measured range.
    ///
    /// Command and speed belong to the same mass, so antiresonances and resonances alternate. Poles next to the zeros of another shaft
    /// only describe a line or two that fit badly.
    fn is_plausible(&self, theta: &[f64]) -> bool {
        let shafts: Vec<[f64; SHAFT]> = theta[RIGID..]
            .chunks_exact(SHAFT)
            .map(|x| [0, 1, 2, 3].map(|i| x[i].exp()))
            .collect();
        let mut neighbours = shafts.windows(2);
        neighbours.all(|pair| (pair[1][2] / pair[0][0]).powi(2) - 1.0 > RATIOS.0)
            && shafts.iter().all(|shaft| self.is_shaft(*shaft))
    }

    fn is_shaft(&self, [wr, zr, wa, za]: [f64; SHAFT]) -> bool {
        let hertz = self.lines.hertz;
        let (resonance, antiresonance) = (wr / TAU, wa / TAU);
        let within = |low: f64, high: f64| hertz.iter().filter(|&&f| f > low && f < high).count();
        let about = |f: f64| within(f / NEAR, f * NEAR) >= SHOWN / 2;
        hertz[0] < antiresonance
            && resonance < hertz[hertz.len() - 1]
            && within(antiresonance / NEAR, resonance * NEAR) >= SHOWN
            && about(antiresonance)
            && about(resonance)
            && is_ratio(wr, wa)
            && zr.max(za) < DAMPED
    }

    /// Frequency of a resonance above the measured range \[Hz\]. Its flank has to explain as much as a resonance within the range.
    fn beyond(&self, rigid: &Fitted) -> Result<Option<f64>> {
        let last = self.lines.hertz[self.lines.hertz.len() - 1];
        let mut best: Option<(f64, f64)> = None;
        for factor in BEYOND {
            for ratio in RATIOS_BEYOND {
                let w = TAU * factor * last;
                let shaft = [w, 0.02, ratio * w, 0.02].map(f64::ln);
                let found = self.solved(&[&rigid.theta[..], &shaft].concat(), TO_THE_END)?;
                let [wr, zr, wa, za] = [0, 1, 2, 3].map(|i| found.theta[RIGID + i].exp());
                let above = last < wr / TAU && wr / TAU < FARTHEST / self.lines.ts;
                let plausible = above && is_ratio(wr, wa) && zr.max(za) < DAMPED;
                let first = best.is_none_or(|(cost, _)| found.cost < cost);
                if plausible && self.is_better(&found, rigid) && first {
                    best = Some((found.cost, wr / TAU));
                }
            }
        }
        Ok(best.map(|(_, hertz)| hertz))
    }
}

fn is_ratio(resonance: f64, antiresonance: f64) -> bool {
    let inertias = (resonance / antiresonance).powi(2) - 1.0;
    inertias > RATIOS.0 && inertias < RATIOS.1
}

/// The lowest resonance first, each antiresonance with the resonance above it: the response does not depend on which pair of zeros
/// belongs to which pair of poles.
fn in_order(found: Fitted) -> Fitted {
    let n = found.theta.len();
    let mut from: Vec<usize> = (0..n).collect();
    // resonances, then antiresonances
    for first in [RIGID, RIGID + 2] {
        let mut order: Vec<usize> = (first..n).step_by(SHAFT).collect();
        order.sort_by(|&a, &b| found.theta[a].total_cmp(&found.theta[b]));
        for (to, &at) in (first..n).step_by(SHAFT).zip(&order) {
            (from[to], from[to + 1]) = (at, at + 1);
        }
    }
    let row = |&i: &usize| from.iter().map(move |&j| (i, j));
    Fitted {
        theta: from.iter().map(|&i| found.theta[i]).collect(),
        covariance: from
            .iter()
            .flat_map(row)
            .map(|(i, j)| found.covariance[i * n + j])
            .collect(),
        ..found
    }
}

/// Indices of the local maxima, the largest first.
fn peaks(ratio: &[f64]) -> Vec<usize> {
    let is_peak = |&k: &usize| ratio[k] >= ratio[k - 1] && ratio[k] >= ratio[k + 1];
    let mut found: Vec<usize> = (1..ratio.len().saturating_sub(1)).filter(is_peak).collect();
    found.sort_by(|&a, &b| ratio[b].total_cmp(&ratio[a]));
    found
}

/// Every choice of `count` of these, in their order.
fn choices(of: &[Swing], count: usize) -> Vec<Vec<Swing>> {
    if count == 0 {
        return vec![Vec::new()];
    }
    let with = |(k, &first): (usize, &Swing)| {
        let rest = choices(&of[k + 1..], count - 1).into_iter();
        rest.map(move |more| [vec![first], more].concat())
    };
    of.iter().enumerate().flat_map(with).collect()
}

/// The real solution of complex equations by least squares, and its sum of squares; none if it is not unique.
fn solved(
    rows: usize,
    columns: usize,
    row: impl Fn(usize, usize) -> Complex<f64>,
    goal: impl Fn(usize) -> Complex<f64>,
) -> Option<(Vec<f64>, f64)> {
    least_norm(rows, columns, row, goal).and_then(|(x, left)| Some((x, left?)))
}

/// The same of the least norm, and its sum of squares if it is unique; none where something is not finite.
fn least_norm(
    rows: usize,
    columns: usize,
    row: impl Fn(usize, usize) -> Complex<f64>,
    goal: impl Fn(usize) -> Complex<f64>,
) -> Option<(Vec<f64>, Option<f64>)> {
    let mut matrix = DMatrix::zeros(2 * rows, columns);
    let mut right = DVector::zeros(2 * rows);
    for k in 0..rows {
        for j in 0..columns {
            let value = row(k, j);
            (matrix[(k, j)], matrix[(rows + k, j)]) = (value.re, value.im);
        }
        let value = goal(k);
        (right[k], right[rows + k]) = (value.re, value.im);
    }
    if 2 * rows < columns || !matrix.iter().chain(right.iter()).all(|v| v.is_finite()) {
        return None;
    }
    let qr = matrix.qr();
    qr.q_tr_mul(&mut right);
    let top = right.rows(0, columns).into_owned();
    let svd = qr.r().try_svd(true, true, f64::EPSILON, 10_000)?;
    let least = f64::EPSILON * (2 * rows).max(columns) as f64 * svd.singular_values.max();
    let rank = svd.rank(least);
    let x = svd.solve(&top, least).ok()?;
    let left = (rank == columns).then(|| right.rows_range(columns..).norm_squared());
    Some((x.iter().copied().collect(), left))
}
