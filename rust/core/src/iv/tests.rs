//! What instrumental variables promise.

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
    // mean of n squared unit normals: deviation sqrt(2/n) = .071; five of those are allowed, and 2 % of bias
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
