//! A host, a clock and a motor for tests.

use crate::Biquad;
use crate::link::identity::capability as can;
use crate::link::{
    Body, Channel, Deframer, Device, Encoding, Fields, Header, Identity, Limits, MAX_WIRE,
    Measurement, Output, Source, State, Travel, encode,
};
use std::vec::Vec;

pub const CAPACITY: usize = 64;
pub const PERIOD: u64 = 1000;
pub const INF: f32 = f32::INFINITY;

const fn channel(
    encoding: Encoding,
    steps_per_unit: u32,
    name: &'static str,
    source: Source,
) -> Channel {
    Channel {
        encoding,
        steps_per_unit,
        name,
        unit: "1",
        source,
    }
}

pub static CHANNELS: [Channel; 6] = [
    channel(Encoding::Counts, 1, "counts", Source::Counts),
    channel(Encoding::Steps, 1000, "u", Source::Command),
    channel(Encoding::Float, 1, "i", Source::Current),
    channel(Encoding::Float, 1, "r", Source::Reference),
    channel(Encoding::Float, 1, "y", Source::Feedback),
    channel(Encoding::Float, 1, "speed", Source::Further(0)),
];

pub fn identity() -> Identity {
    Identity {
        boot_id: 0x1_2345,
        entropy: 0x5EED,
        name: "rig",
        firmware: "test",
        period: PERIOD as u32,
        counts_per_rev: 1500.0,
        capabilities: can::PROFILE
            | can::PID
            | can::DRIVE
            | can::CURRENT
            | can::DESIGN
            | can::BIQUADS
            | can::KINDS
            | can::FEEDFORWARD
            | can::POSITIONS,
        ceilings: Limits {
            volt: 20.0,
            speed: 5000.0,
            acceleration: INF,
            current: 30.0,
        },
        travel: Travel::ANY,
        channels: &CHANNELS,
    }
}

/// A frame from the device.
#[derive(Clone, Debug, PartialEq)]
pub struct Came {
    pub header: Header,
    pub body: Vec<u8>,
}

/// Result and remainder of a reply.
pub type Answer = (u8, Vec<u8>);

pub struct Rig {
    pub device: Device<CAPACITY>,
    pub now: u64,
    pub counts: i32,
    pub current: f32,
    pub further: [f32; 1],
    pub tag: u16,
    pub session: u32,
    pub commands: u32,
    pub beats: u32,
    pub came: Vec<Came>,
    deframer: Deframer,
}

impl Rig {
    pub fn new() -> Self {
        Self::with(identity())
    }

    pub fn with(identity: Identity) -> Self {
        Self {
            device: Device::new(identity).unwrap(),
            now: 0,
            counts: 0,
            current: 0.0,
            further: [0.0],
            tag: identity.boot_id as u16,
            session: 0,
            commands: 0,
            beats: 0,
            came: Vec::new(),
            deframer: Deframer::new(),
        }
    }

    /// Passes boot and standstill; opens a session with limits.
    pub fn ready() -> Self {
        let mut rig = Self::new();
        rig.hello(77);
        rig.samples(150);
        assert_eq!(rig.limits(10.0, 4000.0, INF, 20.0).0, 0);
        rig
    }

    pub fn armed() -> Self {
        let mut rig = Self::ready();
        assert_eq!(rig.arm().0, 0);
        rig
    }

    /// A frame of the session; HELLO has no session number in its header.
    pub fn wire(&self, kind: u8, tag: u16, sequence: u32, body: &[u8]) -> Vec<u8> {
        let session = if kind == 0x01 { 0 } else { self.session };
        let header = Header {
            kind,
            tag,
            sequence,
            time: Header::host_time(session, self.now),
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body, &mut wire).unwrap();
        wire[..length].to_vec()
    }

    pub fn put(&mut self, bytes: &[u8]) {
        self.device.receive(self.now, bytes);
    }

    pub fn say(&mut self, kind: u8, tag: u16, sequence: u32, body: &[u8]) {
        let wire = self.wire(kind, tag, sequence, body);
        self.put(&wire);
    }

    /// All that the device has sent since the last call.
    pub fn listen(&mut self) -> Vec<Came> {
        self.device.poll(self.now);
        let mut new = Vec::new();
        let mut out = [0; 100];
        loop {
            let count = self.device.transmit(&mut out);
            if count == 0 {
                break;
            }
            let mut bytes = &out[..count];
            while let Some(frame) = self.deframer.next(&mut bytes) {
                let frame = frame.unwrap();
                new.push(Came {
                    header: frame.header,
                    body: frame.body.to_vec(),
                });
            }
        }
        self.came.extend(new.iter().cloned());
        new
    }

    fn answer(&mut self, kind: u8, sequence: u32) -> Option<Answer> {
        let replies = self.listen();
        let reply = replies
            .iter()
            .rfind(|came| came.header.kind == 0x80 | kind)?;
        let mut fields = Fields::new(&reply.body);
        assert_eq!(fields.u32(), Some(sequence));
        Some((fields.u8().unwrap(), fields.rest().to_vec()))
    }

    /// A command with the next number.
    pub fn command(&mut self, kind: u8, body: &[u8]) -> Answer {
        self.commands = self.commands.wrapping_add(1);
        self.say(kind, self.tag, self.commands, body);
        self.answer(kind, self.commands).unwrap()
    }

    /// A command with the last number again.
    pub fn again(&mut self, kind: u8, body: &[u8]) -> Option<Answer> {
        self.say(kind, self.tag, self.commands, body);
        self.answer(kind, self.commands)
    }

    pub fn hello(&mut self, session: u32) -> Answer {
        let mut body = Body::new();
        body.u8(1).u8(4).u32(session);
        self.session = session;
        self.say(0x01, 0, 0, body.bytes().unwrap());
        self.answer(0x01, 0).unwrap()
    }

    pub fn new_session(&mut self, session: u32) -> Answer {
        (self.commands, self.beats) = (0, 0);
        self.hello(session)
    }

    pub fn limits(&mut self, volt: f32, speed: f32, acceleration: f32, current: f32) -> Answer {
        let mut body = Body::new();
        body.f32(volt).f32(speed).f32(acceleration).f32(current);
        self.command(0x04, body.bytes().unwrap())
    }

    /// The key of the session.
    pub fn key(&self) -> u32 {
        let session = self.device.core.session.as_ref();
        session.map_or(0, |session| session.key)
    }

    /// The body of ARM.
    pub fn arming(&self, watchdog: u32) -> Vec<u8> {
        [watchdog.to_le_bytes(), self.key().to_le_bytes()].concat()
    }

    pub fn arm(&mut self) -> Answer {
        let body = self.arming(50_000);
        self.command(0x05, &body)
    }

    pub fn stop(&mut self) -> Answer {
        self.command(0x06, &[])
    }

    pub fn clear(&mut self) -> Answer {
        self.command(0x07, &[])
    }

    pub fn upload(&mut self, offset: u32, values: &[i16]) -> Answer {
        let body = upload(offset, values);
        self.command(0x08, body.bytes().unwrap())
    }

    pub fn references(&mut self, offset: u32, values: &[f32]) -> Answer {
        self.numbers(1, offset, values)
    }

    /// UPLOAD of references (table 1) or goals (2).
    pub fn numbers(&mut self, table: u8, offset: u32, values: &[f32]) -> Answer {
        let mut body = Body::new();
        body.u8(table).u32(offset);
        values.iter().for_each(|&value| {
            body.f32(value);
        });
        self.command(0x08, body.bytes().unwrap())
    }

    pub fn start(&mut self, mode: u8, at: u64, length: u32) -> Answer {
        let body = start(mode, at, length, 0b11, 10);
        self.command(0x0A, body.bytes().unwrap())
    }

    /// A heartbeat with the next number.
    pub fn beat(&mut self, kind: u8, body: &[u8]) {
        self.beats += 1;
        self.say(kind, self.tag, self.beats, body);
    }

    pub fn keep(&mut self) {
        self.beat(0x20, &50_000u32.to_le_bytes());
    }

    pub fn drive(&mut self, u: f32) {
        let mut body = Body::new();
        body.u32(50_000).f32(u);
        self.beat(0x21, body.bytes().unwrap());
    }

    /// One control period later.
    pub fn sample(&mut self) -> Output {
        self.now += PERIOD;
        self.sample_at(self.now)
    }

    pub fn sample_at(&mut self, now: u64) -> Output {
        let measurement = Measurement {
            counts: self.counts,
            current: self.current,
            further: &self.further,
        };
        let output = self.device.sample(now, &measurement);
        assert!(output.enabled || output == Output::SAFE);
        assert_eq!(output.enabled, self.device.state() == State::Running);
        output
    }

    /// Periods without a message from the host.
    pub fn samples(&mut self, count: usize) {
        for _ in 0..count {
            self.sample();
        }
    }

    /// Periods with a host that watches.
    pub fn watched(&mut self, count: usize) {
        for _ in 0..count {
            self.keep();
            self.sample();
        }
    }

    /// A run in mode 2 in progress.
    pub fn driving(u: f32) -> Self {
        let mut rig = Self::armed();
        assert_eq!(rig.start(2, 0, 0).0, 0);
        rig.sample();
        rig.drive(u);
        assert_eq!(rig.sample().u, u);
        rig
    }

    /// Codes and reasons of the events so far.
    pub fn events(&mut self) -> Vec<(u8, u8)> {
        self.listen();
        let events = self.came.iter().filter(|came| came.header.kind == 0xC1);
        events.map(|came| (came.body[0], came.body[2])).collect()
    }

    /// Number, counts and command of every sample sent, in frames of the first two channels.
    pub fn sent(&mut self) -> Vec<(u64, i32, i16)> {
        self.listen();
        let batches = self.came.iter().filter(|came| came.header.kind == 0xC0);
        batches.flat_map(read).collect()
    }
}

pub fn upload(offset: u32, values: &[i16]) -> Body {
    let mut body = Body::new();
    body.u8(0).u32(offset);
    for &value in values {
        body.i16(value);
    }
    body
}

pub fn start(mode: u8, at: u64, length: u32, mask: u16, batch: u8) -> Body {
    let mut body = Body::new();
    body.u8(mode).u32(50_000).u64(at);
    body.u32(length).u16(mask).u8(batch);
    body
}

/// Kp, Ti, Td, alpha, beta, N, Tt, u_min, u_max, slew, filter time, counts per unit, filter samples.
pub fn gains(values: [f32; 12], samples: u8) -> Body {
    let mut body = Body::new();
    for value in values {
        body.f32(value);
    }
    body.u8(samples);
    body
}

/// [`gains`], then observer time, reference rate and points of speed, Kp, Ti, Td.
pub fn design(
    values: [f32; 12],
    samples: u8,
    observer: f32,
    rate: f32,
    points: &[[f32; 4]],
) -> Body {
    let mut body = gains(values, samples);
    body.f32(observer).f32(rate).u8(points.len() as u8);
    points.iter().flatten().for_each(|&value| {
        body.f32(value);
    });
    body
}

/// The body of BIQUADS.
pub fn biquads(sections: &[Biquad<f32>]) -> Body {
    let mut body = Body::new();
    body.u8(sections.len() as u8);
    for section in sections {
        body.f32(section.c0).f32(section.c1);
        body.f32(section.a1).f32(section.a2);
    }
    body
}

/// The body of FEEDFORWARD.
pub fn feedforward(preview: u8, late: f32, levels: &[[f32; 2]], taps: &[f32]) -> Body {
    let mut body = Body::new();
    body.u8(preview).f32(late).u8(levels.len() as u8);
    levels.iter().flatten().for_each(|&value| {
        body.f32(value);
    });
    body.u8(taps.len() as u8);
    taps.iter().for_each(|&value| {
        body.f32(value);
    });
    body
}

/// The body of POSITION: gain, fastest, landing, creep, samples of smoothing, rows of rates.
pub fn position(numbers: [f32; 4], smoothing: u8, releases: u8, rows: &[[f32; 3]]) -> Body {
    let mut body = Body::new();
    numbers.iter().for_each(|&value| {
        body.f32(value);
    });
    body.u8(smoothing).u8(releases).u8(rows.len() as u8);
    rows.iter().flatten().for_each(|&value| {
        body.f32(value);
    });
    body
}

/// The body of ANGLE.
pub fn angle(at: u32, angle: f32, way: u8) -> Body {
    let mut body = Body::new();
    body.u32(at).f32(angle).u8(way);
    body
}

/// The body of TRAVEL.
pub fn travel(low: i32, high: i32) -> Body {
    let mut body = Body::new();
    body.i32(low).i32(high);
    body
}

/// Time, counts and command of a batch of the first two channels.
pub fn read(came: &Came) -> Vec<(u64, i32, i16)> {
    let samples = (came.body.len() - 3) / 4;
    let mut fields = Fields::new(&came.body[1..]);
    let mut counts = std::vec![fields.i32().unwrap()];
    for k in 1..samples {
        counts.push(counts[k - 1].wrapping_add(fields.i16().unwrap().into()));
    }
    let times = (0..).map(|k| came.header.time + k * PERIOD);
    let read = times
        .zip(counts)
        .map(|(time, counts)| (time, counts, fields.i16().unwrap()));
    let read: Vec<_> = read.collect();
    assert_eq!(fields.end(), Some(()));
    read
}
