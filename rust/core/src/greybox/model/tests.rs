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
        free: vec![0, 2, 3, 4, 5, 6, 7, 8, 9],
        sample_time: 0.002,
        steps: 2,
        mean: true,
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
        let run = model.simulate(&padded, 1, &[0.0; STATES]).unwrap();
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
