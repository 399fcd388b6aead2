//! The host's side of the bodies in docs/PROTOCOL.md: commands to a device, and its replies.
//!
//! Each command is written by the function of its name. Each reply is read by `of` of its struct, from the fields after
//! sequence and result; `None` means that the body is too short.

use sewfast_control::link::crc::Crc;
use sewfast_control::link::identity::{OLDEST, VERSION};
use sewfast_control::link::{Body, Fields};

fn written(write: impl FnOnce(&mut Body)) -> Body {
    let mut body = Body::new();
    write(&mut body);
    body
}

/// HELLO of a host that also speaks the version before.
#[must_use]
pub fn hello(session: u32) -> Body {
    written(|b| _ = b.u8(OLDEST).u8(VERSION).u32(session))
}

/// ARM, with the key from the reply to HELLO.
#[must_use]
pub fn arm(watchdog: u32, key: u32) -> Body {
    written(|b| _ = b.u32(watchdog).u32(key))
}

/// KEEP: the device may continue for `watchdog` \[us\].
#[must_use]
pub fn keep(watchdog: u32) -> Body {
    written(|b| _ = b.u32(watchdog))
}

/// DRIVE: the command of a direct run; also a heartbeat.
#[must_use]
pub fn drive(watchdog: u32, u: f64) -> Body {
    written(|b| _ = b.u32(watchdog).f32(u as f32))
}

/// CREDIT: the device's time may advance to `until` \[us\]; also a heartbeat.
#[must_use]
pub fn credit(watchdog: u32, until: u64) -> Body {
    written(|b| _ = b.u32(watchdog).u64(until))
}

/// LIMITS: volt, speed, acceleration, current; zeros ask for the limits in force.
#[must_use]
pub fn limits(values: [f64; 4]) -> Body {
    written(|b| numbers(b, &values))
}

/// UPLOAD of values in the table's encoding, from its value `offset` on.
#[must_use]
pub fn upload(table: u8, offset: u32, values: &[u8]) -> Body {
    written(|b| _ = b.u8(table).u32(offset).add(values))
}

/// GAINS: Kp, Ti, Td, alpha, beta, N, Tt, `u_min`, `u_max`, slew, `filter_time`, counts per unit, then the filter's samples.
#[must_use]
pub fn gains(values: [f64; 12], filter_samples: u8) -> Body {
    written(|b| {
        numbers(b, &values);
        b.u8(filter_samples);
    })
}

/// The fields after the gains, for a device with observer, ramp and schedule (speed, Kp, Ti, Td each).
pub fn design(body: &mut Body, observer_time: f64, r_rate: f64, schedule: &[[f64; 4]]) {
    numbers(body, &[observer_time, r_rate]);
    body.u8(u8::try_from(schedule.len()).unwrap_or(u8::MAX));
    for point in schedule {
        numbers(body, point);
    }
}

/// BIQUADS: sections of c0, c1, a1, a2.
#[must_use]
pub fn biquads(sections: &[[f64; 4]]) -> Body {
    written(|b| {
        b.u8(u8::try_from(sections.len()).unwrap_or(u8::MAX));
        for section in sections {
            numbers(b, section);
        }
    })
}

/// FEEDFORWARD: preview, lateness, levels of y and u, taps; without levels and taps it takes the feedforward away.
#[must_use]
pub fn feedforward(preview: u8, late: f64, levels: &[[f64; 2]], taps: &[f64]) -> Body {
    written(|b| {
        b.u8(preview);
        numbers(b, &[late]);
        b.u8(u8::try_from(levels.len()).unwrap_or(u8::MAX));
        for level in levels {
            numbers(b, level);
        }
        b.u8(u8::try_from(taps.len()).unwrap_or(u8::MAX));
        numbers(b, taps);
    })
}

/// POSITION: gain, fastest, landing and creep, samples of smoothing, whether it releases, rows of speed and rates away from and towards
/// rest.
#[must_use]
pub fn position(numbers: [f64; 4], smoothing: u8, releases: bool, rows: &[[f64; 3]]) -> Body {
    written(|b| {
        self::numbers(b, &numbers);
        b.u8(smoothing).u8(releases.into());
        b.u8(u8::try_from(rows.len()).unwrap_or(u8::MAX));
        for row in rows {
            self::numbers(b, row);
        }
    })
}

/// ANGLE: a stop at it \[counts\] from a sample of the run on, 0 for its next one.
#[must_use]
pub fn angle(at: u32, counts: f64, onward: bool) -> Body {
    written(|b| _ = b.u32(at).f32(counts as f32).u8((!onward).into()))
}

/// TRAVEL: least and greatest count; both 0 ask for the limits in force.
#[must_use]
pub fn travel(low: i32, high: i32) -> Body {
    written(|b| _ = b.i32(low).i32(high))
}

/// CONTROLLER: the number of a kind, counts per unit, then the numbers of the kind.
#[must_use]
pub fn controller(kind: u8, counts_per_unit: f64, values: &[f64]) -> Body {
    written(|b| {
        b.u8(kind);
        numbers(b, &[counts_per_unit]);
        numbers(b, values);
    })
}

/// Each value in single precision; infinite beyond its range.
fn numbers(body: &mut Body, values: &[f64]) {
    for &value in values {
        body.f32(value as f32);
    }
}

/// START of a run: its mode, its start (0 for the next sample), its length and the streamed channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Start {
    /// 0 commands, 1 controller, 2 direct, 3 positions.
    pub mode: u8,
    /// Time of the watchdog \[us\].
    pub watchdog: u32,
    /// Device time of the first sample \[us\]; 0 for the next one.
    pub at: u64,
    /// Samples.
    pub length: u32,
    /// A bit for each streamed channel.
    pub mask: u16,
    /// Samples in a frame.
    pub batch: u8,
}

impl Start {
    /// The body.
    #[must_use]
    pub fn body(&self) -> Body {
        written(|b| {
            b.u8(self.mode).u32(self.watchdog).u64(self.at);
            b.u32(self.length).u16(self.mask).u8(self.batch);
        })
    }
}

/// The head of every reply: the command's number and 0, or why it was refused. The remaining fields are the reply itself.
pub fn reply(fields: &mut Fields<'_>) -> Option<(u32, u8)> {
    Some((fields.u32()?, fields.u8()?))
}

/// A text; invalid UTF-8 in it is shown as such.
fn text(fields: &mut Fields<'_>) -> Option<String> {
    let length = fields.u8()?;
    let bytes = fields.take(length.into())?;
    Some(String::from_utf8_lossy(bytes).into_owned())
}

/// The reply to HELLO.
#[derive(Clone, Debug, PartialEq)]
pub struct Greeting {
    /// Version of the protocol.
    pub version: u8,
    /// Boot id, different after each reset.
    pub boot: u32,
    /// CRC-32 of the channels, see [`schema`].
    pub schema: u32,
    /// The device's state at that time.
    pub state: u8,
    /// Number of channels.
    pub channels: u8,
    /// Control period \[us\].
    pub period: u32,
    /// Bits of `sewfast_control::link::capability`.
    pub capabilities: u32,
    /// Number of values that its profile memory holds.
    pub capacity: u32,
    /// Encoder counts per turn.
    pub counts_per_rev: f32,
    /// The device's name.
    pub name: String,
    /// Its firmware's version.
    pub firmware: String,
    /// The session whose HELLO it answers.
    pub session: u32,
    /// The key that ARM repeats.
    pub key: u32,
}

impl Greeting {
    /// The fields of a reply.
    pub fn of(fields: &mut Fields<'_>) -> Option<Self> {
        Some(Self {
            version: fields.u8()?,
            boot: fields.u32()?,
            schema: fields.u32()?,
            state: fields.u8()?,
            channels: fields.u8()?,
            period: fields.u32()?,
            capabilities: fields.u32()?,
            capacity: fields.u32()?,
            counts_per_rev: fields.f32()?,
            name: text(fields)?,
            firmware: text(fields)?,
            session: fields.u32()?,
            key: fields.u32()?,
        })
    }
}

/// The reply to DESCRIBE.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Description {
    /// Number of the channel.
    pub number: u8,
    /// Encoding of its samples.
    pub encoding: u8,
    /// Steps per unit, for encoding 1.
    pub steps_per_unit: u32,
    /// Name of the quantity.
    pub name: String,
    /// Its unit.
    pub unit: String,
}

impl Description {
    /// The fields of a reply.
    pub fn of(fields: &mut Fields<'_>) -> Option<Self> {
        Some(Self {
            number: fields.u8()?,
            encoding: fields.u8()?,
            steps_per_unit: fields.u32()?,
            name: text(fields)?,
            unit: text(fields)?,
        })
    }
}

/// CRC-32 of version, period and the replies to all DESCRIBE, as announced by HELLO.
#[must_use]
pub fn schema<'a>(version: u8, period: u32, replies: impl IntoIterator<Item = &'a [u8]>) -> u32 {
    let head = Crc::new().update(&[version]).update(&period.to_le_bytes());
    let all = replies.into_iter().fold(head, Crc::update);
    all.value()
}

/// The reply to STATUS: about the run in progress, or the last one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Status {
    /// The device's state.
    pub state: u8,
    /// Reason of its last trip.
    pub reason: u8,
    /// Mode of the run.
    pub mode: u8,
    /// Streamed channels.
    pub mask: u16,
    /// Its number.
    pub run: u32,
    /// Its first sample \[us\].
    pub start: u64,
    /// Samples taken in it.
    pub samples: u32,
    /// Length of the run \[samples\].
    pub length: u32,
    /// End of the profile.
    pub end: u32,
    /// Speed \[RPM\].
    pub speed: f32,
    /// The counter.
    pub counts: i32,
    /// Received frames.
    pub received: u32,
    /// Refused frames.
    pub refused: u32,
    /// Frames dropped because its transmit memory was full.
    pub dropped: u32,
    /// Its latest control period \[us late\].
    pub late: u32,
    /// The session it is in.
    pub session: u32,
    /// Frames of other sessions.
    pub foreign: u32,
}

impl Status {
    /// The fields of a reply.
    pub fn of(fields: &mut Fields<'_>) -> Option<Self> {
        Some(Self {
            state: fields.u8()?,
            reason: fields.u8()?,
            mode: fields.u8()?,
            mask: fields.u16()?,
            run: fields.u32()?,
            start: fields.u64()?,
            samples: fields.u32()?,
            length: fields.u32()?,
            end: fields.u32()?,
            speed: fields.f32()?,
            counts: fields.i32()?,
            received: fields.u32()?,
            refused: fields.u32()?,
            dropped: fields.u32()?,
            late: fields.u32()?,
            session: fields.u32()?,
            foreign: fields.u32()?,
        })
    }
}

/// The reply to LIMITS: volt, speed, acceleration and current in force, then the device's ceilings.
pub fn limits_of(fields: &mut Fields<'_>) -> Option<[f32; 8]> {
    let mut found = [0.0; 8];
    for value in &mut found {
        *value = fields.f32()?;
    }
    Some(found)
}

/// The reply to TRAVEL: least and greatest count in force, then the device's own.
pub fn travel_of(fields: &mut Fields<'_>) -> Option<[i32; 4]> {
    let mut found = [0; 4];
    for value in &mut found {
        *value = fields.i32()?;
    }
    Some(found)
}

/// The reply to START: the run's number and its first sample \[us\].
pub fn started(fields: &mut Fields<'_>) -> Option<(u32, u64)> {
    Some((fields.u32()?, fields.u64()?))
}

/// The reply to UPLOAD: end of the profile, and number of further values that fit.
pub fn uploaded(fields: &mut Fields<'_>) -> Option<(u32, u32)> {
    Some((fields.u32()?, fields.u32()?))
}

/// An event on the device, `samples` into a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// The code of the event.
    pub code: u8,
    /// The resulting state.
    pub state: u8,
    /// Reason of a trip.
    pub reason: u8,
    /// The run.
    pub run: u32,
    /// Its samples so far.
    pub samples: u32,
    /// The value that tripped it.
    pub value: f32,
}

impl Event {
    /// The fields of an event.
    pub fn of(fields: &mut Fields<'_>) -> Option<Self> {
        Some(Self {
            code: fields.u8()?,
            state: fields.u8()?,
            reason: fields.u8()?,
            run: fields.u32()?,
            samples: fields.u32()?,
            value: fields.f32()?,
        })
    }
}

/// The status that a device sends while it does not run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beat {
    /// Its boot id.
    pub boot: u32,
    /// Its state.
    pub state: u8,
    /// Reason of its last trip.
    pub reason: u8,
}

impl Beat {
    /// The fields of a beat; the speed after them is not read.
    pub fn of(fields: &mut Fields<'_>) -> Option<Self> {
        Some(Self {
            boot: fields.u32()?,
            state: fields.u8()?,
            reason: fields.u8()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_reply_is_read_or_too_short(body in prop::collection::vec(any::<u8>(), 0..120)) {
            let fields = || Fields::new(&body);
            prop_assert_eq!(Status::of(&mut fields()).is_some(), body.len() >= 61);
            prop_assert_eq!(Event::of(&mut fields()).is_some(), body.len() >= 15);
            prop_assert_eq!(limits_of(&mut fields()).is_some(), body.len() >= 32);
            prop_assert_eq!(travel_of(&mut fields()).is_some(), body.len() >= 16);
            prop_assert_eq!(started(&mut fields()).is_some(), body.len() >= 12);
            prop_assert_eq!(uploaded(&mut fields()).is_some(), body.len() >= 8);
            prop_assert_eq!(reply(&mut fields()).is_some(), body.len() >= 5);
            prop_assert!(Greeting::of(&mut fields()).is_none() || body.len() >= 37);
            prop_assert!(Description::of(&mut fields()).is_none() || body.len() >= 8);
        }
    }

    #[test]
    fn commands_are_as_the_protocol_says() {
        let bytes = |body: &Body| body.bytes().unwrap().to_vec();
        assert_eq!(bytes(&hello(0x0403_0201)), [3, 4, 1, 2, 3, 4]);
        let moves = position([1.0; 4], 8, true, &[[0.0; 3]; 8]);
        assert_eq!(bytes(&moves).len(), 16 + 3 + 96);
        assert_eq!(bytes(&moves)[16..19], [8, 1, 8]);
        assert_eq!(
            bytes(&angle(2, 1.0, true)),
            [2, 0, 0, 0, 0, 0, 0x80, 0x3F, 0]
        );
        assert_eq!(bytes(&travel(-1, 1)), [255, 255, 255, 255, 1, 0, 0, 0]);
        assert_eq!(bytes(&arm(1, 2)), [1, 0, 0, 0, 2, 0, 0, 0]);
        assert_eq!(bytes(&keep(256)), [0, 1, 0, 0]);
        assert_eq!(bytes(&drive(1, 1.0)), [1, 0, 0, 0, 0, 0, 0x80, 0x3F]);
        assert_eq!(bytes(&credit(1, 2)), [1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bytes(&upload(1, 2, b"ab")), [1, 2, 0, 0, 0, b'a', b'b']);
        assert_eq!(
            bytes(&limits([0.0, 0.0, 0.0, 1e300]))[12..],
            f32::INFINITY.to_le_bytes()
        );
        assert_eq!(upload(0, 0, &[0; 227]).bytes(), None);
        let start = Start {
            mode: 2,
            watchdog: 1,
            at: 2,
            length: 3,
            mask: 4,
            batch: 5,
        };
        let expected = [2, 1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 4, 0, 5];
        assert_eq!(bytes(&start.body()), expected);
        assert_eq!(bytes(&biquads(&[[0.0; 4]; 3])).len(), 49);
        assert_eq!(
            bytes(&controller(1, 1.0, &[0.0])),
            [1, 0, 0, 0x80, 0x3F, 0, 0, 0, 0]
        );
        let mut body = gains([0.0; 12], 7);
        design(&mut body, 0.0, f64::INFINITY, &[[1.0; 4]; 2]);
        assert_eq!(bytes(&body).len(), 49 + 9 + 32);
        assert_eq!((bytes(&body)[48], bytes(&body)[57]), (7, 2));
    }
}
