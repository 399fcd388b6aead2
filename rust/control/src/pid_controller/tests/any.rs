//! The safety law: for any input the command is finite, within its limits and its slew; and the controller recovers.

use super::fading;
use crate::biquad::tests::{any_section, section};
use crate::{
    Cascade, Design, Feedforward, Level, PidController, Point, Real, Schedule, Settings, Standard,
};
use proptest::prelude::*;
use std::vec::Vec;

/// The law for a command, in the number type's own arithmetic and without tolerance.
///
/// Limits narrowed below the last command are approached at the slew rate, never left further.
fn holds<T: Real>(settings: &Settings<T>, last: T, u: T) -> Result<(), TestCaseError> {
    let Settings { u_min, u_max, .. } = *settings;
    let change = settings.slew * settings.ts;
    prop_assert!(u.is_finite(), "{u:?}");
    prop_assert!(
        u >= last - change && u <= last + change,
        "{last:?} {u:?} {change:?}"
    );
    let (low, high) = (
        if last < u_min { last } else { u_min },
        if last > u_max { last } else { u_max },
    );
    prop_assert!(u >= low && u <= high, "{last:?} {u:?} {settings:?}");
    Ok(())
}

macro_rules! laws {
    ($float:ident) => {
        mod $float {
            use super::*;
            use prop::num::$float::{ANY, NORMAL, POSITIVE, SUBNORMAL};

            /// Any number, the edges of the range and everyday ones often among them.
            fn number() -> impl Strategy<Value = $float> {
                let edges = [
                    0.0, -0.0, $float::MIN_POSITIVE, $float::MAX, -$float::MAX, $float::MAX / 2.0, -$float::MAX / 3.0,
                    $float::INFINITY, -$float::INFINITY, $float::NAN,
                ];
                prop_oneof![ANY, prop::sample::select(edges.to_vec()), $float::MAX / 1e3..$float::MAX, -50.0..50.0 as $float]
            }

            /// Any number above 0; often infinite, often of an everyday size.
            fn positive() -> impl Strategy<Value = $float> {
                prop_oneof![POSITIVE | NORMAL | SUBNORMAL, Just($float::INFINITY), 1e-3..10.0 as $float]
            }

            fn gains() -> impl Strategy<Value = Standard<$float>> {
                let td = prop_oneof![Just(0.0), POSITIVE | NORMAL, 0.0..0.1 as $float];
                (prop_oneof![NORMAL, -2.0..2.0 as $float], positive(), td)
                    .prop_map(|(kp, ti, td)| Standard { kp, ti, td })
            }

            fn limits() -> impl Strategy<Value = ($float, $float)> {
                let one = || prop_oneof![NORMAL, -9.0..9.0 as $float, Just($float::INFINITY), Just(-$float::INFINITY)];
                let ordered = |(a, b): ($float, $float)| (a.min(b), a.max(b));
                (one(), one()).prop_map(ordered).prop_filter("two limits", |(low, high)| {
                    low < high && *low < $float::INFINITY
                })
            }

            /// Any feedforward, often none.
            fn feedforward() -> impl Strategy<Value = Feedforward<$float>> {
                let levels = prop::collection::vec((number(), number()), 0..=8);
                let taps = prop::collection::vec(number(), 0..=16);
                (0..=30_usize, 0.0..=1.0 as $float, levels, taps).prop_map(|(preview, late, mut levels, taps)| {
                    levels.retain(|(y, u)| y.is_finite() && u.is_finite());
                    levels.sort_by(|a, b| a.0.total_cmp(&b.0));
                    let levels: Vec<_> = levels.into_iter().map(|(y, u)| Level { y, u }).collect();
                    let taps: Vec<_> = taps.into_iter().filter(|tap| tap.is_finite()).collect();
                    Feedforward::new(preview, late, &levels, &taps).unwrap_or(Feedforward::NONE)
                })
            }

            /// Any design that is accepted at this sample time.
            fn design(ts: $float) -> impl Strategy<Value = Design<$float>> {
                let tt = prop_oneof![Just(0.0), Just($float::INFINITY), (1.0..1e3 as $float).prop_map(move |n| n * ts)];
                let time = || prop_oneof![Just(0.0), POSITIVE | NORMAL, 0.0..0.02 as $float];
                let points = prop::collection::vec((0.0..50.0 as $float, gains()), 0..=8);
                let pid = (gains(), number(), number(), positive(), tt, limits(), positive());
                let biquads = prop::collection::vec(any_section(), 0..=4);
                let rest = (1..=64_usize, time(), time(), positive(), points, biquads);
                (pid, rest, feedforward()).prop_map(move |(p, rest, feedforward)| {
                    let (filter_samples, filter_time, observer_time, r_rate, points, biquads) = rest;
                    let points: Vec<_> = points.into_iter().map(|(speed, gains)| Point { speed, gains }).collect();
                    let finite = |x: $float| if x.is_finite() { x } else { 0.0 };
                    let pid = Settings {
                        gains: p.0, alpha: finite(p.1), beta: finite(p.2), n: p.3, tt: p.4, u_min: p.5.0, u_max: p.5.1,
                        slew: p.6, ts,
                    };
                    let schedule = Schedule::new(&points).unwrap_or(Schedule::NONE);
                    let sections: Vec<_> = biquads.into_iter().map(section).collect();
                    let biquads = Cascade::new(&sections).unwrap();
                    let whole = Design {
                        pid, filter_samples, filter_time, observer_time, r_rate, schedule, biquads, feedforward,
                    };
                    // a ramp so slow that a sample of it is 0 is refused
                    if PidController::new(whole).is_ok() { whole } else { Design { r_rate: $float::INFINITY, ..whole } }
                })
            }

            fn designs() -> impl Strategy<Value = (Design<$float>, Design<$float>)> {
                let ts = prop_oneof![POSITIVE | NORMAL, 1e-4..0.1 as $float];
                ts.prop_flat_map(|ts| (design(ts), design(ts)))
            }

            proptest! {
                #[test]
                fn the_command_is_finite_and_keeps_to_limits_and_slew_whatever_comes(
                    (one, other) in designs(),
                    signals in prop::collection::vec((number(), number(), number(), 0..9), 60),
                ) {
                    let mut controller = PidController::new(one).unwrap();
                    let mut last = (0.0 as $float).limit(one.pid.u_min, one.pid.u_max);
                    let mut fresh = true;
                    for (r, y, feedforward, what) in signals {
                        match what {
                            0 => {
                                controller.set_design(other).unwrap();
                                if fresh {
                                    last = (0.0 as $float).limit(other.pid.u_min, other.pid.u_max);
                                }
                            }
                            1 => controller.set_design(one).unwrap(),
                            2 => drop(controller.set_manual(feedforward)),
                            3 => controller.set_automatic(),
                            _ => {}
                        }
                        if what == 1 && fresh {
                            last = (0.0 as $float).limit(one.pid.u_min, one.pid.u_max);
                        }
                        fresh = false;
                        let u = controller.step_with(r, y, feedforward);
                        holds(controller.settings(), last, u)?;
                        last = u;
                    }
                }

                #[test]
                fn the_controller_finds_back_after_anything(
                    kp in 0.01..2.0 as $float, td in 0.0..0.05 as $float, n in 1.0..20.0 as $float,
                    samples in 1..=64_usize, filter_time in 0.0..2e-3 as $float, observer_time in 0.0..2e-3 as $float,
                    given in prop::collection::vec((20.0..400.0, 0.1..1.0, 20.0..400.0, 0.1..1.0, 0..4_u8), 0..=2),
                    garbage in prop::collection::vec((number(), number(), number()), 1..80),
                    r in -3.0..3.0 as $float, y in -3.0..3.0 as $float,
                ) {
                    let gains = Standard { kp, ti: $float::INFINITY, td };
                    let pid = Settings { n, u_min: -20.0, u_max: 20.0, ..Settings::new(gains, 1e-3) };
                    let sections: Vec<_> = given.into_iter().map(section).collect();
                    let biquads = Cascade::new(&sections).unwrap();
                    let design = Design { filter_samples: samples, filter_time, observer_time, biquads, ..Design::new(pid) };
                    let mut controller = PidController::new(design).unwrap();
                    for (r, y, feedforward) in garbage {
                        controller.step_with(r, y, feedforward);
                    }
                    // the largest number fades to nothing, even after a gain of up to 2e4
                    let fade = ($float::MAX as f64).ln() - ($float::EPSILON as f64).ln() + 10.0;
                    let u = (0..fading(&design, fade)).map(|_| controller.step(r, y)).last().unwrap();
                    let exact = kp * (r - y);
                    prop_assert!((u - exact).abs() <= 64.0 * $float::EPSILON * (1.0 + exact.abs()), "{u} {exact}");
                }
            }
        }
    };
}

laws!(f32);
laws!(f64);

#[test]
fn a_command_given_by_hand_before_the_first_measurement_does_not_jump_at_a_change_of_design() {
    let pid = Settings {
        u_max: 9.0,
        slew: 1e3,
        ..Settings::new(
            Standard {
                kp: 1.0,
                ti: 1.0,
                td: 0.0,
            },
            1e-3,
        )
    };
    let mut controller = PidController::new(Design::new(pid)).unwrap();
    controller.set_manual(5.0).unwrap();
    for expected in [1.0, 2.0, 3.0] {
        assert_eq!(controller.step(0.0, f64::NAN), expected);
    }
    controller.set_design(Design::new(pid)).unwrap();
    assert_eq!(controller.step(0.0, f64::NAN), 4.0);
}

#[test]
fn a_measurement_near_the_largest_number_costs_its_samples_only() {
    let gains = Standard {
        kp: 2.0,
        ti: 0.5,
        td: 0.05,
    };
    let pid = Settings {
        u_min: -3.0,
        u_max: 3.0,
        ..Settings::new(gains, 1e-3)
    };
    let design = Design {
        filter_samples: 4,
        ..Design::new(pid)
    };
    let mut controller = PidController::new(design).unwrap();
    for y in [1.0, 1e308, 1e308, 1e308, -1e308] {
        controller.step(1.0, y);
    }
    let after: Vec<f64> = (0..3).map(|_| controller.step(1.0, 0.5)).collect();
    assert!(after[1..].iter().all(|u| *u > 0.9 && *u < 3.0), "{after:?}");
}
