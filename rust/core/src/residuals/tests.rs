use nalgebra::DMatrix;
use proptest::prelude::*;

use super::columns::{Columns, cross, independent, lagged, leading, squared};
use super::{Noise, Run, Test, coloured_information, lags_over, parameters, quantile, tail, tests};
use crate::random::Random;
use crate::{ErrorKind, Monitor};

/// Normal numbers of unit variance.
fn normal(n: usize, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    (0..n).map(|_| random.normal()).collect()
}

fn coloured(n: usize, a: &[f64], seed: u64) -> Vec<f64> {
    let mut e = normal(n, seed);
    for k in 0..n {
        e[k] += a
            .iter()
            .zip((0..k).rev())
            .map(|(a, back)| a * e[back])
            .sum::<f64>();
    }
    e
}

#[test]
fn the_tail_of_even_freedom_is_a_poisson_sum() {
    for freedom in [2, 4, 10, 50, 200] {
        for x in [0.01, 1.0, 7.5, 40.0, 300.0_f64] {
            let mut term = (-x / 2.0).exp();
            let mut sum = 0.0;
            for i in 0..freedom / 2 {
                sum += term;
                term *= x / 2.0 / f64::from(i + 1);
            }
            let found = tail(x, freedom as usize);
            assert!(
                (found - sum).abs() < 1e-11 * sum + 1e-14,
                "{freedom} {x}: {found} {sum}"
            );
        }
    }
    assert_eq!([tail(0.0, 3), tail(f64::INFINITY, 3)], [1.0, 0.0]);
    assert!(tail(f64::NAN, 3).is_nan());
}

#[test]
fn known_quantiles_are_found() {
    // Abramowitz and Stegun, table 26.8
    for (share, freedom, value) in [
        (0.05, 1, 3.84146),
        (0.01, 1, 6.63490),
        (0.01, 25, 44.3141),
        (0.99, 10, 2.55821),
    ] {
        assert!((quantile(share, freedom) - value).abs() < 1e-4 * value);
    }
}

proptest! {
    #[test]
    fn the_quantile_is_the_inverse_of_the_tail(share in 1e-6..0.999_f64, freedom in 1_usize..500) {
        let again = tail(quantile(share, freedom), freedom);
        prop_assert!((again - share).abs() < 1e-9 * share);
    }

    /// Lags begin with 0, rise, reach the memory and no more of them than asked for.
    #[test]
    fn lags_rise(memory in 0_usize..5000, samples in 50_usize..50_000, count in 2_usize..26) {
        let lags = lags_over(memory, samples, count);
        prop_assert_eq!(lags[0], 0);
        prop_assert!(lags.windows(2).all(|pair| pair[0] < pair[1]));
        prop_assert!(lags.len() <= count);
        prop_assert_eq!(*lags.last().unwrap(), memory.min(samples / 10).max(count - 1));
    }

    #[test]
    fn a_basis_is_orthonormal_over_all_experiments(seed in 0_u64..1000, n in 5_usize..40) {
        let mut runs: Vec<_> = [n, 2 * n].map(|n| Columns::new(normal(3 * n, seed + n as u64), n)).into();
        // a fourth column that the others give, and one of zeros
        for run in &mut runs {
            let sum = Columns::new((0..run.len()).map(|k| run.row(k).iter().sum()).collect(), run.len());
            let nothing = Columns::new(vec![0.0; run.len()], run.len());
            *run = run.clone().beside(&sum).beside(&nothing);
        }
        let basis = independent(&runs, 1e-10);
        prop_assert_eq!(basis[0].width(), 3);
        prop_assert!((squared(&basis) - DMatrix::identity(3, 3)).amax() < 1e-6);
        let mut left = runs.clone();
        let taken = cross(&basis, &runs);
        for (run, d) in left.iter_mut().zip(&basis) {
            run.subtract(d, &taken);
        }
        prop_assert!(squared(&left).amax() < 1e-6);
    }
}

#[test]
fn lags_look_back_and_leads_ahead() {
    let z = Columns::new((1..=10).map(f64::from).collect(), 5);
    let known = [true, true, true, false, true];
    let late = lagged(&z, &[0, 2], &known);
    assert_eq!(late.row(1), [3.0, 0.0, 4.0, 0.0]);
    assert_eq!(late.row(2), [5.0, 1.0, 6.0, 2.0]);
    assert_eq!(late.row(3), [0.0; 4]);
    let early = leading(&z, &[1, 3], &known);
    assert_eq!(early.row(1), [5.0, 9.0, 6.0, 10.0]);
    assert_eq!(early.row(4), [0.0; 4]);
}

/// `Z'RZ` from the covariances of an autoregression, which come from its response.
fn direct(a: &[f64], innovation: f64, z: &Columns) -> DMatrix<f64> {
    let mut h = vec![1.0];
    for k in 1..4000_usize {
        let past = a.iter().zip((0..k).rev());
        h.push(past.map(|(a, back)| a * h[back]).sum());
    }
    let r = |lag: usize| innovation * (lag..h.len()).map(|k| h[k] * h[k - lag]).sum::<f64>();
    let r: Vec<f64> = (0..z.len()).map(r).collect();
    let mut sum = DMatrix::zeros(z.width(), z.width());
    for i in 0..z.len() {
        for j in 0..z.len() {
            let outer = DMatrix::from_fn(z.width(), z.width(), |p, q| z.row(i)[p] * z.row(j)[q]);
            sum += outer * r[i.abs_diff(j)];
        }
    }
    sum
}

#[test]
fn noise_finds_the_colour_and_its_covariance() {
    for a in [&[0.9][..], &[1.6, -0.68]] {
        let e = coloured(20_000, a, 5);
        let noise = Noise::fit(std::slice::from_ref(&e), &[vec![true; e.len()]], 0.0, false);
        assert!((noise.innovation - 1.0).abs() < 0.03);
        let z = Columns::new(normal(600, 3), 300);
        let found = noise.power_of(vec![z.clone()]);
        let exact = direct(a, 1.0, &z);
        assert!((&found - &exact).amax() < 0.1 * exact.amax());
        // to rounding where the colour is known
        let known = Noise {
            a: a.to_vec(),
            innovation: 1.0,
            variance: noise.variance,
        };
        assert!((known.power_of(vec![z]) - &exact).amax() < 1e-9 * exact.amax());
    }
}

/// Slow poles are left as they are, and a pole outside is its mirror, however close to the circle.
#[test]
fn slow_noise_keeps_its_power() {
    let n = 400;
    let z = Columns::new((0..n).map(|k| 1.0 + (0.001 * k as f64).sin()).collect(), n);
    let power = |a: &[f64], innovation: f64| {
        let noise = Noise {
            a: a.to_vec(),
            innovation,
            variance: 1.0,
        };
        noise.power_of(vec![z.clone()])[(0, 0)]
    };
    // the variance of a series with a double pole p is (1 + p^2) / (1 - p^2)^3, and its covariance falls slowly
    let p: f64 = 0.9995;
    let variance = (1.0 + p * p) / (1.0 - p * p).powi(3);
    let sum: f64 = z.column(0).sum();
    let found = power(&[2.0 * p, -p * p], 1.0) / (variance * sum * sum);
    assert!((0.95..1.0).contains(&found), "{found}");
    let mirrored = power(&[1.0 / p], 1.0) / power(&[p], p * p);
    assert!((mirrored - 1.0).abs() < 1e-9, "{mirrored}");
}

#[test]
fn poles_outside_the_circle_have_the_spectrum_of_mirrored_ones() {
    let z = Columns::new(normal(200, 1), 100);
    let noise = |a: f64, innovation: f64| Noise {
        a: vec![a],
        innovation,
        variance: 1.0,
    };
    let outside = noise(1.25, 2.0).power_of(vec![z.clone()]);
    let inside = noise(0.8, 2.0 / 1.25 / 1.25).power_of(vec![z]);
    assert!((&outside - &inside).amax() < 1e-12 * inside.amax());
}

#[test]
fn innovations_are_known_where_their_past_is() {
    let noise = Noise {
        a: vec![0.5, 0.1],
        innovation: 1.0,
        variance: 1.0,
    };
    let known = [true, true, true, true, false, true, true, true];
    assert_eq!(
        noise.known(&known),
        [false, false, true, true, false, false, false, true]
    );
}

struct Case {
    u: Vec<f64>,
    output: Vec<f64>,
    error: Vec<f64>,
    counts: Vec<bool>,
    sensitivity: Vec<f64>,
}

impl Case {
    /// `y(k) = u(k-1) + effect(k)`, with a gain and an offset as the parameters.
    fn new(n: usize, seed: u64, a: &[f64], effect: impl Fn(&[f64], &[f64], usize) -> f64) -> Self {
        let u = normal(n, seed);
        let output: Vec<f64> = (0..n).map(|k| if k > 0 { u[k - 1] } else { 0.0 }).collect();
        let noise = coloured(n, a, seed + 1000);
        let error: Vec<f64> = (0..n).map(|k| noise[k] + effect(&u, &noise, k)).collect();
        let mean = error.iter().sum::<f64>() / n as f64;
        Self {
            error: error.iter().map(|e| e - mean).collect(),
            sensitivity: output.iter().flat_map(|y| [*y, 1.0]).collect(),
            counts: vec![true; n],
            u,
            output,
        }
    }

    fn run(&self) -> Run<'_> {
        Run {
            u: &self.u,
            output: &self.output,
            error: &self.error,
            counts: &self.counts,
            sensitivity: &self.sensitivity,
        }
    }

    fn p_values(&self) -> Vec<f64> {
        let found = tests(&[self.run()], 1, 0, false, &Monitor::default()).unwrap();
        found.iter().map(|t| t.p_value).collect()
    }
}

#[test]
fn each_test_sees_what_it_is_for() {
    let (nothing, plain) = (
        Case::new(3000, 1, &[], |_, _, _| 0.0),
        Case::new(3000, 2, &[0.8], |_, _, _| 0.0),
    );
    for p in nothing.p_values() {
        assert!(p > 0.001);
    }
    let sound = plain.p_values();
    assert!(sound[0] < 1e-9, "coloured");
    assert!(sound[1..].iter().all(|p| *p > 0.001), "{sound:?}");
    let seen =
        |effect: fn(&[f64], &[f64], usize) -> f64| Case::new(3000, 3, &[], effect).p_values();
    assert!(seen(|u, _, k| 0.2 * u[k.saturating_sub(3)])[1] < 1e-6);
    assert!(seen(|u, _, k| 0.2 * u[k.saturating_sub(3)].powi(2))[2] < 1e-6);
    assert!(
        seen(|u, _, k| 0.1 * (u[k.saturating_sub(3)].powi(3) - 3.0 * u[k.saturating_sub(3)]))[3]
            < 1e-6
    );
    assert!(seen(|u, _, k| 0.2 * u[k.saturating_sub(1)].powi(2))[4] < 1e-6);
    assert!(seen(|u, e, k| 0.4 * e[k] * u[k.saturating_sub(2)].powi(2))[5] < 1e-6);
    assert!(seen(|u, e, k| 0.3 * e[k.saturating_sub(1)] * u[k.saturating_sub(1)])[6] < 1e-6);
}

#[test]
fn feedback_of_the_residual_is_seen() {
    let mut case = Case::new(3000, 4, &[], |_, _, _| 0.0);
    assert!(case.p_values()[7] > 0.001);
    for k in 1..3000 {
        case.u[k] += 0.3 * case.error[k - 1];
    }
    assert!(case.p_values()[7] < 1e-6);
}

/// Powers of two in place of a unit change no digit, however large.
#[test]
fn units_do_not_matter() {
    let case = Case::new(500, 6, &[0.5], |_, _, _| 0.0);
    let mut other = Case::new(500, 6, &[0.5], |_, _, _| 0.0);
    let (of_u, of_y) = (2.0_f64.powi(900), 2.0_f64.powi(-700));
    other.u.iter_mut().for_each(|v| *v *= of_u);
    other
        .output
        .iter_mut()
        .chain(&mut other.error)
        .for_each(|v| *v *= of_y);
    for (a, b) in case.p_values().iter().zip(other.p_values()) {
        assert!((a - b).abs() < 1e-9 * a, "{a} {b}");
    }
}

#[test]
fn two_experiments_count_as_one_sample() {
    let (a, b) = (
        Case::new(400, 8, &[0.5], |_, _, _| 0.0),
        Case::new(900, 9, &[0.5], |_, _, _| 0.0),
    );
    let found = tests(&[a.run(), b.run()], 1, 60, false, &Monitor::default()).unwrap();
    let sizes = |t: &Test| {
        (
            t.lags.len() * t.series.len(),
            t.correlations.len(),
            t.limits.len(),
        )
    };
    for test in &found {
        let (lags, correlations, limits) = sizes(test);
        assert_eq!((lags, lags), (correlations, limits));
        assert!(test.correlations.iter().all(|r| r.abs() <= 1.0));
        assert!((0.0..=1.0).contains(&test.explained));
    }
}

#[test]
fn a_moved_parameter_is_seen() {
    let case = Case::new(1000, 10, &[], |_, _, _| 0.0);
    assert!(parameters(&[case.run()], 1, 0).unwrap().p_value > 0.001);
    let moved = Case::new(
        1000,
        10,
        &[],
        |u, _, k| if k > 0 { 0.3 * u[k - 1] } else { 0.0 },
    );
    let (alone, trained) = [0, 1000]
        .map(|n| parameters(&[moved.run()], 1, n).unwrap())
        .into();
    assert!(alone.p_value < 1e-9);
    // half of the variance is that of the training
    assert!(trained.p_value > alone.p_value && trained.p_value < 1e-6);
}

#[test]
fn coloured_information_is_that_of_the_noise() {
    let case = Case::new(5000, 11, &[0.8], |_, _, _| 0.0);
    let found = coloured_information(&[case.run()], 1, 0.0).unwrap();
    // the input is white: the gain is as sure as the variance of the residual, the offset as its slow part
    assert!((found[(0, 0)] / 5000.0 * (1.0 - 0.64) - 1.0).abs() < 0.15);
    assert!((found[(1, 1)] / 5000.0 * 0.04 - 1.0).abs() < 0.3);
}

#[test]
fn what_cannot_be_tested_is_refused() {
    let case = Case::new(100, 12, &[], |_, _, _| 0.0);
    let monitor = Monitor::default();
    let refused =
        |runs: &[Run<'_>], channels| tests(runs, channels, 0, false, &monitor).unwrap_err().kind;
    assert_eq!(refused(&[], 1), ErrorKind::Data);
    assert_eq!(refused(&[case.run()], 2), ErrorKind::Data);
    let short = Run {
        output: &case.output[1..],
        ..case.run()
    };
    assert_eq!(refused(&[short], 1), ErrorKind::Data);
    let nothing = [false; 100];
    let unknown = Run {
        counts: &nothing,
        ..case.run()
    };
    assert_eq!(refused(&[unknown], 1), ErrorKind::Data);
    let other = Run {
        sensitivity: &case.sensitivity[..100],
        ..case.run()
    };
    assert_eq!(refused(&[case.run(), other], 1), ErrorKind::Data);
    monitor.request_stop();
    assert_eq!(refused(&[case.run()], 1), ErrorKind::Fit);
}

/// Zeros, constants and single samples give no number that is not one, and no panic.
#[test]
fn hardly_any_data_give_no_verdict() {
    for n in [1, 2, 3, 60] {
        for (u, e) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)] {
            let (values, error) = (vec![u; n], vec![e; n]);
            let run = Run {
                u: &values,
                output: &values,
                error: &error,
                counts: &vec![true; n],
                sensitivity: &[],
            };
            for test in tests(&[run], 1, 0, true, &Monitor::default()).unwrap() {
                assert_eq!(test.p_value.is_nan(), test.freedom == 0);
                assert!(test.correlations.iter().all(|r| r.is_finite()));
            }
        }
    }
}
