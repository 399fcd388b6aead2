//! What the loop makes of the device's frames.

use sewfast_control::link::{Body, Fields, Frame};

use super::kind;
use super::outcome::Outcome;
use super::tick::{HostLoop, Phase, State};
use crate::bodies::{self, Status};

/// States of the device, by the protocol's numbers.
const BOOT: u8 = 0;
const IDLE: u8 = 1;
const TRIPPED: u8 = 4;

/// Events of the protocol that end a run.
const FINISHED: u8 = 4;
const DISARMED: u8 = 5;
const TRIP: u8 = 6;

impl HostLoop {
    /// Takes the frames and samples in `received`.
    pub(super) fn listen(&mut self, now: u64, received: &[u8]) {
        let state = &mut self.state;
        self.receiver.feed(received, |frame| state.hear(now, frame));
        self.receiver.append_to(&mut state.history.columns);
        state.take(now);
        if self.receiver.counters().resets > 0 {
            state.reset();
        }
    }
}

impl State {
    fn hear(&mut self, now: u64, frame: &Frame<'_>) {
        if frame.header.tag != self.settings.tag {
            return self.reset();
        }
        if self.phase == Phase::Starting {
            self.heard = now;
        }
        let mut fields = Fields::new(frame.body);
        // A frame too short for its kind says nothing.
        let _ = match frame.header.kind {
            kind::EVENT => self.event(&mut fields),
            kind::BEAT => self.beat(&mut fields),
            reply if reply == self.request.kind | kind::REPLY => self.reply(now, &mut fields),
            _ => None,
        };
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

    fn reply(&mut self, now: u64, fields: &mut Fields<'_>) -> Option<()> {
        let (sequence, result) = bodies::reply(fields)?;
        if sequence != self.request.sequence || self.request.sent == 0 {
            return None;
        }
        if self.request.sent == 1 {
            let trip = now.saturating_sub(self.request.at);
            self.round_trip = Some(self.round_trip.map_or(trip, |least| least.min(trip)));
        }
        if result == 0 {
            return self.done_with(now, fields);
        }
        self.refused(result, fields.u32()?);
        Some(())
    }

    fn done_with(&mut self, now: u64, fields: &mut Fields<'_>) -> Option<()> {
        match self.phase {
            Phase::Arming => {
                self.phase = Phase::Starting;
                self.heard = now;
                self.request(kind::START, self.start_body());
            }
            Phase::Starting => {
                let (_run, start) = bodies::started(fields)?;
                self.begin(now, start);
            }
            Phase::Stopping => {
                self.stopped = true;
                self.phase = Phase::Asking;
                self.request(kind::STATUS, Body::new());
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
        self.request.sent = 0;
    }

    fn refused(&mut self, result: u8, detail: u32) {
        match self.phase {
            Phase::Arming | Phase::Starting => self.stop(Outcome::Refused {
                command: self.request.kind,
                result,
                detail,
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

    fn event(&mut self, fields: &mut Fields<'_>) -> Option<()> {
        let event = bodies::Event::of(fields)?;
        if self.phase == Phase::Running {
            match event.code {
                FINISHED => self.finished(),
                DISARMED => self.stop(Outcome::Ended),
                TRIP => self.tripped(event.reason, event.value),
                _ => {}
            }
        }
        Some(())
    }

    /// Said while not running, so that an event that was lost is noticed.
    fn beat(&mut self, fields: &mut Fields<'_>) -> Option<()> {
        let (_boot, state, reason) = (fields.u32()?, fields.u8()?, fields.u8()?);
        if self.phase == Phase::Running {
            match state {
                TRIPPED => self.tripped(reason, f32::NAN),
                BOOT | IDLE => self.stop(Outcome::Ended),
                _ => {}
            }
        }
        Some(())
    }

    /// A device that has reset is safe, and knows nothing of this session.
    fn reset(&mut self) {
        self.stop(Outcome::Reset);
        self.phase = Phase::Done;
    }
}
