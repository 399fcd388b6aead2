//! Executes or refuses the host's commands.

use super::{Core, Event, Reason, Run, State, Weight};
use crate::link::command::{
    Beat, Command, Gains, HELLO, Heartbeat, Refusal, STOP, Start, Upload, check_watchdog,
};
use crate::link::identity::{Limits, OLDEST, Travel, VERSION, capability};
use crate::link::positions::{self, Asked, Wish};
use crate::link::profile::Table;
use crate::link::session::{Order, Reply, Session, key};
use crate::link::{Body, Fields, Frame};
use crate::{Cascade, FARTHEST, Feedforward, PositionDesign};

/// How far ahead a run can be planned \[us\].
const AHEAD: u64 = 10_000_000;

type Done = Result<(), Refusal>;

impl<const CAPACITY: usize, const TRANSMIT: usize> Core<CAPACITY, TRANSMIT> {
    /// A frame that arrived whole.
    pub(super) fn frame(&mut self, frame: &Frame<'_>) {
        self.received = self.received.wrapping_add(1);
        match frame.header.kind {
            HELLO => {
                let reply = self.answer(frame);
                self.send(Weight::Answer, reply.kind, &reply.body);
            }
            0x00..0x20 => self.command(frame),
            0x20..0x40 => self.heartbeat(frame),
            _ => {}
        }
    }

    fn command(&mut self, frame: &Frame<'_>) {
        let (tag, sequence) = (frame.header.tag, frame.header.sequence);
        let Some(session) = &mut self.session else {
            return;
        };
        let (own, stop) = (session.says(frame), frame.header.kind == STOP);
        if !own && !stop {
            return;
        }
        if tag != self.identity.tag() {
            let reply = reply(frame, &Err(Refusal::tag(tag)), &Body::new());
            return self.send(Weight::Answer, reply.kind, &reply.body);
        }
        let order = Order::of(sequence, session.command);
        // from any host, and however late: an unwanted stop is the lesser harm
        if stop && (!own || order == Order::Old) {
            let reply = self.answer(frame);
            return self.send(Weight::Answer, reply.kind, &reply.body);
        }
        match order {
            Order::Old => {}
            Order::Repeated => {
                if let Some(reply) = session.reply.clone() {
                    self.send(Weight::Answer, reply.kind, &reply.body);
                }
            }
            Order::New => {
                session.command = sequence;
                let reply = self.answer(frame);
                self.send(Weight::Answer, reply.kind, &reply.body);
                if let Some(session) = &mut self.session {
                    session.reply = Some(reply);
                }
            }
        }
    }

    fn answer(&mut self, frame: &Frame<'_>) -> Reply {
        let mut body = Body::new();
        let command = Command::of(frame.header.kind, frame.body);
        let result = command.and_then(|command| self.execute(command, &mut body));
        if result.is_err() && self.state == State::Running {
            self.trip(Reason::BadCommand, frame.header.kind.into());
        }
        reply(frame, &result, &body)
    }

    fn heartbeat(&mut self, frame: &Frame<'_>) {
        let Some(session) = &mut self.session else {
            return;
        };
        if !session.says(frame) {
            return;
        }
        let sequence = frame.header.sequence;
        let in_order = Order::of(sequence, session.heartbeat) == Order::New;
        if frame.header.tag != self.identity.tag() || !in_order {
            return;
        }
        session.heartbeat = sequence;
        let Some(heartbeat) = Heartbeat::of(frame.header.kind, frame.body) else {
            if self.state == State::Running {
                self.trip(Reason::BadCommand, frame.header.kind.into());
            }
            return;
        };
        self.watchdog.feed(self.now, heartbeat.watchdog);
        match heartbeat.beat {
            Beat::Drive(u) if self.state == State::Running => self.run.drive = u,
            Beat::Credit(until) if self.on_credit() => self.credit = Some(until),
            _ => {}
        }
    }

    fn execute(&mut self, command: Command<'_>, body: &mut Body) -> Done {
        match command {
            Command::Hello { from, to, session } => self.hello(from, to, session, body),
            Command::Describe { channel } => {
                let described = self.identity.describe(channel, body);
                described.ok_or(Refusal::value(0))
            }
            Command::Status => {
                self.status(body);
                Ok(())
            }
            Command::Limits(limits) => self.set_limits(limits, body),
            Command::Arm { watchdog, key } => self.arm(watchdog, key),
            Command::Stop => {
                if matches!(self.state, State::Armed | State::Running) {
                    self.stop(Reason::None);
                }
                body.u8(self.state as u8);
                Ok(())
            }
            Command::Clear => self.clear(),
            Command::Upload(upload) => self.upload(upload, body),
            Command::Gains(gains) => self.set_gains(gains),
            Command::Biquads(biquads) => self.set_biquads(biquads),
            Command::Feedforward(feedforward) => self.set_feedforward(feedforward),
            Command::Positions { kind, body: wish } => self.positions(kind, wish, body),
            Command::Start(start) => self.start(start, body),
            Command::Echo(bytes) => {
                body.add(bytes);
                Ok(())
            }
        }
    }

    #[inline(never)]
    fn hello(&mut self, from: u8, to: u8, number: u32, body: &mut Body) -> Done {
        let version = VERSION.min(to);
        Refusal::version(VERSION).unless(version >= OLDEST && from <= version)?;
        Refusal::value(2).unless(number != 0)?;
        if self.session.as_ref().map(|session| session.number) != Some(number) {
            self.change_host(number);
        }
        if self.on_credit() && self.credit.is_none() {
            self.credit = Some(self.now);
        }
        body.u8(version).u32(self.identity.boot_id);
        body.u32(self.identity.schema(version));
        body.u8(self.state as u8);
        body.u8(self.identity.channels.len() as u8);
        body.u32(self.identity.period);
        body.u32(self.identity.capabilities).u32(CAPACITY as u32);
        body.f32(self.identity.counts_per_rev);
        body.text(self.identity.name, 24);
        body.text(self.identity.firmware, 16).u32(number);
        body.u32(self.session.as_ref().map_or(0, |session| session.key));
        Ok(())
    }

    /// Ensures that nothing said by another host moves a motor; its limits do not apply to this one.
    fn change_host(&mut self, number: u32) {
        match self.state {
            State::Running => self.trip(Reason::HostChanged, 0.0),
            State::Armed => self.stop(Reason::HostChanged),
            _ => {}
        }
        let foreign = self.foreign();
        let (entropy, boot) = (self.identity.entropy, self.identity.boot_id);
        let key = key(entropy, boot, number, self.now);
        self.session = Some(Session::new(number, key, foreign));
        self.credit = None;
        self.limits = None;
        self.travel = None;
        self.gains = None;
        self.profile.clear(Table::Commands);
    }

    fn status(&self, body: &mut Body) {
        let run = &self.run;
        body.u8(self.state as u8).u8(self.reason as u8);
        body.u8(run.start.mode).u16(self.stream.mask());
        body.u32(run.number).u64(run.planned.unwrap_or(run.began));
        body.u32(run.samples).u32(run.start.length);
        body.u32(self.profile.end());
        body.f32(self.guard.speed()).i32(self.guard.counts());
        body.u32(self.received).u32(self.refused);
        body.u32(self.transmit.dropped()).u32(run.latest);
        body.u32(self.session.as_ref().map_or(0, |session| session.number));
        body.u32(self.foreign());
    }

    /// Frames of other sessions since boot.
    fn foreign(&self) -> u32 {
        self.session.as_ref().map_or(0, |session| session.foreign)
    }

    fn set_limits(&mut self, limits: Limits, body: &mut Body) -> Done {
        let ceilings = self.identity.ceilings;
        if limits != Limits::NONE {
            self.allow(&[State::Idle])?;
            self.check_limits(&limits)?;
            self.limits = Some(limits);
        }
        for limits in [self.limits.unwrap_or(Limits::NONE), ceilings] {
            for limit in limits.fields() {
                body.f32(limit);
            }
        }
        Ok(())
    }

    fn check_limits(&self, limits: &Limits) -> Done {
        let ceilings = self.identity.ceilings.fields();
        let unmeasured = !self.can(capability::CURRENT) && limits.current.is_finite();
        Refusal::unsupported(3).unless(!unmeasured || limits.current <= 0.0)?;
        for (index, (limit, ceiling)) in (0..).zip(limits.fields().into_iter().zip(ceilings)) {
            Refusal::value(index).unless(limit > 0.0)?;
            Refusal::limit(index).unless(limit <= ceiling)?;
        }
        Ok(())
    }

    fn allow(&self, states: &[State]) -> Done {
        Refusal::state(self.state).unless(states.contains(&self.state))
    }

    fn arm(&mut self, watchdog: u32, key: u32) -> Done {
        self.allow(&[State::Idle])?;
        check_watchdog(watchdog, 0)?;
        let greeted = self.session.as_ref().map(|session| session.key);
        Refusal::KEY.unless(greeted == Some(key))?;
        Refusal::NO_LIMITS.unless(self.limits.is_some())?;
        Refusal::MOVING.unless(self.guard.at_rest())?;
        if self.can(capability::COMPUTED) {
            self.guard.forget();
        }
        self.armed = self.armed.wrapping_add(1);
        self.state = State::Armed;
        self.watchdog.feed(self.now, watchdog);
        self.event(Event::Armed, Reason::None, 0.0);
        Ok(())
    }

    fn clear(&mut self) -> Done {
        self.allow(&[State::Idle, State::Tripped])?;
        if self.state == State::Tripped {
            self.state = State::Idle;
            self.event(Event::Cleared, Reason::None, 0.0);
        }
        Ok(())
    }

    fn upload(&mut self, upload: Upload<'_>, body: &mut Body) -> Done {
        self.allow(&[State::Idle, State::Armed, State::Running])?;
        let (table, needed) = match upload.table {
            0 => (Table::Commands, capability::PROFILE),
            1 => (Table::References, capability::PID),
            2 if positions::HAS => (Table::Goals, capability::POSITIONS),
            _ => return Err(Refusal::unsupported(0)),
        };
        Refusal::unsupported(0).unless(self.can(needed))?;
        let count = values(table, upload.values, 1.0).count() as u32;
        let committed = self.state == State::Running || self.run.planned.is_some();
        let anew = upload.offset == 0 && !committed;
        let known = if anew {
            Refusal::room(CAPACITY as u32).unless(count as usize <= CAPACITY)?;
            0
        } else {
            self.profile.place(table, upload.offset, count)?
        };
        let steps = self.identity.steps_per_volt();
        let limit = self.profile_limit(table);
        for (index, value) in (0..).zip(values(table, upload.values, steps)) {
            Refusal::limit(index).unless(value.abs() <= limit)?;
            let goes = positions::HAS && table == Table::Goals && self.state == State::Running;
            Refusal::limit(index).unless(!goes || self.holds_goal(self.run.from, value))?;
        }
        if anew {
            self.profile.clear(table);
        }
        for value in values(table, upload.values, steps).skip(known as usize) {
            self.profile.push(value);
        }
        body.u32(self.profile.end()).u32(self.profile.room());
        Ok(())
    }

    /// The largest value of a profile; a reference is a speed in the unit of the gains, or in RPM before there are gains.
    fn profile_limit(&self, table: Table) -> f32 {
        let limits = self.bounds();
        match (table, &self.gains) {
            (Table::Commands, _) => limits.volt,
            (Table::Goals, _) => FARTHEST,
            (Table::References, None) => limits.speed.min(f32::MAX),
            (Table::References, Some(gains)) => {
                let counts = limits.speed * (self.identity.counts_per_rev / 60.0);
                (counts / gains.counts_per_unit).min(f32::MAX)
            }
        }
    }

    #[inline(never)]
    fn set_gains(&mut self, gains: Gains) -> Done {
        self.allow(&[State::Idle, State::Armed])?;
        // the settings that a planned start was checked with must not change
        Refusal::state(self.state).unless(self.run.planned.is_none())?;
        Refusal::unsupported(0).unless(self.can(capability::PID))?;
        Refusal::unsupported(13).unless(!gains.long || self.can(capability::DESIGN))?;
        Refusal::unsupported(0).unless(gains.are_pid() || self.can(capability::KINDS))?;
        gains.check(self.bounds().volt, self.ts)?;
        self.gains = Some(gains);
        Ok(())
    }

    /// Takes a part that belongs to the gains in force: biquads or feedforward of a PID.
    fn set_part<T>(
        &mut self,
        needed: u32,
        part: Result<T, Refusal>,
        is_none: impl Fn(&T) -> bool,
        set: impl Fn(&mut Gains, T),
    ) -> Done {
        self.allow(&[State::Idle, State::Armed])?;
        Refusal::state(self.state).unless(self.run.planned.is_none())?;
        Refusal::unsupported(0).unless(self.can(needed))?;
        let part = part?;
        let gains = self.gains.as_mut().ok_or(Refusal::value(0))?;
        Refusal::value(0).unless(gains.are_pid() || is_none(&part))?;
        set(gains, part);
        Ok(())
    }

    #[inline(never)]
    fn set_biquads(&mut self, biquads: Result<Cascade<f32>, Refusal>) -> Done {
        let needed = capability::BIQUADS;
        self.set_part(needed, biquads, Cascade::is_empty, Gains::set_biquads)
    }

    #[inline(never)]
    fn set_feedforward(&mut self, given: Result<Feedforward<f32>, Refusal>) -> Done {
        let (needed, is_none) = (capability::FEEDFORWARD, Feedforward::is_none);
        self.set_part(needed, given, is_none, Gains::set_feedforward)
    }

    /// Reads and carries out a command of positions, if the device was built with them.
    #[inline(never)]
    fn positions(&mut self, kind: u8, wish: &[u8], body: &mut Body) -> Done {
        Refusal::unsupported(0).unless(positions::HAS)?;
        match Wish::of(kind, wish)? {
            Wish::Position(design) => self.set_position(design),
            Wish::Angle(asked) => self.set_angle(asked, body),
            Wish::Travel(travel) => self.set_travel(travel, body),
        }
    }

    fn set_position(&mut self, design: Result<PositionDesign<f32>, Refusal>) -> Done {
        let (limits, turn) = (self.bounds(), self.identity.counts_per_rev);
        let within = |design: &_| {
            let gains = self.gains.as_ref();
            gains.is_none_or(|gains| gains.moves_within(design, &limits, turn))
        };
        let design =
            design.and_then(|design| Refusal::limit(0).unless(within(&design)).map(|()| design));
        let (needed, set) = (capability::POSITIONS, Gains::set_position);
        self.set_part(needed, design, |_| false, set)
    }

    fn set_angle(&mut self, asked: Result<Asked, Refusal>, body: &mut Body) -> Done {
        self.allow(&[State::Armed, State::Running])?;
        Refusal::state(self.state).unless(self.run.planned.is_none())?;
        Refusal::unsupported(0).unless(self.can(capability::POSITIONS))?;
        let asked = asked?;
        let (ready, from) = if self.state == State::Running {
            let law = self.run.law.as_mut();
            let turns = law.and_then(|law| law.position()).is_some();
            (turns, self.run.samples)
        } else {
            let gains = self.gains.as_ref();
            (gains.is_some_and(|gains| gains.position.is_some()), 0)
        };
        Refusal::value(0).unless(ready && (asked.at == 0 || asked.at >= from))?;
        let at = asked.at.max(from);
        self.asked = Some(Asked { at, ..asked });
        body.u32(at);
        Ok(())
    }

    fn set_travel(&mut self, travel: Travel, body: &mut Body) -> Done {
        Refusal::unsupported(0).unless(self.can(capability::POSITIONS))?;
        if travel != Travel::ASK {
            self.allow(&[State::Idle])?;
            travel.check(&self.identity.travel)?;
            self.travel = Some(travel);
        }
        for Travel { low, high } in [self.travel(), self.identity.travel] {
            body.i32(low).i32(high);
        }
        Ok(())
    }

    /// Whether a goal of a run from this count on is within the limits of the position.
    fn holds_goal(&self, from: i32, goal: f32) -> bool {
        let (travel, from) = (self.travel(), i64::from(from));
        let whole = goal as i64;
        // cut towards 0: the place may be rounded the other way
        let beyond = whole + i64::from(goal > whole as f32) - i64::from(goal < whole as f32);
        travel.holds(from + whole) && travel.holds(from + beyond)
    }

    #[inline(never)]
    fn start(&mut self, start: Start, body: &mut Body) -> Done {
        self.allow(&[State::Armed])?;
        self.check_mode(start.mode)?;
        check_watchdog(start.watchdog, 1)?;
        let in_time = (self.now..=self.now.saturating_add(AHEAD)).contains(&start.at);
        Refusal::value(2).unless(start.at == 0 || in_time)?;
        Refusal::value(3).unless(start.length > 0 || start.mode == 2)?;
        Refusal::value(4).unless(self.stream.knows(start.mask))?;
        Refusal::value(5).unless(self.stream.fits(start.mask, start.batch))?;
        let at = self.on_grid(start.at);
        self.run = Run {
            number: self.run.number.wrapping_add(1),
            start,
            planned: Some(at),
            ..Run::NONE
        };
        self.watchdog.feed(self.now, start.watchdog);
        body.u32(self.run.number).u64(at);
        Ok(())
    }

    /// Checks that the mode has what it needs, within the limits now in force.
    fn check_mode(&self, mode: u8) -> Done {
        let (needed, table) = match mode {
            0 => (capability::PROFILE, Some(Table::Commands)),
            1 => (capability::PID, Some(Table::References)),
            2 => (capability::DRIVE, None),
            3 => (capability::POSITIONS, Some(Table::Goals)),
            _ => return Err(Refusal::value(0)),
        };
        Refusal::unsupported(0).unless(self.can(needed))?;
        if let Some(table) = table {
            Refusal::value(3).unless(self.profile.holds(table))?;
            let within = self.profile.peak() <= self.profile_limit(table);
            Refusal::limit(0).unless(within)?;
        }
        let (mut turns, limits) = (false, self.bounds());
        if mode == 1 || mode == 3 {
            let gains = self.gains.as_ref().ok_or(Refusal::value(0))?;
            let refused = gains.refused(limits.volt, self.ts);
            Refusal::limit(0).unless(refused.is_none())?;
            if let (true, Some(design)) = (positions::HAS, &gains.position) {
                let turn = self.identity.counts_per_rev;
                Refusal::limit(0).unless(gains.moves_within(design, &limits, turn))?;
                turns = true;
            }
        }
        Refusal::value(0).unless(turns || mode != 3 && self.asked.is_none())?;
        if !positions::HAS || mode != 3 {
            return Ok(());
        }
        let ((low, high), from) = (self.profile.range(), self.guard.counts());
        Refusal::limit(0).unless(self.holds_goal(from, low) && self.holds_goal(from, high))
    }

    /// Due time of the first sample at `at` or later, but not before the next one.
    fn on_grid(&self, at: u64) -> u64 {
        let (period, ahead) = (self.period.get(), at.saturating_sub(self.due));
        let periods = (ahead.saturating_add(period - 1) / self.period).max(1);
        self.due.saturating_add(periods.saturating_mul(period))
    }
}

/// Commands in volt, or references, as received.
fn values(table: Table, bytes: &[u8], steps: f32) -> impl Iterator<Item = f32> {
    let mut fields = Fields::new(bytes);
    core::iter::from_fn(move || match table {
        Table::Commands => fields.i16().map(|value| f32::from(value) / steps),
        Table::References | Table::Goals => fields.f32(),
    })
}

/// The reply to a frame.
fn reply(frame: &Frame<'_>, result: &Done, content: &Body) -> Reply {
    let mut body = Body::new();
    body.u32(frame.header.sequence);
    match result {
        Ok(()) => body.u8(0).add(content.bytes().unwrap_or(&[])),
        Err(refusal) => body.u8(refusal.result).u32(refusal.detail),
    };
    let kind = frame.header.kind | 0x80;
    Reply { kind, body }
}
