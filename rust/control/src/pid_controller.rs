//! The whole controller of the paper's Fig. 16: feedback filter, reference ramp, feedforward, biquads, then the
//! two-degree-of-freedom PID.
//!
//! Biquads act on the reference and on the feedback alike. As the PID is linear in both, this equals biquads after it,
//! on the command, where drives have them: the machine's resonance is neither fed back nor excited by the reference.
//! The command of a feedforward is added behind them.
//! But limits, slew, anti-windup and the operator's command act on the command that the machine receives.

use crate::biquad::Memory;
use crate::feedforward::Ahead;
use crate::pid::Terms;
use crate::schedule::{Row, Table};
use crate::{
    Cascade, Controller, Feedback, Feedforward, Pid, Ramp, Real, Refused, Schedule, Settings,
};

/// The numbers used by the step of a controller with constant gains, for code that steps many controllers at once with
/// the same operations in the same order.
#[derive(Clone, Copy, Debug)]
pub struct Numbers<T> {
    /// Gains of the PID.
    pub terms: Terms<T>,
    /// Share of the excess taken from the integral in one sample; see [`Settings::tracking`].
    pub tracking: T,
    /// Samples of the moving average.
    pub samples: usize,
    /// Weight of a new sample in the first-order lag.
    pub lag: T,
    /// `1 - a` and `b` of the observer; `None` if its input passes through.
    pub observer: Option<(T, T)>,
    /// Largest change of the reference in one sample \[y\].
    pub ramp: T,
}

/// An output that an outer loop asks for beyond the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correction<T> {
    /// By how much \[y\].
    pub y: T,
    /// Whether the integral term takes it up.
    pub integrates: bool,
}

impl<T: Real> Correction<T> {
    /// None.
    pub const NONE: Self = Self {
        y: T::ZERO,
        integrates: true,
    };
}

/// Feedback filter, reference ramp, feedforward, biquads, gain schedule and PID in one step.
#[derive(Clone, Debug)]
pub struct PidController<T> {
    design: Design<T>,
    filter: Feedback<T>,
    ramp: Ramp<T>,
    ahead: Ahead<T>,
    /// The biquads' memory of the feedback.
    of_y: Memory<T>,
    /// The biquads' memory of the reference.
    of_r: Memory<T>,
    table: Option<Table<T>>,
    pid: Pid<T>,
    filtered: T,
}

impl<T: Real> PidController<T> {
    /// A controller at rest, in automatic.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn new(design: Design<T>) -> Result<Self, Refused> {
        let Design {
            pid,
            filter_samples,
            filter_time,
            observer_time,
            r_rate,
            schedule,
            biquads: _,
            feedforward: _,
        } = design;
        let ts = pid.ts;
        let filter = Feedback::new(filter_samples, filter_time, observer_time, ts)?;
        Ok(Self {
            pid: Pid::new(pid)?,
            ahead: Ahead::new(filter.clone()),
            filter,
            ramp: Ramp::new(r_rate, ts)?,
            of_y: Memory::new(),
            of_r: Memory::new(),
            table: Table::new(&schedule, &pid),
            design,
            filtered: T::ZERO,
        })
    }

    /// The refusal that [`new`](Self::new) would give, without making the controller, which would fill most of a small processor's stack.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn check(design: &Design<T>) -> Result<(), Refused> {
        let ts = design.pid.ts;
        Pid::new(design.pid)?;
        Feedback::new(
            design.filter_samples,
            design.filter_time,
            design.observer_time,
            ts,
        )?;
        Ramp::new(design.r_rate, ts)?;
        Ok(())
    }

    /// Back to the state before the first sample, in automatic.
    pub fn reset(&mut self) {
        self.filter.reset();
        self.ramp.reset();
        self.ahead.reset();
        self.of_y.started = false;
        self.of_r.started = false;
        self.pid.reset();
        self.filtered = T::ZERO;
    }

    /// From reference and measured output to the command: filter, control, limit.
    ///
    /// For any input the command is finite, within the limits, and no further from the last one than the slew rate
    /// allows. A measurement that is not finite is skipped: the filter keeps its memory and the command its value. A
    /// measurement at which the filter's sum overflows is skipped, too, and the filter starts over with the next one.
    pub fn step(&mut self, r: T, y: T) -> T {
        // x + (-0) is x for every x, even for -0
        self.step_with(r, y, -T::ZERO)
    }

    /// [`step`](Self::step) with a command added before the limits.
    #[inline]
    pub fn step_with(&mut self, r: T, y: T, feedforward: T) -> T {
        self.step_corrected(r, y, feedforward, Correction::NONE)
    }

    /// [`step_with`](Self::step_with) with what an outer loop asks for beyond the reference. It is taken off the filtered
    /// measurement, so that it passes neither the feedback's filter nor set-point weights. A correction that is not finite
    /// skips the sample as a lost measurement does.
    #[inline]
    pub fn step_corrected(&mut self, r: T, y: T, feedforward: T, correction: Correction<T>) -> T {
        if !(y.is_finite() && correction.y.is_finite()) {
            return self.pass(r);
        }
        let filtered = self.filter.step(y);
        if !filtered.is_finite() {
            self.filter.reset();
            return self.pass(r);
        }
        // x - 0 is x for every x, even for -0
        let filtered = filtered - correction.y;
        let sections = self.design.biquads.sections();
        if !self.of_y.started {
            self.of_y.rest_at(filtered);
        }
        let filtered = self.of_y.step(sections, filtered);
        if !filtered.is_finite() {
            self.of_y.started = false;
            return self.pass(r);
        }
        self.filtered = filtered;
        let (r, own) = self.lead(r, filtered);
        let r = self.referred(r);
        let feedforward = own.map_or(feedforward, |own| feedforward + own);
        let terms = match &self.table {
            Some(table) => table.at(self.filtered),
            None => self.pid.terms(),
        };
        let u = self.pid.step_by(terms, r, self.filtered, feedforward);
        if !correction.integrates {
            self.pid.absorb(-(terms.ki * correction.y));
        }
        u
    }

    /// From the reference to that of the PID before the biquads, and the command of the feedforward if there is one.
    /// The ramp begins at `filtered`, the first feedback.
    ///
    /// Neither depends on later measurements, so a simulation can take this way before its loop
    /// ([`without_lead`](Self::without_lead)).
    pub fn lead(&mut self, r: T, filtered: T) -> (T, Option<T>) {
        let ramped = self.ramp.step(r, filtered);
        let feedforward = &self.design.feedforward;
        if feedforward.is_none() {
            return (ramped, None);
        }
        self.ahead.take(ramped);
        if !self.ahead.started {
            return (ramped, None);
        }
        let expected = self.ahead.expected(feedforward);
        (expected, Some(self.ahead.command(feedforward)))
    }

    /// The design of what follows [`lead`](Self::lead): without ramp and feedforward.
    pub fn without_lead(&self) -> Design<T> {
        Design {
            r_rate: T::INFINITY,
            feedforward: Feedforward::NONE,
            ..self.design
        }
    }

    /// A reference that comes before its sample: what was told ahead is told one sample sooner.
    pub(crate) fn refer(&mut self, r: T) {
        let ramped = self.ramp.step(r, r);
        self.ahead.take(ramped);
    }

    /// The last command \[u\].
    pub(crate) fn output(&self) -> T {
        self.pid.output()
    }

    /// The reference that was told `age` samples before the newest one, of a controller with feedforward.
    pub(crate) fn told(&self, age: usize) -> T {
        self.ahead.at(age)
    }

    /// The newest reference after the ramp; `None` before the first one.
    pub(crate) fn ramped(&self) -> Option<T> {
        self.ramp.newest()
    }

    /// The filtered feedback if `y` were the first measurement.
    pub fn first_filtered(&self, y: T) -> T {
        self.filter.given(y)
    }

    /// A sample without a measurement: the reference goes on, as it does on the device that plays it.
    fn pass(&mut self, r: T) -> T {
        if self.ahead.started {
            let ramped = self.ramp.step(r, r);
            self.ahead.take(ramped);
            self.ahead.expected(&self.design.feedforward);
        }
        self.pid.hold()
    }

    /// The reference after the biquads. Before the first sample they stood, like the ramp, at the first output, so a
    /// step of the reference is filtered as well. A reference that is not finite bypasses them, and the PID skips it.
    fn referred(&mut self, r: T) -> T {
        if !r.is_finite() {
            return r;
        }
        if !self.of_r.started {
            self.of_r.rest_at(self.filtered);
        }
        let filtered = self.of_r.step(self.design.biquads.sections(), r);
        self.of_r.started = filtered.is_finite();
        filtered
    }

    /// Another design from the next sample on, without a bump in the command: filter, ramp and derivative keep their
    /// memory, new biquads begin at rest, and the integral term absorbs the change of the other terms.
    ///
    /// A feedforward with another preview begins at rest at the reference that the PID used last; the integral term absorbs the
    /// change of its command. This is without a bump while the reference stands; on a ramp the command may step.
    ///
    /// New biquads begin at the output of the former ones or, if they magnify a step, at the values of the reference's
    /// ramp and of the new filter. So they never magnify what filters hold back, not even the last place by which a
    /// filter at rest differs from its input. Biquads that stay take a changed filter into account for the same reason.
    ///
    /// Without integral action the absorbed change stays; [`reset`](Self::reset) removes it.
    ///
    /// # Errors
    /// The first setting that is outside its range, or another sample time; then nothing is changed.
    pub fn set_design(&mut self, design: Design<T>) -> Result<(), Refused> {
        let (ts, now) = (design.pid.ts, self.design.pid.ts);
        let expected = "the sample time at which the controller runs";
        Refused::unless(ts == now, "Ts", expected, ts.to_f64())?;
        let new = Self::new(design)?;
        // the next input of the sections if nothing moves: by the former filter and by the new one
        let given = |y: Option<T>, filter: &Feedback<T>| y.map(|y| filter.given(y));
        let measured = self.filter.newest();
        let before = given(measured, &self.filter);
        self.filter = new.filter.clone().after(&self.filter);
        let jumped = self.lead_by(&design, new.filter);
        let standing = given(measured, &self.filter);
        self.ramp = new.ramp.after(&self.ramp);
        let terms = match &new.table {
            Some(table) => table.at(self.filtered),
            None => new.pid.terms(),
        };
        let sections = design.biquads;
        if sections == self.design.biquads {
            let jump = before.zip(standing).map(|(from, to)| to - from);
            sections.carry(&mut self.of_y, jump);
        } else {
            for (memory, last, standing) in [
                (&mut self.of_y, self.filtered, standing),
                (&mut self.of_r, self.pid.reference(), self.ramp.newest()),
            ] {
                if memory.started {
                    memory.rest_at(sections.origin(last, standing));
                }
            }
        }
        self.pid.change(design.pid, terms);
        self.pid.absorb(jumped);
        (self.table, self.design) = (new.table, design);
        Ok(())
    }

    /// Takes the feedforward of a new design; returns by how much its command is less than before.
    fn lead_by(&mut self, design: &Design<T>, filter: Feedback<T>) -> T {
        let (new, old) = (&design.feedforward, &self.design.feedforward);
        self.ahead.filtered_by(filter);
        if new == old {
            return T::ZERO;
        }
        let before = if old.is_none() || !self.ahead.started {
            T::ZERO
        } else {
            self.ahead.command(old)
        };
        if new.is_none() || !self.pid.is_started() {
            self.ahead.reset();
            return before;
        }
        if (old.is_none(), new.preview(), new.late()) != (false, old.preview(), old.late()) {
            self.ahead.stand_at(self.pid.reference());
        }
        before - self.ahead.command(new)
    }

    /// Hands the command to the operator: from the next sample on it is `u`, within the limits.
    ///
    /// Filter, ramp and derivative keep following, and the integral term is what automatic would need for the same
    /// command. A sample without measurement still applies `u`.
    ///
    /// # Errors
    /// A command that is not finite.
    pub fn set_manual(&mut self, u: T) -> Result<(), Refused> {
        self.pid.set_manual(u)
    }

    /// Hands the command back to the controller, which starts from the operator's.
    pub fn set_automatic(&mut self) {
        self.pid.set_automatic();
    }

    /// Whether the command is the operator's.
    pub fn is_manual(&self) -> bool {
        self.pid.is_manual()
    }

    /// The filtered feedback of the last step.
    pub fn filtered(&self) -> T {
        self.filtered
    }

    /// The design.
    pub fn design(&self) -> &Design<T> {
        &self.design
    }

    /// The schedule as the step uses it: at least one row more than points, the last one repeated; empty for constant gains.
    pub fn rows(&self) -> &[Row<T>] {
        self.table.as_ref().map_or(&[], Table::rows)
    }

    /// The numbers used by a step, apart from the biquads; `None` if the gains follow a schedule.
    pub fn numbers(&self) -> Option<Numbers<T>> {
        let (samples, lag, observer) = self.filter.parts();
        self.table.is_none().then(|| Numbers {
            terms: self.pid.terms(),
            tracking: self.settings().tracking(),
            samples,
            lag,
            observer: observer.weights(),
            ramp: self.ramp.change(),
        })
    }

    /// The settings of the PID.
    pub fn settings(&self) -> &Settings<T> {
        self.pid.settings()
    }
}

impl<T: Real> Controller<T> for PidController<T> {
    fn reset(&mut self) {
        self.reset();
    }

    fn step_with(&mut self, r: T, y: T, feedforward: T) -> T {
        self.step_with(r, y, feedforward)
    }

    fn filtered(&self) -> T {
        self.filtered
    }

    fn ts(&self) -> T {
        self.settings().ts
    }

    fn limits(&self) -> (T, T) {
        (self.settings().u_min, self.settings().u_max)
    }
}

/// The settings of a whole controller; symbols as in docs/CONVENTIONS.md.
///
/// ```
/// use sewfast_control::{PidController, Design, Settings, Standard};
///
/// let gains = Standard { kp: 0.02, ti: 0.25, td: 0.004 };
/// let pid = Settings { u_min: -20.0, u_max: 20.0, ..Settings::new(gains, 1e-3) };
/// let design = Design { observer_time: 0.004, r_rate: 5000.0, ..Design::new(pid) };
/// assert!(PidController::new(design).is_ok());
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Design<T> {
    /// Gains, set-point weights, limits and sample time.
    pub pid: Settings<T>,
    /// Moving average in the feedback \[samples\]; 1 for none.
    pub filter_samples: usize,
    /// First-order lag in the feedback after it \[s\]; 0 for none.
    pub filter_time: T,
    /// Time constant of the alpha-beta observer after that \[s\]; 0 for none.
    pub observer_time: T,
    /// Largest change of the ramped reference \[y/s\]; infinite for none.
    pub r_rate: T,
    /// Gains over speed; empty for the constant ones of `pid`.
    pub schedule: Schedule<T>,
    /// Biquads, such as notches, on reference and feedback; none by default.
    pub biquads: Cascade<T>,
    /// The command that a model needs for the reference; none by default.
    pub feedforward: Feedforward<T>,
}

impl<T: Real> Design<T> {
    /// The PID alone: no filter, no observer, no ramp, no schedule, no biquads, no feedforward.
    pub fn new(pid: Settings<T>) -> Self {
        Self {
            pid,
            filter_samples: 1,
            filter_time: T::ZERO,
            observer_time: T::ZERO,
            r_rate: T::INFINITY,
            schedule: Schedule::NONE,
            biquads: Cascade::NONE,
            feedforward: Feedforward::NONE,
        }
    }
}

#[cfg(test)]
mod tests;
