//! How well a linear model runs on from a state that a few samples gave it.

use crate::data::window;
use crate::lagged::{Lagged, STATE_SAMPLES};
use crate::linear::LinearModel;
use crate::{Monitor, Record};

/// Segments an experiment is cut into, where it is long enough.
const SEGMENTS: usize = 8;
/// Shortest segment, in multiples of `STATE_SAMPLES`.
const SHORTEST: usize = 5;

/// Mean square free-run error over segments of the records, each started from its own first samples.
///
/// Where the model cannot hold all of the drive (friction, limits), a slow pole almost cancelled by a zero can lower
/// the cost by following the record's trend. Nobody can tell that pole's state from a few samples, so such a model
/// fails whenever it is started anew, which is what a model is for. Infinite where a run leaves the finite numbers, and
/// after a stop.
pub(super) fn restart_error(model: &LinearModel, records: &[Record], monitor: &Monitor) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for record in records {
        let length = (record.len() / SEGMENTS)
            .max(SHORTEST * STATE_SAMPLES)
            .min(record.len());
        for start in (0..)
            .map(|i| i * length)
            .take_while(|s| s + length <= record.len())
        {
            let found = match monitor.stopped() {
                true => None,
                false => segment_error(model, record, start, length),
            };
            let Some((error, samples)) = found else {
                return f64::INFINITY;
            };
            sum += error;
            count += samples;
        }
    }
    if count == 0.0 {
        f64::INFINITY
    } else {
        sum / count
    }
}

/// Sum of squared errors and of the weights of the measured samples behind those that set the state.
fn segment_error(
    model: &LinearModel,
    record: &Record,
    start: usize,
    length: usize,
) -> Option<(f64, f64)> {
    let channels = record.channels;
    let u = &record.u[start * channels..(start + length) * channels];
    let y = &record.y[start..start + length];
    let Some(init) = window(y, STATE_SAMPLES.min(length.div_ceil(SHORTEST))) else {
        return Some((0.0, 0.0));
    };
    let state = model
        .estimate_initial_state(&u[..init * channels], channels, &y[..init])
        .ok()?;
    let run = model.simulate(u, channels, &state).ok()?;
    let scored = (init..length).filter(|&k| !y[k].is_nan());
    let weighted = scored.map(|k| (record.weight(start + k), (y[k] - run[k]).powi(2)));
    Some(weighted.fold((0.0, 0.0), |(sum, count), (w, e)| (sum + w * e, count + w)))
}
