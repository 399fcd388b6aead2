//! Recordings as measured: their check, their scaling, and the cost of the best constant.

use super::output::OutputFunction;
use super::problem::Experiment;
use super::shape::{Scaling, Shape, moments};
use crate::data::{check_weights, unless_one};
use crate::{Error, Record, Result};

/// One experiment as measured; unknown outputs are NaN.
#[derive(Clone, Copy, Debug)]
pub struct Recording<'a> {
    /// Inputs, time first.
    pub u: &'a [f64],
    /// Number of inputs.
    pub inputs: usize,
    /// Outputs, time first.
    pub y: &'a [f64],
    /// Number of outputs.
    pub outputs: usize,
    /// Weights of the samples' squared errors, finite and 0 or more; `None` if all count alike.
    pub weights: Option<&'a [f64]>,
}

impl<'a> From<&Record<'a>> for Recording<'a> {
    fn from(record: &Record<'a>) -> Self {
        Self {
            u: record.u,
            inputs: record.channels,
            y: record.y,
            outputs: 1,
            weights: record.weights,
        }
    }
}

impl<'a> Recording<'a> {
    /// A recording whose shape and values have been checked.
    ///
    /// # Errors
    /// `ErrorKind::Data` for lengths that do not match, inputs that are not finite, outputs that are infinite.
    pub fn new(u: &'a [f64], inputs: usize, y: &'a [f64], outputs: usize) -> Result<Self> {
        if inputs == 0 || outputs == 0 || u.len() / inputs != y.len() / outputs {
            return Err(Error::data(format!(
                "expected u of shape (N, nu) and y of shape (N, ny) with the same N, got {} values for {inputs} inputs and {} for {outputs} outputs; give u and y the same number of samples",
                u.len(),
                y.len()
            )));
        }
        if let Some(i) = u.iter().position(|v| !v.is_finite()) {
            return Err(Error::data(format!(
                "expected finite values in u, got {} at sample {}; cut or repair that part of the recording",
                u[i],
                i / inputs
            )));
        }
        if let Some(i) = y.iter().position(|v| v.is_infinite()) {
            return Err(Error::data(format!(
                "expected finite values in y, or NaN where it is not known, got {} at sample {}; cut or mask that part of the recording",
                y[i],
                i / outputs
            )));
        }
        Ok(Self {
            u,
            inputs,
            y,
            outputs,
            weights: None,
        })
    }

    /// The same recording with a weight for each sample: costs are `sum w e^2 / (2 sum w)`. Only sums of squared errors
    /// use the weights; scaling, starts, estimated states and the guard ignore them.
    ///
    /// # Errors
    /// `ErrorKind::Data` for another number of weights, weights that are negative or not finite, or 0 wherever an
    /// output is known.
    pub fn with_weights(self, weights: &'a [f64]) -> Result<Self> {
        let first_known = |y: &[f64]| y.iter().copied().find(|y| !y.is_nan()).unwrap_or(f64::NAN);
        let known: Vec<f64> = self.y.chunks_exact(self.outputs).map(first_known).collect();
        check_weights(weights, &known)?;
        Ok(Self {
            weights: unless_one(weights),
            ..self
        })
    }

    /// A weight for each output, equal for those of a sample; empty if all count alike.
    pub(super) fn output_weights(&self) -> Vec<f64> {
        let repeated = |w: &f64| std::iter::repeat_n(*w, self.outputs);
        let weights = self.weights.unwrap_or_default();
        weights.iter().flat_map(repeated).collect()
    }

    /// Number of samples.
    pub(crate) fn samples(&self) -> usize {
        self.u.len() / self.inputs
    }

    /// Number of leading samples that contain `count` samples with a known output; all samples if there are fewer.
    pub(crate) fn first_samples(&self, count: usize) -> usize {
        let known = |y: &[f64]| y.iter().any(|y| !y.is_nan());
        let mut samples = self.y.chunks_exact(self.outputs).enumerate();
        let last = samples.by_ref().filter(|(_, y)| known(y)).nth(count - 1);
        last.map_or(self.samples(), |(k, _)| k + 1)
    }
}

/// Means and standard deviations of the known values. With an output function that loses the sign, outputs have a mean of 0.
pub(super) fn scaling(recordings: &[Recording], output: OutputFunction) -> Result<Scaling> {
    let (inputs, outputs) = (recordings[0].inputs, recordings[0].outputs);
    let input = |j: usize| {
        moments(
            recordings
                .iter()
                .flat_map(move |r| r.u.iter().skip(j).step_by(inputs).copied()),
        )
    };
    let measured = |p: usize| {
        moments(
            recordings
                .iter()
                .flat_map(move |r| r.y.iter().skip(p).step_by(outputs).copied()),
        )
    };
    let from_zero = |(mean, deviation): (f64, f64)| match output {
        OutputFunction::Abs { .. } => (0.0, mean.hypot(deviation)),
        _ => (mean, deviation),
    };
    let (u_mean, u_scale): (Vec<f64>, Vec<f64>) = (0..inputs).map(input).unzip();
    let (y_mean, y_scale): (Vec<f64>, Vec<f64>) =
        (0..outputs).map(|p| from_zero(measured(p))).unzip();
    for (name, scales) in [("input", &u_scale), ("output", &y_scale)] {
        // an output that is never known has NaN here, and is refused as well
        if let Some(j) = scales.iter().position(|s| !(s.is_finite() && *s > 0.0)) {
            return Err(Error::data(format!(
                "expected {name} {j} (0-based) to change, got a constant or no known value; leave it out or excite the drive"
            )));
        }
    }
    Ok(Scaling {
        u_mean,
        u_scale,
        y_mean,
        y_scale,
    })
}

/// J of the best constant outputs.
pub(super) fn constant_cost(experiments: &[Experiment], shape: Shape) -> f64 {
    let (mut sum, mut samples) = (0.0, 0.0);
    for p in 0..shape.outputs {
        let known = experiments
            .iter()
            .flat_map(|e| {
                (p..e.y.len())
                    .step_by(shape.outputs)
                    .map(move |i| (e.y[i], e.weight(i)))
            })
            .filter(|(y, _)| !y.is_nan());
        let count: f64 = known.clone().map(|(_, w)| w).sum();
        let mean = known.clone().map(|(y, w)| w * y).sum::<f64>() / count;
        let variance = known
            .map(|(y, w)| w * ((y - mean) * (y - mean)))
            .sum::<f64>()
            / count;
        sum += count * variance.sqrt().powi(2);
        samples += count;
    }
    0.5 * sum / samples
}

/// Refuses recordings on which a model of this shape cannot be trained.
pub(super) fn check_recordings(
    recordings: &[Recording],
    validation: &[Recording],
    shape: Shape,
) -> Result<()> {
    for recording in recordings.iter().chain(validation) {
        let alike = recording.inputs == shape.inputs && recording.outputs == shape.outputs;
        if !alike || recording.samples() < 2 || recording.y.iter().all(|y| y.is_nan()) {
            return Err(Error::data(format!(
                "expected 2 or more samples of {} inputs and {} outputs, some of them known, in every experiment, got {} samples of {} and {}; leave that experiment out",
                shape.inputs,
                shape.outputs,
                recording.samples(),
                recording.inputs,
                recording.outputs
            )));
        }
    }
    let known = recordings
        .iter()
        .flat_map(|r| r.y)
        .filter(|y| !y.is_nan())
        .count();
    let parameters = shape.parameters() + recordings.len() * shape.nx;
    if known <= parameters {
        return Err(Error::data(format!(
            "expected more than {parameters} known outputs for as many parameters, got {known}; record longer or use fewer hidden units"
        )));
    }
    Ok(())
}
