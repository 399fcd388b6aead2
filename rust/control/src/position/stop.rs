//! Stops at an angle: which place at it is gone to and how early, and where the landing of any way ends.
//!
//! A stop from a steady speed begins before the preview is over, because all that the speed loop has been told ahead is that speed.
//! The last, slow part of a way ends where the counts meet the goal, so that a shaft which leads does not pass it.

use super::{Mode, PositionLoop, size};
use crate::{Real, Refused};

/// Counts by which friction holds a shaft off its goal.
fn rests<T: Real>() -> T {
    T::ONE + T::ONE
}

impl<T: Real> PositionLoop<T> {
    /// From the next sample on it goes to a place that differs from `angle` by whole `turn`s, both in counts, and stays there; returns the count.
    ///
    /// Moving `onward` it is the first one that is reached without turning back, at no more than the present speed unless that is
    /// lost within a sample;
    /// otherwise the one that is nearest to where the shaft can be at rest first. From rest it goes forwards, or the shorter way.
    ///
    /// # Errors
    /// An angle or a turn that is not finite, a turn that is not above 0, a present speed above [`PositionDesign::speed`](crate::PositionDesign::speed).
    pub fn stop(&mut self, angle: T, turn: T, onward: bool) -> Result<T, Refused> {
        let rate = self.rate;
        let fast = size(rate);
        Refused::unless(angle.is_finite(), "angle", "a finite angle", angle.to_f64())?;
        Refused::unless(
            turn > T::ZERO && turn.is_finite(),
            "turn",
            "counts of a turn above 0",
            turn.to_f64(),
        )?;
        Refused::unless(
            fast <= self.design.speed,
            "speed",
            "a speed within the position loop's",
            fast.to_f64(),
        )?;
        let sooner = if self.mode == Mode::Speed {
            self.sooner()
        } else {
            0
        };
        self.take_over();
        if self.speed.is_manual() {
            // the shaft may have been turned by hand since it was let go
            self.shift();
        }
        // the profile is that of as many samples later
        self.move_by(-(T::from_count(sooner) * rate * self.per_sample));
        let half = T::ONE / (T::ONE + T::ONE);
        let ts = self.speed.settings().ts;
        // the speed falls from the next sample on
        let way = self.design.rates.way(fast) - half * fast * ts;
        let braked = if way > T::ZERO { way } else { T::ZERO };
        let creeps = if fast > self.design.creep {
            self.design.crept()
        } else {
            T::ZERO
        };
        let way = (braked + creeps) * self.design.counts_per_unit;
        let (forwards, from) = (rate >= T::ZERO, self.path.at(0));
        let earliest = if forwards { from + way } else { from - way };
        let turns = (earliest - angle) / turn;
        let whole = if !onward {
            (turns + half).floor()
        } else if forwards {
            // a shaft that stands within a count of the angle stays
            let near = if fast > T::ZERO {
                T::ZERO
            } else {
                T::ONE / turn
            };
            -(near - turns).floor()
        } else {
            turns.floor()
        };
        // whole counts can be met exactly, and the nearest one may be too near
        let rounded = |whole: T| (angle + whole * turn + half).floor();
        let goal = rounded(whole);
        let goal = if onward && forwards && fast > T::ZERO && goal < earliest {
            rounded(whole + T::ONE)
        } else if onward && !forwards && goal > earliest {
            rounded(whole - T::ONE)
        } else {
            goal
        };
        (self.goal, self.own) = (goal, T::ZERO);
        // what the drive loses within a sample is rest: at that speed a turn could take minutes
        let (row, _) = self.design.rates.at(fast);
        self.fastest = if fast > row.down * ts && onward {
            fast
        } else {
            self.design.speed
        };
        self.mode = Mode::Stop(goal);
        self.untold = sooner;
        Ok(goal)
    }

    /// By how many samples a stop may begin before the preview is over: what the speed loop has been told ahead is the present speed
    /// to within half a count of way, so it may have been told to brake. The drive answers as late as it does to a step of the
    /// command: half of what the feedforward sends for a change of the rate comes by then, and half of the mean. The loop is told two
    /// samples of the profile at each sample until it is told all that it has missed, so that the command does not jump, and half of
    /// that time is left.
    fn sooner(&self) -> usize {
        let feedforward = &self.speed.design().feedforward;
        let (two, preview) = (T::ONE + T::ONE, feedforward.preview());
        let apart = (0..=preview).fold(T::ZERO, |sum, age| {
            sum + size(self.speed.told(age) - self.rate)
        });
        let steady = two * apart * self.per_sample <= T::ONE;
        let all = feedforward.taps().iter().fold(T::ZERO, |sum, t| sum + *t);
        if !steady || self.rate == T::ZERO || all == T::ZERO {
            return 0;
        }
        let mut sum = T::ZERO;
        let before = |tap: &&T| {
            sum += **tap / all;
            two * sum < T::ONE
        };
        let taps = feedforward.taps().iter().take_while(before).count();
        ((taps + self.design.smoothing / 2) / 2).min(preview)
    }

    /// Whether the shaft would meet a goal that stands at the end of what the speed loop has been told ahead, while the profile lands;
    /// the shaft may be half a count beyond its counts.
    pub(super) fn arrives(&self, goal: T) -> bool {
        let left = goal - self.path.at(0);
        let lands = goal == self.goal && left * self.rate > T::ZERO;
        if !lands || size(left) > self.design.landing || size(self.rate) > self.design.creep {
            return false;
        }
        let (place, half) = (self.place(), T::ONE / (T::ONE + T::ONE));
        let (ahead, lead) = if left > T::ZERO {
            (self.places.at(0) - place, self.counts - place)
        } else {
            (place - self.places.at(0), place - self.counts)
        };
        // a larger lead swings, and dies away as the profile lands
        lead <= rests() && lead + ahead + half >= size(goal - place)
    }
}
