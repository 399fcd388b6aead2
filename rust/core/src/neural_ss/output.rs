//! The output function: from the sum of an output to the output itself.

use crate::{Error, Result};

/// The function `f` of `y = f(s)`, in scaled units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OutputFunction {
    /// `f(s) = s`.
    Linear,
    /// `f(s) = low + w p((s - low)/w) - w p((s - high)/w)` with `p(z) = log(1 + e^z)`: limits with smooth corners.
    Saturation {
        /// Lower limit.
        low: f64,
        /// Upper limit.
        high: f64,
        /// Width of a corner.
        width: f64,
    },
    /// `f(s) = sqrt(s^2 + w^2)`: a sensor that does not see the sign.
    Abs {
        /// Width of the corner.
        width: f64,
    },
}

impl OutputFunction {
    /// The function called `name`, with its parameters `()`, `(low, high, w)` or `(w,)`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for another name, another number of parameters, limits without room or a width that is not
    /// above 0.
    pub fn new(name: &str, parameters: &[f64]) -> Result<Self> {
        let function = match (name, parameters) {
            ("linear", []) => Self::Linear,
            ("saturation", &[low, high, width]) => Self::Saturation { low, high, width },
            ("abs", &[width]) => Self::Abs { width },
            _ => {
                return Err(Error::setting(format!(
                    "expected output linear without parameters, saturation with (low, high, w) or abs with (w,), got {name} with {parameters:?}; give all in scaled units"
                )));
            }
        };
        if function.is_sound() {
            return Ok(function);
        }
        Err(Error::setting(format!(
            "expected finite output parameters, low below high and a width w above 0, got {parameters:?}; w = .05 is a narrow corner"
        )))
    }

    fn is_sound(self) -> bool {
        let positive = |w: f64| w > 0.0 && w.is_finite();
        match self {
            Self::Linear => true,
            Self::Saturation { low, high, width } => {
                low < high && low.is_finite() && high.is_finite() && positive(width)
            }
            Self::Abs { width } => positive(width),
        }
    }

    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Saturation { .. } => "saturation",
            Self::Abs { .. } => "abs",
        }
    }

    /// The parameters in files.
    pub fn parameters(self) -> Vec<f64> {
        match self {
            Self::Linear => Vec::new(),
            Self::Saturation { low, high, width } => vec![low, high, width],
            Self::Abs { width } => vec![width],
        }
    }

    /// The output.
    #[inline]
    pub fn value(self, s: f64) -> f64 {
        match self {
            Self::Linear => s,
            Self::Saturation { low, high, width } => saturated(s, low, high, width).0,
            Self::Abs { width } => s.hypot(width),
        }
    }

    /// The output and its derivative.
    #[inline]
    pub fn value_and_slope(self, s: f64) -> (f64, f64) {
        match self {
            Self::Linear => (s, 1.0),
            Self::Saturation { low, high, width } => saturated(s, low, high, width),
            Self::Abs { width } => {
                let y = s.hypot(width);
                (y, s / y)
            }
        }
    }
}

/// Expanded about the nearer limit, with `p(z) = z + p(-z)`: about the other one it would subtract large numbers.
fn saturated(s: f64, low: f64, high: f64, width: f64) -> (f64, f64) {
    let middle = low + 0.5 * (high - low);
    let (base, first, second) = if s < middle {
        (low, s - low, s - high)
    } else {
        (high, low - s, high - s)
    };
    let ((p, dp), (q, dq)) = (softplus(first / width), softplus(second / width));
    let slope = if s < middle { dp - dq } else { dq - dp };
    (base + width * (p - q), slope)
}

/// `log(1 + e^z)` and its derivative `1/(1 + e^-z)`.
fn softplus(z: f64) -> (f64, f64) {
    let e = (-z.abs()).exp();
    let slope = if z > 0.0 {
        1.0 / (1.0 + e)
    } else {
        e / (1.0 + e)
    };
    (z.max(0.0) + e.ln_1p(), slope)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn refuses_what_is_no_function() {
        assert!(OutputFunction::new("linear", &[1.0]).is_err());
        assert!(OutputFunction::new("relu", &[]).is_err());
        assert!(OutputFunction::new("abs", &[0.0]).is_err());
        assert!(OutputFunction::new("saturation", &[1.0, -1.0, 0.1]).is_err());
        assert!(OutputFunction::new("saturation", &[-1.0, f64::INFINITY, 0.1]).is_err());
        let soft = OutputFunction::new("saturation", &[-1.0, 2.0, 0.1]).unwrap();
        assert_eq!(
            OutputFunction::new(soft.name(), &soft.parameters()),
            Ok(soft)
        );
    }

    #[test]
    fn saturates_softly_and_takes_the_sign_off() {
        let soft = OutputFunction::new("saturation", &[-1.0, 2.0, 0.05]).unwrap();
        assert!((soft.value(0.5) - 0.5).abs() < 1e-12);
        assert!((soft.value(99.0) - 2.0).abs() < 1e-12);
        assert!((soft.value(-1e6) + 1.0).abs() < 1e-12);
        let corner = soft.value(2.0);
        assert!((corner - (2.0 - 0.05 * 2f64.ln())).abs() < 1e-12);
        let size = OutputFunction::new("abs", &[0.1]).unwrap();
        assert_eq!(size.value(-3.0), size.value(3.0));
        assert!(OutputFunction::Linear.value(f64::NAN).is_nan());
        assert!(soft.value(f64::NAN).is_nan() && size.value(f64::NAN).is_nan());
    }

    proptest! {
        #[test]
        fn slopes_agree_with_differences(s in -4.0f64..4.0, width in 0.02f64..1.0) {
            for f in [OutputFunction::Saturation { low: -1.0, high: 2.0, width }, OutputFunction::Abs { width }] {
                let step = 1e-4 * width;
                let difference = (f.value(s + step) - f.value(s - step)) / (2.0 * step);
                prop_assert!((f.value_and_slope(s).1 - difference).abs() < 1e-6);
                prop_assert_eq!(f.value_and_slope(s).0, f.value(s));
            }
        }
    }
}
