//! Stretches in which a sensor says nothing: it died, or a few samples stand out.
//!
//! A dead sensor keeps one value to the last bit, though elsewhere it never does for more than a few samples, or a linear model of the rest,
//! whose output is limited to the recorded range, moves; the input has the levels there at which the output moves elsewhere, so that friction
//! or a dead zone is no explanation; and a limit of the output was not reached by motion, so that a saturation or an end stop is none either.
//!
//! Values that stand out are a few samples, far from those before and after, with more power than all of the output but other such values.

use std::cmp::Reverse;

use nalgebra::DVector;

use crate::column::{LARGEST, Rows, median, quantile, range, runs, scale_of};
use crate::data::Samples;
use crate::regression::{solve, triangle};

/// Samples at either side that do not count for a level, before which an input's blow is answered, and a quarter of the least number.
const PAST: usize = 10;
/// Past outputs and inputs of the model of the rest.
const ORDER: usize = 4;
/// Least part of its experiment for a dead stretch, and most stretches that are examined.
const LEAST_PART: f64 = 0.01;
const MOST_STILL: usize = 20;
/// Least number of windows of the rest with which a stretch is compared.
const WINDOWS: usize = 8;
/// Ratio of squared errors, in the stretch to the worst window of the rest. Of 2,400 sound records of `tests/dataset/test_faults.py` the
/// worst has 4.5 (a saturation), of 766 dead sensors the least 20.
const APART: f64 = 10.0;
/// Singular values below this part of the largest count as 0.
const DEPENDENT: f64 = 1e-10;

/// First sample and number of samples of every stretch of every experiment in which the output stands still while the rest says that it
/// cannot.
pub fn dead(experiments: &[Samples]) -> Vec<Vec<(usize, usize)>> {
    experiments.iter().map(dead_in).collect()
}

fn dead_in(experiment: &Samples) -> Vec<(usize, usize)> {
    let rows = Rows::of(&experiment.unseen(), LARGEST);
    let y = rows.width() - 1;
    let mut known: Vec<bool> = rows.known().collect();
    let least = f64::max((4 * ORDER) as f64, LEAST_PART * rows.len() as f64);
    let same =
        (1..rows.len()).map(|k| known[k] && known[k - 1] && rows.at(k, y) == rows.at(k - 1, y));
    let mut still = runs(same);
    still.iter_mut().for_each(|(_, count)| *count += 1);
    still.retain(|(_, count)| *count as f64 >= least);
    still.sort_by_key(|(_, count)| Reverse(*count));
    still.truncate(MOST_STILL);
    for (first, count) in &still {
        known[*first..first + count].fill(false);
    }
    if still.is_empty() {
        return still;
    }
    let rest = Rest::of(rows, known);
    still.retain(|(first, count)| rest.as_ref().is_some_and(|r| r.contradicts(*first, *count)));
    still.sort_unstable();
    still
}

/// A linear model of the part of an experiment in which the output moves.
struct Rest {
    rows: Rows,
    y: Vec<f64>,
    theta: DVector<f64>,
    pieces: Vec<(usize, usize)>,
    /// Most samples in which the output keeps its value.
    longest: usize,
}

impl Rest {
    fn of(mut rows: Rows, rest: Vec<bool>) -> Option<Self> {
        let mut pieces = runs(rest);
        pieces.retain(|(_, count)| *count > 4 * ORDER);
        let parts: Vec<Rows> = pieces.iter().map(|(a, n)| rows.part(*a, *n)).collect();
        rows.scale(&scale_of(&parts)?);
        let (width, last) = (rows.width(), rows.width() - 1);
        let places = pieces.iter().flat_map(|(a, n)| a + ORDER..a + n);
        let row = |k: usize| {
            let past: Vec<f64> = (1..=ORDER).map(|i| rows.at(k - i, last)).collect();
            regressors(&rows, k, &past)
                .chain([rows.at(k, last)])
                .collect::<Vec<_>>()
        };
        let columns = ORDER * width + 1;
        let (r, count) = triangle(columns + 1, places.map(row));
        if count < 10 * ORDER * (1 + width) {
            return None;
        }
        let goal = r.column(columns).into_owned();
        let theta = solve(r.columns(0, columns).into_owned(), &goal, DEPENDENT).theta;
        let y: Vec<f64> = rows.column(last).collect();
        let still = |(a, n): &(usize, usize)| {
            let same = y[*a..a + n].windows(2).map(|pair| pair[0] == pair[1]);
            runs(same).into_iter().map(|(_, count)| count).max()
        };
        let longest = 1 + pieces.iter().filter_map(still).max().unwrap_or(0);
        Some(Self {
            rows,
            y,
            theta,
            pieces,
            longest,
        })
    }

    /// Whether the output moves in this stretch, by everything known from the rest.
    fn contradicts(&self, first: usize, count: usize) -> bool {
        if !(self.covers(first, count) && self.jumps(first, count)) {
            return false;
        }
        // the last digits of a noisy sensor stand still only before the machine was switched on
        if first > 0 && self.longest <= ORDER && count as f64 > APART * self.longest as f64 {
            return true;
        }
        let whole: usize = self.pieces.iter().map(|(_, n)| n).sum();
        let length = count.min(whole / WINDOWS);
        if length <= 2 * ORDER {
            return false;
        }
        let windows = |&(a, n): &(usize, usize)| {
            (a..(a + n + 1).saturating_sub(length).max(a)).step_by((length / 2).max(1))
        };
        let others: Vec<usize> = self.pieces.iter().flat_map(windows).collect();
        if others.len() < WINDOWS / 2 {
            return false;
        }
        let error = |start: usize| self.error(start, length);
        let own = (first..first + count + 1 - length)
            .step_by(length)
            .map(error);
        let worst = others.into_iter().map(error).fold(0.0, f64::max);
        median(own.collect()) > APART * worst
    }

    /// Whether an input reaches the levels here that it has while the output moves.
    ///
    /// Friction, a dead zone or a closed valve keep an output still at some levels, but not at the middle half of those at which it moves,
    /// for more than `PAST` samples at either side.
    fn covers(&self, first: usize, count: usize) -> bool {
        (0..self.rows.width() - 1).any(|j| {
            let column: Vec<f64> = self.rows.column(j).collect();
            let rest = self.pieces.iter().flat_map(|(a, n)| &column[*a..a + n]);
            let rest: Vec<f64> = rest.copied().collect();
            let [low, high] = [0.25, 0.75].map(|share| quantile(rest.clone(), share));
            let mut own = column[first..first + count].to_vec();
            own.sort_unstable_by(f64::total_cmp);
            let end = PAST.min(count - 1);
            own[end] <= low && own[count - 1 - end] >= high && own[0] < own[count - 1]
        })
    }

    /// Whether the output can be at no limit: it is inside the range, or reached it at a jump. A saturated output and an end stop are reached
    /// by motion.
    fn jumps(&self, first: usize, count: usize) -> bool {
        let (y, value) = (&self.y, self.y[first]);
        let (low, high) = self.span();
        if low < value && value < high {
            return true;
        }
        let ends = [first, first + count]
            .into_iter()
            .filter(|k| 0 < *k && *k < y.len());
        let largest = ends.map(|k| (y[k] - y[k - 1]).abs()).fold(0.0, f64::max);
        let changes = self
            .pieces
            .iter()
            .flat_map(|(a, n)| y[*a..a + n].windows(2));
        largest
            > changes
                .map(|pair| (pair[1] - pair[0]).abs())
                .fold(0.0, f64::max)
    }

    fn span(&self) -> (f64, f64) {
        range(self.y.iter().copied())
    }

    /// Mean square error of a free run from the measured start of a window.
    fn error(&self, start: usize, length: usize) -> f64 {
        let (low, high) = self.span();
        let mut past: Vec<f64> = self.y[start..start + ORDER].iter().rev().copied().collect();
        let mut total = 0.0;
        for k in start + ORDER..start + length {
            let row = regressors(&self.rows, k, &past);
            let y: f64 = row.zip(self.theta.iter()).map(|(x, t)| x * t).sum();
            let y = y.clamp(low, high);
            total += (self.y[k] - y).powi(2);
            past.rotate_right(1);
            past[0] = y;
        }
        total / (length - ORDER) as f64
    }
}

/// Past outputs, past values of every input, and a constant.
fn regressors<'a>(rows: &'a Rows, k: usize, past: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
    let lags = (0..rows.width() - 1).flat_map(|j| (1..=ORDER).map(move |i| (j, i)));
    let inputs = lags.map(move |(j, i)| rows.at(k - i, j));
    past.iter().copied().chain(inputs).chain([1.0])
}

/// Most samples in a row that are a spike and no motion, and most spikes of an experiment that are looked for.
const SPIKE: usize = 3;
const SPIKES: usize = 20;

/// A stretch, its power and that of all others.
#[derive(Clone, Copy)]
struct Stretch {
    first: usize,
    count: usize,
    inside: f64,
    rest: f64,
}

/// First sample and number of samples of short stretches of every experiment's output that have most of its power, while no input stands
/// out: the farthest first.
pub fn spikes(experiments: &[Samples]) -> Vec<Vec<(usize, usize)>> {
    let of = |s: &Samples| {
        let rows = Rows::of(&s.unseen(), LARGEST);
        let y = rows.width() - 1;
        // an input moves at nothing else than its blows, an output has noise
        let blows = |j: usize| most(standing_out(rows.column(j).collect()), -1.0);
        let blows: Vec<usize> = (0..y).flat_map(blows).map(|s| s.first).collect();
        let mut found = standing_out(rows.column(y).collect());
        // the answer to a blow on the input is no spike
        let answers = |s: &Stretch| {
            let before = s.first.saturating_sub(PAST)..s.first + s.count;
            blows.iter().any(|blow| before.contains(blow))
        };
        if let Some(end) = found.iter().position(answers) {
            found.truncate(end);
        }
        most(found, 0.0)
            .iter()
            .map(|s| (s.first, s.count))
            .collect()
    };
    experiments.iter().map(of).collect()
}

/// These stretches, up to the last one with more power than all that is left, which is more than `least`; a single one may be all that moves.
///
/// Several spikes of one size have no more power than the rest together with the others.
fn most(mut found: Vec<Stretch>, least: f64) -> Vec<Stretch> {
    let outweighs = |i: usize| found[i].inside > found[i].rest && (found[i].rest > least || i == 0);
    let count = (0..found.len())
        .rev()
        .find(|i| outweighs(*i))
        .map_or(0, |i| i + 1);
    found.truncate(count);
    found
}

/// The farthest stretch, the farthest of the rest, and so on.
fn standing_out(mut column: Vec<f64>) -> Vec<Stretch> {
    let mut found = Vec::new();
    while found.len() < SPIKES
        && let Some(stretch) = farthest(&column)
    {
        column[stretch.first..stretch.first + stretch.count].fill(f64::NAN);
        found.push(stretch);
    }
    found
}

/// `SPIKE` samples or fewer about the farthest value; none if the column does not come back within them.
fn farthest(column: &[f64]) -> Option<Stretch> {
    let known: Vec<f64> = column.iter().copied().filter(|v| v.is_finite()).collect();
    if known.len() < 4 * PAST {
        return None;
    }
    let middle = median(known);
    let apart: Vec<f64> = column.iter().map(|v| (v - middle).abs()).collect();
    let known = |k: &usize| !apart[*k].is_nan();
    let last_to_first = (0..apart.len()).rev().filter(known);
    let k = last_to_first.max_by(|a, b| apart[*a].total_cmp(&apart[*b]))?;
    let most = apart[k];
    if most == 0.0 {
        return None;
    }
    let is_far = |v: &&f64| **v > 0.5 * most;
    let first = k - apart[..k].iter().rev().take_while(is_far).count();
    let last = k + apart[k..].iter().take_while(is_far).count();
    // away and back: a step that settles in a sample begins or ends elsewhere
    if last - first > SPIKE || first == 0 || last == column.len() {
        return None;
    }
    let comes_back = (column[first - 1] - column[last]).abs() < 0.5 * most;
    let power = |of: &[f64]| -> f64 {
        let known = of.iter().filter(|v| !v.is_nan());
        known.map(|v| (v / most).powi(2)).sum()
    };
    comes_back.then(|| Stretch {
        first,
        count: last - first,
        inside: power(&apart[first..last]),
        rest: power(&apart[..first]) + power(&apart[last..]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Held levels, and the noisy output of a lag of the first order.
    fn recorded(noise: f64) -> (Vec<f64>, Vec<f64>) {
        let (mut random, mut x, mut level) = (Random::new(6), 0.0, 0.0);
        let (mut u, mut y) = (Vec::new(), Vec::new());
        for k in 0..3000 {
            if k % 15 == 0 {
                level = random.normal();
            }
            u.push(level);
            y.push(x + noise * random.normal());
            x = 0.9 * x + 0.1 * level;
        }
        (u, y)
    }

    fn samples<'a>(u: &'a [f64], y: &'a [f64]) -> [Samples<'a>; 1] {
        [Samples::new(u, 1, y).unwrap()]
    }

    #[test]
    fn a_sensor_that_died_is_told_from_one_at_rest() {
        for noise in [0.0, 0.01] {
            let (u, mut y) = recorded(noise);
            assert_eq!(dead(&samples(&u, &y)), [[]]);
            let value = y[1500];
            y[1500..1700].fill(value);
            assert_eq!(dead(&samples(&u, &y)), [[(1500, 200)]]);
            // the plant may well rest where the input does
            let mut held = u.clone();
            held[1500..1700].fill(-4.0);
            assert_eq!(dead(&samples(&held, &y)), [[]]);
        }
    }

    #[test]
    fn spikes_stand_out_and_blows_do_not() {
        let (u, mut y) = recorded(0.01);
        assert_eq!(spikes(&samples(&u, &y)), [[]]);
        (y[700], y[701], y[2000]) = (1e3, 900.0, -500.0);
        assert_eq!(spikes(&samples(&u, &y)), [[(700, 2), (2000, 1)]]);
        let mut blow = u.clone();
        (blow[697], blow[1995]) = (1e4, 1e4);
        assert_eq!(spikes(&samples(&blow, &y)), [[]]);
        let ramp: Vec<f64> = (0..3000).map(f64::from).collect();
        assert_eq!(spikes(&samples(&u, &ramp)), [[]]);
    }
}
