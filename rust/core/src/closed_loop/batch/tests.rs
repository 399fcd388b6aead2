//! Loops in lanes against loops that run alone.

use proptest::prelude::*;
use sewfast_control::{
    AnyController, Biquad, Cascade, Design, PidController, STATES, Settings, Standard, StateDesign,
    StateFeedback, Weights, lqg,
};

use super::*;
use crate::closed_loop::kernel_plant::{AnyOrder, Known, ScalarMotor, ScalarPlant, SecondOrder};
use crate::closed_loop::{Constant, LoopController};
use crate::closed_loop::{LaggedPlant, Plant, Run, Varied, encoder, white_noise};
use crate::greybox::{self, GreyBox};
use crate::lagged::Lags;
use crate::linear::LinearModel;
use crate::model::{ClonePlant, Model};
use crate::neural::{NeuralOE, Scaling, Shape};
use crate::random::Random;
use crate::simd::{Lanes, Level, run_everywhere};

const TS: f64 = 1e-3;

/// Samples of the laws: three levels of the reference, and longer than all delays and memories of the lanes.
const SAMPLES: usize = 70;

/// Everything that eight runs wrote down.
#[derive(Default)]
struct Records([Vec<Lanes>; 3]);

impl Notes for Records {
    #[inline(always)]
    fn put<V: F64x8>(&mut self, _k: usize, _r: f64, u: V, y: V, feedback: V) {
        for (record, value) in self.0.iter_mut().zip([u, y, feedback]) {
            let mut group = Lanes::ZERO;
            value.store(&mut group.0);
            record.push(group);
        }
    }
}

fn network(seed: u64, lags: Lags, hidden: usize, bypass: bool, limit: f64) -> NeuralOE {
    let mut random = Random::new(seed);
    let shape = Shape::new(lags, hidden, bypass).unwrap();
    let theta = (0..shape.parameters())
        .map(|_| random.between(-0.5, 0.5))
        .collect();
    let scaling = Scaling {
        u_mean: vec![1.5],
        u_scale: vec![8.0],
        y_mean: 300.0,
        y_scale: 700.0,
    };
    NeuralOE::new(shape, theta, scaling, (-limit, limit)).unwrap()
}

prop_compose! {
    fn designs()(
        kp in -2e-3..0.05, ti in prop_oneof![0.01..0.5, Just(f64::INFINITY)], td in prop_oneof![Just(0.0), 1e-4..0.02],
        (alpha, beta) in (-0.5..1.0, -1.0..1.0), n in prop_oneof![Just(f64::INFINITY), 1.0..20.0],
        tt in prop_oneof![Just(0.0), TS..0.2, Just(f64::INFINITY)],
        slew in prop_oneof![Just(f64::INFINITY), 100.0..5e3],
        high in 1.0..25.0,
        (samples, lag, observer) in (1_usize..9, prop_oneof![Just(0.0), 1e-3..0.01], prop_oneof![Just(0.0), 1e-3..0.01]),
        r_rate in prop_oneof![Just(f64::INFINITY), 1e3..1e5],
        sections in prop::collection::vec((20.0..400.0, 0.02..0.5, 0.2..2.0), 2),
    ) -> Design<f64> {
        let gains = Standard { kp, ti, td };
        let pid = Settings { alpha, beta, n, tt, slew, u_min: -0.6 * high, u_max: high, ..Settings::new(gains, TS) };
        let notch = |&(hertz, depth, width): &(f64, f64, f64)| Biquad::notch(hertz, depth, width, TS).unwrap();
        let biquads = Cascade::new(&sections.iter().map(notch).collect::<Vec<_>>()).unwrap();
        Design { filter_samples: samples, filter_time: lag, observer_time: observer, r_rate, biquads, ..Design::new(pid) }
    }
}

/// How many controllers: more than one group of lanes is as dear as it is large.
fn some() -> impl Strategy<Value = usize> {
    prop_oneof![9 => 1..=LANES, 1 => LANES + 1..=MOST]
}

prop_compose! {
    /// Controllers of one search: as many sections in each.
    fn of_a_search()(mut designs in some().prop_flat_map(|n| prop::collection::vec(designs(), n)), count in 0_usize..3) -> Vec<Design<f64>> {
        for design in &mut designs {
            design.biquads = Cascade::new(&design.biquads.sections()[..count]).unwrap();
        }
        designs
    }
}

fn references(seed: u64, samples: usize) -> Vec<f64> {
    let mut random = Random::new(seed);
    let mut level = 0.0;
    (0..samples)
        .map(|k| {
            if k % 25 == 10 {
                level = random.between(-2000.0, 3000.0);
            }
            level
        })
        .collect()
}

/// A kernel that runs lanes, and each controller alone, on one level.
struct Both<'a> {
    known: KernelPlant<'a>,
    controllers: &'a [&'a PidController<f64>],
    signals: Signals<'a>,
    encoder: Option<&'a Encoder>,
}

type Recorded = (Outcome, [Vec<f64>; 3]);

impl Kernel for Both<'_> {
    type Output = (Vec<Recorded>, Vec<Recorded>, Tallied);

    #[inline(always)]
    fn run<V: F64x8>(self) -> Self::Output {
        let monitor = Monitor::default();
        let lanes = || BatchLoop {
            known: self.known,
            controllers: self.controllers,
            signals: self.signals,
            encoder: self.encoder,
            monitor: &monitor,
        };
        let groups = self.controllers.chunks(LANES);
        let mut records: Vec<_> = groups.clone().map(|_| Records::default()).collect();
        let mut tallies = vec![Tally::default(); records.len()];
        for (tally, group) in tallies.iter_mut().zip(groups) {
            tally.begin(group, 0);
        }
        Grouped::<_, _, 0>(lanes(), &mut tallies).run::<V>();
        let outcomes = Grouped::<_, _, 0>(lanes(), &mut records).run::<V>();
        let together = (0..self.controllers.len()).map(|i| {
            let end = ended(outcomes[i], self.signals.reference.len());
            let of = |record: &Vec<Lanes>| record[..end].iter().map(|g| g.0[i % LANES]).collect();
            (outcomes[i], records[i / LANES].0.each_ref().map(of))
        });
        let alone = self.controllers.iter().map(|controller| {
            let mut constant = Constant::new(controller);
            let mut general = AnyController::from(PidController::clone(controller));
            let run = match self.known.equations {
                Known::Lagged(form, lags) => {
                    let any = || ScalarPlant::<V, AnyOrder>::new(self.known, form, lags);
                    let run = self.alone(any(), &mut general);
                    assert_eq!(run, self.alone(any(), &mut constant));
                    if SecondOrder::takes(&self.known) {
                        let plant = ScalarPlant::<V, SecondOrder>::new(self.known, form, lags);
                        assert_eq!(run, self.alone(plant, &mut constant));
                    }
                    run
                }
                Known::Motor(motor) => {
                    let plant = || ScalarMotor::<V>::new(self.known, motor);
                    let run = self.alone(plant(), &mut general);
                    assert_eq!(run, self.alone(plant(), &mut constant));
                    run
                }
            };
            (run.outcome, [run.u, run.y, run.feedback])
        });
        let sums = (0..self.controllers.len()).map(|i| tallies[i / LANES].sums(i % LANES));
        (together.collect(), alone.collect(), sums.collect())
    }
}

impl Both<'_> {
    /// The run of one loop.
    #[inline(always)]
    fn alone(&self, mut plant: impl Plant, controller: &mut impl LoopController) -> Run {
        let (mut run, monitor) = (Run::default(), Monitor::default());
        run.fill(&mut plant, controller, self.signals, self.encoder, &monitor);
        run
    }
}

type Tallied = Vec<Sums>;

fn ended(outcome: Outcome, samples: usize) -> usize {
    match outcome {
        Outcome::Completed => samples,
        Outcome::Diverged(k) | Outcome::Interrupted(k) => k,
    }
}

fn bits(record: &Recorded) -> (Outcome, Vec<u64>) {
    let all = record.1.iter().flatten().map(|v| v.to_bits());
    (record.0, all.collect())
}

fn check(
    plant: &impl Plant,
    designs: &[Design<f64>],
    signals: Signals<'_>,
    encoder: Option<&Encoder>,
) -> Vec<(Level, Vec<Recorded>)> {
    let controllers: Vec<_> = designs
        .iter()
        .map(|d| PidController::new(*d).unwrap())
        .collect();
    let controllers: Vec<_> = controllers.iter().collect();
    let all = run_everywhere(|| Both {
        known: plant.known().unwrap(),
        controllers: &controllers,
        signals,
        encoder,
    });
    all.into_iter()
        .map(|(level, (together, alone, sums))| {
            for (i, (lane, alone)) in together.iter().zip(&alone).enumerate() {
                assert!(
                    bits(lane) == bits(alone),
                    "{level:?}, lane {i}: {lane:?} {alone:?}"
                );
                if lane.0 == Outcome::Completed {
                    assert_eq!(sums[i], summed(alone, signals.reference, &designs[i]));
                }
            }
            (level, together)
        })
        .collect()
}

/// What a tally has to say of a run.
fn summed((_, [u, y, _]): &Recorded, reference: &[f64], design: &Design<f64>) -> Sums {
    let (low, high) = (design.pid.u_min, design.pid.u_max);
    Sums {
        error: reference.iter().zip(y).map(|(r, y)| (r - y).powi(2)).sum(),
        command: u.iter().map(|u| u * u).sum(),
        change: u.windows(2).map(|p| (p[1] - p[0]).powi(2)).sum(),
        inside: u.iter().filter(|&&u| low < u && u < high).count() as f64,
        largest: u.iter().fold(0.0, |most, u| f64::max(most, u.abs())),
    }
}

proptest! {
    #![proptest_config(crate::laws::cases(300))]
    #[test]
    fn a_lane_is_its_loop_to_the_bit(
        designs in of_a_search(),
        seed in any::<u64>(),
        (na, nb, nk, hidden) in (1_usize..4, 1_usize..4, 1_usize..4, 1_usize..18),
        bypass in any::<bool>(),
        limit in prop_oneof![Just(f64::INFINITY), 0.3..3.0],
        (gain, delay) in (0.5..1.5, 0_usize..5),
        counts in prop_oneof![Just(0.0), Just(26.2)],
        (pushed, fed, noisy) in any::<(bool, bool, bool)>(),
    ) {
        let model = network(seed, Lags::new(na, nb, nk, 1).unwrap(), hidden, bypass, limit);
        let plant = Varied::new(LaggedPlant::new(&model, TS).unwrap(), gain, delay).unwrap();
        let reference = references(seed, SAMPLES);
        let noise = white_noise(2.0, SAMPLES, seed);
        let beside: Vec<f64> = (0..SAMPLES).map(|k| if k > 30 { -2.5 } else { 0.25 }).collect();
        let signals = Signals {
            disturbance: pushed.then_some(&beside),
            feedforward: fed.then_some(&beside[..SAMPLES - 15]),
            noise: noisy.then_some(&noise),
            ..Signals::new(&reference)
        };
        check(&plant, &designs, signals, encoder(counts, 0.5).unwrap().as_ref());
    }

    #[test]
    fn a_lane_around_a_difference_equation_is_its_loop(
        designs in of_a_search(),
        seed in any::<u64>(), nk in 1_usize..3, counts in prop_oneof![Just(0.0), Just(26.2)],
    ) {
        let model = LinearModel::new(vec![-1.6, 0.63], vec![3.0, 2.0], 1, nk, 1.0).unwrap();
        let plant = LaggedPlant::new(&model, TS).unwrap();
        let reference = references(seed, SAMPLES);
        check(&plant, &designs, Signals::new(&reference), encoder(counts, 0.25).unwrap().as_ref());
    }
}

struct Boxed<'a>(Box<dyn ClonePlant + 'a>);

impl Plant for Boxed<'_> {
    fn reset(&mut self) {
        self.0.reset();
    }
    fn output(&self) -> f64 {
        self.0.output()
    }
    fn position(&self) -> f64 {
        self.0.position()
    }
    fn advance(&mut self, u: f64) {
        self.0.advance(u);
    }
    fn known(&self) -> Option<KernelPlant<'_>> {
        self.0.known()
    }
}

/// A motor with or without voltage drop, limits, Stribeck friction, sag and network.
fn motor(values: &[(usize, f64)], units: usize, steps: usize, mean: bool) -> GreyBox {
    let mut all = [0.0; greybox::PARAMETERS.len()];
    all[..10].copy_from_slice(&[0.02, 1e-3, 0.004, 0.006, 0.0, 0.2, 0.25, 0.05, 0.0, 9.0]);
    all[17] = f64::INFINITY;
    for (place, value) in values {
        all[*place] = *value;
    }
    let mut random = Random::new(units as u64);
    let weights: Vec<f64> = (0..4 * units).map(|_| 0.3 * random.normal()).collect();
    let frame = greybox::Frame {
        values: all,
        joint: [0.0; greybox::JOINT.len()],
        free: Vec::new(),
        sample_time: TS,
        steps,
        mean,
        position: false,
        unit: std::f64::consts::TAU / 60.0,
        speed_scale: 150.0,
        command_scale: 3.0,
        residual_variance: 4.0,
        process_noise: 1e-5,
    };
    GreyBox::new(frame, &weights).unwrap()
}

proptest! {
    #![proptest_config(crate::laws::cases(100))]
    #[test]
    fn a_lane_around_a_motor_is_its_loop(
        designs in of_a_search(),
        seed in any::<u64>(),
        (drop, bump, uneven, sag) in (0.0..2.0_f64, 0.0..0.5_f64, -0.1..0.1_f64, 0.0..0.01_f64),
        given in prop::array::uniform5(any::<bool>()),
        (units, steps, mean, delay) in (0_usize..4, 1_usize..4, any::<bool>(), 0.0..3.5_f64),
        (gain, more) in (0.5..1.5, 0_usize..3),
        counts in prop_oneof![Just(0.0), Just(26.2)],
    ) {
        // drop, torque limit, bump of friction and its unevenness, sag
        let values = [(4, drop), (17, 2.0), (8, bump), (18, uneven), (19, sag)];
        let mut values: Vec<_> = values.into_iter().zip(given).filter(|(_, given)| *given).map(|(v, _)| v).collect();
        values.push((16, delay * TS));
        let model = motor(&values, units, steps, mean);
        let plant = Varied::new(Boxed(model.plant(TS).unwrap()), gain, more).unwrap();
        let reference = references(seed, SAMPLES);
        check(&plant, &designs, Signals::new(&reference), encoder(counts, 0.25).unwrap().as_ref());
    }
}

proptest! {
    #![proptest_config(crate::laws::cases(60))]
    #[test]
    fn a_lane_around_a_joint_is_its_loop(
        designs in of_a_search(),
        seed in any::<u64>(),
        (k_l, dead, reach, gravity) in (0.0..0.2_f64, 0.0..0.1_f64, 0.5..2.0_f64, -0.5..0.5_f64),
        given in prop::array::uniform9(any::<bool>()),
        inside in any::<bool>(),
        (units, steps, delay) in (0_usize..3, 1_usize..4, 0.0..3.5_f64),
    ) {
        let with = |given: bool, value: f64| if given { value } else { 0.0 };
        let base = motor(&[(0, 0.2), (2, 0.05), (16, delay * TS)], units, steps, false);
        let mut frame = base.frame().clone();
        frame.position = true;
        frame.joint[0] = with(given[0], k_l);
        frame.joint[5..].copy_from_slice(&[
            with(given[4], 0.03), with(given[4], 0.02), with(given[5], 0.01), with(given[5], 1.5), with(given[4], 0.01),
            with(given[6], 0.02), 0.0, with(given[7], 0.01), with(given[7], 0.3), with(given[7], 0.4), with(given[8], 0.1), with(given[8], 0.05), with(given[8], 6.5),
        ]);
        frame.values[8] = with(given[5], 0.1);
        if inside {
            frame.joint[1..5].copy_from_slice(&[1.0, 0.02, with(given[1], dead), with(given[2], reach)]);
            frame.joint[11] = with(given[6], 0.8);
        }
        (frame.values[10], frame.values[11]) = (with(given[3], gravity), with(given[3], 0.1));
        let model = GreyBox::new(frame, &Model::theta(&base)).unwrap();
        let plant = Boxed(model.plant(TS).unwrap());
        let reference = references(seed, SAMPLES);
        check(&plant, &designs, Signals::new(&reference), None);
    }
}

/// Output and position of a motor under commands, on one level.
struct Turned<'a>(KernelPlant<'a>, &'a [f64]);

impl Kernel for Turned<'_> {
    type Output = Vec<[u64; 2]>;

    #[inline(always)]
    fn run<V: F64x8>(self) -> Self::Output {
        let Known::Motor(motor) = self.0.equations else {
            panic!("expected a motor");
        };
        let mut plant = ScalarMotor::<V>::new(self.0, motor);
        turned(&mut plant, self.1)
    }
}

fn turned(plant: &mut impl Plant, u: &[f64]) -> Vec<[u64; 2]> {
    let after = |u: &f64| {
        plant.advance(*u);
        [plant.output().to_bits(), plant.position().to_bits()]
    };
    u.iter().map(after).collect()
}

/// Without a network, whose `tanh` is the kernel's own.
#[test]
fn a_motor_in_a_kernel_has_the_bits_of_its_equations() {
    let values = [
        (4, 0.8),
        (17, 2.5),
        (8, 0.2),
        (18, 0.05),
        (19, 0.004),
        (16, 1.4 * TS),
    ];
    let (some, mut random) = (values.len(), Random::new(3));
    let mut level = 0.0;
    let command = (0..2000).map(|k| {
        if k % 40 == 0 {
            level = random.between(-12.0, 12.0);
        }
        level
    });
    let u: Vec<f64> = command.collect();
    for count in [0, 1, some] {
        let model = motor(&values[..count], 0, 2, count > 0);
        let mut plant = Boxed(model.plant(TS).unwrap());
        let own = turned(&mut plant, &u);
        for (level, kernel) in run_everywhere(|| Turned(plant.known().unwrap(), &u)) {
            assert!(own == kernel, "{level:?}, {count} values");
        }
    }
}

#[test]
fn a_lane_that_runs_away_leaves_the_others_alone() {
    let model = LinearModel::new(vec![-0.98], vec![9.8], 1, 1, 0.0).unwrap();
    let plant = LaggedPlant::new(&model, TS).unwrap();
    let calm = Settings::new(
        Standard {
            kp: 2e-3,
            ti: 0.05,
            td: 0.0,
        },
        TS,
    );
    let wild = |kp| {
        let gains = Standard { kp, ..calm.gains };
        Settings { gains, ..calm }
    };
    // the third is too large for its command to be a number at all, and so holds
    let kp = [2e-3, 10.0, 1e308, 3e-3, 0.5, 1e-3, -1.0, 2e-3, 4e-3];
    let designs = kp.map(|kp| Design::new(wild(kp)));
    let reference = [1000.0; 400];
    for (_, records) in check(&plant, &designs, Signals::new(&reference), None) {
        let diverged = records
            .iter()
            .map(|(outcome, _)| matches!(outcome, Outcome::Diverged(_)));
        let expected = [false, true, false, false, true, false, true, false, false];
        assert_eq!(diverged.collect::<Vec<_>>(), expected);
        assert_eq!(records[2].1[0], vec![0.0; 400]);
    }
}

#[test]
fn all_lanes_end_on_a_stop() {
    let model = network(1, Lags::new(2, 2, 1, 1).unwrap(), 8, false, f64::INFINITY);
    let plant = LaggedPlant::new(&model, TS).unwrap();
    let gains = Standard {
        kp: 1e-3,
        ti: 0.1,
        td: 0.0,
    };
    let controller = PidController::new(Design::new(Settings::new(gains, TS))).unwrap();
    let monitor = Monitor::default();
    monitor.request_stop();
    let lanes = BatchLoop {
        known: plant.known().unwrap(),
        controllers: &[&controller; 3],
        signals: Signals::new(&[1.0; 10]),
        encoder: None,
        monitor: &monitor,
    };
    let outcomes = lanes.run(&mut [Tally::default()]);
    assert_eq!(outcomes[..3], [Outcome::Interrupted(0); 3]);
}

#[test]
fn levels_differ_by_rounding_only() {
    let model = network(7, Lags::new(2, 2, 1, 1).unwrap(), 8, false, f64::INFINITY);
    let plant = LaggedPlant::new(&model, TS).unwrap();
    let gains = Standard {
        kp: 2e-3,
        ti: 0.1,
        td: 1e-3,
    };
    let pid = Settings {
        n: 8.0,
        u_min: -20.0,
        u_max: 20.0,
        ..Settings::new(gains, TS)
    };
    let reference = references(3, 1000);
    let all = check(
        &plant,
        &[Design::new(pid); 2],
        Signals::new(&reference),
        None,
    );
    for (level, records) in &all {
        for (a, b) in records[0].1[1].iter().zip(&all[0].1[0].1[1]) {
            // what is forgotten at once by this plant is some units in the last place of the outputs' range
            assert!((a - b).abs() <= 1e-12 * 2000.0, "{level:?}: {a} {b}");
        }
    }
}

/// A kernel that runs state feedback in lanes, and each controller alone, on one level.
struct States<'a> {
    known: KernelPlant<'a>,
    controllers: &'a [&'a StateFeedback<f64>],
    signals: Signals<'a>,
    encoder: Option<&'a Encoder>,
}

impl Kernel for States<'_> {
    type Output = (Vec<Recorded>, Vec<Recorded>);

    #[inline(always)]
    fn run<V: F64x8>(self) -> Self::Output {
        let monitor = Monitor::default();
        let lanes = BatchLoop {
            known: self.known,
            controllers: self.controllers,
            signals: self.signals,
            encoder: self.encoder,
            monitor: &monitor,
        };
        let groups = self.controllers.len().div_ceil(LANES);
        let mut records: Vec<_> = (0..groups).map(|_| Records::default()).collect();
        let outcomes = Grouped::<_, _, 0>(lanes, &mut records).run::<V>();
        let together = (0..self.controllers.len()).map(|i| {
            let end = ended(outcomes[i], self.signals.reference.len());
            let of = |record: &Vec<Lanes>| record[..end].iter().map(|g| g.0[i % LANES]).collect();
            (outcomes[i], records[i / LANES].0.each_ref().map(of))
        });
        let together = together.collect();
        let alone = self.controllers.iter().map(|&controller| {
            let Known::Lagged(form, lags) = self.known.equations else {
                panic!("expected a lagged plant");
            };
            let mut plant = ScalarPlant::<V, AnyOrder>::new(self.known, form, lags);
            let mut controller = AnyController::StateFeedback(controller.clone());
            let mut run = Run::default();
            let (signals, encoder) = (self.signals, self.encoder);
            run.fill(&mut plant, &mut controller, signals, encoder, &monitor);
            (run.outcome, [run.u, run.y, run.feedback])
        });
        (together, alone.collect())
    }
}

prop_compose! {
    fn state_designs()(
        rho in 1.0..1e6_f64, integral in prop_oneof![Just(0.0), 0.1..50.0_f64], noise in 1.0..1e6_f64,
        reference in 0.0..1.2_f64, lead in 0.0..0.03_f64, high in 1.0..25.0_f64,
        (slew, r_rate) in (prop_oneof![Just(f64::INFINITY), 100.0..5e3_f64], prop_oneof![Just(f64::INFINITY), 1e3..1e5_f64]),
        pole in 0.9..0.999_f64, fast in 0.1..0.9_f64,
    ) -> StateDesign<f64> {
        let none = [0.0; STATES];
        let plant = StateDesign {
            a: [-pole - fast, pole * fast, 0.0, 0.0],
            b: [3.0, 2.0, 0.0, 0.0],
            k: none, l: none, rest: none, kr: 0.0, ki: 0.0, lead, r_rate, u_min: -0.6 * high, u_max: high, slew, ts: TS,
            weights: Weights { rho, integral, noise, reference },
        };
        lqg(plant, plant.weights).unwrap()
    }
}

proptest! {
    #![proptest_config(crate::laws::cases(300))]
    #[test]
    fn a_lane_of_state_feedback_is_its_loop_to_the_bit(
        designs in some().prop_flat_map(|n| prop::collection::vec(state_designs(), n)),
        seed in any::<u64>(), counts in prop_oneof![Just(0.0), Just(26.2)],
        (pushed, fed, noisy) in any::<(bool, bool, bool)>(),
        huge in prop_oneof![Just(1.0), Just(1e300)],
    ) {
        // gains that no number holds: the command stays, and the observer begins again
        let huge = |d: &StateDesign<f64>| StateDesign { k: d.k.map(|k| k * huge), ..*d };
        let designs: Vec<_> = designs.iter().enumerate().map(|(i, d)| if i == 1 { huge(d) } else { *d }).collect();
        let model = network(seed, Lags::new(2, 2, 1, 1).unwrap(), 6, true, f64::INFINITY);
        let plant = LaggedPlant::new(&model, TS).unwrap();
        let reference = references(seed, SAMPLES);
        let noise = white_noise(2.0, SAMPLES, seed);
        let beside: Vec<f64> = (0..SAMPLES).map(|k| if k > 30 { -2.5 } else { 0.25 }).collect();
        let signals = Signals {
            disturbance: pushed.then_some(&beside),
            feedforward: fed.then_some(&beside[..SAMPLES - 15]),
            noise: noisy.then_some(&noise),
            ..Signals::new(&reference)
        };
        let controllers: Vec<_> = designs.iter().map(|d| StateFeedback::new(*d).unwrap()).collect();
        let controllers: Vec<_> = controllers.iter().collect();
        let encoder = encoder(counts, 0.5).unwrap();
        let all = run_everywhere(|| States {
            known: plant.known().unwrap(), controllers: &controllers, signals, encoder: encoder.as_ref(),
        });
        for (level, (together, alone)) in all {
            for (i, (lane, alone)) in together.iter().zip(&alone).enumerate() {
                prop_assert!(bits(lane) == bits(alone), "{level:?}, lane {i}: {lane:?} {alone:?}");
            }
        }
    }
}
