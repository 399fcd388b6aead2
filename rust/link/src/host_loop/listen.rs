//! What the loop makes of what the device says.

use sewfast_control::link::{Body, Fields};

use super::outcome::Outcome;
use super::tick::{HostLoop, Phase};
use crate::bodies::{self, Beat, Status};
use crate::client::{Event, Reply, kind};

/// States of the device, by the protocol's numbers.
const BOOT: u8 = 0;
const IDLE: u8 = 1;
const TRIPPED: u8 = 4;

/// Events of the protocol that end a run.
const FINISHED: u8 = 4;
const DISARMED: u8 = 5;
const TRIP: u8 = 6;

impl HostLoop {
    /// Takes what the device says and the samples in `received`.
    pub(super) fn listen(&mut self, now: u64, received: &[u8]) {
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

    /// Looks at the samples that have come; those of an earlier run are dropped.
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
        // a body too short for its kind is as good as none: it would come again as it is
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

    /// The device's own count says whether a run that it ended was whole.
    fn conclude(&mut self, status: Status) {
        self.phase = Phase::Done;
        self.status = Some(status);
        if self.outcome == Some(Outcome::Ended) && status.samples >= self.length() {
            self.outcome = None;
            self.finished();
        }
        // a trip whose event was lost; STOP leaves a tripped device tripped, so that the host may have taken it for the end
        let ended = matches!(self.outcome, Some(Outcome::Ended | Outcome::Completed));
        if ended && status.state == TRIPPED {
            let (reason, value) = (status.reason, f32::NAN);
            self.outcome = Some(Outcome::Tripped { reason, value });
        }
    }

    /// The device has run to the end, before which the last ticks were due.
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

    /// Said while not running, so that an event that was lost is noticed.
    fn beat(&mut self, beat: &Beat) {
        if self.phase == Phase::Running {
            match beat.state {
                TRIPPED => self.tripped(beat.reason, f32::NAN),
                BOOT | IDLE => self.stop(Outcome::Ended),
                _ => {}
            }
        }
    }

    /// A device that has reset is safe, and knows nothing of this session.
    fn reset(&mut self) {
        self.stop(Outcome::Reset);
        self.phase = Phase::Done;
    }
}
