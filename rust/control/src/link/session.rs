//! The device's knowledge of the host: its last numbers, its last reply, and how long to go on without it.

use super::{Body, Frame};

/// Order of a number relative to the last one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    New,
    Repeated,
    Old,
}

impl Order {
    /// Modulo 2^32, by half ranges.
    pub(super) fn of(sequence: u32, last: u32) -> Self {
        match sequence.wrapping_sub(last).cast_signed() {
            0 => Self::Repeated,
            1.. => Self::New,
            _ => Self::Old,
        }
    }
}

/// The kind and body of a reply, kept for repetition.
#[derive(Clone, Debug)]
pub(super) struct Reply {
    pub(super) kind: u8,
    pub(super) body: Body,
}

/// A host that has said HELLO.
#[derive(Clone, Debug)]
pub(super) struct Session {
    /// Chosen by the host.
    pub(super) number: u32,
    /// ARM must repeat it: only a host that hears the device knows it.
    pub(super) key: u32,
    /// The last command's number.
    pub(super) command: u32,
    /// The last heartbeat's number.
    pub(super) heartbeat: u32,
    /// Reply to the last command.
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

    /// Whether a frame belongs to this session; others are counted.
    pub(super) fn says(&mut self, frame: &Frame<'_>) -> bool {
        let own = frame.header.session() == self.number;
        if !own {
            self.foreign = self.foreign.wrapping_add(1);
        }
        own
    }
}

/// A key from values that an outsider does not know; each of its bits depends on every bit of `entropy`, `boot`,
/// `session` and `now` (SplitMix64, twice).
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

/// Expires by time, and by samples in case the clock stands still.
#[derive(Clone, Debug)]
pub(super) struct Watchdog {
    period: u64,
    fed: u64,
    time: u64,
    samples: u64,
}

impl Watchdog {
    /// A watchdog that has expired.
    pub(super) const fn new(period: u32) -> Self {
        Self {
            period: period as u64,
            fed: 0,
            time: 0,
            samples: 0,
        }
    }

    /// Restarts it.
    pub(super) fn feed(&mut self, now: u64, time: u32) {
        self.fed = now;
        self.time = time.into();
        self.samples = 0;
    }

    /// Counts a sample.
    pub(super) fn count(&mut self) {
        self.samples = self.samples.saturating_add(1);
    }

    /// Whether it has expired.
    ///
    /// Jitter can add two samples to those that fit the time; with more the clock is wrong.
    pub(super) fn is_out(&self, now: u64) -> bool {
        let longest = self.time.saturating_add(2 * self.period);
        now.saturating_sub(self.fed) >= self.time
            || self.samples.saturating_mul(self.period) > longest
    }
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

    #[test]
    fn runs_out_by_time_or_by_samples() {
        let mut watchdog = Watchdog::new(1000);
        assert!(watchdog.is_out(0));
        watchdog.feed(7, 50_000);
        assert!(!watchdog.is_out(50_006) && watchdog.is_out(50_007));
        watchdog.feed(u64::MAX, 50_000);
        let lasts = (1..).find(|_| {
            watchdog.count();
            watchdog.is_out(u64::MAX)
        });
        assert_eq!(lasts, Some(53));
    }
}
