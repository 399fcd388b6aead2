//! The receiving side of the host: bytes in; frames, columns of samples and everything that went wrong out.

use sewfast_control::link::{Deframer, Frame, Rejected};
use sewfast_core::Result;

use crate::anomalies::{Anomaly, Counters, Kind, Log};
use crate::client::kind::SAMPLES;
use crate::samples::{Batch, Channel, Columns, Samples};
use crate::sequence::{Sequence, Verdict};

/// Set in the kind of every frame of a device.
const OF_A_DEVICE: u8 = 0x80;

/// Receives what a device sends.
///
/// A frame that is damaged, repeated or late is counted and listed, and not used. What is kept for a caller that takes
/// nothing is bounded: [`Samples::ROOM`] samples and [`LISTED`](crate::anomalies::LISTED) anomalies.
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

/// What becomes of the frames.
#[derive(Clone, Debug, Default)]
struct Intake {
    sequence: Sequence,
    samples: Option<Samples>,
    log: Log,
}

impl Receiver {
    /// Takes the first whole frame as the start.
    pub fn new() -> Self {
        Self::default()
    }

    /// The channels that are streamed from now on, in their order, sampled every `period` microseconds. Samples that have not been
    /// taken are dropped.
    ///
    /// # Errors
    /// Channels or a period that cannot be.
    pub fn expect(&mut self, channels: &[Channel], period: u32) -> Result<()> {
        self.intake.samples = Some(Samples::new(channels, period)?);
        Ok(())
    }

    /// Take bytes as they came. Frames other than samples go to `other`, and samples too while no channels are expected.
    pub fn feed(&mut self, mut bytes: &[u8], mut other: impl FnMut(&Frame<'_>)) {
        while let Some(found) = self.deframer.next(&mut bytes) {
            self.intake.take(found, &mut other);
        }
    }

    /// Times and columns of the samples since the last call; no column while no channels are expected.
    pub fn take(&mut self) -> Columns {
        self.intake
            .samples
            .as_mut()
            .map(Samples::take)
            .unwrap_or_default()
    }

    /// Appends times and columns of the samples since the last call to `columns`, which has one for each channel; both keep
    /// their memory.
    pub fn append_to(&mut self, columns: &mut Columns) {
        if let Some(samples) = self.intake.samples.as_mut() {
            samples.append_to(columns);
        }
    }

    /// Device time of the newest sample that has not been taken \[us\].
    pub fn newest(&self) -> Option<i64> {
        self.intake.samples.as_ref().and_then(Samples::newest)
    }

    /// How often everything has happened.
    pub const fn counters(&self) -> &Counters {
        &self.intake.log.counters
    }

    /// What went wrong since the last call, oldest first.
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

    /// Whether the frame is to be used.
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

#[cfg(test)]
mod tests;
