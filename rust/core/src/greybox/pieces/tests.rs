use super::super::{Frame, JOINT, PARAMETERS};
use super::*;
use crate::random::Random;

const TS: f64 = 0.01;
/// Places of `k_e`, `k_a`, `k_s`, `offset`, `delay` and `creep`.
const FREE: [usize; 6] = [0, 2, 6, 7, 16, PARAMETERS.len() + 7];
const TRUE: [f64; 6] = [0.05, 0.003, 0.02, 0.004, 0.013, 0.002];

/// A joint behind a controller.
fn joint(theta: &[f64; 6]) -> GreyBox {
    let mut values = [0.0; PARAMETERS.len()];
    (values[5], values[9], values[17]) = (1.0, 1.0, f64::INFINITY);
    let mut joint = [0.0; JOINT.len()];
    joint[1] = 1.0;
    let frame = Frame {
        values,
        joint,
        free: FREE.to_vec(),
        sample_time: TS,
        steps: 4,
        mean: false,
        position: true,
        unit: 1.0,
        speed_scale: 2.0,
        command_scale: 0.1,
        residual_variance: 1e-6,
        process_noise: 1e-6,
    };
    GreyBox::new(frame, theta).unwrap()
}

/// Commands and positions of the true joint, at random levels and with noise.
fn recorded(noise: f64, seed: u64) -> (Vec<f64>, Vec<f64>) {
    let mut random = Random::new(seed);
    let levels: Vec<f64> = (0..21).map(|_| 1.6 * random.uniform() - 0.8).collect();
    // a piece does not know the commands before it: none changes where one begins
    let u: Vec<f64> = (0..1200).map(|k| levels[(k + 30) / 60]).collect();
    let model = joint(&TRUE);
    let mut y = model.simulate(&u, 1, &[0.0, 0.0, 0.0, u[0]]).unwrap();
    y.iter_mut().for_each(|y| *y += noise * random.normal());
    (u, y)
}

fn pieces<'a>(u: &'a [f64], y: &'a [f64], count: usize) -> Pieces<'a> {
    let length = u.len() / count;
    let cut = u.chunks_exact(length).zip(y.chunks_exact(length));
    let cut: Vec<_> = cut.map(|(u, y)| Samples::new(u, 1, y).unwrap()).collect();
    Pieces::new(&cut).unwrap()
}

fn fit<'a>(prior: &'a [f64], low: &'a [f64]) -> Fit<'a> {
    Fit {
        prior,
        low,
        high: &[f64::INFINITY; 6],
        enough: 1e-3,
        iterations: 40,
    }
}

const NONE: [f64; 6] = [0.0; 6];

#[test]
fn a_joint_is_found_from_pieces_within_its_intervals() {
    let mut inside = 0;
    for seed in 0..4 {
        let (u, y) = recorded(5e-4, seed);
        let pieces = pieces(&u, &y, 4);
        let begun = joint(&[0.08, 0.004, 0.01, 0.0, 0.008, 0.0]);
        let none = Monitor::default();
        let found = pieces.descend(&begun, &fit(&NONE, &NONE), &none).unwrap();
        let again = pieces.squares(&found.model, &found.states);
        assert!((again - found.cost).abs() < 1e-12 * found.cost);
        assert!(
            (found.cost / (1200.0 * 2.5e-7) - 1.0).abs() < 0.1,
            "{}",
            found.cost
        );
        let (covariance, determined) = pieces.covariance(&found.model, &found.states).unwrap();
        assert_eq!(determined, [true; 6]);
        for (j, (value, true_)) in found.model.theta().iter().zip(TRUE).enumerate() {
            let spread = covariance[7 * j].sqrt();
            assert!(
                (value - true_).abs() < 0.1 * true_ + 4.0 * spread,
                "{j}: {value} for {true_}"
            );
            inside += usize::from((value - true_).abs() < 1.96 * spread);
        }
        let n = pieces.independent(&found.model, &found.states).unwrap();
        assert!(n > 700.0, "{n}");
    }
    assert!(inside >= 19, "{inside} of 24");
}

#[test]
fn a_prior_holds_and_a_bound_is_kept() {
    let (u, y) = recorded(5e-4, 9);
    let (pieces, none) = (pieces(&u, &y, 3), Monitor::default());
    let mut prior = NONE;
    prior[2] = 1e6;
    let found = pieces
        .descend(&joint(&TRUE), &fit(&prior, &NONE), &none)
        .unwrap();
    assert!(found.model.theta()[2].abs() < 1e-4);
    let mut low = NONE;
    low[0] = 0.06;
    let mut begun = TRUE;
    begun[0] = 0.07;
    let found = pieces
        .descend(&joint(&begun), &fit(&NONE, &low), &none)
        .unwrap();
    assert!((found.model.theta()[0] - 0.06).abs() < 1e-12);
}

/// A start at rest has no derivative by the speed, as friction holds it, and the descent would stay there.
#[test]
fn a_piece_may_begin_just_before_a_stop() {
    let (u, y) = recorded(0.0, 3);
    let model = joint(&TRUE);
    for at in (60..1100).step_by(7) {
        let mut own = y[at - 10..at + 50].to_vec();
        own[..10].fill(f64::NAN);
        let pieces = Pieces::new(&[Samples::new(&u[at - 10..at + 50], 1, &own).unwrap()]).unwrap();
        let left = pieces.squares(&model, &pieces.states(&model).unwrap());
        assert!(left < 50.0 * 1e-3_f64.powi(2), "{at}: {left}");
    }
}

/// A gap counts as nothing, whatever stands there.
#[test]
fn samples_without_weight_do_not_count() {
    let (u, y) = recorded(0.0, 3);
    let (mut gap, mut weighted) = (y.clone(), y.clone());
    let mut weights = vec![1.0; y.len()];
    for k in 100..130 {
        (gap[k], weighted[k], weights[k]) = (f64::NAN, 99.0, 0.0);
    }
    let model = joint(&[0.06, 0.003, 0.02, 0.0, 0.013, 0.001]);
    let state = vec![vec![0.0, 0.0, 0.0, u[0]]];
    let of = |samples: Samples<'_>| Pieces::new(&[samples]).unwrap().squares(&model, &state);
    let plain = of(Samples::new(&u, 1, &gap).unwrap());
    let other = Samples::new(&u, 1, &weighted)
        .unwrap()
        .with_weights(&weights)
        .unwrap();
    assert!(plain > 0.0 && plain == of(other));
}

#[test]
fn what_does_not_fit_is_refused() {
    let (u, y) = recorded(0.0, 3);
    assert!(Pieces::new(&[Samples::new(&u, 2, &y[..600]).unwrap()]).is_err());
    let (pieces, none) = (pieces(&u, &y, 2), Monitor::default());
    let refused = pieces
        .descend(&joint(&TRUE), &fit(&[0.0; 2], &NONE), &none)
        .unwrap_err();
    assert!(refused.message.contains("6 parameters"));
    none.request_stop();
    let stopped = pieces
        .descend(&joint(&TRUE), &fit(&NONE, &NONE), &none)
        .unwrap_err();
    assert!(stopped.message.contains("stop"));
}
