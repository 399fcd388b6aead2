//! The controller compared with its definition by sums, its limits and its start.

use super::*;
use proptest::prelude::*;
use std::vec::Vec;

const TS: f64 = 1e-3;

fn settings(kp: f64, ti: f64, td: f64) -> Settings<f64> {
    Settings::new(Standard { kp, ti, td }, TS)
}

fn run(settings: Settings<f64>, r: &[f64], y: &[f64]) -> Vec<f64> {
    let mut pid = Pid::new(settings).unwrap();
    r.iter().zip(y).map(|(&r, &y)| pid.step(r, y)).collect()
}

/// The definition written out: the sum of errors, and the filter's impulse response on the differences.
fn by_definition(s: &Settings<f64>, r: &[f64], y: &[f64], k: usize) -> f64 {
    let e = |j: usize| r[j] - y[j];
    let input = |j: usize| e(j) - s.beta * r[j];
    let (kp, filter) = (s.gains.kp, s.gains.td / s.n);
    let sum: f64 = (0..=k).map(e).sum();
    let rate: f64 = (1..=k)
        .map(|j| (filter / (filter + TS)).powi((k - j) as i32) * (input(j) - input(j - 1)))
        .sum();
    kp * (e(k) - s.alpha * r[k])
        + kp * TS / s.gains.ti * sum
        + kp * s.gains.td / (filter + TS) * rate
}

proptest! {
    #[test]
    fn equals_its_definition_where_nothing_limits(
        kp in -2.0..2.0, ti in prop_oneof![0.01..10.0, Just(f64::INFINITY)], td in 0.0..0.1,
        alpha in -0.5..1.5, beta in -0.5..1.5, n in prop_oneof![1.0..50.0, Just(f64::INFINITY)],
        r in prop::collection::vec(-10.0..10.0, 40), y in prop::collection::vec(-10.0..10.0, 40),
    ) {
        let s = Settings { alpha, beta, n, ..settings(kp, ti, td) };
        for (k, u) in run(s, &r, &y).into_iter().enumerate() {
            let exact = by_definition(&s, &r, &y, k);
            prop_assert!((u - exact).abs() <= 1e-10 * (1.0 + exact.abs() + 100.0 * kp.abs() * td / TS));
        }
    }

    #[test]
    fn stays_within_its_limits_whatever_comes(
        r in prop::collection::vec(prop::num::f64::ANY, 40),
        y in prop::collection::vec(prop::num::f64::ANY, 40),
        tt in prop_oneof![Just(0.0), 1e-3..1.0, Just(f64::INFINITY)],
    ) {
        let s = Settings { u_min: -3.0, u_max: 5.0, slew: 1e3, tt, ..settings(0.5, 0.1, 0.01) };
        let mut last = 0.0;
        for u in run(s, &r, &y) {
            prop_assert!((-3.0..=5.0).contains(&u) && f64::abs(u - last) <= 1.0 + 1e-12);
            last = u;
        }
    }

    #[test]
    fn single_and_double_precision_agree(
        r in prop::collection::vec(-10.0_f32..10.0, 60), y in prop::collection::vec(-10.0_f32..10.0, 60),
    ) {
        let double = Settings { alpha: 0.5, beta: 0.25, n: 8.0, u_min: -4.0, u_max: 4.0, ..settings(0.25, 0.125, 0.0078125) };
        let single = Settings {
            gains: Standard { kp: 0.25_f32, ti: 0.125, td: 0.0078125 },
            alpha: 0.5, beta: 0.25, n: 8.0, u_min: -4.0, u_max: 4.0, tt: 1.0, slew: f32::INFINITY, ts: 1e-3,
        };
        let (mut double, mut single) =
            (Pid::new(Settings { tt: 1.0, ..double }).unwrap(), Pid::new(single).unwrap());
        for (&r, &y) in r.iter().zip(&y) {
            let (a, b) = (double.step(r.into(), y.into()), single.step(r, y));
            prop_assert!((a - f64::from(b)).abs() < 1e-3, "{a} {b}");
        }
    }
}

#[test]
fn first_sample_gives_no_derivative_kick() {
    let mut pid = Pid::new(settings(1.0, f64::INFINITY, 1.0)).unwrap();
    assert_eq!(pid.step(500.0, 480.0), 20.0);
    assert_eq!(pid.step(500.0, 480.0), 20.0);
    pid.reset();
    assert_eq!(pid.step(0.0, 300.0), -300.0);
}

#[test]
fn reset_repeats_the_run() {
    let s = Settings {
        n: 5.0,
        u_max: 3.0,
        slew: 100.0,
        ..settings(0.5, 0.2, 0.01)
    };
    let mut pid = Pid::new(s).unwrap();
    let mut once = || -> Vec<f64> {
        pid.reset();
        (0..50)
            .map(|k| pid.step(f64::from(k % 7), f64::from(k % 5)))
            .collect()
    };
    assert_eq!(once(), once());
}

/// Samples from the error's change of sign until the output leaves its upper limit.
fn samples_until_released(tt: f64) -> usize {
    let s = Settings {
        u_min: -1.0,
        u_max: 1.0,
        tt,
        ..settings(0.1, 0.1, 0.0)
    };
    let mut pid = Pid::new(s).unwrap();
    for _ in 0..2_000 {
        pid.step(20.0, 0.0);
    }
    (0..20_000)
        .take_while(|_| pid.step(20.0, 21.0) == 1.0)
        .count()
}

#[test]
fn anti_windup_releases_the_output_at_once() {
    assert!(samples_until_released(f64::INFINITY) > 10_000);
    assert_eq!(samples_until_released(0.0), 0);
    assert!(samples_until_released(0.01) < 5);
}

#[test]
fn conditional_integration_stops_only_while_limited() {
    let s = Settings {
        u_max: 1.0,
        ..settings(1.0, 1.0, 0.0)
    };
    let mut pid = Pid::new(s).unwrap();
    for _ in 0..100 {
        assert_eq!(pid.step(10.0, 0.0), 1.0);
    }
    let u: Vec<f64> = (0..2).map(|_| pid.step(0.5, 0.0)).collect();
    assert!(
        (u[0] - 0.5005).abs() < 1e-12 && (u[1] - 0.501).abs() < 1e-12,
        "{u:?}"
    );
}

#[test]
fn back_calculation_leaves_no_integral_where_there_is_none() {
    let s = Settings {
        u_max: 1.0,
        tt: 0.01,
        ..settings(1.0, f64::INFINITY, 0.0)
    };
    let mut pid = Pid::new(s).unwrap();
    for _ in 0..100 {
        pid.step(10.0, 0.0);
    }
    assert_eq!(pid.step(0.5, 0.0), 0.5);
}

#[test]
fn slew_is_counted_from_rest() {
    let s = Settings {
        slew: 100.0,
        u_max: 0.25,
        ..settings(1.0, f64::INFINITY, 0.0)
    };
    let mut pid = Pid::new(s).unwrap();
    let u: Vec<f64> = (0..4).map(|_| pid.step(1.0, 0.0)).collect();
    for (u, exact) in u.iter().zip([0.1, 0.2, 0.25, 0.25]) {
        assert!((u - exact).abs() < 1e-12);
    }
}

#[test]
fn refuses_settings_out_of_range() {
    let good = settings(1.0, 1.0, 0.0);
    let refused = |s: Settings<f64>| Pid::new(s).unwrap_err().name;
    assert_eq!(
        refused(Settings {
            alpha: f64::NAN,
            ..good
        }),
        "alpha"
    );
    assert_eq!(
        refused(Settings {
            beta: f64::INFINITY,
            ..good
        }),
        "beta"
    );
    assert_eq!(refused(Settings { n: 0.0, ..good }), "N");
    assert_eq!(refused(Settings { tt: 1e-4, ..good }), "Tt");
    assert_eq!(refused(Settings { tt: -1.0, ..good }), "Tt");
    assert_eq!(refused(Settings { slew: 0.0, ..good }), "slew");
    assert_eq!(
        refused(Settings {
            u_min: 1.0,
            u_max: 1.0,
            ..good
        }),
        "u_max"
    );
    assert_eq!(
        refused(Settings {
            u_min: f64::NAN,
            ..good
        }),
        "u_min"
    );
    assert_eq!(
        refused(Settings {
            u_max: f64::NAN,
            ..good
        }),
        "u_max"
    );
    assert_eq!(refused(Settings { ts: 0.0, ..good }), "Ts");
    assert_eq!(refused(settings(1.0, 0.0, 0.0)), "Ti");
}

#[test]
fn conditional_integration_finds_its_way_off_a_limit() {
    // With alpha above 1 a falling reference lifts the command: error and excess then have different signs.
    let s = Settings {
        alpha: 2.0,
        u_max: 1.0,
        ..settings(0.1, 0.1, 0.0)
    };
    let mut pid = Pid::new(s).unwrap();
    for _ in 0..5_000 {
        pid.step(10.0, 9.0);
    }
    assert_eq!(pid.step(0.0, 1.0), 1.0);
    let last = (0..5_000).map(|_| pid.step(0.0, 1.0)).last().unwrap();
    assert!(last < 0.0, "{last}");
}
