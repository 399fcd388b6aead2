//! Plans against exact inverses, answers against long runs, learning on machines that differ from the models.

use std::sync::OnceLock;

use proptest::prelude::*;
use sewfast_control::{Design, Feedforward, Level, PidController, Settings, Standard};

use super::*;
use crate::closed_loop::{LaggedPlant, Varied};
use crate::linear::LinearModel;

const TS: f64 = 1e-3;

fn settings() -> Settings<f64> {
    let gains = Standard {
        kp: 4e-3,
        ti: 0.06,
        td: 0.0,
    };
    Settings {
        u_min: -20.0,
        u_max: 20.0,
        ..Settings::new(gains, TS)
    }
}

fn pid(settings: Settings<f64>, feedforward: Feedforward<f64>) -> AnyController<f64> {
    let design = Design {
        filter_samples: 4,
        feedforward,
        ..Design::new(settings)
    };
    PidController::new(design).unwrap().into()
}

/// Preview, levels and taps that fit [`lag`] roughly.
fn roughly() -> Feedforward<f64> {
    let levels = [
        Level {
            y: -4000.0,
            u: -8.0,
        },
        Level { y: 4000.0, u: 8.0 },
    ];
    Feedforward::new(4, 0.5, &levels, &[0.05, 0.04]).unwrap()
}

/// Gain 490, time constant 50 ms, three samples of delay.
fn lag(gain: f64) -> LinearModel {
    LinearModel::new(vec![-0.98], vec![9.8 * gain], 1, 3, 0.0).unwrap()
}

fn member<'a>(model: &'a LinearModel, controller: &AnyController<f64>) -> Member<'a> {
    let plant = Box::new(LaggedPlant::new(model, TS).unwrap());
    Member {
        plant,
        controller: controller.clone(),
        counted: true,
    }
}

fn trapezoid(top: f64) -> Vec<f64> {
    let at = |k: i32| f64::from((k - 60).min(400 - k).clamp(0, 120)) / 120.0 * top;
    (0..500).map(at).collect()
}

fn planned(members: &[Member<'_>], r: &[f64], preview: usize) -> Planned {
    plan(members, r, preview, 2, &Monitor::default()).unwrap()
}

#[test]
fn hats_add_up_to_the_lines_between_their_knots() {
    let knots = Knots::new(43, 5);
    let c: Vec<f64> = (0..knots.count()).map(|j| ((7 * j) % 5) as f64).collect();
    for (k, x) in knots.signal(&c).into_iter().enumerate() {
        let sum: f64 = c.iter().enumerate().map(|(j, c)| c * knots.hat(j, k)).sum();
        assert!((x - sum).abs() < 1e-12, "{k}: {x} {sum}");
        let reached = (0..knots.count()).filter(|&j| knots.hat(j, knots.early(k)) > 0.0);
        assert!(reached.into_iter().all(|j| knots.start(j) <= k));
    }
    assert_eq!(Knots::new(1, 30).count(), 1);
}

#[test]
fn a_table_removes_nearly_all_of_the_error_of_a_pid_and_of_a_rough_feedforward() {
    let (model, r) = (lag(1.0), trapezoid(2000.0));
    for (feedforward, preview) in [(Feedforward::NONE, 0), (roughly(), 4)] {
        let found = planned(
            &[member(&model, &pid(settings(), feedforward))],
            &r,
            preview,
        );
        let (before, after) = found.errors[0];
        assert!(before > 10.0 && after < before / 10.0, "{before} {after}");
        assert!(found.limited == 0.0 && !found.interrupted);
        assert!(found.u.iter().all(|u| u.abs() < 20.0));
    }
}

#[test]
fn what_a_plan_expects_is_what_its_loop_does() {
    use crate::closed_loop::{closed_loop, encoder};
    let (model, r) = (lag(1.0), trapezoid(2000.0));
    let mut controller = pid(settings(), roughly());
    let found = planned(&[member(&model, &controller)], &r, 4);
    // an encoder so fine that nothing is rounded
    let fine = encoder(1e7, 0.5).unwrap();
    let mut plant = LaggedPlant::new(&model, TS).unwrap();
    let monitor = Monitor::default();
    let run = closed_loop(
        &mut plant,
        &mut controller,
        &found.setpoint,
        fine.as_ref(),
        &monitor,
    );
    let run = run.unwrap();
    let off = run
        .y
        .iter()
        .zip(&found.y)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max);
    assert!(off < 0.1, "{off}");
}

#[test]
fn limits_are_kept_and_the_error_under_them_is_less_than_without_a_table() {
    let (model, r) = (lag(1.0), trapezoid(2000.0));
    let tight = Settings {
        u_min: -2.0,
        u_max: 5.0,
        ..settings()
    };
    let found = planned(&[member(&model, &pid(tight, Feedforward::NONE))], &r, 0);
    assert!(found.u.iter().all(|u| (-2.0..=5.0).contains(u)));
    let (before, after) = found.errors[0];
    assert!(
        found.limited > 0.02 && after < 0.9 * before,
        "{before} {after} {}",
        found.limited
    );
}

#[test]
fn several_members_share_a_table_that_is_best_for_their_mean() {
    let (slow, fast, r) = (lag(0.8), lag(1.2), trapezoid(2000.0));
    let controller = pid(settings(), Feedforward::NONE);
    let [own, other] = [&slow, &fast].map(|model| member(model, &controller));
    let alone = planned(&[member(&slow, &controller)], &r, 0);
    let both = planned(&[own, other], &r, 0);
    let of_both = |table: &[f64]| -> f64 {
        let each = [&slow, &fast].map(|model| {
            let member = member(model, &controller);
            let ran = Ran::new(&member, Knots::new(r.len(), 0), table).unwrap();
            rmse(&r, &ran.y).powi(2)
        });
        each.iter().sum()
    };
    assert!(of_both(&both.setpoint) < of_both(&alone.setpoint));
    assert!(both.errors.iter().all(|(before, after)| after < before));
}

#[test]
fn the_same_bits_come_from_any_number_of_threads() {
    let (slow, fast, r) = (lag(0.8), lag(1.2), trapezoid(2000.0));
    let controller = pid(settings(), roughly());
    let members = [&slow, &fast].map(|model| member(model, &controller));
    let monitor = Monitor::default();
    let [one, three] = [1, 3].map(|threads| plan(&members, &r, 4, threads, &monitor).unwrap());
    assert_eq!(one.setpoint, three.setpoint);
    let [one, three] = [1, 3].map(|threads| {
        let learner = Learner::new(&members, &r, &one.setpoint, 4, threads, &monitor).unwrap();
        learner.next(&vec![0.0; learner.size()], &r, 1.0).unwrap()
    });
    assert_eq!(one, three);
}

/// A table that is planned on four models, and what learns from it: the same for every machine, so it is made once.
fn taught(early: bool) -> &'static (Vec<f64>, Learner) {
    static TAUGHT: [OnceLock<(Vec<f64>, Learner)>; 2] = [const { OnceLock::new() }; 2];
    TAUGHT[usize::from(early)].get_or_init(|| {
        let (model, r, monitor) = (lag(1.0), trapezoid(2000.0), Monitor::default());
        let variants = [(1.0, 0), (0.8, 0), (1.25, 0), (1.0, 1)];
        let models = variants.map(|(gain, delay)| varied(&model, gain, delay, early));
        let preview = if early { 4 } else { 0 };
        let table = planned(&models, &r, preview).setpoint;
        let learner = Learner::new(&models, &r, &table, preview, 2, &monitor).unwrap();
        assert!(learner.contraction < 1.0);
        (table, learner)
    })
}

fn varied(model: &LinearModel, gain: f64, delay: usize, early: bool) -> Member<'_> {
    let plant = Varied::new(LaggedPlant::new(model, TS).unwrap(), gain, delay).unwrap();
    let feedforward = if early { roughly() } else { Feedforward::NONE };
    Member {
        plant: Box::new(plant),
        controller: pid(settings(), feedforward),
        counted: true,
    }
}

/// Errors of repetitions on a machine.
fn learned(machine: &Member<'_>, early: bool) -> Vec<f64> {
    let ((table, learner), r) = (taught(early), trapezoid(2000.0));
    let mut c = vec![0.0; learner.size()];
    let mut errors = Vec::new();
    for _ in 0..12 {
        let played = added(table, &learner.signal(&c).unwrap());
        let ran = Ran::new(machine, learner.knots, &played).unwrap();
        errors.push(rmse(&r, &ran.y));
        c = learner.next(&c, &ran.error(&r), 1.0).unwrap().0;
    }
    errors
}

proptest! {
    #![proptest_config(crate::laws::cases(12))]
    #[test]
    fn learning_removes_what_the_models_do_not_know(gain in 0.7f64..1.4, delay in 0usize..2, early: bool) {
        let model = lag(1.0);
        let errors = learned(&varied(&model, gain, delay, early), early);
        let (first, last) = (errors[0], errors[11]);
        prop_assert!(last <= first && last < 12.0, "{:?}", errors);
    }
}

#[test]
fn a_move_that_stands_needs_no_correction() {
    let model = lag(1.0);
    let r = vec![0.0; 50];
    let found = planned(
        &[member(&model, &pid(settings(), Feedforward::NONE))],
        &r,
        0,
    );
    assert_eq!(found.setpoint, r);
}

#[test]
fn what_no_table_can_be_made_of_is_refused() {
    let (model, monitor) = (lag(1.0), Monitor::default());
    let one = [member(&model, &pid(settings(), Feedforward::NONE))];
    let refused = |members: &[Member<'_>], r: &[f64]| plan(members, r, 0, 1, &monitor).unwrap_err();
    refused(&[], &[1.0; 9]);
    refused(&one, &[]);
    refused(&one, &[0.0, f64::NAN]);
    // a loop with too large a gain
    let wild = Settings {
        u_min: f64::NEG_INFINITY,
        u_max: f64::INFINITY,
        ..settings()
    };
    let wild = Settings {
        gains: Standard {
            kp: 10.0,
            ti: 0.06,
            td: 0.0,
        },
        ..wild
    };
    refused(
        &[member(&model, &pid(wild, Feedforward::NONE))],
        &trapezoid(1.0),
    );
    let r = trapezoid(100.0);
    assert!(Learner::new(&one, &r, &r[1..], 0, 1, &monitor).is_err());
    assert!(Learner::new(&one, &[0.0; 99], &[0.0; 99], 0, 1, &monitor).is_err());
    let learner = Learner::new(&one, &r, &r, 0, 1, &monitor).unwrap();
    let zero = vec![0.0; learner.size()];
    assert!(learner.next(&zero, &[0.0; 3], 1.0).is_err());
    assert!(learner.next(&zero[1..], &[0.0; 500], 1.0).is_err());
    assert!(learner.signal(&[f64::NAN]).is_err());
    // samples that were not measured count as no error
    let (next, left) = learner.next(&zero, &[f64::NAN; 500], 1.0).unwrap();
    assert!(next == zero && left.iter().all(|e| *e == 0.0));
}

#[test]
fn a_stop_request_keeps_what_there_is() {
    let (model, r, monitor) = (lag(1.0), trapezoid(2000.0), Monitor::default());
    let one = [member(&model, &pid(settings(), Feedforward::NONE))];
    monitor.request_stop();
    let found = plan(&one, &r, 0, 1, &monitor).unwrap();
    assert!(found.interrupted && found.setpoint == r);
}

#[test]
fn a_rehearsal_contracts_if_its_changes_shrink_and_no_error_grows() {
    let good = Some(vec![(9.0, 4.0), (5.0, 2.0), (4.0, 1.5)]);
    let small = Some(vec![(1.0, 0.1), (1.2, 0.15)]);
    assert_eq!(contraction(&[good.clone(), small]), 0.75);
    let grown = Some(vec![(9.0, 4.0), (9.5, 2.0)]);
    assert_eq!(contraction(&[good.clone(), grown]), f64::INFINITY);
    assert_eq!(contraction(&[good, None]), f64::INFINITY);
}
