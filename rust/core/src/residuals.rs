//! Tests of a model's residuals: is anything left in them that the inputs, the output or their own past explain?
//!
//! A test is a set of correlations under one verdict (`sums.rs`). Billings and Voon, *Int. J. Control* 38 (1983) 193 and 44 (1986) 235; for
//! powers of the computed output Ramsey, *J. Royal Statistical Society B* 31 (1969) 350. The means of inputs and of their squares and
//! products are removed.

mod chi_square;
mod columns;
mod noise;
mod sums;
#[cfg(test)]
mod tests;

use nalgebra::DMatrix;

pub use chi_square::{quantile, tail};
use columns::{Columns, constant, independent, lagged, leading};
pub use noise::Noise;
pub(crate) use noise::products_of_lags;
use sums::Sums;

use crate::{Error, Monitor, Result};

/// Correlations in one test, for a single series and at the most.
const LAGS: usize = 25;
const LARGEST_SET: usize = 50;
/// Samples for each correlation of a short record.
const SAMPLES_PER_LAG: usize = 8;
/// Least information of a direction in which parameters move, relative to the largest: double precision ends there.
const DETERMINED: f64 = 1e-10;
/// The same where a change of the parameters has to be small for the model to be linear in it.
const FOLLOWED: f64 = 1e-4;
/// Binary exponent up to which values are used as they are: sixth powers of the tests neither overflow nor underflow.
const MODERATE: i32 = 60;
/// Rounding of a mean, as a share of it.
const ROUNDING: f64 = 1e-12;
/// Standard deviations at which a residual is cut off before it is squared: a single outlier would dominate.
const CUT: f64 = 3.0;

/// One experiment.
#[derive(Clone, Copy, Debug)]
pub struct Run<'a> {
    /// Inputs, time first.
    pub u: &'a [f64],
    /// Computed output.
    pub output: &'a [f64],
    /// Residual without mean and without the initial state's effect; 0 where a sample does not count.
    pub error: &'a [f64],
    /// Whether a sample counts: it is measured and comes after the initial ones.
    pub counts: &'a [bool],
    /// Sensitivity of the output to the parameters, time first; 0 where a sample does not count.
    pub sensitivity: &'a [f64],
}

/// One test of a set of correlations.
#[derive(Clone, Debug)]
pub struct Test {
    /// Samples by which the second series is earlier.
    pub lags: Vec<usize>,
    /// The second series: products of these inputs.
    pub series: Vec<Vec<usize>>,
    /// Series by series, lag by lag.
    pub correlations: Vec<f64>,
    /// 99 % of single correlations are not larger.
    pub limits: Vec<f64>,
    /// Chi-square of all correlations together; NaN if nothing can be tested.
    pub statistic: f64,
    /// Probability of a larger statistic.
    pub p_value: f64,
    /// Degrees of freedom of the statistic.
    pub freedom: usize,
    /// Value that the statistic exceeds by chance for one good model in a hundred.
    pub threshold: f64,
    /// Share of the residual's power that the correlations explain, beyond chance.
    pub explained: f64,
}

/// The tests, in this order: `e` with its own past; with past inputs, their squares, their cubes; with powers of the computed output;
/// `e^2` with squares of past inputs; `e(k)` with `e(k-1-lag) u(k-1-lag)`; inputs with past residuals.
///
/// `memory` is the number of samples over which the initial state fades: the lags reach that far. `one_step`: the residuals are those of
/// predictions, and their sensitivities carry noise.
///
/// # Errors
/// `ErrorKind::Data` for runs of uneven lengths, or no sample that counts; `ErrorKind::Fit` on a stop.
pub fn tests(
    runs: &[Run<'_>],
    channels: usize,
    memory: usize,
    one_step: bool,
    monitor: &Monitor,
) -> Result<Vec<Test>> {
    check(runs, channels)?;
    let setting = Setting::new(runs, channels, memory, one_step);
    let all: [fn(&Setting) -> Test; 8] = [
        Setting::own_past,
        Setting::past_inputs,
        Setting::past_squares,
        Setting::past_cubes,
        Setting::computed_output,
        Setting::squared_residual,
        Setting::residual_times_input,
        Setting::feedback,
    ];
    let mut found = Vec::with_capacity(all.len());
    for test in all {
        if monitor.stopped() {
            return Err(Error::fit("stopped before the residuals were tested"));
        }
        found.push(test(&setting));
    }
    Ok(found)
}

/// Whether other parameters would do better on data that the model was not trained on.
///
/// The residual is tested against its significant sensitivities, one "lag" each. The variance allows for the uncertainty that
/// training on `trained` samples leaves; 0: it is not known.
///
/// # Errors
/// As [`tests`].
pub fn parameters(runs: &[Run<'_>], channels: usize, trained: usize) -> Result<Test> {
    check(runs, channels)?;
    let counts = counts(runs);
    let sensitivities: Vec<_> = runs.iter().map(sensitivity).collect();
    let basis = independent(&sensitivities, FOLLOWED);
    let lags = (0..basis[0].width()).collect();
    let errors = errors(runs);
    let noise = Noise::fit(&errors, &counts, 0.0, false);
    let mut sums = Sums::new(basis, &errors, &noise, &constant(&counts));
    if trained > 0 {
        let n: usize = counts.iter().map(|c| number(c)).sum();
        sums.covariance *= 1.0 + n as f64 / trained as f64;
    }
    Ok(sums.test(lags, vec![vec![0]], None))
}

/// `Psi' R Psi` over all experiments, `R` the covariance matrix of the residuals, of which the parameters took `spent` degrees of
/// freedom: the middle factor of the sandwich covariance.
///
/// # Errors
/// As [`tests`].
pub fn coloured_information(runs: &[Run<'_>], channels: usize, spent: f64) -> Result<DMatrix<f64>> {
    check(runs, channels)?;
    let noise = Noise::fit(&errors(runs), &counts(runs), spent, false);
    let sensitivities: Vec<_> = runs.iter().map(sensitivity).collect();
    Ok(noise.power_of(sensitivities))
}

fn check(runs: &[Run<'_>], channels: usize) -> Result<()> {
    let is_even = |run: &Run<'_>| {
        let n = run.counts.len();
        n > 0
            && [run.output.len(), run.error.len()] == [n, n]
            && run.u.len() == n * channels
            && run.sensitivity.len().is_multiple_of(n)
    };
    let width = |run: &Run<'_>| run.sensitivity.len() / run.counts.len();
    let even = channels > 0
        && runs.iter().all(is_even)
        && runs.iter().all(|run| width(run) == width(&runs[0]));
    if !even {
        return Err(Error::data(
            "expected runs with one number of samples for all series, and one of parameters; give each run whole",
        ));
    }
    if !runs.iter().any(|run| number(run.counts) > 0) {
        return Err(Error::data(
            "expected samples that count, got none; give a longer range",
        ));
    }
    Ok(())
}

fn number(counts: &[bool]) -> usize {
    counts.iter().filter(|c| **c).count()
}

fn counts(runs: &[Run<'_>]) -> Vec<Vec<bool>> {
    runs.iter().map(|run| run.counts.to_vec()).collect()
}

fn errors(runs: &[Run<'_>]) -> Vec<Vec<f64>> {
    runs.iter().map(|run| run.error.to_vec()).collect()
}

fn sensitivity(run: &Run<'_>) -> Columns {
    Columns::new(run.sensitivity.to_vec(), run.counts.len())
}

/// What the tests share.
struct Setting {
    inputs: Vec<Columns>,
    outputs: Vec<Columns>,
    counts: Vec<Vec<bool>>,
    errors: Vec<Vec<f64>>,
    noise: Noise,
    /// Basis of the changes of the output by parameters and mean.
    directions: Vec<Columns>,
    /// Whether all values are known that an innovation depends on.
    known: Vec<Vec<bool>>,
    /// Innovations, and the basis of what parameters and mean do to them.
    white: Vec<Vec<f64>>,
    white_directions: Vec<Columns>,
    channels: usize,
    memory: usize,
    one_step: bool,
}

impl Setting {
    fn new(runs: &[Run<'_>], channels: usize, memory: usize, one_step: bool) -> Self {
        let counts = counts(runs);
        let with_mean = runs.iter().map(|run| {
            let mean = Columns::of(run.counts, |c| f64::from(u8::from(*c)));
            sensitivity(run).beside(&mean)
        });
        let directions = independent(&with_mean.collect::<Vec<_>>(), DETERMINED);
        let mut inputs: Vec<_> = runs
            .iter()
            .map(|run| Columns::new(run.u.to_vec(), run.counts.len()))
            .collect();
        let mut outputs: Vec<_> = runs
            .iter()
            .map(|run| Columns::of(run.output, |y| *y))
            .collect();
        let mut errors = errors(runs);
        // the tests do not depend on units, and powers of two change no digit
        for j in 0..channels {
            let size = largest(inputs.iter().flat_map(|u| u.column(j)));
            let exponent = excess(size);
            inputs.iter_mut().for_each(|u| u.scale(j, exponent));
        }
        let exponent = excess(largest(runs.iter().flat_map(|run| {
            let counted = run.output.iter().zip(run.counts).filter(|(_, c)| **c);
            counted.map(|(y, _)| *y)
        })));
        outputs.iter_mut().for_each(|y| y.scale(0, exponent));
        let all = errors.iter_mut().flatten();
        all.for_each(|e| *e = scaled(*e, exponent));

        let noise = Noise::fit(&errors, &counts, directions[0].width() as f64, false);
        let known: Vec<Vec<bool>> = counts.iter().map(|c| noise.known(c)).collect();
        let white_directions = whitened_basis(&directions, &known, &noise);
        let white = innovations(&errors, &white_directions, &known, &noise);
        Self {
            inputs,
            outputs,
            counts,
            errors,
            noise,
            directions,
            known,
            white,
            white_directions,
            channels,
            memory,
            one_step,
        }
    }

    /// As many lags as the record's length and the number of series allow: dense at first, as far as the memory reaches.
    fn lags(&self, series: usize) -> Vec<usize> {
        let n: usize = self.counts.iter().map(|c| number(c)).sum();
        let room = (n / (SAMPLES_PER_LAG * series)).max(2);
        let count = LAGS.min((LARGEST_SET / series).max(5)).min(room);
        lags_over(self.memory, n, count)
    }

    /// Pairs of inputs; of many inputs only the squares, as all products would leave too few lags.
    fn pairs(&self) -> Vec<Vec<usize>> {
        let n = self.channels;
        (0..n)
            .flat_map(|i| (i..n).map(move |j| (i, j)))
            .filter(|(i, j)| n <= 3 || i == j)
            .map(|(i, j)| vec![i, j])
            .collect()
    }

    fn each_input(&self, power: usize) -> Vec<Vec<usize>> {
        (0..self.channels).map(|i| vec![i; power]).collect()
    }

    /// Products of the inputs about their means, about the means of the products.
    fn products_of_inputs(&self, series: &[Vec<usize>]) -> Vec<Columns> {
        centred(Columns::products(&centred(self.inputs.clone()), series))
    }

    fn past(&self, columns: &[Columns], lags: &[usize]) -> Vec<Columns> {
        let pairs = columns.iter().zip(&self.counts);
        pairs.map(|(z, c)| lagged(z, lags, c)).collect()
    }

    /// The test of the residual, plain and whitened, against columns without noise.
    fn with(
        &self,
        lags: Vec<usize>,
        series: Vec<Vec<usize>>,
        instruments: Vec<Columns>,
        own: Option<Vec<Columns>>,
    ) -> Test {
        let white_basis = own
            .as_ref()
            .map(|own| whitened_basis(own, &self.known, &self.noise));
        let basis = own.map(|own| independent(&own, DETERMINED));
        let flat = whitened(&instruments, &self.known, &self.noise);
        let plain = Sums::new(
            instruments,
            &self.errors,
            &self.noise,
            basis.as_ref().unwrap_or(&self.directions),
        );
        let known: usize = self.known.iter().map(|k| number(k)).sum();
        let room = known.saturating_sub(self.white_directions[0].width());
        let white = Sums::new(
            flat,
            &self.white,
            &Noise::white(self.innovation_power() / room.max(1) as f64),
            white_basis.as_ref().unwrap_or(&self.white_directions),
        );
        plain.test(lags, series, Some(&white))
    }

    fn innovation_power(&self) -> f64 {
        self.white.iter().flatten().map(|w| w * w).sum()
    }

    fn own_past(&self) -> Test {
        let lags: Vec<usize> = self.lags(1).iter().map(|lag| lag + 1).collect();
        let errors: Vec<_> = self.errors.iter().map(|e| Columns::of(e, |e| *e)).collect();
        // the sensitivities of a free run are free of noise: only the mean is projected out
        let mean = constant(&self.counts);
        let basis = if self.one_step {
            &self.directions
        } else {
            &mean
        };
        let white = Noise::white(self.noise.variance);
        let sums = Sums::new(self.past(&errors, &lags), &self.errors, &white, basis);
        sums.test(lags, vec![vec![0]], None)
    }

    fn past_inputs(&self) -> Test {
        self.powers_of_inputs(self.each_input(1))
    }

    fn past_squares(&self) -> Test {
        self.powers_of_inputs(self.pairs())
    }

    /// Saturation and dead zone are odd functions, which squares do not detect.
    fn past_cubes(&self) -> Test {
        self.powers_of_inputs(self.each_input(3))
    }

    fn powers_of_inputs(&self, series: Vec<Vec<usize>>) -> Test {
        let lags = self.lags(series.len());
        let past = self.past(&self.products_of_inputs(&series), &lags);
        self.with(lags, series, past, None)
    }

    /// Powers of the computed output, which depends on the input's whole past.
    fn computed_output(&self) -> Test {
        let series = vec![vec![0; 2], vec![0; 3]];
        let lags = self.lags(series.len());
        let mut outputs = centred(self.outputs.clone());
        let n: usize = outputs.iter().map(Columns::len).sum();
        let power: f64 = outputs
            .iter()
            .flat_map(|y| y.column(0))
            .map(|y| y * y)
            .sum();
        let spread = (power / n as f64).sqrt().max(1e-300);
        outputs.iter_mut().for_each(|y| y.divide(spread));
        let powers = centred(Columns::products(&outputs, &series));
        let past = self.past(&powers, &lags);
        self.with(lags, series, past, None)
    }

    fn squared_residual(&self) -> Test {
        let series = self.pairs();
        let lags = self.lags(series.len());
        let squares = self.products_of_inputs(&series);
        let pairs = squares.iter().zip(&self.known);
        let past = pairs.map(|(q, k)| lagged(q, &lags, k)).collect();
        let bound = CUT * self.noise.innovation.sqrt();
        let mut power: Vec<Vec<f64>> = self
            .white
            .iter()
            .map(|w| w.iter().map(|w| w.abs().min(bound).powi(2)).collect())
            .collect();
        about_mean(&mut power, &self.known);
        let noise = Noise::fit(&power, &self.known, 0.0, true);
        Sums::new(past, &power, &noise, &constant(&self.known)).test(lags, series, None)
    }

    /// For white `w` only the sum of `u(k-1-a)^2 w(k)^2 w(k-1-a)^2` enters the covariance.
    fn residual_times_input(&self) -> Test {
        let series = self.each_input(1);
        let lags = self.lags(series.len());
        let late: Vec<usize> = lags.iter().map(|lag| lag + 1).collect();
        let inputs = centred(self.inputs.clone());
        let past = inputs
            .into_iter()
            .zip(&self.white)
            .zip(&self.known)
            .map(|((u, w), k)| lagged(&u.times(w), &late, k))
            .collect();
        let known: usize = self.known.iter().map(|k| number(k)).sum();
        let white = Noise::white(self.innovation_power() / known.max(1) as f64);
        Sums::new(past, &self.white, &white, &constant(&self.known)).test(lags, series, None)
    }

    /// That an input is told by its own past is no response to the residual.
    fn feedback(&self) -> Test {
        let series = self.each_input(1);
        let lags = self.lags(series.len());
        let late: Vec<usize> = lags.iter().map(|lag| lag + 1).collect();
        let inputs = centred(self.inputs.clone());
        let pairs = inputs.iter().zip(&self.counts);
        let ahead = pairs.map(|(u, c)| leading(u, &late, c)).collect();
        let past = self.past(&inputs, &lags);
        let pairs = self.directions.iter().zip(&past);
        let own = pairs.map(|(d, z)| d.clone().beside(z)).collect();
        self.with(late, series, ahead, Some(own))
    }
}

/// Lags from 0 on: one after the other for a short memory, else `memory (i / (count - 1))^2`.
fn lags_over(memory: usize, samples: usize, count: usize) -> Vec<usize> {
    let steps = count.saturating_sub(1).max(1);
    let reach = memory.min(samples / 10).max(count - 1) as f64;
    let wide = |i: usize| (reach * (i as f64 / steps as f64).powi(2)).round_ties_even() as usize;
    let mut lags: Vec<usize> = (0..count).map(|i| i.max(wide(i))).collect();
    lags.dedup();
    lags
}

fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, |most, v| v.abs().max(most))
}

/// The binary exponent of a size that is not moderate, else 0.
fn excess(size: f64) -> i32 {
    if size == 0.0 || !size.is_finite() {
        return 0;
    }
    let exponent = size.log2().floor() as i32 + 1;
    if exponent.abs() > MODERATE {
        exponent
    } else {
        0
    }
}

/// `value 2^-exponent`, in two steps, as the factor alone can overflow.
fn scaled(value: f64, exponent: i32) -> f64 {
    let half = exponent / 2;
    value * 2.0_f64.powi(-half) * 2.0_f64.powi(half - exponent)
}

/// Columns minus their means over all experiments.
fn centred(mut columns: Vec<Columns>) -> Vec<Columns> {
    let n: usize = columns.iter().map(Columns::len).sum();
    for j in 0..columns[0].width() {
        let sum: f64 = columns.iter().flat_map(|c| c.column(j)).sum();
        let mean = sum / n as f64;
        columns.iter_mut().for_each(|c| c.shift(j, -mean));
        // what is left of a constant is rounding
        if largest(columns.iter().flat_map(|c| c.column(j))) <= ROUNDING * mean.abs() {
            columns.iter_mut().for_each(|c| c.clear(j));
        }
    }
    columns
}

/// Series minus their mean over the known samples; 0 where a sample is not known.
fn about_mean(series: &mut [Vec<f64>], known: &[Vec<bool>]) {
    let n: usize = known.iter().map(|k| number(k)).sum();
    let pairs = || series.iter().flatten().zip(known.iter().flatten());
    let sum: f64 = pairs().filter(|(_, k)| **k).map(|(x, _)| x).sum();
    let mean = sum / n.max(1) as f64;
    for (x, k) in series.iter_mut().flatten().zip(known.iter().flatten()) {
        *x = if *k { *x - mean } else { 0.0 };
    }
}

fn whitened(columns: &[Columns], known: &[Vec<bool>], noise: &Noise) -> Vec<Columns> {
    let pairs = columns.iter().zip(known);
    pairs.map(|(c, k)| noise.whitened(c).only(k)).collect()
}

fn whitened_basis(columns: &[Columns], known: &[Vec<bool>], noise: &Noise) -> Vec<Columns> {
    independent(&whitened(columns, known, noise), DETERMINED)
}

/// Whitened residuals without the effect of the parameters: a change of these that is too small to be seen in a residual can be large
/// compared with its innovation.
fn innovations(
    errors: &[Vec<f64>],
    basis: &[Columns],
    known: &[Vec<bool>],
    noise: &Noise,
) -> Vec<Vec<f64>> {
    let columns: Vec<_> = errors.iter().map(|e| Columns::of(e, |e| *e)).collect();
    let mut white = whitened(&columns, known, noise);
    let taken = columns::cross(basis, &white);
    for (w, d) in white.iter_mut().zip(basis) {
        w.subtract(d, &taken);
    }
    white.into_iter().map(Columns::into_values).collect()
}
