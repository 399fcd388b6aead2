//! Where a record changes its sign, scale or time: torn files, turned leads, files that were glued.
//!
//! What one part of a record says of the output predicts the other once it is multiplied or shifted. Input and past are means over ever
//! longer times, so that neither noise nor the order of a plant matters. A change is believed if it leaves no more than half of what plants
//! leave that do not change: a curved one, and a linear one that swings longer than means can tell (a sweep through a resonance has other
//! gains before and after it). Where the output goes on as before while the input grows by what the gain falls, a line is enough in place
//! of the curve: only a plant that is saturated already does the same.

mod pair;
#[cfg(test)]
mod tests;

use std::ops::{Range, RangeInclusive};

use pair::Pair;

use crate::column::{LARGEST, SMALLEST};
use crate::fourier::{correlation, spectrum};
use crate::lagged::Lagged;
use crate::{Error, Monitor, Record, Result, iv};

/// Rows that are used; a longer record is taken in means, so that it has no more.
const MOST: usize = 20_000;
/// Each mean reaches back by this factor.
const WIDER: f64 = 1.5;
/// Places of an experiment at which the search for a change begins.
const PARTS: usize = 16;
/// Share of the error that may be left, as for the causes of a run.
const EXPLAINED: f64 = 0.5;
/// Shares of the output's changes, and of its scale, that are worth a word.
const NOTED: f64 = 0.1;
/// Part of an experiment that may be lost.
const FARTHEST: usize = 4;
/// Errors up to this multiple of the least are equal: a change without a shift is taken.
const TIES: f64 = 1.05;
/// Power of the inputs up to which a model of the whole record is curved.
const CURVED: i32 = 3;
/// Orders of the linear plant that does not change: of 240 sweeps through light resonances none is accused with it,
/// 81 without.
const ORDERS: RangeInclusive<usize> = 2..=4;
/// Iterations of its fit by instrumental variables, which leaves within 1e-4 of the output what output error leaves, in a 27th of the time.
const ITERATIONS: usize = 10;
/// Rows for each column, below which nothing is told.
const ROWS_PER_COLUMN: usize = 10;
/// Parts of an experiment, and halves of two beside each other, that are searched by themselves: of six records of each kind of
/// `tests/support/deceivers.py`, seeds 300 to 305, 146 of 156 were named with them, 133 without.
const WINDOWS: [usize; 2] = [2, 4];
/// Rounds in which a place is made sharper.
const ROUNDS: usize = 3;

/// One experiment, its output NaN where it is not known.
#[derive(Clone, Copy, Debug)]
pub struct Experiment<'a> {
    /// Inputs, time first.
    pub u: &'a [f64],
    /// Output.
    pub y: &'a [f64],
}

/// From sample `start` of an experiment on, the output is `gain` times what the rest of the record says, or what it says for `shift`
/// samples later. `left` is the share of the error that this leaves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Number of the experiment.
    pub experiment: usize,
    /// Sample of the experiment.
    pub start: usize,
    /// Factor of the output.
    pub gain: f64,
    /// Samples by which the output is early.
    pub shift: isize,
    /// Share of the error that is left.
    pub left: f64,
}

/// The change of a record; none if it has none.
///
/// # Errors
/// `ErrorKind::Data` for inputs and outputs of uneven lengths; `ErrorKind::Fit` on a stop.
pub fn changed(
    experiments: &[Experiment<'_>],
    channels: usize,
    monitor: &Monitor,
) -> Result<Option<Change>> {
    let even = |e: &Experiment<'_>| channels > 0 && e.u.len() == e.y.len() * channels;
    if !experiments.iter().all(even) {
        return Err(Error::data(
            "expected as many samples of every input as of the output; cut all to the same range",
        ));
    }
    let total: usize = experiments.iter().map(|e| e.y.len()).sum();
    let every = total.div_ceil(MOST).max(1);
    let is_known = |e: &Experiment<'_>| e.y.len() >= every && e.u.iter().all(|u| u.abs() < LARGEST);
    let known: Vec<usize> = (0..experiments.len())
        .filter(|&i| is_known(&experiments[i]))
        .collect();
    let of = |values: fn(&Experiment<'_>) -> Vec<f64>, width: usize| {
        let each = known
            .iter()
            .map(|&i| means(&values(&experiments[i]), width, every));
        each.collect::<Vec<_>>()
    };
    let (us, ys) = (of(|e| e.u.to_vec(), channels), of(|e| e.y.to_vec(), 1));
    let row = |i: usize, start: usize, found: Change| Change {
        experiment: known[i],
        start: (start + found.start) * every,
        shift: found.shift * every as isize,
        ..found
    };
    if let Some(found) = search(us.clone(), &ys, channels, false, monitor)? {
        return Ok(Some(row(found.experiment, 0, found)));
    }
    // a whole sweep shows each frequency once, and parts of it the same ones before and after a change of scale; what a short part
    // lacks of the past of a plant that integrates looks like rows that were lost
    for parts in WINDOWS {
        for (i, (u, y)) in us.iter().zip(&ys).enumerate() {
            let half = y.len() / (2 * parts);
            for start in (0..2 * parts - 1).map(|k| k * half) {
                let own =
                    |x: &[f64], width: usize| x[width * start..width * (start + 2 * half)].to_vec();
                let (u, y) = (own(u, channels), own(y, 1));
                if let Some(found) = search(vec![u], &[y], channels, true, monitor)? {
                    return Ok(Some(row(i, start, found)));
                }
            }
        }
    }
    Ok(None)
}

/// The change in these experiments, in their numbers and rows.
fn search(
    us: Vec<Vec<f64>>,
    ys: &[Vec<f64>],
    channels: usize,
    is_part: bool,
    monitor: &Monitor,
) -> Result<Option<Change>> {
    let longest = ys.iter().map(Vec::len).max().unwrap_or(0);
    let span = longest / (2 * PARTS);
    if span == 0 || !moves(&us, channels) || !moves(ys, 1) {
        return Ok(None);
    }
    let rows = Rows::new(us, ys, channels, span, is_part);
    let Some((found, left)) = rows.change(monitor)? else {
        return Ok(None);
    };
    // of the rows that have a share of both parts, one explains none
    let row = found.start - rows.edges[found.experiment];
    Ok(Some(Change {
        experiment: found.experiment,
        start: if row > 2 * span { row - span / 2 } else { 0 },
        gain: found.gain,
        shift: found.shift,
        left,
    }))
}

fn stopped() -> Error {
    Error::fit("stopped before the record was searched for changes")
}

/// Means of so many rows; those of values that are not known are not known.
fn means(x: &[f64], width: usize, every: usize) -> Vec<f64> {
    let blocks = x.chunks_exact(width * every);
    let mean = |block: &[f64], j: usize| {
        let sound = |v: &f64| if v.abs() < LARGEST { *v } else { f64::NAN };
        block[j..].iter().step_by(width).map(sound).sum::<f64>() / every as f64
    };
    blocks
        .flat_map(|block| (0..width).map(move |j| mean(block, j)))
        .collect()
}

/// Whether every column has different values, over the rows that are known whole.
fn moves(columns: &[Vec<f64>], width: usize) -> bool {
    let rows = || {
        let all = columns.iter().flat_map(|c| c.chunks_exact(width));
        all.filter(|row| row.iter().all(|v| v.is_finite()))
    };
    let range = |j: usize| {
        let wide = |(low, high): (f64, f64), row: &[f64]| (low.min(row[j]), high.max(row[j]));
        let (low, high) = rows().fold((f64::INFINITY, f64::NEG_INFINITY), wide);
        high - low
    };
    rows().nth(1).is_some() && (0..width).all(|j| range(j) >= SMALLEST)
}

/// Mean and standard deviation of the values that are known.
fn spread(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let known = values.filter(|v| v.is_finite());
    let n = known.clone().count().max(1) as f64;
    let mean = known.clone().sum::<f64>() / n;
    let power: f64 = known.map(|v| (v - mean).powi(2)).sum();
    (mean, (power / n).sqrt())
}

/// Means of the columns over lags 0 to 3, then ever longer ones, and those of a start from 0.
fn past(u: &[f64], width: usize, longest: usize) -> (Vec<f64>, usize) {
    let mut lags = vec![0, 1, 2, 3, 4];
    while lags[lags.len() - 1] < longest {
        lags.push((WIDER * lags[lags.len() - 1] as f64).ceil() as usize);
    }
    let n = u.len() / width;
    // an input that was 0 before, for a plant that did not stand still under the first one
    let sums = |j: usize| {
        let mut sum = 0.0;
        let value = move |k: usize| {
            if j < width {
                u[k * width + j] - u[j]
            } else {
                1.0
            }
        };
        let next = (0..n).map(move |k| {
            sum += value(k);
            sum
        });
        std::iter::once(0.0).chain(next).collect::<Vec<f64>>()
    };
    let sums: Vec<_> = (0..=width).map(sums).collect();
    let columns = (lags.len() - 1) * (width + 1);
    let mut found = Vec::with_capacity(n * columns);
    for k in 1..=n {
        for pair in lags.windows(2) {
            let [from, to] = [pair[0], pair[1]].map(|lag| k.saturating_sub(lag));
            let length = (pair[1] - pair[0]) as f64;
            found.extend(sums.iter().map(|sum| (sum[from] - sum[to]) / length));
        }
    }
    (found, columns)
}

/// Changes over `span` rows; those of the first ones are not known.
fn change(x: &[f64], width: usize, span: usize) -> impl Iterator<Item = f64> {
    let before = std::iter::repeat_n(f64::NAN, span * width).chain(x.iter().copied());
    x.iter().zip(before).map(|(x, before)| x - before)
}

/// Changes of the pasts of all powers of the inputs, of deviation 1, row by row, and their number.
fn columns(us: &[Vec<f64>], channels: usize, powers: i32, span: usize) -> (Vec<f64>, usize) {
    let longest = us.iter().map(|u| u.len() / channels).max().unwrap_or(0) / 8;
    let mut found = Vec::new();
    let mut width = 0;
    for u in us {
        let powered: Vec<f64> = u
            .chunks_exact(channels)
            .flat_map(|row| (1..=powers).flat_map(move |p| row.iter().map(move |u| u.powi(p))))
            .collect();
        let (x, columns) = past(&powered, channels * powers as usize, longest);
        width = columns;
        let known = change(&x, columns, span).map(|v| if v.is_finite() { v } else { 0.0 });
        found.extend(known);
    }
    let n = found.len() / width;
    for j in 0..width {
        let column = found.iter().skip(j).step_by(width).copied();
        let (_, deviation) = spread(column);
        (0..n).for_each(|k| found[k * width + j] /= deviation + 1e-12);
    }
    (found, width)
}

/// A change with its sum of squares, and what it says of the output before and after it.
struct Found {
    experiment: usize,
    start: usize,
    gain: f64,
    shift: isize,
    error: f64,
    before: Vec<f64>,
    after: Vec<f64>,
}

/// Changes of what the inputs were, and of the output, over `span` rows of each experiment: neither a level nor a slow drift is a
/// relation of the two.
struct Rows {
    us: Vec<Vec<f64>>,
    channels: usize,
    /// The outputs, of deviation 1, and their changes.
    ys: Vec<Vec<f64>>,
    y: Vec<f64>,
    x: Vec<f64>,
    width: usize,
    /// Where each experiment begins, and the last one ends.
    edges: Vec<usize>,
    span: usize,
    /// Whether it is a part of an experiment, whose own past is not known whole.
    is_part: bool,
}

/// Rows before a place and of other experiments, and those after it.
type Sides = (Vec<bool>, Vec<bool>);

impl Rows {
    fn new(
        mut us: Vec<Vec<f64>>,
        ys: &[Vec<f64>],
        channels: usize,
        span: usize,
        is_part: bool,
    ) -> Self {
        for j in 0..channels {
            let column = us.iter().flat_map(|u| u.iter().skip(j).step_by(channels));
            let (mean, deviation) = spread(column.copied());
            let all = us.iter_mut();
            let column = all.flat_map(|u| u.iter_mut().skip(j).step_by(channels));
            column.for_each(|u| *u = (*u - mean) / deviation);
        }
        let (_, deviation) = spread(ys.iter().flatten().copied());
        let scaled = |y: &Vec<f64>| y.iter().map(|y| y / deviation).collect();
        let ys: Vec<Vec<f64>> = ys.iter().map(scaled).collect();
        let y = ys.iter().flat_map(|y| change(y, 1, span)).collect();
        let mut edges = vec![0];
        edges.extend(ys.iter().scan(0, |end, y| {
            *end += y.len();
            Some(*end)
        }));
        let (x, width) = columns(&us, channels, 1, span);
        Self {
            us,
            channels,
            ys,
            y,
            x,
            width,
            edges,
            span,
            is_part,
        }
    }

    /// The change that explains most, if it is one, and the share of the error that it leaves.
    fn change(&self, monitor: &Monitor) -> Result<Option<(Found, f64)>> {
        let known = self.y.iter().filter(|y| y.is_finite()).count();
        if known < ROWS_PER_COLUMN * self.width {
            return Ok(None);
        }
        let mut best: Option<Found> = None;
        for (experiment, start) in self.places() {
            if monitor.stopped() {
                return Err(stopped());
            }
            let found = self.at(experiment, start, true);
            let better = |found: &Found| best.as_ref().is_none_or(|b| found.error < b.error);
            if let Some(found) = found.filter(better) {
                best = Some(found);
            }
        }
        let Some(mut best) = best else {
            return Ok(None);
        };
        for _ in 0..ROUNDS {
            best = self
                .at(best.experiment, self.sharper(&best), false)
                .unwrap_or(best);
        }
        let (before, after) = self.sides(best.experiment, best.start);
        let (x, width) = columns(&self.us, self.channels, CURVED, self.span);
        let curved = Pair::new(&x, width, &self.y, &before, &after).one();
        // an output that goes on as before, while its input is larger by what the gain is smaller, has seen no other input, unless a
        // curve explains it better
        let growth = self.growth(&before, &after);
        let is_same = |ratio: f64| (ratio - 1.0).abs() < NOTED;
        let goes_on = is_same(best.gain * growth);
        let other = if goes_on && EXPLAINED * EXPLAINED * best.error <= curved {
            Pair::new(&self.x, self.width, &self.y, &before, &after).one()
        } else {
            curved
        };
        let left = (best.error / other.max(1e-300)).sqrt();
        let own = |value: fn(f64, f64) -> f64| {
            let pairs = self.y.iter().zip(&best.after).zip(&after);
            let values = pairs.filter(|(_, is_own)| **is_own);
            spread(values.map(move |((y, fit), _)| value(*y, *fit))).1
        };
        let follows = own(|y, fit| y - fit) <= EXPLAINED * own(|y, _| y);
        // in a part it is one if a column goes on as before; where both change, the plant may be no line
        let is_inner = self.inner(best.experiment).contains(&best.start)
            && (!self.is_part || goes_on || is_same(growth));
        let is_other = is_inner && (best.shift != 0 || (best.gain - 1.0).abs() > NOTED);
        // an output that answers nothing any more has nothing to follow
        let is_change = left <= EXPLAINED && is_other && (follows || best.gain.abs() < NOTED);
        if !is_change {
            return Ok(None);
        }
        let unchanged = self.unchanged(&before, &after, monitor)?;
        let left = left.max((best.error / unchanged.max(1e-300)).sqrt());
        Ok((left <= EXPLAINED).then_some((best, left)))
    }

    /// The sum of squares that the best linear plant leaves of these rows in free run; infinite without one.
    fn unchanged(&self, before: &[bool], after: &[bool], monitor: &Monitor) -> Result<f64> {
        let pairs = || self.us.iter().zip(&self.ys);
        let is_measured = |y: &[f64]| y.iter().any(|y| y.is_finite());
        let records: Result<Vec<_>> = pairs()
            .filter(|(_, y)| is_measured(y))
            .map(|(u, y)| Record::with_gaps(u, self.channels, y))
            .collect();
        let records = records?;
        let left = |order: usize| -> Result<f64> {
            let fit = iv::fit(&records, order, order + 1, 0, true, ITERATIONS, monitor)?;
            let mut states = fit.initial_states.iter();
            let mut errors = Vec::with_capacity(self.y.len());
            for (u, y) in pairs() {
                // rows of an experiment without outputs are in neither part
                let state = is_measured(y).then(|| states.next()).flatten();
                let Some(state) = state else {
                    errors.extend(y);
                    continue;
                };
                let run = fit.model.simulate(u, self.channels, state)?;
                let error: Vec<f64> = y.iter().zip(run).map(|(y, run)| y - run).collect();
                errors.extend(change(&error, 1, self.span));
            }
            let own = errors.iter().zip(before.iter().zip(after));
            let own = own.filter(|(_, (before, after))| **before || **after);
            Ok(own.map(|(error, _)| error * error).sum())
        };
        let mut least = f64::INFINITY;
        for order in ORDERS {
            least = least.min(left(order).unwrap_or(f64::INFINITY));
            if monitor.stopped() {
                return Err(stopped());
            }
        }
        Ok(least)
    }

    /// By how much the input is larger after a change; NaN for several inputs.
    fn growth(&self, before: &[bool], after: &[bool]) -> f64 {
        if self.channels > 1 {
            return f64::NAN;
        }
        let of = |rows: &[bool]| {
            let all = self.us.iter().flatten().zip(rows);
            spread(all.filter(|(_, is_own)| **is_own).map(|(u, _)| *u)).1
        };
        of(after) / of(before)
    }

    /// Where a change may be: in each experiment, and between several.
    fn places(&self) -> impl Iterator<Item = (usize, usize)> {
        let first = usize::from(self.edges.len() == 2);
        self.edges
            .windows(2)
            .enumerate()
            .flat_map(move |(i, edge)| {
                let (a, b) = (edge[0], edge[1]);
                (first..PARTS).map(move |k| (i, a + k * (b - a) / PARTS))
            })
            .filter(|(i, start)| self.inner(*i).contains(start))
    }

    /// The rows of an experiment at which a change is believed: of a part that others overlap by half those in its middle, as a few
    /// moves at an end fit any scale.
    fn inner(&self, experiment: usize) -> Range<usize> {
        let own = self.own(experiment);
        let end = if self.is_part { own.len() / 4 } else { 0 };
        own.start + end..own.end - end + 1
    }

    fn own(&self, experiment: usize) -> Range<usize> {
        self.edges[experiment]..self.edges[experiment + 1]
    }

    /// The rows before `start` and of other experiments, and those after; none that may have a share of both parts.
    fn sides(&self, experiment: usize, start: usize) -> Sides {
        let own = self.own(experiment);
        let known = |k: usize| self.y[k].is_finite();
        let before = |k: usize| known(k) && !(own.contains(&k) && k + self.span >= start);
        let after = |k: usize| known(k) && own.contains(&k) && k >= start + self.span;
        let all = 0..self.y.len();
        (all.clone().map(before).collect(), all.map(after).collect())
    }

    /// The change from `start` on that explains most; with `worth`, only where one can.
    fn at(&self, experiment: usize, start: usize, worth: bool) -> Option<Found> {
        let (before, after) = self.sides(experiment, start);
        let own = self.own(experiment);
        let number = |rows: &[bool]| rows.iter().filter(|r| **r).count();
        if number(&before).min(number(&after)) < 2 * self.span {
            return None;
        }
        let n = self.y.len() as f64;
        let pair = Pair::new(&self.x, self.width, &self.y, &before, &after);
        let swapped = pair.swapped();
        let one = pair.one();
        if worth && one < NOTED * NOTED * pair.power().max(NOTED * NOTED * n) {
            return None;
        }
        let most = if worth {
            EXPLAINED * EXPLAINED * one
        } else {
            f64::INFINITY
        };
        let apart = [pair.alone(), swapped.alone()];
        let mut found = Vec::new();
        if apart[0] + apart[1] <= most {
            let (gain, error, [before, after]) = pair.scaled(&self.x);
            found.push(Found {
                experiment,
                start,
                gain,
                shift: 0,
                error,
                before,
                after,
            });
        }
        // rows that were lost are in the future of one part: each is fitted, and the other found along that fit
        for is_late in [false, true] {
            let no_shift = self.is_part || (is_late && self.edges.len() > 2);
            if no_shift || apart[usize::from(is_late)] > most {
                continue;
            }
            let (rest, others) = if is_late {
                (&swapped, &before)
            } else {
                (&pair, &after)
            };
            // a short part fits anything
            if number(others) as f64 > (1.0 - 1.0 / FARTHEST as f64) * n {
                continue;
            }
            // where rows of the input were lost, its past ends
            let part = if is_late {
                own.start..start
            } else {
                start..own.end
            };
            let Some((error, shift, fit, moved)) =
                self.moved(rest, others, part, own.len() / FARTHEST)
            else {
                continue;
            };
            let (shift, before, after) = if is_late {
                (-shift, moved, fit)
            } else {
                (shift, fit, moved)
            };
            found.push(Found {
                experiment,
                start,
                gain: 1.0,
                shift,
                error,
                before,
                after,
            });
        }
        let weighed = |f: &Found| f.error * if f.shift == 0 { 1.0 } else { TIES * TIES };
        found
            .into_iter()
            .min_by(|a, b| weighed(a).total_cmp(&weighed(b)))
    }

    /// The shift with which the fit of the rest follows the others best: its error, the fit, and the fit moved by it.
    fn moved(
        &self,
        rest: &Pair,
        others: &[bool],
        own: Range<usize>,
        farthest: usize,
    ) -> Option<(f64, isize, Vec<f64>, Vec<f64>)> {
        let counts: Vec<f64> = others[own.clone()]
            .iter()
            .map(|c| f64::from(u8::from(*c)))
            .collect();
        let total: f64 = counts.iter().sum();
        let fit = rest.fit(&self.x);
        let f = &fit[own.clone()];
        let values = self.y[own.clone()].iter().zip(&counts);
        let y: Vec<f64> = values
            .map(|(y, c)| if *c > 0.0 { *y } else { 0.0 })
            .collect();
        let n = f.len();
        let far = (total as usize / 2).min(farthest) as isize;
        // sums over the rows that both have, for each shift
        let size = (2 * n).next_power_of_two();
        let squares = |x: &[f64]| x.iter().map(|x| x * x).collect::<Vec<_>>();
        let of_y = [&counts, &y, &squares(&y)].map(|v| spectrum(v, size));
        let of_fit = [&vec![1.0; n], &f.to_vec(), &squares(f)].map(|v| spectrum(v, size));
        let [count, sy, syy, sf, sff, syf] = [(0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (1, 1)]
            .map(|(i, j)| correlation(&of_y[i], &of_fit[j]));
        let at = |shift: isize| shift.rem_euclid(size as isize) as usize;
        let error = |shift: isize| {
            let i = at(shift);
            let both = count[i].max(1.0);
            let left = syy[i] - 2.0 * syf[i] + sff[i] - (sy[i] - sf[i]).powi(2) / both;
            if both < 0.5 * total {
                f64::INFINITY
            } else {
                left.max(0.0) * total / both
            }
        };
        let shifts = (0..=far).chain(-far..0);
        let (least, shift) = shifts
            .map(|shift| (error(shift), shift))
            .min_by(|a, b| a.0.total_cmp(&b.0))?;
        // if an end of the search does about as well, no shift is determined: a slow answer to one step goes on as it began
        let end = error(far).min(error(-far));
        if rest.alone() + end <= TIES * TIES * (rest.alone() + least) {
            return None;
        }
        let i = at(shift);
        let level = (sy[i] - sf[i]) / count[i].max(1.0);
        let from = |k: usize| (k as isize + shift).clamp(0, fit.len() as isize - 1) as usize;
        let is_lost = |k: usize| {
            let from = k as isize + shift;
            own.contains(&k) && !(own.start as isize..own.end as isize).contains(&from)
        };
        let moved = (0..fit.len()).map(|k| {
            if is_lost(k) {
                f64::NAN
            } else {
                fit[from(k)] + level
            }
        });
        let moved = moved.collect();
        Some((rest.alone() + least, shift, fit, moved))
    }

    /// From where on what explains the later rows is better than what explains the others.
    fn sharper(&self, found: &Found) -> usize {
        let own = self.own(found.experiment);
        // the answers to inputs that were lost are explained by neither
        if found.start == own.start || found.shift < 0 {
            return found.start;
        }
        let better = |k: usize| {
            let [before, after] = [&found.before, &found.after].map(|f| (self.y[k] - f[k]).powi(2));
            let by = after - before;
            if by.is_finite() { by } else { 0.0 }
        };
        let mut sum = 0.0;
        let total = own.clone().map(|k| {
            sum += better(k);
            (sum, k)
        });
        let inner = total
            .skip(self.span)
            .take(own.len().saturating_sub(2 * self.span));
        // of equal ones the first
        let most = inner.fold(None, |most: Option<(f64, usize)>, next| match most {
            Some(most) if most.0 >= next.0 => Some(most),
            _ => Some(next),
        });
        most.map_or(found.start, |(_, k)| k + 1)
    }
}
