//! Laws that hold after every event, in any order, on a bad line.

use super::rig::*;
use crate::Biquad;
use crate::link::{Fields, Output, Reason, State};
use proptest::prelude::*;
use std::collections::HashMap;
use std::vec;
use std::vec::Vec;

/// What happens to a frame on its way.
#[derive(Clone, Copy, Debug)]
enum Fate {
    Arrives,
    Lost,
    Damaged(u32),
    Halved(u32),
    Twice,
}

#[derive(Clone, Debug)]
enum Act {
    Say(u8, u32),
    Keep(u32),
    Drive(f32),
    /// Arms and starts like a host.
    BringUp(u8),
    Watched(usize),
    Silence(usize),
    /// An earlier frame, repeated by a line with memory.
    Replay(u32),
    Turn(i32),
    Fault,
    StopInput,
    NewHost,
    Reset,
}

/// A frame as a line keeps it: kind, tag, session, sequence, body.
type Said = (u8, u16, u32, u32, Vec<u8>);

/// The knowledge of a bystander who sees the line and the motor but not the device.
struct Bystander {
    rig: Rig,
    boot: u32,
    line: Vec<Said>,
    last_command: u32,
    last_beat: u32,
    /// In force; 0 if there is none.
    session: u32,
    limited: bool,
    /// Until when a message of the host permits motion.
    covered: u64,
    /// CLEAR, ARM, START have not been sent yet.
    clear: bool,
    arm: bool,
    start: bool,
    samples: HashMap<u64, (i32, i16)>,
    replies: HashMap<u32, Vec<u8>>,
    sequence: u32,
}

const SESSION: u32 = 77;
const VOLT: f32 = 10.0;

impl Bystander {
    fn new(boot: u32) -> Self {
        let identity = crate::link::Identity {
            boot_id: boot,
            ..identity()
        };
        Self {
            rig: Rig::with(identity),
            boot,
            line: Vec::new(),
            last_command: 0,
            last_beat: 0,
            session: 0,
            limited: false,
            covered: 0,
            clear: false,
            arm: true,
            start: true,
            samples: HashMap::new(),
            replies: HashMap::new(),
            sequence: 0,
        }
    }

    /// Settles and opens a session with limits.
    fn settle(&mut self) {
        self.sample(150);
        self.hello(self.rig.session.max(SESSION));
        self.say(0x04, command(0x04, 0, 0), Fate::Arrives);
    }

    fn hello(&mut self, session: u32) {
        let mut body = vec![3, 3];
        body.extend(session.to_le_bytes());
        self.rig.session = session;
        self.deliver((0x01, 0, session, 0, body));
    }

    fn say(&mut self, kind: u8, mut body: Vec<u8>, fate: Fate) {
        if kind == 0x05 {
            body.extend(self.rig.key().to_le_bytes());
        }
        let counter = if kind < 0x20 {
            &mut self.rig.commands
        } else {
            &mut self.rig.beats
        };
        *counter += 1;
        let counter = *counter;
        let wire = self.rig.wire(kind, self.rig.tag, counter, &body);
        let frame = (kind, self.rig.tag, self.rig.session, counter, body);
        self.line.push(frame.clone());
        match fate {
            Fate::Arrives => self.deliver(frame),
            Fate::Lost => {}
            Fate::Damaged(bit) => {
                let mut wire = wire;
                let bit = bit as usize % (8 * (wire.len() - 1));
                wire[bit / 8] ^= 1 << (bit % 8);
                self.rig.put(&wire);
                self.rig.put(&[0]);
            }
            Fate::Halved(at) => {
                self.rig.put(&wire[..at as usize % (wire.len() - 1)]);
                self.rig.put(&[0]);
            }
            Fate::Twice => {
                self.deliver(frame.clone());
                self.deliver(frame);
            }
        }
        self.look();
    }

    /// A frame reaches the device whole: records what it must cause.
    fn deliver(&mut self, (kind, tag, session, sequence, body): Said) {
        let (state, body) = (self.rig.device.state(), &body[..]);
        let present = core::mem::replace(&mut self.rig.session, session);
        self.rig.say(kind, tag, sequence, body);
        self.rig.session = present;
        let replies = self.replies(kind, sequence);
        if kind == 0x01 {
            let new = self.session != session;
            self.session = session;
            if new {
                (self.last_command, self.last_beat) = (0, 0);
                (self.rig.commands, self.rig.beats) = (0, 0);
                self.replies.clear();
                self.limited = false;
            }
            assert!(state != State::Running || !new || self.rig.device.state() == State::Tripped);
        } else if self.session == 0 || tag != self.rig.tag {
            assert_eq!(self.rig.device.state(), state);
        } else if session != self.session && kind == 0x06 {
            assert_eq!(replies.len(), 1, "STOP is answered whatever its session");
            self.done(kind, body);
        } else if session != self.session {
            assert!(replies.is_empty() && self.rig.device.state() == state);
        } else if kind >= 0x20 {
            if sequence > self.last_beat {
                self.last_beat = sequence;
                let mut u = Fields::new(&body[4..]);
                if u.f32().is_none_or(f32::is_finite) {
                    self.cover(body);
                }
            }
        } else if sequence > self.last_command {
            self.last_command = sequence;
            assert_eq!(replies.len(), 1, "a command has one reply");
            self.replies.insert(sequence, replies[0].clone());
            if replies[0][4] == 0 {
                self.done(kind, body);
            }
        } else if sequence == self.last_command {
            let first = self.replies.get(&sequence);
            assert_eq!(replies.first(), first, "another reply to the same number");
            assert_eq!(self.rig.device.state(), state, "executed again");
        } else if kind == 0x06 {
            assert_eq!(replies.len(), 1, "STOP is answered whatever its number");
            self.done(kind, body);
        } else {
            assert!(replies.is_empty() && self.rig.device.state() == state);
        }
    }

    fn cover(&mut self, body: &[u8]) {
        let time = Fields::new(body).u32().unwrap();
        self.covered = self.rig.now + u64::from(time);
    }

    fn done(&mut self, kind: u8, body: &[u8]) {
        match kind {
            0x04 => self.limited = true,
            0x05 => {
                assert!(self.limited && !self.clear);
                (self.arm, self.start) = (false, true);
                self.cover(body);
            }
            0x06 => (self.arm, self.start) = (true, true),
            0x07 => self.clear = false,
            0x0A => {
                assert!(!self.arm);
                self.start = false;
                self.cover(&body[1..]);
            }
            _ => {}
        }
    }

    /// The bodies of the replies to a command, among the device's new frames.
    fn replies(&mut self, kind: u8, sequence: u32) -> Vec<Vec<u8>> {
        let number = sequence.to_le_bytes();
        let came = self.listen();
        let wanted = came
            .iter()
            .filter(|came| came.header.kind == 0x80 | kind && came.body.starts_with(&number));
        wanted.map(|came| came.body.clone()).collect()
    }

    /// Frames are numbered without a gap; samples are those that were taken.
    fn listen(&mut self) -> Vec<Came> {
        let came = self.rig.listen();
        for came in &came {
            assert_eq!(came.header.sequence, self.sequence);
            self.sequence += 1;
            if came.header.kind == 0xC0 {
                for (time, counts, u) in read(came) {
                    assert_eq!(self.samples.remove(&time), Some((counts, u)));
                }
            }
        }
        came
    }

    fn sample(&mut self, count: usize) {
        for _ in 0..count {
            let output = self.rig.sample();
            if output.enabled {
                let u = (output.u * 1000.0).round() as i16;
                self.samples.insert(self.rig.now, (self.rig.counts, u));
            }
            self.check(output);
        }
    }

    fn look(&mut self) {
        let output = self.rig.device.poll(self.rig.now);
        self.check(output);
    }

    /// The laws.
    fn check(&mut self, output: Output) {
        let state = self.rig.device.state();
        if output.enabled {
            assert_eq!(state, State::Running);
            assert!(self.rig.now < self.covered, "nobody watches");
            assert!(output.u.abs() <= VOLT && self.limited);
            assert!(!(self.clear || self.arm || self.start), "nobody started it");
        } else {
            assert_eq!(output, Output::SAFE);
        }
        match state {
            State::Tripped => (self.clear, self.arm, self.start) = (true, true, true),
            State::Boot | State::Idle => (self.arm, self.start) = (true, true),
            State::Armed | State::Running => {}
        }
        if state != State::Running {
            self.listen();
            assert!(self.samples.is_empty(), "samples were not sent");
        }
    }

    fn act(&mut self, act: &Act, fate: Fate) {
        match *act {
            Act::Say(kind, value) => self.say(kind, command(kind, value, self.rig.now), fate),
            Act::Keep(time) => self.say(0x20, time.to_le_bytes().to_vec(), fate),
            Act::Drive(u) => {
                let body = [20_000u32.to_le_bytes(), u.to_le_bytes()].concat();
                self.say(0x21, body, fate);
            }
            Act::BringUp(mode) => {
                for kind in [0x07, 0x04, 0x09, 0x0C, 0x0E, 0x08, 0x05, 0x0A] {
                    self.say(
                        kind,
                        command(kind, mode.into(), self.rig.now),
                        Fate::Arrives,
                    );
                }
            }
            Act::Watched(count) => {
                for _ in 0..count {
                    self.say(0x20, 30_000u32.to_le_bytes().to_vec(), fate);
                    self.sample(1);
                }
            }
            Act::Silence(count) => self.sample(count),
            Act::Replay(index) => {
                let index = index as usize % self.line.len().max(1);
                if let Some(frame) = self.line.get(index).cloned() {
                    self.deliver(frame);
                    self.look();
                }
            }
            Act::Turn(counts) => self.rig.counts = self.rig.counts.wrapping_add(counts),
            Act::Fault => {
                self.rig.current = f32::NAN;
                self.sample(1);
                self.rig.current = 0.0;
            }
            Act::StopInput => {
                self.rig.device.trip(self.rig.now, Reason::StopInput);
                self.look();
                assert_eq!(self.rig.device.state(), State::Tripped);
            }
            Act::NewHost => {
                self.hello(self.session + 1);
                self.look();
                self.say(0x04, command(0x04, 0, 0), Fate::Arrives);
            }
            Act::Reset => self.reset(),
        }
    }

    /// The line remembers, the device does not; the host continues its session.
    fn reset(&mut self) {
        let (line, session) = (core::mem::take(&mut self.line), self.session);
        *self = Self::new(self.boot + 1);
        self.line = line;
        self.sample(150);
        for frame in self.line.clone() {
            self.deliver(frame);
        }
        self.look();
        self.hello(session);
        for frame in self.line.clone() {
            self.deliver(frame);
        }
        assert!(!self.limited);
        self.settle();
    }
}

/// A body that could be right for a command.
fn command(kind: u8, value: u32, now: u64) -> Vec<u8> {
    let body = match kind {
        0x04 => return [VOLT, 4000.0, INF, 20.0].map(f32::to_le_bytes).concat(),
        0x05 => return (10_000 + value % 40_000).to_le_bytes().to_vec(),
        0x08 => upload(0, &[2000; 50]),
        0x09 => gains(
            [
                0.02, 0.25, 0.0, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
            ],
            8,
        ),
        0x0C => biquads(&[Biquad::notch(60.0, 0.1, 0.5, 1e-3).unwrap(); 2]),
        0x0E => feedforward(8, 0.5, &[[-3000.0, -6.0], [3000.0, 6.0]], &[0.01, 0.02]),
        0x0A => {
            let mode = if value % 3 == 1 { 2 } else { value % 3 } as u8;
            let at = if value.is_multiple_of(2) {
                0
            } else {
                now + 5000
            };
            start(mode, at, 40, 0b11, 7)
        }
        _ => return Vec::new(),
    };
    body.bytes().unwrap().to_vec()
}

fn acts() -> impl Strategy<Value = (Act, Fate)> {
    let kinds = prop::sample::select(vec![
        0x02u8, 0x03, 0x05, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0C, 0x0E, 0x0A, 0x0A, 0x1E,
    ]);
    let act = prop_oneof![
        6 => (kinds, any::<u32>()).prop_map(|(kind, value)| Act::Say(kind, value)),
        2 => (1000u32..60_000).prop_map(Act::Keep),
        4 => prop_oneof![4 => -15f32..15.0, 1 => Just(f32::NAN)].prop_map(Act::Drive),
        4 => any::<u8>().prop_map(Act::BringUp),
        4 => (1usize..30).prop_map(Act::Watched),
        3 => prop_oneof![4 => 1usize..20, 1 => 40usize..150].prop_map(Act::Silence),
        4 => any::<u32>().prop_map(Act::Replay),
        2 => prop_oneof![6 => -40i32..40, 1 => any::<i32>()].prop_map(Act::Turn),
        1 => Just(Act::Fault),
        1 => Just(Act::StopInput),
        1 => Just(Act::NewHost),
        1 => Just(Act::Reset),
    ];
    let fate = prop_oneof![
        8 => Just(Fate::Arrives),
        1 => Just(Fate::Lost),
        1 => any::<u32>().prop_map(Fate::Damaged),
        1 => any::<u32>().prop_map(Fate::Halved),
        1 => Just(Fate::Twice),
    ];
    (act, fate)
}

proptest! {
    #[test]
    fn no_motion_that_nobody_started_and_nobody_watches(
        acts in prop::collection::vec(acts(), 1..60),
    ) {
        let mut bystander = Bystander::new(0xFFFF);
        bystander.settle();
        for (act, fate) in &acts {
            bystander.act(act, *fate);
        }
    }
}
