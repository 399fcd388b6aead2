//! The sampled linear loop: a plant under a zero-order hold and the controller's feedback path, as functions of frequency.
//!
//! The loop is broken at the plant's input. With `z = exp(j w Ts)`, `G` the plant, `E` the encoder and `R` the way from
//! the measured output to the command,
//!
//! ```text
//! L = R E G,    S = 1/(1 + L),    T = L/(1 + L),    u = -R/(1 + L) n    (n: noise on the measured output)
//! ```
//!
//! [`margins`] says how far the loop is from instability, [`peak_sensitivity`] only `max |S|`, fast enough for a search.

mod margins;
mod path;
mod plant;
mod states;

pub use margins::{Margins, margins, peak_sensitivity};
pub use path::Path;
pub use plant::Measured;
pub use plant::Plant;

use nalgebra::Complex;

use crate::{Error, Result};

/// A place on the unit circle: `z^-1 = exp(-j theta)` and `1 - z^-1`, which keeps its digits at small angles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place {
    theta: f64,
    back: Complex<f64>,
    difference: Complex<f64>,
}

impl Place {
    fn at(theta: f64) -> Self {
        let (half, whole) = ((0.5 * theta).sin(), theta.sin());
        Self {
            theta,
            back: Complex::new(theta.cos(), -whole),
            difference: Complex::new(2.0 * half * half, whole),
        }
    }
}

/// A feedback path closed around a plant.
#[derive(Clone, Copy, Debug)]
pub struct Loop<'a> {
    path: &'a Path,
    plant: &'a Plant,
}

impl<'a> Loop<'a> {
    /// The loop of `path` around `plant`, whose coefficients hold at the path's sample time.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a setting of the path out of range, or a plant whose output depends on the command of the
    /// same sample.
    pub fn new(path: &'a Path, plant: &'a Plant) -> Result<Self> {
        path.check()?;
        if plant.num.first().is_some_and(|&b| b != 0.0) {
            return Err(Error::setting(
                "expected a plant that answers a sample later at the earliest, got one whose y(k) depends on u(k); shift \
                 it by a sample (nk = 1), as the command is decided after the output was measured",
            ));
        }
        Ok(Self { path, plant })
    }

    /// `L` at `omega` \[rad/s\].
    pub fn response(&self, omega: f64) -> Complex<f64> {
        self.at(&Place::at(omega * self.path.ts))
    }

    fn at(&self, place: &Place) -> Complex<f64> {
        self.path.response(place) * self.path.encoder_response(place) * self.plant.response(place)
    }
}

#[cfg(test)]
mod tests;
