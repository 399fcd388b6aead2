use super::super::{LIMIT, SAG, UNEVEN};
use super::*;
use crate::random::Random;

fn frame(delay: f64) -> Frame {
    let mut values = [0.0; PARAMETERS.len()];
    values[..10].copy_from_slice(&[0.02, 1e-3, 0.004, 0.006, 0.06, 0.2, 0.25, 0.05, 0.1, 9.0]);
    values[DELAY] = delay;
    values[17] = f64::INFINITY;
    Frame {
        values,
        joint: [0.0; JOINT.len()],
        free: vec![0, 2, 3, 4, 5, 6, 7, 8, 9],
        sample_time: 0.002,
        steps: 2,
        mean: true,
        position: false,
        unit: std::f64::consts::TAU / 60.0,
        speed_scale: 150.0,
        command_scale: 3.0,
        residual_variance: 4.0,
        process_noise: 1e-5,
    }
}

fn made(units: usize, delay: f64) -> GreyBox {
    let (frame, mut random) = (frame(delay), Random::new(5));
    let mut theta: Vec<f64> = frame.free.iter().map(|&j| frame.values[j]).collect();
    theta.extend((0..WEIGHTS * units).map(|i| match i % WEIGHTS {
        3 => 0.1 * random.normal(),
        _ => random.normal(),
    }));
    GreyBox::new(frame, &theta).unwrap()
}

fn commands(n: usize) -> Vec<f64> {
    let mut random = Random::new(3);
    let levels: Vec<f64> = (0..n / 31 + 1).map(|_| random.between(-8.0, 8.0)).collect();
    (0..n).map(|k| levels[k / 31]).collect()
}

/// Compares with differences, until a sample passes a kink between them.
#[test]
fn derivatives_are_those_of_the_values() {
    for units in [0, 3, 6] {
        let (model, u, state) = (made(units, 0.003), commands(60), [0.3, 0.2, 0.4]);
        let (run, rows) = model.jacobian(&u, 1, &state).unwrap();
        assert_eq!(run, model.simulate(&u, 1, &state).unwrap());
        let (theta, columns) = (Model::theta(&model), model.columns());
        let moved = |j: usize, by: f64| {
            let (mut theta, mut state) = (theta.clone(), state);
            match j.checked_sub(theta.len()) {
                None => theta[j] += by,
                Some(i) => state[i] += by,
            }
            let other = GreyBox::new(model.frame.clone(), &theta).unwrap();
            other.simulate(&u, 1, &state).unwrap()
        };
        for j in 0..columns {
            let h = 1e-6 * theta.get(j).map_or(1.0, |v| v.abs().max(1e-3));
            let (more, less) = (moved(j, h), moved(j, -h));
            let scale = (0..60)
                .map(|k| rows[k * columns + j].abs())
                .fold(1e-9, f64::max);
            let off = (0..60)
                .filter(|&k| {
                    let difference = (more[k] - less[k]) / (2.0 * h);
                    (difference - rows[k * columns + j]).abs() > 1e-3 * scale
                })
                .count();
            assert!(off <= 3, "{units} units, column {j}: {off} samples");
        }
    }
}

#[test]
fn a_loop_steps_it_as_the_free_run_goes() {
    let full = |delay: f64| {
        let mut model = made(2, delay);
        (model.frame.values[LIMIT], model.frame.values[UNEVEN]) = (4.0, 0.05);
        model.frame.values[SAG] = 1e-3;
        model
    };
    let delays = [0.0, 0.001, 0.005];
    for (delay, model) in delays.map(|d| [(d, made(2, d)), (d, full(d))]).concat() {
        let u = commands(300);
        let mut plant = model.plant(0.002).unwrap();
        // from rest, where a zero command before the first sample keeps it
        let padded: Vec<f64> = std::iter::repeat_n(0.0, 8).chain(u.clone()).collect();
        let run = model.simulate(&padded, 1, &model.rest_state()).unwrap();
        for (k, u) in u.iter().enumerate() {
            plant.advance(*u);
            if let Some(free) = run.get(k + 9) {
                assert_eq!(plant.output().to_bits(), free.to_bits(), "{delay} {k}");
            }
        }
        plant.reset();
        assert_eq!((plant.output(), plant.position()), (0.0, 0.0));
    }
    assert!(made(0, 0.0).plant(0.001).is_err());
}

#[test]
fn small_signals_are_the_derivatives_of_a_step() {
    let (model, state) = (made(3, 0.0007), [0.8, 0.3, 0.9]);
    let found = model.linearise(&[2.5], &state).unwrap();
    let step = |u: f64, state: [f64; 3]| {
        let states = model.states(&[u, u], 1, &state).unwrap();
        (
            states[3..].to_vec(),
            model.simulate(&[u], 1, &state).unwrap()[0],
        )
    };
    for i in 0..4 {
        let moved = |h: f64| match i {
            3 => step(2.5 + h, state),
            _ => {
                let mut other = state;
                other[i] += h;
                step(2.5, other)
            }
        };
        let ((more, y_more), (less, y_less)) = (moved(1e-6), moved(-1e-6));
        for q in 0..3 {
            let known = if i == 3 {
                found.b[q]
            } else {
                found.a[3 * q + i]
            };
            assert!(((more[q] - less[q]) / 2e-6 - known).abs() < 1e-6, "{q} {i}");
        }
        let known = if i == 3 { found.d[0] } else { found.c[i] };
        assert!(
            ((y_more - y_less) / 2e-6 - known).abs() < 1e-4 * (1.0 + known.abs()),
            "{i}"
        );
    }
}

/// A joint under gravity with a controller inside, behind gears that rub more under load.
fn joint(inside: bool, units: usize) -> GreyBox {
    let mut frame = frame(0.0033);
    (frame.position, frame.unit, frame.speed_scale) = (true, 0.5, 3.0);
    frame.values[..3].copy_from_slice(&[0.4, 0.0, 0.05]);
    (frame.values[10], frame.values[11]) = (0.3, -0.4);
    frame.joint = [
        0.05, 2.0, 0.02, 0.05, 1.5, 0.03, 0.02, 1e-3, 1.4, 0.01, 2e-3, 3.0, 0.02, 0.3, 0.4, 0.1,
        -0.05, 5.0,
    ];
    frame.free = vec![0, 2, 6, 7, 8, 9, 10, 11, DELAY];
    frame.free.extend(OF_JOINT..OF_JOINT + JOINT.len());
    if !inside {
        frame.joint[K_Q..K_M].fill(0.0);
        frame.joint[RATE] = 0.0;
        let inner = [
            OF_JOINT + K_Q..OF_JOINT + K_M,
            OF_JOINT + RATE..OF_JOINT + RATE + 1,
        ];
        frame
            .free
            .retain(|j| !inner.iter().any(|places| places.contains(j)));
    }
    let mut random = Random::new(7);
    let all: Vec<f64> = frame.values.iter().chain(&frame.joint).copied().collect();
    let mut theta: Vec<f64> = frame.free.iter().map(|&j| all[j]).collect();
    theta.extend((0..WEIGHTS * units).map(|_| 0.3 * random.normal()));
    GreyBox::new(frame, &theta).unwrap()
}

#[test]
fn the_derivatives_of_a_joint_are_those_of_its_values() {
    for (inside, units) in [(false, 0), (true, 0), (true, 3)] {
        let model = joint(inside, units);
        let u: Vec<f64> = commands(60).iter().map(|u| 0.5 * u).collect();
        let state = [0.3, 0.2, 0.4, 0.7, 0.4, 0.7, 0.3];
        let (run, rows) = model.jacobian(&u, 1, &state).unwrap();
        assert_eq!(run, model.simulate(&u, 1, &state).unwrap());
        let (theta, columns) = (Model::theta(&model), model.columns());
        for j in 0..columns {
            let moved = |by: f64| {
                let (mut theta, mut state) = (theta.clone(), state);
                match j.checked_sub(theta.len()) {
                    None => theta[j] += by,
                    Some(i) => state[i] += by,
                }
                let other = GreyBox::new(model.frame.clone(), &theta).unwrap();
                other.simulate(&u, 1, &state).unwrap()
            };
            let h = 1e-6 * theta.get(j).map_or(1.0, |v| v.abs().max(1e-3));
            let (more, less) = (moved(h), moved(-h));
            let column = |k: usize| rows[k * columns + j];
            let scale = (0..60).map(|k| column(k).abs()).fold(1e-9, f64::max);
            let differs =
                |k: &usize| ((more[*k] - less[*k]) / (2.0 * h) - column(*k)).abs() > 2e-3 * scale;
            let off = (0..60).filter(differs).count();
            assert!(
                off <= 6,
                "inside {inside}, {units} units, column {j}: {off} samples"
            );
        }
    }
}

/// At rest under a held command the error is what gravity and friction take: the unit is the loop gain.
#[test]
fn a_controller_without_an_integral_sags() {
    let mut model = joint(true, 0);
    model.frame.free.clear();
    model.frame.values[4] = 0.0;
    model.frame.values[6..12].copy_from_slice(&[0.0, 0.0, 0.0, 1.0, 0.25, 0.0]);
    model.frame.joint = [0.0; JOINT.len()];
    model.frame.joint[K_Q..=DAMPING].copy_from_slice(&[2.0, 0.05]);
    let run = model.simulate(&[0.8; 4000], 1, &[0.0; 4]).unwrap();
    let q = model.frame.unit * run[3999];
    assert!((0.8 - 2.0 * q - 0.25 * q.cos()).abs() < 1e-6, "{q}");
    // dry friction of half the pull holds it wherever it is put
    model.frame.values[6] = 0.5;
    let held = model
        .simulate(&[0.6; 300], 1, &[0.0, 0.0, 0.0, 0.5])
        .unwrap();
    assert!(held.iter().all(|y| (y - 0.5).abs() < 1e-3));
}

#[test]
fn the_state_of_a_joint_is_found_from_its_first_outputs() {
    for (inside, play) in [(false, false), (true, false), (false, true), (true, true)] {
        let mut model = joint(inside, 0);
        if !play {
            model.frame.joint[PLAY] = 0.0;
            let of_play = [PLAY, LOAD_SHARE, RUB_SHARE].map(|j| OF_JOINT + j);
            model.frame.free.retain(|j| !of_play.contains(j));
        }
        let u: Vec<f64> = commands(40).iter().map(|u| 0.5 * u).collect();
        let all = [1.2, 0.2, u[0] / 3.0, -0.8, u[0] / 3.0, -0.8, 1.2];
        let true_ = &all[..model.order()];
        let y = model.simulate(&u, 1, true_).unwrap();
        let state = model.estimate_state(&u, 1, &y).unwrap();
        let run = model.simulate(&u, 1, &state).unwrap();
        let apart = |run: &[f64]| {
            let pairs = run.iter().zip(&y);
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        // where the motor begins within the play its load hardly says
        let half = 0.5 * model.frame.joint[PLAY] / model.frame.unit;
        let off = apart(&run);
        assert!(off < half.max(2e-3), "{inside} {play}: {off}");
        let off = apart(&model.predict(&u, 1, &y, &state, 1).unwrap());
        assert!(off < half.max(5e-3), "{inside} {play}: {off}");
    }
}

#[test]
fn a_loop_steps_a_joint_as_its_free_run_goes() {
    for inside in [false, true] {
        let model = joint(inside, 2);
        let u = commands(300);
        let mut plant = model.plant(0.002).unwrap();
        let padded: Vec<f64> = std::iter::repeat_n(0.0, 1).chain(u.clone()).collect();
        // gravity moves it while the free run's first commands are due
        (0..2).for_each(|_| plant.advance(0.0));
        let run = model.simulate(&padded, 1, &model.rest_state()).unwrap();
        for (k, u) in u.iter().enumerate() {
            plant.advance(*u);
            if let Some(free) = run.get(k + 2) {
                assert_eq!(plant.output().to_bits(), free.to_bits(), "{inside} {k}");
            }
        }
    }
}

#[test]
fn what_is_no_joint_is_refused() {
    let model = joint(true, 0);
    let refused = |change: &dyn Fn(&mut Frame)| {
        let mut frame = model.frame.clone();
        change(&mut frame);
        let theta = Model::theta(&model);
        GreyBox::new(frame, &theta).unwrap_err().message
    };
    assert!(refused(&|f| f.position = false).contains("load_1"));
    assert!(refused(&|f| f.values[12] = 0.1).contains("load_2"));
    let beyond = PARAMETERS.len() + JOINT.len();
    assert!(refused(&|f| f.free[13] = beyond).contains(&beyond.to_string()));
    let mut frame = model.frame.clone();
    (frame.free, frame.joint[REACH]) = (vec![], -1.0);
    assert!(
        GreyBox::new(frame, &[])
            .unwrap_err()
            .message
            .contains("reach")
    );
    assert!(joint(false, 0).integrates() && !model.integrates());
}

#[test]
fn what_is_no_model_is_refused() {
    let (model, u) = (made(1, 0.0), commands(10));
    let refused = |change: &dyn Fn(&mut Frame), theta: &[f64]| {
        let mut frame = model.frame.clone();
        change(&mut frame);
        GreyBox::new(frame, theta).unwrap_err().message
    };
    let theta = Model::theta(&model);
    assert!(refused(&|f| f.unit = 0.0, &theta).contains("unit"));
    assert!(refused(&|f| f.values[10] = 0.1, &theta).contains("load_1"));
    assert!(refused(&|f| f.process_noise = -1.0, &theta).contains("process noise"));
    assert!(refused(&|f| f.free[0] = 16, &theta).contains("delay"));
    assert!(refused(&|_| (), &theta[1..]).contains("units in theta"));
    assert!(model.simulate(&u, 2, &[0.0; 3]).is_err());
    assert!(model.simulate(&u, 1, &[0.0; 2]).is_err());
    assert!(model.predict(&u, 1, &u[1..], &[0.0; 3], 1).is_err());
    assert!(model.predict(&u, 1, &u, &[0.0; 3], 0).is_err());
    assert!(model.estimate_state(&u, 1, &[f64::NAN; 10]).is_err());
    assert!(model.linearise(&[], &[0.0; 3]).is_err());
    assert!(model.embedded(false).is_err());
    assert!(model.simulate(&[], 1, &[0.0; 3]).unwrap().is_empty());
}
