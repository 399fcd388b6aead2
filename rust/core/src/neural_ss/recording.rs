//! Recordings as they are measured: their check, their scaling, and what a constant makes of them.

use super::output::OutputFunction;
use super::problem::Experiment;
use super::scaling::{Scaling, moments};
use super::shape::Shape;
use crate::{Error, Record, Result};

/// One experiment as it was measured; outputs that are not known are NaN.
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
}

impl<'a> From<&Record<'a>> for Recording<'a> {
    fn from(record: &Record<'a>) -> Self {
        Self {
            u: record.u,
            inputs: record.channels,
            y: record.y,
            outputs: 1,
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
        })
    }

    /// Number of samples.
    pub(crate) fn samples(&self) -> usize {
        self.u.len() / self.inputs
    }

    /// Number of leading samples of which `count` have a known output; all where there are not as many.
    pub(crate) fn first_samples(&self, count: usize) -> usize {
        let known = |y: &[f64]| y.iter().any(|y| !y.is_nan());
        let mut samples = self.y.chunks_exact(self.outputs).enumerate();
        let last = samples.by_ref().filter(|(_, y)| known(y)).nth(count - 1);
        last.map_or(self.samples(), |(k, _)| k + 1)
    }
}

/// Means and standard deviations of the known values. An output function without sign counts from 0.
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
        // NaN, of an output that is never known, does not change either
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
            .flat_map(|e| e.y.iter().skip(p).step_by(shape.outputs))
            .filter(|y| !y.is_nan());
        let count = known.clone().count() as f64;
        sum += count * moments(known.copied()).1.powi(2);
        samples += count;
    }
    0.5 * sum / samples
}

/// Refuses recordings that a model of this shape cannot be trained on.
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
