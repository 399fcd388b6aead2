//! The sequence of a device's frames: which are in order, missing, repeated or late.

/// How far back a repeat can be distinguished from a late frame.
const WINDOW: u32 = 4096;
const HALF: u32 = 1 << 31;
/// This many consecutive frames with the previous boot's tag are a new boot that happens to have the same tag.
const INSISTENT: u32 = 16;

/// The verdict on a frame's number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The expected number, or the first one seen.
    InOrder,
    /// The number of frames missing before this one.
    Missing(u32),
    /// Another boot; the number of its frames missing before this one.
    Reset(u32),
    /// Received before; not to be used.
    Repeated,
    /// A later frame, or one of the next boot, was received before; not to be used.
    Late,
}

/// Compares each frame's number with the expected one, modulo 2^32, by half ranges.
#[derive(Clone, Debug)]
pub struct Sequence {
    tag: Option<u16>,
    expected: u32,
    seen: [u64; WINDOW as usize / 64],
    former: Former,
}

/// The previous boot, whose frames may still arrive.
#[derive(Clone, Copy, Debug, Default)]
struct Former {
    tag: Option<u16>,
    next: u32,
    in_a_row: u32,
}

impl Sequence {
    /// Starts with the first number received.
    pub const fn new() -> Self {
        Self {
            tag: None,
            expected: 0,
            seen: [0; WINDOW as usize / 64],
            former: Former {
                tag: None,
                next: 0,
                in_a_row: 0,
            },
        }
    }

    /// The next expected number.
    pub const fn expected(&self) -> u32 {
        self.expected
    }

    /// Judges the number of a received frame.
    #[inline]
    pub fn judge(&mut self, tag: u16, sequence: u32) -> Verdict {
        match self.tag {
            Some(current) if current == tag => {
                self.former.in_a_row = 0;
                self.compare(sequence)
            }
            Some(_) if self.former.tag == Some(tag) && !self.former.insists(sequence) => {
                Verdict::Late
            }
            Some(current) => {
                self.begin(tag, sequence);
                self.former.tag = Some(current);
                Verdict::Reset(sequence)
            }
            None => {
                self.begin(tag, sequence);
                Verdict::InOrder
            }
        }
    }

    fn begin(&mut self, tag: u16, sequence: u32) {
        *self = Self::new();
        self.tag = Some(tag);
        self.expected = sequence;
        self.advance(sequence);
    }

    fn compare(&mut self, sequence: u32) -> Verdict {
        let ahead = sequence.wrapping_sub(self.expected);
        if ahead < HALF {
            for k in 0..ahead.min(WINDOW) {
                self.mark(self.expected.wrapping_add(k), false);
            }
            self.advance(sequence);
            return match ahead {
                0 => Verdict::InOrder,
                missing => Verdict::Missing(missing),
            };
        }
        let within = self.expected.wrapping_sub(sequence) <= WINDOW;
        if within && self.mark(sequence, true) {
            Verdict::Repeated
        } else {
            Verdict::Late
        }
    }

    fn advance(&mut self, sequence: u32) {
        self.mark(sequence, true);
        self.expected = sequence.wrapping_add(1);
    }

    /// Marks whether a number of the window was received; returns its previous mark.
    fn mark(&mut self, sequence: u32, came: bool) -> bool {
        let at = sequence % WINDOW;
        let (word, bit) = (&mut self.seen[at as usize / 64], 1 << (at % 64));
        let before = *word & bit != 0;
        *word = if came { *word | bit } else { *word & !bit };
        before
    }
}

impl Default for Sequence {
    fn default() -> Self {
        Self::new()
    }
}

impl Former {
    /// Whether its frames have followed one another for so long that they cannot be leftovers.
    fn insists(&mut self, sequence: u32) -> bool {
        let follows = sequence == self.next;
        self.in_a_row = if follows { self.in_a_row + 1 } else { 1 };
        self.next = sequence.wrapping_add(1);
        self.in_a_row >= INSISTENT
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashSet;

    /// The rule in its simplest form, without modulo and without a window.
    fn by_sets(numbers: &[u64]) -> Vec<Verdict> {
        let (mut came, mut expected) = (HashSet::new(), numbers[0]);
        let judge = |&number: &u64| {
            let missing = number.saturating_sub(expected) as u32;
            let verdict = match (number >= expected, missing, came.contains(&number)) {
                (true, 0, _) => Verdict::InOrder,
                (true, n, _) => Verdict::Missing(n),
                (false, _, true) => Verdict::Repeated,
                (false, _, false) => Verdict::Late,
            };
            expected = expected.max(number + 1);
            came.insert(number);
            verdict
        };
        numbers.iter().map(judge).collect()
    }

    proptest! {
        #[test]
        fn equals_the_rule_in_sets_at_any_start(
            start in any::<u32>(), steps in prop::collection::vec((0..40i64, any::<bool>()), 1..400),
        ) {
            let mut at = 1_000i64;
            let numbers: Vec<u64> = steps
                .iter()
                .map(|&(step, back)| {
                    let number = if back { at - step } else { at + step / 8 };
                    at = at.max(number + 1);
                    number.max(0) as u64
                })
                .collect();
            let mut sequence = Sequence::new();
            let judged: Vec<Verdict> = numbers
                .iter()
                .map(|&number| sequence.judge(9, start.wrapping_add(number as u32)))
                .collect();
            prop_assert_eq!(judged, by_sets(&numbers));
        }
    }

    #[test]
    fn a_gap_may_be_longer_than_the_window() {
        let mut sequence = Sequence::new();
        (0..5000).for_each(|n| assert_eq!(sequence.judge(1, n), Verdict::InOrder));
        assert_eq!(sequence.judge(1, 100_000), Verdict::Missing(95_000));
        assert_eq!(sequence.judge(1, 99_999), Verdict::Late);
        assert_eq!(sequence.judge(1, 99_999), Verdict::Repeated);
        assert_eq!(sequence.judge(1, 4_999), Verdict::Late);
        assert_eq!(sequence.judge(1, 100_001), Verdict::InOrder);
    }

    #[test]
    fn leftovers_of_the_boot_before_are_late() {
        let mut sequence = Sequence::new();
        assert_eq!(sequence.judge(1, 70), Verdict::InOrder);
        assert_eq!(sequence.judge(2, 3), Verdict::Reset(3));
        assert_eq!(sequence.judge(1, 71), Verdict::Late);
        assert_eq!(sequence.judge(2, 4), Verdict::InOrder);
        assert_eq!(sequence.judge(2, 3), Verdict::Repeated);
        assert_eq!(sequence.judge(3, 0), Verdict::Reset(0));
    }

    #[test]
    fn leftovers_do_not_add_up_while_the_boot_goes_on() {
        let mut sequence = Sequence::new();
        sequence.judge(1, 70);
        sequence.judge(2, 0);
        for n in 0..40 {
            assert_eq!(sequence.judge(1, 71 + n), Verdict::Late);
            if n % 10 == 9 {
                assert_eq!(sequence.judge(2, n / 10 + 1), Verdict::InOrder);
            }
        }
    }

    #[test]
    fn half_of_all_numbers_lie_ahead() {
        let judged = |ahead: u32| {
            let mut sequence = Sequence::new();
            sequence.judge(1, 999);
            sequence.judge(1, 1000u32.wrapping_add(ahead))
        };
        assert_eq!(judged(HALF - 1), Verdict::Missing(HALF - 1));
        assert_eq!(judged(HALF), Verdict::Late);
        assert_eq!(judged(u32::MAX), Verdict::Repeated);
    }

    #[test]
    fn a_boot_that_has_the_tag_of_the_one_before_the_last_is_found() {
        let mut sequence = Sequence::new();
        sequence.judge(1, 70);
        sequence.judge(2, 0);
        let verdicts: Vec<Verdict> = (0..20).map(|n| sequence.judge(1, n)).collect();
        assert_eq!(
            verdicts[14..17],
            [Verdict::Late, Verdict::Reset(15), Verdict::InOrder]
        );
    }
}
