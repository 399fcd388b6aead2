//! Refined instrumental variables (SRIV): unbiased by measurement noise, without a search.

mod step;

use std::rc::Rc;

use nalgebra::{DMatrix, DVector};

use crate::lagged::{Lagged, Lags};
use crate::level::about_level;
use crate::linear::{LinearFit, LinearModel, covariance_rows, soften, stabilised};
use crate::lm::Termination;
use crate::{Error, Monitor, Record, Result, arx};
use step::Refiner;

pub(crate) use step::Outputs;

/// A change of the free run below this part of the spread caused by noise does not matter: it is less than 1 % of the
/// estimate's variance. Directions that the data hardly determine keep moving within it.
const SMALL_CHANGE: f64 = 0.1;
/// A change of the free run below this part of the output's spread is rounding.
const ROUNDING: f64 = 1e-9;

/// Fits `LinearModel` by simple refined instrumental variables over all experiments.
///
/// Each iteration filters inputs and outputs by `1/A` of the previous model and solves
/// `sum z(k) (y_f(k) - phi_f(k)' theta) = 0`. The instruments `z` are the regressors with the model's own free run
/// instead of the measured outputs (Young 1976; Young 2011, section 6.4). If the noise is white and added to the
/// output, a fixed point is asymptotically as good as output error. The unknown state before each experiment is
/// estimated as well. The iteration starts at the ARX model; poles outside the unit circle are mirrored into it.
///
/// The outcome is `SmallStep` if the free run no longer changes; `Stalled` if that is only because a pole was mirrored;
/// `RankDeficient` if the instruments do not determine the parameters; or `MaxIterations`. In all but the first case
/// the iterate with the best free run is kept.
///
/// ```
/// use sewfast_core::lagged::Lagged;
/// use sewfast_core::linear::LinearModel;
/// use sewfast_core::{Monitor, Record, iv};
///
/// let truth = LinearModel::new(vec![-0.9], vec![0.2], 1, 1, 0.5)?;
/// let u: Vec<f64> = (0..200).map(|k| f64::from(k * k % 7)).collect();
/// let y = truth.simulate(&u, 1, &[3.0])?;
/// let records = [Record::new(&u, 1, &y)?];
/// let fit = iv::fit(&records, 1, 1, 1, true, 20, &Monitor::default())?;
/// assert!((fit.model.a()[0] + 0.9).abs() < 1e-9);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
///
/// # Errors
/// As [`arx::fit`] for unusable data and settings; `ErrorKind::Setting` for records with weights, `ErrorKind::Fit` if
/// the first model has no finite free run.
pub fn fit(
    records: &[Record],
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<LinearFit> {
    if records.iter().any(|r| r.weights.is_some()) {
        return Err(Error::setting(
            "weights: expected none for instrumental variables, which take no weights between 0 and 1, got some; leave them out, mask what is not to count (weight 0), or fit arx or oe",
        ));
    }
    let lags = arx::check(records, na, nb, nk)?;
    require_enough(records, &lags, offset)?;
    about_level(records, offset, |records, _| {
        let first = arx::fit(records, na, nb, nk, offset)?;
        let refiner = Refiner::new(records, lags, offset, monitor);
        monitor.set_total(max_iterations as u64);
        let start = with_denominator(&first, stabilised(first.a()));
        let start = start.and_then(|m| refiner.point(m)).ok_or_else(no_model)?;
        let mut search = Search::new(start);
        search.termination = search.iterate(&refiner, records, max_iterations, monitor);
        Ok(search.fit(&refiner, records))
    })
}

/// The state of the iteration: the present point and the best free run so far.
struct Search {
    present: Rc<Point>,
    best: Rc<Point>,
    trace: Vec<f64>,
    termination: Termination,
}

impl Search {
    fn new(start: Point) -> Self {
        let start = Rc::new(start);
        Self {
            trace: vec![start.cost()],
            best: Rc::clone(&start),
            present: start,
            termination: Termination::MaxIterations,
        }
    }

    fn iterate(
        &mut self,
        refiner: &Refiner,
        records: &[Record],
        max_iterations: usize,
        monitor: &Monitor,
    ) -> Termination {
        let rounding = ROUNDING * spread(records);
        let small = SMALL_CHANGE * self.present.relative_spread();
        for _ in 0..max_iterations {
            let found = refiner.refine(&self.present, Outputs::Simulated);
            let next = found.and_then(|e| Some((refiner.point(e.model)?, e.reflected)));
            if monitor.stopped() {
                return Termination::Interrupted;
            }
            let Some((next, reflected)) = next else {
                return Termination::RankDeficient;
            };
            let (cost, next) = (next.cost(), Rc::new(next));
            let rests = next.change(&self.present) <= (small * (2.0 * cost).sqrt()).max(rounding);
            if cost < self.best.cost() || (rests && !reflected) {
                self.best = Rc::clone(&next);
            }
            self.present = next;
            self.trace.push(cost);
            monitor.advance(1);
            monitor.report_cost(self.best.cost());
            if rests && reflected {
                return Termination::Stalled;
            }
            if rests {
                return Termination::SmallStep;
            }
        }
        Termination::MaxIterations
    }

    /// The fit, with the best model's own free run and covariance.
    fn fit(self, refiner: &Refiner, records: &[Record]) -> LinearFit {
        let Point { model, runs } = &*self.best;
        let parameters = model.parameters();
        let samples: usize = runs.iter().map(|r| r.measured).sum();
        let free = samples.saturating_sub(parameters + model.lags().na * records.len());
        let variance = runs.iter().map(|r| r.error).sum::<f64>() / free.max(1) as f64;
        let covariance = refiner.covariance(&self.best, variance);
        LinearFit {
            model: model.clone(),
            cost: self.best.cost(),
            iterations: self.trace.len() - 1,
            termination: self.termination,
            trace: self.trace,
            initial_states: runs.iter().map(|r| r.state.clone()).collect(),
            covariance: covariance_rows(covariance.as_ref(), parameters),
        }
    }
}

/// Denominators met in `iterations` iterations from the model `first`, as starts for output error.
///
/// With measured outputs as instruments this is the method of Steiglitz and McBride (1965).
pub(crate) fn denominators(
    records: &[Record],
    first: &LinearModel,
    offset: bool,
    instruments: Outputs,
    iterations: usize,
    monitor: &Monitor,
) -> Vec<Vec<f64>> {
    let refiner = Refiner::new(records, first.lags(), offset, monitor);
    let mut model = with_denominator(first, stabilised(first.a()));
    let mut met = Vec::with_capacity(iterations);
    for _ in 0..iterations {
        let point = model.and_then(|m| refiner.point(m));
        model = point.and_then(|p| Some(refiner.refine(&p, instruments)?.model));
        let Some(model) = &model else { break };
        met.push(model.a().to_vec());
    }
    met
}

fn with_denominator(model: &LinearModel, a: Vec<f64>) -> Option<LinearModel> {
    let Lags { channels, nk, .. } = model.lags();
    LinearModel::new(a, model.b().to_vec(), channels, nk, model.offset()).ok()
}

/// Standard deviation of the measured output.
fn spread(records: &[Record]) -> f64 {
    let values = || {
        records
            .iter()
            .flat_map(|r| r.y.iter().copied())
            .filter(|y| !y.is_nan())
    };
    let count = (values().count() as f64).max(1.0);
    let mean = values().sum::<f64>() / count;
    (values().map(|y| (y - mean) * (y - mean)).sum::<f64>() / count).sqrt()
}

fn require_enough(records: &[Record], lags: &Lags, offset: bool) -> Result<()> {
    let needed = lags.regressors() + usize::from(offset) + lags.na * records.len();
    let whole = |r: &Record| r.len().saturating_sub(lags.first_whole());
    let usable: usize = records.iter().map(whole).sum();
    if usable > needed {
        return Ok(());
    }
    Err(Error::data(format!(
        "expected more than {needed} samples with a whole regressor for as many parameters and initial states, got {usable}; record longer or lower na and nb"
    )))
}

fn no_model() -> Error {
    Error::fit(
        "expected a first model with a finite free run, found none; check units and signs, lower na, or record with more excitation",
    )
}

// The free run of a linear model from the initial state that fits the record best.

/// Responses to the past below this no longer affect any digit of an output.
const DECAYED: f64 = 1e-30;

/// One free run.
struct Run {
    /// The model's outputs.
    output: Vec<f64>,
    /// Past outputs before the first measured sample, newest first.
    state: Vec<f64>,
    /// Sum of squared errors at the measured samples.
    error: f64,
    /// Number of measured samples.
    measured: usize,
}

/// A model with its free run over each record.
struct Point {
    model: LinearModel,
    runs: Vec<Run>,
}

impl Point {
    /// `1/(2N) sum e^2` over all records.
    fn cost(&self) -> f64 {
        let measured: usize = self.runs.iter().map(|r| r.measured).sum();
        0.5 * self.runs.iter().map(|r| r.error).sum::<f64>() / measured.max(1) as f64
    }

    /// Standard deviation of the free run caused by the estimated parameters, relative to that of the noise.
    fn relative_spread(&self) -> f64 {
        let measured: usize = self.runs.iter().map(|r| r.measured).sum();
        (self.model.parameters() as f64 / measured.max(1) as f64).sqrt()
    }

    /// Root mean square difference of the free runs.
    fn change(&self, before: &Self) -> f64 {
        let pairs = self.runs.iter().zip(&before.runs);
        let (n, sum) = pairs
            .flat_map(|(new, old)| new.output.iter().zip(&old.output))
            .fold((0.0, 0.0), |(n, sum), (x, y)| {
                (n + 1.0, sum + (x - y) * (x - y))
            });
        (sum / f64::max(n, 1.0)).sqrt()
    }
}

/// Response of the outputs to one unit in each past output, `na` values per sample, until it has decayed.
fn responses(a: &[f64], samples: usize) -> Vec<f64> {
    let na = a.len();
    let mut rows = vec![0.0_f64; na * na];
    for i in 0..na {
        rows[(na - 1 - i) * na + i] = 1.0;
    }
    for k in na..na + samples {
        let past = &rows[(k - na) * na..];
        if past.iter().all(|v| v.abs() < DECAYED) {
            break;
        }
        let row: Vec<f64> = (0..na)
            .map(|i| {
                -(0..na)
                    .map(|m| a[m] * past[(na - 1 - m) * na + i])
                    .sum::<f64>()
            })
            .collect();
        rows.extend(row);
    }
    rows.split_off(na * na)
}

/// The run whose past outputs are least-squares estimates over the whole record; they enter the run linearly.
fn best_run(model: &LinearModel, record: &Record, responses: &[f64]) -> Option<Run> {
    let na = model.lags().na;
    let mut output = model
        .simulate(record.u, record.channels, &vec![0.0; na])
        .ok()?;
    let (mut normal, mut moment) = (DMatrix::zeros(na, na), DVector::zeros(na));
    let errors = record.y.iter().zip(&output).map(|(y, x)| y - x);
    for (error, row) in errors.zip(responses.chunks_exact(na)) {
        if error.is_nan() {
            continue;
        }
        for i in 0..na {
            moment[i] += row[i] * error;
            for j in 0..na {
                normal[(i, j)] += row[i] * row[j];
            }
        }
    }
    soften(&mut normal);
    let state = normal.cholesky()?.solve(&moment);
    for (x, row) in output.iter_mut().zip(responses.chunks_exact(na)) {
        *x += row
            .iter()
            .zip(state.iter())
            .map(|(r, s)| r * s)
            .sum::<f64>();
    }
    let errors = record.y.iter().zip(&output).map(|(y, x)| y - x);
    let squares = errors.filter(|e| !e.is_nan()).map(|e| e * e);
    let (measured, error) = squares.fold((0, 0.0), |(n, sum), e| (n + 1, sum + e));
    error.is_finite().then(|| Run {
        state: before(record.first_measured(), &output, state.as_slice()),
        output,
        error,
        measured,
    })
}

/// Past outputs before sample `k` of a run that began at `state`.
fn before(k: usize, output: &[f64], state: &[f64]) -> Vec<f64> {
    let past = output[..k].iter().rev().chain(state);
    past.take(state.len()).copied().collect()
}

#[cfg(test)]
mod tests {
    //! The properties of instrumental variables.

    use super::*;
    use crate::ErrorKind;
    use crate::random::Random;

    fn noise(samples: usize, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        (0..samples).map(|_| random.normal()).collect()
    }

    fn noisy(clean: &[f64], size: f64, seed: u64) -> Vec<f64> {
        let pairs = clean.iter().zip(noise(clean.len(), seed));
        pairs.map(|(y, e)| y + size * e).collect()
    }

    fn worst(found: &[f64], truth: &[f64]) -> f64 {
        let pairs = found.iter().zip(truth);
        pairs.map(|(f, t)| (f - t).abs()).fold(0.0, f64::max)
    }

    fn fitted(records: &[Record], lags: Lags) -> LinearFit {
        let Lags { na, nb, nk, .. } = lags;
        fit(records, na, nb, nk, true, 50, &Monitor::default()).unwrap()
    }

    #[test]
    fn recovers_a_clean_system_from_experiments_in_any_state() {
        let b = vec![0.5, 0.3, -0.2, 0.1];
        let truth = LinearModel::new(vec![-1.5, 0.7], b, 2, 2, 0.4).unwrap();
        let (u1, u2) = (noise(400, 1), noise(600, 2));
        let y1 = truth.simulate(&u1, 2, &[9.0, -4.0]).unwrap();
        let y2 = truth.simulate(&u2, 2, &[5.0, 3.0]).unwrap();
        let records = [
            Record::new(&u1, 2, &y1).unwrap(),
            Record::new(&u2, 2, &y2).unwrap(),
        ];
        let fit = fitted(&records, truth.lags());
        assert!(worst(fit.model.a(), truth.a()) < 1e-9);
        assert!(worst(fit.model.b(), truth.b()) < 1e-9);
        assert!((fit.model.offset() - 0.4).abs() < 1e-9);
        assert_eq!(fit.termination, Termination::SmallStep);
        assert!(worst(&fit.initial_states[0], &[9.0, -4.0]) < 1e-6);
    }

    #[test]
    fn runs_through_gaps() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let u = noise(800, 1);
        let clean = truth.simulate(&u, 1, &[3.0, 1.0]).unwrap();
        let mut y = clean.clone();
        let mut random = Random::new(7);
        y.iter_mut()
            .filter(|_| random.between(0.0, 1.0) < 0.1)
            .for_each(|y| *y = f64::NAN);
        y[..30].fill(f64::NAN);
        let fit = fitted(&[Record::with_gaps(&u, 1, &y).unwrap()], truth.lags());
        assert!(worst(fit.model.a(), truth.a()) < 1e-7, "{:?}", fit.model);
        assert!(worst(&fit.initial_states[0], &[clean[29], clean[28]]) < 1e-5);
    }

    #[test]
    fn is_not_biased_by_noise_that_ruins_least_squares() {
        // 490 / ((.252 s + 1)(.0074 s + 1)) sampled at 1 ms, with the noise of a counted encoder.
        let a = vec![-1.86963746, 0.87013806];
        let truth = LinearModel::new(a, vec![0.1255, 0.1198], 1, 1, 3.0).unwrap();
        let u: Vec<f64> = (0..16_000)
            .map(|k| 3.0 + 3.0 * (6e-4 * k as f64 + 3e-7 * (k * k) as f64).sin())
            .collect();
        let clean = truth.simulate(&u, 1, &[500.0, 480.0]).unwrap();
        let y = noisy(&clean, 15.0, 3);
        let records = [Record::new(&u, 1, &y).unwrap()];
        let fit = fitted(&records, truth.lags());
        let by_arx = arx::fit(&records, 2, 2, 1, true).unwrap();
        assert!(by_arx.a()[0] > -1.0, "{:?}", by_arx.a());
        assert_eq!(fit.termination, Termination::SmallStep);
        let poles = fit.model.poles();
        let slowest = poles.iter().map(|p| p.re).fold(0.0, f64::max);
        assert!((slowest - 0.99604).abs() < 1e-3, "{slowest}");
        assert!((fit.model.dc_gain()[0] / truth.dc_gain()[0] - 1.0).abs() < 0.02);
        assert!((fit.cost / 112.5 - 1.0).abs() < 0.05, "{}", fit.cost);
    }

    #[test]
    fn standard_errors_are_those_of_many_repetitions() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let u: Vec<f64> = noise(500, 1).iter().map(|v| v + 5.0).collect();
        let clean = truth.simulate(&u, 1, &[2.0, 1.0]).unwrap();
        let values = [-1.5, 0.7, 0.5, 0.3, 0.4];
        let trials = 400;
        let mut squares = [0.0; 5];
        let mut sums = [0.0; 5];
        for seed in 0..trials {
            let y = noisy(&clean, 0.5, 100 + seed);
            let fit = fitted(&[Record::new(&u, 1, &y).unwrap()], truth.lags());
            let found: Vec<f64> = fit.model.a().iter().chain(fit.model.b()).copied().collect();
            let found = found.into_iter().chain([fit.model.offset()]);
            for (i, (f, error)) in found.zip(fit.standard_errors()).enumerate() {
                let score = (f - values[i]) / error;
                squares[i] += score * score;
                sums[i] += score;
            }
        }
        // the mean of n squared unit normals has deviation sqrt(2/n) = .071; five deviations are allowed, and 2 % of bias
        for (square, sum) in squares.iter().zip(sums) {
            let (mean, variance) = (sum / trials as f64, square / trials as f64);
            assert!((variance - 1.0).abs() < 0.37, "{squares:?}");
            assert!(mean.abs() < 0.3, "{sums:?}");
        }
    }

    #[test]
    fn stays_stable_and_says_so_on_data_of_an_unstable_system() {
        let u = noise(60, 4);
        let unstable = LinearModel::new(vec![-1.1], vec![1.0], 1, 1, 0.0).unwrap();
        let y = unstable.simulate(&u, 1, &[0.0]).unwrap();
        let fit = fitted(&[Record::new(&u, 1, &y).unwrap()], unstable.lags());
        assert!(fit.model.is_stable());
        assert_ne!(fit.termination, Termination::SmallStep);
    }

    #[test]
    fn keeps_what_it_has_when_stopped_and_refuses_short_records() {
        let u = noise(300, 5);
        let y = noisy(&u, 0.1, 6);
        let records = [Record::new(&u, 1, &y).unwrap()];
        let short = [Record::new(&u[..8], 1, &y[..8]).unwrap()];
        let error = fit(&short, 2, 2, 1, true, 50, &Monitor::default()).unwrap_err();
        assert!(error.kind == ErrorKind::Data && error.message.contains("longer"));
        let few = fit(&records, 2, 2, 1, true, 1, &Monitor::default()).unwrap();
        assert_eq!(few.termination, Termination::MaxIterations);
        let monitor = Monitor::default();
        monitor.request_stop();
        assert!(fit(&records, 2, 2, 1, true, 50, &monitor).is_err());
    }

    #[test]
    fn takes_no_weights() {
        let (u, y) = ([1.0, 2.0, 0.0, 1.0], [0.0, 1.0, 2.0, 0.0]);
        let record = Record::new(&u, 1, &y).unwrap();
        let records = [record.with_weights(&[1.0, 0.5, 1.0, 1.0]).unwrap()];
        let refused = fit(&records, 1, 1, 1, true, 20, &Monitor::default()).unwrap_err();
        assert_eq!(refused.kind, crate::ErrorKind::Setting);
        assert!(refused.message.contains("weights"), "{}", refused.message);
    }
}
