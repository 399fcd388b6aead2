use super::{Change, Experiment, changed};
use crate::random::Random;
use crate::{ErrorKind, Monitor};

/// Steps, and the answer of a plant of second order to them with some noise.
fn record(n: usize, seed: u64) -> (Vec<f64>, Vec<f64>) {
    let mut random = Random::new(seed);
    let mut u = vec![0.0; n];
    let mut y = vec![0.0; n];
    for k in 2..n {
        u[k] = if k % 25 == 2 {
            random.between(-2.0, 2.0)
        } else {
            u[k - 1]
        };
        y[k] = 1.6 * y[k - 1] - 0.65 * y[k - 2] + 0.05 * u[k - 1];
    }
    y.iter_mut().for_each(|y| *y += 0.01 * random.normal());
    (u, y)
}

fn change_of(records: &[(Vec<f64>, Vec<f64>)], channels: usize) -> Option<Change> {
    let experiments: Vec<_> = records.iter().map(|(u, y)| Experiment { u, y }).collect();
    changed(&experiments, channels, &Monitor::default()).unwrap()
}

#[test]
fn a_sound_record_has_no_change() {
    for seed in 0..4 {
        assert_eq!(change_of(&[record(3000, seed)], 1), None);
        assert_eq!(
            change_of(&[record(1500, seed), record(900, seed + 10)], 1),
            None
        );
    }
}

#[test]
fn a_slow_answer_to_one_step_has_lost_no_rows() {
    let mut random = Random::new(65);
    for _ in 0..60 {
        let n = random.between(150.0, 600.0) as usize;
        let at = random.between(3.0, 21.0) as usize;
        let poles = [15.0, 5.0].map(|tau: f64| (-1.0 / (tau * random.between(1.0, 5.0))).exp());
        let u: Vec<f64> = (0..n).map(|k| f64::from(u8::from(k >= at))).collect();
        let mut x = [0.0; 2];
        let y = u.iter().map(|u| {
            x = [
                poles[0] * x[0] + (1.0 - poles[0]) * u,
                poles[1] * x[1] + (1.0 - poles[1]) * x[0],
            ];
            x[1] + 0.003 * random.normal()
        });
        let y = y.collect();
        assert_eq!(change_of(&[(u, y)], 1), None);
    }
}

#[test]
fn a_sweep_through_a_resonance_is_one_plant() {
    for seed in 0..6 {
        let mut random = Random::new(seed);
        let (n, turn) = (3000, random.between(12.0, 40.0));
        let damping = random.between(0.97, 0.995);
        let a = 2.0 * damping * (std::f64::consts::TAU / turn).cos();
        let (mut u, mut y) = (vec![0.0; n], vec![0.0; n]);
        for k in 2..n {
            let turns = k as f64 / turn * (0.1 + 1.5 * k as f64 / n as f64);
            u[k] = (std::f64::consts::TAU * turns).sin();
            y[k] = a * y[k - 1] - damping * damping * y[k - 2] + u[k - 1];
        }
        let (whole, unmeasured) = ((u.clone(), y.clone()), (u.clone(), vec![f64::NAN; n]));
        assert_eq!(
            change_of(std::slice::from_ref(&whole), 1),
            None,
            "seed {seed}"
        );
        assert_eq!(change_of(&[unmeasured, whole], 1), None, "seed {seed}");
        y[n / 2] = f64::NAN;
        assert_eq!(change_of(&[(u, y)], 1), None, "seed {seed}");
    }
}

#[test]
fn another_scale_of_a_sweep_is_found() {
    for later in [3.0, 0.25] {
        let sine = |k: usize| (k as f64 * (0.015 + 2e-5 * k as f64)).sin();
        let mut u: Vec<f64> = (0..4000).map(sine).collect();
        let mut x = 0.0;
        let y = u.iter().map(|u| {
            let before = x;
            x += 0.1 * (u - x);
            before
        });
        let y: Vec<f64> = y.collect();
        assert_eq!(change_of(&[(u.clone(), y.clone())], 1), None);
        u[2100..].iter_mut().for_each(|u| *u *= later);
        let found = change_of(&[(u, y)], 1).unwrap();
        assert!((found.gain * later - 1.0).abs() < 0.1, "{found:?}");
        assert!(found.start.abs_diff(2100) < 150, "{found:?}");
    }
}

#[test]
fn another_sign_or_scale_is_found_where_it_begins() {
    for (gain, seed) in [(-1.0, 1), (0.5, 2), (3.0, 3), (0.0, 4)] {
        let (u, mut y) = record(3000, seed);
        y[1800..].iter_mut().for_each(|y| *y *= gain);
        let found = change_of(&[(u, y)], 1).unwrap();
        assert!(
            (found.gain - gain).abs() < 0.1 * gain.abs() + 0.05,
            "{found:?}"
        );
        assert_eq!(found.shift, 0);
        assert!(found.start.abs_diff(1800) < 100, "{found:?}");
        assert!(found.left < 0.5);
    }
}

#[test]
fn rows_that_were_lost_are_a_shift() {
    let (mut u, y) = record(3000, 5);
    // a file without 40 rows of its input
    u.drain(1500..1540);
    let found = change_of(&[(u, y[..2960].to_vec())], 1).unwrap();
    assert_eq!(found.shift.abs(), 40, "{found:?}");
    assert!(found.start.abs_diff(1500) < 150, "{found:?}");
}

#[test]
fn an_experiment_can_differ_from_the_others() {
    let mut records: Vec<_> = (0..3).map(|seed| record(1200, seed)).collect();
    records[1].1.iter_mut().for_each(|y| *y = -*y);
    let found = change_of(&records, 1).unwrap();
    assert_eq!((found.experiment, found.start), (1, 0));
    assert!((found.gain + 1.0).abs() < 0.1);
}

/// Two inputs, gaps, a level, a huge unit: the change is the same.
#[test]
fn units_levels_gaps_and_a_second_input_do_not_matter() {
    let (u, mut y) = record(3000, 6);
    y[1000..].iter_mut().for_each(|y| *y *= -1.0);
    let plain = change_of(&[(u.clone(), y.clone())], 1).unwrap();
    let mut random = Random::new(9);
    let both = u.iter().flat_map(|u| [1e20 * u + 3e20, random.normal()]);
    let both: Vec<f64> = both.collect();
    y.iter_mut().for_each(|y| *y = 1e-20 * (*y + 100.0));
    y[400..420].fill(f64::NAN);
    let found = change_of(&[(both, y)], 2).unwrap();
    assert!((found.gain - plain.gain).abs() < 0.1);
    assert!(found.start.abs_diff(plain.start) < 60);
}

/// Longer than the rows that are used.
#[test]
fn a_long_record_is_taken_in_means() {
    let (u, mut y) = record(50_000, 7);
    y[30_000..].iter_mut().for_each(|y| *y *= -1.0);
    let found = change_of(&[(u, y)], 1).unwrap();
    assert!((found.gain + 1.0).abs() < 0.1);
    assert!(found.start.abs_diff(30_000) < 1500, "{found:?}");
}

#[test]
fn hardly_any_data_have_no_change() {
    for n in [0, 1, 31, 32, 100] {
        for value in [0.0, 1.0, f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(change_of(&[(vec![value; n], vec![value; n])], 1), None);
            let (u, y) = record(n.max(3), 1);
            assert_eq!(change_of(&[(u.clone(), vec![value; u.len()])], 1), None);
            assert_eq!(change_of(&[(vec![value; y.len()], y)], 1), None);
        }
    }
    assert_eq!(change_of(&[], 1), None);
}

#[test]
fn what_is_no_record_is_refused_and_a_stop_is_heard() {
    let (u, y) = record(1000, 1);
    let experiments = [Experiment { u: &u, y: &y[1..] }];
    let refused = changed(&experiments, 1, &Monitor::default()).unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Data);
    let monitor = Monitor::default();
    monitor.request_stop();
    let experiments = [Experiment { u: &u, y: &y }];
    let stopped = changed(&experiments, 1, &monitor).unwrap_err();
    assert_eq!(stopped.kind, ErrorKind::Fit);
}
