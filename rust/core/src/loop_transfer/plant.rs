//! The plant of a linear loop: a fraction of polynomials in `z^-1` with delays as leading zeros, or a frequency
//! response measured at some frequencies, with the sensitivity of a loop around it.

use nalgebra::Complex;

use super::{Path, Place};
use crate::linear::poles;
use crate::{Error, Result};

/// A pole this near to 1 is an integrator.
const INTEGRATOR: f64 = 1e-9;

/// `G(z) = (num_0 + num_1 z^-1 + ..)/(1 + den_1 z^-1 + ..)`, and the facts about its poles that the argument principle needs.
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

    /// `K e^(-sL)/(1 + sT)` under a zero-order hold, exact even if `L` is not a whole number of samples:
    ///
    /// ```text
    /// L = d Ts + tau:  y(k+1) = a y(k) + K (1 - e^(-(Ts-tau)/T)) u(k-d) + K (e^(-(Ts-tau)/T) - a) u(k-d-1),  a = e^(-Ts/T)
    /// ```
    ///
    /// (K. J. Astrom, B. Wittenmark, *Computer-Controlled Systems*, 3rd ed., 1997, section 2.3.)
    ///
    /// # Errors
    /// `ErrorKind::Setting` for invalid numbers, or a dead time of more than 10,000 samples.
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
        // expm1 keeps the digits of 1 - e^(-x) for slow plants
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

/// A frequency response, with the radius of the circle in which it lies at each frequency.
#[derive(Clone, Debug)]
pub struct Measured {
    lines: Vec<(Place, Complex<f64>, f64)>,
    /// Whether the output was counted: the response then includes the encoder's mean over a sample.
    counted: bool,
}

impl Measured {
    /// From frequencies \[rad/s\], responses and radii at sample time `ts`; `counted`: the response includes the encoder.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for no line, different lengths, a frequency beyond half the sample rate, or values that are not finite.
    pub fn new(
        omega: &[f64],
        response: &[Complex<f64>],
        radius: &[f64],
        counted: bool,
        ts: f64,
    ) -> Result<Self> {
        let n = omega.len();
        if n == 0 || response.len() != n || radius.len() != n {
            return Err(Error::setting(format!(
                "expected a frequency response with a value and a radius at each frequency, got {n} frequencies, {} \
                 values and {} radii",
                response.len(),
                radius.len()
            )));
        }
        let lines = omega.iter().zip(response).zip(radius);
        let line = |((&w, &value), &radius): ((&f64, &Complex<f64>), &f64)| {
            let theta = w * ts;
            let inside = theta > 0.0 && theta <= std::f64::consts::PI * (1.0 + 1e-12);
            let finite = value.re.is_finite() && value.im.is_finite() && radius.is_finite();
            if !(inside && finite && radius >= 0.0) {
                return Err(Error::setting(format!(
                    "expected finite responses at frequencies above 0 up to half the sample rate, got {value} with a \
                     radius of {radius} at {w} rad/s"
                )));
            }
            Ok((Place::at(theta), value, radius))
        };
        let lines = lines.map(line).collect::<Result<_>>()?;
        Ok(Self { lines, counted })
    }

    /// The largest `|S|` that the circles allow; infinite if one reaches -1. The loop is assumed to be stable.
    pub fn peak_sensitivity(&self, path: &Path) -> f64 {
        let largest = |most: f64, (at, plant, radius): &(Place, Complex<f64>, f64)| {
            let feedback = self.feedback(path, at);
            let distance = (feedback * plant + 1.0).norm() - feedback.norm() * radius;
            let sensitivity = if distance > 0.0 {
                1.0 / distance
            } else {
                f64::INFINITY
            };
            most.max(sensitivity)
        };
        self.lines.iter().fold(0.0, largest)
    }

    /// The largest `|L|`.
    pub(crate) fn largest_gain(&self, path: &Path) -> f64 {
        let gains = self.lines.iter();
        gains
            .map(|(at, plant, _)| (self.feedback(path, at) * plant).norm())
            .fold(0.0, f64::max)
    }

    fn feedback(&self, path: &Path, at: &Place) -> Complex<f64> {
        let feedback = path.response(at);
        if self.counted {
            return feedback;
        }
        feedback * path.encoder_response(at)
    }
}

#[cfg(test)]
mod tests {
    use sewfast_control::Standard;

    use super::super::{Loop, Plant, peak_sensitivity};
    use super::*;

    const TS: f64 = 1e-3;

    #[test]
    fn a_response_without_error_has_the_sensitivity_of_its_plant() {
        let gains = Standard {
            kp: 0.02,
            ti: 0.1,
            td: 0.0,
        };
        let plant = Plant::fopdt(490.0, 0.25, 0.0083, TS).unwrap();
        for counted in [false, true] {
            let path = Path {
                encoder: counted,
                ..Path::new(gains, TS)
            };
            let omega: Vec<f64> = (1..20_000).map(|k| f64::from(k) * 0.15).collect();
            let of = |w: &f64| {
                let at = Place::at(w * TS);
                plant.response(&at)
                    * if counted {
                        path.encoder_response(&at)
                    } else {
                        Complex::new(1.0, 0.0)
                    }
            };
            let response: Vec<_> = omega.iter().map(of).collect();
            let exact = peak_sensitivity(&Loop::new(&path, &plant).unwrap());
            let none = vec![0.0; omega.len()];
            let measured = Measured::new(&omega, &response, &none, counted, TS).unwrap();
            assert!((measured.peak_sensitivity(&path) / exact - 1.0).abs() < 1e-4);
            // circles can only make it worse; a circle around -1 allows any size
            let radius: Vec<f64> = response.iter().map(|g| 0.1 * g.norm()).collect();
            let wide = Measured::new(&omega, &response, &radius, counted, TS).unwrap();
            assert!(wide.peak_sensitivity(&path) > 1.02 * exact);
            let radius: Vec<f64> = response.iter().map(|g| 2.0 * g.norm()).collect();
            let wide = Measured::new(&omega, &response, &radius, counted, TS).unwrap();
            assert!(wide.peak_sensitivity(&path).is_infinite());
        }
    }

    #[test]
    fn refuses_what_is_no_response() {
        let one = Complex::new(1.0, 0.0);
        for (omega, value, radius) in [
            (vec![], vec![], vec![]),
            (vec![1.0], vec![one, one], vec![0.0]),
            (vec![1.0], vec![one], vec![]),
            (vec![0.0], vec![one], vec![0.0]),
            (vec![4e3], vec![one], vec![0.0]),
            (vec![1.0], vec![one], vec![-1.0]),
            (vec![1.0], vec![one], vec![f64::INFINITY]),
            (vec![1.0], vec![Complex::new(f64::NAN, 0.0)], vec![0.0]),
        ] {
            assert!(Measured::new(&omega, &value, &radius, false, TS).is_err());
        }
    }
}
