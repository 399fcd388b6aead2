//! Between the data's units and the network's.

use super::{Network, NeuralOE};
use crate::{Error, Record, Result};

/// `(u - u_mean)/u_scale` and `(y - y_mean)/y_scale`.
#[derive(Clone, Debug, PartialEq)]
pub struct Scaling {
    /// Subtracted from each input.
    pub u_mean: Vec<f64>,
    /// Each input is then divided by it.
    pub u_scale: Vec<f64>,
    /// Subtracted from the output.
    pub y_mean: f64,
    /// The output is then divided by it.
    pub y_scale: f64,
}

impl Scaling {
    /// Means and standard deviations over all records; for the output, over its measured samples.
    pub fn of(records: &[Record]) -> Self {
        let channels = records[0].channels;
        let input = |j: usize| {
            moments(
                records
                    .iter()
                    .flat_map(move |r| r.u.iter().skip(j).step_by(channels)),
            )
        };
        let (u_mean, u_scale) = (0..channels).map(input).unzip();
        let measured = records.iter().flat_map(|r| r.y).filter(|y| !y.is_nan());
        let (y_mean, y_scale) = moments(measured);
        Self {
            u_mean,
            u_scale,
            y_mean,
            y_scale,
        }
    }

    /// Refuses a scaling that does not fit `channels` inputs.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for wrong lengths, scales that are not positive, values that are not finite.
    pub fn check(&self, channels: usize) -> Result<()> {
        if self.u_mean.len() != channels || self.u_scale.len() != channels {
            return Err(Error::setting(format!(
                "expected u_mean and u_scale with {channels} values, one per input, got {} and {}",
                self.u_mean.len(),
                self.u_scale.len()
            )));
        }
        let scales = self.u_scale.iter().chain([&self.y_scale]);
        if let Some(scale) = scales.copied().find(|s| !(s.is_finite() && *s > 0.0)) {
            return Err(Error::setting(format!(
                "expected positive scales, got {scale}; leave scales out to use standard deviations"
            )));
        }
        if self
            .u_mean
            .iter()
            .chain([&self.y_mean])
            .any(|m| !m.is_finite())
        {
            return Err(Error::setting(
                "expected finite means, got NaN or infinity; leave them out to use the data's",
            ));
        }
        Ok(())
    }

    /// Whether the weights may absorb the scaling: a mean far beyond its scale would lose digits, and an extreme scale makes no sense.
    pub(crate) fn is_moderate(&self) -> bool {
        let inputs = self.u_mean.iter().zip(&self.u_scale);
        inputs
            .chain([(&self.y_mean, &self.y_scale)])
            .all(|(mean, scale)| (1e-100..1e100).contains(scale) && mean.abs() <= 1e3 * scale)
    }

    /// All inputs, scaled.
    pub fn inputs(&self, u: &[f64]) -> Vec<f64> {
        let mut scaled = u.to_vec();
        for row in scaled.chunks_exact_mut(self.u_mean.len()) {
            for ((u, mean), scale) in row.iter_mut().zip(&self.u_mean).zip(&self.u_scale) {
                *u = (*u - mean) / scale;
            }
        }
        scaled
    }

    /// An output, scaled.
    pub fn output(&self, y: f64) -> f64 {
        (y - self.y_mean) / self.y_scale
    }

    /// A scaled output in the data's unit.
    pub fn restored(&self, scaled: f64) -> f64 {
        scaled * self.y_scale + self.y_mean
    }

    /// A regressor with `na` past outputs and `nb` past values of each input, scaled.
    pub(super) fn regressor(&self, phi: &[f64], na: usize, nb: usize, scaled: &mut [f64]) {
        let (outputs, inputs) = scaled.split_at_mut(na);
        for (scaled, y) in outputs.iter_mut().zip(phi) {
            *scaled = self.output(*y);
        }
        for (j, (scaled, u)) in inputs.iter_mut().zip(&phi[na..]).enumerate() {
            *scaled = (u - self.u_mean[j / nb]) / self.u_scale[j / nb];
        }
    }
}

impl NeuralOE {
    /// The same model as a network in the data's units.
    ///
    /// With `(x - m)/s` for each regressor, `W1' = W1/s`, `b1' = b1 - W1' m`; with `y_scale f + y_mean` for the output,
    /// `w2' = y_scale w2`, `linear' = y_scale linear/s`, `b2' = y_scale b2 + y_mean - linear' m`.
    pub(crate) fn in_data_units(&self) -> Network {
        let (theta, limits) = self.theta_in_data_units();
        let mut network = Network::zero(self.shape(), limits);
        network.load(&theta);
        network
    }

    /// Its parameters and the limits of its output.
    pub(crate) fn theta_in_data_units(&self) -> (Vec<f64>, (f64, f64)) {
        let (shape, scaling) = (self.shape(), &self.scaling);
        let (n_phi, na, nb) = (shape.lags.regressors(), shape.lags.na, shape.lags.nb);
        let [bias, second, constant, linear] = shape.offsets();
        let of = |c: usize| match c.checked_sub(na) {
            None => (scaling.y_mean, scaling.y_scale),
            Some(input) => (scaling.u_mean[input / nb], scaling.u_scale[input / nb]),
        };
        let mut theta = self.theta.clone();
        for i in 0..shape.hidden {
            for c in 0..n_phi {
                let (mean, scale) = of(c);
                theta[i * n_phi + c] /= scale;
                theta[bias + i] -= theta[i * n_phi + c] * mean;
            }
            theta[second + i] *= scaling.y_scale;
        }
        theta[constant] = scaling.restored(theta[constant]);
        for (c, i) in (linear..theta.len()).enumerate() {
            let (mean, scale) = of(c);
            theta[i] *= scaling.y_scale / scale;
            theta[constant] -= theta[i] * mean;
        }
        let (low, high) = self.limits();
        (theta, (scaling.restored(low), scaling.restored(high)))
    }
}

fn moments<'a>(values: impl Iterator<Item = &'a f64> + Clone) -> (f64, f64) {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let variance = values.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count;
    (mean, variance.sqrt())
}
