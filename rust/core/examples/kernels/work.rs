//! The kernels: fixed problems, each prepared once and then called as often as needed.

use std::hint::black_box;

use sewfast_control::{AnyController, AnyDesign, Design, PidController, Settings, Standard};
use sewfast_core::closed_loop::{LaggedPlant, Run, encoder};
use sewfast_core::lagged::{Lagged, Lags};
use sewfast_core::linear::LinearModel;
use sewfast_core::machine::{Machine, Parameters};
use sewfast_core::neural::{self, InitialState, NeuralOE, Scaling, Shape};
use sewfast_core::neural_ss::{self, OutputFunction};
use sewfast_core::random::Random;
use sewfast_core::tune::{self, Aggregate, Constraints, Cost, Parameter, Task, Variable};
use sewfast_core::{Monitor, Record, arx};

/// A call that can be repeated.
pub type Call = Box<dyn FnMut()>;

/// A kernel with its name.
pub struct Kernel {
    /// Its name.
    pub name: &'static str,
    /// Samples, or steps of a candidate, per call.
    pub samples: usize,
    /// Creates everything that the call needs.
    pub prepare: fn() -> Call,
}

const TS: f64 = 1e-3;
const RUN: usize = 20_000;
const TRAINED: usize = 1_000;
const STATES_TRAINED: usize = 250;
const REGRESSED: usize = 50_000;
const LOOP: usize = 4_000;
const SHORT_LOOP: usize = 500;
const CANDIDATES: usize = 64;

/// Every kernel. A training of 8 iterations and one of 4 differ by exactly 4 iterations: both have learnt, so neither
/// starts over.
pub const KERNELS: &[Kernel] = &[
    kernel("free_run", RUN, free_run),
    kernel("training_4", TRAINED, || training(4)),
    kernel("training_8", TRAINED, || training(8)),
    kernel("state_space_run", STATES_TRAINED, state_space_run),
    kernel("state_space_training_4", STATES_TRAINED, || {
        state_space_training(4)
    }),
    kernel("state_space_training_8", STATES_TRAINED, || {
        state_space_training(8)
    }),
    kernel("arx", REGRESSED, regression),
    kernel("closed_loop", LOOP, || closed_loop(false)),
    kernel("closed_loop_encoded", LOOP, || closed_loop(true)),
    kernel("candidates", CANDIDATES * SHORT_LOOP, || candidates(false)),
    kernel("candidates_encoded", CANDIDATES * SHORT_LOOP, || {
        candidates(true)
    }),
    kernel("machine", RUN, machine),
];

const fn kernel(name: &'static str, samples: usize, prepare: fn() -> Call) -> Kernel {
    Kernel {
        name,
        samples,
        prepare,
    }
}

/// A command from 0 to .6 with rising frequency.
fn chirp(samples: usize) -> Vec<f64> {
    let phase = |k: usize| 1e-3 * k as f64 * (1.0 + 2e-4 * k as f64);
    (0..samples).map(|k| 0.3 * (1.0 - phase(k).cos())).collect()
}

/// A saturating second-order drive driven by the chirp, with a little noise.
fn drive(samples: usize) -> (Vec<f64>, Vec<f64>) {
    let (u, mut y) = (chirp(samples), vec![0.0; samples]);
    for k in 2..samples {
        let driven = 0.06 * (2.5 * u[k - 1]).tanh();
        y[k] = 1.87 * y[k - 1] - 0.8705 * y[k - 2] + 0.1 * driven;
    }
    let mut random = Random::new(1);
    y.iter_mut().for_each(|y| *y += 1e-3 * random.normal());
    (u, y)
}

fn lags() -> Lags {
    Lags::new(2, 2, 1, 1).expect("orders of one input")
}

fn unscaled() -> Scaling {
    Scaling {
        u_mean: vec![0.0],
        u_scale: vec![1.0],
        y_mean: 0.0,
        y_scale: 1.0,
    }
}

/// Eight tanh units around a stable second-order drive.
fn network() -> NeuralOE {
    let shape = Shape::new(lags(), 8, false).expect("a shape");
    let mut random = Random::new(2);
    let mut theta: Vec<f64> = (0..shape.parameters())
        .map(|_| random.between(-0.3, 0.3))
        .collect();
    // the first two units pass the past outputs on
    theta[..8].copy_from_slice(&[0.5, 0.0, 0.1, 0.0, 0.0, 0.5, 0.0, 0.1]);
    theta[40..42].copy_from_slice(&[2.0, -0.5]);
    let limits = (f64::NEG_INFINITY, f64::INFINITY);
    NeuralOE::new(shape, theta, unscaled(), limits).expect("a network")
}

fn free_run() -> Call {
    let (model, u) = (network(), chirp(RUN));
    Box::new(move || {
        black_box(model.simulate(&u, 1, &[0.0, 0.0]).expect("a stable run"));
    })
}

fn training(max_iterations: usize) -> Call {
    let (u, y) = drive(TRAINED);
    let settings = neural::Settings {
        na: 2,
        nb: 2,
        nk: 1,
        hidden: 8,
        linear: None,
        scaling: Some(unscaled()),
        saturate: None,
        initial_state: InitialState::Zero,
        weight_decay: 0.0,
        max_iterations,
        starts: 1,
        initial_theta: None,
        seed: 0,
        threads: 1,
    };
    Box::new(move || {
        let records = [Record::new(&u, 1, &y).expect("a record")];
        black_box(neural::fit(&records, &[], &settings, &Monitor::default()).expect("a fit"));
    })
}

fn state_space_settings(max_iterations: usize, linear: LinearModel) -> neural_ss::Settings {
    neural_ss::Settings {
        nx: 3,
        nk: 1,
        hidden: 15,
        linear: Some(linear),
        initial: Vec::new(),
        output: OutputFunction::Linear,
        integrator: false,
        weight_decay: 1e-6,
        hidden_scale: 1.0,
        guard: false,
        max_iterations,
        starts: 1,
        first_start: 0,
        seed: 0,
        threads: 1,
    }
}

/// The drive followed by a sensor: third order at the output.
fn sensed() -> (Vec<f64>, Vec<f64>) {
    let (u, mut y) = drive(STATES_TRAINED);
    for k in 1..y.len() {
        y[k] = 0.6 * y[k - 1] + 0.4 * y[k];
    }
    (u, y)
}

fn third_order() -> LinearModel {
    let a = vec![-2.47, 1.9925, -0.5223];
    LinearModel::new(a, vec![2e-3, 1e-3, 1e-3], 1, 1, 0.0).expect("a model")
}

fn state_space_training(max_iterations: usize) -> Call {
    let ((u, y), settings) = (
        sensed(),
        state_space_settings(max_iterations, third_order()),
    );
    Box::new(move || {
        let records = [Record::new(&u, 1, &y).expect("a record")];
        black_box(neural_ss::fit(&records, &[], &settings, &Monitor::default()).expect("a fit"));
    })
}

fn state_space_run() -> Call {
    let ((u, y), settings) = (sensed(), state_space_settings(1, third_order()));
    let records = [Record::new(&u, 1, &y).expect("a record")];
    let fit = neural_ss::fit(&records, &[], &settings, &Monitor::default()).expect("a fit");
    Box::new(move || {
        let run = sewfast_core::model::Model::simulate(&fit.model, &u, 1, &[0.0; 3]);
        black_box(run.expect("a stable run"));
    })
}

fn regression() -> Call {
    let (u, y) = drive(REGRESSED);
    Box::new(move || {
        let records = [Record::new(&u, 1, &y).expect("a record")];
        black_box(arx::fit(&records, 2, 2, 1, false).expect("a fit"));
    })
}

/// A controller of the network, one of many; with the filter that an encoder needs.
fn design(candidate: usize, encoded: bool) -> Design<f64> {
    let share = candidate as f64 / CANDIDATES as f64;
    let gains = Standard {
        kp: 0.2 + 0.3 * share,
        ti: 0.2,
        td: 0.002 * share,
    };
    let pid = Settings {
        alpha: 0.3,
        n: 8.0,
        tt: 0.2,
        u_min: 0.0,
        u_max: 1.0,
        ..Settings::new(gains, TS)
    };
    let filter_samples = if encoded { 8 } else { 1 };
    Design {
        filter_samples,
        ..Design::new(pid)
    }
}

fn levels(samples: usize) -> Vec<f64> {
    let level = |k| [0.2, 0.4, 0.1, 0.3][4 * k / samples];
    (0..samples).map(level).collect()
}

/// Counts per unit and second of the loops' encoder; 0 for none.
fn counts(encoded: bool) -> f64 {
    if encoded { 26_200.0 } else { 0.0 }
}

fn closed_loop(encoded: bool) -> Call {
    let model: &'static NeuralOE = Box::leak(Box::new(network()));
    let mut plant = LaggedPlant::new(model, TS).expect("a plant");
    let mut controller =
        AnyController::from(PidController::new(design(8, encoded)).expect("a controller"));
    let encoder = encoder(counts(encoded), 0.5).expect("an encoder");
    let (r, mut run) = (levels(LOOP), Run::with_capacity(LOOP));
    Box::new(move || {
        run.record(
            &mut plant,
            &mut controller,
            &r,
            encoder.as_ref(),
            &Monitor::default(),
        );
        black_box(&run);
    })
}

fn candidates(encoded: bool) -> Call {
    let model: &'static NeuralOE = Box::leak(Box::new(network()));
    let plants = [LaggedPlant::new(model, TS).expect("a plant")];
    let designs: Vec<AnyDesign<f64>> = (0..CANDIDATES).map(|c| design(c, encoded).into()).collect();
    let variables = [Variable::new(Parameter::Alpha, None, &designs[0]).expect("a variable")];
    let r = levels(SHORT_LOOP);
    let cost = Cost {
        chatter: Some(0.0),
        overshoot: Some(0.0),
        saturation: Some(0.0),
        ..Cost::default()
    };
    Box::new(move || {
        let task = Task {
            plants: &plants,
            references: &[&r],
            disturbances: &[],
            noise: &[],
            loads: &[],
            encoder: encoder(counts(encoded), 0.5).expect("an encoder"),
            start: designs[0],
            variables: &variables,
            cost,
            aggregate: Aggregate::Mean,
            constraints: Constraints::default(),
        };
        let judged = tune::costs(&task, &designs, 1, &Monitor::default());
        black_box(judged.expect("costs"));
    })
}

fn machine() -> Call {
    let mut machine = Machine::new(Parameters::default()).expect("a machine");
    let u: Vec<f64> = chirp(RUN).iter().map(|u| 10.0 * u).collect();
    Box::new(move || {
        machine.reset();
        u.iter().for_each(|&u| machine.advance(u));
        black_box(machine.speed_rpm());
    })
}
