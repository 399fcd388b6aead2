//! A host's session: what it has said already, what it was answered last.

use super::{Body, Frame};

/// Where a number stands to the last one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    New,
    Repeated,
    Old,
}

impl Order {
    /// Modulo 2^32, in half ranges.
    pub(super) fn of(sequence: u32, last: u32) -> Self {
        match sequence.wrapping_sub(last).cast_signed() {
            0 => Self::Repeated,
            1.. => Self::New,
            _ => Self::Old,
        }
    }
}

/// The kind and body of a reply, to be given again.
#[derive(Clone, Debug)]
pub(super) struct Reply {
    pub(super) kind: u8,
    pub(super) body: Body,
}

/// A host that has said HELLO.
#[derive(Clone, Debug)]
pub(super) struct Session {
    /// As the host chose it.
    pub(super) number: u32,
    /// The last command's.
    pub(super) command: u32,
    /// The last heartbeat's.
    pub(super) heartbeat: u32,
    /// To the last command.
    pub(super) reply: Option<Reply>,
    /// Frames of other sessions since boot.
    pub(super) foreign: u32,
}

impl Session {
    pub(super) const fn new(number: u32, foreign: u32) -> Self {
        Self {
            number,
            command: 0,
            heartbeat: 0,
            reply: None,
            foreign,
        }
    }

    /// Whether a frame is of this session; others are counted.
    pub(super) fn says(&mut self, frame: &Frame<'_>) -> bool {
        let own = frame.header.session() == self.number;
        if !own {
            self.foreign = self.foreign.wrapping_add(1);
        }
        own
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_compare_in_half_ranges() {
        assert_eq!(Order::of(1, 0), Order::New);
        assert_eq!(Order::of(0, 0), Order::Repeated);
        assert_eq!(Order::of(3, u32::MAX), Order::New);
        assert_eq!(Order::of(u32::MAX, 3), Order::Old);
        assert_eq!(Order::of(0x7FFF_FFFF, 0), Order::New);
        assert_eq!(Order::of(0x8000_0000, 0), Order::Old);
    }
}
