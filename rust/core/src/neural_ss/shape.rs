//! Length, order and parts of theta; and the scaling between the data's units and the model's.

use std::ops::Range;

use crate::{Error, Result};

/// Sizes of a neural state-space model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Number of states.
    pub nx: usize,
    /// Delay in samples from input to output.
    pub nk: usize,
    /// Number of inputs.
    pub inputs: usize,
    /// Hidden units.
    pub hidden: usize,
    /// Whether the last state is the sum of a function of the others.
    pub integrator: bool,
}

/// Larger sizes are typing errors.
const MOST: [(&str, usize, usize); 4] = [
    ("nx", 1, 50),
    ("nk", 0, 1_000),
    ("inputs", 1, 100),
    ("hidden", 1, 1_000),
];

/// The range of each part of theta.
#[derive(Clone, Debug)]
pub(crate) struct Parts {
    pub a: Range<usize>,
    pub b: Range<usize>,
    pub e: Range<usize>,
    pub wx: Range<usize>,
    pub wu: Range<usize>,
    pub bh: Range<usize>,
    pub c: Range<usize>,
    pub d: Range<usize>,
    pub constant: Range<usize>,
    pub g: Range<usize>,
}

impl Shape {
    /// The same shape, if its sizes make a model.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for sizes out of range.
    pub fn checked(self) -> Result<Self> {
        let sizes = [self.nx, self.nk, self.inputs, self.hidden];
        for ((name, least, most), value) in MOST.into_iter().zip(sizes) {
            if value < least || value > most {
                return Err(Error::setting(format!(
                    "expected {name} from {least} to {most}, got {value}; 3 states and 8 hidden units are a good beginning"
                )));
            }
        }
        Ok(self)
    }

    /// Length of theta.
    pub fn parameters(&self) -> usize {
        self.parts().g.end
    }

    /// Number of arguments of a hidden unit besides its bias: states and inputs.
    pub(super) fn arguments(&self) -> usize {
        self.nx + self.inputs
    }

    /// The range of each part.
    pub(crate) fn parts(&self) -> Parts {
        let (nx, nu, hidden) = (self.nx, self.inputs, self.hidden);
        let mut next = 0;
        let mut part = |size: usize| {
            next += size;
            next - size..next
        };
        Parts {
            a: part(nx * nx),
            b: part(nx * nu),
            e: part(nx * hidden),
            wx: part(hidden * nx),
            wu: part(hidden * nu),
            bh: part(hidden),
            c: part(nx),
            d: part(nu),
            constant: part(1),
            g: part(hidden),
        }
    }

    /// Index of the last state's own pole.
    pub(super) fn pole(&self) -> usize {
        self.parts().a.end - 1
    }

    /// Parameters held fixed by an integrator, and their values.
    pub(super) fn held(&self) -> Vec<(usize, f64)> {
        if !self.integrator {
            return Vec::new();
        }
        let (nx, last, parts) = (self.nx, self.nx - 1, self.parts());
        let column = (0..last).map(|q| (parts.a.start + q * nx + last, 0.0));
        let units = (0..self.hidden).map(|i| (parts.wx.start + i * nx + last, 0.0));
        column.chain([(self.pole(), 1.0)]).chain(units).collect()
    }

    /// Sets the parameters held fixed by an integrator.
    pub(super) fn hold(&self, theta: &mut [f64]) {
        for (i, value) in self.held() {
            theta[i] = value;
        }
    }

    /// Share of the weight decay for a parameter: 1 for the network's weights, a tenth for its biases, else 0.
    pub(super) fn decay(&self, parameter: usize) -> f64 {
        let parts = self.parts();
        if parts.bh.contains(&parameter) {
            return 0.1;
        }
        let weights = [&parts.e, &parts.wx, &parts.wu, &parts.g];
        f64::from(u8::from(
            weights.iter().any(|part| part.contains(&parameter)),
        ))
    }
}

/// `(u - u_mean)/u_scale`, input by input, and `(y - y_mean)/y_scale`.
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
    /// Refuses a scaling that does not fit the number of inputs.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for wrong lengths, scales that are not positive, values that are not finite.
    pub fn check(&self, inputs: usize) -> Result<()> {
        let parts = [
            ("u_mean", &self.u_mean, inputs),
            ("u_scale", &self.u_scale, inputs),
            ("y_mean", &vec![self.y_mean], 1),
            ("y_scale", &vec![self.y_scale], 1),
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

    /// All inputs, scaled and delayed by `delay` samples; before the first sample they hold their first value.
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
        y.iter().map(|y| self.output(*y)).collect()
    }

    /// An output, scaled.
    pub(super) fn output(&self, y: f64) -> f64 {
        (y - self.y_mean) / self.y_scale
    }

    /// An output in the data's unit.
    pub(super) fn restored(&self, scaled: f64) -> f64 {
        scaled * self.y_scale + self.y_mean
    }
}

/// Root mean square of the values that are not NaN; 0 if there are none.
pub(super) fn root_mean_square(values: impl Iterator<Item = f64>) -> f64 {
    let known = values.filter(|v| !v.is_nan());
    let (count, squares) = known.fold((0.0, 0.0), |(n, q), v| (n + 1.0, q + v * v));
    (squares / f64::max(count, 1.0)).sqrt()
}

/// Mean and standard deviation of the values that are not NaN.
pub(super) fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let known = values.filter(|v| !v.is_nan());
    let count = known.clone().count() as f64;
    let mean = known.clone().sum::<f64>() / count;
    let variance = known.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count;
    (mean, variance.sqrt())
}
