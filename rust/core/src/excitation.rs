//! What a record shows of a plant: levels of its inputs, limits at which they stay, rests at its ends, one trajectory over and over, an
//! unstable pole.

use std::f64::consts::TAU;

use crate::column::{LARGEST, MAD, MEASURED, distinct, median, quantile, range, runs};
use crate::data::Samples;
use crate::fourier;
use crate::innovations::MOST_ORDER;
use crate::{Record, Result, arx};

/// Part of the samples that must be at one of two levels, and least part at each of them.
const CLUSTERED: f64 = 0.95;
const LEAST_AT_LEVEL: f64 = 0.02;
/// Samples of which the levels are taken.
const SAMPLED: usize = 20_000;
/// Least part of the samples and least number of stretches for an input to count as limited; samples of such a stretch.
const LIMITED: f64 = 0.02;
const VISITS: usize = 3;
const STUCK: usize = 3;
/// Least number of different values of an input that is limited: a staircase also stays at its highest level.
const VALUES: usize = 50;
const SEARCHED: usize = 200_000;
/// Correlation of the inputs with themselves one period later above which a record repeats; and the same in a closed loop, where noise
/// returns in the input: of the inputs alone, and of the output.
const REPEATED: f64 = 0.95;
const REPEATED_LOOSELY: f64 = 0.3;
const OUTPUT_REPEATED: f64 = 0.98;
/// Most values searched for a period; longer records are averaged in blocks.
const MOST: usize = 65_536;
/// Least values, and the correlation that a signal falls below before its period.
const LEAST: usize = 20;
const APART: f64 = 0.5;

/// The values of one input that are measured ones.
fn known_input(records: &[Record], j: usize) -> Vec<f64> {
    let input = |r: &Record| {
        input(r, j)
            .filter(|v| v.abs() < MEASURED)
            .collect::<Vec<_>>()
    };
    records.iter().flat_map(input).collect()
}

fn input<'a>(record: &Record<'a>, j: usize) -> impl Iterator<Item = f64> + use<'a> {
    record.u.iter().skip(j).step_by(record.channels).copied()
}

fn records<'a>(experiments: &[Samples<'a>]) -> (Vec<Record<'a>>, usize) {
    let records: Vec<_> = experiments.iter().map(Samples::unseen).collect();
    let channels = records.first().map_or(0, |r| r.channels);
    (records, channels)
}

/// The two levels of every input, apart from noise and few values in transit; none if it has others.
pub fn two_levels(experiments: &[Samples]) -> Vec<Option<(f64, f64)>> {
    let (records, channels) = records(experiments);
    (0..channels)
        .map(|j| levels(&known_input(&records, j)))
        .collect()
}

fn levels(values: &[f64]) -> Option<(f64, f64)> {
    let (low, high) = range(values.iter().copied());
    if values.is_empty() || low == high {
        return None;
    }
    if values.iter().all(|v| *v == low || *v == high) {
        return Some((low, high));
    }
    let every = (values.len() / SAMPLED).max(1);
    let sample: Vec<f64> = values.iter().step_by(every).copied().collect();
    // quantiles, because one outlier would shift the middle
    let ends = [0.02, 0.98].map(|share| quantile(sample.clone(), share));
    let middle = 0.5 * (ends[0] + ends[1]);
    let n = sample.len() as f64;
    let (low, high): (Vec<f64>, Vec<f64>) = sample.into_iter().partition(|v| *v < middle);
    if (low.len().min(high.len()) as f64) < LEAST_AT_LEVEL * n {
        return None;
    }
    let groups = [low, high];
    let levels = [0, 1].map(|i: usize| median(groups[i].clone()));
    let off = |i: usize| groups[i].iter().map(move |v| (v - levels[i]).abs());
    let spreads = [0, 1].map(|i| MAD * median(off(i).collect()));
    let gap = levels[1] - levels[0];
    if spreads[0].max(spreads[1]) > gap / 20.0 {
        return None;
    }
    let at = |i: usize| {
        let most = (5.0 * spreads[i]).max(0.02 * gap);
        off(i).filter(|off| *off < most).count()
    };
    ((at(0) + at(1)) as f64 > CLUSTERED * n).then_some((levels[0], levels[1]))
}

/// Limits at which an input stays: input, limit, number of stretches, share of the samples.
pub fn limits(experiments: &[Samples]) -> Vec<(usize, f64, usize, f64)> {
    let (records, channels) = records(experiments);
    let of = |j: usize| {
        let known = known_input(&records, j);
        let few = known.len().min(SEARCHED);
        let (low, high) = range(known.iter().copied());
        let ends = if distinct(known[..few].to_vec()).len() < VALUES {
            Vec::new()
        } else {
            vec![low, high]
        };
        let (records, n) = (&records, known.len() as f64);
        ends.into_iter().filter_map(move |limit| {
            let of = |r: &Record| runs(input(r, j).map(|v| v == limit));
            let stretches = records.iter().flat_map(of).map(|(_, count)| count);
            let stretches: Vec<usize> = stretches.filter(|count| *count >= STUCK).collect();
            let share = stretches.iter().sum::<usize>() as f64 / n;
            let stays = stretches.len() >= VISITS && share > LIMITED;
            stays.then_some((j, limit, stretches.len(), share))
        })
    };
    (0..channels).flat_map(of).collect()
}

/// Samples at the beginning and at the end of every experiment during which every column stays at its level.
pub fn rests(experiments: &[Samples]) -> Vec<(usize, usize)> {
    let of = |s: &Samples| {
        let record = s.unseen();
        let columns: Vec<Vec<f64>> = (0..record.channels)
            .map(|j| input(&record, j).collect())
            .chain([record.y.to_vec()])
            .collect();
        let backwards: Vec<Vec<f64>> = columns
            .iter()
            .map(|c| c.iter().rev().copied().collect())
            .collect();
        (resting(&columns), resting(&backwards))
    };
    experiments.iter().map(of).collect()
}

/// Samples before a column leaves its first level; the output is the last column.
fn resting(columns: &[Vec<f64>]) -> usize {
    let n = columns[0].len();
    let end = (n / 20).clamp(5, 50);
    let mut still = n;
    for (i, column) in columns.iter().enumerate() {
        let known: Vec<f64> = column
            .iter()
            .copied()
            .filter(|v| v.abs() < MEASURED)
            .collect();
        let (low, high) = range(known.iter().copied());
        if known.len() < 2 * end || low == high {
            continue;
        }
        let level = median(known[..end].to_vec());
        let spread = MAD * median(known[..end].iter().map(|v| (v - level).abs()).collect());
        let span = high - low;
        // noise on a level is allowed, but an input that is noise does not rest
        let most = if i + 1 < columns.len() { 0.05 } else { 0.1 };
        let tolerance = (0.01 * span).max(5.0 * spread).min(most * span);
        let leaves = column.iter().position(|v| (v - level).abs() > tolerance);
        still = still.min(leaves.unwrap_or(n));
    }
    still
}

/// Period \[samples\] of inputs of the longest experiment that repeat at least twice, and their correlation at it.
pub fn period(experiments: &[Samples]) -> Option<(f64, f64)> {
    let (records, _) = records(experiments);
    // the first of equal ones
    let record = records.iter().rev().max_by_key(|r| r.len())?;
    let size = (record.len() / MOST).max(1);
    let inputs = (0..record.channels).map(|j| input(record, j).collect::<Vec<_>>());
    let moving: Vec<Vec<f64>> = inputs
        .filter_map(|c| averaged(&c, size))
        .map(|c| autocorrelation(&c))
        .collect();
    let first = moving.first().filter(|r| r.len() >= LEAST)?;
    let lags = 0..first.len();
    let least = |k: usize| moving.iter().map(|r| r[k]).fold(f64::INFINITY, f64::min);
    let r: Vec<f64> = lags.clone().map(least).collect();
    let output = averaged(record.y, size).map(|c| autocorrelation(&c));
    // at lags near 0 every signal resembles itself
    let (mut apart, mut output_apart) = (false, false);
    let again = lags.map(|k| {
        apart |= r[k] < APART;
        let of_output = output.as_ref().map_or(0.0, |o| o[k]);
        output_apart |= output.is_some() && of_output < APART;
        let loosely = r[k] >= REPEATED_LOOSELY && of_output >= OUTPUT_REPEATED;
        r[k] >= REPEATED && apart || loosely && output_apart
    });
    let (first, count) = *runs(again).first()?;
    let stretch = (first..first + count).rev();
    let lag = stretch.max_by(|a, b| r[*a].total_cmp(&r[*b]))?;
    Some(((lag * size) as f64, r[lag]))
}

/// Block means minus their mean over the largest, 0 where nothing is known; none if the column is constant.
fn averaged(column: &[f64], size: usize) -> Option<Vec<f64>> {
    let mean = |block: &[f64]| {
        let known = block.iter().filter(|v| v.abs() < MEASURED);
        let (sum, n) = known.fold((0.0, 0.0), |(sum, n), v| (sum + v, n + 1.0));
        (n > 0.0).then(|| sum / n)
    };
    let means: Vec<Option<f64>> = column.chunks_exact(size).map(mean).collect();
    let known = || means.iter().flatten();
    let middle = known().sum::<f64>() / known().count().max(1) as f64;
    let found = means.iter().map(|m| m.map_or(0.0, |m| m - middle));
    let found: Vec<f64> = found.collect();
    let most = |values: &[f64]| {
        let known = values.iter().map(|v| v.abs()).filter(|v| *v < MEASURED);
        known.fold(0.0, f64::max)
    };
    let largest = most(&found);
    let moves = largest > 1e-12 * most(column);
    moves.then(|| found.iter().map(|v| v / largest).collect())
}

/// Correlation of a column with itself at lags up to half its length, over each overlap.
fn autocorrelation(column: &[f64]) -> Vec<f64> {
    let n = column.len();
    let of = fourier::spectrum(column, (2 * n).next_power_of_two());
    let products = fourier::correlation(&of, &of);
    let mut squares = vec![0.0; n + 1];
    for (k, v) in column.iter().enumerate() {
        squares[k + 1] = squares[k] + v * v;
    }
    let one = |lag: usize| {
        let size = (squares[n - lag] * (squares[n] - squares[lag])).sqrt();
        products[lag] / size.max(1e-9 * squares[n])
    };
    (0..=n / 2).map(one).collect()
}

/// Orders of the equation-error model. Of 200 unstable plants in loops (`tests/dataset/test_stability.py`) it shows 192, with 8 orders 165:
/// noise of the measurement asks for many.
const ORDER: usize = 20;
/// Growth over half a record from which it cannot come from an open loop. Integrators of 10 seeds of the battery's families reach 8 by
/// chance, all others less.
const GROWTH: f64 = 100.0;
/// Fewest samples of a turn of the pole, or of a growth by as much. Outputs that were smoothed or filtered in both directions have quicker
/// ones, which are no plant's, and coarse encoder steps have a pole at 60. Of 576 records of the battery, plain and resampled, none is called unstable; of 166 filtered in both directions over many samples, some
/// are.
const TURN: f64 = 40.0;

/// Modulus of an unstable pole per sample; none if the record shows none.
///
/// A bounded record of an unstable plant comes from a closed loop. There least squares of many orders is still consistent if a reference or
/// a dither moves the loop (Ljung 1999, section 13.4). Both halves of a record, of 20,000 samples at most, have to show a pole that would
/// have grown a hundredfold in open loop.
pub fn unstable_pole(experiments: &[Samples]) -> Option<f64> {
    let half = |second: usize| {
        let of = |s: &Samples| {
            let r = s.unseen();
            let (k, m) = (r.len().min(SAMPLED) / 2, r.channels);
            let part = second * k..(second + 1) * k;
            (
                r.u[part.start * m..part.end * m].to_vec(),
                bridged(&r.y[part]),
            )
        };
        let parts: Vec<_> = experiments
            .iter()
            .map(of)
            .filter(|(_, y)| !y.is_empty())
            .collect();
        largest_pole(&parts).unwrap_or((0.0, f64::NEG_INFINITY))
    };
    let (first, second) = (half(0), half(1));
    let (pole, growth) = if second.1 < first.1 { second } else { first };
    (growth >= GROWTH.ln()).then_some(pole)
}

/// An output whose short gaps are lines: every ninth value missing would leave no sample with a known past.
fn bridged(y: &[f64]) -> Vec<f64> {
    let mut found = y.to_vec();
    for (first, count) in runs(y.iter().map(|y| y.is_nan())) {
        if count > MOST_ORDER || first == 0 || first + count == y.len() {
            continue;
        }
        let (from, slope) = (
            y[first - 1],
            (y[first + count] - y[first - 1]) / (count + 1) as f64,
        );
        for (k, y) in found[first..first + count].iter_mut().enumerate() {
            *y = from + slope * (k + 1) as f64;
        }
    }
    found
}

/// Modulus of the largest pole, and the logarithm of its growth over the mean experiment.
fn largest_pole(parts: &[(Vec<f64>, Vec<f64>)]) -> Option<(f64, f64)> {
    let samples: usize = parts.iter().map(|(_, y)| y.len()).sum();
    let channels = parts.first()?.0.len() / parts.first()?.1.len();
    let order = (samples / (10 * (1 + channels))).clamp(2, ORDER);
    let records = parts.iter().map(|(u, y)| Record::with_gaps(u, channels, y));
    let records = records.collect::<Result<Vec<_>>>().ok()?;
    let fit = arx::fit(&records, order, order, 1, true).ok()?;
    let poles = fit.poles().into_iter().rev();
    let largest = poles.max_by(|a, b| a.norm().total_cmp(&b.norm()))?;
    let pole = largest.norm();
    let is_slow = pole > 0.0 && pole.ln().hypot(largest.arg()) <= TAU / TURN;
    is_slow.then(|| (pole, samples as f64 / parts.len() as f64 * pole.ln()))
}

/// Jumps of an angle that wraps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wraps {
    /// A turn, in the output's unit.
    pub period: f64,
    /// Number of jumps.
    pub jumps: usize,
}

/// Jumps of the output by nearly its whole range, against the motion before and after.
pub fn wraps(experiments: &[Samples]) -> Option<Wraps> {
    let known = |s: &Samples| {
        s.unseen()
            .y
            .iter()
            .copied()
            .filter(|v| v.abs() < LARGEST)
            .collect()
    };
    let columns: Vec<Vec<f64>> = experiments.iter().map(known).collect();
    let (low, high) = range(columns.iter().flatten().copied());
    let span = high - low;
    if span <= 0.0 {
        return None;
    }
    let (mut back, mut other, mut sizes, mut all) = (0, 0, Vec::new(), Vec::new());
    for y in &columns {
        let change: Vec<f64> = y.windows(2).map(|pair| pair[1] - pair[0]).collect();
        all.extend(change.iter().map(|c| c.abs()));
        let is_jump = |c: f64| c.abs() > 0.7 * span;
        for (k, c) in change
            .iter()
            .enumerate()
            .filter(|(_, c)| c.abs() > 0.35 * span)
        {
            let (first, last) = (k.saturating_sub(5), (k + 6).min(change.len()));
            let around = &change[first..last];
            // changes of an angle are either small or jumps; noise has changes of all sizes between; there and back is a spike
            if !is_jump(*c) || around.iter().any(|a| is_jump(*a) && a * c < 0.0) {
                other += 1;
                continue;
            }
            let others = (first..last)
                .filter(|i| *i != k)
                .map(|i| change[i])
                .collect::<Vec<_>>();
            let slope = if others.is_empty() {
                0.0
            } else {
                median(others)
            };
            if slope * c < 0.0 && slope.abs() < 0.2 * span {
                back += 1;
                sizes.push((c - slope).abs());
            } else {
                other += 1;
            }
        }
    }
    if back < 2 || back < 4 * other {
        return None;
    }
    let period = median(sizes);
    // what wraps stays within one turn but for noise (six deviations are at most eight of its median steps); a stretch that is shifted
    // does not
    if span > period + 8.0 * median(all) {
        return None;
    }
    let counts = (8..33).map(|bits| 2.0_f64.powi(bits));
    let mut turns = [360.0, TAU, 1.0].into_iter().chain(counts);
    let turn = turns.find(|turn| (period / turn - 1.0).abs() < 0.02);
    Some(Wraps {
        period: turn.unwrap_or(period),
        jumps: back,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    fn samples<'a>(u: &'a [f64], y: &'a [f64]) -> [Samples<'a>; 1] {
        [Samples::new(u, 1, y).unwrap()]
    }

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        (0..n).map(|_| random.normal()).collect()
    }

    #[test]
    fn levels_and_limits() {
        let rough = noise(2000, 1);
        let two = |k: usize, size: f64| f64::from(u8::from(k / 30 % 2 == 1)) + size * rough[k];
        let of = |size: f64| (0..2000).map(|k| two(k, size)).collect::<Vec<_>>();
        assert_eq!(two_levels(&samples(&of(0.0), &rough)), [Some((0.0, 1.0))]);
        let found = two_levels(&samples(&of(0.01), &rough))[0].unwrap();
        assert!(found.0.abs() < 0.01 && (found.1 - 1.0).abs() < 0.01);
        assert_eq!(two_levels(&samples(&rough, &rough)), [None]);
        assert_eq!(two_levels(&samples(&[1.0; 9], &[1.0; 9])), [None]);
        let clipped: Vec<f64> = (0..2000)
            .map(|k| (3.0 * (k as f64 / 20.0).sin()).min(2.5))
            .collect();
        let found = limits(&samples(&clipped, &rough));
        assert_eq!((found.len(), found[0].1), (1, 2.5));
        assert!(found[0].2 > 10 && (found[0].3 - 0.19).abs() < 0.02);
        assert_eq!(limits(&samples(&of(0.0), &rough)), []);
    }

    #[test]
    fn rests_and_periods() {
        let rough = noise(1000, 2);
        let at = |k: usize| {
            if (300..800).contains(&k) {
                10.0 * rough[k]
            } else {
                0.0
            }
        };
        let u: Vec<f64> = (0..1000).map(at).collect();
        let y: Vec<f64> = (0..1000).map(|k| at(k) + 0.01 * rough[k]).collect();
        let (before, after) = rests(&samples(&u, &y))[0];
        assert!((300..310).contains(&before) && (200..210).contains(&after));
        let again: Vec<f64> = (0..1000).map(|k| rough[k % 250]).collect();
        let (found, correlation) = period(&samples(&again, &again)).unwrap();
        assert!(found == 250.0 && correlation > 0.99);
        assert_eq!(period(&samples(&rough, &rough)), None);
        assert_eq!(period(&samples(&[1.0; 99], &rough[..99])), None);
    }

    #[test]
    fn angles_wrap_and_noise_does_not() {
        let turning = |k: usize| (0.37 * k as f64).rem_euclid(TAU);
        let y: Vec<f64> = (0..500).map(turning).collect();
        let found = wraps(&samples(&y, &y)).unwrap();
        assert_eq!((found.period, found.jumps), (TAU, 29));
        assert_eq!(wraps(&samples(&y, &noise(500, 3))), None);
        assert_eq!(wraps(&samples(&y, &[1.0; 500])), None);
    }

    #[test]
    fn a_loop_shows_the_pole_that_it_holds() {
        let (r, e) = (noise(4000, 4), noise(4000, 5));
        let held = |pole: f64, gain: f64| {
            let (mut x, mut u, mut y) = (0.0, Vec::new(), Vec::new());
            for k in 0..4000 {
                y.push(x + 0.01 * e[k]);
                u.push(r[k] - gain * y[k]);
                x = pole * x + u[k];
            }
            (u, y)
        };
        let (u, y) = held(1.05, 0.3);
        let found = unstable_pole(&samples(&u, &y)).unwrap();
        assert!((found - 1.05).abs() < 0.01, "{found}");
        let (u, y) = held(0.95, 0.0);
        assert_eq!(unstable_pole(&samples(&u, &y)), None);
    }
}
