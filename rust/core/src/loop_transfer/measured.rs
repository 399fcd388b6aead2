//! A plant that is known at frequencies only, as it was measured, and the sensitivity of a loop around it.

use nalgebra::Complex;

use super::{Path, Place};
use crate::{Error, Result};

/// A frequency response with the radius of the circle in which it lies at each frequency.
#[derive(Clone, Debug)]
pub struct Measured {
    lines: Vec<(Place, Complex<f64>, f64)>,
    /// Whether the output was counted: the encoder's mean over a sample is in the response already.
    counted: bool,
}

impl Measured {
    /// From frequencies \[rad/s\], responses and radii at sample time `ts`; `counted`: the encoder is in the response.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for no line, other lengths, a frequency beyond half the sample rate, what is not finite.
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

    /// The largest `|S|` that the circles allow, infinite where one reaches -1. That the loop is stable is taken for granted.
    pub fn peak_sensitivity(&self, path: &Path) -> f64 {
        let largest = |most: f64, (at, plant, radius): &(Place, Complex<f64>, f64)| {
            let mut feedback = path.response(at);
            if !self.counted {
                feedback *= path.encoder_response(at);
            }
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loop_transfer::{Loop, Plant, peak_sensitivity};
    use sewfast_control::Standard;

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
            // circles can only make it worse, and -1 inside of one has no bound
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
