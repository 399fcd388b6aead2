//! The whole controller: its bits of before, changes without a bump, constant cost.

use super::*;
use crate::biquad::tests::{any_section, section, settling};
use crate::real::counted::{Counted, operations};
use crate::{AHEAD, Biquad, Cascade, Feedforward, Level, Point, Schedule, Standard, TAPS};
use proptest::prelude::*;
use std::vec::Vec;

mod any;

const TS: f64 = 1e-3;

fn pid(kp: f64, ti: f64, td: f64) -> Settings<f64> {
    Settings::new(Standard { kp, ti, td }, TS)
}

fn point<T>(speed: T, kp: T, ti: T, td: T) -> Point<T> {
    let gains = Standard { kp, ti, td };
    Point { speed, gains }
}

/// Any design without limits.
fn free() -> impl Strategy<Value = Design<f64>> {
    let ti = || prop_oneof![0.05..10.0, Just(f64::INFINITY)];
    let gains = (0.01..2.0, ti(), 0.0..0.05, -0.5..1.5, -0.5..1.5);
    let n = prop_oneof![1.0..20.0, Just(f64::INFINITY)];
    let filter = (1..12_usize, 0.0..0.01, prop_oneof![Just(0.0), 1e-3..0.02]);
    let rate = prop_oneof![Just(f64::INFINITY), 1e2..1e5];
    let points = prop_oneof![
        Just(Schedule::NONE),
        (0.01..2.0, ti(), 0.0..0.05, 0.01..2.0, ti(), 0.0..0.05).prop_map(|g| Schedule::new(&[
            point(0.0, g.0, g.1, g.2),
            point(50.0, g.3, g.4, g.5)
        ])
        .unwrap()),
    ];
    let biquads = prop::collection::vec(any_section(), 0..=2).prop_map(|given| {
        let sections: Vec<_> = given.into_iter().map(section).collect();
        Cascade::new(&sections).unwrap()
    });
    let feedforward = prop_oneof![
        Just(Feedforward::NONE),
        (0..=30_usize, 0.0..=1.0, -0.5..0.5, -0.5..0.5).prop_map(|(preview, late, u, tap)| {
            let levels = [Level { y: -5.0, u: -2.0 }, Level { y: 5.0, u }];
            Feedforward::new(preview, late, &levels, &[tap, u]).unwrap()
        }),
    ];
    (gains, n, filter, rate, points, biquads, feedforward).prop_map(
        |(g, n, filter, r_rate, schedule, biquads, feedforward)| Design {
            pid: Settings {
                alpha: g.3,
                beta: g.4,
                n,
                ..pid(g.0, g.1, g.2)
            },
            filter_samples: filter.0,
            filter_time: filter.1,
            observer_time: filter.2,
            r_rate,
            schedule,
            biquads,
            feedforward,
        },
    )
}

/// Samples in which the controller's memory, except its integral, fades by `exp(-fade)`: the ramp of a reference within
/// 100, then the moving average, derivative, filter, observer and sections, one after the other.
fn fading<T: Real>(design: &Design<T>, fade: f64) -> u32 {
    let (pid, ts) = (&design.pid, design.pid.ts.to_f64());
    let all = design.schedule.points().iter().map(|p| p.gains);
    let td = all.chain([pid.gains]).map(|g| g.td.to_f64());
    let times = [
        td.fold(0.0, f64::max) / pid.n.to_f64(),
        design.filter_time.to_f64(),
        2.0 * design.observer_time.to_f64(),
    ];
    let slow = times.iter().filter(|time| **time > 0.0);
    let memory: f64 = slow.map(|time| time / ts + 1.0).sum();
    let ramp = 100.0 / (design.r_rate.to_f64() * ts);
    let ramp = ramp + (AHEAD.max(TAPS) + 1) as f64;
    let own = ramp + design.filter_samples as f64 + fade * memory;
    own.ceil() as u32 + settling(&design.biquads, fade)
}

/// Largest move of the integral itself in one sample.
fn creep(design: &Design<f64>, e: f64) -> f64 {
    let all = design.schedule.points().iter().map(|p| p.gains);
    let gains = all.chain([design.pid.gains]);
    let largest = gains.map(|g| g.kp * TS / g.ti).fold(0.0, f64::max);
    largest * e.abs()
}

proptest! {
    #[test]
    fn a_change_of_design_moves_nothing_at_once(
        old in free(), new in free(), r in -40.0..40.0, y in -40.0..40.0, feedforward in -5.0..5.0, kept in any::<bool>(),
    ) {
        let new = Design { biquads: if kept { old.biquads } else { new.biquads }, ..new };
        let mut controller = PidController::new(old).unwrap();
        controller.step_with(r, y / 2.0, feedforward);
        let before = (0..fading(&old, 40.0)).map(|_| controller.step_with(r, y, feedforward)).last().unwrap();
        controller.set_design(new).unwrap();
        let after = controller.step_with(r, y, feedforward);
        // the first output of a section amplifies what its input moves by rounding
        let amplified = new.biquads.sections().iter().fold(1.0, |by, s| by * (1.0 + s.c0.abs()));
        let scale = (1e-11 + 1e-14 * amplified) * (1.0 + before.abs() + 400.0);
        prop_assert!((after - before).abs() <= creep(&new, r - y) * (1.0 + 1e-9) + scale, "{before} {after}");
    }

    #[test]
    fn a_change_on_a_ramp_of_the_output_moves_nothing_at_once(
        kp in 0.01..2.0, kp2 in 0.01..2.0_f64, td in 1e-3..0.05, td2 in 1e-3..0.05, n in 1.0..20.0, slope in -1.0..1.0_f64,
    ) {
        // Without integral action a ramp moves only the proportional term, by Kp slope a sample.
        let inf = f64::INFINITY;
        let old = Design::new(Settings { n, ..pid(kp, inf, td) });
        let new = Design::new(Settings { n, ..pid(kp2, inf, td2) });
        let mut controller = PidController::new(old).unwrap();
        let before = (0..5000).map(|k| controller.step(0.0, slope * f64::from(k))).last().unwrap();
        controller.set_design(new).unwrap();
        let after = controller.step(0.0, slope * 5000.0);
        prop_assert!((after - before + kp2 * slope).abs() <= 1e-9 * (1.0 + before.abs()), "{before} {after}");
    }

    #[test]
    fn the_same_design_again_changes_no_bit(
        design in free(), signals in prop::collection::vec((-40.0..40.0, -40.0..40.0), 40), limit in 1.0..50.0_f64,
    ) {
        let pid = Settings { u_min: -limit, u_max: limit, slew: 1e4, ..design.pid };
        let design = Design { pid, ..design };
        let mut left = PidController::new(design).unwrap();
        let mut touched = left.clone();
        for (r, y) in signals {
            prop_assert_eq!(left.step(r, y).to_bits(), touched.step(r, y).to_bits());
            touched.set_design(design).unwrap();
        }
    }

    #[test]
    fn manual_hands_over_where_the_operator_was(
        design in free(), r in -40.0..40.0, y in -40.0..40.0, manual in -12.0..12.0, feedforward in -5.0..5.0,
    ) {
        let pid = Settings { u_min: -10.0, u_max: 10.0, ..design.pid };
        let design = Design { pid, ..design };
        let mut controller = PidController::new(design).unwrap();
        controller.step_with(r, y / 3.0, feedforward);
        controller.set_manual(manual).unwrap();
        let mut u = 0.0;
        for _ in 0..fading(&design, 40.0) {
            u = controller.step_with(r, y, feedforward);
            prop_assert_eq!(u, manual.clamp(-10.0, 10.0));
        }
        prop_assert!(controller.is_manual());
        controller.set_automatic();
        let after = controller.step_with(r, y, feedforward);
        prop_assert!((after - u).abs() <= creep(&design, r - y) * (1.0 + 1e-9) + 1e-9, "{u} {after}");
    }

    #[test]
    fn stays_within_its_limits_whatever_comes(
        design in free(), other in free(),
        signals in prop::collection::vec((prop::num::f64::ANY, prop::num::f64::ANY, prop::num::f64::ANY, 0..5), 40),
    ) {
        let limited = |d: Design<f64>| Design { pid: Settings { u_min: -3.0, u_max: 5.0, slew: 1e3, tt: 0.01, ..d.pid }, ..d };
        let mut controller = PidController::new(limited(design)).unwrap();
        let mut last = 0.0;
        for (r, y, feedforward, what) in signals {
            match what {
                0 => controller.set_design(limited(other)).unwrap(),
                1 => drop(controller.set_manual(feedforward)),
                2 => controller.set_automatic(),
                _ => {}
            }
            let u = controller.step_with(r, y, feedforward);
            prop_assert!((-3.0..=5.0).contains(&u) && f64::abs(u - last) <= 1.0 + 1e-12);
            last = u;
        }
    }

    #[test]
    fn equal_points_are_constant_gains_bit_for_bit(
        design in free(), count in 1..=8_usize, spacing in 1.0..30.0,
        signals in prop::collection::vec((-40.0..40.0, -40.0..40.0), 60),
    ) {
        let constant = Design { schedule: Schedule::NONE, ..design };
        let gains = design.pid.gains;
        let points: Vec<_> =
            (0..count).map(|i| Point { speed: spacing * i as f64, gains }).collect();
        let scheduled = Design { schedule: Schedule::new(&points).unwrap(), ..design };
        let (mut a, mut b) = (PidController::new(constant).unwrap(), PidController::new(scheduled).unwrap());
        for (r, y) in signals {
            prop_assert_eq!(a.step(r, y).to_bits(), b.step(r, y).to_bits());
        }
    }

    #[test]
    fn feedforward_is_added_before_the_limits(
        design in free(), signals in prop::collection::vec((-40.0..40.0, -40.0..40.0, -20.0..20.0), 40),
    ) {
        let mut with = PidController::new(design).unwrap();
        let mut without = with.clone();
        for (r, y, feedforward) in signals {
            let (u, base) = (with.step_with(r, y, feedforward), without.step(r, y));
            prop_assert!((u - base - feedforward).abs() <= 1e-9 * (1.0 + u.abs() + base.abs()));
        }
    }
}

#[test]
fn feeds_back_the_filtered_output_and_skips_a_lost_measurement() {
    let design = Design {
        filter_samples: 2,
        ..Design::new(pid(1.0, f64::INFINITY, 0.0))
    };
    let mut controller = PidController::new(design).unwrap();
    assert_eq!(controller.step(0.0, 4.0), -4.0);
    assert_eq!(controller.step(0.0, 0.0), -2.0);
    assert_eq!(controller.filtered(), 2.0);
    assert_eq!(controller.step(0.0, f64::NAN), -2.0);
    assert_eq!(controller.step(0.0, 0.0), 0.0);
}

#[test]
fn biquads_act_as_on_the_command() {
    // linear in reference and output, so they may come after the PID as well
    let gains = pid(0.7, 0.05, 0.004);
    let notch = Biquad::notch(60.0, 0.05, 0.6, TS).unwrap();
    let low_pass = Biquad::low_pass(200.0, 0.7, TS).unwrap();
    let sections = [notch, low_pass];
    let design = Design {
        biquads: Cascade::new(&sections).unwrap(),
        ..Design::new(Settings {
            alpha: 0.3,
            beta: 0.6,
            n: 5.0,
            ..gains
        })
    };
    let mut filtered = PidController::new(design).unwrap();
    let plain = Design {
        biquads: Cascade::NONE,
        ..design
    };
    let mut plain = PidController::new(plain).unwrap();
    let mut behind = crate::biquad::Memory::new();
    behind.rest_at(0.0);
    for k in 0..500_i32 {
        let (r, y) = (f64::from((k / 50) % 3), f64::from((k * k) % 17) * 0.1);
        let (r, y) = if k == 0 { (0.0, 0.0) } else { (r, y) };
        let exact = behind.step(&sections, plain.step(r, y));
        let found = filtered.step(r, y);
        assert!((found - exact).abs() < 1e-8, "{k} {found} {exact}");
    }
}

#[test]
fn biquads_filter_a_step_of_the_reference_at_the_first_sample() {
    let low_pass = Biquad::low_pass(5.0, 1.0, TS).unwrap();
    let design = Design {
        biquads: Cascade::new(&[low_pass]).unwrap(),
        ..Design::new(pid(1.0, f64::INFINITY, 0.0))
    };
    let mut controller = PidController::new(design).unwrap();
    for _ in 0..2 {
        let first = controller.step(100.0, 20.0);
        assert!(first > 0.0 && first < 0.05, "{first}");
        let later = (0..2000).map(|_| controller.step(100.0, 20.0)).last();
        assert!((later.unwrap() - 80.0).abs() < 1e-9);
        controller.reset();
    }
}

#[test]
fn a_lead_makes_no_bump_of_the_last_place() {
    // the observer rests one unit in the last place away from its input, and the lead responds to a step by 4e5
    let lead = Biquad::resonance(0.5, 1.0, 499.0, 1.0, TS).unwrap();
    let lead = Cascade::new(&[lead]).unwrap();
    let observed = Design {
        observer_time: 0.0157,
        ..Design::new(pid(1.0, f64::INFINITY, 0.0))
    };
    let plain = Design {
        biquads: lead,
        observer_time: 0.0,
        ..observed
    };
    for before in [Cascade::NONE, lead] {
        let mut missed = 0;
        for y in (1..=20).map(|k| 36.3 + f64::from(k).sqrt()) {
            let biquads = before;
            let mut controller = PidController::new(Design {
                biquads,
                ..observed
            })
            .unwrap();
            controller.step(0.0, y / 2.0);
            let u = (0..20_000).map(|_| controller.step(0.0, y)).last().unwrap();
            missed += u32::from(controller.filtered() != y);
            controller.set_design(plain).unwrap();
            let after = controller.step(0.0, y);
            assert!((after - u).abs() < 1e-12, "{u} {after}");
        }
        assert!(missed > 0);
    }
}

#[test]
fn biquads_outlive_what_is_no_number() {
    let notch = Biquad::notch(60.0, 0.05, 0.6, TS).unwrap();
    let design = Design {
        biquads: Cascade::new(&[notch; 4]).unwrap(),
        ..Design::new(pid(1.0, f64::INFINITY, 0.0))
    };
    let mut controller = PidController::new(design).unwrap();
    controller.step(3.0, 1.0);
    for (r, y) in [
        (f64::NAN, 1.0),
        (3.0, f64::NAN),
        (f64::INFINITY, 1.0),
        (f64::MAX, 1.0),
        (-f64::MAX, -f64::MAX),
        (f64::MAX, f64::MAX),
    ] {
        assert!(controller.step(r, y).is_finite());
    }
    let later = (0..20_000).map(|_| controller.step(3.0, 1.0)).last();
    assert!((later.unwrap() - 2.0).abs() < 1e-9, "{later:?}");
}

#[test]
fn anti_windup_sees_the_feedforward() {
    // The sum is limited, so the integral must not go on; without feedforward it may.
    let design = Design::new(Settings {
        u_min: -1.0,
        u_max: 1.0,
        ..pid(0.1, 0.1, 0.0)
    });
    let mut controller = PidController::new(design).unwrap();
    for _ in 0..1000 {
        assert_eq!(controller.step_with(1.0, 0.0, 2.0), 1.0);
    }
    let u = controller.step(1.0, 0.0);
    assert!((u - 0.1 - 0.001).abs() < 1e-12, "{u}");
}

#[test]
fn the_reference_ramps_from_the_first_output() {
    let design = Design {
        r_rate: 1000.0,
        ..Design::new(pid(1.0, f64::INFINITY, 0.0))
    };
    let mut controller = PidController::new(design).unwrap();
    for _ in 0..2 {
        let u: Vec<f64> = (0..3).map(|_| controller.step(100.0, 50.0)).collect();
        assert_eq!(u, [1.0, 2.0, 3.0]);
        controller.reset();
    }
}

#[test]
fn manual_works_without_a_measurement_and_is_slewed() {
    let design = Design::new(Settings {
        u_max: 2.0,
        slew: 500.0,
        ..pid(1.0, 1.0, 0.0)
    });
    let mut controller = PidController::new(design).unwrap();
    controller.step(1.0, 1.0);
    controller.set_manual(5.0).unwrap();
    let lost: Vec<f64> = (0..5).map(|_| controller.step(1.0, f64::NAN)).collect();
    assert_eq!(lost, [0.5, 1.0, 1.5, 2.0, 2.0]);
    controller.set_automatic();
    assert_eq!(controller.step(1.0, 1.0), 2.0);
    assert_eq!(controller.set_manual(f64::NAN).unwrap_err().name, "manual");
    controller.set_manual(1.0).unwrap();
    controller.reset();
    assert!(!controller.is_manual());
}

#[test]
fn a_change_that_is_refused_changes_nothing() {
    let design = Design::new(pid(1.0, 1.0, 0.0));
    let mut controller = PidController::new(design).unwrap();
    let slower = Settings {
        ts: 2e-3,
        ..design.pid
    };
    assert_eq!(
        controller.set_design(Design::new(slower)).unwrap_err().name,
        "Ts"
    );
    let bad = Design {
        observer_time: -1.0,
        ..design
    };
    assert_eq!(
        controller.set_design(bad).unwrap_err().name,
        "observer_time"
    );
    assert_eq!(controller.design(), &design);
}

#[test]
fn refuses_what_its_parts_refuse() {
    let good = Design::new(pid(1.0, 1.0, 0.0));
    let refused = |design| PidController::<f64>::new(design).unwrap_err().name;
    let r_rate = 0.0;
    assert_eq!(refused(Design { r_rate, ..good }), "r_rate");
    let filter_samples = 65;
    assert_eq!(
        refused(Design {
            filter_samples,
            ..good
        }),
        "filter_samples"
    );
    let filter_time = f64::NAN;
    assert_eq!(
        refused(Design {
            filter_time,
            ..good
        }),
        "filter_time"
    );
    let observer_time = f64::INFINITY;
    assert_eq!(
        refused(Design {
            observer_time,
            ..good
        }),
        "observer_time"
    );
}

/// Everything switched on.
fn whole() -> Design<Counted> {
    let c = Counted;
    let gains = |kp| Standard {
        kp: c(kp),
        ti: c(0.2),
        td: c(0.004),
    };
    let points: Vec<_> = (0..8)
        .map(|i| Point {
            speed: c(300.0 * f64::from(i)),
            gains: gains(0.01 + 0.002 * f64::from(i)),
        })
        .collect();
    Design {
        pid: Settings {
            alpha: c(0.4),
            beta: c(0.2),
            n: c(8.0),
            tt: c(0.05),
            u_min: c(-10.0),
            u_max: c(10.0),
            slew: c(2000.0),
            ..Settings::new(gains(0.02), c(1e-3))
        },
        filter_samples: 8,
        filter_time: c(0.002),
        observer_time: c(0.004),
        r_rate: c(5000.0),
        schedule: Schedule::new(&points).unwrap(),
        biquads: Cascade::new(&[section((40.0, 0.2, 70.0, 0.5, 3)); 4]).unwrap(),
        feedforward: Feedforward::NONE,
    }
}

/// Operations of each step over inputs of every kind.
fn costs(design: Design<Counted>, manual: bool) -> (Vec<u64>, Vec<u64>) {
    let mut controller = PidController::new(design).unwrap();
    let (mut taken, mut skipped) = (Vec::new(), Vec::new());
    let values = [
        0.0,
        -0.0,
        1e-300,
        3.0,
        -5e3,
        1e9,
        -1e300,
        f64::INFINITY,
        f64::NAN,
    ];
    for round in 0..60_usize {
        if manual && round == 20 {
            controller.set_manual(Counted(7.0)).unwrap();
        }
        for (i, &r) in values.iter().enumerate() {
            for &y in &values[..] {
                let y = if round % 2 == 0 {
                    y
                } else {
                    y.clamp(-1e3, 2e3)
                };
                let feedforward = values[(i + round) % values.len()];
                let [r, y, feedforward] = [r, y, feedforward].map(Counted);
                let count = operations(|| {
                    controller.step_with(r, y, feedforward);
                });
                let finite = [r, y, feedforward].iter().all(|x| x.0.abs() < 1e10);
                if finite { &mut taken } else { &mut skipped }.push(count);
            }
        }
    }
    (taken, skipped)
}

#[test]
fn a_step_costs_the_same_whatever_comes() {
    let constant = Design {
        schedule: Schedule::NONE,
        biquads: Cascade::NONE,
        ..whole()
    };
    let plain = Design::new(Settings {
        tt: Counted(0.0),
        ..whole().pid
    });
    for (design, most) in [(whole(), 240), (constant, 125), (plain, 95)] {
        for manual in [false, true] {
            let (taken, skipped) = costs(design, manual);
            let first = taken[0];
            assert!(first <= most, "{first}");
            let (least, dearest) = (taken.iter().min(), taken.iter().max());
            assert_eq!((least, dearest), (Some(&first), Some(&first)));
            assert!(skipped.iter().max() <= Some(&first));
        }
    }
}

// Golden bits of filter and PID alone: parts that are switched off do not change them.

/// Numbers from -1 to 1, always the same.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// FNV-1a over 64-bit words.
fn hash(sum: u64, word: u64) -> u64 {
    (sum ^ word).wrapping_mul(0x0100_0000_01b3)
}

/// Reference and output of sample `k`: steps, noise, lost measurements.
fn sample(noise: &mut Noise, k: u32) -> (f64, f64) {
    let r = f64::from(k / 150 % 3) * 700.0 - 200.0;
    let y = 600.0 + 900.0 * noise.next();
    (r, if k % 97 == 96 { f64::NAN } else { y })
}

macro_rules! golden {
    ($name:ident $float:ident $made:ident) => {
        fn $name() -> u64 {
            let (mut sum, mut noise) = (0xcbf2_9ce4_8422_2325, Noise(88_172_645_463_325_252));
            let inf = $float::INFINITY;
            for (kp, ti, td) in [(0.02, 0.25, 0.004), (0.02, inf, 0.0), (-0.3, 0.01, 0.1)] {
                for (n, tt, slew) in [(inf, 0.0, inf), (8.0, 0.05, 2e3), (3.0, inf, 5e4)] {
                    for (samples, time) in [(1, 0.0), (8, 0.0), (64, 0.003)] {
                        let gains = Standard { kp, ti, td };
                        let settings = Settings {
                            alpha: 0.4,
                            beta: -0.7,
                            n,
                            tt,
                            slew,
                            u_min: -12.0,
                            u_max: 15.0,
                            ..Settings::new(gains, 1e-3)
                        };
                        let mut controller = $made(settings, samples, time);
                        for k in 0..700 {
                            let (r, y) = sample(&mut noise, k);
                            let u = controller.step(r as $float, y as $float);
                            sum = hash(sum, u.to_bits().into());
                            sum = hash(sum, controller.filtered().to_bits().into());
                        }
                    }
                }
            }
            sum
        }
    };
}

fn made<T: Real>(pid: Settings<T>, filter_samples: usize, filter_time: T) -> PidController<T> {
    let design = Design {
        filter_samples,
        filter_time,
        ..Design::new(pid)
    };
    PidController::new(design).unwrap()
}

golden!(double f64 made);
golden!(single f32 made);

#[test]
fn filter_and_pid_alone_give_these_bits() {
    assert_eq!(double(), 0x8849_10b4_fd16_f95c);
    assert_eq!(single(), 0x5552_cc79_5b9a_2f65);
}
