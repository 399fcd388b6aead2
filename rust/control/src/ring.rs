//! The last 32 values, newest first: references and positions that are used later.

use crate::Real;

/// Values kept.
pub(crate) const KEPT: usize = 32;

/// The last values; the newest is at `newest`, older ones follow it.
#[derive(Clone, Debug)]
pub(crate) struct Ring<T> {
    kept: [T; KEPT],
    newest: usize,
}

impl<T: Real> Ring<T> {
    /// As if the value had been the same for ever.
    pub(crate) fn filled(value: T) -> Self {
        Self {
            kept: [value; KEPT],
            newest: 0,
        }
    }

    pub(crate) fn push(&mut self, value: T) {
        self.newest = (self.newest + KEPT - 1) % KEPT;
        if let Some(place) = self.kept.get_mut(self.newest) {
            *place = value;
        }
    }

    fn place(&self, age: usize) -> usize {
        (self.newest + age) % KEPT
    }

    /// The value `age` pushes before the newest.
    pub(crate) fn at(&self, age: usize) -> T {
        self.kept.get(self.place(age)).copied().unwrap_or(T::ZERO)
    }

    /// The values from this age on, in two parts one after the other: a loop over them need not compute a place for each.
    pub(crate) fn parts(&self, age: usize) -> [&[T]; 2] {
        let first = self.place(age);
        [self.kept.get(first..), self.kept.get(..first)].map(Option::unwrap_or_default)
    }

    pub(crate) fn values_mut(&mut self) -> impl Iterator<Item = &mut T> {
        self.kept.iter_mut()
    }
}

/// The last place up to `last` that holds, as the first ones do and later ones do not; 0 if none holds. The search begins at `near`,
/// as what is looked for at every sample is rarely far from where it was.
pub(crate) fn last_holding(last: usize, near: usize, holds: impl Fn(usize) -> bool) -> usize {
    let mut place = near;
    if place > 0 && !holds(place) {
        while place > 1 && !holds(place - 1) {
            place -= 1;
        }
        return place - 1;
    }
    while place < last && holds(place + 1) {
        place += 1;
    }
    place
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_search_finds_the_same_place_wherever_it_begins(last in 0..9_usize, near in 0..9_usize, holding in 0..10_usize) {
            let found = last_holding(last, near.min(last), |place| place < holding);
            prop_assert_eq!(found, holding.saturating_sub(1).min(last));
        }
    }
}
