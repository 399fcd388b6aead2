//! The loop without port or clock: time and bytes in, at most one frame out; and its reactions to the device.

use sewfast_control::PidController;
use sewfast_control::link::{Body, Fields};
use sewfast_core::Result;

use super::history::{Age, History};
use super::{Outcome, Settings, Tick, Ticks};
use crate::bodies::{self, Beat, Status};
use crate::client::{Client, Event, Reply, kind};
use crate::receiver::Counters;
use crate::samples::Channel;

/// How long after the usual arrival of samples a tick comes \[us\]: the permitted variation of their delay.
const MARGIN: u64 = 1000;

/// An armed device sends something every 200 ms, so it must be heard within this time \[us\].
const ARMED_SILENCE: u64 = 250_000;

/// What the loop is waiting for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Arming,
    Starting,
    Running,
    Stopping,
    Asking,
    Done,
}

/// A controller that drives a device in mode 2: it arms and starts the device, sends a command each period, and stops it.
#[derive(Debug)]
pub struct HostLoop {
    pub(super) client: Client,
    settings: Settings,
    controller: PidController<f64>,
    reference: Vec<f64>,
    phase: Phase,
    outcome: Option<Outcome>,
    fed: u64,
    start: i64,
    deadline: u64,
    next: usize,
    newest: Option<i64>,
    used: Option<i64>,
    heard: u64,
    age: Age,
    round_trip: Option<u64>,
    stopped: bool,
    status: Option<Status>,
    history: History,
    ticks: Ticks,
}

impl HostLoop {
    /// A loop at rest that has sent nothing, in a session that `client` has opened. `channels` are those of the mask,
    /// counts first; `reference` has a value for each of its periods.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for settings with which no loop can run.
    pub fn new(
        mut client: Client,
        settings: Settings,
        channels: &[Channel],
        mut controller: PidController<f64>,
        reference: Vec<f64>,
    ) -> Result<Self> {
        settings.check(channels.len(), reference.len(), controller.settings().ts)?;
        controller.reset();
        client.set_watchdog(settings.watchdog);
        client.receiver().expect(channels, settings.device_period)?;
        client.arm();
        let samples = (reference.len() * settings.ratio as usize).min(super::ROOM);
        Ok(Self {
            client,
            settings,
            controller,
            phase: Phase::Arming,
            outcome: None,
            fed: 0,
            start: 0,
            deadline: 0,
            next: 0,
            newest: None,
            used: None,
            heard: 0,
            age: Age::default(),
            round_trip: None,
            stopped: false,
            status: None,
            history: History::with_capacity(samples, channels.len()),
            ticks: Ticks::with_capacity(reference.len().min(super::ROOM)),
            reference,
        })
    }

    /// Takes the bytes received up to `now` \[us\] and returns the frame to send, or nothing.
    ///
    /// A call before [`wake`](Self::wake) only takes bytes. A deadline missed by more than a period is skipped and counted.
    pub fn tick(&mut self, now: u64, received: &[u8]) -> &[u8] {
        self.listen(now, received);
        let u = self.drive(now);
        match (self.phase, u) {
            (Phase::Running, Some(u)) => self.client.drive(now, u),
            (Phase::Running | Phase::Done, _) => &[],
            _ => self.ask(now),
        }
    }

    /// When [`tick`](Self::tick) must be called at the latest \[us\].
    pub fn wake(&self) -> u64 {
        let due = self.client.due().unwrap_or(0);
        match self.phase {
            Phase::Running => self.deadline,
            Phase::Starting => due.min(self.keep_due()),
            Phase::Done => 0,
            _ => due,
        }
    }

    /// Counts a command that was not sent.
    pub fn unsent(&mut self) {
        self.ticks.unsent += 1;
    }

    /// True once everything has been sent and answered, or given up.
    pub fn done(&self) -> bool {
        self.phase == Phase::Done
    }

    /// Ends the loop without sending anything: there is no port.
    pub fn abandon(&mut self, why: Outcome) {
        self.stop(why);
        self.phase = Phase::Done;
    }

    /// How it ended; `None` while it runs.
    pub fn outcome(&self) -> Option<&Outcome> {
        self.outcome.as_ref()
    }

    /// The decisions of each tick.
    pub fn ticks(&self) -> &Ticks {
        &self.ticks
    }

    /// Every received sample of the run.
    pub fn history(&self) -> &History {
        &self.history
    }

    /// The device's status after the run, if that reply came.
    pub fn status(&self) -> Option<&Status> {
        self.status.as_ref()
    }

    /// Device time of the run's first sample \[us\]; 0 if it never began.
    pub fn start(&self) -> i64 {
        self.start
    }

    /// The shortest time in which a command was answered \[us\].
    pub fn round_trip(&self) -> Option<u64> {
        self.round_trip
    }

    /// How often frames were lost, refused or late on the way to the host.
    pub fn counters(&self) -> &Counters {
        self.client.counters()
    }

    /// True once the device has answered STOP.
    pub fn stopped(&self) -> bool {
        self.stopped
    }

    /// Sequence numbers of the last command and of the last heartbeat, from which the session continues.
    pub fn sequences(&self) -> (u32, u32) {
        self.client.sequences()
    }

    /// Number of finished ticks, and of all ticks.
    pub fn progress(&self) -> (usize, usize) {
        (self.next, self.reference.len())
    }
}

impl HostLoop {
    /// Repeats the pending command or gives it up; meanwhile feeds the watchdog of an armed device.
    fn ask(&mut self, now: u64) -> &[u8] {
        if let Some(unanswered) = self.client.expire(now) {
            self.give_up(unanswered.kind);
        }
        if self.client.due().is_some_and(|due| now >= due) {
            self.fed = now;
            return self.client.transmit(now);
        }
        if self.phase == Phase::Starting && now >= self.keep_due() {
            self.fed = now;
            return self.client.keep(now);
        }
        &[]
    }

    fn give_up(&mut self, command: u8) {
        match self.phase {
            Phase::Arming | Phase::Starting => self.stop(Outcome::Unanswered(command)),
            _ => self.phase = Phase::Done,
        }
    }

    /// When an armed device needs the next heartbeat; never once it has long been silent, so that its watchdog ends
    /// whatever it may be doing.
    fn keep_due(&self) -> u64 {
        let due = self.fed + u64::from(self.settings.watchdog / 4);
        let deaf_after = ARMED_SILENCE.max(self.settings.watchdog.into());
        if due > self.heard + deaf_after {
            u64::MAX
        } else {
            due
        }
    }

    /// Runs a tick if its deadline has come: measure, control; returns the command. `None` if no tick is due, or the loop ends.
    fn drive(&mut self, now: u64) -> Option<f64> {
        if self.phase != Phase::Running || now < self.deadline {
            return None;
        }
        let (late, period) = (now - self.deadline, self.settings.period());
        let missed = usize::try_from(late / period).unwrap_or(usize::MAX);
        let left = self.reference.len() - self.next;
        self.ticks.missed += missed.min(left) as u64;
        self.next += missed.min(left);
        self.deadline = now - late % period + period;
        let Some(&r) = self.reference.get(self.next) else {
            self.stop(Outcome::Completed);
            return None;
        };
        if now.saturating_sub(self.heard) > u64::from(self.settings.watchdog) {
            self.stop(Outcome::Silent);
            return None;
        }
        let u = self.control(now, late, r);
        self.next += 1;
        Some(u)
    }

    /// The command for this tick, from the speed over the newest period; without a new sample the last command is kept.
    fn control(&mut self, now: u64, late: u64, r: f64) -> f64 {
        let newest = self.history.newest();
        let fresh = newest > self.used;
        let y = match newest {
            // ARM is refused unless the motor stands still.
            None if self.next == 0 => 0.0,
            Some(_) if fresh => {
                let period = self.settings.period().cast_signed();
                self.history.rate(period, self.start) / self.settings.counts_per_unit
            }
            _ => f64::NAN,
        };
        self.used = newest;
        let u = self.controller.step(r, y);
        self.ticks.push(Tick {
            number: self.next,
            late,
            age: newest.and_then(|time| self.age.of(now, time)),
            fresh,
            y,
            feedback: self.controller.filtered(),
            u,
        });
        u
    }

    /// Ends the loop for the first reason given: the next frame is STOP, and no command to the motor follows it.
    pub fn stop(&mut self, why: Outcome) {
        if self.outcome.is_none() {
            self.outcome = Some(why);
        }
        if matches!(self.phase, Phase::Arming | Phase::Starting | Phase::Running) {
            self.phase = Phase::Stopping;
            self.client.begin(kind::STOP, Body::new());
        }
    }

    /// Sets the grid of deadlines shortly after the first samples, so that all ticks find fresh ones; without samples
    /// it begins after half the watchdog time.
    fn set_grid(&mut self, now: u64, sampled: bool) {
        self.deadline = if sampled {
            now + (self.settings.period() / 16).min(MARGIN)
        } else {
            now + u64::from(self.settings.watchdog / 2)
        };
    }

    /// START of mode 2, at the next sample; the host stops the run before it ends by itself.
    fn start_body(&self) -> Body {
        let s = &self.settings;
        let start = bodies::Start {
            mode: 2,
            watchdog: s.watchdog,
            at: 0,
            length: self.length(),
            mask: s.mask,
            batch: s.batch,
        };
        start.body()
    }

    /// Most samples of the run: the reference, the batch before its first tick, and a period for delays.
    fn length(&self) -> u32 {
        let periods = self.reference.len() as u64 + 1;
        let samples = periods * u64::from(self.settings.ratio) + u64::from(self.settings.batch);
        u32::try_from(samples).unwrap_or(u32::MAX)
    }
}

/// States of the device, by the protocol's numbers.
const BOOT: u8 = 0;
const IDLE: u8 = 1;
const TRIPPED: u8 = 4;

/// Events of the protocol that end a run.
const FINISHED: u8 = 4;
const DISARMED: u8 = 5;
const TRIP: u8 = 6;

impl HostLoop {
    /// Takes the device's frames and the samples in `received`.
    fn listen(&mut self, now: u64, received: &[u8]) {
        self.client.receive(now, received);
        while let Some(event) = self.client.event() {
            match event {
                Event::Reply(reply) => self.reply(now, &reply),
                Event::Happened(event, _) => self.happened(&event),
                Event::Beat(beat) => self.beat(&beat),
                Event::Reset => self.reset(),
            }
        }
        if self.phase == Phase::Starting && self.client.heard() == Some(now) {
            self.heard = now;
        }
        self.client.receiver().append_to(&mut self.history.columns);
        self.take(now);
    }

    /// Takes the new samples; those of an earlier run are dropped.
    fn take(&mut self, now: u64) {
        if matches!(self.phase, Phase::Arming) {
            self.history.keep(i64::MAX, 0);
        }
        let newest = self.history.newest();
        if newest == self.newest {
            return;
        }
        if self.newest.is_none() && self.phase == Phase::Running && self.ticks.run.is_empty() {
            self.set_grid(now, true);
        }
        self.newest = newest;
        self.heard = now;
        if let Some(newest) = newest {
            self.age.arrived(now, newest);
        }
        if self.history.times().len() > self.length() as usize {
            self.history.keep(self.start, self.length() as usize);
        }
    }

    fn reply(&mut self, now: u64, reply: &Reply) {
        if let Some(trip) = reply.round_trip {
            self.round_trip = Some(self.round_trip.map_or(trip, |least| least.min(trip)));
        }
        if reply.result != 0 {
            return self.refused(reply);
        }
        let mut fields = Fields::new(reply.body.bytes().unwrap_or_default());
        // a body too short for its kind counts as no reply: a repeat would be the same
        if self.done_with(now, &mut fields).is_none() {
            self.give_up(reply.kind);
        }
    }

    fn done_with(&mut self, now: u64, fields: &mut Fields<'_>) -> Option<()> {
        match self.phase {
            Phase::Arming => {
                self.phase = Phase::Starting;
                self.heard = now;
                let body = self.start_body();
                self.client.begin(kind::START, body);
            }
            Phase::Starting => {
                let (_run, start) = bodies::started(fields)?;
                self.begin(now, start);
            }
            Phase::Stopping => {
                self.stopped = true;
                self.phase = Phase::Asking;
                self.client.begin(kind::STATUS, Body::new());
            }
            Phase::Asking => {
                self.conclude(Status::of(fields)?);
            }
            Phase::Running | Phase::Done => {}
        }
        Some(())
    }

    fn begin(&mut self, now: u64, start: u64) {
        self.phase = Phase::Running;
        self.start = i64::try_from(start).unwrap_or(i64::MAX);
        self.history.keep(self.start, self.length() as usize);
        self.heard = now;
        self.set_grid(now, false);
    }

    fn refused(&mut self, reply: &Reply) {
        match self.phase {
            Phase::Arming | Phase::Starting => self.stop(Outcome::Refused {
                command: reply.kind,
                result: reply.result,
                detail: reply.detail,
            }),
            _ => self.phase = Phase::Done,
        }
    }

    /// The device's own count shows whether a run that it ended was complete.
    fn conclude(&mut self, status: Status) {
        self.phase = Phase::Done;
        self.status = Some(status);
        if self.outcome == Some(Outcome::Ended) && status.samples >= self.length() {
            self.outcome = None;
            self.finished();
        }
        // a trip whose event was lost: STOP leaves a tripped device tripped, so the host may have mistaken it for the end
        let ended = matches!(self.outcome, Some(Outcome::Ended | Outcome::Completed));
        if ended && status.state == TRIPPED {
            let (reason, value) = (status.reason, f32::NAN);
            self.outcome = Some(Outcome::Tripped { reason, value });
        }
    }

    /// The device ran to the end; the last ticks were due before that.
    fn finished(&mut self) {
        self.ticks.missed += (self.reference.len() - self.next) as u64;
        self.next = self.reference.len();
        self.stop(Outcome::Completed);
    }

    fn tripped(&mut self, reason: u8, value: f32) {
        if self.outcome == Some(Outcome::Ended) {
            self.outcome = None;
        }
        self.stop(Outcome::Tripped { reason, value });
    }

    fn happened(&mut self, event: &bodies::Event) {
        if self.phase == Phase::Running {
            match event.code {
                FINISHED => self.finished(),
                DISARMED => self.stop(Outcome::Ended),
                TRIP => self.tripped(event.reason, event.value),
                _ => {}
            }
        }
    }

    /// Sent while not running, so that a lost event is noticed.
    fn beat(&mut self, beat: &Beat) {
        if self.phase == Phase::Running {
            match beat.state {
                TRIPPED => self.tripped(beat.reason, f32::NAN),
                BOOT | IDLE => self.stop(Outcome::Ended),
                _ => {}
            }
        }
    }

    /// A device that has reset is safe, but knows nothing of this session.
    fn reset(&mut self) {
        self.stop(Outcome::Reset);
        self.phase = Phase::Done;
    }
}
