//! Starts of linear output error: least squares, instrumental variables, and poles over all time constants, on pieces
//! of long records; and the restart error: how well a model runs on from a state estimated from a few samples.

use std::f64::consts::PI;

use nalgebra::Complex;

use super::problem::OutputError;
use crate::data::window;
use crate::iv::{self, Outputs};
use crate::lagged::{Lagged, STATE_SAMPLES};
use crate::linear::{LinearModel, is_stable, polynomial, stabilised};
use crate::random::Random;
use crate::{Monitor, Record, arx};

/// Instrumental-variable iterations; if they settle at all, they do so within five or so.
const IV_ITERATIONS: usize = 12;
/// Samples simulated in all for drawn poles: about a fifth of a second.
const SCREENED_SAMPLES: usize = 4_000_000;
/// Candidates whose costs agree this closely count as one.
const SAME_COST: f64 = 1e-6;

/// Start parameters with their costs, best free run first.
pub(super) fn candidates(
    problem: &mut OutputError,
    records: &[Record],
    monitor: &Monitor,
) -> Vec<(f64, Vec<f64>)> {
    let mut found: Vec<(f64, Vec<f64>)> = Vec::new();
    let lags = problem.lags;
    let offset = problem.shared() > lags.regressors();
    // the quickest one first, so that an early stop has a result
    let least_squares = arx::fit(records, lags.na, lags.nb, lags.nk, offset);
    if let Ok(first) = &least_squares {
        found.extend(problem.with_poles(&stabilised(first.a())));
    }
    let identified = least_squares.map_or_else(
        |_| Vec::new(),
        |first| identified(records, &first, offset, monitor),
    );
    for a in identified.into_iter().chain(drawn(problem, records)) {
        if monitor.stopped() {
            break;
        }
        found.extend(problem.with_poles(&a));
    }
    found.sort_by(|x, y| x.0.total_cmp(&y.0));
    found.dedup_by(|x, y| (x.0 - y.0).abs() <= SAME_COST * y.0);
    found
}

/// Denominators by SRIV and by Steiglitz and McBride, made stable.
fn identified(
    records: &[Record],
    first: &LinearModel,
    offset: bool,
    monitor: &Monitor,
) -> Vec<Vec<f64>> {
    let denominators =
        |instruments| iv::denominators(records, first, offset, instruments, IV_ITERATIONS, monitor);
    [Outputs::Simulated, Outputs::Measured]
        .into_iter()
        .flat_map(denominators)
        .collect()
}

/// Denominators with poles drawn over time constants from half a sample to a quarter of the record; a third of them
/// have complex pairs.
fn drawn(problem: &OutputError, records: &[Record]) -> Vec<Vec<f64>> {
    let samples: usize = records.iter().map(Record::len).sum();
    let longest = records.iter().map(Record::len).max().unwrap_or(1) as f64 / 4.0;
    let na = problem.lags.na;
    let draws = (SCREENED_SAMPLES / samples.max(1)).clamp(20, 60 * na.min(4));
    let mut random = Random::new(0);
    (0..draws)
        .map(|i| {
            let mut roots = Vec::with_capacity(na);
            while roots.len() < na {
                let time = (random.between(0.5f64.ln(), longest.max(2.0).ln())).exp();
                let radius = (-1.0 / time).exp();
                if i % 3 == 2 && na - roots.len() >= 2 {
                    let angle = random.between((0.5 / longest.max(1.0)).ln(), PI.ln()).exp();
                    let root = Complex::from_polar(radius, angle.min(PI));
                    roots.extend([root, root.conj()]);
                } else {
                    roots.push(Complex::new(radius, 0.0));
                }
            }
            polynomial(&roots)
        })
        .filter(|a| is_stable(a, 1e-9))
        .collect()
}

/// Records with more samples in all are searched in an excerpt.
const LONG: usize = 40_000;
/// Approximate number of samples of an excerpt.
const EXCERPT: usize = 16_000;
/// Samples of a piece.
const PIECE: usize = 8_000;

/// Pieces of each record, evenly spread and in proportion to its length; `None` if the records are short.
pub(super) fn excerpt<'a>(records: &[Record<'a>]) -> Option<Vec<Record<'a>>> {
    let samples: usize = records.iter().map(Record::len).sum();
    if samples <= LONG {
        return None;
    }
    let pieces: Vec<_> = records
        .iter()
        .flat_map(|record| {
            let share = (EXCERPT * record.len()).div_ceil(samples);
            pieces_of(record, share.min(record.len()))
        })
        .collect();
    (!pieces.is_empty()).then_some(pieces)
}

/// Pieces of about `share` samples together; pieces without any measured output of positive weight are left out.
fn pieces_of<'a>(record: &Record<'a>, share: usize) -> Vec<Record<'a>> {
    let count = share.div_ceil(PIECE).max(1);
    let length = share / count;
    let room = record.len() - length;
    let piece = |i: usize| {
        // a single piece comes from the middle
        let start = if count == 1 {
            room / 2
        } else {
            i * room / (count - 1)
        };
        let (from, to) = (start * record.channels, (start + length) * record.channels);
        let y = &record.y[start..start + length];
        let piece = Record::with_gaps(&record.u[from..to], record.channels, y).ok()?;
        let piece = piece.at_rest(record.rests && start == 0);
        match record.weights {
            None => Some(piece),
            Some(weights) => piece.with_weights(&weights[start..start + length]).ok(),
        }
    };
    (0..count).filter_map(piece).collect()
}

/// Segments into which an experiment is cut, if it is long enough.
const SEGMENTS: usize = 8;
/// Shortest segment, in multiples of `STATE_SAMPLES`.
const SHORTEST: usize = 5;

/// Mean square free-run error over segments of the records, each started from its own first samples.
///
/// If the model cannot describe all of the drive (friction, limits), a slow pole almost cancelled by a zero can lower
/// the cost by following the record's trend. The state of that pole cannot be determined from a few samples, so such a
/// model fails whenever it is started anew, which is what a model is for. Infinite if a run leaves the finite numbers,
/// and after a stop.
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

/// Sum of squared errors, and of the weights, of the measured samples after those that set the state.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_short_records_whole_and_takes_pieces_of_long_ones() {
        let u: Vec<f64> = (0..200_000).map(f64::from).collect();
        let y = &u[..100_000];
        let short = Record::new(&u[..40_000], 1, &y[..40_000]).unwrap();
        assert!(excerpt(&[short]).is_none());
        let long = Record::new(&u, 2, y).unwrap();
        let other = Record::new(&u[..1_000], 1, &y[..1_000]).unwrap();
        let pieces = excerpt(&[long]).unwrap();
        assert_eq!(pieces.len(), 2);
        assert_eq!((pieces[0].y[0], pieces[1].y[7_999]), (0.0, 99_999.0));
        assert_eq!(pieces[1].u[0], 2.0 * pieces[1].y[0]);
        let both = excerpt(&[Record::new(y, 1, y).unwrap(), other]).unwrap();
        assert_eq!(both.len(), 3);
        let samples: usize = both.iter().map(Record::len).sum();
        assert!((15_900..16_100).contains(&samples), "{samples}");
    }
}
