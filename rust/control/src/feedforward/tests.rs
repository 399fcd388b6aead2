//! The feedforward compared with its definition, in a loop with a known plant, and what it refuses.

use super::*;
use crate::{Design, PidController, Settings, Standard};
use proptest::prelude::*;
use std::vec::Vec;

fn levels() -> [Level<f64>; 4] {
    [(-9.0, -4.0), (-0.1, -1.0), (0.1, 1.0), (9.0, 6.0)].map(|(y, u)| Level { y, u })
}

fn design(feedforward: Feedforward<f64>) -> Design<f64> {
    let gains = Standard {
        kp: 0.4,
        ti: 0.05,
        td: 0.01,
    };
    Design {
        filter_samples: 5,
        filter_time: 2e-3,
        feedforward,
        ..Design::new(Settings {
            u_min: -50.0,
            u_max: 50.0,
            ..Settings::new(gains, 1e-3)
        })
    }
}

#[test]
fn a_level_is_held_by_its_command_and_the_ends_go_on_straight() {
    let of = Feedforward::new(0, 0.0, &levels(), &[]).unwrap();
    for level in levels() {
        assert_eq!(of.held(level.y), level.u);
    }
    assert_eq!(of.held(0.0), 0.0);
    assert!((of.held(18.0) - (6.0 + 9.0 * 5.0 / 8.9)).abs() < 1e-12);
    assert!((of.held(-18.0) - (-4.0 - 9.0 * 3.0 / 8.9)).abs() < 1e-12);
    let one = Feedforward::new(0, 0.0, &levels()[..1], &[]).unwrap();
    assert_eq!([one.held(-100.0), one.held(100.0)], [-4.0; 2]);
}

#[test]
fn the_exact_inverse_follows_any_reference_with_no_work_left_for_the_pid() {
    // y(k+1) = a y(k) + b u(k-2), measured through the controller's filter: a preview of 3 samples
    let (a, b) = (0.98, 0.5);
    let levels = [-10.0, 10.0].map(|y: f64| Level {
        y,
        u: y * (1.0 - a) / b,
    });
    // u(k) = (r(k+3) - a r(k+2))/b = (1-a)/b r(k+3) + a/b (r(k+3) - r(k+2))
    let of = Feedforward::new(3, 0.0, &levels, &[a / b]).unwrap();
    let mut controller = PidController::new(design(of)).unwrap();
    let r: Vec<f64> = (0..400)
        .map(|k| {
            f64::from((k - 20).clamp(0, 100)) * 0.1 + (0.05 * f64::from((k - 20).max(0))).sin()
        })
        .map(|r| r.clamp(0.0, 9.0))
        .collect();
    let (mut y, mut late) = (r[0], [0.0; 2]);
    late.fill(of.held(r[0]));
    for k in 0..r.len() - 3 {
        let u = controller.step(r[k + 3], y);
        if k > 3 {
            assert!((y - r[k]).abs() < 1e-9, "{k}: {y} {}", r[k]);
        }
        y = a * y + b * late[0];
        late = [late[1], u];
    }
}

#[test]
fn a_lost_measurement_or_reference_costs_its_sample_only() {
    let of = Feedforward::new(4, 0.5, &levels(), &[0.3, 0.1]).unwrap();
    let [mut whole, mut torn] = [design(of); 2].map(|d| PidController::new(d).unwrap());
    let r = |k: usize| 0.02 * k as f64;
    for k in 0..300 {
        let u = whole.step(r(k), r(k));
        let given = if k == 100 { f64::NAN } else { r(k) };
        let measured = if (150..153).contains(&k) {
            f64::NAN
        } else {
            r(k)
        };
        let v = torn.step(given, measured);
        assert!(v.is_finite());
        // 32 samples later nothing of either is left but what the integral took meanwhile
        if k == 299 {
            assert!((u - v).abs() < 0.2, "{u} {v}");
        }
    }
}

#[test]
fn references_near_the_largest_number_are_forgotten() {
    let of = Feedforward::new(4, 0.5, &levels(), &[0.3, 0.1]).unwrap();
    let [mut calm, mut shaken] = [design(of); 2].map(|d| PidController::new(d).unwrap());
    for k in 0..400 {
        let r = if (20..23).contains(&k) { 1.7e308 } else { 3.0 };
        let (u, v) = (calm.step(3.0, 3.0), shaken.step(r, 3.0));
        // once the ring has lost them, what is left is in the integral
        assert!(v.is_finite() && (k < 60 || v < 50.0), "{k}: {v}");
        assert!(k < 399 || (u - v).abs() < 1.0, "{u} {v}");
    }
}

#[test]
fn a_change_of_feedforward_while_the_reference_stands_makes_no_bump() {
    let first = Feedforward::new(4, 0.5, &levels(), &[0.3, 0.1]).unwrap();
    let other = Feedforward::new(9, 0.0, &levels()[1..], &[0.7]).unwrap();
    for (from, to) in [
        (Feedforward::NONE, first),
        (first, Feedforward::NONE),
        (first, other),
        (
            first,
            Feedforward::new(4, 0.5, &levels()[..2], &[0.2]).unwrap(),
        ),
    ] {
        let mut controller = PidController::new(design(from)).unwrap();
        let before = (0..60).map(|_| controller.step(3.0, 3.0)).last().unwrap();
        controller.set_design(design(to)).unwrap();
        for _ in 0..60 {
            let u = controller.step(3.0, 3.0);
            assert!((u - before).abs() < 1e-12, "{u} {before}");
        }
    }
}

#[test]
fn what_cannot_be_is_refused_by_its_name() {
    let level = |y, u| Level { y, u };
    let refused = |preview, late, levels: &[Level<f64>], taps: &[f64]| {
        let refused = Feedforward::new(preview, late, levels, taps).unwrap_err();
        assert_eq!(refused.name, "feedforward");
        refused.expected
    };
    let one = [level(1.0, 2.0)];
    assert!(refused(31, 0.0, &one, &[]).contains("preview"));
    assert!(refused(0, 1.5, &one, &[]).contains("late"));
    assert!(refused(0, f64::NAN, &one, &[]).contains("late"));
    assert!(refused(0, 0.0, &[], &[]).contains("at least one"));
    assert!(refused(0, 0.0, &[level(0.0, 0.0); 9], &[]).contains("at most"));
    assert!(refused(0, 0.0, &one, &[0.0; 17]).contains("at most"));
    assert!(refused(0, 0.0, &one, &[f64::INFINITY]).contains("taps"));
    assert!(refused(0, 0.0, &[level(f64::NAN, 0.0)], &[]).contains("outputs"));
    assert!(refused(0, 0.0, &[level(0.0, f64::NAN)], &[]).contains("commands"));
    assert!(refused(0, 0.0, &[level(1.0, 0.0); 2], &[]).contains("growing"));
    let steep = [level(0.0, -1e300), level(1e-300, 1e300)];
    assert!(refused(0, 0.0, &steep, &[]).contains("growing"));
}

proptest! {
    /// Taken before a loop, the reference's way gives the bits that it has within the loop.
    #[test]
    fn the_way_of_the_reference_is_the_same_before_a_loop_and_within(
        r in prop::collection::vec(-5.0..5.0_f64, 40..80),
        noise in prop::collection::vec(-1.0..1.0_f64, 80),
        preview in 0..=AHEAD, late in 0.0..=1.0_f64,
        taps in prop::collection::vec(-2.0..2.0_f64, 0..=TAPS),
        rate in prop_oneof![Just(f64::INFINITY), 10.0..1e3_f64],
        samples in 1..=64_usize,
    ) {
        let of = Feedforward::new(preview, late, &levels(), &taps).unwrap();
        let whole = Design { filter_samples: samples, r_rate: rate, ..design(of) };
        let mut within = PidController::new(whole).unwrap();
        let mut lead = within.clone();
        let mut rest = PidController::new(within.without_lead()).unwrap();
        let first = lead.first_filtered(noise[0]);
        for (r, y) in r.iter().zip(&noise) {
            let (expected, own) = lead.lead(*r, first);
            let u = rest.step_with(expected, *y, own.unwrap());
            prop_assert_eq!(u.to_bits(), within.step(*r, *y).to_bits());
        }
    }
}
