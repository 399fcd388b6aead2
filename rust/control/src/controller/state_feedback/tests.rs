//! State feedback: the law of all controllers, gains with known answers, its behaviour on its own model.

use super::*;
use proptest::prelude::*;
use std::sync::LazyLock;
use std::vec::Vec;

const TS: f64 = 1e-3;

const WEIGHTS: Weights<f64> = Weights {
    rho: 2e4,
    integral: 5.0,
    noise: 1e4,
    reference: 1.0,
};

/// A motor of 490 RPM/V with time constants of 252 and 7.4 ms, without gains.
fn motor() -> StateDesign<f64> {
    let (p, q) = (0.996_039_6, 0.873_6);
    let b = 490.0 * (1.0 - p) * (1.0 - q) / 2.0;
    StateDesign {
        a: [-p - q, p * q, 0.0, 0.0],
        b: [b, b, 0.0, 0.0],
        k: [0.0; STATES],
        l: [0.0; STATES],
        rest: [0.0; STATES],
        kr: 0.0,
        ki: 0.0,
        lead: 0.0,
        r_rate: f64::INFINITY,
        u_min: -10.0,
        u_max: 10.0,
        slew: f64::INFINITY,
        ts: TS,
        weights: WEIGHTS,
    }
}

/// The plant of a design, from rest, with a command added after the limits.
struct Plant {
    past_u: [f64; STATES],
    past_y: [f64; STATES],
}

impl Plant {
    fn new() -> Self {
        Self {
            past_u: [0.0; STATES],
            past_y: [0.0; STATES],
        }
    }

    fn output(&self, design: &StateDesign<f64>) -> f64 {
        let sum = |c: &[f64], past: &[f64]| c.iter().zip(past).map(|(c, p)| c * p).sum::<f64>();
        sum(&design.b, &self.past_u) - sum(&design.a, &self.past_y)
    }

    fn advance(&mut self, y: f64, u: f64) {
        self.past_u.rotate_right(1);
        self.past_y.rotate_right(1);
        (self.past_u[0], self.past_y[0]) = (u, y);
    }
}

/// Outputs and commands along a reference; `added` is added to the command at each sample.
fn run(design: &StateDesign<f64>, r: &[f64], load: impl Fn(usize) -> f64) -> Vec<(f64, f64)> {
    let (mut controller, mut plant) = (StateFeedback::new(*design).unwrap(), Plant::new());
    let mut step = |(k, &r): (usize, &f64)| {
        let y = plant.output(design);
        let u = controller.step(r, y);
        plant.advance(y, u + load(k));
        (y, u)
    };
    r.iter().enumerate().map(&mut step).collect()
}

macro_rules! laws {
    ($float:ident) => {
        mod $float {
            use super::*;
            use prop::num::$float::{ANY, NORMAL, POSITIVE, SUBNORMAL};

            /// Any number, the edges of the range and everyday ones often among them.
            fn number() -> impl Strategy<Value = $float> {
                let edges = [
                    0.0, -0.0, $float::MIN_POSITIVE, $float::MAX, -$float::MAX, $float::MAX / 2.0,
                    $float::INFINITY, -$float::INFINITY, $float::NAN,
                ];
                prop_oneof![ANY, prop::sample::select(edges.to_vec()), -50.0..50.0 as $float]
            }

            fn finite() -> impl Strategy<Value = $float> {
                prop_oneof![NORMAL, Just(0.0), -2.0..2.0 as $float]
            }

            fn positive() -> impl Strategy<Value = $float> {
                prop_oneof![POSITIVE | NORMAL | SUBNORMAL, Just($float::INFINITY), 1e-3..10.0 as $float]
            }

            fn limits() -> impl Strategy<Value = ($float, $float)> {
                let one = || prop_oneof![NORMAL, -9.0..9.0 as $float, Just($float::INFINITY), Just(-$float::INFINITY)];
                let ordered = |(a, b): ($float, $float)| (a.min(b), a.max(b));
                (one(), one()).prop_map(ordered).prop_filter("two limits", |(low, high)| {
                    low < high && *low < $float::INFINITY
                })
            }

            /// Any design that is accepted.
            fn design() -> impl Strategy<Value = StateDesign<$float>> {
                let ts = prop_oneof![POSITIVE | NORMAL, 1e-4..0.1 as $float];
                let numbers = prop::collection::vec(finite(), NUMBERS);
                (numbers, ts, limits(), positive(), positive()).prop_map(|(numbers, ts, limits, slew, r_rate)| {
                    let mut numbers = numbers.into_iter();
                    let made = StateDesign::from_numbers(|| numbers.next(), ts).unwrap();
                    let whole = StateDesign { u_min: limits.0, u_max: limits.1, slew, r_rate, ..made };
                    // a ramp so slow that a sample of it is 0 is refused
                    if whole.check().is_ok() { whole } else { StateDesign { r_rate: $float::INFINITY, ..whole } }
                })
            }

            proptest! {
                #[test]
                fn the_command_is_finite_and_keeps_to_limits_and_slew_whatever_comes(
                    design in design(),
                    signals in prop::collection::vec((number(), number(), number(), 0..20_u8), 60),
                ) {
                    let mut controller = StateFeedback::new(design).unwrap();
                    let StateDesign { u_min, u_max, slew, ts, .. } = design;
                    let rest = (0.0 as $float).limit(u_min, u_max);
                    let mut last = rest;
                    for (r, y, feedforward, what) in signals {
                        if what == 0 {
                            controller.reset();
                            last = rest;
                        }
                        let u = controller.step_with(r, y, feedforward);
                        let change = slew * ts;
                        prop_assert!(u.is_finite() && u >= u_min && u <= u_max, "{u}");
                        prop_assert!(u >= last - change && u <= last + change, "{last} {u} {change}");
                        last = u;
                    }
                }

                #[test]
                fn the_controller_finds_back_after_anything(
                    garbage in prop::collection::vec((number(), number(), number()), 1..80),
                    r in -300.0..300.0 as $float,
                ) {
                    // without integral action, which keeps what it has learned
                    static EXACT: LazyLock<StateDesign<f64>> = LazyLock::new(|| {
                        lqg(motor(), Weights { integral: 0.0, ..WEIGHTS }).unwrap()
                    });
                    let numbers = EXACT.numbers().map(|x| x as $float);
                    let mut numbers = numbers.into_iter();
                    let design = StateDesign::from_numbers(|| numbers.next(), TS as $float).unwrap();
                    let mut controller = StateFeedback::new(design).unwrap();
                    for (r, y, feedforward) in garbage {
                        controller.step_with(r, y, feedforward);
                    }
                    // a plant at rest at its reference; the observer's memory fades by its poles, within 40,000 samples
                    // from 1e308
                    let fade = ($float::MAX as f64).ln() - ($float::EPSILON as f64).ln();
                    let settled = (0..(40_000.0 * fade / 745.0) as u32).map(|_| controller.step(r, r)).last().unwrap();
                    let held = (r as f64) / 490.0;
                    let tolerance = if $float::EPSILON > 1e-10 { 0.05 } else { 1e-9 };
                    prop_assert!((settled as f64 - held).abs() <= tolerance, "{settled} {held}");
                }
            }
        }
    };
}

laws!(f32);
laws!(f64);

proptest! {
    /// For a first-order plant both gains solve a quadratic equation.
    #[test]
    fn gains_of_one_state_are_those_of_the_scalar_riccati_equation(
        pole in -0.99..1.2_f64, b in 0.01..10.0_f64, rho in 1e-3..1e3_f64, noise in 1e-3..1e3_f64,
    ) {
        let bare = StateDesign { a: [-pole, 0.0, 0.0, 0.0], b: [b, 0.0, 0.0, 0.0], ..motor() };
        let weights = Weights { rho, noise, integral: 0.0, reference: 1.0 };
        let design = lqg(bare, weights).unwrap();
        // b^2 X^2 + (rho (1 - p^2) - q b^2) X - q rho = 0
        let positive = |b2: f64, rho: f64, q: f64| {
            let half = (rho * (1.0 - pole * pole) - q * b2) / 2.0;
            ((half * half + b2 * q * rho).sqrt() - half) / b2
        };
        let x = positive(b * b, rho, 1.0);
        let gain = pole * b * x / (rho + b * b * x);
        prop_assert!((design.k[0] - gain).abs() <= 1e-9 * (1.0 + gain.abs()), "{} {gain}", design.k[0]);
        let p = positive(1.0, noise, b * b);
        let seen = p / (p + noise);
        prop_assert!((design.l[0] - seen).abs() <= 1e-9, "{} {seen}", design.l[0]);
        prop_assert_eq!(design.ki, 0.0);
    }

    /// For any weights the loop around the model settles at the reference, also under a load.
    #[test]
    fn the_loop_around_its_model_is_stable_and_exact(
        rho in 1e2..1e5_f64, integral in 3.0..100.0_f64, noise in 1e2..1e6_f64, reference in 0.0..1.2_f64, load in -2.0..2.0_f64,
    ) {
        let weights = Weights { rho, integral, noise, reference };
        let design = lqg(motor(), weights).unwrap();
        let done = run(&design, &[1500.0; 8_000], |k| if k > 500 { load } else { 0.0 });
        let (y, u) = done[done.len() - 1];
        prop_assert!((y - 1500.0).abs() < 0.1, "{y}");
        prop_assert!((u + load - 1500.0 / 490.0).abs() < 1e-2, "{u}");
    }
}

#[test]
fn the_model_comes_to_the_reference_without_help_of_the_integral() {
    let weights = Weights {
        integral: 0.0,
        ..WEIGHTS
    };
    let design = lqg(motor(), weights).unwrap();
    let done = run(&design, &[1000.0; 3_000], |_| 0.0);
    assert!((done[2_999].0 - 1000.0).abs() < 1e-6, "{:?}", done[2_999]);
    assert_eq!(design.ki, 0.0);
}

#[test]
fn a_limit_that_holds_for_long_winds_nothing_up() {
    let design = lqg(motor(), WEIGHTS).unwrap();
    // 10 V are 4,900 RPM: 8,000 are out of reach, then 1,000 are requested
    let after = |held: usize| {
        let r: Vec<f64> = (0..held + 1_000)
            .map(|k| if k < held { 8_000.0 } else { 1_000.0 })
            .collect();
        let done = run(&design, &r, |_| 0.0);
        assert_eq!(done[held - 1].1, 10.0);
        done[held..].to_vec()
    };
    for ((y, u), (later_y, later_u)) in after(3_000).into_iter().zip(after(20_000)) {
        assert!((y - later_y).abs() < 1.0 && (u - later_u).abs() < 0.01);
    }
}

#[test]
fn the_observer_begins_as_if_the_plant_rested_at_the_first_measurement() {
    let design = lqg(
        motor(),
        Weights {
            integral: 0.0,
            ..WEIGHTS
        },
    )
    .unwrap();
    let mut controller = StateFeedback::new(design).unwrap();
    for _ in 0..50 {
        let u = controller.step(490.0, 490.0);
        assert!((u - 1.0).abs() < 1e-9, "{u}");
        assert!((controller.filtered() - 490.0).abs() < 1e-9);
    }
    // a missing measurement leaves the command and the model's course unchanged
    let u = controller.step(490.0, f64::NAN);
    assert!((u - 1.0).abs() < 1e-9);
    assert!((controller.step(490.0, 490.0) - 1.0).abs() < 1e-9);
}

#[test]
fn the_reference_is_led_and_ramped() {
    let led = StateDesign {
        lead: 5e-3,
        ..lqg(motor(), WEIGHTS).unwrap()
    };
    let plain = StateDesign { lead: 0.0, ..led };
    let ramp: Vec<f64> = (0..600).map(|k| 2.0 * f64::from(k)).collect();
    let lag = |design| {
        let (y, _) = run(&design, &ramp, |_| 0.0)[599];
        ramp[599] - y
    };
    let shift = lag(plain) - lag(led);
    // 5 ms of 2 RPM a sample, minus what the integral takes back
    assert!(shift > 1.0 && shift < 12.0, "{shift}");
    let slow = StateDesign {
        r_rate: 1_000.0,
        ..plain
    };
    let mut controller = StateFeedback::new(slow).unwrap();
    assert!(controller.step(1e4, 0.0) < 1.5 * slow.kr);
}

#[test]
fn numbers_come_back_and_single_precision_rounds_them() {
    let design = lqg(motor(), WEIGHTS).unwrap();
    let mut numbers = design.numbers().into_iter();
    let back = StateDesign::from_numbers(|| numbers.next(), TS).unwrap();
    assert_eq!(
        StateDesign {
            weights: WEIGHTS,
            ..back
        },
        design
    );
    let single = design.single();
    assert_eq!(single.numbers(), design.numbers().map(|x| x as f32));
    let mut few = [0.0; NUMBERS - 1].into_iter();
    assert_eq!(StateDesign::from_numbers(|| few.next(), TS), None);
}

#[test]
fn refuses_by_name() {
    let refused = |design, weights| lqg(design, weights).unwrap_err().name;
    for rho in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(refused(motor(), Weights { rho, ..WEIGHTS }), "rho");
        assert_eq!(
            refused(
                motor(),
                Weights {
                    noise: rho,
                    ..WEIGHTS
                }
            ),
            "noise"
        );
    }
    assert_eq!(
        refused(
            motor(),
            Weights {
                integral: -1.0,
                ..WEIGHTS
            }
        ),
        "integral"
    );
    assert_eq!(
        refused(
            motor(),
            Weights {
                reference: f64::NAN,
                ..WEIGHTS
            }
        ),
        "weight"
    );
    let still = StateDesign {
        b: [1.0, -1.0, 0.0, 0.0],
        ..motor()
    };
    assert_eq!(refused(still, WEIGHTS), "num");
    for (design, name) in [
        (
            StateDesign {
                u_max: -20.0,
                ..motor()
            },
            "u_max",
        ),
        (
            StateDesign {
                slew: 0.0,
                ..motor()
            },
            "slew",
        ),
        (
            StateDesign {
                r_rate: -1.0,
                ..motor()
            },
            "r_rate",
        ),
        (StateDesign { ts: 0.0, ..motor() }, "Ts"),
        (
            StateDesign {
                k: [f64::NAN; STATES],
                ..motor()
            },
            "K",
        ),
    ] {
        assert_eq!(design.check().unwrap_err().name, name);
    }
}
