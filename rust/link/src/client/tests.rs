//! The client with the state machine of a real device, over a line that loses, repeats, damages and delays frames.

use proptest::prelude::*;
use sewfast_control::link::{
    Body, Device, Fields, Header, Identity, MAX_WIRE, Measurement, State, capability, encode,
};

use super::{
    Client, Event, PATIENCE, PATIENCE_ON_CREDIT, REPEAT, Reply, STOP_REPEAT, Unanswered, kind,
};
use crate::bench;
use crate::bodies::{self, Status};
use crate::samples::Channel;

const LIMITS: u8 = 0x04;
const UPLOAD: u8 = 0x08;
/// The longest of the protocol, so that only STOP ends a run.
const WATCHDOG: u32 = 10_000_000;
const COUNTS: i32 = 70_000;

/// What a line does to frames, each in so many of a thousand.
#[derive(Clone, Copy, Debug)]
struct Faults {
    lost: u64,
    twice: u64,
    damaged: u64,
    late: u64,
    noise: u64,
}

/// One direction of a line.
struct Line {
    faults: Faults,
    dice: u64,
    held: Vec<u8>,
}

impl Line {
    /// SplitMix64; true in `of_a_thousand` of 1,000 calls.
    fn happens(&mut self, of_a_thousand: u64) -> bool {
        self.next() % 1000 < of_a_thousand
    }

    fn next(&mut self) -> u64 {
        self.dice = self.dice.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.dice;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// The frames that arrive.
    fn pass(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        for frame in bytes.split_inclusive(|&byte| byte == 0) {
            let mut frame = frame.to_vec();
            let faults = self.faults;
            if self.happens(faults.noise) {
                let length = self.next() % 300;
                out.extend((0..length).map(|_| self.next() as u8));
                out.push(0);
            }
            if self.happens(faults.lost) {
                continue;
            }
            if self.happens(faults.damaged) {
                let at = self.next() as usize % frame.len();
                frame[at] ^= 1 << (self.next() % 8);
            }
            if self.happens(faults.late) {
                self.held.append(&mut frame);
                continue;
            }
            if self.happens(faults.twice) {
                out.extend_from_slice(&frame);
            }
            out.append(&mut frame);
            out.append(&mut self.held);
        }
        out
    }
}

/// A device at rest, its line, and the client at the other end.
struct World {
    device: Device<512>,
    client: Client,
    to_device: Line,
    to_host: Line,
    now: u64,
    events: usize,
}

impl World {
    fn new(faults: Faults, seed: u64) -> Self {
        let identity = Identity {
            entropy: 1,
            capabilities: capability::DRIVE | capability::PROFILE,
            ..bench::identity()
        };
        let line = |dice| Line {
            faults,
            dice,
            held: Vec::new(),
        };
        let mut world = Self {
            device: Device::new(identity).unwrap(),
            client: Client::new(99, WATCHDOG),
            to_device: line(seed),
            to_host: line(!seed),
            now: 1_000,
            events: 0,
        };
        world.pass(200);
        world
    }

    fn quiet() -> Self {
        let none = Faults {
            lost: 0,
            twice: 0,
            damaged: 0,
            late: 0,
            noise: 0,
        };
        Self::new(none, 1)
    }

    /// Lets milliseconds pass on the device, with its frames delivered to the client. Returns the reply that came.
    fn pass(&mut self, milliseconds: u32) -> Option<Reply> {
        let mut found = None;
        for _ in 0..milliseconds {
            self.now += 1000;
            let measurement = Measurement {
                counts: COUNTS,
                current: f32::NAN,
                further: &[],
            };
            self.device.sample(self.now, &measurement);
            let mut chunk = [0; 512];
            let length = self.device.transmit(&mut chunk);
            let arrived = self.to_host.pass(&chunk[..length]);
            self.client.receive(self.now, &arrived);
            while let Some(event) = self.client.event() {
                self.events += 1;
                match event {
                    Event::Reply(reply) => assert!(found.replace(reply).is_none(), "two replies"),
                    Event::Reset => panic!("nothing was reset"),
                    _ => {}
                }
            }
        }
        found
    }

    fn send(&mut self, frame: &[u8]) {
        let arrived = self.to_device.pass(frame);
        self.device.receive(self.now, &arrived);
        self.device.poll(self.now);
    }

    /// Takes turns until the pending request is answered or given up.
    fn finish(&mut self) -> Result<Reply, Unanswered> {
        loop {
            if let Some(unanswered) = self.client.expire(self.now) {
                return Err(unanswered);
            }
            let frame = self.client.transmit(self.now).to_vec();
            self.send(&frame);
            if let Some(reply) = self.pass(1) {
                return Ok(reply);
            }
        }
    }

    fn greet(&mut self) {
        self.client.greet(10 * PATIENCE);
        let reply = self.finish().unwrap();
        assert_eq!((reply.kind, reply.result), (kind::HELLO, 0));
    }

    fn ask(&mut self, kind: u8, body: Body) -> Reply {
        self.client.begin(kind, body);
        let reply = self.finish().unwrap();
        assert_eq!((reply.kind, reply.result), (kind, 0), "{reply:?}");
        reply
    }

    fn set_limits(&mut self) {
        let body = bodies::limits([20.0, 4000.0, f64::INFINITY, f64::INFINITY]);
        self.ask(LIMITS, body);
    }

    /// A direct run of 300 samples at 1 V, stopped by the host; returns its first sample's time and the device's status.
    fn run(&mut self) -> (i64, Status) {
        let channels =
            [(0, 1), (1, 1000)].map(|(code, steps)| Channel::described(code, steps).unwrap());
        self.client.receiver().expect(&channels, 1000).unwrap();
        self.client.arm();
        assert_eq!(self.finish().unwrap().result, 0);
        let start = bodies::Start {
            mode: 2,
            watchdog: WATCHDOG,
            at: 0,
            length: 100_000,
            mask: 3,
            batch: 10,
        };
        let reply = self.ask(kind::START, start.body());
        let (_, first) = bodies::started(&mut Fields::new(reply.body.bytes().unwrap())).unwrap();
        for _ in 0..300 {
            let frame = self.client.drive(self.now, 1.0).to_vec();
            self.send(&frame);
            self.pass(1);
        }
        assert_eq!(self.device.state(), State::Running);
        self.ask(kind::STOP, Body::new());
        let reply = self.ask(kind::STATUS, Body::new());
        let status = Status::of(&mut Fields::new(reply.body.bytes().unwrap())).unwrap();
        (first as i64, status)
    }
}

fn faults() -> impl Strategy<Value = Faults> {
    let rate = || 0_u64..300;
    (rate(), rate(), rate(), rate(), rate()).prop_map(|(lost, twice, damaged, late, noise)| {
        Faults {
            lost,
            twice,
            damaged,
            late,
            noise,
        }
    })
}

/// `few` cases, because each is slow; `PROPTEST_CASES`, if set, overrides it.
fn cases(few: u32) -> ProptestConfig {
    match std::env::var_os("PROPTEST_CASES") {
        Some(_) => ProptestConfig::default(),
        None => ProptestConfig::with_cases(few),
    }
}

proptest! {
    #![proptest_config(cases(48))]

    /// An upload is refused if the one before was executed twice or not at all.
    #[test]
    fn each_command_is_executed_once_whatever_the_line_does(faults in faults(), seed in any::<u64>()) {
        let mut world = World::new(faults, seed);
        world.greet();
        world.set_limits();
        for k in 0..20_u32 {
            let body = bodies::upload(0, 4 * k, &[k as u8, 0, 1, 0, 2, 0, 3, 0]);
            let reply = world.ask(UPLOAD, body);
            let (end, _) = bodies::uploaded(&mut Fields::new(reply.body.bytes().unwrap())).unwrap();
            prop_assert_eq!(end, 4 * k + 4);
            let data = [k as u8; 9];
            let mut echo = Body::new();
            echo.add(&data);
            let reply = world.ask(kind::ECHO, echo);
            prop_assert_eq!(reply.body.bytes(), Some(&data[..]));
        }
        prop_assert_eq!(world.client.sequences(), (41, 0));
    }

    /// All that arrived is right and in order, and all that did not is counted.
    #[test]
    fn each_sample_has_come_or_is_missing(faults in faults(), seed in any::<u64>()) {
        let mut world = World::new(faults, seed);
        world.greet();
        world.set_limits();
        let (first, status) = world.run();
        let (times, columns) = world.client.receiver().take();
        prop_assert_eq!(world.device.state(), State::Idle);
        prop_assert!(times.windows(2).all(|pair| pair[0] < pair[1]));
        prop_assert!(times.iter().all(|time| (time - first) % 1000 == 0 && *time >= first));
        prop_assert!(times.iter().all(|time| (time - first) / 1000 < status.samples.into()));
        prop_assert!(columns[0].iter().all(|&counts| counts == f64::from(COUNTS)));
        prop_assert!(columns[1].iter().all(|&u| u == 0.0 || u == 1.0));
        let counters = *world.client.counters();
        prop_assert_eq!(counters.samples, times.len() as u64);
        if counters.missing == 0 {
            prop_assert_eq!(times.len() as u32, status.samples);
        }
        prop_assert_eq!(counters.resets, 0);
        prop_assert!(world.client.newest() <= world.now);
    }

    /// Arbitrary bytes, at any time, lead to events within bounds.
    #[test]
    fn any_bytes_are_endured(
        calls in prop::collection::vec((any::<u64>(), prop::collection::vec(any::<u8>(), 0..400)), 0..40),
        frames in prop::collection::vec((any::<u8>(), any::<u32>(), prop::collection::vec(any::<u8>(), 0..232)), 0..400),
    ) {
        let mut client = Client::new(5, 50_000).continued(9, 0, 0, 0);
        for (now, bytes) in &calls {
            client.receive(*now, bytes);
            client.expire(*now);
            client.transmit(*now);
        }
        client.begin(kind::ECHO, Body::new());
        client.transmit(7);
        let mut stream = Vec::new();
        for (kind, sequence, body) in &frames {
            let header = Header { kind: *kind | kind::REPLY, tag: 9, sequence: *sequence, time: 1 };
            let mut wire = [0; MAX_WIRE];
            let length = encode(&header, body, &mut wire).unwrap();
            stream.extend_from_slice(&wire[..length]);
        }
        client.receive(8, &stream);
        let events = std::iter::from_fn(|| client.event()).count();
        prop_assert!(events <= super::ROOM + 2 + calls.len());
    }
}

/// A frame of the device, as it would be sent.
fn framed(kind: u8, tag: u16, sequence: u32, body: &[u8]) -> Vec<u8> {
    let mut wire = [0; MAX_WIRE];
    let header = Header {
        kind,
        tag,
        sequence,
        time: 77,
    };
    let length = encode(&header, body, &mut wire).unwrap();
    wire[..length].to_vec()
}

#[test]
fn a_command_is_repeated_unchanged_then_given_up() {
    let mut client = Client::new(5, 50_000).continued(9, 0, 0, 0);
    for (kind, pause, tries) in [(kind::STATUS, REPEAT, 10), (kind::STOP, STOP_REPEAT, 100)] {
        client.begin(kind, Body::new());
        let first = client.transmit(1_000_000).to_vec();
        let mut now = 1_000_000;
        for _ in 1..tries {
            assert!(client.transmit(now + pause - 1).is_empty());
            now += pause;
            assert_eq!((client.expire(now), client.due()), (None, Some(now)));
            assert_eq!(client.transmit(now), first);
        }
        now += pause;
        let unanswered = client.expire(now).unwrap();
        assert_eq!((unanswered.kind, unanswered.attempts), (kind, tries));
        assert_eq!((unanswered.waited, unanswered.others), (PATIENCE, 0));
        assert!(!client.is_busy() && client.due().is_none());
    }
}

#[test]
fn a_stop_is_repeated_for_as_long_as_the_motor_may_turn() {
    let mut client = Client::new(5, 5_000_000).continued(9, 0, 0, 0);
    client.begin(kind::STOP, Body::new());
    let mut now = 0;
    while client.expire(now).is_none() {
        client.transmit(now);
        now += STOP_REPEAT;
    }
    assert_eq!(now, 5_000_000);
}

#[test]
fn only_the_reply_to_the_command_under_way_is_taken_and_once() {
    let mut client = Client::new(5, 50_000).continued(9, 0, 3, 0);
    let reply = |sequence: u8| [sequence, 0, 0, 0, 0, 42];
    client.begin(kind::ECHO, Body::new());
    client.receive(0, &framed(0x8B, 9, 0, &reply(4)));
    assert!(client.event().is_none(), "it has not been sent");
    client.transmit(10);
    client.receive(20, &framed(0x8B, 9, 1, &reply(3)));
    client.receive(20, &framed(0x83, 9, 2, &reply(4)));
    client.receive(20, &framed(0x8B, 9, 3, &[4, 0, 0, 0, 6, 1]));
    assert!(
        client.event().is_none(),
        "another command's, another kind, half a refusal"
    );
    client.receive(30, &framed(0x8B, 9, 4, &reply(4)));
    client.receive(31, &framed(0x8B, 9, 5, &reply(4)));
    let Some(Event::Reply(found)) = client.event() else {
        panic!("it is its reply");
    };
    assert_eq!((found.sent, found.round_trip), (10, Some(20)));
    assert_eq!((found.time, found.body.bytes()), (77, Some(&[42][..])));
    assert!(client.event().is_none() && !client.is_busy());
}

#[test]
fn a_frame_of_another_boot_is_a_reset_but_not_while_greeting() {
    let mut client = Client::new(5, 50_000).continued(9, 0, 0, 0);
    client.receive(0, &framed(kind::BEAT, 9, 0, &[0; 10]));
    assert!(matches!(client.event(), Some(Event::Beat(_))));
    client.receive(1, &framed(kind::BEAT, 8, 0, &[0; 10]));
    assert!(matches!(client.event(), Some(Event::Reset)));
    client.greet(REPEAT);
    client.receive(2, &framed(kind::BEAT, 8, 1, &[0; 10]));
    assert!(matches!(client.event(), Some(Event::Beat(_))));
}

#[test]
fn samples_of_another_boot_are_a_reset_too() {
    let mut client = Client::new(5, 50_000).continued(9, 0, 0, 0);
    let counts = [Channel::described(0, 1).unwrap()];
    client.receiver().expect(&counts, 1000).unwrap();
    client.receive(0, &framed(kind::SAMPLES, 9, 0, &[0; 5]));
    assert_eq!((client.heard(), client.newest()), (Some(0), 77));
    assert!(client.event().is_none());
    client.receive(1, &framed(kind::SAMPLES, 8, 0, &[0; 5]));
    assert!(matches!(client.event(), Some(Event::Reset)));
}

#[test]
fn a_session_that_is_confirmed_gives_its_command_all_tries_again() {
    let mut world = World::quiet();
    world.greet();
    world.client.begin(kind::STATUS, Body::new());
    // the port is away: nothing leaves
    for _ in 0..9 {
        world.client.transmit(world.now);
        world.pass(100);
    }
    world.client.greet(PATIENCE);
    world.finish().unwrap();
    let confirmed = world.now;
    world.client.transmit(world.now);
    while world.client.expire(world.now).is_none() {
        world.client.transmit(world.now);
        world.pass(1);
    }
    assert_eq!(world.now - confirmed, u64::from(WATCHDOG));
}

#[test]
fn a_device_on_credit_has_the_time_of_a_busy_computer() {
    let mut world = World::quiet();
    world.device = Device::new(Identity {
        capabilities: capability::DRIVE | capability::CREDIT,
        ..bench::identity()
    })
    .unwrap();
    world.pass(200);
    world.greet();
    world.client.begin(kind::STATUS, Body::new());
    let asked = world.now;
    while world.client.expire(world.now).is_none() {
        world.client.transmit(world.now);
        world.now += REPEAT;
    }
    assert_eq!(world.now - asked, PATIENCE_ON_CREDIT);
}

#[test]
fn a_greeting_to_another_session_is_not_taken() {
    let mut world = World::quiet();
    world.greet();
    let mut other = Client::new(98, WATCHDOG);
    other.greet(PATIENCE);
    let frame = other.transmit(world.now).to_vec();
    world.send(&frame);
    world.client.greet(PATIENCE);
    assert!(world.pass(2).is_none(), "the reply is to the other host");
    world.finish().unwrap();
}
