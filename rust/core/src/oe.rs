//! Linear output error: the free run fitted by Levenberg-Marquardt with exact sensitivities and stable poles.

mod problem;
mod starts;

use problem::OutputError;
use starts::{excerpt, restart_error};

use crate::lagged::{Lagged, Lags};
use crate::level::about_level;
use crate::linear::{LinearFit, LinearModel, stabilised};
use crate::lm::{self, Outcome, Problem, Settings, Termination};
use crate::{Error, Monitor, Record, Result, arx};

/// How many candidates are refined: half of them for their cost, half for their restart error.
const REFINED: usize = 8;
/// Candidates whose restart error is computed.
const RESTARTED: usize = 40;
/// Restart errors within this ratio do not decide which model is better; the cost does.
const ABOUT_AS_WELL: f64 = 1.05;
/// Iterations after which the refined candidates are compared and only the best one continues.
const HEAT: usize = 30;

/// Measured outputs under the first inputs needed to see that a plant stands: two always lie on a line.
const HELD: usize = 3;

/// Fits `LinearModel` in free run over all experiments, with an initial state per experiment.
///
/// Records whose inputs are held at first are fitted a second time, from the model's own equilibrium under these
/// inputs. A free state could absorb the response to a step soon after the start, and the gain would be undetermined.
/// The free states are kept only if they lower the Bayesian information criterion (Schwarz, *Ann. Stat.* 6, 1978), with
/// as many independent samples as the residuals' spectrum leaves: then the plant was moving before the record began.
///
/// Least squares is biased by measurement noise, so its model is only one candidate. Others are instrumental-variable iterations (SRIV,
/// Young 1976; Steiglitz and McBride 1965) and fixed sets of real and complex poles over the whole range of time constants, each with its
/// best numerator. The best free runs are refined; steps that would move a pole out of the unit circle are rejected (Schur-Cohn test), so
/// every accepted step is stable. Refined models are restarted from a few samples ([`restart_error`]); of those that then run about as
/// well as the best, the one with the lowest cost is chosen. For records of more than 40,000 samples this search uses an excerpt, and the
/// final fit all samples.
///
/// ```
/// use sewfast_core::lagged::Lagged;
/// use sewfast_core::linear::LinearModel;
/// use sewfast_core::{Monitor, Record, oe};
///
/// let truth = LinearModel::new(vec![-0.9], vec![0.2], 1, 1, 0.5)?;
/// let u: Vec<f64> = (0..200).map(|k| f64::from(k * k % 7)).collect();
/// let y = truth.simulate(&u, 1, &[0.0])?;
/// let records = [Record::new(&u, 1, &y)?];
/// let model = oe::fit(&records, 1, 1, 1, true, 100, &Monitor::default())?.model;
/// assert!((model.a()[0] + 0.9).abs() < 1e-6);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
///
/// # Errors
/// As [`arx::fit`] for unusable data and settings; `ErrorKind::Fit` if no stable model has a finite free run.
pub fn fit(
    records: &[Record],
    na: usize,
    nb: usize,
    nk: usize,
    offset: bool,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<LinearFit> {
    let lags = arx::check(records, na, nb, nk)?;
    by_search(records, lags, offset, false, max_iterations, monitor)
}

/// [`fit`] of a predictor of `order`: its last input is the output itself. In its place the model's own output is fed
/// back where none was measured, so that the error there is 0, whatever the input has; starts use the input.
pub(crate) fn fit_predictor(
    records: &[Record],
    order: usize,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<LinearFit> {
    let lags = arx::check(records, order, order, 1)?;
    by_search(records, lags, true, true, max_iterations, monitor)
}

fn by_search(
    records: &[Record],
    lags: Lags,
    offset: bool,
    fed: bool,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<LinearFit> {
    let iterations = max_iterations + (REFINED - 1) * HEAT;
    let found = |records: &[Record]| {
        let mut problem = OutputError::new(records, lags, offset, fed, monitor)?;
        let from_pieces = excerpt(records)
            .and_then(|pieces| searched_in(&pieces, &mut problem, max_iterations, monitor));
        let (best, spent) = match from_pieces {
            Some(found) => found,
            None => {
                searched(&mut problem, records, max_iterations, monitor).ok_or_else(no_model)?
            }
        };
        finished(problem, best, spent, max_iterations, monitor)
    };
    // a predictor's last input is the output itself, whose level is not that of the first sample alone
    about_level(records, offset && !fed, |records, _| {
        from_rest_or_motion(records, iterations, monitor, found)
    })
}

/// [`fit`] from one model instead of a search over many, for data that the model is known to describe nearly.
///
/// The initial states are estimated first. The poles of an unstable model are mirrored into the unit circle, and its
/// numerator is estimated anew. Without `offset` the model's offset is dropped.
///
/// # Errors
/// As [`fit`], `ErrorKind::Setting` for a model with another number of inputs than the records have.
pub fn fit_from(
    records: &[Record],
    initial: &LinearModel,
    offset: bool,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<LinearFit> {
    let Lags {
        na,
        nb,
        nk,
        channels,
    } = initial.lags();
    let lags = arx::check(records, na, nb, nk)?;
    if lags.channels != channels {
        return Err(Error::setting(format!(
            "expected an initial model of {} inputs, as the records have, got one of {channels}; leave it out",
            lags.channels
        )));
    }
    about_level(records, offset, |records, level| {
        let initial = level.lowered(initial)?;
        from_rest_or_motion(records, max_iterations, monitor, |records| {
            let mut problem = OutputError::new(records, lags, offset, false, monitor)?;
            let (cost, theta) = problem
                .with_states(&initial)
                .or_else(|| problem.with_poles(&stabilised(initial.a())))
                .ok_or_else(no_model)?;
            let start = unfinished(cost, theta, Termination::MaxIterations);
            finished(problem, start, 0, max_iterations, monitor)
        })
    })
}

/// The fit with free initial states, or the one from rest if the free states do not pay.
fn from_rest_or_motion(
    records: &[Record],
    iterations: usize,
    monitor: &Monitor,
    fit: impl Fn(&[Record]) -> Result<Fitted>,
) -> Result<LinearFit> {
    let resting: Vec<_> = records
        .iter()
        .map(|r| r.at_rest(r.begins_held(HELD)))
        .collect();
    let tied = resting.iter().filter(|r| r.rests).count();
    monitor.set_total(iterations as u64 * if tied > 0 { 2 } else { 1 });
    let free = fit(records);
    if tied == 0 || monitor.stopped() {
        return free.map(|free| free.fit);
    }
    let rest = fit(&resting);
    let iterations = [&free, &rest].map(|f| f.as_ref().map_or(0, |f| f.fit.iterations));
    let mut chosen = match (free, rest) {
        (Err(_), Ok(rest)) => rest.fit,
        (Ok(free), Ok(rest)) if !free.pays(&rest, tied) => rest.fit,
        (free, _) => free?.fit,
    };
    chosen.iterations = iterations.iter().sum();
    if monitor.stopped() {
        chosen.termination = Termination::Interrupted;
    }
    Ok(chosen)
}

/// A fit, and the number of independent samples in its residuals.
struct Fitted {
    fit: LinearFit,
    independent: f64,
}

impl Fitted {
    /// Whether the free states of `tied` records lower the information criterion compared with a fit from rest.
    fn pays(&self, rest: &Self, tied: usize) -> bool {
        let states = (tied * self.fit.model.lags().na) as f64;
        let n = self.independent;
        n * (rest.fit.cost / self.fit.cost).ln() > states * n.ln()
    }
}

/// The fit that continues from `best` with the remaining iterations, after `spent` ones in all.
fn finished(
    mut problem: OutputError,
    best: Outcome,
    spent: usize,
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<Fitted> {
    let left = max_iterations.saturating_sub(best.iterations);
    let goes_on = best.termination == Termination::MaxIterations && left > 0;
    let (best, spent) = if goes_on {
        let rest = lm::minimize(
            &mut problem,
            best.theta.clone(),
            &settings(left),
            monitor,
            |_, _| {},
        );
        let spent = spent + rest.iterations;
        (joined(best, rest), spent)
    } else {
        (best, spent)
    };
    let independent = problem.independent(&best.theta);
    let fit = LinearFit {
        model: problem.model(&best.theta)?,
        cost: best.cost,
        iterations: spent,
        termination: match monitor.stopped() {
            true => Termination::Interrupted,
            false => best.termination,
        },
        trace: best.trace,
        initial_states: problem.initial_states(&best.theta),
        covariance: problem.covariance(&best.theta, best.cost),
    };
    Ok(Fitted { fit, independent })
}

/// The best refined candidate, and the iterations of all.
fn searched(
    problem: &mut OutputError,
    records: &[Record],
    max_iterations: usize,
    monitor: &Monitor,
) -> Option<(Outcome, usize)> {
    if monitor.stopped() {
        return None;
    }
    let candidates = starts::candidates(problem, records, monitor);
    let candidates = promising(problem, records, candidates, monitor);
    let heats = refined(problem, candidates, max_iterations, monitor);
    let spent = heats.iter().map(|o| o.iterations).sum();
    Some((chosen(problem, records, heats, monitor)?, spent))
}

/// The same on pieces of the records; the result is a start for all of them.
fn searched_in(
    pieces: &[Record],
    problem: &mut OutputError,
    max_iterations: usize,
    monitor: &Monitor,
) -> Option<(Outcome, usize)> {
    let offset = problem.shared() > problem.lags.regressors();
    let mut part = OutputError::new(pieces, problem.lags, offset, problem.fed, monitor).ok()?;
    let (mut found, spent) = searched(&mut part, pieces, max_iterations, monitor)?;
    let states = vec![0.0; problem.parameters() - problem.shared()];
    found.theta.truncate(problem.shared());
    found.theta.extend(states);
    if let Some((cost, theta)) = problem.with_poles(&found.theta[..problem.lags.na]) {
        (found.cost, found.theta) = (cost, theta);
    }
    found.trace = vec![found.cost];
    found.iterations = 0;
    if !monitor.stopped() {
        found.termination = Termination::MaxIterations;
    }
    Some((found, spent))
}

/// The candidates with the lowest cost and those with the least restart error, without repetition.
fn promising(
    problem: &OutputError,
    records: &[Record],
    candidates: Vec<(f64, Vec<f64>)>,
    monitor: &Monitor,
) -> Vec<(f64, Vec<f64>)> {
    let (first, rest) = candidates.split_at(candidates.len().min(REFINED / 2));
    let mut ranked: Vec<_> = rest
        .iter()
        .take(RESTARTED)
        .map(|c| (restarted(problem, records, &c.1, monitor), c))
        .collect();
    ranked.sort_by(|x, y| x.0.total_cmp(&y.0));
    let others = ranked.into_iter().map(|(_, c)| c);
    first.iter().chain(others).take(REFINED).cloned().collect()
}

/// The outcome with the lowest cost among those that restart about as well as the best one.
///
/// After a stop, candidates that have not been restarted count as failed; if none has been, all are equal.
fn chosen(
    problem: &OutputError,
    records: &[Record],
    outcomes: Vec<Outcome>,
    monitor: &Monitor,
) -> Option<Outcome> {
    let ranked: Vec<(f64, Outcome)> = outcomes
        .into_iter()
        .map(|o| (restarted(problem, records, &o.theta, monitor), o))
        .collect();
    let least = ranked.iter().map(|r| r.0).fold(f64::INFINITY, f64::min);
    let good = ranked.into_iter().filter(|r| r.0 <= ABOUT_AS_WELL * least);
    good.map(|(_, outcome)| outcome)
        .min_by(|x, y| x.cost.total_cmp(&y.cost))
}

fn restarted(problem: &OutputError, records: &[Record], theta: &[f64], monitor: &Monitor) -> f64 {
    let error = |model| restart_error(&model, records, monitor);
    problem.model(theta).map_or(f64::INFINITY, error)
}

/// A few iterations from each of the best candidates; after an early stop, the best candidate unchanged.
fn refined(
    problem: &mut OutputError,
    candidates: Vec<(f64, Vec<f64>)>,
    max_iterations: usize,
    monitor: &Monitor,
) -> Vec<Outcome> {
    let heat = settings(max_iterations.min(HEAT));
    let mut outcomes = Vec::with_capacity(REFINED);
    for (cost, theta) in candidates.into_iter().take(REFINED) {
        if !monitor.stopped() {
            let start = theta.clone();
            outcomes.push(lm::minimize(problem, start, &heat, monitor, |_, _| {}));
        }
        // a stop may come before the refinement has a cost
        outcomes.retain(|o: &Outcome| o.cost.is_finite());
        if monitor.stopped() && outcomes.is_empty() {
            outcomes.push(unfinished(cost, theta, Termination::Interrupted));
        }
    }
    outcomes
}

/// An outcome without iterations.
fn unfinished(cost: f64, theta: Vec<f64>, termination: Termination) -> Outcome {
    Outcome {
        theta,
        cost,
        iterations: 0,
        trials: 0,
        termination,
        trace: vec![cost],
    }
}

fn settings(max_iterations: usize) -> Settings {
    Settings {
        max_iterations,
        ..Settings::default()
    }
}

fn joined(first: Outcome, rest: Outcome) -> Outcome {
    if rest.cost > first.cost {
        return Outcome {
            termination: rest.termination,
            ..first
        };
    }
    let mut trace = first.trace;
    trace.extend(rest.trace.iter().skip(1));
    Outcome { trace, ..rest }
}

fn no_model() -> Error {
    Error::fit(
        "expected a stable model with a finite free run, found none; check units and signs, raise na, or record with more excitation",
    )
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::machine::{Machine, Parameters};
    use crate::random::Random;

    fn chirp(samples: usize, scale: f64) -> Vec<f64> {
        let value = |k: usize| {
            let t = k as f64 / samples as f64;
            scale * (1.0 - (40.0 * t + 500.0 * t * t).cos())
        };
        (0..samples).map(value).collect()
    }

    fn noisy(y: &[f64], size: f64, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        y.iter().map(|y| y + size * random.normal()).collect()
    }

    fn check_reaches_noise(truth: &LinearModel, u: &[f64], size: f64) -> LinearFit {
        let lags = truth.lags();
        let clean = truth.simulate(u, 1, &vec![0.0; lags.na]).unwrap();
        let y = noisy(&clean, size, 5);
        let records = [Record::new(u, 1, &y).unwrap()];
        let fit = fit(
            &records,
            lags.na,
            lags.nb,
            lags.nk,
            true,
            100,
            &Monitor::default(),
        )
        .unwrap();
        assert!(fit.model.is_stable());
        assert!(fit.trace.windows(2).all(|w| w[1] < w[0]), "{:?}", fit.trace);
        let run = fit.model.simulate(u, 1, &fit.initial_states[0]).unwrap();
        let error = clean
            .iter()
            .zip(&run)
            .map(|(c, r)| (c - r).powi(2))
            .sum::<f64>();
        let rms = (error / u.len() as f64).sqrt();
        assert!(rms < 0.1 * size, "{rms} against noise {size}");
        fit
    }

    #[test]
    fn reaches_the_noise_where_least_squares_is_far_off() {
        // 490 / ((.252 s + 1)(.0074 s + 1)) sampled at 1 ms, with the noise of a counted encoder.
        let truth = LinearModel::new(
            vec![-1.86963746, 0.87013806],
            vec![0.1255, 0.1198],
            1,
            1,
            0.0,
        )
        .unwrap();
        let fit = check_reaches_noise(&truth, &chirp(8000, 2.0), 15.0);
        assert!((fit.model.dc_gain()[0] / truth.dc_gain()[0] - 1.0).abs() < 0.02);
    }

    #[test]
    fn starts_from_an_excerpt_of_a_long_record_and_fits_all_of_it() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let fit = check_reaches_noise(&truth, &chirp(60_000, 3.0), 0.5);
        assert_eq!(fit.initial_states.len(), 1);
        assert!((fit.cost / 0.125 - 1.0).abs() < 0.05, "{}", fit.cost);
        let error = fit.standard_errors()[0];
        assert!((fit.model.a()[0] + 1.5).abs() < 6.0 * error, "{error}");
    }

    #[test]
    fn finds_lightly_damped_complex_poles() {
        let truth = LinearModel::new(vec![-1.9, 0.95], vec![0.02, 0.01], 1, 1, 0.1).unwrap();
        check_reaches_noise(&truth, &chirp(2000, 3.0), 0.2);
    }

    #[test]
    fn does_not_follow_the_trend_of_a_drive_with_friction() {
        // Friction and dead time bend the record: its lowest cost belongs to a pole beyond 1 s that other records do not show.
        let run = |u: &[f64]| {
            let mut machine = Machine::new(Parameters::default()).unwrap();
            machine.run(u).unwrap().1
        };
        let grows = |k: usize| {
            (0.6 + 2.5e-4 * k as f64) * (1.0 - ((6e-4 + 3e-7 * k as f64) * k as f64).cos())
        };
        let u: Vec<f64> = (0..16_000).map(grows).collect();
        let held = |k: usize| 1.0 + 4.0 * ((k / 700 * 5) % 7) as f64 / 7.0;
        let other: Vec<f64> = (0..8_000).map(held).collect();
        let (y, truth) = (run(&u), run(&other));
        let records = [Record::new(&u, 1, &y).unwrap()];
        let fit = fit(&records, 2, 2, 1, true, 100, &Monitor::default()).unwrap();
        let slowest = fit.model.poles().iter().map(|p| p.re).fold(0.0, f64::max);
        assert!(slowest < 0.998, "slowest pole {slowest}");
        let state = fit
            .model
            .estimate_initial_state(&other[..20], 1, &truth[..20])
            .unwrap();
        let free = fit.model.simulate(&other, 1, &state).unwrap();
        let percent = crate::metrics::fit_percent(&truth[20..], &free[20..]);
        assert!(percent > 90.0, "fit {percent} %");
    }

    #[test]
    fn keeps_a_state_per_experiment() {
        let truth = LinearModel::new(vec![-1.7, 0.72], vec![0.05, 0.03], 1, 1, 0.2).unwrap();
        let u = chirp(500, 1.0);
        let y1 = truth.simulate(&u, 1, &[4.0, 4.0]).unwrap();
        let y2 = truth.simulate(&u[..300], 1, &[-2.0, -1.0]).unwrap();
        let records = [
            Record::new(&u, 1, &y1).unwrap(),
            Record::new(&u[..300], 1, &y2).unwrap(),
        ];
        let fit = fit(&records, 2, 2, 1, true, 100, &Monitor::default()).unwrap();
        assert!(fit.cost < 1e-12, "{}", fit.cost);
        assert!(
            (fit.initial_states[1][0] + 2.0).abs() < 1e-3,
            "{:?}",
            fit.initial_states
        );
    }

    #[test]
    fn stays_stable_on_data_of_an_unstable_system() {
        let u = chirp(60, 1.0);
        let unstable = LinearModel::new(vec![-1.1], vec![1.0], 1, 1, 0.0).unwrap();
        let y = unstable.simulate(&u, 1, &[0.0]).unwrap();
        let fit = fit(
            &[Record::new(&u, 1, &y).unwrap()],
            1,
            1,
            1,
            true,
            100,
            &Monitor::default(),
        )
        .unwrap();
        assert!(fit.model.is_stable());
    }

    #[test]
    fn returns_what_it_has_when_stopped_and_refuses_short_records() {
        let u = chirp(500, 1.0);
        let y = noisy(&u, 0.1, 1);
        let records = [Record::new(&u, 1, &y).unwrap()];
        let monitor = Monitor::default();
        monitor.request_stop();
        let stopped = fit(&records, 2, 2, 1, true, 100, &monitor);
        assert_eq!(stopped.unwrap_err().kind, crate::ErrorKind::Fit);
        let short = [Record::new(&u[..6], 1, &y[..6]).unwrap()];
        assert!(
            fit(&short, 2, 2, 1, true, 100, &Monitor::default())
                .unwrap_err()
                .message
                .contains("longer")
        );
    }

    #[test]
    fn goes_on_from_a_model_that_is_nearly_right() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let u = chirp(4_000, 3.0);
        let y = noisy(&truth.simulate(&u, 1, &[3.0, -2.0]).unwrap(), 0.2, 3);
        let records = [Record::new(&u, 1, &y).unwrap()];
        let searched = fit(&records, 2, 2, 1, true, 100, &Monitor::default()).unwrap();
        let near = LinearModel::new(vec![-1.45, 0.66], vec![0.4, 0.4], 1, 1, 0.0).unwrap();
        let found = fit_from(&records, &near, true, 100, &Monitor::default()).unwrap();
        assert!((found.cost / searched.cost - 1.0).abs() < 1e-9);
        assert!((found.model.a()[0] - searched.model.a()[0]).abs() < 1e-6);
        assert!(
            found.iterations < searched.iterations / 3,
            "{}",
            found.iterations
        );
        // at the end of a fit only the last test remains
        let again = fit_from(&records, &searched.model, true, 100, &Monitor::default()).unwrap();
        assert!(again.iterations <= PATIENCE, "{}", again.iterations);
        assert!((again.trace[0] / searched.cost - 1.0).abs() < 1e-9);
        let without = fit_from(&records, &near, false, 100, &Monitor::default()).unwrap();
        assert_eq!(without.model.offset(), 0.0);
        let unstable = LinearModel::new(vec![-2.2, 1.2], vec![0.4, 0.4], 1, 1, 0.0).unwrap();
        let found = fit_from(&records, &unstable, true, 100, &Monitor::default()).unwrap();
        assert!(found.model.is_stable());
        let two = LinearModel::new(vec![-0.5], vec![0.4, 0.4], 2, 1, 0.0).unwrap();
        let refused = fit_from(&records, &two, true, 100, &Monitor::default()).unwrap_err();
        assert_eq!(refused.kind, crate::ErrorKind::Setting);
    }

    /// Slow iterations in a row that end a fit.
    const PATIENCE: usize = 6;

    #[test]
    fn begins_at_rest_or_in_motion_as_the_record_does() {
        let truth = LinearModel::new(vec![-1.9, 0.9025], vec![0.03, 0.02], 1, 1, 0.2).unwrap();
        let rest = (0.2 + 0.05 * 2.0) / 0.0025;
        for (held, states) in [
            (3, [rest; 2]),
            (20, [rest; 2]),
            (7, [rest + 40.0, rest - 30.0]),
        ] {
            let u: Vec<f64> = (0..700).map(|k| if k < held { 2.0 } else { 8.0 }).collect();
            let y = noisy(&truth.simulate(&u, 1, &states).unwrap(), 1.0, held as u64);
            let records = [Record::new(&u, 1, &y).unwrap()];
            let fit = fit(&records, 2, 2, 1, true, 100, &Monitor::default()).unwrap();
            let [first, second] = fit.initial_states[0][..] else {
                panic!("two past outputs")
            };
            let at_rest = states[0] == states[1];
            assert_eq!(first == second, at_rest, "{held}: {first} {second}");
            if at_rest {
                let gain = fit.model.dc_gain()[0];
                assert!((gain - 20.0).abs() < 0.2, "{held}: {gain}");
            }
        }
    }

    #[test]
    fn gives_the_best_so_far_wherever_it_is_stopped() {
        let truth = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.4).unwrap();
        let u = chirp(3_000, 3.0);
        let y = noisy(&truth.simulate(&u, 1, &[0.0; 2]).unwrap(), 0.5, 3);
        let records = [Record::new(&u, 1, &y).unwrap()];
        // the first refinements have more iterations than these
        for iterations in [1, 20, 40] {
            let (monitor, done) = (Monitor::default(), AtomicBool::new(false));
            let found = std::thread::scope(|scope| {
                scope.spawn(|| {
                    while monitor.progress().0 < iterations && !done.load(Ordering::Relaxed) {
                        std::thread::yield_now();
                    }
                    monitor.request_stop();
                });
                let found = fit(&records, 4, 5, 1, true, 100, &monitor);
                done.store(true, Ordering::Relaxed);
                found.unwrap()
            });
            assert_eq!(found.termination, Termination::Interrupted);
            assert!(found.model.is_stable() && found.cost.is_finite());
        }
    }
}
