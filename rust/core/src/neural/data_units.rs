//! The network between data and data: its weights take the scaling in.

use super::{Network, NeuralOE};

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
