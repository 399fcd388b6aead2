//! A linear plant at a sample time: a fraction of polynomials in `z^-1`, delays as leading zeros.

use nalgebra::Complex;

use super::Place;
use crate::linear::poles;
use crate::{Error, Result};

/// How near to 1 a pole is an integrator.
const INTEGRATOR: f64 = 1e-9;

/// `G(z) = (num_0 + num_1 z^-1 + ..)/(1 + den_1 z^-1 + ..)` with what the argument principle needs of its poles.
#[derive(Clone, Debug)]
pub struct Plant {
    pub(super) num: Vec<f64>,
    pub(super) den: Vec<f64>,
    pub(super) poles: Vec<Complex<f64>>,
    pub(super) integrators: usize,
    pub(super) unstable: usize,
}

impl Plant {
    /// A plant from its coefficients of `z^0, z^-1, ..`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for coefficients that are missing or not finite, or a denominator that begins with 0.
    pub fn new(num: &[f64], den: &[f64]) -> Result<Self> {
        let finite = |c: &[f64]| !c.is_empty() && c.iter().all(|x| x.is_finite());
        let first = den.first().copied().unwrap_or(0.0);
        if !(finite(num) && finite(den) && first != 0.0) {
            return Err(Error::setting(format!(
                "expected finite coefficients of z^0, z^-1, .. with a denominator that does not begin with 0, got {num:?} \
                 over {den:?}"
            )));
        }
        if num.iter().all(|&b| b == 0.0) {
            return Err(Error::setting(
                "expected a plant that answers to its input, got a numerator of zeros",
            ));
        }
        let scaled = |c: &[f64]| c.iter().map(|x| x / first).collect::<Vec<_>>();
        let (num, den) = (scaled(num), scaled(den));
        let poles = if den.len() > 1 {
            poles(&den[1..])
        } else {
            Vec::new()
        };
        if poles.iter().any(|p| !p.norm().is_finite()) {
            return Err(Error::setting(
                "expected a plant whose poles can be found, got coefficients that span too much",
            ));
        }
        let integrators = poles
            .iter()
            .filter(|p| (*p - 1.0).norm() < INTEGRATOR)
            .count();
        let outside = |p: &&Complex<f64>| p.norm() > 1.0 && (*p - 1.0).norm() >= INTEGRATOR;
        let unstable = poles.iter().filter(outside).count();
        Ok(Self {
            num,
            den,
            poles,
            integrators,
            unstable,
        })
    }

    /// `K e^(-sL)/(1 + sT)` under a zero-order hold, exactly, also where `L` is not a whole number of samples:
    ///
    /// ```text
    /// L = d Ts + tau:  y(k+1) = a y(k) + K (1 - e^(-(Ts-tau)/T)) u(k-d) + K (e^(-(Ts-tau)/T) - a) u(k-d-1),  a = e^(-Ts/T)
    /// ```
    ///
    /// (K. J. Astrom, B. Wittenmark, *Computer-Controlled Systems*, 3rd ed., 1997, section 2.3.)
    ///
    /// # Errors
    /// `ErrorKind::Setting` for numbers that are no such plant, or a dead time of more than 10,000 samples.
    pub fn fopdt(k: f64, t: f64, l: f64, ts: f64) -> Result<Self> {
        let known =
            k.is_finite() && t > 0.0 && t.is_finite() && l >= 0.0 && ts > 0.0 && l / ts <= 1e4;
        if !known {
            return Err(Error::setting(format!(
                "expected a finite K, T above 0 s and L of 0 to 10,000 samples, got K = {k}, T = {t}, L = {l} at {ts} s"
            )));
        }
        let d = (l / ts).floor();
        let rest = ts - (l - d * ts);
        // 1 - e^(-x) keeps its digits for slow plants
        let (early, whole) = (-(-rest / t).exp_m1(), -(-ts / t).exp_m1());
        let mut num = vec![0.0; d as usize + 1];
        num.extend([k * early, k * (whole - early)]);
        Self::new(&num, &[1.0, whole - 1.0])
    }

    /// Coefficients of the numerator, of `z^0, z^-1, ..`.
    pub fn num(&self) -> &[f64] {
        &self.num
    }

    /// Coefficients of the denominator; the first is 1.
    pub fn den(&self) -> &[f64] {
        &self.den
    }

    pub(super) fn response(&self, at: &Place) -> Complex<f64> {
        horner(&self.num, at.back) / horner(&self.den, at.back)
    }

    /// Samples of the longest memory: the order of a state space in observer form.
    pub(super) fn order(&self) -> usize {
        self.num.len().max(self.den.len()) - 1
    }
}

fn horner(coefficients: &[f64], x: Complex<f64>) -> Complex<f64> {
    coefficients
        .iter()
        .rev()
        .fold(Complex::new(0.0, 0.0), |sum, &c| sum * x + c)
}
