//! Goals, stops at an angle and the limits of the position.

use super::rig::*;
use crate::link::identity::capability as can;
use crate::link::{Fields, Identity, Reason, State, Travel};
use crate::{
    Controller, Design, FARTHEST, Feedforward, Level, PidController, PositionDesign, PositionLoop,
    Rate, Rates, Settings, Standard, Turning,
};
use proptest::prelude::*;
use std::vec;
use std::vec::Vec;

const TURN: f32 = 1500.0;
const PER: f32 = TURN / 60.0;
const LEVELS: [[f32; 2]; 2] = [[-5000.0, -10.0], [5000.0, 10.0]];
const TAPS: [f32; 1] = [0.1];
const ROWS: [[f32; 3]; 2] = [[0.0, 9000.0, 11_000.0], [1500.0, 6000.0, 14_000.0]];
const MOVES: [f32; 4] = [30.0, 3000.0, 12.0, 60.0];

/// A motor with dry friction and a time constant of 50 ms, in RPM, and an encoder of 1500 counts.
struct Motor {
    y: f64,
    position: f64,
    before: i64,
}

impl Motor {
    fn new() -> Self {
        Self {
            y: 0.0,
            position: 0.5,
            before: 0,
        }
    }

    /// Counts since the last call.
    fn moved(&mut self) -> i32 {
        let counts = self.position.floor() as i64;
        (counts - std::mem::replace(&mut self.before, counts)) as i32
    }

    fn advance(&mut self, u: f32) {
        let u = f64::from(u);
        let held = self.y == 0.0 && u.abs() <= 0.2;
        let way = if self.y == 0.0 { u } else { self.y };
        let drive = if held { 0.0 } else { u - 0.2_f64.copysign(way) };
        let y = self.y + 1e-3 * (500.0 * drive - self.y) / 0.05;
        let y = if y * self.y < 0.0 { 0.0 } else { y };
        self.position += 0.5e-3 * (self.y + y) * 25.0;
        self.y = y;
    }
}

fn speed_loop() -> Design<f32> {
    let gains = Standard {
        kp: 0.01,
        ti: 0.03,
        td: 0.0,
    };
    let limits = Settings {
        u_min: -10.0,
        u_max: 10.0,
        ..Settings::new(gains, 1e-3)
    };
    let levels = LEVELS.map(|[y, u]| Level { y, u });
    Design {
        feedforward: Feedforward::new(1, 0.5, &levels, &TAPS).unwrap(),
        ..Design::new(limits)
    }
}

fn law() -> Turning {
    let rows = ROWS.map(|[speed, up, down]| Rate { speed, up, down });
    let [gain, speed, landing, creep] = MOVES;
    let design = PositionDesign {
        gain,
        counts_per_unit: PER,
        speed,
        rates: Rates::new(&rows).unwrap(),
        smoothing: 8,
        landing,
        creep,
        releases: false,
    };
    let speed = PidController::new(speed_loop()).unwrap();
    Turning::new(PositionLoop::new(design, speed).unwrap())
}

impl Rig {
    fn moves(&mut self, numbers: [f32; 4], smoothing: u8, rows: &[[f32; 3]]) -> (u8, Vec<u8>) {
        let body = position(numbers, smoothing, 0, rows);
        self.command(0x0F, body.bytes().unwrap())
    }

    fn turn_to(&mut self, at: u32, counts: f32, way: u8) -> (u8, Vec<u8>) {
        let body = angle(at, counts, way);
        self.command(0x10, body.bytes().unwrap())
    }

    fn travel(&mut self, low: i32, high: i32) -> (u8, Vec<u8>) {
        self.command(0x11, travel(low, high).bytes().unwrap())
    }

    /// With the position loop of [`law`].
    fn positioned() -> Self {
        Self::ready().with_moves()
    }

    fn with_moves(mut self) -> Self {
        self.set_gains();
        assert_eq!(self.moves(MOVES, 8, &ROWS).0, 0);
        self
    }

    fn set_gains(&mut self) {
        let (design, s) = (speed_loop(), speed_loop().pid);
        let values = [
            s.gains.kp,
            s.gains.ti,
            s.gains.td,
            s.alpha,
            s.beta,
            s.n,
            s.tt,
            s.u_min,
            s.u_max,
            s.slew,
            design.filter_time,
            PER,
        ];
        let body = gains(values, design.filter_samples as u8);
        assert_eq!(self.command(0x09, body.bytes().unwrap()).0, 0);
        let body = feedforward(1, 0.5, &LEVELS, &TAPS);
        assert_eq!(self.command(0x0E, body.bytes().unwrap()).0, 0);
    }

    /// Samples of a motor that turns as it is commanded; the profile, which stays behind, goes on.
    fn turns(&mut self, motor: &mut Motor, table: u8, values: &[f32]) -> usize {
        let (mut taken, mut end) = (0, 0);
        while taken < values.len() {
            if end < values.len() && end < taken + CAPACITY - 20 {
                let piece = &values[end..(end + 20).min(values.len())];
                assert_eq!(self.numbers(table, end as u32, piece).0, 0);
                end += piece.len();
                if end < values.len().min(CAPACITY - 20) {
                    continue;
                }
            }
            if taken == 0 && self.device.state() == State::Armed {
                let mode = if table == 1 { 1 } else { 3 };
                assert_eq!(self.start(mode, 0, values.len() as u32).0, 0);
            }
            self.keep();
            self.counts = self.counts.wrapping_add(motor.moved());
            let output = self.sample();
            if !output.enabled {
                break;
            }
            motor.advance(output.u);
            taken += 1;
        }
        // the end of the run, with the batch under way
        self.sample();
        taken
    }
}

/// Whole steps of the command, as a device rounds them.
fn steps(u: f32) -> i16 {
    (u * 1000.0).round_ties_even() as i16
}

/// The commands of the law over the counts of a run.
fn replayed(
    sent: &[(u64, i32, i16)],
    values: &[f32],
    stop: Option<(usize, f32)>,
) -> (Vec<i16>, Turning) {
    let mut law = law();
    if stop.is_none() {
        law.follow();
    }
    let mut before = sent[0].1;
    let steps = sent
        .iter()
        .zip(values)
        .enumerate()
        .map(|(k, (sample, &r))| {
            if let Some((at, angle)) = stop
                && at == k
            {
                law.stop(angle, TURN, true).unwrap();
            }
            let moved = sample.1.wrapping_sub(before);
            before = sample.1;
            steps(law.step(r, moved))
        });
    (steps.collect(), law)
}

fn commands(sent: &[(u64, i32, i16)]) -> Vec<i16> {
    sent.iter().map(|sample| sample.2).collect()
}

#[test]
fn goals_are_followed_with_the_bits_of_the_law() {
    let mut rig = Rig::positioned();
    rig.counts = i32::MAX - 1000;
    rig.samples(150);
    assert_eq!(rig.arm().0, 0);
    let goals = [vec![0.0; 40], vec![4000.0; 900], vec![-750.0; 900]].concat();
    let (mut motor, first) = (Motor::new(), rig.counts);
    assert_eq!(rig.turns(&mut motor, 2, &goals), goals.len());
    let sent = rig.sent();
    assert_eq!(sent.len(), goals.len());
    let (expected, law) = replayed(&sent, &goals, None);
    assert_eq!(commands(&sent), expected);
    assert_eq!(law.goal(), Some(-750));
    // the counter has wrapped on the way
    let at = |k: usize| sent[k].1.wrapping_sub(first);
    assert!((at(939) - 4000).abs() <= 1, "{}", at(939));
    assert!((at(sent.len() - 1) + 750).abs() <= 1);
}

#[test]
fn a_stop_that_is_planned_has_the_bits_of_the_law_however_far_the_shaft_has_turned() {
    for before in [600, 30_000] {
        let mut rig = Rig::positioned();
        assert_eq!(rig.arm().0, 0);
        assert_eq!(rig.turn_to(before as u32, 400.0, 0).0, 0);
        let ramp = (0..before + 900).map(|k| 2400.0 * (k as f32 / 400.0).min(1.0));
        let speeds: Vec<f32> = ramp.collect();
        let mut motor = Motor::new();
        assert_eq!(rig.turns(&mut motor, 1, &speeds), speeds.len());
        let sent = rig.sent();
        let (expected, law) = replayed(&sent, &speeds, Some((before, 400.0)));
        assert_eq!(commands(&sent), expected);
        let (_, last, _) = sent[sent.len() - 1];
        let goal = law.goal().unwrap();
        assert_eq!((goal - 400) % 1500, 0, "{goal}");
        assert!((i64::from(last) - goal).abs() <= 1, "{last} {goal}");
        // it goes on to the first place that it can reach
        let then = i64::from(sent[before].1);
        assert!(goal > then && goal < then + 6 * 1500, "{goal} {then}");
        if before > 1000 {
            assert!(law.origin() > 1_000_000);
        }
    }
}

#[test]
fn a_stop_can_be_asked_for_while_it_runs_and_once_more() {
    let mut rig = Rig::positioned();
    rig.arm();
    assert_eq!(rig.references(0, &[0.0; 50]).0, 0);
    assert_eq!(rig.start(1, 0, 50).0, 0);
    rig.watched(10);
    for (at, result) in [(9, 3), (10, 0), (12, 0), (0, 0)] {
        if result == 0 {
            assert_eq!(rig.turn_to(at, 700.0, 1).0, 0);
        }
    }
    rig.watched(5);
    let turning = rig.device.core.run.law.as_mut();
    let goal = turning.and_then(|law| law.position()).unwrap().goal();
    // from rest, the shorter way
    assert_eq!(goal, Some(700));
    // the next sample, which the reply names
    let next = rig.device.core.run.samples.to_le_bytes();
    assert_eq!(rig.turn_to(0, 800.0, 1), (0, next.to_vec()));
    rig.watched(1);
    let turning = rig.device.core.run.law.as_mut();
    let goal = turning.and_then(|law| law.position()).unwrap().goal();
    assert_eq!((goal, rig.device.state()), (Some(-700), State::Running));
    // one that has passed is a bad command
    assert_eq!(rig.turn_to(3, 800.0, 1), (3, vec![0; 4]));
    assert_eq!(rig.device.reason(), Reason::BadCommand);
}

#[test]
fn a_stop_belongs_to_one_run() {
    let mut rig = Rig::positioned();
    rig.arm();
    assert_eq!(rig.turn_to(2, 700.0, 0).0, 0);
    rig.stop();
    rig.arm();
    rig.references(0, &[0.0; 9]);
    rig.start(1, 0, 9);
    rig.watched(9);
    let law = rig.device.core.run.law.as_mut();
    let goal = law.and_then(|law| law.position()).unwrap().goal();
    assert_eq!(goal, None);
}

#[test]
fn what_no_position_loop_can_be_is_refused() {
    let mut rig = Rig::ready();
    assert_eq!(rig.moves(MOVES, 8, &ROWS), (3, vec![0; 4]), "no gains");
    rig.set_gains();
    let detail = |(result, body): (u8, Vec<u8>)| (result, body.first().copied());
    for (place, value) in [(0, 0.0), (1, INF), (2, -1.0), (2, f32::NAN), (3, 0.0)] {
        let mut numbers = MOVES;
        numbers[place] = value;
        assert_eq!(detail(rig.moves(numbers, 8, &ROWS)), (3, Some(0)));
    }
    for smoothing in [0, 32] {
        assert_eq!(detail(rig.moves(MOVES, smoothing, &ROWS)), (3, Some(0)));
    }
    let many: Vec<_> = (0..9).map(|i| [i as f32, 1.0, 1.0]).collect();
    for rows in [&[][..], &many, &ROWS[1..], &[[0.0, 0.0, 1.0]]] {
        assert_eq!(detail(rig.moves(MOVES, 8, rows)), (3, Some(0)));
    }
    let body = position(MOVES, 8, 2, &ROWS);
    assert_eq!(rig.command(0x0F, body.bytes().unwrap()).0, 3);
    let body = position(MOVES, 8, 0, &ROWS);
    let whole = body.bytes().unwrap();
    assert_eq!(rig.command(0x0F, &whole[1..]).0, 2);
    assert_eq!(
        rig.moves([30.0, 4001.0, 12.0, 60.0], 8, &ROWS),
        (6, vec![0; 4])
    );
    assert_eq!(rig.moves(MOVES, 8, &ROWS).0, 0);
    // limits that are tightened afterwards hold at the start
    assert_eq!(rig.limits(10.0, 2900.0, INF, 20.0).0, 0);
    rig.arm();
    rig.numbers(2, 0, &[0.0]);
    assert_eq!(rig.start(3, 0, 1), (6, vec![0; 4]));
    rig.stop();
    assert_eq!(rig.limits(10.0, 3000.0, 13_000.0, 20.0).0, 0);
    assert_eq!(rig.moves(MOVES, 8, &ROWS), (6, vec![0; 4]), "a rate");
    rig.arm();
    assert_eq!(rig.start(3, 0, 1), (6, vec![0; 4]));
    // new gains have none
    rig.stop();
    rig.set_gains();
    rig.arm();
    assert_eq!(rig.start(3, 0, 1), (3, vec![0; 4]));
    assert_eq!(rig.turn_to(0, 1.0, 0), (3, vec![0; 4]));
}

#[test]
fn angles_and_goals_out_of_range_are_refused() {
    let mut rig = Rig::positioned();
    assert_eq!(rig.turn_to(0, 0.0, 0), (4, vec![1, 0, 0, 0]));
    rig.arm();
    for (counts, way, field) in [(f32::NAN, 0, 1), (4.2e6, 0, 1), (INF, 0, 1), (1.0, 2, 2)] {
        assert_eq!(rig.turn_to(0, counts, way), (3, vec![field, 0, 0, 0]));
    }
    assert_eq!(rig.command(0x10, &[0; 8]).0, 2);
    for goal in [f32::NAN, 4.2e6, -INF] {
        let (result, body) = rig.numbers(2, 0, &[1.0, goal]);
        assert_eq!((result, body[0]), (6, 1));
    }
    // a stop before a run without positions
    assert_eq!(rig.turn_to(5, 1.0, 0).0, 0);
    rig.upload(0, &[0; 3]);
    assert_eq!(rig.start(0, 0, 3), (3, vec![0; 4]));
    assert_eq!(rig.start(2, 0, 0), (3, vec![0; 4]));
}

#[test]
fn a_device_without_positions_refuses_them() {
    let without = Identity {
        capabilities: identity().capabilities & !can::POSITIONS,
        ..identity()
    };
    let mut rig = Rig::with(without);
    rig.hello(77);
    rig.samples(150);
    rig.limits(10.0, 4000.0, INF, 20.0);
    rig.set_gains();
    assert_eq!(rig.moves(MOVES, 8, &ROWS), (8, vec![0; 4]));
    assert_eq!(rig.travel(0, 0), (8, vec![0; 4]));
    assert_eq!(rig.numbers(2, 0, &[0.0]), (8, vec![0; 4]));
    rig.arm();
    assert_eq!(rig.turn_to(0, 0.0, 0), (8, vec![0; 4]));
    assert_eq!(rig.start(3, 0, 1), (8, vec![0; 4]));
}

#[test]
fn a_stop_from_beyond_the_fastest_speed_trips() {
    let mut rig = Rig::positioned();
    rig.arm();
    rig.turn_to(700, 0.0, 0);
    let speeds: Vec<f32> = (0..800).map(|k| 5.0 * k as f32).collect();
    let mut motor = Motor::new();
    assert_eq!(rig.turns(&mut motor, 1, &speeds), 700);
    assert_eq!(rig.device.reason(), Reason::BadCommand);
    rig.listen();
    let event = rig.came.iter().rfind(|came| came.header.kind == 0xC1);
    let mut value = Fields::new(&event.unwrap().body[11..]);
    assert!(value.f32().is_some_and(|speed| speed > 3000.0));
}

#[test]
fn the_counter_keeps_to_its_travel_in_every_mode() {
    let own = Travel {
        low: -1000,
        high: 5000,
    };
    let mut rig = Rig::with(Identity {
        travel: own,
        ..identity()
    });
    rig.hello(77);
    rig.samples(150);
    rig.limits(10.0, 4000.0, INF, 20.0);
    let mut rig = rig.with_moves();
    let said = |values: [i32; 4]| (0, values.map(i32::to_le_bytes).concat());
    assert_eq!(rig.travel(0, 0), said([-1000, 5000, -1000, 5000]));
    assert_eq!(rig.travel(9, 9), (3, vec![1, 0, 0, 0]));
    assert_eq!(rig.travel(-1001, 9), (6, vec![0; 4]));
    assert_eq!(rig.travel(-9, 5001), (6, vec![1, 0, 0, 0]));
    assert_eq!(rig.travel(-500, 2000), said([-500, 2000, -1000, 5000]));
    rig.arm();
    assert_eq!(rig.travel(-9, 9), (4, vec![2, 0, 0, 0]));
    // goals, at the start and while it runs
    for goal in [2001.0, -501.0] {
        rig.numbers(2, 0, &[0.0, goal]);
        assert_eq!(rig.start(3, 0, 2), (6, vec![0; 4]));
    }
    rig.numbers(2, 0, &[0.0; 9]);
    assert_eq!(rig.start(3, 0, 20).0, 0);
    rig.watched(3);
    assert_eq!(rig.numbers(2, 9, &[2000.0]).0, 0);
    assert_eq!(rig.numbers(2, 10, &[2001.0]), (6, vec![0; 4]));
    assert_eq!(rig.device.reason(), Reason::BadCommand);
    // a shaft that is turned, in any mode
    for mode in [0, 1, 2, 3] {
        rig.clear();
        rig.counts = 0;
        rig.samples(150);
        rig.arm();
        match mode {
            0 => rig.upload(0, &[0; 9]),
            1 => rig.references(0, &[0.0; 9]),
            _ => rig.numbers(2, 0, &[0.0; 9]),
        };
        assert_eq!(rig.start(mode, 0, 9).0, 0);
        rig.watched(2);
        rig.counts = 2001;
        assert!(!rig.sample().enabled);
        let reason = rig.device.reason();
        assert!(
            matches!(reason, Reason::Travel | Reason::Speed),
            "{reason:?}"
        );
        rig.counts = 1990;
        rig.clear();
    }
    // another session has the device's own
    rig.new_session(78);
    assert_eq!(rig.travel(0, 0), said([-1000, 5000, -1000, 5000]));
}

#[test]
fn positions_count_from_the_first_sample_of_a_run() {
    let mut rig = Rig::positioned();
    rig.arm();
    assert_eq!(rig.numbers(2, 0, &[0.0; 30]).0, 0);
    rig.start(3, 0, 30);
    // turned by hand in the sample of the start
    rig.counts += 3;
    rig.watched(5);
    assert_eq!(rig.device.core.run.from, rig.counts);
    assert!(rig.sent().iter().all(|sample| sample.2 == 0));
}

#[test]
fn a_goal_is_rounded_to_no_count_beyond_the_travel() {
    let mut rig = Rig::positioned();
    assert_eq!(rig.travel(-1800, 1800).0, 0);
    rig.arm();
    for (goal, is_within) in [(1800.0, true), (1800.9, false), (-1800.9, false)] {
        rig.numbers(2, 0, &[goal; 30]);
        assert_eq!(rig.start(3, 0, 30).0 == 0, is_within, "{goal}");
        rig.stop();
        rig.samples(150);
        if rig.device.state() == State::Idle {
            rig.arm();
        }
    }
}

#[test]
fn a_stop_whose_goal_is_beyond_the_travel_trips_before_it_is_gone_to() {
    let mut rig = Rig::positioned();
    assert_eq!(rig.travel(-10, 40_000).0, 0);
    rig.arm();
    rig.turn_to(0, 100.0, 0);
    rig.references(0, &[0.0; 30]);
    rig.start(1, 0, 30);
    rig.watched(30);
    assert_eq!(rig.device.state(), State::Running);
    rig.stop();
    assert_eq!(rig.travel(-10, 90).0, 0);
    rig.samples(150);
    rig.arm();
    rig.turn_to(3, 100.0, 0);
    rig.references(0, &[0.0; 30]);
    rig.start(1, 0, 30);
    rig.watched(9);
    assert_eq!(rig.device.reason(), Reason::Travel);
    assert_eq!(rig.sent().len(), 30 + 3);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever is asked for, and whenever: the command keeps to its limits and the shaft, if nothing trips, comes to the angle.
    #[test]
    fn any_stop_ends_at_its_angle(
        // a slow shaft takes longer than the run for the turn that may be left
        speed in prop_oneof![300.0..2900.0_f32, -2900.0..-300.0_f32], at in 400..900_u32, counts in -4e4..4e4_f32, way in 0..2_u8,
    ) {
        let mut rig = Rig::positioned();
        rig.arm();
        prop_assert_eq!(rig.turn_to(at, counts, way).0, 0);
        let length = at as usize + 1500;
        let ramp: Vec<f32> = (0..length).map(|k| speed * (k as f32 / 390.0).min(1.0)).collect();
        let mut motor = Motor::new();
        prop_assert_eq!(rig.turns(&mut motor, 1, &ramp), length);
        let sent = rig.sent();
        prop_assert!(sent.iter().all(|sample| sample.2.abs() <= 10_000));
        let law = rig.device.core.run.law.as_mut();
        let goal = law.and_then(|law| law.position()).unwrap().goal().unwrap();
        let off = (goal as f64 - f64::from(counts)).rem_euclid(1500.0);
        prop_assert!(off.min(1500.0 - off) <= 0.5 + 1e-2, "{} {}", goal, counts);
        let last = i64::from(sent[length - 1].1);
        prop_assert!((last - goal).abs() <= 1, "{} {}", last, goal);
    }
}

#[test]
fn limits_of_the_command_are_those_of_the_speed_loop() {
    assert_eq!(law().limits(), (-10.0, 10.0));
    assert_eq!(law().law().speed().limits(), (-10.0, 10.0));
}

/// Single precision has half counts at the farthest goal: a move there ends at its goal and stands.
#[test]
fn a_move_far_away_ends_at_its_goal() {
    let (mut law, mut motor) = (law(), Motor::new());
    law.follow();
    let (mut counts, mut commands) = (0, Vec::new());
    for (goal, samples) in [
        (0, 10),
        (FARTHEST as i32, 62_000),
        (FARTHEST as i32 - 777, 1500),
    ] {
        commands.clear();
        for k in 0..samples {
            let moved = motor.moved();
            counts += moved;
            let u = law.step(goal as f32, moved);
            assert!(u.is_finite() && u.abs() <= 10.0);
            motor.advance(u);
            if k + 500 > samples {
                commands.push(counts);
            }
        }
        assert!(law.law().stands(), "{goal}: {}", law.law().place());
        assert!(commands.iter().all(|at| (at - goal).abs() <= 1), "{goal}");
    }
}
