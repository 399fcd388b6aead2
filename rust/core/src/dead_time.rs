//! The dead time of every input in three ways: regressions on lags, free runs of models with each delay, and the correlation of input
//! and output behind the filter that makes the input white (Box, Jenkins, Reinsel, *Time Series Analysis*, 2008, section 12.1).

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use crate::column::{dot, moments};
use crate::data::Samples;
use crate::fourier::{correlation, spectrum};
use crate::lagged::Lagged;
use crate::linear::LinearFit;
use crate::regression::{Solution, solve_scaled, triangle};
use crate::residuals::{products_of_lags, quantile};
use crate::{Error, ErrorKind, Monitor, Record, Result, iv};

/// Singular values below this part of the largest (for columns of length 1) count as zero.
const DEPENDENT: f64 = 1e-10;
/// Past outputs and inputs of the ARX models.
const ORDER: usize = 4;
/// Past outputs and inputs of the models whose free runs are compared; more could mimic a delay.
const REFINED: usize = 2;
const ITERATIONS: usize = 6;
/// Lags over which the residual's autocorrelations are summed.
const SMOOTH: usize = 2000;
/// Order of the autoregression that makes an input white.
const WHITENING: usize = 20;

/// The triangle of `[y(k), y(k-1) .., u_1(k) u_1(k-1) .., u_2(k) .., 1]` over all rows whose samples are known.
pub(crate) struct LaggedRegression {
    triangle: DMatrix<f64>,
    na: usize,
    lags: usize,
    channels: usize,
    /// Number of rows.
    pub samples: usize,
}

/// Least squares of y(k) on some of the columns.
pub(crate) struct OnLags {
    columns: Vec<usize>,
    pub solution: Solution,
    /// Sum of squared residuals.
    pub squares: f64,
}

impl LaggedRegression {
    /// With `na` past outputs, and `lags` values of each input from u(k) on back.
    pub fn new(experiments: &[Record], na: usize, lags: usize) -> Self {
        let channels = experiments.first().map_or(1, |e| e.channels);
        let row = |(e, k): (&Record, usize)| {
            let past = e.y[k - na..=k].iter().rev().copied();
            let inputs = (0..channels).flat_map(|j| (0..lags).map(move |i| (j, i)));
            let inputs = inputs.map(|(j, i)| e.u[(k - i) * channels + j]);
            past.chain(inputs).chain([1.0]).collect::<Vec<f64>>()
        };
        let first = na.max(lags - 1);
        let places = experiments
            .iter()
            .flat_map(|e| (first..e.len()).map(move |k| (e, k)));
        let rows = places
            .map(row)
            .filter(|row| row.iter().all(|v| v.is_finite()));
        let (triangle, samples) = triangle(2 + na + lags * channels, rows);
        Self {
            triangle,
            samples,
            na,
            lags,
            channels,
        }
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.triangle.ncols()
    }

    /// Least squares on `na` past outputs, each input's lags in its window, and a constant; of the least norm where they are dependent.
    pub fn solve(&self, na: usize, windows: &[Range<usize>]) -> OnLags {
        let first = 1 + self.na;
        let inputs = windows.iter().enumerate();
        let inputs = inputs.flat_map(|(j, w)| w.clone().map(move |lag| (j, lag)));
        let columns: Vec<usize> = (1..=na)
            .chain(inputs.map(|(j, lag)| first + j * self.lags + lag))
            .chain([first + self.lags * self.channels])
            .collect();
        let chosen = self.triangle.select_columns(&columns);
        let y = self.triangle.column(0).into_owned();
        let mut found = OnLags {
            columns,
            solution: solve_scaled(chosen, &y, DEPENDENT),
            squares: 0.0,
        };
        found.squares = self.squares(&found);
        found
    }

    /// Sum of squared one-step errors of a solution, perhaps found on other data.
    pub fn squares(&self, of: &OnLags) -> f64 {
        let chosen = self.triangle.select_columns(&of.columns);
        (self.triangle.column(0) - chosen * &of.solution.theta).norm_squared()
    }
}

/// The delay of one input. Lags count from the smallest that was tried.
#[derive(Clone, Debug)]
pub struct InputDelay {
    /// Index of the delay with the lowest cost in free run.
    pub best: usize,
    /// First and last plausible delay: likely by at least `1 - confidence` of the best one.
    pub plausible: (usize, usize),
    /// First lag that correlates beyond chance.
    pub correlated: Option<usize>,
    /// Mean square free-run error of a model with each delay; infinite if there is none.
    pub cost: Vec<f64>,
    /// Mean square one-step error of an ARX model with each delay.
    pub one_step_cost: Vec<f64>,
    /// Correlation at each lag behind the filter that makes the input white.
    pub correlation: Vec<f64>,
    /// Its bound for an input and an output that are independent, for all lags together.
    pub bound: f64,
}

/// The delays of all inputs, from `lags` samples on.
///
/// Models with two past outputs and two past inputs are fitted by instrumental variables for every delay, the other inputs at their own
/// best ones. The likelihood of a delay relative to the best is `(cost_best / cost)^(N/2)` with `N` the number of independent samples.
///
/// # Errors
/// `ErrorKind::Data` for too few samples; `ErrorKind::Fit` if no model has a finite free run, or after a stop request.
pub fn delay(
    experiments: &[Samples],
    lags: Range<usize>,
    confidence: f64,
    monitor: &Monitor,
) -> Result<Vec<InputDelay>> {
    let records = experiments.iter().map(Samples::record);
    let records = records.collect::<Result<Vec<_>>>()?;
    let channels = records.first().map_or(0, |r| r.channels);
    let reach = lags.end - 1 + ORDER;
    let regression = LaggedRegression::new(&records, ORDER, reach);
    let (needed, samples) = (2 * regression.width(), regression.samples);
    if samples < needed {
        return Err(Error::data(format!(
            "expected at least {needed} samples with {reach} samples before them, got {samples}; lower `longest`, or record longer"
        )));
    }
    let one_step: Vec<_> = (0..channels)
        .map(|j| one_step_costs(&regression, j, &lags))
        .collect();
    let mut best: Vec<usize> = one_step.iter().map(|c| lags.start + least(c)).collect();
    let mut costs = one_step.clone();
    for _ in 0..if channels == 1 { 1 } else { 2 } {
        for j in 0..channels {
            costs[j] = free_run_costs(&records, j, &lags, &best, monitor)?;
            best[j] = lags.start + least(&costs[j]);
        }
    }
    let independent = independent_samples(&records, &best, monitor)?;
    // rounding: a clean record has costs of nearly zero, whose ratios mean nothing
    let floor = 1e-16 * known(records.iter().flat_map(|r| r.y)).1.powi(2);
    let all = costs.into_iter().zip(one_step).enumerate();
    let found = all.map(|(j, (cost, one_step_cost))| {
        let at = least(&cost);
        let likely = |c: &f64| {
            let deviance = independent * ((c + floor) / (cost[at] + floor)).ln();
            deviance <= -2.0 * (1.0 - confidence).ln()
        };
        let (correlation, samples) = prewhitened(&records, j, &lags);
        // a significance of each lag such that all together keep the level (Sidak)
        let each = 1.0 - confidence.powf(1.0 / lags.len() as f64);
        let bound = (quantile(each, 1) / samples as f64).sqrt();
        InputDelay {
            best: at,
            plausible: (
                cost.iter().position(likely).unwrap_or(at),
                cost.iter().rposition(likely).unwrap_or(at),
            ),
            correlated: correlation.iter().position(|c| c.abs() > bound),
            cost,
            one_step_cost,
            correlation,
            bound,
        }
    });
    Ok(found.collect())
}

/// Index of the first lowest cost.
fn least(costs: &[f64]) -> usize {
    let lowest = costs.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1));
    lowest.map_or(0, |(i, _)| i)
}

/// Mean square errors of ARX models in which the other inputs have all lags.
fn one_step_costs(regression: &LaggedRegression, j: usize, lags: &Range<usize>) -> Vec<f64> {
    let cost = |nk: usize| {
        let mut windows = vec![0..regression.lags; regression.channels];
        windows[j] = nk..nk + ORDER;
        regression.solve(ORDER, &windows).squares / regression.samples as f64
    };
    lags.clone().map(cost).collect()
}

/// Mean square free-run errors with input `j` delayed by each lag, the others by their best.
fn free_run_costs(
    records: &[Record],
    j: usize,
    lags: &Range<usize>,
    best: &[usize],
    monitor: &Monitor,
) -> Result<Vec<f64>> {
    let mut delays = best.to_vec();
    let mut cost = |nk: usize| {
        delays[j] = nk;
        match refined(records, &delays, monitor) {
            Ok((fit, _)) => Ok(2.0 * fit.cost),
            Err(e) if e.kind == ErrorKind::Setting || monitor.stopped() => Err(e),
            Err(_) => Ok(f64::INFINITY),
        }
    };
    let costs = lags.clone().map(&mut cost).collect::<Result<Vec<_>>>()?;
    if costs.iter().all(|c| !c.is_finite()) {
        return Err(Error::fit(
            "expected a linear model with a finite free run, found none at any delay; check units and signs, or record with more excitation",
        ));
    }
    Ok(costs)
}

/// The second-order model with these delays, and the inputs that it had.
fn refined(
    records: &[Record],
    delays: &[usize],
    monitor: &Monitor,
) -> Result<(LinearFit, Vec<Vec<f64>>)> {
    let inputs: Vec<_> = records.iter().map(|r| delayed(r, delays)).collect();
    let late: Vec<_> = records
        .iter()
        .zip(&inputs)
        .map(|(r, u)| Record { u, ..*r })
        .collect();
    let fit = iv::fit(&late, REFINED, REFINED, 1, true, ITERATIONS, monitor)?;
    if monitor.stopped() {
        return Err(Error::fit(
            "expected to be left alone, got a request to stop",
        ));
    }
    Ok((fit, inputs))
}

/// Inputs delayed by one sample less than `delays`, held at their first values.
fn delayed(record: &Record, delays: &[usize]) -> Vec<f64> {
    let n = record.len() as isize;
    let input = |k: isize, j: usize| record.input(k.min(n - 1))[j];
    let row = |k: isize| {
        delays
            .iter()
            .enumerate()
            .map(move |(j, d)| (k + 1 - *d as isize, j))
    };
    (0..n).flat_map(row).map(|(k, j)| input(k, j)).collect()
}

/// Samples over the sum of the residual's squared autocorrelations (Bartlett 1946): a nonlinear drive leaves a smooth residual, which
/// carries less information than its length suggests.
fn independent_samples(records: &[Record], delays: &[usize], monitor: &Monitor) -> Result<f64> {
    let (fit, inputs) = refined(records, delays, monitor)?;
    let (mut products, mut samples) = (vec![0.0; 1], 0);
    for ((record, u), state) in records.iter().zip(&inputs).zip(&fit.initial_states) {
        let (first, channels) = (record.first_measured(), record.channels);
        let run = fit
            .model
            .simulate(&u[first * channels..], channels, state)?;
        let mut error: Vec<f64> = record.y[first..]
            .iter()
            .zip(run)
            .map(|(y, run)| y - run)
            .collect();
        let middle = known(error.iter()).0;
        for e in &mut error {
            *e = if e.is_finite() { *e - middle } else { 0.0 };
        }
        let of = spectrum(&error, (2 * error.len()).next_power_of_two());
        let found = correlation(&of, &of);
        let kept = (error.len() / 4 + 1).min(SMOOTH);
        products.resize(products.len().max(kept), 0.0);
        products
            .iter_mut()
            .zip(&found[..kept])
            .for_each(|(sum, found)| *sum += found);
        samples += record.measured();
    }
    let samples = samples as f64;
    if products[0] <= 0.0 {
        return Ok(samples);
    }
    let squares = products[1..].iter().map(|p| (p / products[0]).powi(2));
    // squared autocorrelations of a white residual have the mean 1/N
    let excess = squares.sum::<f64>() - (products.len() - 1) as f64 / samples;
    Ok(samples / (1.0 + 2.0 * excess.max(0.0)))
}

/// Correlation of input `j` and the output behind the filter that makes the input white, and the number of outputs.
fn prewhitened(records: &[Record], j: usize, lags: &Range<usize>) -> (Vec<f64>, usize) {
    let columns: Vec<Vec<f64>> = records
        .iter()
        .map(|r| r.u.iter().skip(j).step_by(r.channels).copied().collect())
        .collect();
    let filter = whitener(&columns);
    let (mut sums, mut power, mut samples) = (vec![0.0; lags.len()], [0.0; 2], 0);
    for (record, u) in records.iter().zip(&columns) {
        let (u, mut y) = (filtered(u, &filter), filtered(record.y, &filter));
        samples += y.iter().filter(|y| y.is_finite()).count();
        for y in y.iter_mut().filter(|y| !y.is_finite()) {
            *y = 0.0;
        }
        for (sum, lag) in sums.iter_mut().zip(lags.clone()) {
            *sum += dot(&u, y.get(lag..).unwrap_or_default());
        }
        power = [power[0] + dot(&u, &u), power[1] + dot(&y, &y)];
    }
    let size = (power[0] * power[1]).sqrt();
    if size > 0.0 {
        sums.iter_mut().for_each(|s| *s /= size);
    }
    (sums, samples.max(1))
}

/// The filter `[1, c_1, .., c_n]` that makes the series white, by least squares.
fn whitener(series: &[Vec<f64>]) -> Vec<f64> {
    let shortest = series.iter().map(|s| s.len().saturating_sub(1) / 4).min();
    let order = WHITENING.min(shortest.unwrap_or(0));
    let middle = known(series.iter().flatten()).0;
    let about = |s: &Vec<f64>| s.iter().map(|v| v - middle).collect();
    let series: Vec<Vec<f64>> = series.iter().map(about).collect();
    let known: Vec<_> = series.iter().map(|s| vec![true; s.len()]).collect();
    let (sums, _) = products_of_lags(&series, &known, order);
    // the ridge bounds the filter for inputs that few parameters describe (steps, sines)
    let ridge = DMatrix::identity(order, order) * (1e-8 * sums[(0, 0)]);
    let own = sums.view((1, 1), (order, order)) + ridge;
    let right = sums.view((1, 0), (order, 1)).column(0).into_owned();
    let found = own.lu().solve(&right);
    let found = found.unwrap_or_else(|| DVector::zeros(order));
    [1.0].into_iter().chain(found.iter().map(|c| -c)).collect()
}

/// The values about their mean behind a filter, without those that need samples before the first.
fn filtered(values: &[f64], filter: &[f64]) -> Vec<f64> {
    let middle = known(values.iter()).0;
    let about: Vec<f64> = values.iter().map(|v| v - middle).collect();
    let one = |window: &[f64]| window.iter().rev().zip(filter).map(|(v, f)| v * f).sum();
    about.windows(filter.len()).map(one).collect()
}

/// Mean and deviation of the values that are known.
fn known<'a>(values: impl Iterator<Item = &'a f64> + Clone) -> (f64, f64) {
    moments(values.copied().filter(|v| v.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Inputs row by row and the output of a lag of the first order, in which input `j` acts `delays[j]` samples late.
    fn recorded(n: usize, delays: &[usize], noise: f64) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(4);
        let m = delays.len();
        let mut u = vec![0.0; n * m];
        for j in 0..m {
            let mut level = 0.0;
            for k in 0..n {
                if k % 7 == 0 {
                    level = random.normal();
                }
                u[k * m + j] = level;
            }
        }
        let mut y = vec![0.0; n];
        for k in 1..n {
            let at = |back: usize, j: usize| u[k.saturating_sub(back) * m + j];
            let moved = |(j, d): (usize, &usize)| at(*d, j) + 0.7 * at(*d + 1, j);
            y[k] = 0.8 * y[k - 1] + delays.iter().enumerate().map(moved).sum::<f64>();
        }
        y.iter_mut().for_each(|y| *y += noise * random.normal());
        (u, y)
    }

    fn found(u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<InputDelay>> {
        let samples = [Samples::new(u, channels, y).unwrap()];
        delay(&samples, 1..13, 0.95, &Monitor::default())
    }

    #[test]
    fn every_input_has_its_own_delay() {
        for (delays, noise) in [(vec![3], 0.05), (vec![1], 0.0), (vec![7, 2], 0.02)] {
            let (u, mut y) = recorded(900, &delays, noise);
            y[100..110].fill(f64::NAN);
            let all = found(&u, delays.len(), &y).unwrap();
            for (input, delay) in all.iter().zip(&delays) {
                assert_eq!(1 + input.best, *delay);
                assert!(input.plausible.0 <= input.best && input.best <= input.plausible.1);
                assert_eq!(input.correlated.map(|lag| 1 + lag), Some(*delay));
                assert_eq!(input.correlation.len(), 12);
            }
        }
    }

    #[test]
    fn regressions_on_lags_are_those_of_the_rows() {
        let (u, y) = recorded(400, &[2, 5], 0.1);
        let records = [Record::new(&u, 2, &y).unwrap()];
        let regression = LaggedRegression::new(&records, 3, 8);
        let found = regression.solve(2, &[1..4, 2..6]);
        let first = 7;
        let rows = DMatrix::from_fn(400 - first, 10, |i, c| match (i + first, c) {
            (k, 0..2) => y[k - 1 - c],
            (k, 2..5) => u[(k - (c - 1)) * 2],
            (k, 5..9) => u[(k - (c - 3)) * 2 + 1],
            _ => 1.0,
        });
        let target = DVector::from_iterator(400 - first, y[first..].iter().copied());
        let normal = rows.tr_mul(&rows).cholesky().unwrap();
        let theta = normal.solve(&rows.tr_mul(&target));
        let squares = (&target - &rows * &theta).norm_squared();
        assert_eq!((regression.samples, found.solution.rank), (400 - first, 10));
        assert!((found.solution.theta - theta).amax() < 1e-9);
        assert!((found.squares - squares).abs() < 1e-9 * squares);
    }

    #[test]
    fn too_few_samples_are_refused() {
        let (u, y) = recorded(40, &[1], 0.1);
        let refused = found(&u, 1, &y).unwrap_err();
        assert!(refused.message.contains("record longer"));
    }
}
