//! A control period: measure, limits, filter, control, limit, apply.

use super::{Core, Event, Measurement, Output, Reason, State, capability};
use crate::link::guard::Trip;
use crate::link::identity::{Limits, Source};
use crate::link::positions::{self, Law};
use crate::link::stream::to_steps;

/// Good samples in a row that end the boot.
const GOOD: u8 = 10;

impl<const CAPACITY: usize, const TRANSMIT: usize> Core<CAPACITY, TRANSMIT> {
    pub(super) fn sample(&mut self, now: u64, measurement: &Measurement<'_>) {
        self.now = self.now.max(now);
        self.guard.take(measurement.counts);
        self.watchdog.count();
        self.check_watchdog();
        self.keep_time(now);
        match self.state {
            State::Boot => self.settle(measurement),
            State::Armed => self.begin_if_due(),
            _ => {}
        }
        if self.state == State::Running {
            self.step(measurement);
        }
        self.beat();
    }

    /// Ends the boot once the firmware's measurements are trustworthy.
    fn settle(&mut self, measurement: &Measurement<'_>) {
        let good = self.is_good(measurement);
        self.good = if good { self.good.saturating_add(1) } else { 0 };
        if self.good >= GOOD {
            self.state = State::Idle;
        }
    }

    fn is_good(&self, measurement: &Measurement<'_>) -> bool {
        let current = measurement.current.is_finite() || !self.can(capability::CURRENT);
        current && measurement.further.iter().all(|value| value.is_finite())
    }

    /// Sets when this sample was due. A run has a grid and ends if a sample is off it; without a run, samples come as they come.
    fn keep_time(&mut self, now: u64) {
        let planned = self.state == State::Armed && self.run.planned.is_some();
        if self.state != State::Running && !planned {
            self.due = self.now;
            return;
        }
        let period = self.period.get();
        self.due = self.due.saturating_add(period);
        let (late, early) = (now.saturating_sub(self.due), self.due.saturating_sub(now));
        self.run.latest = self.run.latest.max(u32::try_from(late).unwrap_or(u32::MAX));
        let half = late >= period / 2;
        // after a lost sample all that follow are a period late, less the jitter
        let off = late >= period || early > period / 2 || half && self.run.late_before;
        self.run.late_before = half;
        if !off {
            return;
        }
        if planned {
            self.stop(Reason::Late);
            self.due = self.now;
        } else {
            self.trip(Reason::Late, late as f32 - early as f32);
        }
    }

    #[inline(never)]
    fn begin_if_due(&mut self) {
        if self.run.planned.is_none_or(|at| self.due < at) {
            return;
        }
        let (start, limits) = (self.run.start, self.bounds());
        self.run.planned = None;
        self.run.began = self.due;
        self.run.law = None;
        if let (1 | 3, Some(gains)) = (start.mode, &self.gains) {
            gains.begin(&mut self.run.law, limits.volt, self.ts, start.mode);
        }
        self.run.from = self.guard.counts();
        self.guard.begin();
        self.stream.begin(start.mask, start.batch);
        self.state = State::Running;
        self.event(Event::Started, Reason::None, 0.0);
    }

    fn step(&mut self, measurement: &Measurement<'_>) {
        let length = self.run.start.length;
        if length != 0 && self.run.samples >= length {
            self.halt(State::Idle);
            return self.event(Event::Finished, Reason::None, 0.0);
        }
        match self.command_for(measurement) {
            Ok((u, reference, clipped)) => {
                self.output = Output { u, enabled: true };
                self.record(measurement, reference, clipped);
            }
            Err((reason, value)) => self.trip(reason, value),
        }
    }

    /// Returns command, reference, and whether the command was clipped.
    fn command_for(&mut self, measurement: &Measurement<'_>) -> Result<(f32, f32, bool), Trip> {
        let limits = self.limits.unwrap_or(Limits::NONE);
        if !self.is_good(measurement) {
            return Err((Reason::Measurement, f32::NAN));
        }
        let measured = self.can(capability::CURRENT);
        let current = if measured { measurement.current } else { 0.0 };
        self.guard.check(&limits, current)?;
        self.check_travel(self.guard.counts().into())?;
        let (wanted, reference) = self.wanted()?;
        if !wanted.is_finite() {
            return Err((Reason::Measurement, wanted));
        }
        let u = self.in_whole_steps(wanted.max(-limits.volt).min(limits.volt), limits.volt);
        self.guard.expect_motion(&limits, u)?;
        // a profile may swing as its author wants; without a limit on acceleration there is no check either
        if self.run.start.mode != 0 && limits.acceleration.is_finite() {
            let (low, high) = self.range(limits.volt);
            self.guard.expect_calm(low, high, u)?;
        }
        let bound = limits.volt - 1.0 / self.identity.steps_per_volt();
        let limited = self.run.law.is_some() && u.abs() > bound;
        Ok((u, reference, wanted.abs() > limits.volt || limited))
    }

    /// The limits of the loop's command: the controller's own, which lie within the volt limit, if there is a controller.
    fn range(&self, volt: f32) -> (f32, f32) {
        let own = self.run.law.as_ref().map(Law::limits);
        own.unwrap_or((-volt, volt))
    }

    /// The command in whole steps of its channel: the host sees exactly what is applied.
    fn in_whole_steps(&self, u: f32, limit: f32) -> f32 {
        let per_volt = self.identity.steps_per_volt();
        let steps = to_steps(u, per_volt as u32);
        let value = f32::from(steps) / per_volt;
        if value.abs() > limit {
            f32::from(steps - steps.signum()) / per_volt
        } else {
            value
        }
    }

    fn wanted(&mut self) -> Result<(f32, f32), Trip> {
        if self.run.start.mode == 2 {
            return Ok((self.run.drive, f32::NAN));
        }
        let dry = (Reason::Underrun, self.run.samples as f32);
        let value = self.profile.play().ok_or(dry)?;
        if self.run.start.mode == 0 {
            return Ok((value, f32::NAN));
        }
        if positions::HAS {
            self.stop_if_asked()?;
        }
        let (Some(law), Some(gains)) = (&mut self.run.law, &self.gains) else {
            return Err((Reason::BadCommand, 0.0));
        };
        let unit = self.ts * gains.counts_per_unit;
        // positions are 0 at the first sample of a run, also of a shaft that was turned by hand just before it
        let begins = positions::HAS && self.run.samples == 0 && law.position().is_some();
        let moved = if begins { 0 } else { self.guard.change() };
        let u = law.step(value, moved, unit);
        let goal = law.position().and_then(|turning| turning.goal());
        let goal = goal.map(|goal| goal.saturating_add(self.run.from.into()));
        goal.map_or(Ok(()), |goal| self.check_travel(goal))?;
        Ok((u, value))
    }

    /// Begins the stop that is due.
    fn stop_if_asked(&mut self) -> Result<(), Trip> {
        let due = |at: u32| at <= self.run.samples;
        let Some(asked) = self.asked.take_if(|asked| due(asked.at)) else {
            return Ok(());
        };
        let turning = self.run.law.as_mut().and_then(Law::position);
        let turning = turning.ok_or((Reason::BadCommand, 0.0))?;
        let turn = self.identity.counts_per_rev;
        let done = turning.stop(asked.angle, turn, asked.onward);
        done.map_err(|refused| (Reason::BadCommand, refused.received as f32))
    }

    fn check_travel(&self, counts: i64) -> Result<(), Trip> {
        if !positions::HAS || self.travel().holds(counts) {
            return Ok(());
        }
        Err((Reason::Travel, counts as f32))
    }

    fn record(&mut self, measurement: &Measurement<'_>, reference: f32, clipped: bool) {
        if !self.stream.accepts(measurement.counts) {
            self.flush();
        }
        let (output, law) = (self.output, &self.run.law);
        let value = |source| match source {
            Source::Counts => measurement.counts as f32,
            Source::Command => output.u,
            Source::Current => measurement.current,
            Source::Reference => reference,
            Source::Feedback => law.as_ref().map_or(f32::NAN, Law::filtered),
            Source::Further(index) => {
                let further = measurement.further.get(usize::from(index));
                further.copied().unwrap_or(f32::NAN)
            }
        };
        self.stream
            .push(self.due, measurement.counts, clipped, value);
        if self.stream.is_full() {
            self.flush();
        }
        self.run.samples = self.run.samples.wrapping_add(1);
    }
}
