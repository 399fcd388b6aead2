//! The runs by which a network is guarded: from past outputs beside the data's, and over larger inputs.

use super::free_run;
use super::network::Network;
use super::problem::Experiment;
use crate::guard::{Guard, enlarged};
use crate::lagged::Lagged;

/// True where the free run forgets its initial state and answers somewhat larger inputs with outputs of like size.
pub(super) fn is_sound(network: &Network, experiments: &[Experiment]) -> bool {
    let guard = Guard::of(experiments.iter().flat_map(|e| &e.y));
    experiments.iter().all(|experiment| {
        let usual = run(network, &experiment.u, experiment.first, &experiment.state);
        let beside = |side: f64| {
            let state = vec![side; experiment.state.len()];
            run(network, &experiment.u, experiment.first, &state)
        };
        let enlarged = enlarged(&experiment.u, network.lags().channels);
        guard
            .sides()
            .iter()
            .all(|&side| guard.meet(&usual, &beside(side)))
            && guard.holds(&run(
                network,
                &enlarged,
                experiment.first,
                &experiment.state,
            ))
    })
}

/// The free run; NaN from where on it leaves the finite numbers.
fn run(network: &Network, u: &[f64], first: usize, state: &[f64]) -> Vec<f64> {
    let samples = u.len() / network.lags().channels;
    free_run::outputs(network, u, first, state, samples - first)
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
