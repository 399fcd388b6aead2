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
    /// What ARM must repeat: only who hears the device knows it.
    pub(super) key: u32,
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
    pub(super) const fn new(number: u32, key: u32, foreign: u32) -> Self {
        Self {
            number,
            key,
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

/// A key out of what an outsider does not know; each bit of it hangs on every bit of `entropy`, `boot`, `session` and `now`
/// (SplitMix64, twice).
pub(super) const fn key(entropy: u32, boot: u32, session: u32, now: u64) -> u32 {
    let first = mixed(((entropy as u64) << 32) | boot as u64);
    (mixed(first ^ now.rotate_left(32) ^ session as u64) >> 32) as u32
}

const fn mixed(seed: u64) -> u64 {
    let z = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_hangs_on_all_that_it_is_made_of() {
        let base = key(1, 2, 3, 4);
        for bit in 0..32 {
            let others = [
                key(1 ^ 1 << bit, 2, 3, 4),
                key(1, 2 ^ 1 << bit, 3, 4),
                key(1, 2, 3 ^ 1 << bit, 4),
                key(1, 2, 3, 4 ^ 1 << bit),
            ];
            for other in others {
                let changed = (base ^ other).count_ones();
                assert!((6..=26).contains(&changed), "{changed}");
            }
        }
    }

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
