//! Records for a training: their check, their scaling, and the cost of the best constant.

use super::output::OutputFunction;
use super::problem::Experiment;
use super::shape::{Scaling, Shape, moments};
use crate::{Error, Record, Result};

/// Means and standard deviations of the known values. With an output function that loses the sign, outputs have a mean of 0.
pub(super) fn scaling(records: &[Record], output: OutputFunction) -> Result<Scaling> {
    let inputs = records[0].channels;
    let input = |j: usize| {
        let all = records.iter();
        moments(all.flat_map(move |r| r.u.iter().skip(j).step_by(inputs).copied()))
    };
    let (u_mean, u_scale): (Vec<f64>, Vec<f64>) = (0..inputs).map(input).unzip();
    let (mean, deviation) = moments(records.iter().flat_map(|r| r.y.iter().copied()));
    let (y_mean, y_scale) = match output {
        OutputFunction::Abs { .. } => (0.0, mean.hypot(deviation)),
        _ => (mean, deviation),
    };
    for (name, scales) in [("input", &u_scale), ("output", &vec![y_scale])] {
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

/// J of the best constant output.
pub(super) fn constant_cost(experiments: &[Experiment]) -> f64 {
    let known = experiments
        .iter()
        .flat_map(|e| (0..e.y.len()).map(move |i| (e.y[i], e.weight(i))))
        .filter(|(y, _)| !y.is_nan());
    let count: f64 = known.clone().map(|(_, w)| w).sum();
    let mean = known.clone().map(|(y, w)| w * y).sum::<f64>() / count;
    let squares = known.map(|(y, w)| w * ((y - mean) * (y - mean)));
    0.5 * squares.sum::<f64>() / count
}

/// Refuses records on which a model of this shape cannot be trained.
pub(super) fn check_records(records: &[Record], validation: &[Record], shape: Shape) -> Result<()> {
    for record in records.iter().chain(validation) {
        if record.channels != shape.inputs || record.len() < 2 || record.measured() == 0 {
            return Err(Error::data(format!(
                "expected 2 or more samples of {} inputs and of an output, some of it known, in every experiment, got {} samples of {} inputs; leave that experiment out",
                shape.inputs,
                record.len(),
                record.channels
            )));
        }
    }
    let known: usize = records.iter().map(Record::measured).sum();
    let parameters = shape.parameters() + records.len() * shape.nx;
    if known <= parameters {
        return Err(Error::data(format!(
            "expected more than {parameters} known outputs for as many parameters, got {known}; record longer or use fewer hidden units"
        )));
    }
    Ok(())
}
