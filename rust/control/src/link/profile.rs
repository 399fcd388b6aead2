//! The uploaded commands or references: a ring of values, each written once and played once.

use super::command::Refusal;

/// The kind of values in a profile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Table {
    Commands = 0,
    References = 1,
    Goals = 2,
}

/// Values `end - CAPACITY .. end` of a profile, numbered from its beginning.
#[derive(Clone, Debug)]
pub(super) struct Profile<const CAPACITY: usize> {
    values: [f32; CAPACITY],
    table: Table,
    end: u32,
    played: u32,
    /// Least and greatest value or 0, as limits may change after the upload.
    low: f32,
    high: f32,
}

impl<const CAPACITY: usize> Profile<CAPACITY> {
    const ROOM: u32 = {
        assert!(CAPACITY > 0 && CAPACITY <= u32::MAX as usize);
        CAPACITY as u32
    };

    pub(super) const fn new() -> Self {
        Self {
            values: [0.0; CAPACITY],
            table: Table::Commands,
            end: 0,
            played: 0,
            low: 0.0,
            high: 0.0,
        }
    }

    /// The number of the value after the last one.
    pub(super) fn end(&self) -> u32 {
        self.end
    }

    /// Values that can be written now.
    pub(super) fn room(&self) -> u32 {
        Self::ROOM.saturating_sub(self.end.saturating_sub(self.played))
    }

    /// Largest magnitude.
    pub(super) fn peak(&self) -> f32 {
        self.high.max(-self.low)
    }

    /// Least and greatest value, or 0.
    pub(super) fn range(&self) -> (f32, f32) {
        (self.low, self.high)
    }

    /// Whether a run can start: there are values of this kind, including the first.
    pub(super) fn holds(&self, table: Table) -> bool {
        self.table == table && (1..=Self::ROOM).contains(&self.end)
    }

    /// Forgets all values.
    pub(super) fn clear(&mut self, table: Table) {
        self.table = table;
        self.end = 0;
        self.played = 0;
        (self.low, self.high) = (0.0, 0.0);
    }

    /// How many of `count` values from `offset` on are already there.
    ///
    /// # Errors
    /// A gap before `offset`, values that differ from those already there, no room.
    pub(super) fn place(&self, table: Table, offset: u32, count: u32) -> Result<u32, Refusal> {
        if self.table != table {
            return Err(Refusal::order(0));
        }
        let known = self.end.checked_sub(offset);
        let known = known.ok_or(Refusal::order(self.end))?;
        let fresh = count.saturating_sub(known);
        let fits = fresh <= self.room() && self.end.checked_add(fresh).is_some();
        if fits {
            Ok(known)
        } else {
            Err(Refusal::room(known.saturating_add(self.room())))
        }
    }

    /// Appends a value; [`place`](Self::place) has found room for it.
    pub(super) fn push(&mut self, value: f32) {
        if self.room() == 0 {
            return;
        }
        let slot = self.end as usize % CAPACITY;
        if let Some(slot) = self.values.get_mut(slot) {
            *slot = value;
            self.end = self.end.saturating_add(1);
            (self.low, self.high) = (self.low.min(value), self.high.max(value));
        }
    }

    /// The next value; `None` if the profile has run dry.
    pub(super) fn play(&mut self) -> Option<f32> {
        if self.played >= self.end {
            return None;
        }
        let value = self.values.get(self.played as usize % CAPACITY).copied();
        self.played = self.played.saturating_add(1);
        value
    }

    /// Returns to the first value after a run; a profile whose first values were overwritten is cleared.
    pub(super) fn rewind(&mut self) {
        if self.end > Self::ROOM {
            self.clear(self.table);
        }
        self.played = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn upload<const N: usize>(
        profile: &mut Profile<N>,
        offset: u32,
        values: &[f32],
    ) -> Result<(), Refusal> {
        let known = profile.place(Table::Commands, offset, values.len() as u32)?;
        for &value in values.iter().skip(known as usize) {
            profile.push(value);
        }
        Ok(())
    }

    proptest! {
        /// In any pieces, repeated and overlapping, and for any number of turns of the ring.
        #[test]
        fn plays_what_was_uploaded(
            values in prop::collection::vec(-9.0f32..9.0, 1..200),
            cuts in prop::collection::vec((0usize..12, 0usize..9, 0usize..12), 1..400),
        ) {
            let mut profile = Profile::<16>::new();
            let mut played = Vec::new();
            for (back, count, play) in cuts {
                let end = profile.end() as usize;
                let offset = end.saturating_sub(back);
                let piece = &values[offset..(offset + count).min(values.len()).max(offset)];
                let fits = (end - offset) + profile.room() as usize;
                let result = upload(&mut profile, offset as u32, piece);
                prop_assert_eq!(result.is_ok(), piece.len() <= fits);
                if let Err(refusal) = result {
                    prop_assert_eq!(refusal, Refusal::room(fits as u32));
                }
                played.extend((0..play).map_while(|_| profile.play()));
                prop_assert!(profile.end() as usize - played.len() <= 16);
            }
            prop_assert_eq!(&played[..], &values[..played.len()]);
        }
    }

    #[test]
    fn refuses_gaps_and_other_tables() {
        let mut profile = Profile::<8>::new();
        assert_eq!(upload(&mut profile, 1, &[1.0]), Err(Refusal::order(0)));
        upload(&mut profile, 0, &[1.0, -2.0]).unwrap();
        assert_eq!(upload(&mut profile, 3, &[1.0]), Err(Refusal::order(2)));
        let other = profile.place(Table::References, 2, 1);
        assert_eq!(other, Err(Refusal::order(0)));
        assert_eq!(profile.peak(), 2.0);
        assert!(profile.holds(Table::Commands) && !profile.holds(Table::References));
    }

    #[test]
    fn a_profile_without_its_beginning_cannot_start() {
        let mut profile = Profile::<4>::new();
        upload(&mut profile, 0, &[1.0; 4]).unwrap();
        assert_eq!(profile.play(), Some(1.0));
        profile.rewind();
        assert!(profile.holds(Table::Commands));
        profile.play();
        upload(&mut profile, 4, &[2.0]).unwrap();
        assert!(!profile.holds(Table::Commands));
        profile.rewind();
        assert_eq!(
            (profile.end(), profile.room(), profile.play()),
            (0, 4, None)
        );
    }
}
