use super::*;
use crate::random::Random;
use proptest::prelude::*;

const TS: f64 = 1e-3;

/// Inputs and outputs of a step from `u_low` to `u_high` at sample `at`.
fn response(plant: Fopdt, at: usize, n: usize) -> (Vec<f64>, Vec<f64>) {
    let u: Vec<f64> = (0..n)
        .map(|k| if k < at { plant.u_low } else { plant.u_high })
        .collect();
    let y = (0..n).map(|k| {
        let since = (k as f64 - at as f64) * TS - plant.l;
        let share = if since > 0.0 {
            1.0 - (-since / plant.t).exp()
        } else {
            0.0
        };
        plant.offset + plant.k * (plant.u_low + share * (plant.u_high - plant.u_low))
    });
    (u.clone(), y.collect())
}

fn plant(k: f64, t: f64, l: f64, offset: f64) -> Fopdt {
    Fopdt {
        k,
        t,
        l,
        offset,
        u_low: 1.0,
        u_high: 3.0,
        fit_percent: 100.0,
        errors: [0.0; 3],
        limited: 0,
        moving: false,
        overshoot: 0.0,
    }
}

fn fit(u: &[f64], y: &[f64]) -> Result<Fopdt> {
    fit_fopdt(Record::new(u, 1, y).unwrap(), TS, &Monitor::default())
}

/// A response without noise must give its plant back.
fn recovers(plant: &Fopdt, at: usize, n: usize) {
    let (u, y) = response(*plant, at, n);
    let found = fit(&u, &y).unwrap();
    let Fopdt {
        k, t, l, offset, ..
    } = *plant;
    assert!((found.k / k - 1.0).abs() < 1e-4, "{found:?}");
    assert!((found.t - t).abs() < 1e-3 * t + 1e-6, "{found:?}");
    assert!((found.l - l).abs() < 1e-5 + 1e-3 * t, "{found:?}");
    assert!((found.offset - offset).abs() < 1e-3 * (k.abs() + offset.abs()));
    assert!(found.fit_percent > 99.9);
}

proptest! {
    #![proptest_config(crate::laws::cases(500))]
    /// The search takes time in proportion to the record: one in a hundred has 3,000 samples, the others 60 and faster plants.
    #[test]
    fn recovers_an_exact_response(
        k in prop_oneof![1.0..1000.0, -1000.0..-1.0], t in 0.01..0.4, l in 0.0..0.2,
        offset in -500.0..500.0, at in 1_usize..800, long in prop::bool::weighted(0.01),
    ) {
        let (n, t, l, at) =
            if long { (3000, t, l, at) } else { (60, 1e-3 + 0.015 * t, 0.02 * l, 1 + at / 50) };
        recovers(&plant(k, t, l, offset), at, n);
    }
}

#[test]
fn recovers_what_once_ended_beside_the_best() {
    recovers(&plant(1.0, 0.350_396_400_395_631_2, 0.0, 0.0), 99, 3000);
    recovers(&plant(1.0, 0.01, 0.168_730_799_256_019_55, 0.0), 601, 3000);
}

#[test]
fn bears_noise_and_the_steps_of_raw_speed() {
    let truth = plant(490.0, 0.25, 0.0075, 20.0);
    let (u, y) = response(truth, 300, 2500);
    let (mut random, count) = (Random::new(3), 38.168);
    let raw: Vec<f64> = y
        .iter()
        .map(|y| ((y + 15.0 * random.normal()) / count).round() * count)
        .collect();
    let found = fit(&u, &raw).unwrap();
    assert!((found.k / truth.k - 1.0).abs() < 0.005, "{found:?}");
    assert!((found.t / truth.t - 1.0).abs() < 0.02 && (found.l - truth.l).abs() < 0.002);
    assert!(found.fit_percent > 90.0 && found.fit_percent < 99.0);
}

#[test]
fn uses_the_first_step_of_several() {
    let truth = plant(490.0, 0.1, 0.01, 0.0);
    let (mut u, mut y) = response(truth, 100, 1000);
    u.extend([0.0; 500]);
    y.extend([0.0; 500]);
    let found = fit(&u, &y).unwrap();
    assert!(
        (found.k / truth.k - 1.0).abs() < 1e-3 && found.u_high == 3.0,
        "{found:?}"
    );
}

#[test]
fn refuses_what_holds_no_settled_step() {
    let truth = plant(490.0, 0.25, 0.01, 0.0);
    let (u, y) = response(truth, 100, 400);
    assert!(fit(&u, &y).unwrap_err().message.contains("settles"));
    assert!(
        fit(&[1.0; 500], &[0.0; 500])
            .unwrap_err()
            .message
            .contains("a step")
    );
    assert!(fit(&[], &[]).is_err());
    let ramp: Vec<f64> = (0..15).map(f64::from).collect();
    assert!(fit(&ramp, &ramp).unwrap_err().message.contains("ramp"));
    let (u, _) = response(truth, 100, 2000);
    let mut random = Random::new(1);
    let noise: Vec<f64> = (0..2000).map(|_| random.normal()).collect();
    assert!(fit(&u, &noise).unwrap_err().message.contains("noise"));
    assert!(fit(&u, &[7.3; 2000]).unwrap_err().message.contains("noise"));
    assert!(
        fit_fopdt(
            Record::new(&[1.0, 2.0], 2, &[1.0]).unwrap(),
            TS,
            &Monitor::default()
        )
        .is_err()
    );
    assert!(
        fit_fopdt(
            Record::new(&u, 1, &noise).unwrap(),
            0.0,
            &Monitor::default()
        )
        .is_err()
    );
}

/// Residuals of a first-order autoregression.
fn coloured(random: &mut Random, n: usize, rho: f64, size: f64) -> Vec<f64> {
    let mut x = size * random.normal();
    let drive = size * (1.0 - rho * rho).sqrt();
    (0..n)
        .map(|_| {
            x = rho * x + drive * random.normal();
            x
        })
        .collect()
}

/// 200 records of each spectrum. Two sigma should cover at least 92 % of them (95 % if all were known exactly); fewer
/// than 165 hits would be five standard deviations off (binomial: 184 - 5 x 3.84).
/// five standard deviations off (binomial: 184 - 5 x 3.84).
#[test]
fn intervals_hold_with_white_and_coloured_noise() {
    let truth = plant(490.0, 0.03, 0.0063, 20.0);
    for (seed, rho) in [(1, 0.0), (2, 0.8), (3, -0.6)] {
        let mut random = Random::new(seed);
        let mut hits = [0; 3];
        for _ in 0..200 {
            let (u, y) = response(truth, 100, 500);
            let noise = coloured(&mut random, y.len(), rho, 20.0);
            let noisy: Vec<f64> = y.iter().zip(&noise).map(|(y, e)| y + e).collect();
            let found = fit(&u, &noisy).unwrap();
            let off = [found.k - truth.k, found.t - truth.t, found.l - truth.l];
            for (hit, (off, error)) in hits.iter_mut().zip(off.iter().zip(found.errors)) {
                *hit += usize::from(off.abs() < 2.0 * error);
            }
        }
        assert!(
            hits.iter().all(|&hit| (165..200).contains(&hit)),
            "{rho} {hits:?}"
        );
    }
}

#[test]
fn a_limited_output_has_no_weight() {
    let truth = plant(490.0, 0.12, 0.01, 20.0);
    let mut random = Random::new(7);
    let (u, y) = response(truth, 200, 1200);
    let full = 490.0 * 2.0;
    let limit = 20.0 + 490.0 + 0.85 * full;
    let limited: Vec<f64> = y
        .iter()
        .map(|y| (y + 3.0 * random.normal()).min(limit))
        .collect();
    let found = fit(&u, &limited).unwrap();
    assert!(found.limited > 500, "{found:?}");
    assert!((found.k / truth.k - 1.0).abs() < 0.03, "{found:?}");
    assert!((found.t / truth.t - 1.0).abs() < 0.06, "{found:?}");
    // a response that settles at whole counts is not a limited one
    for counts in [1.0, 38.168] {
        let settled: Vec<f64> = y.iter().map(|y| (y / counts).round() * counts).collect();
        let found = fit(&u, &settled).unwrap();
        assert!(
            found.limited == 0 && (found.k / truth.k - 1.0).abs() < 0.02,
            "{found:?}"
        );
    }
}

#[test]
fn a_machine_that_still_moved_is_fitted_with_its_free_response() {
    let truth = plant(490.0, 0.12, 0.01, 20.0);
    let mut random = Random::new(9);
    let (u, y) = response(truth, 200, 1200);
    let moved: Vec<f64> = y
        .iter()
        .enumerate()
        .map(|(k, y)| y + 600.0 * (-(k as f64) * TS / truth.t).exp() + 3.0 * random.normal())
        .collect();
    let found = fit(&u, &moved).unwrap();
    assert!(found.moving, "{found:?}");
    let off = [found.k - truth.k, found.t - truth.t, found.l - truth.l];
    for (off, error) in off.iter().zip(found.errors) {
        assert!(off.abs() < 5.0 * error, "{found:?}");
    }
    assert!((found.k / truth.k - 1.0).abs() < 0.01 && (found.t / truth.t - 1.0).abs() < 0.03);
}

#[test]
fn a_stop_ends_the_search() {
    let (u, y) = response(plant(490.0, 0.12, 0.01, 20.0), 200, 1200);
    let monitor = Monitor::default();
    monitor.request_stop();
    let stopped = fit_fopdt(Record::new(&u, 1, &y).unwrap(), TS, &monitor);
    assert!(stopped.unwrap_err().message.contains("stop"));
}

/// Outputs of a second order of damping `zeta` after a step at `at`.
fn oscillating(zeta: f64, at: usize, n: usize) -> (Vec<f64>, Vec<f64>) {
    let (u, _) = response(plant(1.0, 1.0, 0.0, 0.0), at, n);
    let (omega, damped) = (60.0, (1.0 - zeta * zeta).sqrt());
    let y = (0..n).map(|k| {
        let t = omega * TS * k.saturating_sub(at) as f64;
        let (sin, cos) = (damped * t).sin_cos();
        500.0 - 200.0 * (-zeta * t).exp() * (cos + zeta / damped * sin)
    });
    (u, y.collect())
}

#[test]
fn an_overshoot_beyond_the_noise_is_told() {
    for (zeta, n) in [(0.1, 1000), (0.2, 600), (0.3, 600), (0.5, 800)] {
        let (u, y) = oscillating(zeta, 100, n);
        let peak = (-std::f64::consts::PI * zeta / (1.0 - zeta * zeta).sqrt()).exp();
        let found = fit(&u, &y).unwrap().overshoot;
        assert!((found - peak).abs() < 0.07, "{zeta}: {found}, {peak}");
        let mirrored: Vec<f64> = y.iter().map(|y| -y).collect();
        assert!((fit(&u, &mirrored).unwrap().overshoot - found).abs() < 1e-6);
        let mut random = Random::new(7);
        let noisy: Vec<f64> = y.iter().map(|y| y + 6.0 * random.normal()).collect();
        assert!(fit(&u, &noisy).unwrap().overshoot > 0.8 * peak);
    }
}

#[test]
fn noise_on_a_first_order_is_no_overshoot() {
    for (t, colour) in [(0.02, 0.0), (0.02, 0.95), (0.1, 0.0), (0.1, 0.9)] {
        let (u, y) = response(plant(100.0, t, 0.005, 20.0), 150, 900);
        for seed in 0..25 {
            let (mut random, mut noise) = (Random::new(seed), 0.0);
            let noisy: Vec<f64> = y
                .iter()
                .map(|y| {
                    noise = colour * noise + random.normal();
                    y + 20.0 * (1.0 - colour * colour).sqrt() * noise
                })
                .collect();
            assert_eq!(
                fit(&u, &noisy).unwrap().overshoot,
                0.0,
                "{t} {colour} {seed}"
            );
        }
    }
}
