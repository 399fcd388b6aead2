//! The main loop of a drive's firmware, and a computed motor as a board to run it on (docs/wiring.md).
//!
//! `cargo run --package sewfast-control --example firmware`

use sewfast_control::link::{
    Channel, Device, Encoding, Identity, Limits, Measurement, Output, Source, State, Travel,
    capability,
};

static CHANNELS: [Channel; 3] = [
    Channel {
        encoding: Encoding::Counts,
        steps_per_unit: 1,
        name: "counts",
        unit: "1",
        source: Source::Counts,
    },
    Channel {
        encoding: Encoding::Steps,
        steps_per_unit: 1000,
        name: "u",
        unit: "V",
        source: Source::Command,
    },
    Channel {
        encoding: Encoding::Float,
        steps_per_unit: 1,
        name: "feedback",
        unit: "RPM",
        source: Source::Feedback,
    },
];

/// The part that a firmware's author writes; nothing here may wait.
trait Board {
    /// Microseconds since boot, from a timer that never runs backwards.
    fn time(&self) -> u64;
    /// Once each control period: when the counter was latched, and its value.
    fn measure(&mut self) -> Option<(u64, i32)>;
    /// Drives the motor, or switches the drive off.
    fn apply(&mut self, output: Output);
    /// Received bytes; returns how many.
    fn read(&mut self, bytes: &mut [u8]) -> usize;
    /// Sends as much as there is room for; returns how many bytes.
    fn write(&mut self, bytes: &[u8]) -> usize;
    /// Kicks the hardware watchdog.
    fn alive(&mut self);
}

struct Firmware<B> {
    device: Device<2048>,
    board: B,
    out: [u8; 64],
    waiting: usize,
    sent: usize,
}

impl<B: Board> Firmware<B> {
    fn new(boot_id: u32, entropy: u32, board: B) -> Result<Self, sewfast_control::Refused> {
        let device = Device::new(Identity {
            boot_id,
            entropy,
            name: "example drive",
            firmware: "1.0",
            period: 1000,
            counts_per_rev: 1572.0,
            capabilities: capability::PROFILE
                | capability::PID
                | capability::DRIVE
                | capability::DESIGN
                | capability::BIQUADS
                | capability::FEEDFORWARD
                | capability::POSITIONS,
            ceilings: Limits {
                volt: 20.0,
                speed: 4000.0,
                acceleration: 60_000.0,
                current: f32::INFINITY,
            },
            travel: Travel::ANY,
            channels: &CHANNELS,
        })?;
        Ok(Self {
            device,
            board,
            out: [0; 64],
            waiting: 0,
            sent: 0,
        })
    }

    /// One turn of the main loop, many times a period; the sample goes first.
    fn step(&mut self) {
        if let Some((when, counts)) = self.board.measure() {
            let measurement = Measurement {
                counts,
                current: f32::NAN,
                further: &[],
            };
            let output = self.device.sample(when, &measurement);
            self.board.apply(output);
            self.board.alive();
        } else {
            let output = self.device.poll(self.board.time());
            self.board.apply(output);
        }
        self.communicate();
    }

    fn communicate(&mut self) {
        let mut bytes = [0; 64];
        let count = self.board.read(&mut bytes);
        if count > 0 {
            let now = self.board.time();
            self.device.receive(now, &bytes[..count]);
            let output = self.device.poll(now);
            self.board.apply(output);
        }
        if self.sent == self.waiting {
            self.sent = 0;
            self.waiting = self.device.transmit(&mut self.out);
        }
        self.sent += self.board.write(&self.out[self.sent..self.waiting]);
    }
}

/// A motor at rest and a port that nobody has opened; each turn of the loop takes 100 us.
#[derive(Default)]
struct Desk {
    time: u64,
    sampled: u64,
    kicked: u32,
    sent: usize,
    applied: Option<Output>,
}

impl Board for Desk {
    fn time(&self) -> u64 {
        self.time
    }

    fn measure(&mut self) -> Option<(u64, i32)> {
        self.time += 100;
        let due = self.time - self.sampled >= 1000;
        due.then(|| {
            self.sampled = self.time;
            (self.time, 0)
        })
    }

    fn apply(&mut self, output: Output) {
        self.applied = Some(output);
    }

    fn read(&mut self, _: &mut [u8]) -> usize {
        0
    }

    fn write(&mut self, bytes: &[u8]) -> usize {
        self.sent += bytes.len();
        bytes.len()
    }

    fn alive(&mut self) {
        self.kicked += 1;
    }
}

fn main() -> Result<(), sewfast_control::Refused> {
    let mut firmware = Firmware::new(1, 0x1F2E_3D4C, Desk::default())?;
    assert_eq!(firmware.device.state(), State::Boot);
    for _ in 0..10_000 {
        firmware.step();
    }
    assert_eq!(firmware.device.state(), State::Idle);
    let desk = firmware.board;
    assert_eq!(desk.applied, Some(Output::SAFE));
    println!(
        "after {} s: idle, {} periods, {} bytes sent, {} bytes of memory",
        desk.time as f64 / 1e6,
        desk.kicked,
        desk.sent,
        size_of::<Device<2048>>()
    );
    Ok(())
}
