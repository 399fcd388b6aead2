//! What went wrong on the way: counted without end, listed within bounds.

use std::collections::VecDeque;

/// The longest list that is kept for a caller that does not take it.
pub const LISTED: usize = 1 << 14;

/// What went wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Frames from this number on had not come when the one after them came.
    Missing,
    /// A frame came again.
    Repeated,
    /// A frame came after a later one.
    Late,
    /// The device has booted; the count is that of the boot's frames before the first that came.
    Reset,
    /// Bytes were no frame; the number is the one expected then.
    Rejected,
    /// A frame of a host came back.
    Echoed,
    /// A batch of samples whose length fits no number of samples.
    Malformed,
    /// Samples for which there was no room, as nobody took the earlier ones.
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

/// One thing that went wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Anomaly {
    /// What it was.
    pub kind: Kind,
    /// The number of the (first) frame that it concerns.
    pub sequence: u32,
    /// How many; frames, or samples where they were not taken.
    pub count: u32,
}

/// How often everything has happened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Whole frames of a device, used or not.
    pub frames: u64,
    /// Samples that entered the columns.
    pub samples: u64,
    /// Blocks of bytes that were no frame.
    pub rejected: u64,
    /// Frames that had not come when a later one came; those that came late are among them.
    pub missing: u64,
    /// Frames that came again.
    pub repeated: u64,
    /// Frames that came after a later one.
    pub late: u64,
    /// Boots seen, without the first.
    pub resets: u64,
    /// Frames of a host that came back.
    pub echoed: u64,
    /// Batches whose length fits no number of samples.
    pub malformed: u64,
    /// Samples for which there was no room.
    pub untaken: u64,
    /// Batches with a clipped command.
    pub clipped: u64,
    /// Batches before which the device's transmit memory had overflowed.
    pub overflows: u64,
    /// Anomalies that were counted but found no room in the list.
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
pub struct Log {
    /// How often everything has happened.
    pub counters: Counters,
    list: VecDeque<Anomaly>,
}

impl Log {
    /// Count and list what went wrong. What repeats at the same place, as noise does, is one entry.
    pub fn note(&mut self, kind: Kind, sequence: u32, count: u32) {
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

    /// What went wrong since the last call, oldest first.
    pub fn drain(&mut self) -> impl ExactSizeIterator<Item = Anomaly> + '_ {
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
