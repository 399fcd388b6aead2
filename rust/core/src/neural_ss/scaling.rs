//! Between the data's units and the model's, for several outputs.

use crate::{Error, Result};

/// `(u - u_mean)/u_scale` and `(y - y_mean)/y_scale`, input by input and output by output.
#[derive(Clone, Debug, PartialEq)]
pub struct Scaling {
    /// What is taken off each input.
    pub u_mean: Vec<f64>,
    /// What each input is then divided by.
    pub u_scale: Vec<f64>,
    /// What is taken off each output.
    pub y_mean: Vec<f64>,
    /// What each output is then divided by.
    pub y_scale: Vec<f64>,
}

impl Scaling {
    /// Refuses a scaling that does not fit the numbers of inputs and outputs.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for wrong lengths, scales that are not positive, values that are not finite.
    pub fn check(&self, inputs: usize, outputs: usize) -> Result<()> {
        let parts = [
            ("u_mean", &self.u_mean, inputs),
            ("u_scale", &self.u_scale, inputs),
            ("y_mean", &self.y_mean, outputs),
            ("y_scale", &self.y_scale, outputs),
        ];
        for (name, values, count) in parts {
            let is_scale = name.ends_with("scale");
            let sound = |v: &f64| v.is_finite() && (!is_scale || *v > 0.0);
            if values.len() != count || !values.iter().all(sound) {
                return Err(Error::setting(format!(
                    "expected {name} with {count} finite values{}, got {values:?}; identify the model again",
                    if is_scale { " above 0" } else { "" }
                )));
            }
        }
        Ok(())
    }

    /// All inputs, scaled and delayed by `delay` samples; before the first sample they are held at their first value.
    pub(super) fn delayed_inputs(&self, u: &[f64], delay: usize) -> Vec<f64> {
        let channels = self.u_mean.len();
        let samples = u.len() / channels;
        let input = |k: usize, j: usize| {
            (u[k.saturating_sub(delay) * channels + j] - self.u_mean[j]) / self.u_scale[j]
        };
        (0..samples * channels)
            .map(|i| input(i / channels, i % channels))
            .collect()
    }

    /// An input, scaled.
    pub(crate) fn input(&self, j: usize, u: f64) -> f64 {
        (u - self.u_mean[j]) / self.u_scale[j]
    }

    /// All outputs, scaled.
    pub(super) fn outputs(&self, y: &[f64]) -> Vec<f64> {
        let count = self.y_mean.len();
        y.iter()
            .enumerate()
            .map(|(i, y)| self.output(i % count, *y))
            .collect()
    }

    /// Output `p`, scaled.
    pub(super) fn output(&self, p: usize, y: f64) -> f64 {
        (y - self.y_mean[p]) / self.y_scale[p]
    }

    /// Output `p` in the data's unit.
    pub(super) fn restored(&self, p: usize, scaled: f64) -> f64 {
        scaled * self.y_scale[p] + self.y_mean[p]
    }
}

/// Root mean square of the values that are numbers; 0 where there are none.
pub(super) fn root_mean_square(values: impl Iterator<Item = f64>) -> f64 {
    let known = values.filter(|v| !v.is_nan());
    let (count, squares) = known.fold((0.0, 0.0), |(n, q), v| (n + 1.0, q + v * v));
    (squares / f64::max(count, 1.0)).sqrt()
}

/// Mean and standard deviation of the values that are numbers.
pub(super) fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let known = values.filter(|v| !v.is_nan());
    let count = known.clone().count() as f64;
    let mean = known.clone().sum::<f64>() / count;
    let variance = known.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count;
    (mean, variance.sqrt())
}
