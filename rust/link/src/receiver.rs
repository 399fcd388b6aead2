//! The receiving side of the host: bytes in; frames, columns of samples and anomalies out. Anomalies are all counted,
//! and listed up to a bound.

use std::collections::VecDeque;

use sewfast_control::link::{Deframer, Frame, Rejected};
use sewfast_core::Result;

use crate::client::kind::SAMPLES;
use crate::samples::{Batch, Channel, Columns, Samples};
use crate::sequence::{Sequence, Verdict};

/// Set in the kind of every frame from a device.
const OF_A_DEVICE: u8 = 0x80;

/// Receives a device's frames.
///
/// A damaged, repeated or late frame is counted and listed, but not used. If a caller takes nothing, at most
/// [`Samples::ROOM`] samples and [`LISTED`] anomalies are kept.
///
/// ```
/// use sewfast_control::link::{Header, MAX_WIRE, encode};
/// use sewfast_link::{Channel, Receiver};
///
/// let mut receiver = Receiver::new();
/// receiver.expect(&[Channel::described(0, 1)?, Channel::described(1, 1000)?], 1000)?;
/// let mut wire = [0; MAX_WIRE];
/// let header = Header { kind: 0xc0, tag: 7, sequence: 41, time: 2_000_000 };
/// let body = [0, 100, 0, 0, 0, 3, 0, 0xd0, 0x07, 0x18, 0xfc];
/// let length = encode(&header, &body, &mut wire).unwrap_or(0);
/// receiver.feed(&wire[..length], |frame| panic!("{frame:?} is another frame"));
/// let (times, columns) = receiver.take();
/// assert_eq!(times, [2_000_000, 2_001_000]);
/// assert_eq!(columns, [[100.0, 103.0], [2.0, -1.0]]);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Receiver {
    deframer: Deframer,
    intake: Intake,
}

/// The processing of frames.
#[derive(Clone, Debug, Default)]
struct Intake {
    sequence: Sequence,
    samples: Option<Samples>,
    log: Log,
}

impl Receiver {
    /// Starts with the first whole frame.
    pub fn new() -> Self {
        Self::default()
    }

    /// The channels streamed from now on, in their order, sampled every `period` microseconds. Samples that have not
    /// been taken are dropped.
    ///
    /// # Errors
    /// Impossible channels or period.
    pub fn expect(&mut self, channels: &[Channel], period: u32) -> Result<()> {
        self.intake.samples = Some(Samples::new(channels, period)?);
        Ok(())
    }

    /// Takes received bytes. Frames other than samples go to `other`; while no channels are expected, samples do, too.
    pub fn feed(&mut self, mut bytes: &[u8], mut other: impl FnMut(&Frame<'_>)) {
        while let Some(found) = self.deframer.next(&mut bytes) {
            self.intake.take(found, &mut other);
        }
    }

    /// Times and columns of the samples since the last call; no columns while no channels are expected.
    pub fn take(&mut self) -> Columns {
        self.intake
            .samples
            .as_mut()
            .map(Samples::take)
            .unwrap_or_default()
    }

    /// Appends times and columns of the samples since the last call to `columns`, which has one for each channel; both
    /// keep their memory.
    pub fn append_to(&mut self, columns: &mut Columns) {
        if let Some(samples) = self.intake.samples.as_mut() {
            samples.append_to(columns);
        }
    }

    /// Device time of the newest sample that has not been taken \[us\].
    pub fn newest(&self) -> Option<i64> {
        self.intake.samples.as_ref().and_then(Samples::newest)
    }

    /// All counters.
    pub const fn counters(&self) -> &Counters {
        &self.intake.log.counters
    }

    /// The anomalies since the last call, oldest first.
    pub fn anomalies(&mut self) -> impl ExactSizeIterator<Item = Anomaly> + '_ {
        self.intake.log.drain()
    }
}

impl Intake {
    fn take(
        &mut self,
        found: std::result::Result<Frame<'_>, Rejected>,
        other: &mut impl FnMut(&Frame<'_>),
    ) {
        match found {
            Err(_) => self.log.note(Kind::Rejected, self.sequence.expected(), 1),
            Ok(frame) if frame.header.kind & OF_A_DEVICE == 0 => {
                self.log.note(Kind::Echoed, frame.header.sequence, 1);
            }
            Ok(frame) => {
                self.log.counters.frames += 1;
                if self.in_order(&frame) {
                    self.pass(&frame, other);
                }
            }
        }
    }

    /// Whether to use the frame.
    fn in_order(&mut self, frame: &Frame<'_>) -> bool {
        let (expected, number) = (self.sequence.expected(), frame.header.sequence);
        match self.sequence.judge(frame.header.tag, number) {
            Verdict::InOrder => {}
            Verdict::Missing(count) => self.log.note(Kind::Missing, expected, count),
            Verdict::Reset(before) => {
                self.log.note(Kind::Reset, number, before);
                self.samples.iter_mut().for_each(Samples::restart);
            }
            Verdict::Repeated => {
                self.log.note(Kind::Repeated, number, 1);
                return false;
            }
            Verdict::Late => {
                self.log.note(Kind::Late, number, 1);
                return false;
            }
        }
        true
    }

    fn pass(&mut self, frame: &Frame<'_>, other: &mut impl FnMut(&Frame<'_>)) {
        let header = frame.header;
        let Some(samples) = self.samples.as_mut().filter(|_| header.kind == SAMPLES) else {
            return other(frame);
        };
        match samples.add(header.time, frame.body) {
            Batch::Taken(count, flags) => {
                self.log.counters.samples += count as u64;
                self.log.counters.clipped += u64::from(flags & 1);
                self.log.counters.overflows += u64::from(flags >> 1 & 1);
            }
            Batch::NoRoom(count) => self.log.note(Kind::Untaken, header.sequence, count as u32),
            Batch::Malformed => self.log.note(Kind::Malformed, header.sequence, 1),
        }
    }
}

/// Most list entries kept for a caller that takes none.
pub const LISTED: usize = 1 << 14;

/// Kinds of anomalies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// When a frame came, the frames from this number up to it were missing.
    Missing,
    /// A frame came again.
    Repeated,
    /// A frame came after a later one.
    Late,
    /// The device has rebooted; the count is the number of its frames before the first one received.
    Reset,
    /// Bytes that were no frame; the number is the one expected at that time.
    Rejected,
    /// A frame of a host was returned.
    Echoed,
    /// A batch whose length does not match any number of samples.
    Malformed,
    /// Samples without room, because earlier ones were not taken.
    Untaken,
}

impl Kind {
    /// Its name in lower case.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Missing => "missing",
            Self::Repeated => "repeated",
            Self::Late => "late",
            Self::Reset => "reset",
            Self::Rejected => "rejected",
            Self::Echoed => "echoed",
            Self::Malformed => "malformed",
            Self::Untaken => "untaken",
        }
    }
}

/// An anomaly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Anomaly {
    /// Its kind.
    pub kind: Kind,
    /// The number of the (first) frame concerned.
    pub sequence: u32,
    /// Number of frames, or of samples for `Untaken`.
    pub count: u32,
}

/// The counters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Whole frames from a device, used or not.
    pub frames: u64,
    /// Samples that entered the columns.
    pub samples: u64,
    /// Blocks of bytes that were no frame.
    pub rejected: u64,
    /// Frames missing when a later one came, including those that came late.
    pub missing: u64,
    /// Frames that came again.
    pub repeated: u64,
    /// Frames that came after a later one.
    pub late: u64,
    /// Reboots seen.
    pub resets: u64,
    /// Frames of a host that were returned.
    pub echoed: u64,
    /// Batches whose length does not match any number of samples.
    pub malformed: u64,
    /// Samples without room.
    pub untaken: u64,
    /// Batches with a clipped command.
    pub clipped: u64,
    /// Batches before which the device's transmit memory overflowed.
    pub overflows: u64,
    /// Anomalies counted but not listed for lack of room.
    pub unlisted: u64,
}

impl Counters {
    /// All counters by name.
    pub const fn named(&self) -> [(&'static str, u64); 13] {
        [
            ("frames", self.frames),
            ("samples", self.samples),
            ("rejected", self.rejected),
            ("missing", self.missing),
            ("repeated", self.repeated),
            ("late", self.late),
            ("resets", self.resets),
            ("echoed", self.echoed),
            ("malformed", self.malformed),
            ("untaken", self.untaken),
            ("clipped", self.clipped),
            ("overflows", self.overflows),
            ("unlisted", self.unlisted),
        ]
    }

    fn of(&mut self, kind: Kind) -> &mut u64 {
        match kind {
            Kind::Missing => &mut self.missing,
            Kind::Repeated => &mut self.repeated,
            Kind::Late => &mut self.late,
            Kind::Reset => &mut self.resets,
            Kind::Rejected => &mut self.rejected,
            Kind::Echoed => &mut self.echoed,
            Kind::Malformed => &mut self.malformed,
            Kind::Untaken => &mut self.untaken,
        }
    }
}

/// Counters and list together.
#[derive(Clone, Debug, Default)]
struct Log {
    /// The counters.
    counters: Counters,
    list: VecDeque<Anomaly>,
}

impl Log {
    /// Counts and lists an anomaly. Repetitions at the same place, as from noise, are one entry.
    fn note(&mut self, kind: Kind, sequence: u32, count: u32) {
        *self.counters.of(kind) += if kind == Kind::Reset { 1 } else { count.into() };
        let last = self.list.back_mut();
        if let Some(last) = last.filter(|last| last.goes_on(kind, sequence)) {
            last.count = last.count.saturating_add(count);
        } else if self.list.len() < LISTED {
            self.list.push_back(Anomaly {
                kind,
                sequence,
                count,
            });
        } else {
            self.counters.unlisted += 1;
        }
    }

    /// The anomalies since the last call, oldest first.
    fn drain(&mut self) -> impl ExactSizeIterator<Item = Anomaly> + '_ {
        self.list.drain(..)
    }
}

impl Anomaly {
    fn goes_on(&self, kind: Kind, sequence: u32) -> bool {
        let untaken = kind == Kind::Untaken;
        let noise = kind == Kind::Rejected && self.sequence == sequence;
        self.kind == kind && (noise || untaken)
    }
}

#[cfg(test)]
mod tests;
