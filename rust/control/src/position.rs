//! A position loop over the speed loop: the profile of a move, the feedback of the position, and the stop at an angle.
//!
//! ```text
//! goal ─> profile ─┬─ its speed ────────────────────────────> r(k+p) ─┐
//!                  └─ its position, as late as the counts             ├─> PidController, unchanged ─> command
//!                       └─ minus counts, times the gain ─> correction ┘
//! ```
//!
//! The profile is as fast as the drive can be: its speed rises and falls at the rates that the drive has at that speed
//! ([`Rates`]), and a mean over some samples bounds the jerk (Biagiotti and Melchiorri, FIR filters for online trajectory
//! planning with time- and frequency-domain specifications, Control Engineering Practice 20, 2012). It meets a goal that
//! stands exactly and without passing it. The speed loop follows the profile's speed with its own feedforward, which needs it
//! `p` samples early; the position is compared with the profile's `p` samples ago.
//!
//! Where the profile stands and the counts are within one of it, the integral of the speed loop lets go of the position error: it
//! would rise until dry friction gives way, and the shaft would be pushed to and fro for ever.

mod rates;
mod stop;
mod turning;

use crate::pid_controller::Correction;
use crate::ring::{KEPT, Ring};
use crate::{Controller, PidController, Real, Refused};
use stop::Angle;

pub use rates::{RATES, Rate, Rates};
pub use turning::{FARTHEST, Turning};

/// All values that a ring keeps.
const ALL: u8 = KEPT as u8;
/// The longest mean over the samples of a profile.
pub const SMOOTHED: usize = 31;

/// The settings of a position loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PositionDesign<T> {
    /// Speed that a position error calls for, over this error \[1/s\].
    pub gain: T,
    /// Counts per unit of the output and second.
    pub counts_per_unit: T,
    /// Largest speed of a move, and the largest from which a stop begins \[y\].
    pub speed: T,
    /// Rates of the speed.
    pub rates: Rates<T>,
    /// Samples in which the rate of the speed comes up, 1 to [`SMOOTHED`].
    pub smoothing: usize,
    /// The last part of a move, passed at the speed `creep`: what braking still makes swing dies away before the goal \[counts\];
    /// 0 for none.
    pub landing: T,
    /// Speed of that part \[y\].
    pub creep: T,
    /// Whether the command goes to 0 once the shaft has come to rest at its goal, until the next one; otherwise it holds it.
    pub releases: bool,
}

impl<T: Real> PositionDesign<T> {
    /// The refusal that [`PositionLoop::new`] would give, without making the loop.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn check(&self) -> Result<(), Refused> {
        let finite = "a finite number above 0";
        for (name, value) in [
            ("position gain", self.gain),
            ("counts_per_unit", self.counts_per_unit),
            ("speed", self.speed),
            ("creep", self.creep),
        ] {
            let above = value > T::ZERO && value.is_finite();
            Refused::unless(above, name, finite, value.to_f64())?;
        }
        let landing = self.landing >= T::ZERO && self.landing.is_finite();
        Refused::unless(
            landing,
            "landing",
            "a finite distance of 0 or more",
            self.landing.to_f64(),
        )?;
        Refused::unless(
            (1..=SMOOTHED).contains(&self.smoothing),
            "smoothing",
            "1 to 31 samples",
            self.smoothing as f64,
        )
    }

    /// By how much the landing makes a way at this part of the rates longer \[y s\].
    fn crept(&self, part: T) -> T {
        let more = self.landing / self.counts_per_unit - self.rates.way_by(self.creep, part);
        if more > T::ZERO { more } else { T::ZERO }
    }

    /// The speed of the next sample towards a goal at a distance of 0 or more, at this part of the rates, by which the landing makes
    /// the way longer by `crept`; its row of the rates is looked for from `near` on.
    fn towards(&self, distance: T, ts: T, part: T, crept: T, near: usize) -> T {
        let from = |distance| self.rates.from(distance, ts, part, near);
        if crept == T::ZERO {
            return from(distance);
        }
        let first = if distance > crept {
            from(distance - crept)
        } else {
            T::ZERO
        };
        // above its own speed the landing does not matter
        if first >= self.creep {
            return first;
        }
        let last = from(distance);
        let slow = if last < self.creep { last } else { self.creep };
        if first > slow { first } else { slow }
    }
}

/// What the loop does.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Mode<T> {
    /// References are speeds \[y\].
    Speed,
    /// References are goals \[counts\].
    Goals,
    /// It goes to the goal; with an angle it may go on to a later place at it.
    Stop(Option<Angle<T>>),
}

fn size<T: Real>(x: T) -> T {
    if x < T::ZERO { -x } else { x }
}

/// A position loop over a speed loop, in counts of an encoder.
///
/// It begins as the speed loop alone. [`follow`](Self::follow) and [`stop`](Self::stop) take over without a bump.
#[derive(Clone, Debug)]
pub struct PositionLoop<T> {
    design: PositionDesign<T>,
    speed: PidController<T>,
    mode: Mode<T>,
    /// Counts of one sample at a speed of one unit.
    per_sample: T,
    /// Counts since the reset.
    counts: T,
    /// Positions before the mean \[counts\].
    path: Ring<T>,
    /// Positions of the profile, the newest `preview` samples ahead \[counts\].
    places: Ring<T>,
    /// Speed before the mean \[y\].
    rate: T,
    /// Goal of the last sample \[counts\], and its own speed \[y\].
    goal: T,
    own: T,
    /// Part of the rates that this move uses, by how much its landing makes a way longer \[y s\], and its largest speed \[y\].
    part: T,
    crept: T,
    fastest: T,
    /// Largest way of a sample of the profile since this move was planned, and all the way that braking has taken off \[counts\].
    top: T,
    lost: T,
    /// Where among the rates its speed was at the last sample.
    row: u8,
    /// Samples for which the speed is held before a move is planned anew.
    unplanned: u8,
    /// Samples since the last count.
    still: u8,
    /// How many of the newest `places` are the goal.
    stood: u8,
    /// So many of the newest positions before the mean are known to be the goal.
    met: u8,
    /// Samples that the speed loop has yet to be told of the profile, beyond one at each sample.
    untold: u8,
}

impl<T: Real> PositionLoop<T> {
    /// A loop at rest over a speed loop.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn new(design: PositionDesign<T>, speed: PidController<T>) -> Result<Self, Refused> {
        design.check()?;
        Ok(Self::checked(design, speed))
    }

    /// The same for settings that have been checked. Inlined, so that it is made in its place: it would fill most of a small
    /// processor's stack.
    #[inline(always)]
    pub(crate) fn checked(design: PositionDesign<T>, speed: PidController<T>) -> Self {
        let ts = speed.settings().ts;
        Self {
            mode: Mode::Speed,
            per_sample: ts * design.counts_per_unit,
            counts: T::ZERO,
            path: Ring::filled(T::ZERO),
            places: Ring::filled(T::ZERO),
            rate: T::ZERO,
            goal: T::ZERO,
            own: T::ZERO,
            part: T::ONE,
            crept: design.crept(T::ONE),
            fastest: design.speed,
            top: T::ZERO,
            lost: T::ZERO,
            row: 0,
            unplanned: 0,
            still: 0,
            stood: ALL,
            met: 0,
            untold: 0,
            design,
            speed,
        }
    }

    /// Back to the state before the first sample, as the speed loop alone, with the counts at 0.
    pub fn reset(&mut self) {
        self.speed.reset();
        self.mode = Mode::Speed;
        (self.counts, self.rate, self.goal) = (T::ZERO, T::ZERO, T::ZERO);
        (self.own, self.still, self.untold) = (T::ZERO, 0, 0);
        (self.path, self.places) = (Ring::filled(T::ZERO), Ring::filled(T::ZERO));
        self.stood = ALL;
        self.planned(T::ONE, self.design.speed);
    }

    /// From the reference and the counts `moved` since the last sample to the command. The reference is a speed \[y\], after
    /// [`follow`](Self::follow) a goal \[counts\], and does nothing after [`stop`](Self::stop).
    ///
    /// A number of counts that is not finite is a lost measurement: the position is then unknown, and the command stays.
    pub fn step(&mut self, reference: T, moved: T) -> T {
        self.counts += moved;
        self.still = if moved == T::ZERO {
            (self.still + 1).min(ALL)
        } else {
            0
        };
        let y = moved / self.per_sample;
        let goal = match self.mode {
            Mode::Speed => {
                let u = self.speed.step(reference, y);
                let referred = self.speed.ramped().unwrap_or(T::ZERO);
                let place = self.places.at(0) + referred * self.per_sample;
                self.places.push(place);
                self.rate = referred;
                return u;
            }
            Mode::Goals => reference,
            Mode::Stop(_) => self.goal,
        };
        let goal = self.within_reach(goal);
        let begins_again = self.speed.is_manual() && (goal != self.goal || !self.stands());
        if begins_again {
            // the shaft may have been turned by hand
            self.shift();
        }
        // what was missed is made up for sample by sample
        if self.untold > 0 {
            let sooner = self.profile(goal);
            self.speed.refer(sooner);
            self.untold -= 1;
        }
        let speed = self.profile(goal);
        let error = self.place() - self.counts;
        let (one, stands) = (T::ONE, self.stands());
        let near = error <= one && error >= -one;
        if stands && near && self.design.releases && self.still >= ALL {
            // always finite
            let _ = self.speed.set_manual(T::ZERO);
        }
        let correction = Correction {
            y: self.design.gain * error / self.design.counts_per_unit,
            integrates: !(stands && near),
        };
        let u = self.speed.step_corrected(speed, y, -T::ZERO, correction);
        if begins_again {
            // its integral term is now that of a command of 0 here
            self.speed.set_automatic();
        }
        u
    }

    /// From the next sample on references are goals: positions in counts since the reset. One that stands is gone to within
    /// the bounds; one that moves as the drive can is followed as it is.
    pub fn follow(&mut self) {
        self.take_over();
        self.set_goal(self.path.at(0));
        self.own = self.rate;
        self.planned(T::ONE, self.design.speed);
        self.mode = Mode::Goals;
    }

    /// The profile goes on from the reference of the speed loop, whose position is now that of the counts.
    fn take_over(&mut self) {
        if self.mode != Mode::Speed {
            return;
        }
        self.shift();
        let (step, samples) = (self.rate * self.per_sample, self.design.smoothing);
        let half = T::ONE / (T::ONE + T::ONE);
        let newest = self.places.at(0) + half * T::from_count(samples - 1) * step;
        for age in (0..KEPT).rev() {
            self.path.push(newest - T::from_count(age) * step);
        }
    }

    /// Moves the profile to where the counts are.
    fn shift(&mut self) {
        self.move_by(self.counts - self.place());
    }

    /// The origin of positions moves on by so many counts. It must not do so while there is a goal, which it would leave behind.
    pub(crate) fn move_origin(&mut self, counts: T) {
        self.counts = self.counts - counts;
        self.move_by(-counts);
    }

    #[inline(never)]
    fn move_by(&mut self, shift: T) {
        for place in self.path.values_mut().chain(self.places.values_mut()) {
            *place += shift;
        }
        self.set_goal(self.goal);
    }

    #[inline(never)]
    fn set_goal(&mut self, goal: T) {
        (self.goal, self.met) = (goal, 0);
        let places = (0..KEPT).map(|age| self.places.at(age));
        self.stood = places.take_while(|place| *place == goal).count() as u8;
    }

    /// The profile one sample on towards a goal; its speed \[y\].
    fn profile(&mut self, goal: T) -> T {
        let samples = self.design.smoothing;
        if goal == self.goal && self.is_there() {
            self.own = T::ZERO;
            if usize::from(self.met) > samples || self.stood == ALL {
                self.places.push(goal);
                self.stood = (self.stood + 1).min(ALL);
                return T::ZERO;
            }
            self.path.push(goal);
            self.met += 1;
        } else if self.unplanned > 0 {
            self.path
                .push(self.path.at(0) + self.rate * self.per_sample);
        } else if self.arrives(goal) {
            (self.path, self.rate, self.own) = (Ring::filled(goal), T::ZERO, T::ZERO);
            self.met = ALL;
        } else {
            self.advance(goal);
        }
        let (newest, oldest) = (self.path.at(0), self.path.at(samples));
        let place = self.mean();
        self.places.push(place);
        self.stood = if place == self.goal {
            (self.stood + 1).min(ALL)
        } else {
            0
        };
        (newest - oldest) / (T::from_count(samples) * self.per_sample)
    }

    /// Whether the path has come to rest at the goal.
    fn is_there(&self) -> bool {
        self.unplanned == 0 && self.rate == T::ZERO && self.path.at(0) == self.goal
    }

    /// The position before the mean, one sample on towards a goal.
    fn advance(&mut self, goal: T) {
        let goal = if goal.is_finite() { goal } else { self.goal };
        let (ts, rate) = (self.speed.settings().ts, self.rate);
        let (design, part) = (&self.design, self.part);
        let place = design.rates.place(size(rate), self.row.into());
        let row = design.rates.at(place, part);
        let (up, down) = (row.up * ts, row.down * ts);
        // a goal that moves as the drive can is followed at its own speed, from its second sample on: before, it may be a step
        let (own, last) = ((goal - self.goal) / self.per_sample, self.own);
        let moves = last != T::ZERO && size(own) <= self.fastest;
        let follows = moves && size(own - last) <= up + down;
        let carried = if follows { own } else { T::ZERO };
        self.row = place as u8;
        if goal != self.goal {
            self.set_goal(goal);
        }
        self.own = own;
        let at = self.path.at(0);
        let left = (goal - at) / self.design.counts_per_unit - carried * ts;
        let design = &self.design;
        let towards = design.towards(size(left), ts, part, self.crept, place);
        let wanted = carried + if left < T::ZERO { -towards } else { towards };
        let wanted = wanted.limit(-self.fastest, self.fastest);
        // on its way to a goal the speed may fall by the rate of the row below, and by an eighth more just before it, where the
        // last samples do not divide the way evenly
        let brakes = size(wanted) <= size(rate) && wanted * rate >= T::ZERO;
        let down = if brakes {
            let next = design
                .rates
                .at(design.rates.below(size(wanted), place), part);
            let steeper = if next.down > row.down {
                next.down * ts
            } else {
                down
            };
            steeper + steeper / T::from_count(8)
        } else {
            down
        };
        let (low, high) = if rate > T::ZERO {
            (rate - down, rate + up)
        } else if rate < T::ZERO {
            (rate - up, rate + down)
        } else {
            (-up, up)
        };
        self.rate = wanted.limit(low, high);
        // exactly, for which no rounding must be left
        let met = carried + left / ts == self.rate;
        self.path.push(if met {
            goal
        } else {
            at + self.rate * self.per_sample
        });
    }

    /// The mean over the newest positions of the path; exactly the goal if all are.
    fn mean(&self) -> T {
        let samples = self.design.smoothing;
        let (mut off, mut left) = (T::ZERO, samples);
        for part in self.path.parts(0) {
            let used = part.get(..left).unwrap_or(part);
            for place in used {
                off += *place - self.goal;
            }
            left -= used.len();
        }
        self.goal + off / T::from_count(samples)
    }

    /// The age of the position of this sample among those of the profile.
    fn now(&self) -> usize {
        self.speed.design().feedforward.preview() - usize::from(self.untold)
    }

    /// The profile's position at this sample \[counts\]. The speed of a sample is the mean over it, and the speed loop takes it
    /// for that at its end, so the position is half a sample later.
    pub fn place(&self) -> T {
        let now = self.now();
        let (now, before) = (self.places.at(now), self.places.at(now + 1));
        now + (before - now) / (T::ONE + T::ONE)
    }

    /// Whether the profile stands at its goal.
    pub fn stands(&self) -> bool {
        self.mode != Mode::Speed && self.stood == ALL
    }

    /// Whether it is the speed loop alone, as it begins.
    pub fn is_speed_loop(&self) -> bool {
        self.mode == Mode::Speed
    }

    /// The goal \[counts\]; of a speed loop 0.
    pub fn goal(&self) -> T {
        self.goal
    }

    /// Counts since the reset.
    pub fn counts(&self) -> T {
        self.counts
    }

    /// Samples by which a reference of the position arrives early: the speed loop's preview and half of the mean.
    pub fn early(&self) -> usize {
        self.speed.design().feedforward.preview() + self.design.smoothing / 2
    }

    /// The settings.
    pub fn design(&self) -> &PositionDesign<T> {
        &self.design
    }

    /// The speed loop.
    pub fn speed(&self) -> &PidController<T> {
        &self.speed
    }

    /// The filtered feedback of the last step \[y\].
    pub fn filtered(&self) -> T {
        Controller::filtered(&self.speed)
    }
}

#[cfg(test)]
mod tests;
