//! The runs by which a model is guarded: from states beside the training's, over larger inputs and in another order.

use super::free_run::{self, Trajectory};
use super::network::{Network, Scratch};
use super::problem::Experiment;
use super::shape::Shape;
use super::state::Statistics;
use crate::Monitor;
use crate::guard::{Guard, enlarged, rearranged};

/// Where a run that is to forget its state is started, in standard deviations of the training states.
const BESIDE: f64 = 3.0;

/// True where the free run answers somewhat larger inputs with outputs of like size and, unless a state is integrated,
/// forgets its initial state and stays near the training outputs when its inputs come in another order.
pub(super) fn is_sound(
    network: &Network,
    experiments: &[Experiment],
    runs: &[Trajectory],
    states: &[Vec<f64>],
    statistics: &Statistics,
) -> bool {
    let Shape {
        nx,
        inputs,
        outputs,
        integrator,
        ..
    } = network.shape;
    let measured = |p: usize| {
        experiments
            .iter()
            .flat_map(move |e| e.y.iter().skip(p).step_by(outputs))
    };
    let guards: Vec<Guard> = (0..outputs).map(|p| Guard::of(measured(p))).collect();
    let beside = |sign: f64| -> Vec<f64> {
        let deviation = |i: usize| statistics.state_covariance[i * (nx + 1)].sqrt();
        (0..nx)
            .map(|i| statistics.state_mean[i] + sign * BESIDE * deviation(i))
            .collect()
    };
    experiments
        .iter()
        .zip(runs)
        .zip(states)
        .all(|((experiment, usual), state)| {
            let of = |p: usize, run: &Trajectory| -> Vec<f64> {
                let sums = run.sums.iter().skip(p).step_by(outputs);
                sums.map(|s| network.output.value(*s)).collect()
            };
            let forgets = |sign: f64| {
                run(network, &experiment.v, &beside(sign)).is_some_and(|other| {
                    (0..outputs).all(|p| guards[p].meet(&of(p, usual), &of(p, &other)))
                })
            };
            let stays = || {
                rearranged(&experiment.v, inputs).iter().all(|v| {
                    run(network, v, state).is_some_and(|other| {
                        (0..outputs).all(|p| guards[p].holds_at_home(&of(p, &other)))
                    })
                })
            };
            let larger = run(network, &enlarged(&experiment.v, inputs), state);
            larger.is_some_and(|larger| (0..outputs).all(|p| guards[p].holds(&of(p, &larger))))
                && (integrator || (forgets(1.0) && forgets(-1.0) && stays()))
        })
}

fn run(network: &Network, v: &[f64], state: &[f64]) -> Option<Trajectory> {
    let mut run = Trajectory::new(network, v.len() / network.shape.inputs);
    let mut scratch = Scratch::new(network.shape);
    let monitor = Monitor::default();
    let found = free_run::alone(network, v, state, &mut run, &mut scratch, &monitor);
    found.then_some(run)
}
