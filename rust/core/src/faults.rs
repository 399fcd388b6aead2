//! Columns that are no input and output of a plant: one is computed from the other, they are exchanged, or one was logged late.
//!
//! All tests compare a record with itself and take its side in doubt; columns are compared about their mean, in units of their deviation.
//! The order in time: the past of a cause helps to predict its effect beyond the effect's own past, and not the other way (Granger,
//! *Econometrica* 37, 1969).

use nalgebra::DMatrix;

use crate::column::{
    LARGEST, Rows, SMALLEST, distinct, moments, quantum, range, scale_of, stretches,
};
use crate::data::Samples;
use crate::regression::{solve, triangle};
use crate::{Monitor, Record};

/// Past outputs and inputs in the regressions, and largest lead in samples.
const PAST: usize = 10;
/// Most samples that a regression uses.
const MOST: usize = 20_000;
/// Twice the log-likelihood that a cause must add. By chance the 10 coefficients of a lead add 10, and 60 in one of 3e8 records.
const SURE: f64 = 60.0;
/// Parts of a record of which the loudest does not count. In 3 of 100 records of `end_stop` in `tests/dataset/test_faults.py` one bump
/// said 65 to 189 for a late input, the other parts below 0.
const PARTS: usize = 8;
/// Means of an input over 10, 20, 40 .. samples before these: plants with long dead times.
const OCTAVES: usize = 6;
/// Powers of the inputs of which an output is a curve.
const POWERS: usize = 3;
/// Singular values below this part of the largest count as 0.
const DEPENDENT: f64 = 1e-10;

/// The output is `gain` times the input `delay` samples before, plus `offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Copy {
    /// Number of the input.
    pub input: usize,
    /// Factor.
    pub gain: f64,
    /// Summand.
    pub offset: f64,
    /// Samples.
    pub delay: usize,
}

/// An input that the output repeats to rounding, up to ten samples later.
pub fn copied(experiments: &[Samples]) -> Option<Copy> {
    let of = |s: &Samples| Rows::of(&s.unseen(), LARGEST);
    let rows: Vec<Rows> = experiments.iter().map(of).collect();
    let channels = rows.first()?.width() - 1;
    let places = (0..channels).flat_map(|j| (0..=PAST).map(move |delay| (j, delay)));
    places
        .into_iter()
        .find_map(|(j, delay)| copy_of(&rows, j, delay))
}

fn copy_of(rows: &[Rows], j: usize, delay: usize) -> Option<Copy> {
    let pairs = rows.iter().flat_map(|r| {
        let y = r.column(r.width() - 1).skip(delay);
        r.column(j).zip(y)
    });
    let (u, y): (Vec<f64>, Vec<f64>) = pairs
        .filter(|(u, y)| u.is_finite() && y.is_finite())
        .unzip();
    let head = |v: &[f64]| v[..v.len().min(MOST)].to_vec();
    // a few steps between two levels, later, are those of any plant that settles in a sample
    let steps = || u.windows(2).filter(|pair| pair[0] != pair[1]).count();
    let is_binary = || delay > 0 && steps() < PAST && distinct(head(&u)).len() < 3;
    if y.len() < 4 * PAST || is_binary() {
        return None;
    }
    // most records show in their beginning that this is none
    of_line(&head(&u), &head(&y))?;
    let moves = |v: &[f64]| {
        let (low, high) = range(v.iter().copied());
        high - low >= SMALLEST
    };
    if !moves(&u) || !moves(&y) {
        return None;
    }
    let covariance = of_line(&u, &y)?;
    let ((u_mean, u_size), (y_mean, _)) = (whole(&u), whole(&y));
    let gain = covariance / (u_size * u_size);
    let offset = y_mean - gain * u_mean;
    let rounding = rounding(&y) + gain.abs() * rounding(&u);
    let off = u.iter().zip(&y).map(|(u, y)| (y - gain * u - offset).abs());
    // the line of least squares is off the true one by a rounding as well
    (off.fold(0.0, f64::max) <= 2.0 * rounding).then_some(Copy {
        input: j,
        gain,
        offset,
        delay,
    })
}

fn whole(column: &[f64]) -> (f64, f64) {
    moments(column.iter().copied())
}

/// The covariance of two columns that lie on a line; none if they do not.
fn of_line(u: &[f64], y: &[f64]) -> Option<f64> {
    let ((u_mean, u_size), (y_mean, y_size)) = (whole(u), whole(y));
    let products = u.iter().zip(y).map(|(u, y)| (u - u_mean) * (y - y_mean));
    let covariance = products.sum::<f64>() / u.len() as f64;
    (covariance.abs() >= 0.999 * (u_size * y_size)).then_some(covariance)
}

/// Half of a step: of the grid of the values or of the digits that were printed, or of six digits where neither is seen or both are so
/// coarse that their steps are levels.
fn rounding(column: &[f64]) -> f64 {
    let steps = [quantum(column), printed(column)].into_iter().flatten();
    let fine = steps.filter(|step| *step < 0.02 * whole(column).1);
    let (low, high) = range(column.iter().copied());
    fine.reduce(f64::max)
        .map_or(0.5e-5 * (high - low), |step| 0.5 * step)
}

/// The power of ten of the last digit that the values have, of six in their range.
fn printed(column: &[f64]) -> Option<f64> {
    let known = || column.iter().copied().filter(|v| v.is_finite());
    let (low, high) = range(known());
    let first = (high - low).log10().floor();
    let is_multiple = |v: f64, step: f64| {
        let places = v / step;
        (places - places.round()).abs() < 1e-9 * places.abs().max(1.0)
    };
    let steps = (0..6).map(|digit| 10.0_f64.powf(first - f64::from(digit)));
    { steps }.find(|step| known().all(|v| is_multiple(v, *step)))
}

/// Known stretches of the longest experiments, at most [`MOST`] samples, every column scaled.
fn pieces(experiments: &[Samples]) -> Vec<Rows> {
    let records: Vec<Record> = experiments.iter().map(Samples::unseen).collect();
    let (mut found, mut left) = (Vec::new(), MOST);
    for stretch in stretches(&records, LARGEST) {
        let count = stretch.len().min(left);
        if count > 4 * PAST {
            found.push(stretch.part(0, count));
            left -= count;
        }
    }
    let Some(scale) = scale_of(&found) else {
        return Vec::new();
    };
    found.iter_mut().for_each(|p| p.scale(&scale));
    found
}

/// What of the output is a sum of inputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sum {
    /// The output itself.
    Output,
    /// Its change.
    Change,
    /// The output itself, of powers of the inputs in the same sample.
    Curve,
}

/// Whether the output, or its change, is a sum of inputs in the same sample and in some before, or the output a curve of them, to rounding.
///
/// A simulation without noise answers one sample later, and a plant has a memory of its own.
pub fn computed(experiments: &[Samples]) -> Option<Sum> {
    let pieces = pieces(experiments);
    let channels = pieces.first()?.width() - 1;
    if pieces.iter().map(Rows::len).sum::<usize>() < 10 * PAST * (1 + channels) {
        return None;
    }
    // u(k) of every input, u(k-1) .., 1; then y(k) and its change
    let inputs = (1 + PAST) * channels;
    let row = |p: &Rows, k: usize, c: usize| match c.checked_sub(inputs) {
        None => p.at(k - c / channels, c % channels),
        Some(0) => 1.0,
        Some(1) => p.at(k, channels),
        Some(_) => p.at(k, channels) - p.at(k - 1, channels),
    };
    let at: Vec<(&Rows, usize)> = pieces
        .iter()
        .flat_map(|p| (PAST..p.len()).map(move |k| (p, k)))
        .collect();
    let all = DMatrix::from_fn(at.len(), inputs + 3, |i, c| row(at[i].0, at[i].1, c));
    // any response fits a few moves
    let moved = |i: &usize| (0..channels).any(|c| all[(*i, c)] != all[(*i - 1, c)]);
    if (1..at.len()).filter(moved).count() < 2 * PAST {
        return None;
    }
    let column = |c: usize| all.as_slice()[c * at.len()..][..at.len()].iter().copied();
    let span = |c: usize| {
        let (low, high) = range(column(c));
        high - low
    };
    let y: Vec<f64> = column(inputs + 1).collect();
    let roundings = [0.5e-5 * span(inputs + 1), rounding(&y)];
    let r = triangle_of(&all);
    let is_exact = |target: usize, first: usize| {
        let used = inputs + 1 - first;
        let goal = r.column(target).into_owned();
        let theta = solve(r.columns(first, used).into_owned(), &goal, DEPENDENT).theta;
        let of_u: f64 = (first..inputs)
            .map(|c| theta[c - first].abs() * 0.5e-5 * span(c))
            .sum();
        let size = moments(column(target)).1;
        let allowed = roundings.map(|r| 2.0 * r + of_u);
        let allowed = allowed
            .into_iter()
            .filter(|v| *v < 0.02 * size)
            .fold(0.0, f64::max);
        (all.column(target) - all.columns(first, used) * theta).amax() <= allowed
    };
    let found = [(Sum::Output, inputs + 1), (Sum::Change, inputs + 2)];
    let mut found = found.into_iter();
    found
        .find(|(_, target)| is_exact(*target, 0) && !is_exact(*target, channels))
        .map(|(sum, _)| sum)
        .or_else(|| is_curve(&pieces, &y).then_some(Sum::Curve))
}

/// Whether the output is a polynomial of the inputs of the same sample, to rounding.
fn is_curve(pieces: &[Rows], y: &[f64]) -> bool {
    let channels = pieces[0].width() - 1;
    let used = channels * POWERS + 1;
    let rows = pieces
        .iter()
        .flat_map(|p| (PAST..p.len()).map(move |k| (p, k)));
    let u: Vec<f64> = rows
        .flat_map(|(p, k)| {
            let powers = (1..=POWERS as i32).flat_map(move |i| (0..channels).map(move |j| (i, j)));
            { powers }.map(move |(i, j)| p.at(k, j).powi(i))
        })
        .collect();
    let value = |i: usize, c: usize| match c {
        c if c < used - 1 => u[i * (used - 1) + c],
        c if c < used => 1.0,
        _ => y[i],
    };
    let all = DMatrix::from_fn(y.len(), used + 1, value);
    let r = triangle_of(&all);
    let goal = r.column(used).into_owned();
    let theta = solve(r.columns(0, used).into_owned(), &goal, DEPENDENT).theta;
    let of_u = |c: usize| {
        let (low, high) = range(all.column(c).iter().copied());
        theta[c].abs() * 0.5e-5 * (high - low)
    };
    let allowed = 2.0 * rounding(y) + (0..used - 1).map(of_u).sum::<f64>();
    (all.column(used) - all.columns(0, used) * theta).amax() <= allowed
}

fn triangle_of(all: &DMatrix<f64>) -> DMatrix<f64> {
    let rows = (0..all.nrows()).map(|i| (0..all.ncols()).map(move |j| all[(i, j)]));
    triangle(all.ncols(), rows).0
}

/// How two signals are out of order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The input answers the output.
    Exchanged,
    /// The input was logged late.
    Late,
    /// The output moves in the sample in which the input does.
    AtOnce,
}

/// Which of two signals moves first. An input that was logged late moves one sample before the output if it is read `shift` samples
/// earlier; `evidence` is twice the log-likelihood that shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Order {
    /// How.
    pub kind: Kind,
    /// Number of the input.
    pub input: usize,
    /// Samples.
    pub shift: usize,
    /// Twice a log-likelihood.
    pub evidence: f64,
}

/// Whether an input moves after the output that it should drive; none if no input does.
///
/// An input that keeps its value to the last bit for most samples is no answer to a noisy output: if the output moves before it, it was
/// logged late. Other late inputs look like those that a controller computed, so only exchanged columns are found: the past of the output
/// predicts the input, and the past of the input says nothing about the output.
pub fn order_in_time(experiments: &[Samples], monitor: &Monitor) -> Option<Order> {
    let pieces = pieces(experiments);
    let channels = pieces.first()?.width() - 1;
    if pieces.iter().map(Rows::len).sum::<usize>() < 10 * PAST * (2 + channels) {
        return None;
    }
    (0..channels)
        .take_while(|_| !monitor.stopped())
        .find_map(|j| {
            if is_held(&pieces, j) {
                late(&pieces, j)
            } else {
                exchanged(&pieces, j)
            }
        })
}

fn is_held(pieces: &[Rows], j: usize) -> bool {
    let still = |j: usize| {
        let pairs = pieces
            .iter()
            .flat_map(move |p| p.column(j).zip(p.column(j).skip(1)));
        pairs.filter(|(a, b)| a == b).count()
    };
    let count: usize = pieces.iter().map(|p| p.len() - 1).sum();
    2 * still(j) > count && 2 * (count - still(pieces[0].width() - 1)) > count
}

/// How much `more` columns say of column `of`, beyond the past of the columns `past`: twice the log-likelihood that each of them and those
/// behind it add together; and without the part of the record that says most, as one bump into an end stop can look like anything.
///
/// The `more` columns stand beside the rows `PAST` to `-PAST` of all pieces.
fn evidence(pieces: &[Rows], of: usize, past: &[usize], more: &[Vec<f64>]) -> (Vec<f64>, Vec<f64>) {
    let y = beside(pieces, of, 0);
    let lags = past.iter().flat_map(|c| (1..=PAST).map(move |i| (*c, i)));
    let mut columns: Vec<Vec<f64>> = lags
        .map(|(c, i)| beside(pieces, c, -(i as isize)))
        .collect();
    columns.push(vec![1.0; y.len()]);
    let least = columns.len();
    columns.extend_from_slice(more);
    let width = columns.len();
    columns.push(y);
    let n = columns[0].len();
    let all = DMatrix::from_iterator(n, width + 1, columns.into_iter().flatten());
    let r = triangle_of(&all);
    // a column of parameters for each number of columns
    let goal = r.column(width).into_owned();
    let mut theta = DMatrix::zeros(width, width - least + 1);
    for (i, mut column) in theta.column_iter_mut().enumerate() {
        let used = least + i;
        let found = solve(r.columns(0, used).into_owned(), &goal, DEPENDENT);
        column.rows_mut(0, used).copy_from(&found.theta);
    }
    let fits = all.columns(0, width) * theta;
    let y = all.column(width);
    // the first parts are longer by a sample where the number does not divide
    let edge = |i: usize| i * (n / PARTS) + i.min(n % PARTS);
    let squares = |j: usize| -> [f64; PARTS] {
        std::array::from_fn(|i| {
            let (first, count) = (edge(i), edge(i + 1) - edge(i));
            let (y, fit) = (y.rows(first, count), fits.view((first, j), (count, 1)));
            // below this only the rounding of the columns is left, and of a column that stands still nothing
            (y - fit)
                .norm_squared()
                .max(1e-12 * y.norm_squared())
                .max(f64::MIN_POSITIVE)
        })
    };
    let last = squares(more.len());
    let added = |j: usize| {
        let own = squares(j);
        let whole = n as f64 * (own.iter().sum::<f64>() / last.iter().sum::<f64>()).ln();
        let parts: Vec<f64> = own.iter().zip(&last).map(|(o, l)| (o / l).ln()).collect();
        let loudest = parts.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let rest = n as f64 / PARTS as f64 * (parts.iter().sum::<f64>() - loudest);
        (whole, whole.min(rest))
    };
    (0..more.len()).map(added).unzip()
}

/// Column `j` so many samples after the rows of [`evidence`].
fn beside(pieces: &[Rows], j: usize, ahead: isize) -> Vec<f64> {
    let first = (PAST as isize + ahead) as usize;
    let of = |p: &Rows| {
        p.column(j)
            .skip(first)
            .take(p.len() - 2 * PAST)
            .collect::<Vec<_>>()
    };
    pieces.iter().flat_map(of).collect()
}

/// Means of column `j` over octaves of lags from `PAST` on, 0 before the first sample.
fn distant(pieces: &[Rows], j: usize) -> Vec<Vec<f64>> {
    let edges: Vec<usize> = (0..=OCTAVES).map(|i| PAST << i).collect();
    let mut means = vec![Vec::new(); OCTAVES];
    for p in pieces {
        let mut total = vec![0.0];
        for v in p.column(j) {
            total.push(total[total.len() - 1] + v);
        }
        for (mean, edge) in means.iter_mut().zip(edges.windows(2)) {
            let at = |k: usize, edge: usize| total[k.saturating_sub(edge)];
            let length = (edge[1] - edge[0]) as f64;
            mean.extend((PAST..p.len() - PAST).map(|k| (at(k, edge[0]) - at(k, edge[1])) / length));
        }
    }
    means
}

/// How many samples the output leads an input that no controller computed.
fn late(pieces: &[Rows], j: usize) -> Option<Order> {
    let everything: Vec<usize> = (0..pieces[0].width()).collect();
    let ahead: Vec<_> = (0..=PAST).map(|i| beside(pieces, j, i as isize)).collect();
    let (_, evidence) = evidence(pieces, everything.len() - 1, &everything, &ahead);
    // the last lead without which something is lost; where the farthest matters, the record differs from this model in another way
    let lead = evidence
        .iter()
        .rposition(|e| *e > SURE)
        .filter(|lead| *lead < PAST)?;
    Some(Order {
        kind: if lead > 0 { Kind::Late } else { Kind::AtOnce },
        input: j,
        shift: lead + 1,
        evidence: evidence[lead],
    })
}

fn exchanged(pieces: &[Rows], j: usize) -> Option<Order> {
    let y = pieces[0].width() - 1;
    let lags = |j: usize| (1..=PAST).map(move |i| beside(pieces, j, -(i as isize)));
    let of_input: Vec<_> = lags(j).chain(distant(pieces, j)).collect();
    if evidence(pieces, y, &[y], &of_input).0[0] > SURE {
        return None;
    }
    let of_output: Vec<_> = lags(y).collect();
    let answers = evidence(pieces, j, &[j], &of_output).1[0];
    (answers > SURE).then_some(Order {
        kind: Kind::Exchanged,
        input: j,
        shift: 0,
        evidence: answers,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Held levels, or noise if they are held for a sample, and the noisy output of a lag that they drive `delay` samples later.
    fn recorded(n: usize, held: usize, delay: usize) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(3);
        let levels: Vec<f64> = (0..n.div_ceil(held)).map(|_| random.normal()).collect();
        let u: Vec<f64> = (0..n).map(|k| levels[k / held]).collect();
        let mut x = 0.0;
        let y = (0..n).map(|k| {
            x = 0.9 * x + u[k.saturating_sub(delay)];
            x + 0.02 * random.normal()
        });
        let y = y.collect();
        (u, y)
    }

    fn samples<'a>(u: &'a [f64], y: &'a [f64]) -> [Samples<'a>; 1] {
        [Samples::new(u, 1, y).unwrap()]
    }

    #[test]
    fn exchanged_late_and_prompt_columns_are_told() {
        let of = |u: &[f64], y: &[f64]| order_in_time(&samples(u, y), &Monitor::default());
        let (u, y) = recorded(3000, 1, 2);
        assert_eq!(of(&u, &y), None);
        let found = of(&y, &u).unwrap();
        assert_eq!((found.kind, found.input), (Kind::Exchanged, 0));
        let (u, y) = recorded(3000, 10, 0);
        let found = of(&u, &y).unwrap();
        assert_eq!((found.kind, found.shift), (Kind::AtOnce, 1));
        let found = of(&u[..2996], &y[4..]).unwrap();
        assert_eq!((found.kind, found.shift), (Kind::Late, 5));
        assert!(found.evidence > SURE);
        assert_eq!(of(&u[4..], &y[..2996]), None);
    }

    #[test]
    fn copies_and_sums_are_told_from_plants() {
        let (u, y) = recorded(2000, 5, 1);
        assert_eq!(copied(&samples(&u, &y)), None);
        assert_eq!(computed(&samples(&u, &y)), None);
        let at = |k: usize, i: usize| u[k.saturating_sub(i)];
        let copy: Vec<f64> = (0..2000).map(|k| 3.0 - 2.0 * at(k, 4)).collect();
        let found = copied(&samples(&u, &copy)).unwrap();
        assert_eq!((found.input, found.delay), (0, 4));
        assert!((found.gain + 2.0).abs() < 1e-9 && (found.offset - 3.0).abs() < 1e-9);
        let sum: Vec<f64> = (0..2000).map(|k| (0..4).map(|i| at(k, i)).sum()).collect();
        assert_eq!(computed(&samples(&u, &sum)), Some(Sum::Output));
        let mut total = 0.0;
        let add = |u: &f64| {
            total += u;
            total
        };
        let integral: Vec<f64> = u.iter().map(add).collect();
        let square: Vec<f64> = u.iter().map(|u| 3.0 * u + u * u).collect();
        assert_eq!(computed(&samples(&u, &square)), Some(Sum::Curve));
        assert_eq!(computed(&samples(&u[..1999], &square[1..])), None);
        assert_eq!(computed(&samples(&u, &integral)), Some(Sum::Change));
        assert_eq!(computed(&samples(&u[..20], &sum[..20])), None);
    }
}
