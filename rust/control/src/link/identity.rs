//! The device's description of itself: names, period, ceilings, channels.

use super::Body;
use super::crc::Crc;
use crate::Refused;

/// The version of the protocol implemented here.
pub const VERSION: u8 = 4;
/// The oldest version that is spoken with a peer that has no later one.
pub const OLDEST: u8 = 3;
/// The number of channels is limited by the bits of START's mask.
pub const MAX_CHANNELS: usize = 16;

/// With far fewer counts per turn a speed would be infinite, and infinity times 0 counts is NaN, on which no limit trips.
const COUNTS_PER_REV: core::ops::RangeInclusive<f32> = 1.0..=1e9;

/// Bits of [`Identity::capabilities`].
pub mod capability {
    /// Plays uploaded commands.
    pub const PROFILE: u32 = 1;
    /// Runs the PID along uploaded references.
    pub const PID: u32 = 1 << 1;
    /// Holds the command sent by the host.
    pub const DRIVE: u32 = 1 << 2;
    /// The host's credit advances its time.
    pub const CREDIT: u32 = 1 << 3;
    /// Measures the current.
    pub const CURRENT: u32 = 1 << 4;
    /// A computed machine, which ARM resets to its initial state.
    pub const COMPUTED: u32 = 1 << 5;
    /// Its PID has observer, reference ramp and gain schedule.
    pub const DESIGN: u32 = 1 << 6;
    /// Its PID has biquads.
    pub const BIQUADS: u32 = 1 << 7;
    /// Besides its PID, runs controllers of the kinds named by CONTROLLER along uploaded references.
    pub const KINDS: u32 = 1 << 8;
    /// Its PID has feedforward.
    pub const FEEDFORWARD: u32 = 1 << 9;
    /// Runs a position loop over its PID, and keeps to limits of the position.
    pub const POSITIONS: u32 = 1 << 10;
}

/// How a channel's samples are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// The first as i32, each further one as its i16 difference from the previous one.
    Counts = 0,
    /// i16 in steps of `1/steps_per_unit`.
    Steps = 1,
    /// f32.
    Float = 2,
}

impl Encoding {
    /// The bytes that `samples` samples take.
    pub(super) fn size(self, samples: usize) -> usize {
        match self {
            Self::Counts if samples == 0 => 0,
            Self::Counts => 2 + 2 * samples,
            Self::Steps => 2 * samples,
            Self::Float => 4 * samples,
        }
    }
}

/// Source of a channel's value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The counter.
    Counts,
    /// The applied command.
    Command,
    /// The measured current.
    Current,
    /// The reference; NaN if the PID does not run.
    Reference,
    /// The filtered feedback; NaN if the PID does not run.
    Feedback,
    /// One of [`Measurement::further`](super::Measurement::further).
    Further(u8),
}

/// A signal that can be streamed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// How its samples are encoded.
    pub encoding: Encoding,
    /// Steps per unit of [`Encoding::Steps`].
    pub steps_per_unit: u32,
    /// At most 15 bytes.
    pub name: &'static str,
    /// At most 7 bytes.
    pub unit: &'static str,
    /// Source of its value.
    pub source: Source,
}

/// The limits within which the device keeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Largest command in either direction \[V\].
    pub volt: f32,
    /// Largest speed in either direction \[RPM\].
    pub speed: f32,
    /// Largest acceleration in either direction \[RPM/s\].
    pub acceleration: f32,
    /// Largest current in either direction \[A\].
    pub current: f32,
}

impl Limits {
    /// Not set.
    pub(super) const NONE: Self = Self {
        volt: 0.0,
        speed: 0.0,
        acceleration: 0.0,
        current: 0.0,
    };

    pub(super) fn fields(&self) -> [f32; 4] {
        [self.volt, self.speed, self.acceleration, self.current]
    }
}

/// Where the counter may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Travel {
    /// The least count.
    pub low: i32,
    /// The greatest count, above the least.
    pub high: i32,
}

impl Travel {
    /// Anywhere.
    pub const ANY: Self = Self {
        low: i32::MIN,
        high: i32::MAX,
    };

    /// Whether a count is within; a counter that may be anywhere may also wrap.
    pub(super) fn holds(&self, counts: i64) -> bool {
        *self == Self::ANY || (i64::from(self.low)..=i64::from(self.high)).contains(&counts)
    }
}

/// The identity of a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Identity {
    /// Must differ, in its low 16 bits, from that of the previous boot.
    pub boot_id: u32,
    /// Bits unknown to outsiders, from a random generator or a converter's noise; any value if there is neither.
    /// HELLO's key is made from them, from the boot id and from the time of HELLO.
    pub entropy: u32,
    /// At most 24 bytes.
    pub name: &'static str,
    /// At most 16 bytes.
    pub firmware: &'static str,
    /// Control period \[us\].
    pub period: u32,
    /// Counts per turn of the motor, 1 to 1e9.
    pub counts_per_rev: f32,
    /// Bits of [`capability`].
    pub capabilities: u32,
    /// Upper bounds of the limits; infinite for none.
    pub ceilings: Limits,
    /// Where the counter may be during a run.
    pub travel: Travel,
    /// The counter, the command, then any others.
    pub channels: &'static [Channel],
}

impl Identity {
    /// For a device that is off.
    pub(super) const NONE: Self = Self {
        boot_id: 0,
        entropy: 0,
        name: "",
        firmware: "",
        period: 1,
        counts_per_rev: 1.0,
        capabilities: 0,
        ceilings: Limits::NONE,
        travel: Travel::ANY,
        channels: &[],
    };

    /// Whether the device has every capability in `bits`.
    pub fn can(&self, bits: u32) -> bool {
        self.capabilities & bits == bits
    }

    /// The low 16 bits of the boot id, which every frame carries.
    pub(super) fn tag(&self) -> u16 {
        self.boot_id as u16
    }

    /// Steps of the command's channel per volt.
    pub(super) fn steps_per_volt(&self) -> f32 {
        self.channels.get(1).map_or(1, |u| u.steps_per_unit) as f32
    }

    /// # Errors
    /// The first field that is outside its range.
    pub(super) fn check(&self) -> Result<(), Refused> {
        let unless = Refused::unless;
        short(self.name, "name", 24, "at most 24 bytes")?;
        short(self.firmware, "firmware", 16, "at most 16 bytes")?;
        let period = self.period;
        let holds = (10..=1_000_000).contains(&period);
        unless(holds, "period", "10 us to 1 s", period.into())?;
        let counts = self.counts_per_rev;
        let holds = COUNTS_PER_REV.contains(&counts);
        let expected = "1 to 1e9";
        unless(holds, "counts_per_rev", expected, counts.into())?;
        let Travel { low, high } = self.travel;
        unless(
            low < high,
            "travel",
            "a greatest count above the least",
            high.into(),
        )?;
        self.check_ceilings()?;
        self.check_channels()
    }

    fn check_ceilings(&self) -> Result<(), Refused> {
        let ceilings = self.ceilings;
        let names = ["volt", "speed", "acceleration", "current"];
        for (name, ceiling) in names.into_iter().zip(ceilings.fields()) {
            let expected = "a ceiling above 0, or inf";
            Refused::unless(ceiling > 0.0, name, expected, ceiling.into())?;
        }
        let volt = ceilings.volt;
        let holds = volt * self.steps_per_volt() <= i16::MAX.into();
        let expected = "a ceiling that the steps of the second channel can hold";
        Refused::unless(holds, "volt", expected, volt.into())?;
        let holds = self.can(capability::CURRENT) || ceilings.current == f32::INFINITY;
        let expected = "inf where the current is not measured";
        Refused::unless(holds, "current", expected, ceilings.current.into())
    }

    fn check_channels(&self) -> Result<(), Refused> {
        let count = self.channels.len();
        let holds = (2..=MAX_CHANNELS).contains(&count);
        let expected = "2 to 16 channels";
        Refused::unless(holds, "channels", expected, count as f64)?;
        for (index, channel) in self.channels.iter().enumerate() {
            channel.check(index, self.can(capability::CURRENT))?;
        }
        Ok(())
    }

    /// The reply to DESCRIBE after its result; `None` if there is no such channel.
    pub(super) fn describe(&self, index: u8, body: &mut Body) -> Option<()> {
        let channel = self.channels.get(usize::from(index))?;
        body.u8(index).u8(channel.encoding as u8);
        body.u32(channel.steps_per_unit);
        body.text(channel.name, 15).text(channel.unit, 7);
        Some(())
    }

    /// CRC-32 of version, period and the descriptions of all channels.
    pub(super) fn schema(&self, version: u8) -> u32 {
        let mut crc = Crc::new()
            .update(&[version])
            .update(&self.period.to_le_bytes());
        let mut body = Body::new();
        for index in 0..self.channels.len() as u8 {
            body.clear();
            self.describe(index, &mut body);
            crc = crc.update(body.bytes().unwrap_or(&[]));
        }
        crc.value()
    }
}

impl Channel {
    fn check(&self, index: usize, measures_current: bool) -> Result<(), Refused> {
        let unless = Refused::unless;
        let at = index as f64;
        short(self.name, "channel name", 15, "at most 15 bytes")?;
        short(self.unit, "channel unit", 7, "at most 7 bytes")?;
        let counts = (self.encoding, self.source) == (Encoding::Counts, Source::Counts);
        let holds = counts == (self.encoding == Encoding::Counts) && (index != 0 || counts);
        let expected = "the counter as counts in channel 0, no other source as counts";
        unless(holds, "channels", expected, at)?;
        let command = (self.encoding, self.source) == (Encoding::Steps, Source::Command);
        let expected = "the command in steps in channel 1";
        unless(index != 1 || command, "channels", expected, at)?;
        let holds = self.encoding != Encoding::Steps || self.steps_per_unit > 0;
        unless(
            holds,
            "steps_per_unit",
            "above 0",
            self.steps_per_unit.into(),
        )?;
        let holds = self.source != Source::Current || measures_current;
        unless(holds, "channels", "no current where none is measured", at)
    }
}

fn short(
    text: &str,
    name: &'static str,
    most: usize,
    expected: &'static str,
) -> Result<(), Refused> {
    Refused::unless(text.len() <= most, name, expected, text.len() as f64)
}
