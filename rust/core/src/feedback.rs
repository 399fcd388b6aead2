//! Statistical tests of a record: whether the output integrates an input, and whether the record was made in closed loop.

use nalgebra::{DMatrix, DVector};

use crate::column::{MAD, MEASURED, Rows, dot, median, moments, range, stretches};
use crate::data::Samples;
use crate::regression::{solve, triangle, unit_columns};
use crate::{Monitor, Record};

/// Numbers of blocks for the longest experiment, and past changes in the regression on them.
const SCALES: [(usize, usize); 3] = [(60, 1), (200, 2), (1000, 4)];
/// Least samples of the longest experiment, and least blocks, for a test.
const LEAST_DIFFERENCES: usize = 300;
const LEAST_BLOCKS: usize = 40;
/// Length of the record in time constants below which a pole cannot be told from 1.
const NEGLIGIBLE: f64 = 0.5;
/// Standard errors by which a pole must lie inside the unit circle, at each of the scales. More on the finest blocks, where sensor noise
/// on the level looks like a restoring force.
const RESTORED: [f64; 3] = [3.0, 3.0, 6.0];
/// The same at every scale where the record is too short for the finest blocks.
const RESTORED_SHORT: f64 = 2.5;
/// Standard errors by which the input must drive the change of the output.
const DRIVEN: f64 = 4.5;
/// Largest ratio of restoring to driving part of the change: in the median of the scales, and at the scale where the input drives most
/// clearly.
const BALANCE: f64 = 0.2;
const MOST_BALANCE: f64 = 0.5;
/// Least part of the output, without its trend, that the integral of the input must explain.
const EXPLAINED: f64 = 0.35;
const MOST_EXPERIMENTS: usize = 50;
/// Singular values below this part of the largest (for columns of length 1) count as zero.
const DEPENDENT: f64 = 1e-9;
const TINY: f64 = f64::MIN_POSITIVE;

/// How an output that inputs drive returns to its level, over the whole record.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Integration {
    /// Whether it does not return.
    pub is_integral: bool,
    /// The input that drives it most clearly.
    pub input: usize,
    /// Length of the longest experiment in time constants; 0 or below for an integral.
    pub lengths: f64,
    /// Of the slowest pole \[s\], a sum if several are slow; infinite for an integral.
    pub time_constant: f64,
    /// The output's change per second and unit of the input, at low frequencies.
    pub gain: f64,
    /// Standard errors by which the pole lies inside the circle.
    pub restoring: f64,
    /// Standard errors by which the input drives the change.
    pub driving: f64,
}

/// Test for a pole at 1 that an input drives; none where the record is too short or still.
///
/// An augmented Dickey-Fuller regression (D. Dickey, W. Fuller, *J. American Statistical Association* 74 (1979) 427-431) with inputs, their
/// squares, a line and the sign of the motion (dry friction) is solved over block means of three lengths. For an integral no pole lies
/// inside, and an input drives the change and explains the output.
pub fn integration(experiments: &[Samples], sample_time: f64) -> Option<Integration> {
    let mut records: Vec<Record> = experiments.iter().map(Samples::unseen).collect();
    records.sort_by_key(|e| std::cmp::Reverse(e.len()));
    records.truncate(MOST_EXPERIMENTS);
    let longest = records.first()?.len();
    if longest < LEAST_DIFFERENCES {
        return None;
    }
    let rows: Vec<Rows> = records.iter().map(|r| Rows::of(r, MEASURED)).collect();
    let at = |&(blocks, past): &(usize, usize)| {
        let size = longest / blocks;
        if size == 0 {
            return None;
        }
        let means = rows.iter().map(|r| r.means(size));
        let means = means.filter(|m| m.len() > past + 2).collect();
        let (lengths, seconds) = (longest as f64 / size as f64, sample_time * size as f64);
        scale(means, past, lengths, seconds)
    };
    let found: Vec<Scale> = SCALES.iter().filter_map(at).collect();
    let most = |of: fn(&Scale) -> f64| {
        let first = found.iter().rev();
        first.max_by(|a, b| of(a).total_cmp(&of(b)))
    };
    let (restored, driven) = (most(Scale::restoring)?, most(|s| s.driving)?);
    let whole = found.len() == SCALES.len();
    let bound = |i: usize| if whole { RESTORED[i] } else { RESTORED_SHORT };
    let is_integral = found
        .iter()
        .enumerate()
        .all(|(i, s)| s.restoring() < bound(i))
        && driven.driving > DRIVEN
        && median(found.iter().map(|s| s.balance).collect()) < BALANCE
        && driven.balance < MOST_BALANCE
        && driven.explained > EXPLAINED;
    let lengths = if is_integral {
        driven.lengths
    } else {
        restored.lengths
    };
    Some(Integration {
        is_integral,
        input: driven.input,
        lengths,
        time_constant: if is_integral || lengths <= 0.0 {
            f64::INFINITY
        } else {
            sample_time * longest as f64 / lengths
        },
        gain: driven.gain,
        restoring: restored.restoring(),
        driving: driven.driving,
    })
}

/// The regression at one length of blocks, in deviations and records.
struct Scale {
    lengths: f64,
    error: f64,
    input: usize,
    driving: f64,
    balance: f64,
    explained: f64,
    gain: f64,
}

impl Scale {
    fn restoring(&self) -> f64 {
        if self.error > 0.0 {
            (self.lengths - NEGLIGIBLE) / self.error
        } else {
            0.0
        }
    }
}

/// The regression over blocks, `record` of them in the longest experiment, `seconds` each.
fn scale(mut means: Vec<Rows>, past: usize, record: f64, seconds: f64) -> Option<Scale> {
    let y = means.first()?.width() - 1;
    let whole = |j: usize| {
        let of = |m: &Rows| {
            m.known()
                .zip(m.column(j))
                .filter(|(k, _)| *k)
                .collect::<Vec<_>>()
        };
        means
            .iter()
            .flat_map(of)
            .map(|(_, v)| v)
            .collect::<Vec<f64>>()
    };
    if whole(y).len() < LEAST_BLOCKS {
        return None;
    }
    let moving = |j: usize| {
        let column = whole(j);
        let (middle, size) = moments(column.iter().copied());
        let largest = column.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
        (size > 1e-12 * largest).then_some((j, middle, size))
    };
    let moving: Vec<_> = (0..=y).filter_map(moving).collect();
    let inputs = moving.len().checked_sub(2)? + 1;
    if moving[inputs].0 != y {
        return None;
    }
    let (chosen, size): (Vec<usize>, Vec<f64>) = moving.iter().map(|(j, _, s)| (*j, *s)).unzip();
    let by: Vec<(f64, f64)> = moving.iter().map(|(_, m, s)| (*m, *s)).collect();
    for m in &mut means {
        *m = m.some(&chosen);
        m.scale(&by);
        // inputs at missing outputs are not scaled: their squares could overflow
        m.forget_above(MEASURED);
    }
    let changes = means.iter().flat_map(|m| {
        let y = m.column(inputs);
        y.clone().skip(1).zip(y).map(|(next, y)| next - y)
    });
    let spread = deviation(changes);
    let lags = past + 2;
    let width = 1 + past + inputs * lags + 3 + 2 * inputs;
    let rows = means.iter().flat_map(|m| rows(m, past, record, spread));
    let rows = rows.filter(|row| row.iter().all(|v| v.is_finite()));
    let (r, count) = triangle(width + 1, rows);
    if count < 2 * (width + 1) {
        return None;
    }
    let (theta, covariance) = least_squares(&r, count)?;
    let left = 1.0 - theta.rows(1, past).sum();
    let window = |j: usize| 1 + past + j * lags;
    let driving = |j: usize| {
        let total = theta.rows(window(j), lags).sum();
        let variance = covariance.view((window(j), window(j)), (lags, lags)).sum();
        (total, total.abs() / variance.max(TINY).sqrt())
    };
    let driving: Vec<(f64, f64)> = (0..inputs).map(driving).collect();
    let j = (0..inputs)
        .rev()
        .max_by(|a, b| driving[*a].1.total_cmp(&driving[*b].1))?;
    let total = driving[j].0;
    if left == 0.0 || total == 0.0 {
        return None;
    }
    let gain = total / left;
    let integral = means.iter().flat_map(|m| {
        let known = m.column(j).map(|v| if v.is_finite() { v } else { 0.0 });
        let sums = known.scan(0.0, |sum, v| {
            *sum += v;
            Some(*sum)
        });
        without_line(sums.collect())
    });
    let output = means
        .iter()
        .flat_map(|m| without_line(m.column(inputs).collect()));
    Some(Scale {
        lengths: -theta[0] / left * record,
        error: covariance[(0, 0)].max(0.0).sqrt() / left.abs() * record,
        input: chosen[j],
        driving: driving[j].1,
        balance: -theta[0] / total.abs(),
        explained: gain.abs() * deviation(integral) / deviation(output).max(TINY),
        gain: gain * size[inputs] / size[j] / seconds,
    })
}

/// `[level, past changes, inputs, 1, time, sign of motion, squares, change]` of each block.
fn rows(m: &Rows, past: usize, record: f64, spread: f64) -> Vec<Vec<f64>> {
    let inputs = m.width() - 1;
    let change = |k: usize| m.at(k + 1, inputs) - m.at(k, inputs);
    // the square of a two-level input is a constant
    let has_levels = |j: usize| {
        let (low, high) = range(m.column(j).filter(|v| v.is_finite()).map(f64::abs));
        high - low > 0.05
    };
    let has_levels: Vec<bool> = (0..inputs).map(has_levels).collect();
    let row = |k: usize| {
        let mut row = vec![m.at(k, inputs)];
        row.extend((1..=past).map(|i| change(k - i)));
        for j in 0..inputs {
            row.extend((0..past + 2).map(|i| m.at(k + 1 - i, j)));
        }
        let before = change(k - 1);
        let motion = before / (before * before + 0.01 * (spread * spread) + TINY).sqrt();
        row.extend([1.0, k as f64 / record - 0.5, motion]);
        for (j, has_levels) in has_levels.iter().enumerate() {
            let square = |k: usize| if *has_levels { m.at(k, j).powi(2) } else { 0.0 };
            row.extend([square(k), square(k - 1)]);
        }
        row.push(change(k));
        row
    };
    (past..m.len() - 1).map(row).collect()
}

/// Parameters of the last column on the others, and their covariance; parameters that the rows do not determine are 0.
fn least_squares(r: &DMatrix<f64>, count: usize) -> Option<(DVector<f64>, DMatrix<f64>)> {
    let width = r.ncols() - 1;
    let (mut x, y) = (r.columns(0, width).into_owned(), r.column(width));
    let scale = unit_columns(&mut x);
    let svd = x.clone().try_svd(true, true, 5.0 * f64::EPSILON, 10_000)?;
    let least = DEPENDENT * svd.singular_values.max();
    let rank = svd.rank(least);
    let (left, right) = (svd.u.as_ref()?, svd.v_t.as_ref()?);
    let mut back = DMatrix::zeros(width, 0);
    let mut theta = DVector::zeros(width);
    for (i, value) in svd
        .singular_values
        .iter()
        .enumerate()
        .filter(|(_, v)| **v > least)
    {
        let column = right.row(i).transpose() / *value;
        theta += &column * left.column(i).dot(&y);
        let at = back.ncols();
        back = back.insert_column(at, 0.0);
        back.set_column(at, &column);
    }
    let error = y - x * &theta;
    let variance = error.norm_squared() / count.saturating_sub(rank).max(1) as f64;
    let covariance =
        (&back * back.transpose() * variance).component_mul(&(&scale * scale.transpose()));
    Some((theta.component_mul(&scale), covariance))
}

/// Standard deviation of the values that are known; 0 of none.
fn deviation(values: impl Iterator<Item = f64>) -> f64 {
    let known: Vec<f64> = values.filter(|v| v.is_finite()).collect();
    moments(known.into_iter()).1
}

/// The values without the line through those that are known, by least squares.
fn without_line(column: Vec<f64>) -> Vec<f64> {
    let known = || column.iter().enumerate().filter(|(_, v)| v.is_finite());
    if known().count() < 3 {
        return column.iter().map(|v| 0.0 * v).collect();
    }
    let (k_mean, _) = moments(known().map(|(k, _)| k as f64));
    let (v_mean, _) = moments(known().map(|(_, v)| *v));
    let (mut products, mut squares) = (0.0, 0.0);
    for (k, v) in known() {
        let k = k as f64 - k_mean;
        (products, squares) = (products + k * (v - v_mean), squares + k * k);
    }
    let slope = products / squares;
    let without = |(k, v): (usize, &f64)| v - v_mean - slope * (k as f64 - k_mean);
    column.iter().enumerate().map(without).collect()
}

// Whether a record was made in closed loop: noise of the output returns in an input.

/// Past outputs and inputs in the regressions for the innovations; fewer with many inputs.
const PAST: usize = 20;
/// Largest lead: samples after an innovation of the output within which an input is tested.
const LEADS: usize = 10;
/// Largest part of the plant's response that a controller can mimic within a sample.
const AT_ONCE: f64 = 0.2;
/// Samples over which that input is summed: a filter in the loop spreads the feedback.
const SPANS: [usize; 3] = [1, 3, 10];
/// Least significance of a correlation \[standard errors\]; chance reaches it in .1 % of records.
const SIGNIFICANT: f64 = 4.2;
/// Least ratio to the largest correlation with the past, which only a misfit can cause.
const OVER_MISFIT: f64 = 2.0;
/// Largest part of the samples in which a fed back input keeps its value to the last bit.
const HELD: f64 = 0.5;
const MOST_SAMPLES: usize = 20_000;
/// Samples below which nothing is tested, of all pieces and of one.
const LEAST: usize = 300;
const SHORTEST: usize = 4 * (PAST + LEADS);
/// Robust deviations at which innovations are clipped.
const CLIP: f64 = 5.0;
/// Innovation over standard deviation below which only rounding is left of a signal.
const EXACT: f64 = 1e-9;
/// Lags over which the variance of a correlation is summed.
const SMOOTH: usize = 12;
/// Singular values below this part of the largest count as zero.
const ROUNDING: f64 = 1e-13;

/// How one input follows the output's innovations, `lead` samples later.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feedback {
    /// Number of the input.
    pub input: usize,
    /// Samples.
    pub lead: usize,
    /// Correlation of the innovations at this lead.
    pub correlation: f64,
    /// The same in standard errors.
    pub significance: f64,
    /// The largest correlation with the input's past beyond the regression \[standard errors\].
    pub misfit: f64,
}

/// The input with the clearest response to noise of the output; none if no input responds.
///
/// Innovations of output and input correlate at positive leads only if the input was computed from the output (Granger 1969; Box, Jenkins,
/// Reinsel 2008, section 12.1; standard errors: Newey, West 1987). At lead 0 the signs of controller and plant differ. Only a misfit also
/// correlates with the input's past.
pub fn feedback(experiments: &[Samples], monitor: &Monitor) -> Option<Feedback> {
    let pieces = pieces(experiments);
    let channels = pieces.first()?.width() - 1;
    let of = |j: usize| {
        let (step, first) = sampling(&pieces, j)?;
        let thinned = pieces
            .iter()
            .zip(first)
            .map(|(p, first)| p.thinned(first, step));
        let thinned: Vec<_> = thinned.filter(|p| p.len() > SHORTEST).collect();
        let enough = thinned.iter().map(Rows::len).sum::<usize>() >= LEAST;
        enough.then(|| of_input(&thinned, j, step)).flatten()
    };
    let found = (0..channels)
        .take_while(|_| !monitor.stopped())
        .filter_map(of);
    // the first of equal ones
    found.reduce(|best, f| {
        if f.significance > best.significance {
            f
        } else {
            best
        }
    })
}

/// The longest runs without missing values, in deviations from the mean.
fn pieces(experiments: &[Samples]) -> Vec<Rows> {
    let records: Vec<Record> = experiments.iter().map(Samples::unseen).collect();
    let mut all = stretches(&records, MEASURED);
    all.retain(|p| p.len() > SHORTEST);
    all.sort_by_key(|p| std::cmp::Reverse(p.len()));
    let (mut chosen, mut left) = (Vec::new(), MOST_SAMPLES);
    for piece in all {
        if left > SHORTEST {
            let count = piece.len().min(left);
            chosen.push(piece.part(0, count));
            left -= count;
        }
    }
    let width = chosen.first().map_or(0, Rows::width);
    let scale = |j: usize| {
        let column = || chosen.iter().flat_map(move |p: &Rows| p.column(j));
        let (middle, size) = moments(column());
        (middle, if size > 0.0 { size } else { 1.0 })
    };
    let scale: Vec<_> = (0..width).map(scale).collect();
    chosen.iter_mut().for_each(|p| p.scale(&scale));
    chosen
}

/// Interval between changes of a held input and the offset of each piece; none if the input is not fed back.
fn sampling(pieces: &[Rows], j: usize) -> Option<(usize, Vec<usize>)> {
    let (low, high) = range(pieces.iter().flat_map(|p| p.column(j)));
    let (mut count, mut total, mut places) = (0, 0, Vec::new());
    for p in pieces {
        let mut at = Vec::new();
        for (k, (v, next)) in p.column(j).zip(p.column(j).skip(1)).enumerate() {
            // samples at a limit do not count as held
            let (is_free, changes) = (v > low && v < high, next != v);
            total += usize::from(is_free);
            count += usize::from(is_free && changes);
            if changes {
                at.push(k + 1);
            }
        }
        places.push(at);
    }
    let free = (1.0 - HELD) * total as f64;
    if total < LEAST {
        return None;
    }
    if count as f64 > free {
        return Some((1, vec![0; pieces.len()]));
    }
    let between = || {
        places
            .iter()
            .flat_map(|at| at.windows(2).map(|pair| pair[1] - pair[0]))
    };
    let mut numbers = vec![0_usize; between().max()? + 1];
    between().for_each(|b| numbers[b] += 1);
    // the shortest of the most frequent
    let step = (0..numbers.len()).rev().max_by_key(|b| numbers[*b])?;
    let regular = between().filter(|b| b.is_multiple_of(step)).count() as f64;
    let is_held = regular >= 0.9 * between().count() as f64 && (count * step) as f64 >= free;
    let offset = |at: &Vec<usize>| at.first().map_or(0, |first| first % step);
    (step >= 2 && is_held).then(|| (step, places.iter().map(offset).collect()))
}

fn of_input(pieces: &[Rows], j: usize, step: usize) -> Option<Feedback> {
    let width = pieces[0].width();
    let y = width - 1;
    let past = (2 * (PAST + 1) / width).clamp(3, PAST);
    let lagged = |p: &Rows, k: usize| {
        let one = move |i: usize| (0..width).map(move |c| (i, c));
        let all = (1..=past).flat_map(one);
        all.map(|(i, c)| p.at(k - i, c)).collect::<Vec<f64>>()
    };
    let whole = innovation(pieces, past, j, y, |p, k, motion| {
        let mut row = lagged(p, k);
        row.extend([motion[k - 2], motion[k - 3]]);
        row
    });
    let own = innovation(pieces, past, j, j, |p, k, _| {
        (1..=past).map(|i| p.at(k - i, j)).collect()
    });
    let (parts, response) = (
        whole.0?.into_iter().zip(own.0?).collect::<Vec<_>>(),
        whole.1,
    );
    let (past_lags, ahead) = (-((past + LEADS) as isize), LEADS as isize);
    let tests = |span: usize, lags: std::ops::RangeInclusive<isize>| {
        let parts = &parts;
        lags.map(move |lag| {
            let (size, significance) = correlation(parts, lag, span);
            (lag, size, significance)
        })
    };
    let misfit = SPANS.iter().flat_map(|&span| {
        let last = -((past + span) as isize);
        tests(span, past_lags..=last).map(|(_, _, s)| s.abs())
    });
    let misfit = misfit.fold(0.0, f64::max);
    let leads = SPANS
        .iter()
        .flat_map(|&span| tests(span, 1..=ahead + 1 - span as isize));
    let mut leads: Vec<_> = leads.collect();
    let impulse = impulse(&response, past, width, j);
    let at_once = correlation(&parts, 0, 1);
    let largest = impulse.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
    let is_small = impulse[0].abs() < AT_ONCE * largest;
    if is_small && at_once.1 * impulse.iter().sum::<f64>() < 0.0 {
        leads.push((0, at_once.0, at_once.1));
    }
    // the first of equal ones
    let clearer =
        |a: (isize, f64, f64), b: (isize, f64, f64)| if b.2.abs() > a.2.abs() { b } else { a };
    let (lead, size, significance) = leads.into_iter().reduce(clearer)?;
    (significance.abs() > SIGNIFICANT.max(OVER_MISFIT * misfit)).then_some(Feedback {
        input: j,
        lead: lead as usize * step,
        correlation: size,
        significance: significance.abs(),
        misfit,
    })
}

/// Smoothed sign of every change of the output.
fn motion(y: impl Iterator<Item = f64> + Clone) -> Vec<f64> {
    let changes = y.clone().skip(1).zip(y).map(|(next, y)| next - y);
    let (_, spread) = moments(changes.clone());
    let floor = 0.01 * (spread * spread) + TINY;
    changes.map(|c| c / (c * c + floor).sqrt()).collect()
}

/// Clipped residuals of column `of` on the rows and a constant, piece by piece, none if only rounding is left; and the coefficients with
/// column `j` in the same sample as one more, the last.
fn innovation(
    pieces: &[Rows],
    past: usize,
    j: usize,
    of: usize,
    row: impl Fn(&Rows, usize, &[f64]) -> Vec<f64>,
) -> (Option<Vec<Vec<f64>>>, DVector<f64>) {
    let mut all = Vec::new();
    for p in pieces {
        let motion = motion(p.column(p.width() - 1));
        all.extend((past..p.len()).map(|k| {
            let mut row = row(p, k, &motion);
            row.extend([1.0, p.at(k, j), p.at(k, of)]);
            row
        }));
    }
    let n = all[0].len() - 2;
    let (r, _) = triangle(n + 2, all.iter().map(|row| row.iter().copied()));
    let mut x = r.columns(0, n + 1).into_owned();
    let u = x.column(n).into_owned();
    let mut scale = unit_columns(&mut x);
    // the input keeps its own scale
    x.set_column(n, &u);
    scale[n] = 1.0;
    let y = r.column(n + 1).into_owned();
    let theta = solve(x.columns(0, n).into_owned(), &y, ROUNDING).theta;
    let theta = theta.component_mul(&scale.rows(0, n));
    let with_u = solve(x, &y, ROUNDING).theta.component_mul(&scale);
    let left = |row: &Vec<f64>| row[n + 1] - dot(row, theta.as_slice());
    let mut left: Vec<f64> = all.iter().map(left).collect();
    let whole = moments(all.iter().map(|row| row[n + 1])).1;
    if moments(left.iter().copied()).1 <= EXACT * whole.max(TINY) {
        return (None, with_u);
    }
    let robust = MAD * median(left.iter().map(|v| v.abs()).collect());
    if robust > 0.0 {
        let most = CLIP * robust;
        left.iter_mut().for_each(|v| *v = v.clamp(-most, most));
    }
    let (middle, _) = moments(left.iter().copied());
    left.iter_mut().for_each(|v| *v -= middle);
    let mut rest = &left[..];
    let mut parts = Vec::new();
    for p in pieces {
        let (own, behind) = rest.split_at(p.len() - past);
        parts.push(own.to_vec());
        rest = behind;
    }
    (Some(parts), with_u)
}

/// Response of the output to one sample of input `j`, from the same sample on.
fn impulse(theta: &DVector<f64>, past: usize, width: usize, j: usize) -> Vec<f64> {
    let lag = |i: usize, c: usize| theta[(i - 1) * width + c];
    let mut response: Vec<f64> = Vec::with_capacity(past + 1);
    for k in 0..=past {
        let of_u = if k == 0 {
            theta[theta.len() - 1]
        } else {
            lag(k, j)
        };
        let of_y = response.iter().rev().enumerate();
        let of_y: f64 = of_y.map(|(i, r)| lag(i + 1, width - 1) * r).sum();
        response.push(of_u + of_y);
    }
    response
}

/// Correlation of e(k) with w(k + lag) + .. + w(k + lag + span - 1), also in standard errors.
fn correlation(parts: &[(Vec<f64>, Vec<f64>)], lag: isize, span: usize) -> (f64, f64) {
    let (mut total, mut variance, mut squares) = (0.0, 0.0, [0.0; 2]);
    for (e, w) in parts {
        let later: Vec<f64> = w.windows(span).map(|w| w.iter().sum()).collect();
        let first = (-lag).max(0) as usize;
        let last = (later.len() as isize - lag).clamp(0, e.len() as isize) as usize;
        if last.saturating_sub(first) <= SMOOTH {
            continue;
        }
        let one = &e[first..last];
        let other = &later[(first as isize + lag) as usize..(last as isize + lag) as usize];
        let z: Vec<f64> = one.iter().zip(other).map(|(a, b)| a * b).collect();
        total += z.iter().sum::<f64>();
        let own = dot(&z, &z);
        let weight = |i: usize| 2.0 * (1.0 - i as f64 / (SMOOTH as f64 + 1.0));
        let between: f64 = (1..=SMOOTH).map(|i| weight(i) * dot(&z[i..], &z)).sum();
        // at least the value without memory: a negative sum is chance
        variance += (own + between).max(own);
        squares = [squares[0] + dot(one, one), squares[1] + dot(other, other)];
    }
    if !(variance > 0.0 && squares.iter().all(|s| *s > 0.0)) {
        return (0.0, 0.0);
    }
    (
        total / (squares[0] * squares[1]).sqrt(),
        total / variance.sqrt(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Held random levels, and the output of a lag of the first order; with a gain, a controller takes the output off the levels.
    fn recorded(n: usize, pole: f64, gain: f64) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(7);
        let (mut u, mut y) = (vec![0.0; n], vec![0.0; n]);
        let (mut level, mut x, mut before) = (0.0, 0.0, 0.0);
        for k in 0..n {
            if k % 10 == 0 {
                level = random.between(-1.0, 1.0);
            }
            u[k] = level - gain * before;
            y[k] = x + 0.05 * random.normal();
            before = y[k];
            x = pole * x + 0.1 * u[k];
        }
        (u, y)
    }

    #[test]
    fn a_loop_returns_noise_of_the_output() {
        let monitor = Monitor::default();
        for (gain, expected) in [(0.8, true), (0.0, false)] {
            let (u, y) = recorded(4000, 0.9, gain);
            let found = feedback(&[Samples::new(&u, 1, &y).unwrap()], &monitor);
            assert_eq!(found.is_some(), expected, "{found:?}");
            if let Some(found) = found {
                assert!(found.significance > SIGNIFICANT && found.lead == 1);
            }
        }
        let (u, y) = recorded(100, 0.9, 0.8);
        let short = [Samples::new(&u, 1, &y).unwrap()];
        assert_eq!(feedback(&short, &monitor), None);
    }

    #[test]
    fn a_pole_at_one_is_told_from_one_within() {
        let (u, y) = recorded(6000, 1.0, 0.0);
        let found = integration(&[Samples::new(&u, 1, &y).unwrap()], 0.01).unwrap();
        assert!(found.is_integral && found.time_constant.is_infinite());
        assert!((found.gain - 10.0).abs() < 1.0, "{found:?}");
        let (u, y) = recorded(6000, 0.98, 0.0);
        let mut gaps = y.clone();
        gaps[300..500].fill(f64::NAN);
        for y in [y, gaps] {
            let found = integration(&[Samples::new(&u, 1, &y).unwrap()], 0.01).unwrap();
            assert!(!found.is_integral && found.restoring > 5.0);
            assert!((found.time_constant - 0.5).abs() < 0.1, "{found:?}");
        }
        let short = [Samples::new(&u[..200], 1, &u[..200]).unwrap()];
        assert_eq!(integration(&short, 0.01), None);
    }
}
