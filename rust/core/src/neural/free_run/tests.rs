use super::*;
use crate::lagged::{Lagged, Lags};
use crate::neural::network::Shape;
use crate::random::Random;

const SAMPLES: usize = 333;
const LIMITS: (f64, f64) = (-0.4, 0.4);

fn shape(na: usize, hidden: usize, bypass: bool) -> Shape {
    Shape::new(Lags::new(na, 2, 1, 2).unwrap(), hidden, bypass).unwrap()
}

fn network(shape: Shape, random: &mut Random) -> Network {
    let mut network = Network::zero(shape, LIMITS);
    let theta: Vec<f64> = (0..shape.parameters())
        .map(|_| random.between(-0.3, 0.3))
        .collect();
    network.load(&theta);
    network
}

/// The sums of squares, outputs and hidden outputs of runs side by side.
fn side_by_side<const RUNS: usize>(
    networks: [&Network; RUNS],
    state: &[f64],
    u: &[f64],
    y: &[f64],
    limit: f64,
) -> [(Option<f64>, Vec<f64>, Vec<Lanes>); RUNS] {
    let groups = networks[0].shape.groups();
    let mut kept = networks.map(|_| (vec![0.0; SAMPLES], vec![Lanes::ZERO; SAMPLES * groups]));
    let mut left = networks.into_iter();
    let limit = Limit {
        limit,
        samples: SAMPLES as f64,
        ..Limit::NONE
    };
    let sums = FreeRuns {
        weights: &[],
        runs: kept.each_mut().map(|(outputs, hidden)| Run {
            network: left.next().unwrap(),
            state,
            outputs,
            hidden,
            limit: Some(limit),
        }),
        u,
        first: 0,
        y,
        bound: 1e4,
        monitor: None,
    }
    .go();
    let mut sums = sums.into_iter();
    kept.map(|(outputs, hidden)| (sums.next().unwrap(), outputs, hidden))
}

#[test]
fn runs_alone_and_side_by_side_are_the_same_bits_and_those_of_steps_but_for_rounding() {
    let (mut random, mut clipped) = (Random::new(9), 0);
    let shapes = [
        (1, 3, true),
        (2, 8, false),
        (2, 8, true),
        (3, 8, true),
        (5, 7, true),
        (2, 17, true),
    ];
    for (na, hidden, bypass) in shapes {
        let shape = shape(na, hidden, bypass);
        let networks = [network(shape, &mut random), network(shape, &mut random)];
        let u: Vec<f64> = (0..2 * SAMPLES).map(|_| random.normal()).collect();
        let unmeasured = |k: usize| if k % 7 == 3 { f64::NAN } else { 0.0 };
        let y: Vec<f64> = (0..SAMPLES)
            .map(|k| unmeasured(k) + random.normal())
            .collect();
        let state: Vec<f64> = (0..na).map(|_| random.normal()).collect();
        let limit = f64::INFINITY;
        let both = side_by_side([&networks[0], &networks[1]], &state, &u, &y, limit);
        for (network, together) in networks.iter().zip(&both) {
            let [alone] = side_by_side([network], &state, &u, &y, limit);
            assert_eq!(&alone, together);
            let mut phi = [&state[..], &[0.0; 4]].concat();
            for (k, output) in alone.1.iter().enumerate() {
                shape.lags.write_inputs(&u, k, &mut phi[na..]);
                let step = network.output(&phi);
                // a run adds the hidden units in another order
                assert!((step - output).abs() < 1e-13, "{na} {hidden} {k}");
                phi.copy_within(..na - 1, 1);
                phi[0] = *output;
            }
            let limit = |y: &&f64| **y == LIMITS.0 || **y == LIMITS.1;
            clipped += alone.1.iter().filter(limit).count();
            assert!(alone.1.iter().all(|y| (LIMITS.0..=LIMITS.1).contains(y)));
            let errors = y.iter().zip(&alone.1).map(|(y, run)| y - run);
            let sum: f64 = errors.filter(|e| !e.is_nan()).map(|e| e * e).sum();
            assert!((alone.0.unwrap() - sum).abs() < 1e-9 * sum);
            let less = 0.25 * sum / SAMPLES as f64;
            let [stopped] = side_by_side([network], &state, &u, &y, less);
            assert_eq!(stopped.0, None);
        }
    }
    assert!(clipped > 0);
}
