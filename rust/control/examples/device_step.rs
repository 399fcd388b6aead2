//! The cost of a control period: measurement, heartbeats through codec and session, controller, samples on the wire.
//!
//! `cargo run --release --package sewfast-control --example device_step`

use std::hint::black_box;
use std::time::Instant;

use sewfast_control::link::{
    Body, Channel, Deframer, Device, Encoding, Header, Identity, Limits, MAX_WIRE, Measurement,
    Source, State, Travel, capability, encode,
};

const SAMPLES: u32 = 2_000_000;
const CAPACITY: usize = 2048;

const fn channel(encoding: Encoding, name: &'static str, source: Source) -> Channel {
    Channel {
        encoding,
        steps_per_unit: 1000,
        name,
        unit: "1",
        source,
    }
}

static CHANNELS: [Channel; 4] = [
    channel(Encoding::Counts, "counts", Source::Counts),
    channel(Encoding::Steps, "u", Source::Command),
    channel(Encoding::Steps, "current", Source::Current),
    channel(Encoding::Float, "feedback", Source::Feedback),
];

struct Host {
    device: Device<CAPACITY>,
    now: u64,
    counts: i32,
    commands: u32,
    beats: u32,
    sent: u64,
}

impl Host {
    fn new() -> Self {
        let identity = Identity {
            boot_id: 7,
            entropy: 0,
            name: "bench",
            firmware: "1",
            period: 1000,
            counts_per_rev: 1572.0,
            capabilities: capability::PROFILE
                | capability::PID
                | capability::DRIVE
                | capability::CURRENT
                | capability::DESIGN
                | capability::BIQUADS
                | capability::FEEDFORWARD
                | capability::POSITIONS,
            ceilings: Limits {
                volt: 20.0,
                speed: 4000.0,
                acceleration: f32::INFINITY,
                current: 30.0,
            },
            travel: Travel::ANY,
            channels: &CHANNELS,
        };
        Self {
            device: Device::new(identity).expect("a sound identity"),
            now: 0,
            counts: 0,
            commands: 0,
            beats: 0,
            sent: 0,
        }
    }

    fn say(&mut self, kind: u8, body: &Body) {
        let (tag, sequence) = match kind {
            0x01 => (0, 0),
            0x20.. => {
                self.beats += 1;
                (7, self.beats)
            }
            _ => {
                self.commands += 1;
                (7, self.commands)
            }
        };
        let header = Header {
            kind,
            tag,
            sequence,
            time: Header::host_time(if kind == 0x01 { 0 } else { 1 }, self.now),
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body.bytes().expect("a body"), &mut wire).expect("a frame");
        self.device.receive(self.now, &wire[..length]);
        self.device.poll(self.now);
    }

    fn period(&mut self, counts: i32) {
        self.now += 1000;
        self.counts = self.counts.wrapping_add(counts);
        let measurement = Measurement {
            counts: self.counts,
            current: 0.5,
            further: &[],
        };
        black_box(self.device.sample(self.now, black_box(&measurement)));
        let mut out = [0; 64];
        self.sent += self.device.transmit(&mut out) as u64;
        black_box(&out);
    }

    /// The key in the reply to HELLO, which ARM repeats.
    fn key(&mut self) -> u32 {
        let (mut heard, mut out) = (Deframer::new(), [0; 64]);
        loop {
            self.device.poll(self.now);
            let count = self.device.transmit(&mut out);
            assert!(count > 0, "no reply to HELLO");
            let mut input = &out[..count];
            while let Some(found) = heard.next(&mut input) {
                if let Ok(frame) = found
                    && frame.header.kind == 0x81
                {
                    let last = frame.body.last_chunk().expect("a whole reply");
                    return u32::from_le_bytes(*last);
                }
            }
        }
    }

    /// Starts a run that only STOP ends, in mode 0, 1 or 2; `whole`: with observer, ramp and a schedule of 8 points;
    /// `ahead`: with a feedforward of 8 levels and 16 taps.
    fn run(mode: u8, whole: bool, ahead: bool) -> Self {
        let mut host = Self::new();
        (0..150).for_each(|_| host.period(0));
        host.say(0x01, Body::new().u8(3).u8(3).u32(1));
        let key = host.key();
        host.say(
            0x04,
            Body::new()
                .f32(20.0)
                .f32(4000.0)
                .f32(f32::INFINITY)
                .f32(30.0),
        );
        let mut gains = Body::new();
        for value in [0.02, 0.25, 0.004, 0.4, 0.2, 10.0, 0.0, -20.0, 20.0] {
            gains.f32(value);
        }
        gains.f32(f32::INFINITY).f32(0.002).f32(26.2).u8(8);
        if whole {
            gains.f32(0.004).f32(50_000.0).u8(8);
            for k in 0..8u8 {
                gains
                    .f32(200.0 * f32::from(k))
                    .f32(0.02)
                    .f32(0.25)
                    .f32(0.004);
            }
        }
        host.say(0x09, &gains);
        if ahead {
            let mut body = Body::new();
            body.u8(30).f32(0.5).u8(8);
            for k in 0..8u8 {
                body.f32(500.0 * f32::from(k)).f32(1.5 * f32::from(k));
            }
            body.u8(16);
            (0..16).for_each(|_| {
                body.f32(0.01);
            });
            host.say(0x0E, &body);
        }
        host.say(0x08, Body::new().u8(mode & 1).u32(0).u32(0));
        host.say(0x05, Body::new().u32(50_000).u32(key));
        let length = if mode == 2 { 0 } else { SAMPLES };
        let mut start = Body::new();
        start
            .u8(mode)
            .u32(50_000)
            .u64(0)
            .u32(length)
            .u16(0b1111)
            .u8(10);
        host.say(0x0A, &start);
        host
    }

    /// Keeps the profile full: 40 values every 40 samples.
    fn feed(&mut self, mode: u8, sample: u32) {
        let mut body = Body::new();
        body.u8(mode & 1)
            .u32(if mode == 0 { 2 + sample } else { 1 + sample });
        for k in 0..40u32 {
            let value = 1000.0 + ((sample + k) % 100) as f32;
            if mode == 0 {
                body.i16(value as i16);
            } else {
                body.f32(value);
            }
        }
        self.say(0x08, &body);
    }
}

fn main() {
    let runs = [
        (0, false, false, "open loop"),
        (1, false, false, "PID"),
        (1, false, true, "PID, ahead"),
        (1, true, false, "whole design"),
        (1, true, true, "whole, ahead"),
        (2, false, false, "direct drive"),
    ];
    for (mode, whole, ahead, what) in runs {
        let mut host = Host::run(mode, whole, ahead);
        let clock = Instant::now();
        for sample in 0..SAMPLES {
            if mode != 2 && sample % 40 == 0 {
                host.feed(mode, sample);
            }
            if sample % 10 == 0 {
                host.say(0x21, Body::new().u32(50_000).f32(2.0));
            }
            host.period((sample % 3) as i32 + 25);
        }
        let each = clock.elapsed().as_nanos() as f64 / f64::from(SAMPLES);
        assert_eq!(
            host.device.state(),
            State::Running,
            "{:?}",
            host.device.reason()
        );
        println!(
            "{what:>12}: {each:6.0} ns a sample, {:.1} bytes a sample on the wire",
            host.sent as f64 / f64::from(SAMPLES)
        );
    }
}
