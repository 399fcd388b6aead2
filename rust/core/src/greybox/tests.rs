use super::*;
use crate::random::Random;

fn run(task: Run<'_>, u: &[f64]) -> Result<Found> {
    super::run(task, u, &Monitor::default())
}
const THETA: [f64; 30] = [
    0.019, 0.0006, 0.0049, 0.0073, 0.08, 0.06, 0.25, 0.03, 0.12, 9.0, 0.14, -0.06, 0.05, 0.02,
    2e-4, -1e-4, 0.0013, 6.0, 0.04, 4e-4, 0.01, -0.02, 0.05, 0.02, -0.03, 0.04, 0.02, 0.03, 0.03,
    -0.02,
];

fn commands(n: usize) -> Vec<f64> {
    let mut random = Random::new(3);
    let mut level = 0.0;
    (0..n)
        .map(|k| {
            if k % 37 == 0 {
                level = 16.0 * random.uniform() - 8.0;
            }
            level
        })
        .collect()
}

fn task<'a>(theta: &'a [f64; 30], free: &'a [usize], angle: Option<&'a [f64]>) -> Run<'a> {
    Run {
        theta,
        free,
        sample_time: 0.001,
        steps: 2,
        speed: 20.0,
        mean: true,
        angle,
        orders: [3, 6, 12, 4],
    }
}

/// Compares with differences, except where a sample lies on a kink between them.
#[test]
fn derivatives_are_those_of_the_values() {
    let u = commands(400);
    let angle: Vec<f64> = (0..400).map(|k| 0.1 * k as f64).collect();
    let free: Vec<usize> = (0..30).collect();
    let found = run(task(&THETA, &free, Some(&angle)), &u).unwrap();
    for j in 0..30 {
        let h = 1e-6 * THETA[j].abs();
        let beside = |sign: f64| {
            let mut theta = THETA;
            theta[j] += sign * h;
            run(task(&theta, &[], Some(&angle)), &u).unwrap()
        };
        let (more, less) = (beside(1.0), beside(-1.0));
        for (by, [a, b]) in [
            (&found.speed_by, [&more.speed, &less.speed]),
            (&found.drive_by, [&more.drive, &less.drive]),
        ] {
            let column: Vec<f64> = (0..400).map(|k| by[30 * k + j]).collect();
            let scale = column.iter().fold(0.0_f64, |most, d| most.max(d.abs()));
            if (ECCENTRIC..WAVES).contains(&j) && std::ptr::eq(by, &found.drive_by) {
                assert_eq!(scale, 0.0); // the encoder shows it, but not the motor
                continue;
            }
            assert!(scale > 0.0, "{} moves nothing", PARAMETERS[j]);
            let off = (0..400)
                .filter(|&k| ((a[k] - b[k]) / (2.0 * h) - column[k]).abs() > 2e-4 * scale)
                .count();
            assert!(off <= 4, "{}: {off} samples", PARAMETERS[j]);
        }
    }
}

#[test]
fn a_linear_motor_reaches_its_steady_speed_with_its_time_constants() {
    let mut theta = [0.0; 30];
    theta[..6].copy_from_slice(&[0.02, 0.001, 0.004, 0.005, 0.0, 1.0]);
    theta[9] = 1.0;
    theta[17] = f64::INFINITY;
    let u = vec![3.0; 3000];
    let mut of = task(&theta, &[], None);
    (of.speed, of.mean, of.steps) = (0.0, false, 4);
    let found = run(of, &u).unwrap();
    // tau k_a w'' + (k_a + tau k_b) w' + (k_e + k_b) w = u, from rest, with the drive at its steady value
    let (a2, a1, a0): (f64, f64, f64) = (0.005 * 0.004, 0.004 + 0.005 * 0.001, 0.021);
    let root = (a1 * a1 - 4.0 * a2 * a0).sqrt();
    let (p, q) = ((-a1 + root) / (2.0 * a2), (-a1 - root) / (2.0 * a2));
    let last = 3.0 / a0;
    let (start, slope) = (-last, 3.0 / 0.004);
    let c = (slope - q * start) / (p - q);
    for k in [1, 5, 20, 100, 400, 2999] {
        let t = 0.001 * k as f64;
        let exact = last + c * (p * t).exp() + (start - c) * (q * t).exp();
        assert!(
            (found.speed[k] - exact).abs() < 2e-4 * last,
            "{k}: {} {exact}",
            found.speed[k]
        );
    }
}

/// A current is measured at the sample: an error of half a step is a third of a per cent of the resistance.
#[test]
fn the_drive_is_that_of_the_sample() {
    for tau in [0.0, 5e-4, 0.02] {
        let mut theta = [0.0; 30];
        theta[..6].copy_from_slice(&[0.02, 0.001, 0.0012, tau, 0.0, 1.0]);
        theta[9] = 1.0;
        theta[17] = f64::INFINITY;
        let u: Vec<f64> = (0..400).map(|k| f64::from(k / 100 % 2)).collect();
        let found = |steps: usize| {
            let mut of = task(&theta, &[], None);
            (of.speed, of.steps) = (0.0, steps);
            run(of, &u).unwrap().drive
        };
        let (few, many) = (found(2), found(2000));
        for k in (0..400).filter(|k| k % 100 > 2) {
            let off = (few[k] - many[k]).abs();
            assert!(off < 2e-4, "{tau} {k}: {off}");
        }
    }
}

#[test]
fn friction_holds_what_it_can_and_no_more() {
    let mut theta = THETA;
    theta[10..16].fill(0.0);
    theta[UNEVEN..].fill(0.0);
    let mut of = task(&theta, &[], None);
    of.speed = 0.0;
    let held = run(of, &[0.38; 500]).unwrap(); // below k_s + k_t + offset, including the drop
    assert!(held.speed.iter().all(|&w| w == 0.0));
    let moving = run(of, &[0.6; 500]).unwrap();
    assert!(moving.speed[499] > 1.0);
}

/// A wave that repeats several times within a sample cancels: one long sample gives the same as many short ones.
#[test]
fn a_wave_acts_by_its_mean_over_a_sample() {
    let theta = {
        let mut theta = [0.0; 30];
        theta[..6].copy_from_slice(&[0.02, 0.0, 0.004, 0.0, 0.0, 1.0]);
        (theta[9], theta[LIMIT]) = (1.0, f64::INFINITY);
        (theta[WAVES], theta[WAVES + 1]) = (0.3, -0.2);
        theta
    };
    let after = |samples: usize| {
        let (speed, ts) = (200.0, 0.004 / samples as f64);
        let angle: Vec<f64> = (0..=samples).map(|k| 0.3 + speed * ts * k as f64).collect();
        let mut of = task(&theta, &[], Some(&angle));
        (of.orders, of.mean, of.speed) = ([12, 0, 0, 0], false, speed);
        (of.sample_time, of.steps) = (ts, 1 + 64 / samples);
        // the command that holds the speed, so that only the wave changes the speed
        run(of, &vec![4.0; samples + 1]).unwrap().speed[samples]
    };
    let (once, often) = (after(1) - 200.0, after(64) - 200.0);
    assert!(once.abs() > 1e-3, "{once}");
    assert!((once - often).abs() < 0.02 * once.abs(), "{once} {often}");
}

#[test]
fn an_order_of_none_is_no_wave() {
    let (u, angle) = (commands(50), vec![0.4; 50]);
    let mut of = task(&THETA, &[WAVES], Some(&angle));
    of.orders = [0; ORDERS];
    assert!(run(of, &u).unwrap_err().message.contains("orders"));
    of.free = &[];
    let mut none = THETA;
    none[WAVES..].fill(0.0);
    let mut even = of;
    even.theta = &none;
    assert_eq!(run(of, &u).unwrap(), run(even, &u).unwrap());
}

#[test]
fn a_delay_of_whole_samples_shifts_the_command() {
    let u = commands(300);
    let angle = vec![0.4; 300];
    let (mut none, mut two) = (THETA, THETA);
    (none[16], two[16]) = (0.0, 0.002);
    let late: Vec<f64> = [u[0], u[0]].iter().chain(&u[..298]).copied().collect();
    assert_eq!(
        run(task(&two, &[], Some(&angle)), &u).unwrap(),
        run(task(&none, &[], Some(&angle)), &late).unwrap()
    );
}

#[test]
fn the_width_of_the_derivatives_changes_no_value() {
    let u = commands(200);
    let angle = vec![0.4; 200];
    let free: Vec<usize> = (0..30).collect();
    let plain = run(task(&THETA, &[], Some(&angle)), &u).unwrap();
    for count in [3, 7, 11, 15, 18, 30] {
        let found = run(task(&THETA, &free[..count], Some(&angle)), &u).unwrap();
        assert_eq!(found.speed, plain.speed);
        assert_eq!(found.drive, plain.drive);
    }
}

#[test]
fn what_cannot_be_simulated_is_refused() {
    let u = commands(10);
    let refused = |change: &dyn Fn(&mut [f64; 30])| {
        let mut theta = THETA;
        change(&mut theta);
        run(task(&theta, &[], None), &u).unwrap_err().message
    };
    assert!(refused(&|theta| theta[2] = 0.0).contains("k_a"));
    assert!(refused(&|theta| theta[3] = -1.0).contains("tau"));
    assert!(refused(&|theta| theta[0] = f64::NAN).contains("k_e"));
    assert!(
        run(task(&THETA, &[10], None), &u)
            .unwrap_err()
            .message
            .contains("angle")
    );
    assert!(run(task(&THETA, &[99], None), &u).is_err());
    assert!(run(task(&THETA, &[], None), &[f64::NAN]).is_err());
    assert!(run(task(&THETA, &[], Some(&[0.0])), &u).is_err());
    assert!(run(task(&THETA, &[], None), &[]).unwrap().speed.is_empty());
}
