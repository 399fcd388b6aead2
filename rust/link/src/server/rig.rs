//! The virtual drive: the simulated sewing machine with the state machine of a device, and its clock.

use std::time::{Duration, Instant};

use sewfast_control::link::{
    Channel, Device, Encoding, Identity, Limits, Measurement, Output, Source, State, Travel,
    capability,
};
use sewfast_core::machine::Machine;
use sewfast_core::{Error, Result};

/// Values that the profile's memory holds: 8 s of commands, so longer signals must be uploaded while they run.
pub const CAPACITY: usize = 8192;

/// Control period [us], the sample time of the machine.
pub const PERIOD: u32 = 1000;

const CAPABILITIES: u32 = capability::PROFILE
    | capability::PID
    | capability::DRIVE
    | capability::CURRENT
    | capability::COMPUTED
    | capability::DESIGN
    | capability::BIQUADS
    | capability::KINDS
    | capability::FEEDFORWARD
    | capability::POSITIONS;

const CHANNELS: [Channel; 6] = [
    channel("counts", "1", Encoding::Counts, 1, Source::Counts),
    channel("u", "V", Encoding::Steps, 1000, Source::Command),
    channel("current", "A", Encoding::Steps, 1000, Source::Current),
    channel("r", "RPM", Encoding::Float, 1, Source::Reference),
    channel("feedback", "RPM", Encoding::Float, 1, Source::Feedback),
    channel("speed_true", "RPM", Encoding::Float, 1, Source::Further(0)),
];

const fn channel(
    name: &'static str,
    unit: &'static str,
    encoding: Encoding,
    steps_per_unit: u32,
    source: Source,
) -> Channel {
    Channel {
        encoding,
        steps_per_unit,
        name,
        unit,
        source,
    }
}

/// The machine, its device, and the device's time.
pub struct Rig {
    device: Box<Device<CAPACITY>>,
    machine: Machine,
    /// The counter's value when the machine last returned to its initial state.
    counted: i64,
    /// When the next sample is due [us].
    next: u64,
    output: Output,
}

impl Rig {
    /// A drive that boots now; `credit`: whether the host may grant it time.
    ///
    /// # Errors
    /// A setting error for a machine that a device cannot represent.
    pub fn new(machine: Machine, name: &'static str, boot_id: u32, credit: bool) -> Result<Self> {
        let identity = Identity {
            boot_id,
            entropy: entropy(),
            name,
            firmware: env!("CARGO_PKG_VERSION"),
            period: PERIOD,
            counts_per_rev: machine.parameters().counts_per_rev as f32,
            capabilities: CAPABILITIES | if credit { capability::CREDIT } else { 0 },
            ceilings: Limits {
                volt: machine.parameters().u_limit as f32,
                speed: f32::INFINITY,
                acceleration: f32::INFINITY,
                current: f32::INFINITY,
            },
            travel: Travel::ANY,
            channels: &CHANNELS,
        };
        Ok(Self {
            device: Box::new(booted(identity)?),
            machine,
            counted: 0,
            next: u64::from(PERIOD),
            output: Output::SAFE,
        })
    }

    /// Reboots: another boot id, time and counter from 0, the motor without command, the machine in its present state.
    pub fn reboot(&mut self) {
        let boot_id = following(self.boot_id());
        let identity = *self.device.identity();
        if let Ok(device) = booted(Identity {
            boot_id,
            entropy: entropy(),
            ..identity
        }) {
            *self.device = device;
        }
        self.counted = -(self.machine.counts() as i64);
        self.next = u64::from(PERIOD);
        self.output = Output::SAFE;
    }

    /// The boot id.
    pub fn boot_id(&self) -> u32 {
        self.device.identity().boot_id
    }

    /// When the next sample is due [us].
    pub fn next(&self) -> u64 {
        self.next
    }

    /// The state.
    pub fn state(&self) -> State {
        self.device.state()
    }

    /// How far the host lets time advance; `None` without an open session.
    pub fn credit(&self) -> Option<u64> {
        self.device.credit()
    }

    /// The device's last output.
    pub fn output(&self) -> Output {
        self.output
    }

    /// Takes the sample that is due and advances the machine by a period.
    pub fn sample(&mut self) {
        let speed = self.machine.speed_rpm() as f32;
        let measured = Measurement {
            counts: self.counts() as i32,
            current: self.machine.current() as f32,
            further: &[speed],
        };
        self.output = self.device.sample(self.next, &measured);
        let u = if self.output.enabled {
            self.output.u
        } else {
            0.0
        };
        self.machine.advance(f64::from(u));
        self.next += u64::from(PERIOD);
    }

    fn counts(&self) -> i64 {
        self.counted + self.machine.counts() as i64
    }

    /// Passes the device a received frame, or a part of one.
    pub fn receive(&mut self, now: u64, frame: &[u8]) {
        let armed = self.device.armed_count();
        self.device.receive(now, frame);
        if self.device.armed_count() != armed {
            // the counter continues, so the device sees no motion where there was none
            self.counted = self.counts();
            self.machine.reset();
        }
        self.output = self.device.poll(now);
    }

    /// Reports that the host has gone.
    pub fn disconnect(&mut self) {
        self.device.disconnect();
    }

    /// Moves bytes for the host into `buffer`; returns how many.
    pub fn transmit(&mut self, buffer: &mut [u8]) -> usize {
        self.device.transmit(buffer)
    }
}

fn booted(identity: Identity) -> Result<Device<CAPACITY>> {
    let device = Device::new(identity);
    device.map_err(|refused| Error::setting(refused.to_string()))
}

/// Random bits of the system, from the keys that it gives to hash tables.
fn entropy() -> u32 {
    use std::hash::{BuildHasher, RandomState};
    RandomState::new().hash_one(0) as u32
}

/// The next boot id whose low 16 bits are neither this one's nor 0, the tag of HELLO.
fn following(boot_id: u32) -> u32 {
    let next = boot_id.wrapping_add(1);
    if next as u16 == 0 {
        next.wrapping_add(1)
    } else {
        next
    }
}

/// Microseconds since the device's boot.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    time: u64,
    /// When it showed `time`; `None` while it is stopped.
    since: Option<Instant>,
}

impl Clock {
    /// Starts at zero now.
    pub fn new(now: Instant) -> Self {
        Self {
            time: 0,
            since: Some(now),
        }
    }

    /// The time it shows.
    pub fn read(&self, now: Instant) -> u64 {
        let passed = self
            .since
            .map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
        self.time + passed.as_micros() as u64
    }

    /// Stops at `time`.
    pub fn stand(&mut self, time: u64) {
        *self = Self { time, since: None };
    }

    /// Continues from the time it shows.
    pub fn run(&mut self, now: Instant) {
        self.since.get_or_insert(now);
    }

    /// Shows `time` now and continues from there.
    pub fn set(&mut self, time: u64, now: Instant) {
        *self = Self {
            time,
            since: Some(now),
        };
    }

    /// How long until it shows `time`; `None` while it is stopped.
    pub fn until(&self, time: u64, now: Instant) -> Option<Duration> {
        let due = self.since? + Duration::from_micros(time.saturating_sub(self.time));
        Some(due.saturating_duration_since(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_stands_and_runs_on() {
        let start = Instant::now();
        let after = |ms| start + Duration::from_millis(ms);
        let mut clock = Clock::new(start);
        assert_eq!(clock.read(after(5)), 5000);
        assert_eq!(clock.until(7000, after(5)), Some(Duration::from_millis(2)));
        clock.stand(6000);
        assert_eq!(
            (clock.read(after(9)), clock.until(7000, after(9))),
            (6000, None)
        );
        clock.run(after(10));
        clock.run(after(11));
        assert_eq!(clock.read(after(12)), 8000);
    }
}
