//! The motor gets what was uploaded, and the host hears what the motor did.

use super::rig::*;
use crate::biquad::tests::{any_section, section};
use crate::link::{Body, Fields, Reason, State};
use crate::{
    Biquad, Cascade, Design, Feedforward, Level, PidController, Point, STATES, Schedule, Settings,
    Standard, StateDesign, StateFeedback, Weights, lqg,
};
use proptest::prelude::*;
use std::vec;
use std::vec::Vec;

proptest! {
    /// In any pieces: overlapping, repeated, refused for lack of room and sent again, while it plays.
    #[test]
    fn a_profile_plays_as_uploaded(
        values in prop::collection::vec(-9_000i16..9_000, 1..300),
        pieces in prop::collection::vec((1usize..=40, 0usize..60, any::<bool>(), 1usize..12), 1..200),
        batch in 1u8..20,
    ) {
        let mut rig = Rig::armed();
        let first = values.len().min(CAPACITY);
        prop_assert_eq!(rig.upload(0, &values[..first]).0, 0);
        let body = start(0, 0, values.len() as u32, 0b11, batch);
        prop_assert_eq!(rig.command(0x0A, body.bytes().unwrap()).0, 0);
        let (mut end, mut played, mut log) = (first, Vec::new(), Vec::new());
        let mut pieces = pieces.into_iter().cycle();
        while played.len() < values.len() {
            let (count, back, repeated, play) = pieces.next().unwrap();
            let from = end.saturating_sub(back);
            let room = CAPACITY - (end - played.len());
            let to = (end + count.min(room)).min(values.len());
            let piece = &values[from..to];
            let answer = rig.upload(from as u32, piece);
            end = to;
            let room = (CAPACITY - (end - played.len())) as u32;
            let expected = [end as u32, room].map(u32::to_le_bytes).concat();
            prop_assert_eq!(&answer, &(0, expected));
            if repeated {
                let body = upload(from as u32, piece);
                prop_assert_eq!(rig.again(0x08, body.bytes().unwrap()), Some(answer));
            }
            for _ in 0..play.min(end - played.len()) {
                rig.keep();
                rig.counts += 7;
                let output = rig.sample();
                prop_assert!(output.enabled);
                played.push((output.u * 1000.0).round() as i16);
                log.push((rig.now, rig.counts, values[log.len()]));
            }
        }
        prop_assert_eq!(&played, &values);
        rig.keep();
        prop_assert!(!rig.sample().enabled);
        prop_assert_eq!(rig.device.state(), State::Idle);
        prop_assert_eq!(rig.sent(), log);
        prop_assert_eq!(rig.events().pop(), Some((4, 0)));
    }

    /// The device's controller is the crate's own, with its command in whole steps.
    #[test]
    fn the_pid_is_the_controller(
        references in prop::collection::vec(0f32..3000.0, 1..60),
        moves in prop::collection::vec(-60i32..90, 60),
        filter in 1u8..20,
        kp in 0.001f32..0.05, ti in 0.01f32..1.0, td in 0f32..0.01, tt in prop_oneof![Just(0f32), 0.01f32..1.0],
        observer in prop_oneof![Just(0f32), 0.001f32..0.02], rate in prop_oneof![Just(INF), 100f32..1e5],
        kps in prop::collection::vec(0.001f32..0.05, 0..=8), long: bool,
        given in prop::collection::vec(any_section(), 0..=4),
        ahead in 0..=30_u8, taps in prop::collection::vec(-0.01_f32..0.01, 0..=16),
    ) {
        let per_unit = 25.0;
        let values = [kp, ti, td, 0.4, 0.2, 10.0, tt, -20.0, 8.0, 2000.0, 0.002, per_unit];
        let mut rig = Rig::armed();
        let points: Vec<[f32; 4]> =
            kps.iter().enumerate().map(|(i, &kp)| [400.0 * i as f32, kp, ti, td]).collect();
        let (observer_time, r_rate, points) = if long { (observer, rate, points) } else { (0.0, INF, vec![]) };
        let body = if long { design(values, filter, observer_time, r_rate, &points) } else { gains(values, filter) };
        prop_assert_eq!(rig.command(0x09, body.bytes().unwrap()).0, 0);
        let sections: Vec<Biquad<f32>> = given.into_iter().map(section).collect();
        if !sections.is_empty() {
            prop_assert_eq!(rig.command(0x0C, biquads(&sections).bytes().unwrap()).0, 0);
        }
        let levels = [[-100.0, -0.4], [2000.0, 4.2]];
        let body = feedforward(ahead, 0.5, &levels, &taps);
        prop_assert_eq!(rig.command(0x0E, body.bytes().unwrap()).0, 0);
        let levels = levels.map(|[y, u]| Level { y, u });
        let feedforward = Feedforward::new(ahead.into(), 0.5, &levels, &taps).unwrap();
        let points: Vec<_> = points
            .iter()
            .map(|&[speed, kp, ti, td]| Point { speed, gains: Standard { kp, ti, td } })
            .collect();
        prop_assert_eq!(rig.references(0, &references[..references.len().min(50)]).0, 0);
        if references.len() > 50 {
            prop_assert_eq!(rig.references(50, &references[50..]).0, 0);
        }
        let body = start(1, 0, references.len() as u32, 0b01_1011, 4);
        prop_assert_eq!(rig.command(0x0A, body.bytes().unwrap()).0, 0);
        let settings = Settings {
            alpha: 0.4, beta: 0.2, n: 10.0, tt, u_min: -10.0, u_max: 8.0, slew: 2000.0,
            ..Settings::new(Standard { kp, ti, td }, 1e-3)
        };
        let design = Design {
            pid: settings, filter_samples: filter.into(), filter_time: 0.002, observer_time, r_rate,
            schedule: Schedule::new(&points).unwrap(), biquads: Cascade::new(&sections).unwrap(), feedforward,
        };
        let mut controller = PidController::<f32>::new(design).unwrap();
        let mut expected = Vec::new();
        for (&reference, &count) in references.iter().zip(&moves) {
            rig.counts += count;
            rig.keep();
            let wanted = controller.step(reference, count as f32 / (1e-3 * per_unit));
            let u = (wanted * 1000.0).round() / 1000.0;
            prop_assert_eq!(rig.sample(), crate::link::Output { u, enabled: true });
            expected.push((reference.to_bits(), controller.filtered().to_bits()));
        }
        rig.watched(1);
        rig.listen();
        let mut heard = Vec::new();
        for came in rig.came.iter().filter(|came| came.header.kind == 0xC0) {
            let samples = (came.body.len() - 3) / 12;
            let mut fields = Fields::new(&came.body[1 + 2 + 4 * samples..]);
            let mut column = || (0..samples).map(|_| fields.u32().unwrap()).collect::<Vec<_>>();
            let (r, y) = (column(), column());
            heard.extend(r.into_iter().zip(y));
        }
        prop_assert_eq!(heard, expected);
    }
}

/// A motor of 490 RPM/V with state feedback, as sent by a host.
fn state_feedback() -> StateDesign<f64> {
    let none = [0.0; STATES];
    let weights = Weights {
        rho: 2e5,
        integral: 20.0,
        noise: 2e5,
        reference: 0.9,
    };
    let plant = StateDesign {
        a: [-1.869_639_6, 0.870_140_2, 0.0, 0.0],
        b: [0.12265, 0.12265, 0.0, 0.0],
        k: none,
        l: none,
        rest: none,
        kr: 0.0,
        ki: 0.0,
        lead: 2e-3,
        r_rate: 1e5,
        u_min: -20.0,
        u_max: 8.0,
        slew: 2000.0,
        ts: 1e-3,
        weights,
    };
    lqg(plant, weights).unwrap()
}

/// The body of CONTROLLER.
fn kind(number: u8, per_unit: f32, numbers: &[f32]) -> Body {
    let mut body = Body::new();
    body.u8(number).f32(per_unit);
    for &x in numbers {
        body.f32(x);
    }
    body
}

proptest! {
    #[test]
    fn state_feedback_is_the_controller_too(
        references in prop::collection::vec(0f32..3000.0, 1..50),
        moves in prop::collection::vec(-60i32..90, 50),
    ) {
        let (design, per_unit) = (state_feedback().single(), 25.0);
        let mut rig = Rig::armed();
        let body = kind(1, per_unit, &design.numbers());
        prop_assert_eq!(rig.command(0x0D, body.bytes().unwrap()).0, 0);
        prop_assert_eq!(rig.references(0, &references).0, 0);
        let body = start(1, 0, references.len() as u32, 0b01_1011, 4);
        prop_assert_eq!(rig.command(0x0A, body.bytes().unwrap()).0, 0);
        // the session's volt limit clips what the host allows
        let clipped = StateDesign { u_min: -10.0, ..design };
        let mut controller = StateFeedback::new(clipped).unwrap();
        for (&reference, &count) in references.iter().zip(&moves) {
            rig.counts += count;
            rig.keep();
            let wanted = controller.step_with(reference, count as f32 / (1e-3 * per_unit), -0.0);
            let u = (wanted * 1000.0).round() / 1000.0;
            prop_assert_eq!(rig.sample(), crate::link::Output { u, enabled: true });
        }
    }
}

#[test]
fn another_controller_is_refused_by_its_field() {
    let numbers = state_feedback().single().numbers();
    let mut rig = Rig::armed();
    let mut sent = |number, per_unit, change: Option<(usize, f32)>| {
        let mut numbers = numbers;
        if let Some((place, value)) = change {
            numbers[place] = value;
        }
        let body = kind(number, per_unit, &numbers);
        let answer = rig.command(0x0D, body.bytes().unwrap());
        let detail = answer.1.try_into().map_or(0, u32::from_le_bytes);
        (answer.0, detail)
    };
    assert_eq!(sent(7, 25.0, None), (3, 0));
    assert_eq!(sent(1, 0.0, None), (3, 1));
    for (place, value, field) in [
        (1, f32::NAN, 0),
        (9, INF, 8),
        (21, INF, 20),
        (23, 0.0, 23),
        (24, 9.0, 25),
        (26, -1.0, 26),
    ] {
        assert_eq!(sent(1, 25.0, Some((place, value))), (3, field + 2));
    }
    assert_eq!(sent(1, 25.0, Some((25, -15.0))).0, 6);
    assert_eq!(sent(1, 25.0, None), (0, 0));
    let short = kind(1, 25.0, &numbers[1..]);
    assert_eq!(rig.command(0x0D, short.bytes().unwrap()).0, 2);
    let sections = [Biquad::notch(60.0, 0.1, 0.5, 1e-3).unwrap()];
    assert_eq!(rig.command(0x0C, biquads(&sections).bytes().unwrap()).0, 3);
    let body = feedforward(0, 0.0, &[], &[0.01]);
    assert_eq!(rig.command(0x0E, body.bytes().unwrap()).0, 3);
}

#[test]
fn a_profile_that_runs_dry_trips() {
    let mut rig = Rig::armed();
    rig.upload(0, &[1000; 5]);
    rig.start(0, 0, 10);
    for _ in 0..5 {
        assert!(rig.sample().enabled);
    }
    assert!(!rig.sample().enabled);
    assert_eq!(rig.device.reason(), Reason::Underrun);
    assert_eq!(rig.sent().len(), 5);
}

#[test]
fn a_run_starts_when_its_reply_says() {
    for (ahead, periods) in [(0, 1), (1, 1), (1000, 1), (1001, 2), (7_500, 8)] {
        let mut rig = Rig::armed();
        rig.upload(0, &[1000; 5]);
        let at = if ahead == 0 { 0 } else { rig.now + ahead };
        let (result, body) = rig.start(0, at, 5);
        let begins = rig.now + periods * PERIOD;
        assert_eq!((result, &body[4..]), (0, &begins.to_le_bytes()[..]));
        rig.watched(periods as usize + 5);
        let times: Vec<u64> = rig.sent().iter().map(|sample| sample.0).collect();
        let expected: Vec<u64> = (0..5).map(|k| begins + k * PERIOD).collect();
        assert_eq!(times, expected);
    }
}

#[test]
fn jitter_does_not_move_the_samples_times() {
    let mut rig = Rig::armed();
    rig.upload(0, &[1000; 20]);
    rig.start(0, 0, 20);
    let begin = rig.now;
    for k in 1..=20 {
        rig.keep();
        rig.sample_at(begin + k * PERIOD + 37 * (k % 5));
    }
    let times: Vec<u64> = rig.sent().iter().map(|sample| sample.0).collect();
    assert_eq!(
        times,
        (1..=20).map(|k| begin + k * PERIOD).collect::<Vec<_>>()
    );
}

#[test]
fn a_profile_plays_twice() {
    let mut rig = Rig::ready();
    rig.upload(0, &[1000, 2000, 3000]);
    for _ in 0..2 {
        assert_eq!(rig.arm().0, 0);
        assert_eq!(rig.start(0, 0, 3).0, 0);
        let played: Vec<f32> = (0..4).map(|_| rig.sample().u).collect();
        assert_eq!(played, [1.0, 2.0, 3.0, 0.0]);
    }
}

#[test]
fn uploads_are_taken_whole_or_not_at_all() {
    let mut rig = Rig::ready();
    let many = [0; CAPACITY + 1];
    let fits = (CAPACITY as u32).to_le_bytes().to_vec();
    assert_eq!(rig.upload(0, &many), (7, fits));
    assert_eq!(rig.upload(1, &[1]), (9, vec![0; 4]));
    assert_eq!(rig.upload(0, &[1, 2]).0, 0);
    assert_eq!(rig.upload(3, &[1]), (9, vec![2, 0, 0, 0]));
    assert_eq!(rig.references(2, &[1.0]), (9, vec![0; 4]));
    assert_eq!(rig.upload(u32::MAX, &[1]), (9, vec![2, 0, 0, 0]));
    assert_eq!(
        rig.upload(1, &many[..CAPACITY]),
        (7, (CAPACITY as u32 - 1).to_le_bytes().to_vec())
    );
    assert_eq!(
        rig.command(0x08, &[0, 0, 0, 0, 0, 1]),
        (2, vec![6, 0, 0, 0])
    );
    assert_eq!(rig.command(0x08, &[3, 0, 0, 0, 0]), (8, vec![0; 4]));
}

#[test]
fn starts_that_make_no_sense_are_refused_by_field() {
    let mut rig = Rig::armed();
    rig.upload(0, &[1000; 5]);
    let mut refused = |body: crate::link::Body| {
        let (result, body) = rig.command(0x0A, body.bytes().unwrap());
        (result, body[0])
    };
    assert_eq!(refused(start(4, 0, 5, 3, 10)), (3, 0));
    assert_eq!(refused(start(3, 0, 5, 3, 10)), (3, 3));
    assert_eq!(refused(start(1, 0, 5, 3, 10)), (3, 3));
    assert_eq!(refused(start(0, 0, 0, 3, 10)), (3, 3));
    assert_eq!(refused(start(0, 0, 5, 0x40, 10)), (3, 4));
    assert_eq!(refused(start(0, 0, 5, 3, 58)), (3, 5));
    assert_eq!(refused(start(0, 0, 5, 3, 0)), (3, 5));
    let mut short = start(0, 0, 5, 3, 10).bytes().unwrap().to_vec();
    short[1..5].copy_from_slice(&999u32.to_le_bytes());
    assert_eq!(rig.command(0x0A, &short), (3, vec![1, 0, 0, 0]));
    rig.references(0, &[1.0]);
    let body = start(1, 0, 1, 3, 10);
    let answer = rig.command(0x0A, body.bytes().unwrap());
    assert_eq!(answer, (3, vec![0; 4]), "no gains");
}

#[test]
fn the_batch_under_way_is_sent_when_the_run_ends() {
    let mut rig = Rig::driving(3.0);
    rig.watched(11);
    rig.stop();
    assert_eq!(rig.sent().len(), 13);
    let mut rig = Rig::driving(3.0);
    rig.samples(60);
    assert_eq!(rig.device.reason(), Reason::Watchdog);
    let sent = rig.sent();
    assert!(sent.windows(2).all(|pair| pair[1].0 - pair[0].0 == PERIOD));
    assert_eq!(sent.len(), 50);
}

#[test]
fn what_is_applied_is_in_whole_steps_and_within_the_limit() {
    let mut rig = Rig::ready();
    assert_eq!(rig.limits(9.9996, 4000.0, 1e9, 20.0).0, 0);
    rig.arm();
    rig.start(2, 0, 0);
    rig.sample();
    rig.drive(1.23456);
    assert_eq!(rig.sample().u, 1.235);
    for (wanted, applied) in [(50.0, 9.999), (-50.0, -9.999), (-0.0004, 0.0)] {
        rig.drive(wanted);
        assert_eq!(rig.sample().u, applied);
    }
}
