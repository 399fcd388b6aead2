//! Feedforward from a reference that is known ahead: the command that the model needs for it, and the measurement that it then expects.
//!
//! ```text
//! r(k+p) ─┬─> levels: the command that holds this output ────┐
//!         ├─> taps:   the command for its last changes ──────┴─> added to the PID's command
//!         └─> p samples later, late as the measurement is, through the feedback's filter ─> the PID's reference
//! ```
//!
//! The levels are the static inverse of a model, with its friction and saturation; the taps are the truncated
//! non-causal inverse of its dynamics, found by least squares (`sewfast_core::inverse`). The preview of `p` samples
//! covers the delay and the lag of the plant. Feedback compares a measurement with what it ought to be at that time: a
//! measurement that is late by its filter with a reference that is late by the same filter. Otherwise it would fight the
//! feedforward.

use crate::ring::{Ring, last_holding};
use crate::{Feedback, Real, Refused};

/// The longest preview, in samples: the ring also keeps the newest reference and the one before the delayed one.
pub const AHEAD: usize = 30;
/// The most taps.
pub const TAPS: usize = 16;
/// The most levels.
pub const LEVELS: usize = 8;

/// An output and the command that holds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level<T> {
    /// Output \[y\].
    pub y: T,
    /// Command \[u\].
    pub u: T,
}

/// Levels, taps and preview of a feedforward; [`NONE`](Self::NONE) for none.
///
/// ```
/// use sewfast_control::{Feedforward, Level};
///
/// let levels = [Level { y: -3000.0, u: -6.5 }, Level { y: 3000.0, u: 6.5 }];
/// let feedforward = Feedforward::new(8, 0.5, &levels, &[0.004, 0.012, 0.004])?;
/// assert_eq!((feedforward.preview(), feedforward.levels()), (8, &levels[..]));
/// assert!(Feedforward::new(99, 0.5, &levels, &[]).is_err());
/// # Ok::<(), sewfast_control::Refused>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Feedforward<T> {
    preview: u8,
    late: T,
    levels: [Level<T>; LEVELS],
    level_count: u8,
    taps: [T; TAPS],
    tap_count: u8,
}

impl<T: Real> Feedforward<T> {
    /// No feedforward: the reference arrives at its time and passes unchanged.
    pub const NONE: Self = Self {
        preview: 0,
        late: T::ZERO,
        levels: [Level {
            y: T::ZERO,
            u: T::ZERO,
        }; LEVELS],
        level_count: 0,
        taps: [T::ZERO; TAPS],
        tap_count: 0,
    };

    /// For a reference that arrives `preview` samples early, and a measurement that is `late` by 0 to 1 sample before
    /// the controller's filter: half a sample for a speed from counts.
    ///
    /// Between levels the command is linear; beyond the first and the last it continues on the same line. Tap `j` \[u/y\]
    /// multiplies the change of the reference `j` samples before the newest.
    ///
    /// # Errors
    /// More than [`AHEAD`], [`LEVELS`] or [`TAPS`]; neither levels nor taps; numbers that are not finite; outputs that
    /// do not increase.
    pub fn new(preview: usize, late: T, levels: &[Level<T>], taps: &[T]) -> Result<Self, Refused> {
        let refuse = |holds, expected, received: T| {
            Refused::unless(holds, "feedforward", expected, received.to_f64())
        };
        let count = T::from_count;
        refuse(
            preview <= AHEAD,
            "a preview of at most 30 samples",
            count(preview),
        )?;
        let held = late >= T::ZERO && late <= T::ONE;
        refuse(held, "a measurement late by 0 to 1 sample", late)?;
        let some = !(levels.is_empty() && taps.is_empty());
        refuse(some, "at least one level or tap", T::ZERO)?;
        let mut made = Self::NONE;
        let (Some(own_levels), Some(own_taps)) = (
            made.levels.get_mut(..levels.len()),
            made.taps.get_mut(..taps.len()),
        ) else {
            let most = if levels.len() > LEVELS {
                levels.len()
            } else {
                taps.len()
            };
            refuse(false, "at most 8 levels and 16 taps", count(most))?;
            return Ok(Self::NONE);
        };
        own_levels.copy_from_slice(levels);
        own_taps.copy_from_slice(taps);
        for tap in taps {
            refuse(tap.is_finite(), "finite taps", *tap)?;
        }
        let mut last: Option<Level<T>> = None;
        for level in levels {
            refuse(level.y.is_finite(), "finite outputs of its levels", level.y)?;
            refuse(
                level.u.is_finite(),
                "finite commands of its levels",
                level.u,
            )?;
            let grows = |last: Level<T>| {
                level.y > last.y && ((level.u - last.u) / (level.y - last.y)).is_finite()
            };
            refuse(
                last.is_none_or(grows),
                "growing outputs of its levels",
                level.y,
            )?;
            last = Some(*level);
        }
        (made.preview, made.late) = (preview as u8, late);
        (made.level_count, made.tap_count) = (levels.len() as u8, taps.len() as u8);
        Ok(made)
    }

    /// Whether there is none.
    pub fn is_none(&self) -> bool {
        self.level_count == 0 && self.tap_count == 0
    }

    /// Samples by which the reference arrives early.
    pub fn preview(&self) -> usize {
        self.preview.into()
    }

    /// Share of a sample by which the measurement is late before the controller's filter.
    pub fn late(&self) -> T {
        self.late
    }

    /// The levels, by increasing output.
    pub fn levels(&self) -> &[Level<T>] {
        self.levels
            .get(..self.level_count.into())
            .unwrap_or_default()
    }

    /// The taps, the newest change's first.
    pub fn taps(&self) -> &[T] {
        self.taps.get(..self.tap_count.into()).unwrap_or_default()
    }

    /// The command that holds the output `y`.
    pub fn held(&self, y: T) -> T {
        self.held_from(y, self.passed(y, 0))
    }

    /// How many of the levels between the first and the last, which grow, `y` has passed; the search begins at `near`. (The remainders
    /// only tell the compiler that no index is beyond the levels.)
    fn passed(&self, y: T, near: usize) -> usize {
        let last = usize::from(self.level_count).saturating_sub(2);
        let holds = |place: usize| y >= self.levels[place % LEVELS].y;
        last_holding(last, near.min(last), holds)
    }

    /// The command on the line from a level to the next one.
    fn held_from(&self, y: T, level: usize) -> T {
        let low = self.levels[level % LEVELS];
        let next = (level + 1).min(usize::from(self.level_count).saturating_sub(1));
        let high = self.levels[next % LEVELS];
        // one level alone: any distance, as the command does not change over it
        let apart = if high.y > low.y {
            high.y - low.y
        } else {
            T::ONE
        };
        low.u + (y - low.y) * (high.u - low.u) / apart
    }
}

impl<T: PartialEq> PartialEq for Feedforward<T> {
    fn eq(&self, other: &Self) -> bool {
        let counts = |of: &Self| (of.preview, of.level_count, of.tap_count);
        let used = |count: u8| ..usize::from(count);
        (counts(self), &self.late) == (counts(other), &other.late)
            && self.levels.get(used(self.level_count)) == other.levels.get(used(self.level_count))
            && self.taps.get(used(self.tap_count)) == other.taps.get(used(self.tap_count))
    }
}

/// The last references, and the filter of the expected measurement.
#[derive(Clone, Debug)]
pub(crate) struct Ahead<T> {
    kept: Ring<T>,
    pub(crate) started: bool,
    /// For how many samples the reference has stood, up to [`TAPS`].
    stood: u8,
    /// The level that it had passed at the last sample.
    level: u8,
    filter: Feedback<T>,
}

impl<T: Real> Ahead<T> {
    /// Without a reference yet; `filter` is the feedback's.
    pub(crate) fn new(filter: Feedback<T>) -> Self {
        Self {
            kept: Ring::filled(T::ZERO),
            started: false,
            stood: 0,
            level: 0,
            filter,
        }
    }

    pub(crate) fn reset(&mut self) {
        self.started = false;
        self.filter.reset();
    }

    /// The reference `age` samples before the newest.
    pub(crate) fn at(&self, age: usize) -> T {
        self.kept.at(age)
    }

    /// As if the reference had been `r` for ever.
    pub(crate) fn stand_at(&mut self, r: T) {
        self.kept = Ring::filled(r);
        self.stood = TAPS as u8;
        self.started = true;
        self.filter.reset();
    }

    /// Takes a reference; one that is not finite repeats the last. Before the first one it was always the same.
    pub(crate) fn take(&mut self, r: T) {
        if !self.started {
            if r.is_finite() {
                self.stand_at(r);
            }
            return;
        }
        let last = self.at(0);
        let r = if r.is_finite() { r } else { last };
        self.stood = if r == last {
            (self.stood + 1).min(TAPS as u8)
        } else {
            0
        };
        self.kept.push(r);
    }

    /// The command for the references so far.
    pub(crate) fn command(&mut self, of: &Feedforward<T>) -> T {
        let newest = self.at(0);
        // a reference that stands has no changes: their sum is 0 exactly
        let sum = if self.stood >= of.tap_count {
            T::ZERO
        } else {
            self.changes(of, newest)
        };
        if of.level_count == 0 {
            return sum;
        }
        let level = of.passed(newest, self.level.into());
        self.level = level as u8;
        of.held_from(newest, level) + sum
    }

    /// The command for the last changes.
    fn changes(&self, of: &Feedforward<T>, newest: T) -> T {
        let (mut sum, mut newer, mut taps) = (T::ZERO, newest, of.taps());
        for part in self.kept.parts(1) {
            for (tap, older) in taps.iter().zip(part) {
                sum += *tap * (newer - *older);
                newer = *older;
            }
            taps = taps.get(part.len()..).unwrap_or_default();
        }
        sum
    }

    /// The measurement that is expected at this sample, after the feedback's filter. References so large that the
    /// filter's sum overflows give none that is finite, which the PID skips; the filter then starts over.
    pub(crate) fn expected(&mut self, of: &Feedforward<T>) -> T {
        let (now, before) = (self.at(of.preview()), self.at(of.preview() + 1));
        let expected = self.filter.step(now + of.late * (before - now));
        if !expected.is_finite() {
            self.filter.reset();
        }
        expected
    }

    /// The filter's new settings with its memory.
    pub(crate) fn filtered_by(&mut self, filter: Feedback<T>) {
        self.filter = filter.after(&self.filter);
    }
}

#[cfg(test)]
mod tests;
