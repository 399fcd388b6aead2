//! The loop with a minimal device, in computed time.

use proptest::prelude::*;
use sewfast_control::link::{Body, Deframer, Fields, Header, MAX_WIRE, encode};
use sewfast_control::{Design, PidController, Settings as Pid, Standard};

use super::{HostLoop, Outcome, Settings};
use crate::client::{Client, kind};
use crate::samples::Channel;

mod with_device;

const PERIOD: u64 = 10_000;
const TAG: u16 = 7;
const SESSION: u32 = 0x8000_0009;

/// A motor `dx/dt = (400 u - x) / .1 s` \[counts/s\] behind a device that simply obeys.
struct Peer {
    deframer: Deframer,
    out: Vec<u8>,
    said: Vec<(Header, Vec<u8>)>,
    sequence: u32,
    time: u64,
    start: Option<u64>,
    length: u32,
    taken: u32,
    batch: Vec<i32>,
    speed: f64,
    position: f64,
    u: f64,
    mute: bool,
    deaf: bool,
}

impl Peer {
    fn new() -> Self {
        Self {
            deframer: Deframer::new(),
            out: Vec::new(),
            said: Vec::new(),
            sequence: 0,
            time: 5_000_000,
            start: None,
            length: 0,
            taken: 0,
            batch: Vec::new(),
            speed: 0.0,
            position: 0.5,
            u: 0.0,
            mute: false,
            deaf: false,
        }
    }

    fn say(&mut self, kind: u8, time: u64, body: &Body) {
        let header = Header {
            kind,
            tag: TAG,
            sequence: self.sequence,
            time,
        };
        self.sequence += 1;
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body.bytes().unwrap(), &mut wire).unwrap();
        if !self.mute {
            self.out.extend_from_slice(&wire[..length]);
        }
    }

    fn hear(&mut self, mut bytes: &[u8]) {
        let mut deframer = std::mem::take(&mut self.deframer);
        while let Some(frame) = deframer.next(&mut bytes) {
            let frame = frame.expect("the loop sends whole frames");
            assert_eq!(frame.header.session(), SESSION);
            self.said.push((frame.header, frame.body.to_vec()));
            if !self.deaf {
                self.obey(&frame.header, frame.body);
            }
        }
        self.deframer = deframer;
    }

    fn obey(&mut self, header: &Header, body: &[u8]) {
        let mut fields = Fields::new(body);
        let mut reply = Body::new();
        reply.u32(header.sequence).u8(0);
        match header.kind {
            kind::DRIVE => {
                fields.u32();
                self.u = f64::from(fields.f32().unwrap());
                return;
            }
            kind::KEEP => return,
            kind::START => {
                fields.take(1 + 4 + 8);
                self.length = fields.u32().unwrap();
                self.start = Some(self.time + 1000);
                reply.u32(1).u64(self.time + 1000);
            }
            kind::STOP => {
                self.flush();
                self.start = None;
                reply.u8(1);
            }
            kind::STATUS => {
                reply.u8(1).u8(0).u8(2).u16(1).u32(1).u64(0).u32(self.taken);
                reply.u32(self.length).u32(0).f32(0.0).i32(0);
                reply.u32(1).u32(2).u32(3).u32(4).u32(5).u32(6);
            }
            _ => {}
        }
        self.say(header.kind | kind::REPLY, self.time, &reply);
    }

    fn advance(&mut self, to: u64) {
        while self.time + 1000 <= to {
            self.time += 1000;
            let Some(start) = self.start else { continue };
            if self.time < start {
                continue;
            }
            self.batch.push(self.position.floor() as i32);
            self.taken += 1;
            self.speed += (400.0 * self.u - self.speed) * 0.01;
            self.position += self.speed * 1e-3;
            if self.batch.len() == 5 || self.taken == self.length {
                self.flush();
            }
            if self.taken == self.length {
                self.start = None;
            }
        }
    }

    fn flush(&mut self) {
        if let [first, rest @ ..] = &self.batch[..] {
            let mut body = Body::new();
            body.u8(0).i32(*first);
            let mut last = *first;
            for &counts in rest {
                body.i16((counts - last) as i16);
                last = counts;
            }
            let time = self.time - 1000 * rest.len() as u64;
            self.batch.clear();
            self.say(0xC0, time, &body);
        }
    }

    fn event(&mut self, code: u8, reason: u8, value: f32) {
        let mut body = Body::new();
        body.u8(code)
            .u8(4)
            .u8(reason)
            .u32(1)
            .u32(self.taken)
            .f32(value);
        self.start = None;
        self.say(kind::EVENT, self.time, &body);
    }

    fn beat(&mut self, state: u8, reason: u8) {
        let mut body = Body::new();
        body.u32(1).u8(state).u8(reason).f32(0.0);
        self.start = None;
        self.say(kind::BEAT, self.time, &body);
    }

    fn count(&self, kind: u8) -> usize {
        self.said
            .iter()
            .filter(|(header, _)| header.kind == kind)
            .count()
    }
}

fn host_loop(ticks: usize) -> HostLoop {
    let gains = Standard {
        kp: 0.004,
        ti: 0.1,
        td: 0.0,
    };
    let pid = Pid {
        u_min: -10.0,
        u_max: 10.0,
        tt: 0.0,
        ..Pid::new(gains, PERIOD as f64 * 1e-6)
    };
    let settings = Settings {
        device_period: 1000,
        ratio: 10,
        watchdog: 50_000,
        batch: 5,
        mask: 1,
        counts_per_unit: 1.0,
    };
    let counts = Channel::described(0, 1).unwrap();
    let controller = PidController::new(Design::new(pid)).unwrap();
    let client = Client::new(SESSION, 0).continued(TAG, 0, 3, 8);
    HostLoop::new(client, settings, &[counts], controller, vec![1000.0; ticks]).unwrap()
}

/// A loop and a device whose clocks differ by a constant.
struct World {
    looped: HostLoop,
    peer: Peer,
    now: u64,
}

impl World {
    fn new(ticks: usize) -> Self {
        Self {
            looped: host_loop(ticks),
            peer: Peer::new(),
            now: 1_000_000,
        }
    }

    /// Lets time pass until `now`, then calls the loop once.
    fn call(&mut self, now: u64) {
        self.now = now;
        self.peer.advance(now + 4_000_000);
        let received = std::mem::take(&mut self.peer.out);
        let said = self.looped.tick(now, &received).to_vec();
        assert!(
            said.iter().filter(|&&byte| byte == 0).count() <= 1,
            "more than one frame"
        );
        self.peer.hear(&said);
    }

    /// Calls the loop like its thread, until `until` or its end.
    fn serve(&mut self, until: u64) {
        while !self.looped.done() && self.now < until {
            let wake = self.looped.wake().clamp(self.now + 100, self.now + 1000);
            self.call(wake);
        }
    }

    fn outcome(&self) -> Option<&Outcome> {
        self.looped.outcome()
    }
}

#[test]
fn arms_starts_drives_to_the_reference_stops_and_asks() {
    let mut world = World::new(100);
    world.serve(u64::MAX);
    assert_eq!(world.outcome(), Some(&Outcome::Completed));
    let kinds: Vec<u8> = world
        .peer
        .said
        .iter()
        .map(|(header, _)| header.kind)
        .collect();
    assert_eq!((kinds[0], kinds[1]), (kind::ARM, kind::START));
    assert_eq!(kinds[2..102], [kind::DRIVE; 100]);
    assert_eq!(kinds[102..], [kind::STOP, kind::STATUS]);
    let commands = world
        .peer
        .said
        .iter()
        .filter(|(h, _)| h.kind < 0x20)
        .map(|(h, _)| h.sequence);
    assert_eq!(commands.collect::<Vec<_>>(), [4, 5, 6, 7]);
    assert_eq!(world.peer.said[2].0.sequence, 9);

    let (ticks, history) = (world.looped.ticks(), world.looped.history());
    assert_eq!((ticks.run.len(), ticks.missed), (100, 0));
    // The reference, and the batch before its first tick.
    assert_eq!(history.times().len(), 1005);
    assert!(
        history
            .times()
            .windows(2)
            .all(|pair| pair[1] == pair[0] + 1000)
    );
    let late: f64 = ticks.run[70..].iter().map(|tick| tick.y).sum();
    assert!((late / 30.0 - 1000.0).abs() < 30.0, "{late}");
    assert!(
        ticks
            .run
            .iter()
            .all(|tick| tick.late < 1000 && tick.age.is_none_or(|age| age <= 5000))
    );
    assert_eq!(
        world
            .looped
            .status()
            .map(|status| (status.samples, status.refused)),
        Some((1005, 2))
    );
}

#[test]
fn measures_the_speed_over_its_own_period() {
    let mut world = World::new(30);
    world.serve(u64::MAX);
    let (ticks, history) = (world.looped.ticks(), world.looped.history());
    for tick in ticks.run.iter().skip(2) {
        let newest = history.times().iter().zip(history.counts()).enumerate();
        let expected = newest
            .filter(|(k, _)| *k >= 10)
            .map(|(k, (_, counts))| (counts - history.counts()[k - 10]) / 0.01);
        assert!(
            tick.fresh
                && expected
                    .into_iter()
                    .any(|speed| (speed - tick.y).abs() < 1e-9)
        );
    }
}

#[test]
fn skips_missed_deadlines_and_counts_each_once() {
    let mut world = World::new(50);
    world.serve(1_200_000);
    let (run, deadline) = (world.looped.ticks().run.len(), world.looped.wake());
    world.call(deadline + 35_000);
    let ticks = world.looped.ticks();
    assert_eq!((ticks.run.len(), ticks.missed), (run + 1, 3));
    assert_eq!(
        ticks.run.last().map(|tick| (tick.late, tick.number)),
        Some((35_000, run + 3))
    );
    assert_eq!(world.looped.wake(), deadline + 40_000, "the grid stays");
    world.serve(u64::MAX);
    let ticks = world.looped.ticks();
    assert_eq!(ticks.run.len() as u64 + ticks.missed, 50);
}

#[test]
fn keeps_the_command_without_a_new_sample_and_stops_when_blind() {
    let mut world = World::new(100);
    world.serve(1_300_000);
    world.peer.mute = true;
    let before = world.looped.ticks().run.len();
    world.serve(1_300_000 + 50_000 + PERIOD + 1000);
    assert_eq!(world.outcome(), Some(&Outcome::Silent));
    let held = &world.looped.ticks().run[before + 1..];
    assert!(
        held.len() >= 3
            && held
                .iter()
                .all(|tick| !tick.fresh && tick.y.is_nan() && tick.u == held[0].u)
    );
    let drives = world.peer.count(kind::DRIVE);
    world.serve(u64::MAX);
    assert_eq!(world.peer.count(kind::DRIVE), drives);
    assert_eq!(
        world.peer.count(kind::STOP),
        100,
        "STOP is repeated, then given up"
    );
}

#[test]
fn names_the_trip_by_its_event_or_by_a_beat() {
    let mut world = World::new(100);
    world.serve(1_200_000);
    world.peer.event(6, 2, 3100.0);
    world.serve(u64::MAX);
    assert_eq!(
        world.outcome(),
        Some(&Outcome::Tripped {
            reason: 2,
            value: 3100.0
        })
    );

    let mut world = World::new(100);
    world.serve(1_200_000);
    world.peer.beat(4, 4);
    world.serve(u64::MAX);
    assert!(matches!(
        world.outcome(),
        Some(Outcome::Tripped { reason: 4, .. })
    ));
}

#[test]
fn gives_up_a_device_that_never_answers() {
    let mut world = World::new(10);
    world.peer.deaf = true;
    world.serve(u64::MAX);
    assert_eq!(world.outcome(), Some(&Outcome::Unanswered(kind::ARM)));
    assert_eq!(
        (world.peer.count(kind::ARM), world.peer.count(kind::STOP)),
        (10, 100)
    );
    assert_eq!(world.now, 1_000_100 + 20 * 100_000);
}

#[test]
fn says_stop_for_as_long_as_the_motor_may_turn() {
    let mut world = World::new(10);
    world.looped.client.set_watchdog(5_000_000);
    world.peer.deaf = true;
    world.looped.stop(Outcome::Interrupted);
    world.serve(u64::MAX);
    assert_eq!(world.peer.count(kind::STOP), 500);
    assert!(world.looped.done() && !world.looped.stopped());
}

#[test]
fn feeds_the_watchdog_while_start_is_unanswered() {
    let mut world = World::new(10);
    world.call(1_000_000);
    world.peer.mute = true;
    world.serve(1_090_000);
    assert_eq!(
        (world.peer.count(kind::START), world.peer.count(kind::KEEP)),
        (1, 7)
    );
    world.peer.mute = false;
    world.peer.out.clear();
    world.serve(u64::MAX);
    assert!(world.outcome().is_some());
}

#[test]
fn says_what_was_refused() {
    let mut world = World::new(10);
    world.peer.deaf = true;
    world.call(1_000_000);
    let mut refusal = Body::new();
    refusal.u32(4).u8(12).u32(0);
    world.peer.say(kind::ARM | kind::REPLY, 0, &refusal);
    world.peer.deaf = false;
    world.serve(u64::MAX);
    let expected = Outcome::Refused {
        command: kind::ARM,
        result: 12,
        detail: 0,
    };
    assert_eq!(world.outcome(), Some(&expected));
}

#[test]
fn a_start_that_is_answered_by_nothing_is_not_fed_for_long() {
    let mut world = World::new(100);
    while world.peer.count(kind::START) == 0 {
        world.serve(world.now + 100);
        world.peer.mute = world.peer.count(kind::ARM) == 1;
    }
    let muted = world.now;
    world.serve(u64::MAX);
    assert_eq!(world.outcome(), Some(&Outcome::Unanswered(kind::START)));
    let keeps = world.peer.said.iter().filter(|(h, _)| h.kind == kind::KEEP);
    let after = keeps.map(|(header, _)| (header.time & 0xFFFF_FFFF) - muted);
    let after: Vec<u64> = after.collect();
    assert!(after.len() > 10 && after.iter().all(|&after| after <= 250_000));
}

#[test]
fn a_device_that_has_reset_ends_the_loop_at_once() {
    let mut world = World::new(100);
    world.serve(1_200_000);
    let header = Header {
        kind: kind::BEAT,
        tag: TAG + 1,
        sequence: 0,
        time: 0,
    };
    let mut wire = [0; MAX_WIRE];
    let length = encode(&header, &[0; 10], &mut wire).unwrap();
    assert!(world.looped.tick(world.now + 1, &wire[..length]).is_empty());
    assert!(world.looped.done());
    assert_eq!(world.outcome(), Some(&Outcome::Reset));
}

fn numbers() -> Settings {
    Settings {
        device_period: 1000,
        ratio: 10,
        watchdog: 50_000,
        batch: 10,
        mask: 3,
        counts_per_unit: 26.2,
    }
}

#[test]
fn takes_a_loop_that_can_run() {
    assert_eq!(numbers().check(2, 100, 0.01), Ok(()));
}

#[test]
fn refuses_what_cannot_run_and_names_it() {
    let slow = Settings {
        ratio: 60,
        ..numbers()
    };
    assert!(
        slow.check(2, 100, 0.06)
            .unwrap_err()
            .message
            .contains("longer than the loop's period")
    );
    assert!(
        numbers()
            .check(2, 100, 0.02)
            .unwrap_err()
            .message
            .contains("0.01 s, got 0.02")
    );
    assert!(numbers().check(2, 0, 0.01).is_err());
    assert!(numbers().check(2, usize::MAX / 16, 0.01).is_err());
    let blind = Settings {
        mask: 6,
        ..numbers()
    };
    assert!(
        blind
            .check(2, 1, 0.01)
            .unwrap_err()
            .message
            .contains("counts (bit 0)")
    );
}
/// Something that happens between two calls.
#[derive(Clone, Debug)]
enum Happening {
    Wait(u64),
    Noise(Vec<u8>),
    Mute(bool),
    Event(u8, u8),
    Beat(u8),
    Stop,
}

fn happening() -> impl Strategy<Value = Happening> {
    prop_oneof![
        12 => (0_u64..40_000).prop_map(Happening::Wait),
        1 => (0_u64..3_000_000).prop_map(Happening::Wait),
        4 => prop::collection::vec(any::<u8>(), 0..300).prop_map(Happening::Noise),
        2 => any::<bool>().prop_map(Happening::Mute),
        1 => (0_u8..8, 0_u8..12).prop_map(|(code, reason)| Happening::Event(code, reason)),
        1 => (0_u8..6).prop_map(Happening::Beat),
        1 => Just(Happening::Stop),
    ]
}

proptest! {
    #[test]
    fn whatever_happens_no_command_follows_a_stop(happenings in prop::collection::vec(happening(), 1..120), ticks in 1_usize..60) {
        let mut world = World::new(ticks);
        for happens in happenings {
            let mut wait = 100;
            match happens {
                Happening::Wait(time) => wait = time,
                Happening::Noise(bytes) => world.peer.out.extend(bytes),
                Happening::Mute(mute) => world.peer.mute = mute,
                Happening::Event(code, reason) => world.peer.event(code, reason, 0.0),
                Happening::Beat(state) => world.peer.beat(state, 1),
                Happening::Stop => world.looped.stop(Outcome::Interrupted),
            }
            world.call(world.now + wait);
        }
        world.serve(u64::MAX);
        prop_assert!(world.looped.done() && world.outcome().is_some());
        let stop = world.peer.said.iter().position(|(header, _)| header.kind == kind::STOP);
        let moves = |kind: u8| matches!(kind, kind::ARM | kind::START | kind::KEEP | kind::DRIVE);
        if let Some(stop) = stop {
            prop_assert!(!world.peer.said[stop..].iter().any(|(header, _)| moves(header.kind)));
        }
        let log = world.looped.ticks();
        prop_assert!(log.run.len() as u64 + log.missed <= ticks as u64);
        prop_assert!(log.run.windows(2).all(|pair| pair[0].number < pair[1].number));
        prop_assert_eq!(world.peer.count(kind::DRIVE), log.run.len());
        if world.outcome() == Some(&Outcome::Completed) {
            prop_assert_eq!(log.run.len() as u64 + log.missed, ticks as u64);
        }
        prop_assert!(world.looped.history().times().len() <= 10 * ticks + 15);
    }

    #[test]
    fn any_bytes_at_any_clock_are_endured(calls in prop::collection::vec((any::<u64>(), prop::collection::vec(any::<u8>(), 0..100)), 0..50)) {
        let mut looped = host_loop(20);
        for (now, bytes) in calls {
            let said = looped.tick(now, &bytes);
            prop_assert!(said.iter().filter(|&&byte| byte == 0).count() <= 1);
        }
    }
}
