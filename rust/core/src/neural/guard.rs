//! A guard against networks that fit their data and run away, or stick to a false equilibrium, on other data.

use super::network::Network;
use super::problem::Experiment;
use crate::lagged::{Lagged, push_past};

/// How far outside the training output's range a run is started, in widths of that range.
const BESIDE: f64 = 0.25;
/// Largest distance, in widths of that range, that may be left at the end between runs from different states.
const FORGOTTEN: f64 = 0.2;
/// Factor by which inputs are enlarged about their means.
const ENLARGED: f64 = 1.25;
/// How far outside the training output's range enlarged inputs may drive the run, in widths of that range.
const ROOM: f64 = 1.0;

/// True where the free run forgets its initial state and answers somewhat larger inputs with outputs of like size.
pub(super) fn is_sound(network: &Network, experiments: &[Experiment]) -> bool {
    let outputs = experiments.iter().flat_map(|e| &e.y);
    let range = |(low, high): (f64, f64), &y: &f64| (low.min(y), high.max(y));
    let (low, high) = outputs.fold((f64::INFINITY, f64::NEG_INFINITY), range);
    let width = high - low;
    let sides = [low - BESIDE * width, high + BESIDE * width];
    experiments.iter().all(|experiment| {
        let usual = run(network, &experiment.u, experiment.first, &experiment.state);
        let beside = |side: f64| {
            let state = vec![side; experiment.state.len()];
            run(network, &experiment.u, experiment.first, &state)
        };
        let forgets = sides
            .iter()
            .all(|&side| final_gap(&usual, &beside(side)) < FORGOTTEN * width);
        let enlarged = enlarged(&experiment.u, network.lags().channels);
        let inside = |y: &f64| (low - ROOM * width..=high + ROOM * width).contains(y);
        forgets
            && run(network, &enlarged, experiment.first, &experiment.state)
                .iter()
                .all(inside)
    })
}

fn run(network: &Network, u: &[f64], first: usize, state: &[f64]) -> Vec<f64> {
    let lags = network.lags();
    let mut phi = vec![0.0; lags.regressors()];
    phi[..lags.na].copy_from_slice(state);
    let next = |k: usize| {
        lags.write_inputs(u, k, &mut phi[lags.na..]);
        let y = network.output(&phi);
        push_past(&mut phi[..lags.na], y);
        y
    };
    (first..u.len() / lags.channels).map(next).collect()
}

/// Mean distance over the last tenth; NaN, which is below no bound, where a run has left the finite numbers.
fn final_gap(a: &[f64], b: &[f64]) -> f64 {
    let last = a.len().div_ceil(10);
    let pairs = a.iter().zip(b).rev().take(last);
    pairs.map(|(a, b)| (a - b).abs()).sum::<f64>() / last as f64
}

fn enlarged(u: &[f64], channels: usize) -> Vec<f64> {
    let samples = (u.len() / channels) as f64;
    let mean = |j: usize| u.iter().skip(j).step_by(channels).sum::<f64>() / samples;
    let means: Vec<f64> = (0..channels).map(mean).collect();
    let enlarge = |(i, u): (usize, &f64)| {
        let mean = means[i % channels];
        mean + ENLARGED * (u - mean)
    };
    u.iter().enumerate().map(enlarge).collect()
}

#[cfg(test)]
mod tests {
    use super::super::network::Shape;
    use super::*;
    use crate::lagged::Lags;

    fn verdict(pole: f64, hidden: f64) -> bool {
        let shape = Shape::new(Lags::new(1, 1, 1, 1).unwrap(), 1, true).unwrap();
        let mut network = Network::zero(shape, (f64::NEG_INFINITY, f64::INFINITY));
        network.load(&[4.0, 0.0, 0.0, hidden, 0.0, pole, 0.1]);
        let u: Vec<f64> = (0..300).map(|k| (k as f64 * 0.05).sin()).collect();
        let y = run(&network, &u, 0, &[0.0]);
        let y = y.iter().map(|y| y.clamp(-1.0, 1.0)).collect();
        is_sound(
            &network,
            &[Experiment {
                u,
                y,
                first: 0,
                state: vec![0.0],
            }],
        )
    }

    #[test]
    fn passes_a_stable_model_and_no_other() {
        assert!(verdict(0.9, 0.0));
        assert!(!verdict(1.02, 0.0), "an unstable bypass runs away");
        assert!(
            !verdict(0.7, 1.0),
            "two equilibria, of which the start decides"
        );
    }
}
