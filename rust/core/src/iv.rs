//! Refined instrumental variables (SRIV): unbiased by measurement noise, without a search.

mod run;
mod step;

pub(crate) use step::Outputs;

use std::rc::Rc;

use run::Point;
use step::Refiner;

use crate::lagged::{Lagged, Lags};
use crate::linear::{LinearModel, stabilised};
use crate::linear_fit::{LinearFit, covariance_rows};
use crate::lm::Termination;
use crate::{Error, Monitor, Record, Result, arx};

/// A change of the free run below this part of the spread that noise gives it anyway does not matter: less than 1 % of
/// the estimate's variance. Directions that the data hardly fix go on to move about within it.
const SMALL_CHANGE: f64 = 0.1;
/// A change of the free run below this part of the output's spread is rounding.
const ROUNDING: f64 = 1e-9;

/// Fits `LinearModel` by simple refined instrumental variables over all experiments.
///
/// Each iteration filters inputs and outputs by `1/A` of the model before and solves
/// `sum z(k) (y_f(k) - phi_f(k)' theta) = 0`, where the instruments `z` are the regressors with the model's own free run
/// in the place of the measured outputs (Young 1976; Young 2011, section 6.4). Where the noise is white and added to the
/// output, a fixed point is asymptotically as good as output error. The unknown state before each experiment is estimated
/// along. It starts at the ARX model; poles outside the unit circle are mirrored into it.
///
/// The outcome is `SmallStep` where the free run has come to rest; `Stalled` where it has done so only because a pole
/// was mirrored; `RankDeficient` where the instruments do not fix the parameters; `MaxIterations`. In all but the first
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
/// As [`arx::fit`] for unusable data and settings; `ErrorKind::Setting` for records with weights, `ErrorKind::Fit` where the first model has no finite free run.
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
    let first = arx::fit(records, na, nb, nk, offset)?;
    let refiner = Refiner::new(records, lags, offset, monitor);
    monitor.set_total(max_iterations as u64);
    let start = with_denominator(&first, stabilised(first.a()));
    let start = start.and_then(|m| refiner.point(m)).ok_or_else(no_model)?;
    let mut search = Search::new(start);
    search.termination = search.iterate(&refiner, records, max_iterations, monitor);
    Ok(search.fit(&refiner, records))
}

/// The iterations' state: where they are and the best free run so far.
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

/// Denominators met by `iterations` iterations from the model `first`, which are starts for output error.
///
/// With measured outputs as instruments it is the method of Steiglitz and McBride (1965).
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

#[cfg(test)]
mod tests;
