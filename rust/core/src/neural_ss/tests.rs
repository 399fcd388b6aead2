use super::*;
use crate::monitor::Limit;
use crate::random::Random;
use proptest::prelude::*;

fn random_model(seed: u64, shape: Shape, output: OutputFunction) -> NeuralSS {
    let mut random = Random::new(seed);
    let parts = shape.parts();
    let mut theta: Vec<f64> = (0..shape.parameters())
        .map(|_| random.between(-0.5, 0.5))
        .collect();
    // rows of A and E are so small that no state can grow
    for range in [parts.a, parts.e] {
        let width = range.len() / shape.nx;
        theta[range].iter_mut().for_each(|t| *t /= width as f64);
    }
    shape.hold(&mut theta);
    let ramp = |n: usize, first: f64| (0..n).map(|i| first + 0.3 * i as f64).collect::<Vec<_>>();
    let scaling = Scaling {
        u_mean: ramp(shape.inputs, 0.1),
        u_scale: ramp(shape.inputs, 2.0),
        y_mean: 3.0,
        y_scale: 20.0,
    };
    let unit = (0..shape.nx * shape.nx).map(|i| f64::from(u8::from(i % (shape.nx + 1) == 0)));
    let statistics = Statistics {
        state_mean: vec![0.0; shape.nx],
        state_covariance: unit.collect(),
        residual_variance: 1e-6,
        process_noise: 1e-3,
    };
    NeuralSS::new(shape, output, theta, scaling, statistics).unwrap()
}

fn moved(model: &NeuralSS, i: usize, by: f64) -> NeuralSS {
    let mut moved = model.clone();
    moved.theta[i] += by;
    moved.network.load(&moved.theta);
    moved
}

pub(super) fn noise(count: usize, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.normal()).collect()
}

fn shapes() -> impl Strategy<Value = Shape> {
    let integrator = any::<bool>();
    (1usize..7, 0usize..3, 1usize..4, 1usize..19, integrator).prop_map(
        |(nx, nk, inputs, hidden, integrator)| Shape {
            nx,
            nk,
            inputs,
            hidden,
            integrator,
        },
    )
}

fn functions() -> impl Strategy<Value = OutputFunction> {
    prop_oneof![
        Just(OutputFunction::Linear),
        Just(OutputFunction::Saturation {
            low: -0.6,
            high: 0.7,
            width: 0.2
        }),
        Just(OutputFunction::Abs { width: 0.3 }),
    ]
}

/// In each case every fifth parameter is varied.
const EVERY: usize = 5;

proptest! {
    #![proptest_config(crate::laws::cases(400))]
    #[test]
    fn sensitivities_agree_with_differences(seed in any::<u64>(), shape in shapes(), output in functions()) {
        let model = random_model(seed, shape, output);
        let u = noise(20 * shape.inputs, seed ^ 1);
        let state = noise(shape.nx, seed ^ 2);
        let (run, rows) = model.jacobian(&u, shape.inputs, &state).unwrap();
        let columns = shape.parameters() + shape.nx;
        // some in each case: two runs for every parameter of the largest model would take most of the time
        for i in (seed as usize % EVERY..columns).step_by(EVERY) {
            let at = |by: f64| match i.checked_sub(shape.parameters()) {
                None => moved(&model, i, by).simulate(&u, shape.inputs, &state).unwrap(),
                Some(j) => {
                    let mut state = state.clone();
                    state[j] += by;
                    model.simulate(&u, shape.inputs, &state).unwrap()
                }
            };
            let (ahead, behind) = (at(1e-5), at(-1e-5));
            for k in 0..run.len() {
                let difference = (ahead[k] - behind[k]) / 2e-5;
                let row = rows[k * columns + i];
                prop_assert!((row - difference).abs() < 1e-5 * (20.0 + difference.abs()), "{i} {k}: {row} {difference}");
            }
        }
    }

    #[test]
    fn a_clean_record_gives_its_state_back(seed in any::<u64>(), hidden in 1usize..10) {
        let shape = Shape { nx: 2, nk: 1, inputs: 1, hidden, integrator: false };
        let model = random_model(seed, shape, OutputFunction::Linear);
        let u = noise(30, seed ^ 1);
        let y = model.simulate(&u, 1, &[0.5, -0.8]).unwrap();
        let state = model.estimate_state(&u, 1, &y).unwrap();
        let again = model.simulate(&u, 1, &state).unwrap();
        let worst = y.iter().zip(&again).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        prop_assert!(worst < 1e-2 * model.scaling().y_scale, "{worst}");
    }
}

const SMALL: Shape = Shape {
    nx: 2,
    nk: 1,
    inputs: 1,
    hidden: 3,
    integrator: false,
};

#[test]
fn a_long_horizon_runs_free_and_a_short_one_follows_the_outputs() {
    let mut model = random_model(4, SMALL, OutputFunction::Linear);
    model.theta[..4].copy_from_slice(&[0.97, 0.1, 0.0, 0.95]);
    model.network.load(&model.theta);
    let u = noise(200, 5);
    let y = model.simulate(&u, 1, &[0.3, 0.2]).unwrap();
    let wrong = [3.0, -3.0];
    let free = model.simulate(&u, 1, &wrong).unwrap();
    assert_eq!(model.predict(&u, 1, &y, &wrong, 200).unwrap(), free);
    let error = |run: &[f64]| run.iter().zip(&y).map(|(a, b)| (a - b).abs()).sum::<f64>();
    let one = error(&model.predict(&u, 1, &y, &wrong, 1).unwrap());
    assert!(2.0 * one < error(&free), "{one} {}", error(&free));
    assert!(model.predict(&u, 1, &y, &wrong, 0).is_err());
}

#[test]
fn rests_where_nothing_moves() {
    let shape = Shape { inputs: 2, ..SMALL };
    let mut model = random_model(6, shape, OutputFunction::Linear);
    model.scaling.u_mean = vec![0.0; 2];
    model.scaling.y_mean = 0.0;
    for range in [shape.parts().bh, shape.parts().constant] {
        model.theta[range].fill(0.0);
    }
    model.network.load(&model.theta);
    assert!(
        model.rest_state().iter().all(|x| x.abs() < 1e-6),
        "{:?}",
        model.rest_state()
    );
}

#[test]
fn steps_as_it_simulates() {
    for nk in [1, 3] {
        let model = random_model(7, Shape { nk, ..SMALL }, OutputFunction::Linear);
        let mut stepper = Stepper::new(&model).unwrap();
        let mut u = vec![0.0; 3];
        u.extend(noise(50, 8));
        let run = model.simulate(&u, 1, &model.rest_state()).unwrap();
        for (u, y) in u.iter().zip(&run) {
            assert!((stepper.output() - y).abs() < 1e-12);
            stepper.advance(&[*u]);
        }
    }
    let model = random_model(7, Shape { nk: 0, ..SMALL }, OutputFunction::Linear);
    assert!(Stepper::new(&model).is_err());
}

#[test]
fn refuses_what_is_no_model() {
    let model = random_model(9, SMALL, OutputFunction::Linear);
    let with = |theta: Vec<f64>, statistics: Statistics, shape: Shape| {
        NeuralSS::new(
            shape,
            OutputFunction::Linear,
            theta,
            model.scaling.clone(),
            statistics,
        )
    };
    let good = || (model.theta.clone(), model.statistics.clone());
    assert!(with(good().0, good().1, SMALL).is_ok());
    assert!(with(vec![0.0], good().1, SMALL).is_err());
    assert!(with(good().0, good().1, Shape { nx: 0, ..SMALL }).is_err());
    assert!(
        with(
            good().0,
            good().1,
            Shape {
                integrator: true,
                ..SMALL
            }
        )
        .is_err()
    );
    let mut statistics = good().1;
    statistics.residual_variance = 0.0;
    assert!(with(good().0, statistics, SMALL).is_err());
    assert!(model.simulate(&[0.0; 4], 2, &[0.0; 2]).is_err());
    assert!(model.simulate(&[0.0; 4], 1, &[0.0; 3]).is_err());
    assert!(model.simulate(&[f64::NAN; 4], 1, &[0.0; 2]).is_err());
    assert!(model.estimate_state(&[], 1, &[]).is_err());
}

fn settings(shape: Shape) -> Settings {
    Settings {
        nx: shape.nx,
        nk: shape.nk,
        hidden: shape.hidden,
        linear: None,
        initial: Vec::new(),
        output: OutputFunction::Linear,
        integrator: shape.integrator,
        weight_decay: 0.0,
        hidden_scale: 1.0,
        guard: true,
        max_iterations: 60,
        starts: 3,
        first_start: 0,
        seed: 1,
        threads: 1,
    }
}

#[test]
fn recovers_a_model_of_its_own_class_and_gaps_do_not_matter() {
    let truth = random_model(11, SMALL, OutputFunction::Linear);
    let (u, other) = (noise(1200, 12), noise(400, 13));
    let mut y = truth.simulate(&u, 1, &[0.2, 0.1]).unwrap();
    y[100..140].fill(f64::NAN);
    let recording = crate::Record::with_gaps(&u, 1, &y).unwrap();
    let fit = fit(&[recording], &[], &settings(SMALL), &Monitor::default()).unwrap();
    let expected = truth.simulate(&other, 1, &[0.0, 0.0]).unwrap();
    let state = fit
        .model
        .estimate_state(&other[..50], 1, &expected[..50])
        .unwrap();
    let found = fit.model.simulate(&other, 1, &state).unwrap();
    let error: f64 = found
        .iter()
        .zip(&expected)
        .skip(50)
        .map(|(a, b)| (a - b).powi(2))
        .sum();
    let mean = expected.iter().sum::<f64>() / expected.len() as f64;
    let spread: f64 = expected.iter().map(|y| (y - mean).powi(2)).sum();
    assert!(error < 1e-4 * spread, "{}", error / spread);
    assert!(fit.sound && fit.trace.windows(2).all(|w| w[1] <= w[0]));
}

#[test]
fn the_threads_and_the_split_of_the_starts_do_not_matter() {
    let truth = random_model(21, SMALL, OutputFunction::Linear);
    let u = noise(300, 22);
    let y = truth.simulate(&u, 1, &[0.2, 0.1]).unwrap();
    let recording = [crate::Record::with_gaps(&u, 1, &y).unwrap()];
    let fit =
        |settings: &Settings| super::fit(&recording, &[], settings, &Monitor::default()).unwrap();
    let base = Settings {
        max_iterations: 10,
        ..settings(SMALL)
    };
    let one = fit(&base);
    let many = fit(&Settings {
        threads: 3,
        ..base.clone()
    });
    let last = fit(&Settings {
        starts: 1,
        first_start: 2,
        ..base.clone()
    });
    let theta = |model: &Option<NeuralSS>| model.as_ref().unwrap().theta().to_vec();
    for i in 0..3 {
        assert_eq!(theta(&one.start_models[i]), theta(&many.start_models[i]));
    }
    assert_eq!(theta(&last.start_models[0]), theta(&one.start_models[2]));
}

#[test]
fn a_model_is_trained_further_where_it_was_left() {
    let truth = random_model(31, SMALL, OutputFunction::Linear);
    let u = noise(300, 32);
    let y = truth.simulate(&u, 1, &[0.2, 0.1]).unwrap();
    let recording = [crate::Record::with_gaps(&u, 1, &y).unwrap()];
    let fit = |settings: &Settings| super::fit(&recording, &[], settings, &Monitor::default());
    let first = fit(&Settings {
        max_iterations: 5,
        ..settings(SMALL)
    })
    .unwrap();
    let further = Settings {
        initial: first.models.clone(),
        starts: first.models.len(),
        ..settings(SMALL)
    };
    let second = fit(&further).unwrap();
    assert!(second.trace[0] <= 1.001 * first.cost && second.cost < first.cost);
    assert_eq!(second.model.scaling(), first.model.scaling());
    let misfits = [
        Settings {
            starts: 1,
            ..further.clone()
        },
        Settings {
            hidden: 1,
            ..further.clone()
        },
        Settings {
            output: OutputFunction::Abs { width: 0.1 },
            ..further
        },
    ];
    assert!(misfits.iter().all(|settings| fit(settings).is_err()));
}

/// A free run and the rows of its sensitivities, as one kernel.
struct Whole<'a> {
    network: &'a Network,
    v: &'a [f64],
    y: &'a [f64],
    state: &'a [f64],
}

impl simd::Kernel for Whole<'_> {
    type Output = (Trajectory, Vec<Vec<f64>>);

    #[inline(always)]
    fn run<V: simd::F64x8>(self) -> Self::Output {
        let shape = self.network.shape;
        let monitor = Monitor::default();
        let mut run = Trajectory::new(self.network, self.v.len() / shape.inputs);
        let free = free_run::FreeRuns {
            weights: &[],
            runs: [free_run::Run {
                network: self.network,
                state: self.state,
                run: &mut run,
                scratch: &mut Scratch::new(shape),
                limit: Some(Limit::NONE),
            }],
            v: self.v,
            y: &[],
            bound: 1e3,
            monitor: &monitor,
        };
        assert!(free.run::<V>()[0].is_some());
        let columns = Columns::new(shape);
        let mut rows = Kept {
            width: columns.room,
            columns: columns.error + 1,
            block: Vec::new(),
            rows: Vec::new(),
        };
        let recursion = Recursion {
            weights: &[],
            network: self.network,
            run: &run,
            v: self.v,
            y: self.y,
            buffers: &mut Sensitivities::new(shape),
            rows: &mut rows,
            exact: false,
            monitor: &monitor,
        };
        recursion.run::<V>();
        (run, rows.rows)
    }
}

/// All rows; entries that are not written stay NaN.
struct Kept {
    width: usize,
    columns: usize,
    block: Vec<f64>,
    rows: Vec<Vec<f64>>,
}

impl Rows for Kept {
    fn width(&self) -> usize {
        self.width
    }

    fn room(&mut self, count: usize) -> &mut [f64] {
        self.block = vec![f64::NAN; count * self.width];
        &mut self.block
    }

    fn keep(&mut self, count: usize) {
        let rows = self.block.chunks_exact(self.width).take(count);
        self.rows
            .extend(rows.map(|row| row[..self.columns].to_vec()));
    }
}

pub(super) fn network_of(seed: u64, shape: Shape) -> Network {
    random_model(seed, shape, OutputFunction::Abs { width: 0.3 }).network
}

fn kinds() -> impl Iterator<Item = Shape> {
    (1..6).flat_map(|nx| {
        [3, 8, 15, 20].map(|hidden| Shape {
            nx,
            nk: 1,
            inputs: 2,
            hidden,
            integrator: false,
        })
    })
}

#[test]
fn every_processor_runs_and_differentiates_alike() {
    // Some hundred operations a sample, each rounded at 1e-16, in states that forget.
    let close = |a: f64, b: f64| (a - b).abs() < 1e-12 * (1.0 + a.abs());
    for shape in kinds() {
        let network = network_of(3, shape);
        let (v, state) = (noise(75 * shape.inputs, 4), noise(shape.nx, 5));
        let y = noise(75, 6);
        let all = simd::run_everywhere(|| Whole {
            network: &network,
            v: &v,
            y: &y,
            state: &state,
        });
        let (_, (first, first_rows)) = &all[0];
        assert_eq!(first_rows.len(), y.len());
        for (level, (run, rows)) in &all {
            let states = first.states.iter().zip(&run.states);
            let sums = first.sums.iter().zip(&run.sums);
            let slopes = first_rows.iter().flatten().zip(rows.iter().flatten());
            for (i, (a, b)) in states.chain(sums).chain(slopes).enumerate() {
                assert!(close(*a, *b), "{level:?} {shape:?} {i}: {a} {b}");
            }
        }
    }
}

#[test]
fn outputs_that_are_not_known_have_no_row_and_change_no_other() {
    for shape in kinds() {
        let network = network_of(7, shape);
        let (v, state) = (noise(75 * shape.inputs, 8), noise(shape.nx, 9));
        let all = noise(75, 10);
        let is_known = |i: &usize| i % 5 != 1 && !(30..36).contains(i) && i + 1 != all.len();
        let some: Vec<f64> = (0..all.len())
            .map(|i| if is_known(&i) { all[i] } else { f64::NAN })
            .collect();
        let rows = |y: &[f64]| {
            simd::run(Whole {
                network: &network,
                v: &v,
                y,
                state: &state,
            })
            .1
        };
        let every = rows(&all);
        let expected: Vec<_> = (0..all.len()).filter(is_known).map(|i| &every[i]).collect();
        assert_eq!(
            rows(&some).iter().collect::<Vec<_>>(),
            expected,
            "{shape:?}"
        );
    }
}

/// The state of a grown model that corresponds to one of the model itself.
fn grown_state(model: &NeuralSS, grown: &NeuralSS, state: &[f64]) -> Vec<f64> {
    let kept = state.len() - usize::from(model.shape().integrator);
    let added = grown.shape().nx - state.len();
    let new = grown.statistics().state_mean[kept..kept + added].to_vec();
    [&state[..kept], &new, &state[kept..]].concat()
}

#[test]
fn a_grown_model_runs_almost_as_before() {
    let functions = [
        OutputFunction::Linear,
        OutputFunction::Abs { width: 0.3 },
        OutputFunction::Saturation {
            low: -0.6,
            high: 0.7,
            width: 0.2,
        },
    ];
    for seed in 0..60_u64 {
        let shape = Shape {
            nx: 1 + seed as usize % 5,
            nk: 1,
            inputs: 1 + seed as usize % 2,
            hidden: 1 + seed as usize % 17,
            integrator: seed % 4 == 3,
        };
        let mut model = random_model(seed, shape, functions[seed as usize % 3]);
        if seed % 4 == 0 {
            // the first state is slow
            model.theta[..shape.nx].fill(0.0);
            model.theta[0] = 0.998;
            let e = shape.parts().e.start;
            model.theta[e..e + shape.hidden].fill(0.001);
            model.network.load(&model.theta);
        }
        let u = noise(2_000 * shape.inputs, seed ^ 1);
        let state = noise(shape.nx, seed ^ 2);
        let y = model.simulate(&u, shape.inputs, &state).unwrap();
        for (nx, hidden) in [(0, 8), (1, 0), (2, 8)] {
            let grown = model
                .grown(shape.nx + nx, shape.hidden + hidden, seed)
                .unwrap();
            assert_eq!(grown.shape().nx, shape.nx + nx);
            let state = grown_state(&model, &grown, &state);
            let run = grown.simulate(&u, shape.inputs, &state).unwrap();
            let mean = y.iter().sum::<f64>() / y.len() as f64;
            let rms = |squares: f64| (squares / y.len() as f64).sqrt();
            let spread = rms(y.iter().map(|y| (y - mean).powi(2)).sum());
            let moved = rms(y.iter().zip(&run).map(|(y, run)| (y - run).powi(2)).sum());
            // an output that hardly moves is measured by its scale in training
            let moved = moved / spread.max(model.scaling().y_scale);
            assert!(
                moved < 1e-2 && moved > 0.0,
                "{seed} {shape:?} {nx} {hidden}: {moved}"
            );
        }
    }
}

#[test]
fn growing_keeps_all_weights_and_refuses_less() {
    let shape = Shape {
        nx: 3,
        hidden: 4,
        integrator: true,
        ..SMALL
    };
    let model = random_model(7, shape, OutputFunction::Linear);
    let same = model.grown(3, 4, 1).unwrap();
    assert_eq!(same.theta(), model.theta());
    assert_eq!(same.statistics(), model.statistics());
    let grown = model.grown(5, 6, 1).unwrap();
    let parts = grown.shape().parts();
    let (a, old) = (&grown.theta()[parts.a], model.theta());
    assert_eq!(
        [a[0], a[1], a[5], a[20], a[21]],
        [old[0], old[1], old[3], old[6], old[7]]
    );
    assert_eq!([a[4], a[9], a[14], a[19], a[24]], [0.0, 0.0, 0.0, 0.0, 1.0]);
    assert!((POLES_OF_NEW_STATES).contains(&a[12]) && POLES_OF_NEW_STATES.contains(&a[18]));
    assert!(
        [a[2], a[3], a[7], a[8], a[22], a[23]]
            .iter()
            .all(|a| *a == 0.0)
    );
    let wx = &grown.theta()[parts.wx];
    assert!((0..4).all(|i| wx[i * 5 + 2..i * 5 + 5].iter().all(|w| *w == 0.0)));
    assert!((4..6).all(|i| wx[i * 5 + 4] == 0.0 && wx[i * 5 + 2] != 0.0));
    assert_ne!(model.grown(5, 6, 2).unwrap().theta(), grown.theta());
    assert_eq!(model.grown(5, 6, 1).unwrap().theta(), grown.theta());
    for (nx, hidden) in [(2, 4), (3, 3), (51, 4), (3, 1_001)] {
        assert_eq!(
            model.grown(nx, hidden, 0).unwrap_err().kind,
            crate::ErrorKind::Setting
        );
    }
}

const POLES_OF_NEW_STATES: std::ops::Range<f64> = 0.5..0.98;

#[test]
fn a_slowed_model_has_the_same_steady_states_and_takes_longer() {
    let model = random_model(9, SMALL, OutputFunction::Linear);
    let slowed = model.slowed(4.0).unwrap();
    let (u, state) = (vec![1.3; 600], [0.0; 2]);
    let (fast, slow) = (
        model.simulate(&u, 1, &state).unwrap(),
        slowed.simulate(&u, 1, &state).unwrap(),
    );
    assert!((fast[599] - slow[599]).abs() < 1e-9 * fast[599].abs().max(1.0));
    let settled = |run: &[f64]| {
        run.iter()
            .rposition(|y| (y - run[599]).abs() > 0.05)
            .unwrap()
    };
    assert!(
        settled(&slow) > 2 * settled(&fast),
        "{} {}",
        settled(&slow),
        settled(&fast)
    );
    assert!(model.slowed(0.0).is_err() && model.slowed(f64::NAN).is_err());
}
