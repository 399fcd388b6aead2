//! Errors of linear models of every order and delay: information criteria (Ljung, *System Identification*, 1999, section 16.4), free runs
//! on later data, and the Lipschitz index of He and Asada (*American Control Conference*, 1993), which supposes no model.

use crate::column::{dot, moments};
use crate::data::{Samples, window};
use crate::dead_time::LaggedRegression;
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::{Error, ErrorKind, Monitor, Record, Result, iv};

/// Parts of the later data, for the standard error of a difference between structures.
const BLOCKS: usize = 10;
const IV_ITERATIONS: usize = 10;
/// Samples that are compared pairwise, spread evenly over the data, and the least number.
const POINTS: usize = 600;
const FEWEST_POINTS: usize = 20;
/// Part of the points: number of largest quotients that are averaged.
const SHARE: f64 = 0.02;

/// The structures to try.
#[derive(Clone, Copy, Debug)]
pub struct Grid<'a> {
    /// Past outputs.
    pub na: &'a [usize],
    /// Past values of each input.
    pub nb: &'a [usize],
    /// Delays.
    pub nk: &'a [usize],
}

/// A structure and its errors.
#[derive(Clone, Debug)]
pub struct Structure {
    /// Past outputs, past inputs, delay.
    pub orders: (usize, usize, usize),
    /// Number of parameters that the training data determine.
    pub parameters: usize,
    /// Root mean square one-step error of the ARX model on later data.
    pub one_step: f64,
    /// Mean squared free-run error in each part of the later data; infinite if the run diverges.
    pub blocks: Vec<f64>,
    /// AIC, AICc, BIC and FPE of the ARX model.
    pub criteria: [f64; 4],
    /// Index of He and Asada of a model with these lags; NaN if there are too few samples.
    pub lipschitz: f64,
}

/// Every structure of the grid, delay by delay. The free run is that of the ARX model or of its refinement by instrumental variables,
/// whichever is better. The first `init` measured outputs of later data serve for the initial state only.
///
/// # Errors
/// `ErrorKind::Data` for too few samples or a later part without a measured output; `ErrorKind::Fit` after a stop request.
pub fn table(
    train: &[Samples],
    later: &[Samples],
    grid: Grid,
    init: usize,
    monitor: &Monitor,
) -> Result<Vec<Structure>> {
    let most = |of: &[usize]| of.iter().copied().max().unwrap_or(1);
    let (na, lags) = (most(grid.na), most(grid.nk) + most(grid.nb));
    let [known, fresh] = [train, later].map(|of| {
        let records: Vec<_> = of.iter().map(Samples::unseen).collect();
        LaggedRegression::new(&records, na, lags)
    });
    let width = known.width();
    if known.samples < 2 * width || fresh.samples == 0 {
        return Err(Error::data(format!(
            "expected at least {} samples for {} parameters, got {} to fit and {} to judge on; record longer, or lower na, nb and nk",
            2 * width,
            width - 1,
            known.samples,
            fresh.samples
        )));
    }
    let later: Vec<_> = later.iter().map(Samples::unseen).collect();
    let points = Points::of(train);
    let mut structures = Vec::new();
    for nk in grid.nk {
        for na in grid.na {
            structures.extend(grid.nb.iter().map(|nb| (*na, *nb, *nk)));
        }
    }
    monitor.set_total(structures.len() as u64);
    let row = |orders: (usize, usize, usize)| {
        let (na, nb, nk) = orders;
        let windows = vec![nk..nk + nb; points.channels];
        let arx = known.solve(na, &windows);
        let mut best = vec![f64::INFINITY; BLOCKS];
        let theta = arx.solution.theta.as_slice();
        let least_squares = from_theta(theta, orders, points.channels);
        for model in [least_squares, refined(train, orders)] {
            if monitor.stopped() {
                return Err(Error::fit(
                    "expected to be left alone, got a request to stop",
                ));
            }
            if let Ok(model) = model {
                let found = blocks(&model, &later, init)?;
                if mean(&found) < mean(&best) {
                    best = found;
                }
            }
        }
        monitor.advance(1);
        monitor.report_cost(mean(&best).sqrt());
        let n = known.samples as f64;
        Ok(Structure {
            orders,
            parameters: arx.solution.rank,
            one_step: (fresh.squares(&arx) / fresh.samples as f64).sqrt(),
            blocks: best,
            criteria: criteria(arx.solution.rank as f64, arx.squares, n),
            lipschitz: points.index(na, nb, nk),
        })
    };
    structures.into_iter().map(row).collect()
}

/// The model of a regression on past outputs, inputs and a constant.
fn from_theta(
    theta: &[f64],
    (na, _, nk): (usize, usize, usize),
    channels: usize,
) -> Result<LinearModel> {
    let a = theta[..na].iter().map(|t| -t).collect();
    let b = theta[na..theta.len() - 1].to_vec();
    LinearModel::new(a, b, channels, nk, theta[theta.len() - 1])
}

/// The structure by instrumental variables. For a nonlinear drive they can follow the record's trend with a slow pole that no other
/// record shows; least squares cannot.
fn refined(train: &[Samples], (na, nb, nk): (usize, usize, usize)) -> Result<LinearModel> {
    let records = train.iter().map(Samples::record);
    let records = records.collect::<Result<Vec<_>>>()?;
    // a monitor of its own: the steps of the table are structures
    let own = Monitor::default();
    Ok(iv::fit(&records, na, nb, nk, true, IV_ITERATIONS, &own)?.model)
}

/// Mean squared free-run error in each part of the later data; infinite if the run diverges.
fn blocks(model: &LinearModel, later: &[Record], init: usize) -> Result<Vec<f64>> {
    let mut squares = Vec::new();
    for record in later {
        match errors(model, record, init) {
            Ok(found) => squares.extend(found.into_iter().map(|e| e * e)),
            Err(e) if e.kind == ErrorKind::Fit => return Ok(vec![f64::INFINITY; BLOCKS]),
            Err(e) => return Err(e),
        }
    }
    // the first parts are longer by a sample where the number does not divide
    let (n, parts) = (squares.len(), BLOCKS.min(squares.len()));
    let edge = |i: usize| i * (n / parts) + i.min(n % parts);
    Ok((0..parts)
        .map(|i| mean(&squares[edge(i)..edge(i + 1)]))
        .collect())
}

/// Free-run errors behind the outputs from which the initial state is estimated.
fn errors(model: &LinearModel, record: &Record, init: usize) -> Result<Vec<f64>> {
    let measured = record.y.iter().filter(|y| !y.is_nan()).count();
    let first = window(record.y, init.min(measured)).filter(|first| *first > 0);
    let first = first.unwrap_or(init).min(record.len());
    let channels = record.channels;
    let known = &record.u[..first * channels];
    let state = model.estimate_initial_state(known, channels, &record.y[..first])?;
    let run = model.simulate(record.u, channels, &state)?;
    let error = record.y.iter().zip(run).map(|(y, run)| y - run);
    Ok(error.skip(first).filter(|e| e.is_finite()).collect())
}

/// AIC, AICc, BIC and FPE of a least-squares fit with `p` parameters on `n` samples.
fn criteria(p: f64, squares: f64, n: f64) -> [f64; 4] {
    let variance = squares.max(1e-300) / n;
    let aic = n * variance.ln() + 2.0 * p;
    [
        aic,
        aic + 2.0 * p * (p + 1.0) / (n - p - 1.0),
        n * variance.ln() + p * n.ln(),
        variance * (1.0 + p / n) / (1.0 - p / n),
    ]
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Samples in units of the standard deviations of their columns, output first.
struct Points {
    runs: Vec<Vec<f64>>,
    channels: usize,
}

impl Points {
    fn of(experiments: &[Samples]) -> Self {
        let records: Vec<_> = experiments.iter().map(Samples::unseen).collect();
        let channels = records.first().map_or(1, |r| r.channels);
        let row = |r: &Record, k: usize| {
            let inputs = r.u[k * channels..][..channels].iter().copied();
            [r.y[k]].into_iter().chain(inputs).collect::<Vec<_>>()
        };
        let rows = |r: &Record| (0..r.len()).flat_map(|k| row(r, k)).collect();
        let mut runs: Vec<Vec<f64>> = records.iter().map(rows).collect();
        for j in 0..=channels {
            let column = || {
                runs.iter()
                    .flat_map(|r| r.iter().skip(j).step_by(1 + channels))
            };
            let (middle, spread) = moments(column().copied().filter(|v| !v.is_nan()));
            let scale = if spread > 0.0 { spread } else { 1.0 };
            for run in &mut runs {
                let column = run.iter_mut().skip(j).step_by(1 + channels);
                column.for_each(|v| *v = (*v - middle) / scale);
            }
        }
        Self { runs, channels }
    }

    /// Geometric mean of the largest quotients `|dy| / |dphi|`, times `sqrt(n)` for `n` regressors.
    ///
    /// With too few lags two nearly equal regressors can have very different outputs: the index is large. It falls to a level, which
    /// noise raises, as lags are added; the order is where it stops falling.
    fn index(&self, na: usize, nb: usize, nk: usize) -> f64 {
        let width = 1 + self.channels;
        let first = na.max((nk + nb).saturating_sub(1));
        let row = |run: &[f64], k: usize| {
            let past = (0..=na).map(|i| run[(k - i) * width]);
            let inputs = (0..self.channels).flat_map(|j| (0..nb).map(move |i| (j, i)));
            let inputs = inputs.map(|(j, i)| run[(k - nk - i) * width + 1 + j]);
            past.chain(inputs).collect::<Vec<f64>>()
        };
        let rows = self.runs.iter().flat_map(|run| {
            let last = run.len() / width;
            (first..last).map(move |k| row(run, k))
        });
        let rows: Vec<_> = rows.filter(|r| r.iter().all(|v| v.is_finite())).collect();
        let n = rows.len().min(POINTS);
        if n < FEWEST_POINTS {
            return f64::NAN;
        }
        let step = (rows.len() - 1) as f64 / (n - 1) as f64;
        let chosen = (0..n).map(|i| &rows[(i as f64 * step).round_ties_even() as usize]);
        let chosen: Vec<_> = chosen.collect();
        let most = chosen
            .iter()
            .map(|r| dot(&r[1..], &r[1..]))
            .fold(0.0, f64::max);
        let mut quotients = Vec::with_capacity(n * (n - 1) / 2);
        for (i, one) in chosen.iter().enumerate() {
            for other in &chosen[..i] {
                let apart = one[1..].iter().zip(&other[1..]);
                let apart: f64 = apart.map(|(a, b)| (a - b).powi(2)).sum();
                // distances within rounding do not count
                let near = apart <= 1e-14 * most;
                let moved = (one[0] - other[0]).powi(2);
                quotients.push(if near { 0.0 } else { moved / apart });
            }
        }
        let count = ((SHARE * n as f64) as usize).max(1);
        let at = quotients.len() - count;
        let (_, least, above) = quotients.select_nth_unstable_by(at, f64::total_cmp);
        if *least <= 0.0 {
            return f64::NAN;
        }
        let logs = least.ln() + above.iter().map(|q| q.ln()).sum::<f64>();
        ((rows[0].len() - 1) as f64).sqrt() * (0.5 * logs / count as f64).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// `y(k) = 1.2 y(k-1) - .4 y(k-2) + tanh(u(k-1)) + .5 u(k-2)`.
    fn recorded(n: usize) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(2);
        let u: Vec<f64> = (0..n).map(|_| 1.5 * random.normal()).collect();
        let mut y = vec![0.0; n];
        for k in 2..n {
            y[k] = 1.2 * y[k - 1] - 0.4 * y[k - 2] + u[k - 1].tanh() + 0.5 * u[k - 2];
        }
        (u, y)
    }

    #[test]
    fn the_true_orders_stand_out() {
        let (u, y) = recorded(2000);
        let cut = 1500;
        let train = [Samples::new(&u[..cut], 1, &y[..cut]).unwrap()];
        let later = [Samples::new(&u[cut..], 1, &y[cut..]).unwrap()];
        let grid = Grid {
            na: &[1, 2, 3],
            nb: &[1, 2],
            nk: &[1],
        };
        let monitor = Monitor::default();
        let found = table(&train, &later, grid, 20, &monitor).unwrap();
        assert_eq!(monitor.progress().0, 6);
        let of = |na: usize, nb: usize| {
            let row = |s: &&Structure| s.orders == (na, nb, 1);
            found.iter().find(row).unwrap()
        };
        let free = |na, nb| mean(&of(na, nb).blocks);
        assert!(free(2, 2) < 0.5 * free(1, 2) && free(2, 2) < 0.9 * free(2, 1));
        assert!((free(3, 2) / free(2, 2) - 1.0).abs() < 0.1);
        assert!(of(2, 2).lipschitz < 0.5 * of(1, 1).lipschitz);
        assert!(of(2, 2).criteria[2] < of(1, 2).criteria[2]);
        assert_eq!((of(2, 2).parameters, of(2, 2).blocks.len()), (5, BLOCKS));
    }

    #[test]
    fn parts_are_those_of_the_errors() {
        let model = LinearModel::new(vec![-0.5], vec![1.0], 1, 1, 0.0).unwrap();
        let u: Vec<f64> = (0..43).map(|k| (k as f64).sin()).collect();
        let mut y = model.simulate(&u, 1, &[0.0]).unwrap();
        (20..43).for_each(|k| y[k] += (k - 19) as f64);
        let found = blocks(&model, &[Record::new(&u, 1, &y).unwrap()], 20).unwrap();
        let square = |k: i32| f64::from(k * k);
        assert!((found[0] - (1.0 + square(2) + square(3)) / 3.0).abs() < 1e-3);
        assert!((found[9] - (square(22) + square(23)) / 2.0).abs() < 1e-3);
        let wild = LinearModel::new(vec![-30.0], vec![1.0], 1, 1, 0.0).unwrap();
        let long: Vec<f64> = u.iter().cycle().take(900).copied().collect();
        let found = blocks(&wild, &[Record::new(&long, 1, &long).unwrap()], 20).unwrap();
        assert_eq!(found, [f64::INFINITY; BLOCKS]);
    }

    #[test]
    fn hardly_any_data_are_refused() {
        let (u, y) = recorded(30);
        let samples = [Samples::new(&u, 1, &y).unwrap()];
        let grid = Grid {
            na: &[5],
            nb: &[5],
            nk: &[1],
        };
        let refused = table(&samples, &samples, grid, 20, &Monitor::default()).unwrap_err();
        assert!(refused.message.contains("record longer"));
        assert!(Points::of(&samples).index(5, 5, 9).is_nan());
    }
}
