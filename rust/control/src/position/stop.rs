//! Stops at an angle: which place at it is gone to and how early, whether the drive can, and where the landing of any way ends.
//!
//! A stop from a steady speed begins before the preview is over, because all that the speed loop has been told ahead is that speed.
//! A shaft that brakes less than planned goes on to a later place at the angle, once, instead of passing it by much and turning
//! back. The last, slow part of any way ends where the counts meet the goal, so that a shaft which leads does not pass it.

use super::{Mode, PositionLoop, size};
use crate::{Real, Refused};

/// An angle of a stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Angle<T> {
    /// At the angle 0 plus this \[counts\].
    at: T,
    /// Counts of a turn.
    turn: T,
    /// Whether the shaft must not turn back.
    onward: bool,
}

/// Counts by which friction holds a shaft off its goal.
fn rests<T: Real>() -> T {
    T::ONE + T::ONE
}

impl<T: Real> PositionLoop<T> {
    /// From the next sample on it goes to a place that differs from `angle` by whole `turn`s, both in counts, and stays there; returns the count.
    ///
    /// Moving `onward` it is the first one that is reached without turning back, at no more than the present speed unless that is
    /// lost within a sample. A shaft that brakes less than planned goes on to a later one ([`goal`](Self::goal)), once.
    /// Otherwise it is the one that is nearest to where the shaft can be at rest first. From rest it goes forwards, or the shorter way.
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
        let asked = Angle {
            at: angle,
            turn,
            onward,
        };
        // a stop that is asked for once more goes on as it was
        if self.mode == Mode::Stop(Some(asked)) && !self.speed.is_manual() {
            return Ok(self.goal);
        }
        let sooner = match self.mode {
            Mode::Speed => Some(self.sooner()),
            _ => None,
        };
        self.take_over();
        if self.speed.is_manual() {
            // the shaft may have been turned by hand since it was let go
            self.shift();
        }
        // the profile is that of as many samples later
        let missed = T::from_count(sooner.unwrap_or(0).into());
        self.move_by(-(missed * rate * self.per_sample));
        // what the drive loses within a sample is rest: at that speed a turn could take minutes
        let rates = &self.design.rates;
        let row = rates.at(rates.place(fast, 0), T::ONE);
        let moves = fast > row.down * self.speed.settings().ts;
        let fastest = if moves && onward {
            fast
        } else {
            self.design.speed
        };
        self.planned(T::ONE, fastest);
        self.set_goal(self.reached(asked));
        self.own = T::ZERO;
        self.mode = Mode::Stop(onward.then_some(asked));
        // what the first of two stops had not told yet is told all the same
        self.untold = sooner.unwrap_or(self.untold);
        Ok(self.goal)
    }

    /// The place at an angle to which the profile can go from where it is.
    fn reached(&self, asked: Angle<T>) -> T {
        let Angle { at, turn, onward } = asked;
        let (rate, fast) = (self.rate, size(self.rate));
        let half = T::ONE / (T::ONE + T::ONE);
        // the speed falls from the next sample on
        let way =
            self.design.rates.way_by(fast, self.part) - half * fast * self.speed.settings().ts;
        let braked = if way > T::ZERO { way } else { T::ZERO };
        let creeps = if fast > self.design.creep {
            self.crept
        } else {
            T::ZERO
        };
        let way = (braked + creeps) * self.design.counts_per_unit;
        let (forwards, from) = (rate >= T::ZERO, self.path.at(0));
        let earliest = if forwards { from + way } else { from - way };
        let turns = (earliest - at) / turn;
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
        let rounded = |whole: T| (at + whole * turn + half).floor();
        let goal = rounded(whole);
        if onward && forwards && fast > T::ZERO && goal < earliest {
            rounded(whole + T::ONE)
        } else if onward && !forwards && goal > earliest {
            rounded(whole - T::ONE)
        } else {
            goal
        }
    }

    /// By how many samples a stop may begin before the preview is over: what the speed loop has been told ahead is the present speed
    /// to within half a count of way, so it may have been told to brake. The drive answers as late as it does to a step of the
    /// command: half of what the feedforward sends for a change of the rate comes by then. The loop is told two samples of the profile
    /// at each sample until it is told all that it has missed, so that the command does not jump, and half of that time is left.
    fn sooner(&self) -> u8 {
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
        (taps / 2).min(preview) as u8
    }

    /// A move with this part of the rates and this largest speed begins.
    pub(super) fn planned(&mut self, part: T, fastest: T) {
        (self.part, self.crept) = (part, self.design.crept(part));
        (self.fastest, self.unplanned) = (fastest, 0);
        (self.top, self.lost) = (T::ZERO, T::ZERO);
    }

    /// The goal, or a later place at its angle if the shaft would pass it. A stop is planned anew once at most.
    pub(super) fn within_reach(&mut self, goal: T) -> T {
        let Mode::Stop(Some(asked)) = self.mode else {
            return goal;
        };
        // what was planned is over: a shaft that is pushed away comes back
        if self.stands() {
            return goal;
        }
        let now = self.now();
        let moved = self.places.at(now) - self.places.at(now + 1);
        // at this sample, which the profile has yet to take
        let place = self.place() + moved;
        if self.unplanned == 0 && !self.plans_anew(place, moved) {
            return goal;
        }
        self.unplanned -= 1;
        self.move_by(self.counts - place);
        if self.unplanned > 0 {
            return goal;
        }
        self.mode = Mode::Stop(None);
        self.reached(asked)
    }

    /// Whether the shaft brakes less than was planned and would pass its goal: the command is at its limit, and the shaft leads by
    /// more than the landing and the counts between which it rests. Then the move is planned anew.
    ///
    /// How much of its rates the drive has is seen in the way that braking has taken off so far. The new plan leaves the feedback as
    /// much room again as was missing, but uses no less than a quarter of the rates. It begins at the speed that the shaft has once it
    /// has been told all of the old plan: to speed up again would make a heavy shaft swing again. A shaft that then rests before its
    /// rate can come up keeps its goal, passes it and turns back.
    fn plans_anew(&mut self, place: T, moved: T) -> bool {
        if size(moved) > self.top {
            self.top = size(moved);
        }
        self.lost += self.top - size(moved);
        let forwards = moved > T::ZERO;
        let lead = if forwards {
            self.counts - place
        } else {
            place - self.counts
        };
        let passes = lead > self.design.landing + rests() && self.lost > T::ZERO;
        if !(passes && self.brakes_fully(forwards)) {
            return false;
        }
        let half = T::ONE / (T::ONE + T::ONE);
        let has = T::ONE - lead / self.lost;
        let has = if has > half { has } else { half };
        let top = self.top / self.per_sample;
        let kept = top - (top - size(self.rate)) * has;
        let samples = self.design.smoothing;
        let rates = &self.design.rates;
        let row = rates.at(rates.place(kept, 0), self.part);
        if kept < row.down * self.speed.settings().ts * T::from_count(samples) {
            return false;
        }
        self.rate = if forwards { kept } else { -kept };
        self.planned(self.part * (has * has), kept);
        self.unplanned = (self.speed.design().feedforward.preview() + samples) as u8;
        true
    }

    /// Whether the last command was at the limit that brakes a motion.
    fn brakes_fully(&self, forwards: bool) -> bool {
        let limits = self.speed.settings();
        if forwards == (limits.gains.kp > T::ZERO) {
            self.speed.output() <= limits.u_min
        } else {
            self.speed.output() >= limits.u_max
        }
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
