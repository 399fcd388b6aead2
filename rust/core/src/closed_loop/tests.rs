//! The loop against its linear state-space form, its encoder, its plants and its outcomes.

use nalgebra::{Matrix3, Vector3};

mod state_space;

use sewfast_control::{
    Biquad, Cascade, Design, Feedforward, Level, PidController, Settings, Standard,
};

use super::*;
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::machine::{Machine, Parameters};

const TS: f64 = 1e-3;

fn closed(
    plant: &mut impl Plant,
    controller: &mut AnyController<f64>,
    reference: &[f64],
    encoder: Option<&Encoder>,
) -> Result<Run> {
    closed_loop(plant, controller, reference, encoder, &Monitor::default())
}

fn lag() -> LinearModel {
    LinearModel::new(vec![-0.98], vec![9.8], 1, 1, 0.0).unwrap()
}

fn controller(settings: Settings<f64>, samples: usize) -> AnyController<f64> {
    let design = Design {
        filter_samples: samples,
        ..Design::new(settings)
    };
    PidController::new(design).unwrap().into()
}

fn pi(kp: f64, ti: f64) -> Settings<f64> {
    Settings::new(Standard { kp, ti, td: 0.0 }, TS)
}

#[test]
fn equals_the_exact_linear_loop_where_nothing_limits() {
    let (a, b, kp, ti, alpha) = (0.98, 9.8, 2e-3, 0.05, 0.3);
    let model = lag();
    let settings = Settings {
        alpha,
        ..pi(kp, ti)
    };
    let r = 1000.0;
    let run = closed(
        &mut LaggedPlant::new(&model, TS).unwrap(),
        &mut controller(settings, 1),
        &[r; 300],
        None,
    )
    .unwrap();
    // State (y, integral, 1): u = kp (r - y - alpha r) + integral + ki (r - y).
    let ki = kp * TS / ti;
    #[rustfmt::skip]
    let step = Matrix3::new(
        a - b * (kp + ki), b,   b * (kp * (1.0 - alpha) + ki) * r,
        -ki,               1.0, ki * r,
        0.0,               0.0, 1.0,
    );
    let mut x = Vector3::new(0.0, 0.0, 1.0);
    for (k, &y) in run.y.iter().enumerate() {
        assert!((y - x[0]).abs() < 1e-9, "{k}: {y} {}", x[0]);
        x = step * x;
    }
    assert!((run.y[299] - r).abs() < 15.0 && run.outcome == Outcome::Completed);
}

#[test]
fn a_model_in_the_loop_gives_what_it_gives_in_free_run() {
    let model = LinearModel::new(vec![-1.5, 0.54], vec![3.0, 2.0, 1.0], 1, 3, 0.0).unwrap();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let reference: Vec<f64> = (0..200)
        .map(|k| 100.0 * (f64::from(k) / 20.0).sin())
        .collect();
    let run = closed(
        &mut plant,
        &mut controller(pi(0.01, 0.1), 1),
        &reference,
        None,
    );
    let run = run.unwrap();
    // The loop starts at rest: the command before the first sample is 0.
    let mut u = vec![0.0; 4];
    u.extend(&run.u);
    let free = model.simulate(&u, 1, &[0.0, 0.0]).unwrap();
    for (a, b) in run.y.iter().zip(&free[4..]) {
        assert!((a - b).abs() < 1e-9);
    }
}

#[test]
fn an_encoder_is_quantised_to_whole_counts_and_exact_on_average() {
    let model = lag();
    let scale = 1572.0 / 60.0;
    let sensor = encoder(scale, 0.5).unwrap();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let run = closed(
        &mut plant,
        &mut controller(pi(1e-3, 0.1), 1),
        &[500.0; 2000],
        sensor.as_ref(),
    );
    let run = run.unwrap();
    for measured in &run.feedback {
        let counts = measured * TS * scale;
        assert!((counts - counts.round()).abs() < 1e-6);
    }
    let mean = |x: &[f64]| x[1000..].iter().sum::<f64>() / 1000.0;
    assert!((mean(&run.feedback) - mean(&run.y)).abs() < 2.0 * 38.2 / 1000.0);
    assert!(
        run.feedback
            .iter()
            .zip(&run.y)
            .any(|(m, y)| (m - y).abs() > 5.0)
    );
}

#[test]
fn says_when_the_loop_diverges() {
    let unstable = LinearModel::new(vec![-2.0], vec![1.0], 1, 1, 0.0).unwrap();
    let mut plant = LaggedPlant::new(&unstable, TS).unwrap();
    let run = closed(
        &mut plant,
        &mut controller(pi(1e-9, 1.0), 1),
        &[1.0; 2000],
        None,
    );
    let run = run.unwrap();
    assert!(matches!(run.outcome, Outcome::Diverged(k) if k == run.y.len() && k < 200));
    assert!(run.y.iter().chain(&run.u).all(|v| v.is_finite()));
}

#[test]
fn repeats_a_run_from_rest() {
    let model = lag();
    let mut plant = Varied::new(LaggedPlant::new(&model, TS).unwrap(), 1.25, 2).unwrap();
    let mut c = controller(
        Settings {
            u_max: 3.0,
            ..pi(2e-3, 0.05)
        },
        8,
    );
    let sensor = encoder(26.2, 0.5).unwrap();
    let mut once = || closed(&mut plant, &mut c, &[400.0; 300], sensor.as_ref()).unwrap();
    assert_eq!(once(), once());
}

#[test]
fn a_varied_plant_has_its_gain_and_its_delay() {
    let model = lag();
    let settle = |gain, delay| {
        let mut plant = Varied::new(LaggedPlant::new(&model, TS).unwrap(), gain, delay).unwrap();
        let y: Vec<f64> = (0..2000)
            .map(|_| {
                plant.advance(1.0);
                plant.output()
            })
            .collect();
        (y[1999], y.iter().take_while(|&&y| y == 0.0).count())
    };
    let (nominal, none) = settle(1.0, 0);
    let (scaled, two) = settle(0.8, 2);
    assert!((scaled / nominal - 0.8).abs() < 1e-9 && (none, two) == (0, 2));
    assert!(Varied::new(LaggedPlant::new(&model, TS).unwrap(), 0.0, 0).is_err());
    assert!(Varied::new(LaggedPlant::new(&model, TS).unwrap(), 1.0, 17).is_err());
}

#[test]
fn refuses_what_cannot_be_closed() {
    let two = LinearModel::new(vec![-0.9], vec![1.0, 1.0], 2, 1, 0.0).unwrap();
    let direct = LinearModel::new(vec![-0.9], vec![1.0], 1, 0, 0.0).unwrap();
    assert!(
        LaggedPlant::new(&two, TS)
            .unwrap_err()
            .message
            .contains("one input")
    );
    assert!(
        LaggedPlant::new(&direct, TS)
            .unwrap_err()
            .message
            .contains("nk")
    );
    assert!(LaggedPlant::new(&lag(), 0.0).is_err());
    assert!(encoder(-1.0, 0.5).is_err() && encoder(1.0, 2.0).is_err());
    assert_eq!(encoder(0.0, 0.5), Ok(None));
    let model = lag();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    for bad in [&[][..], &[1.0, f64::NAN]] {
        let run = closed(&mut plant, &mut controller(pi(1.0, 1.0), 1), bad, None);
        assert!(run.is_err());
    }
}

#[test]
fn the_machine_is_measured_by_its_own_encoder() {
    let machine = |quantisation| {
        let changes = [("quantisation", quantisation)];
        Machine::new(Parameters::default().with(changes).unwrap()).unwrap()
    };
    let run = |quantisation, encoder: Option<&Encoder>| {
        let mut c = controller(pi(2e-3, 0.1), 1);
        closed(&mut machine(quantisation), &mut c, &[1000.0; 500], encoder).unwrap()
    };
    let other = Encoder::new(1.0, 0.0);
    assert_eq!(run(1.0, Some(&other)), run(1.0, None));
    let count = 60.0 / (1572.0 * TS);
    assert!(
        run(1.0, None)
            .feedback
            .iter()
            .all(|y| (y / count - (y / count).round()).abs() < 1e-6)
    );
    let ideal = run(0.0, None);
    assert!(
        ideal
            .feedback
            .windows(2)
            .zip(ideal.y.windows(2))
            .all(|(m, y)| (m[1] - (y[0] + y[1]) / 2.0).abs() < 2.0)
    );
}

#[test]
fn stops_on_request() {
    let monitor = Monitor::default();
    monitor.request_stop();
    let (model, mut c) = (lag(), controller(pi(1.0, 1.0), 1));
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let run = closed_loop(&mut plant, &mut c, &[1.0; 10], None, &monitor).unwrap();
    assert_eq!((run.outcome, run.u.len()), (Outcome::Interrupted(0), 0));
}

#[test]
fn a_model_begins_at_standstill_wherever_it_would_settle() {
    // a drive with friction: without a command its model would settle at -50, and the drive stands
    let model = LinearModel::new(vec![-1.5, 0.54], vec![3.0], 1, 1, -2.0).unwrap();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    assert_eq!((plant.output(), plant.position()), (0.0, 0.0));
    plant.advance(0.0);
    assert_eq!(plant.output(), -2.0);
    plant.reset();
    assert_eq!((plant.output(), plant.position()), (0.0, 0.0));
}

#[test]
fn signals_that_do_not_fit_are_refused() {
    let model = lag();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let mut c = controller(pi(1e-3, 0.1), 1);
    let mut refused = |feedforward, disturbance| {
        let signals = Signals {
            feedforward,
            disturbance,
            ..Signals::new(&[1.0; 3])
        };
        let monitor = Monitor::default();
        let run = closed_loop_with(&mut plant, &mut c, signals, None, &monitor);
        run.unwrap_err().message
    };
    assert!(refused(Some(&[0.0; 2]), None).contains("feedforward"));
    assert!(refused(None, Some(&[0.0; 4])).contains("disturbance"));
    assert!(refused(None, Some(&[0.0, f64::NAN, 0.0])).contains("sample 1"));
}

#[test]
fn a_disturbance_acts_behind_the_limits() {
    let model = lag();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let limited = Settings {
        u_min: -0.5,
        u_max: 0.5,
        ..pi(1.0, 0.1)
    };
    let signals = Signals {
        disturbance: Some(&[2.0; 2000]),
        ..Signals::new(&[0.0; 2000])
    };
    let monitor = Monitor::default();
    let mut c = controller(limited, 1);
    let run = closed_loop_with(&mut plant, &mut c, signals, None, &monitor).unwrap();
    assert!(run.u.iter().all(|u| u.abs() <= 0.5));
    assert!((run.y[1999] - 490.0 * 1.5).abs() < 1e-6);
}

#[test]
fn a_feedforward_has_the_bits_of_its_controller_stepped_by_hand() {
    let model = lag();
    let levels = [(-1e3, -2.0), (1e3, 2.1)].map(|(y, u)| Level { y, u });
    let feedforward = Feedforward::new(5, 0.5, &levels, &[0.05, 0.02, -0.01]).unwrap();
    let reference: Vec<f64> = (0..600)
        .map(|k| 200.0 * (f64::from(k) / 30.0).sin() + 300.0)
        .collect();
    let (added, noise) = (vec![0.1; 600], white_noise(2.0, 600, 3));
    let signals = Signals {
        feedforward: Some(&added),
        noise: Some(&noise),
        ..Signals::new(&reference)
    };
    for (r_rate, sensor) in [
        (f64::INFINITY, None),
        (4e3, None),
        (f64::INFINITY, encoder(26.2, 0.5).unwrap()),
        (4e3, encoder(26.2, 0.5).unwrap()),
    ] {
        let design = Design {
            filter_samples: 4,
            r_rate,
            feedforward,
            ..Design::new(pi(2e-3, 0.05))
        };
        let mut controller: AnyController<f64> = PidController::new(design).unwrap().into();
        let mut plant = LaggedPlant::new(&model, TS).unwrap();
        let (sensor, monitor) = (sensor.as_ref(), Monitor::default());
        let run = closed_loop_with(&mut plant, &mut controller, signals, sensor, &monitor);
        let run = run.unwrap();
        plant.reset();
        let mut before = counts(&plant, sensor, -TS);
        for k in 0..600 {
            let now = counts(&plant, sensor, 0.0);
            let measured = match (before, now) {
                (Some(before), Some(now)) => (now - before) / (TS * 26.2),
                _ => plant.output(),
            };
            before = now;
            let ahead = reference[(k + 5).min(599)];
            let u = controller.step_with(ahead, measured + noise[k], 0.1);
            assert_eq!(run.u[k].to_bits(), u.to_bits(), "{k}");
            plant.advance(u);
        }
    }
}

#[test]
fn noise_is_measured_and_no_part_of_the_output() {
    let model = lag();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let noise = white_noise(3.0, 2000, 1);
    let signals = Signals {
        noise: Some(&noise),
        ..Signals::new(&[100.0; 2000])
    };
    let monitor = Monitor::default();
    let mut c = controller(pi(1e-3, 0.1), 1);
    let run = closed_loop_with(&mut plant, &mut c, signals, None, &monitor).unwrap();
    for (k, added) in noise.iter().enumerate() {
        assert_eq!(run.feedback[k], run.y[k] + added);
    }
    // the loop answers to it
    let calm = closed_loop(&mut plant, &mut c, signals.reference, None, &monitor).unwrap();
    assert_ne!(run.u, calm.u);
}

#[test]
fn noise_is_white_of_its_deviation_and_of_its_seed() {
    let noise = white_noise(2.0, 100_000, 7);
    let mean_product = |lag: usize| {
        let pairs = noise[lag..].iter().zip(&noise);
        pairs.map(|(a, b)| a * b).sum::<f64>() / (noise.len() - lag) as f64
    };
    assert!((mean_product(0) - 4.0).abs() < 0.06);
    // four standard errors of a correlation that is zero
    assert!((1..20).all(|lag| mean_product(lag).abs() < 0.05));
    assert_eq!(noise[..50], white_noise(2.0, 50, 7)[..]);
    assert_ne!(noise[..50], white_noise(2.0, 50, 8)[..]);
}
