use proptest::prelude::*;
use std::vec::Vec;

use super::*;
use crate::{Design, Feedforward, Level, Settings, Standard};

mod stops;

const TS: f64 = 1e-3;
const TURN: f64 = 1572.0;
const PER: f64 = TURN / 60.0;

fn speed_loop() -> PidController<f64> {
    let gains = Standard {
        kp: 0.01,
        ti: 0.03,
        td: 0.0,
    };
    let limits = Settings {
        u_min: -20.0,
        u_max: 20.0,
        ..Settings::new(gains, TS)
    };
    // the exact inverse of the motor
    let levels = [-5000.0, 5000.0].map(|y| Level { y, u: y / 490.0 });
    let feedforward = Feedforward::new(1, 0.5, &levels, &[0.1]).unwrap();
    let design = Design {
        feedforward,
        ..Design::new(limits)
    };
    PidController::new(design).unwrap()
}

fn rates(rows: &[(f64, f64, f64)]) -> Rates<f64> {
    let rows: Vec<_> = rows
        .iter()
        .map(|&(speed, up, down)| Rate { speed, up, down })
        .collect();
    Rates::new(&rows).unwrap()
}

fn design(rates: Rates<f64>, smoothing: usize) -> PositionDesign<f64> {
    PositionDesign {
        gain: 30.0,
        counts_per_unit: PER,
        speed: 5000.0,
        rates,
        smoothing,
        landing: 0.0,
        creep: 20.0,
        releases: false,
    }
}

/// A motor with a time constant of 50 ms, if nothing else is said, and an encoder.
struct Motor {
    y: f64,
    position: f64,
    before: f64,
    lag: f64,
}

impl Motor {
    fn new() -> Self {
        Self {
            y: 0.0,
            position: 0.0,
            before: 0.0,
            lag: 0.05,
        }
    }

    fn moved(&mut self) -> f64 {
        let counts = Real::floor(self.position * PER + 0.5);
        counts - std::mem::replace(&mut self.before, counts)
    }

    /// With dry friction of .3 V.
    fn advance(&mut self, u: f64) {
        let held = self.y == 0.0 && u.abs() <= 0.3;
        let way = if self.y == 0.0 { u } else { self.y };
        let drive = if held { 0.0 } else { u - 0.3_f64.copysign(way) };
        let y = self.y + TS * (490.0 * drive - self.y) / self.lag;
        let y = if y * self.y < 0.0 { 0.0 } else { y };
        self.position += TS * 0.5 * (self.y + y);
        self.y = y;
    }
}

/// Rows of one to eight rates.
fn any_rates() -> impl Strategy<Value = Rates<f64>> {
    prop::collection::vec((50.0..900.0_f64, 2e3..40e3_f64, 2e3..40e3_f64), 1..=8).prop_map(|rows| {
        let mut speed = 0.0;
        let rows: Vec<_> = rows
            .iter()
            .enumerate()
            .map(|(i, &(more, up, down))| {
                speed += if i == 0 { 0.0 } else { more };
                (speed, up, down)
            })
            .collect();
        rates(&rows)
    })
}

proptest! {
    #[test]
    fn a_profile_meets_a_goal_exactly_without_passing_it(
        rates in any_rates(), smoothing in 1..=SMOOTHED, goal in -20_000.0..20_000.0_f64,
        landing in prop_oneof![Just(0.0), 0.0..60.0],
    ) {
        let landing = PositionDesign { landing, ..design(rates, smoothing) };
        let mut law = PositionLoop::new(landing, speed_loop()).unwrap();
        law.follow();
        let (mut before, mut last) = (0.0, 0.0);
        for _ in 0..20_000 {
            law.step(goal, 0.0);
            let place = law.places.at(0);
            prop_assert!((goal - place) * goal >= -1e-9 * goal * goal, "{goal} {place}");
            let speed = (place - before) / law.per_sample;
            prop_assert!(speed.abs() <= 5000.0 * (1.0 + 1e-9));
            let most = rates.rows().iter().flat_map(|r| [r.up, r.down]).fold(0.0, f64::max);
            prop_assert!((speed - last).abs() <= 1.13 * most * TS + 1e-9, "{} {}", speed - last, most * TS);
            (before, last) = (place, speed);
            if law.stands() {
                break;
            }
        }
        prop_assert!(law.stands());
        prop_assert_eq!(law.place(), goal);
    }

    #[test]
    fn a_stop_begins_without_a_jump_and_ends_at_the_angle(
        rates in any_rates(), smoothing in 1..=SMOOTHED, angle in 0.0..TURN, speed in -4000.0..4000.0_f64, onward: bool,
        landing in prop_oneof![Just(0.0), 0.0..60.0],
    ) {
        let landed = PositionDesign { landing, ..design(rates, smoothing) };
        let mut law = PositionLoop::new(landed, speed_loop()).unwrap();
        for _ in 0..40 {
            law.step(speed, speed * law.per_sample);
        }
        let before = law.places.at(0);
        let goal = law.stop(angle, TURN, onward).unwrap();
        let off = (goal - angle) / TURN;
        prop_assert!((off - off.round()).abs() <= 0.5001 / TURN);
        // counts that follow the profile
        let mut way = 0.0_f64;
        let mut earlier = before;
        for _ in 0..40_000 {
            let moved = law.place() - law.counts();
            law.step(0.0, moved);
            let place = law.places.at(0);
            way += (place - earlier).abs();
            earlier = place;
            if law.stands() {
                break;
            }
        }
        prop_assert!(law.stands() && law.place() == goal);
        let needed = law.design.rates.way(speed.abs()) * PER + speed.abs() * law.per_sample * 20.0 + landing;
        if onward {
            prop_assert!((way - (goal - before).abs()).abs() < 1e-6 * way + 1e-6, "turned back");
            prop_assert!(way <= needed + TURN + 1.0, "{way} {needed}");
        } else {
            prop_assert!(way <= 3.0 * needed + 0.5 * TURN + 1.0);
        }
    }

    #[test]
    fn whatever_comes_the_command_is_finite_and_within_its_limits(
        inputs in prop::collection::vec((
            prop_oneof![-1e5..1e5_f64, Just(f64::NAN), Just(f64::INFINITY), Just(1e300)],
            prop_oneof![-500.0..500.0_f64, Just(f64::NAN), Just(1e300)],
        ), 1..200), follows: bool,
    ) {
        let steady = rates(&[(0.0, 2e4, 2e4)]);
        let mut law = PositionLoop::new(design(steady, 4), speed_loop()).unwrap();
        if follows {
            law.follow();
        }
        for (r, moved) in inputs {
            let u = law.step(r, moved);
            prop_assert!((-20.0..=20.0).contains(&u));
        }
    }
}

#[test]
fn a_goal_that_moves_as_the_drive_can_is_followed_as_it_is() {
    let mut law = PositionLoop::new(design(rates(&[(0.0, 2e4, 2e4)]), 1), speed_loop()).unwrap();
    law.follow();
    // an acceleration of 15,000 RPM/s, then a constant speed
    let (mut at, mut speed) = (0.0, 0.0_f64);
    for k in 0..600 {
        if k > 10 {
            speed = (speed + 15.0).min(2000.0);
        }
        at += speed * PER * TS;
        law.step(at, 0.0);
        assert!((law.places.at(0) - at).abs() < 1e-9 * (1.0 + at), "{k}");
    }
}

#[test]
fn the_last_counts_are_passed_slowly() {
    let slow = PositionDesign {
        landing: 20.0,
        ..design(rates(&[(0.0, 2e4, 2e4)]), 1)
    };
    let mut law = PositionLoop::new(slow, speed_loop()).unwrap();
    law.follow();
    let (mut before, mut samples) = (0.0, 0);
    for _ in 0..3000 {
        law.step(3000.0, 0.0);
        let place = law.places.at(0);
        if 3000.0 - before <= 19.9 && place < 3000.0 {
            samples += 1;
            assert!(place - before <= 20.0 * law.per_sample + 1e-9, "{place}");
        }
        before = place;
    }
    // 20 RPM are .524 counts a sample
    assert!((36..=40).contains(&samples) && law.stands(), "{samples}");
}

#[test]
fn a_landing_ends_where_the_counts_meet_the_goal() {
    let slow = PositionDesign {
        landing: 20.0,
        ..design(rates(&[(0.0, 2e4, 2e4)]), 4)
    };
    // samples until the profile stands if the shaft leads by so many counts
    let lands = |lead: f64| {
        let mut law = PositionLoop::new(slow, speed_loop()).unwrap();
        law.follow();
        for k in 0..3000 {
            let at = Real::floor(law.place() + lead + 0.5);
            law.step(3000.0, at - law.counts());
            if law.stands() {
                return k;
            }
        }
        panic!("it does not land");
    };
    // 2 counts at 20 RPM are 4 samples; a lead that friction does not hold dies away first
    let [exact, led, far] = [0.0, 2.0, 4.0].map(lands);
    assert!(led + 4 <= exact && far > led, "{exact} {led} {far}");
}

#[test]
fn a_motor_goes_to_a_goal_stops_at_an_angle_and_stands() {
    let bounded = design(rates(&[(0.0, 3e4, 3e4)]), 8);
    let mut law = PositionLoop::new(bounded, speed_loop()).unwrap();
    let mut motor = Motor::new();
    for _ in 0..1000 {
        let moved = motor.moved();
        motor.advance(law.step(2000.0, moved));
    }
    let goal = law.stop(0.25 * TURN, TURN, true).unwrap();
    let mut most = f64::MIN;
    for _ in 0..1500 {
        let moved = motor.moved();
        motor.advance(law.step(0.0, moved));
        most = most.max(motor.position * PER);
    }
    assert!(
        (motor.before - goal).abs() <= 1.0 && most - goal <= 1.0,
        "{} {goal} {most}",
        motor.before
    );
    // nothing moves for as long as one looks
    let (u, at) = (law.step(0.0, motor.moved()), motor.position);
    for _ in 0..5000 {
        let moved = motor.moved();
        motor.advance(law.step(0.0, moved));
    }
    assert!((motor.position - at).abs() * PER < 1.0 && u.abs() < 1.0);
}

#[test]
fn at_rest_it_lets_go_if_asked() {
    let releasing = PositionDesign {
        releases: true,
        ..design(rates(&[(0.0, 3e4, 3e4)]), 8)
    };
    let mut law = PositionLoop::new(releasing, speed_loop()).unwrap();
    law.follow();
    let mut motor = Motor::new();
    let mut u = 1.0;
    for _ in 0..3000 {
        let moved = motor.moved();
        u = law.step(400.4, moved);
        motor.advance(u);
    }
    assert_eq!(u, 0.0);
    // somebody turns the shaft, and a new goal is gone to from there
    for _ in 0..100 {
        motor.position += 5.0 / PER;
        assert_eq!(law.step(400.4, motor.moved()), 0.0);
    }
    for _ in 0..20 {
        law.step(400.4, 0.0);
    }
    let mut steepest = 0.0_f64;
    for _ in 0..3000 {
        let moved = motor.moved();
        let before = std::mem::replace(&mut u, law.step(1100.0, moved));
        steepest = steepest.max((u - before).abs());
        motor.advance(u);
    }
    assert!(
        (motor.before - 1100.0).abs() <= 1.0 && u == 0.0 && steepest < 2.0,
        "{steepest}"
    );
    law.reset();
    assert_eq!((law.counts(), law.stands()), (0.0, false));
}

#[test]
fn a_shaft_that_was_let_go_stops_again() {
    let releasing = PositionDesign {
        releases: true,
        ..design(rates(&[(0.0, 3e4, 3e4)]), 8)
    };
    let mut law = PositionLoop::new(releasing, speed_loop()).unwrap();
    let mut motor = Motor::new();
    let stopped = |law: &mut PositionLoop<f64>, motor: &mut Motor, angle: f64| {
        let goal = law.stop(angle, TURN, false).unwrap();
        let first = law.step(0.0, motor.moved());
        motor.advance(first);
        let mut last = first;
        for _ in 0..2000 {
            last = law.step(0.0, motor.moved());
            motor.advance(last);
        }
        assert_eq!(last, 0.0, "let go");
        assert!(
            (motor.before - goal).abs() <= 1.0,
            "{} {goal}",
            motor.before
        );
        // it begins without a jump
        assert!(first.abs() < 1.0, "{first}");
    };
    stopped(&mut law, &mut motor, 100.0);
    stopped(&mut law, &mut motor, 500.0);
    // somebody turns the shaft, and it is asked for the same angle again
    for _ in 0..100 {
        motor.position += 2.0 / PER;
        assert_eq!(law.step(0.0, motor.moved()), 0.0);
    }
    stopped(&mut law, &mut motor, 500.0);
    // where it is already it may stay
    stopped(&mut law, &mut motor, 500.0);
}

#[test]
fn bad_settings_are_refused_by_name() {
    let good = design(rates(&[(0.0, 3e4, 3e4)]), 8);
    let refused = |design| PositionLoop::new(design, speed_loop()).unwrap_err().name;
    assert_eq!(
        refused(PositionDesign { gain: 0.0, ..good }),
        "position gain"
    );
    assert_eq!(
        refused(PositionDesign {
            speed: f64::NAN,
            ..good
        }),
        "speed"
    );
    assert_eq!(
        refused(PositionDesign {
            smoothing: 32,
            ..good
        }),
        "smoothing"
    );
    assert_eq!(
        refused(PositionDesign {
            counts_per_unit: -1.0,
            ..good
        }),
        "counts_per_unit"
    );
    let rate = |speed, up, down| Rate { speed, up, down };
    assert!(Rates::<f64>::new(&[]).is_err());
    assert!(Rates::new(&[rate(1.0, 1.0, 1.0)]).is_err());
    assert!(Rates::new(&[rate(0.0, 0.0, 1.0)]).is_err());
    assert!(Rates::new(&[rate(0.0, 1.0, 1.0), rate(0.0, 1.0, 1.0)]).is_err());
    assert!(Rates::new(&[rate(0.0, 1.0, f64::INFINITY)]).is_err());
    let mut law = PositionLoop::new(good, speed_loop()).unwrap();
    assert_eq!(law.stop(f64::NAN, TURN, true).unwrap_err().name, "angle");
    assert_eq!(law.stop(0.0, 0.0, true).unwrap_err().name, "turn");
    for _ in 0..10 {
        law.step(9000.0, 0.0);
    }
    assert_eq!(law.stop(0.0, TURN, true).unwrap_err().name, "speed");
}
