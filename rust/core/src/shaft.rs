//! A rigid machine, or masses on shafts, under a held command: its response as the encoder counts it, and the fit of
//! its parameters to a measured response.
//!
//! With `n` shafts between the masses, the motor's speed under a command is
//!
//! ```text
//! G(s) = K e^(-s tau) / (1 + a1 s + a2 s^2)  x  product of (w_r/w_a)^2 (s^2 + 2 z_a w_a s + w_a^2) / (s^2 + 2 z_r w_r s + w_r^2)
//! ```
//!
//! `theta` has the logarithms of `K`, `a1`, `a2`, the delay in samples, then for each shaft the logarithms of `w_r`, `z_r`, `w_a`, `z_a`
//! (frequencies in rad/s). The measured quantity is not `G` but its response to a command held over each sample: the speed at the samples
//! or, counted, its mean between them. Partial fractions give it exactly: each pole `p` with residue `r` adds
//!
//! ```text
//! r (b_0 + b_1 q) q^(whole + 1) / (1 - e^(p Ts) q),    b_0 = (e^(p (1 - part) Ts) - 1)/p,    b_1 = (e^(p Ts) - e^(p (1 - part) Ts))/p
//! ```
//!
//! with `q = 1/z` and a delay of `whole + part` samples. Derivatives are exact: poles and residues carry theirs ([`Dual`]).

mod dual;
mod search;

use nalgebra::Complex;

use crate::least_squares::{Residuals, Settings, Solution, solve};
use crate::linear::{monic, polynomial};
use crate::{Error, Monitor, Result};
use dual::Dual;

pub use search::{Fitted, search};

/// Number of parameters of a rigid machine, and of each shaft.
const RIGID: usize = 4;
const SHAFT: usize = 4;
/// Most parameters: two shafts.
const MOST: usize = RIGID + 2 * SHAFT;
/// Longest delay \[samples\], and largest logarithm.
const LATEST: f64 = 50.0;
const LARGEST: f64 = 40.0;
/// Least lag \[samples\] and longest lag \[periods of the lowest frequency\]. A lag far below a sample, or far above
/// all measured periods, changes no residual, so a search that gets there would stay there.
const FASTEST: f64 = 1e-2;
const SLOWEST: f64 = 1e4;

/// The contribution of a pole to the response, see [`Machine::response`].
struct Mode {
    /// Residue times the weights of the present command and of the previous one.
    now: Dual,
    before: Dual,
    /// `e^(p Ts)`.
    decay: Dual,
}

/// A machine at a sample time.
struct Machine {
    ts: f64,
    counted: bool,
    /// The delay's whole samples.
    whole: usize,
    modes: Vec<Mode>,
}

impl Machine {
    fn new(theta: &[f64], ts: f64, counted: bool) -> Self {
        let exp = |j: usize| Dual::variable(theta[j], j).exp();
        let delay = theta[3].max(0.0);
        let whole = delay.floor();
        let part = Dual::variable(delay, 3) - Dual::real(whole);
        let (a1, a2) = (exp(1), exp(2));
        let mut numerator = vec![exp(0)];
        let mut poles = pair(a1 / a2 * 0.5, Dual::real(1.0) / a2).to_vec();
        for j in (RIGID..theta.len()).step_by(SHAFT) {
            let [wr, zr, wa, za] = [0, 1, 2, 3].map(|k| exp(j + k));
            let ratio = wr / wa;
            let by = [Dual::real(1.0), za * wa * 2.0, wa * wa].map(|c| c * ratio * ratio);
            numerator = product(&numerator, &by);
            poles.extend(pair(zr * wr, wr * wr));
        }
        if counted {
            poles.push(Dual::real(0.0));
        }
        let mode = |(k, &pole): (usize, &Dual)| {
            let others = poles.iter().enumerate().filter(|&(i, _)| i != k);
            let apart = others.fold(a2, |all, (_, &other)| all * (pole - other));
            let value = numerator
                .iter()
                .fold(Dual::real(0.0), |sum, &c| sum * pole + c);
            let residue = value / apart;
            let still = counted && k + 1 == poles.len();
            let (left, all) = ((Dual::real(1.0) - part) * ts, Dual::real(ts));
            let (inner, decay) = ((pole * left).exp(), (pole * all).exp());
            // an integrator is the limit
            let (now, before) = match still {
                true => (left, all - left),
                false => ((inner - Dual::real(1.0)) / pole, (decay - inner) / pole),
            };
            Mode {
                now: residue * now,
                before: residue * before,
                decay,
            }
        };
        Self {
            ts,
            counted,
            whole: whole as usize,
            modes: poles.iter().enumerate().map(mode).collect(),
        }
    }

    /// The response at `q = exp(-j w Ts)`; calls `derivative` with each pole and the response's derivatives by its
    /// numbers `now`, `before`, `decay`.
    fn response(
        &self,
        q: Complex<f64>,
        mut derivative: impl FnMut(&Mode, [Complex<f64>; 3]),
    ) -> Complex<f64> {
        let one = Complex::new(1.0, 0.0);
        let mut common = q.powi(self.whole as i32 + 1);
        if self.counted {
            common *= (one - q) / self.ts;
        }
        let of = |mode: &Mode| {
            let per_now = common / (one - mode.decay.value * q);
            let per_before = per_now * q;
            let made = mode.now.value * per_now + mode.before.value * per_before;
            let per_decay = made * q / (one - mode.decay.value * q);
            derivative(mode, [per_now, per_before, per_decay]);
            made
        };
        self.modes.iter().map(of).sum()
    }
}

/// The roots of `s^2 + 2 half s + square`.
fn pair(half: Dual, square: Dual) -> [Dual; 2] {
    let root = (half * half - square).sqrt();
    // the smaller of two real roots comes from their product: the difference would lose digits
    let large = Dual::real(0.0)
        - (half
            + if root.value.re < 0.0 {
                Dual::real(0.0) - root
            } else {
                root
            });
    [large, square / large]
}

fn product(a: &[Dual], b: &[Dual]) -> Vec<Dual> {
    let mut found = vec![Dual::real(0.0); a.len() + b.len() - 1];
    for (i, &x) in a.iter().enumerate() {
        for (j, &y) in b.iter().enumerate() {
            found[i + j] = found[i + j] + x * y;
        }
    }
    found
}

fn check(theta: &[f64], ts: f64) -> Result<()> {
    let shaped =
        theta.len() >= RIGID && theta.len() <= MOST && (theta.len() - RIGID).is_multiple_of(SHAFT);
    let soon = |delay: f64| delay <= f64::from(u16::MAX);
    if !(shaped && ts > 0.0 && ts.is_finite() && soon(theta[3])) {
        return Err(Error::setting(format!(
            "expected 4, 8 or 12 parameters of a machine and a sample time above 0 s, got {} and {ts} s",
            theta.len()
        )));
    }
    Ok(())
}

/// The response of the measured quantity at `hertz`: the speed at the samples or, `counted`, its mean between them.
///
/// # Errors
/// `ErrorKind::Setting` for another number of parameters or no sample time.
pub fn response(theta: &[f64], hertz: &[f64], ts: f64, counted: bool) -> Result<Vec<Complex<f64>>> {
    check(theta, ts)?;
    let machine = Machine::new(theta, ts, counted);
    let at = |f: &f64| machine.response(back(*f, ts), |_, _| ());
    Ok(hertz.iter().map(at).collect())
}

/// `exp(-j w Ts)`.
fn back(hertz: f64, ts: f64) -> Complex<f64> {
    Complex::from_polar(1.0, -std::f64::consts::TAU * hertz * ts)
}

/// `G` under a held command, with the speed at the samples, as numerator and denominator in powers of `z^-1`.
///
/// # Errors
/// As [`response`].
pub fn fraction(theta: &[f64], ts: f64) -> Result<(Vec<f64>, Vec<f64>)> {
    check(theta, ts)?;
    let machine = Machine::new(theta, ts, false);
    let decays: Vec<_> = machine.modes.iter().map(|m| m.decay.value).collect();
    let mut num = vec![Complex::new(0.0, 0.0); decays.len() + 2];
    for (k, mode) in machine.modes.iter().enumerate() {
        let others = [&decays[..k], &decays[k + 1..]].concat();
        for (i, c) in monic(&others).into_iter().enumerate() {
            num[i + 1] += c * mode.now.value;
            num[i + 2] += c * mode.before.value;
        }
    }
    let delayed = vec![0.0; machine.whole].into_iter();
    let num = delayed.chain(num.iter().map(|c| c.re)).collect();
    Ok((
        num,
        std::iter::once(1.0).chain(polynomial(&decays)).collect(),
    ))
}

/// Lines of a measured response, with their uncertainty.
#[derive(Clone, Copy, Debug)]
pub struct Lines<'a> {
    /// Frequencies \[Hz\].
    pub hertz: &'a [f64],
    /// The response there.
    pub value: &'a [Complex<f64>],
    /// Standard deviations of the real part, and equally of the imaginary part.
    pub sigma: &'a [f64],
    /// Sample time \[s\].
    pub ts: f64,
    /// Whether the output is a mean over a sample.
    pub counted: bool,
}

impl Lines<'_> {
    fn check(&self) -> Result<()> {
        let count = self.hertz.len();
        let positive = |v: &[f64]| v.iter().all(|x| *x > 0.0 && x.is_finite());
        let whole = count > 0 && self.value.len() == count && self.sigma.len() == count;
        if !whole || !positive(self.hertz) || !positive(self.sigma) {
            return Err(Error::setting(format!(
                "expected a response and a standard deviation above 0 at each of {count} frequencies above 0 Hz, got {} and {}",
                self.value.len(),
                self.sigma.len()
            )));
        }
        Ok(())
    }
}

struct Fit<'a> {
    lines: Lines<'a>,
    back: Vec<Complex<f64>>,
    parameters: usize,
}

impl Residuals for Fit<'_> {
    fn parameters(&self) -> usize {
        self.parameters
    }

    fn len(&self) -> usize {
        2 * self.back.len()
    }

    fn residuals(&mut self, theta: &[f64], r: &mut [f64]) -> bool {
        let Lines {
            ts,
            counted,
            value,
            sigma,
            ..
        } = self.lines;
        let machine = Machine::new(theta, ts, counted);
        for (k, (r, &q)) in r.chunks_exact_mut(2).zip(&self.back).enumerate() {
            let off = (machine.response(q, |_, _| ()) - value[k]) / sigma[k];
            (r[0], r[1]) = (off.re, off.im);
        }
        r.iter().all(|v| v.is_finite())
    }

    fn jacobian(&mut self, theta: &[f64], _: &[f64], j: &mut [f64]) -> bool {
        let machine = Machine::new(theta, self.lines.ts, self.lines.counted);
        let n = self.parameters;
        for (k, (rows, &q)) in j.chunks_exact_mut(2 * n).zip(&self.back).enumerate() {
            let mut slopes = [Complex::new(0.0, 0.0); MOST];
            machine.response(q, |mode, [per_now, per_before, per_decay]| {
                for (i, slope) in slopes[..n].iter_mut().enumerate() {
                    *slope += per_now * mode.now.slopes[i]
                        + per_before * mode.before.slopes[i]
                        + per_decay * mode.decay.slopes[i];
                }
            });
            let (real, imaginary) = rows.split_at_mut(n);
            for (i, slope) in slopes[..n].iter().enumerate() {
                let slope = slope / self.lines.sigma[k];
                (real[i], imaginary[i]) = (slope.re, slope.im);
            }
        }
        j.iter().all(|v| v.is_finite())
    }
}

/// The parameters that fit the lines best, from a start and with at most `evaluations`.
///
/// # Errors
/// `ErrorKind::Setting` for another number of parameters or a start that is not finite; `ErrorKind::Fit` on a stop.
fn fit(lines: Lines<'_>, start: &[f64], evaluations: usize, monitor: &Monitor) -> Result<Solution> {
    check(start, lines.ts)?;
    let n = start.len();
    let (mut lower, mut upper) = (vec![-LARGEST; n], vec![LARGEST; n]);
    (lower[3], upper[3]) = (0.0, LATEST);
    let lowest = lines.hertz.iter().copied().fold(f64::INFINITY, f64::min);
    let (fastest, slowest) = (FASTEST * lines.ts, (SLOWEST / lowest).max(lines.ts));
    for power in [1, 2] {
        lower[power] = power as f64 * fastest.ln();
        upper[power] = power as f64 * slowest.ln();
    }
    let begin = (0..n).map(|j| start[j].clamp(lower[j], upper[j])).collect();
    let mut problem = Fit {
        back: lines.hertz.iter().map(|&f| back(f, lines.ts)).collect(),
        parameters: n,
        lines,
    };
    let settings = Settings {
        max_evaluations: evaluations,
        lower: Some(lower),
        upper: Some(upper),
        ..Settings::default()
    };
    let found = solve(&mut problem, begin, &settings, monitor)?;
    if monitor.stopped() {
        return Err(Error::fit("expected time to search, got a stop"));
    }
    Ok(found)
}

#[cfg(test)]
mod tests;
