//! A host's end of a session with a device, without port or clock: bytes and time in, frames and events out.
//!
//! It is the only client of the protocol (docs/PROTOCOL.md): the loop on the host and the bindings both use it. It
//! holds the session: its number, key and tag, the counters of commands and of heartbeats, the pending command with its
//! repeats, the newest time of the device and when the last frame came. Its owner has the port and the clock:
//!
//! 1. [`receive`](Client::receive) incoming bytes, then take each [`event`](Client::event);
//! 2. [`expire`](Client::expire) commands repeated in vain;
//! 3. write what [`transmit`](Client::transmit) returns, by [`due`](Client::due) at the latest;
//! 4. while a motor may turn, write a heartbeat ([`keep`](Client::keep), [`drive`](Client::drive) or
//!    [`grant`](Client::grant)) every quarter of the watchdog time.
//!
//! Unless they are the device's, all times are the host's, in microseconds of a clock that does not run backwards.
//!
//! ```
//! use sewfast_control::link::Body;
//! use sewfast_link::client::{Client, kind};
//!
//! let mut client = Client::new(7, 100_000);
//! client.greet(1_000_000);
//! assert!(!client.transmit(0).is_empty());
//! assert!(client.transmit(99_999).is_empty(), "it is repeated after .1 s");
//! assert_eq!(client.due(), Some(100_000));
//! ```

use std::collections::VecDeque;

use sewfast_control::link::{Body, Fields, Frame, Header, MAX_WIRE, capability, encode};

use crate::bodies::{self, Beat, Greeting};
use crate::receiver::{Counters, Receiver};

/// Kinds of the protocol's frames.
pub mod kind {
    #![allow(missing_docs, reason = "the protocol's names")]
    pub const HELLO: u8 = 0x01;
    pub const STATUS: u8 = 0x03;
    pub const ARM: u8 = 0x05;
    pub const STOP: u8 = 0x06;
    pub const START: u8 = 0x0A;
    pub const ECHO: u8 = 0x0B;
    pub const KEEP: u8 = 0x20;
    pub const DRIVE: u8 = 0x21;
    pub const CREDIT: u8 = 0x22;
    /// Added to a command's kind in its reply.
    pub const REPLY: u8 = 0x80;
    pub const SAMPLES: u8 = 0xC0;
    pub const EVENT: u8 = 0xC1;
    pub const BEAT: u8 = 0xC2;
}

/// How long to wait for a reply before a command is repeated.
pub const REPEAT: u64 = 100_000;
/// The same for STOP, within any usual watchdog time.
pub const STOP_REPEAT: u64 = 10_000;
/// How long a command is repeated before it is given up, if the watchdog's time is not longer: a motor may turn for
/// that long, and STOP must not be given up earlier.
pub const PATIENCE: u64 = 1_000_000;
/// The same for a device on credit: nothing there turns meanwhile, and a busy computer may not come to it for seconds.
pub const PATIENCE_ON_CREDIT: u64 = 20_000_000;
/// Most events and beats kept for a caller who takes none; later ones are dropped.
const ROOM: usize = 256;

/// A device's reply.
#[derive(Clone, Debug)]
pub struct Reply {
    /// Kind of the command.
    pub kind: u8,
    /// 0, or why it was refused.
    pub result: u8,
    /// Detail of a refusal.
    pub detail: u32,
    /// Empty in a refusal.
    pub body: Body,
    /// Time of the device \[us\].
    pub time: u64,
    /// When the command was sent first.
    pub sent: u64,
    /// Time from then to the reply, if the command was sent only once.
    pub round_trip: Option<u64>,
}

/// Something received from a device.
#[derive(Clone, Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "a reply in a box would be allocated while a motor turns"
)]
pub enum Event {
    /// The reply to the pending command, or to HELLO.
    Reply(Reply),
    /// An event on the device, at this device time \[us\].
    Happened(bodies::Event, u64),
    /// The device's status while it does not run.
    Beat(Beat),
    /// The device has rebooted: it knows nothing of this session, and its motor has no command.
    Reset,
}

/// A command that was repeated in vain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unanswered {
    /// Its kind.
    pub kind: u8,
    /// How often it was sent.
    pub attempts: u64,
    /// How long the host waited \[us\].
    pub waited: u64,
    /// Whole frames received meanwhile.
    pub others: u64,
}

/// A pending command: repeated unchanged until its reply comes or it is given up.
#[derive(Clone, Debug)]
struct Request {
    kind: u8,
    sequence: u32,
    body: Body,
    /// How often it is sent before it is given up.
    tries: u64,
    sent: u64,
    /// When it was first sent; repeats carry the same time.
    first: Option<u64>,
    last: u64,
    /// When its tries began to count: they restart after the session was confirmed on a port that had vanished.
    since: u64,
    /// Number of whole frames received by then.
    frames: u64,
}

impl Request {
    fn new(kind: u8, sequence: u32, body: Body, patience: u64) -> Self {
        Self {
            kind,
            sequence,
            body,
            tries: (patience / repeat(kind)).max(1),
            sent: 0,
            first: None,
            last: 0,
            since: 0,
            frames: 0,
        }
    }

    fn due(&self) -> u64 {
        if self.sent == 0 {
            0
        } else {
            self.last.saturating_add(repeat(self.kind))
        }
    }

    /// Whether the last try has waited long enough. Tries count, not time: a host that did not get the processor for a
    /// while has waited, but not asked.
    fn is_exhausted(&self, now: u64) -> bool {
        self.sent >= self.tries && now >= self.due()
    }

    /// Notes that it is sent now; returns the time for its frame.
    fn send(&mut self, now: u64, frames: u64) -> u64 {
        if self.sent == 0 {
            (self.since, self.frames) = (now, frames);
        }
        self.sent += 1;
        self.last = now;
        *self.first.get_or_insert(now)
    }

    fn given_up(&self, now: u64, frames: u64) -> Unanswered {
        Unanswered {
            kind: self.kind,
            attempts: self.sent,
            waited: now.saturating_sub(self.since),
            others: frames.saturating_sub(self.frames),
        }
    }

    fn answered(&self, now: u64, answer: Answer) -> Event {
        let first = self.first.unwrap_or(now);
        Event::Reply(Reply {
            kind: self.kind,
            result: answer.result,
            detail: answer.detail,
            body: answer.body,
            time: answer.time,
            sent: first,
            round_trip: (self.last == first).then(|| now.saturating_sub(first)),
        })
    }
}

fn repeat(kind: u8) -> u64 {
    if kind == kind::STOP {
        STOP_REPEAT
    } else {
        REPEAT
    }
}

/// A reply that has not been assigned to a request yet.
struct Answer {
    sequence: u32,
    result: u8,
    detail: u32,
    body: Body,
    time: u64,
}

impl Answer {
    /// `None` for a body that is no reply: a refusal has its detail and nothing else.
    fn of(frame: &Frame<'_>) -> Option<Self> {
        let mut fields = Fields::new(frame.body);
        let (sequence, result) = bodies::reply(&mut fields)?;
        let mut detail = 0;
        if result != 0 {
            detail = fields.u32()?;
            fields.end()?;
        }
        let mut body = Body::new();
        body.add(fields.rest());
        Some(Self {
            sequence,
            result,
            detail,
            body,
            time: frame.header.time,
        })
    }

    fn greeting(&self) -> Option<Greeting> {
        Greeting::of(&mut Fields::new(self.body.bytes()?))
    }
}

/// A session with a device; see the module's documentation.
#[derive(Clone, Debug)]
pub struct Client {
    receiver: Receiver,
    session: Session,
    watchdog: u32,
    wire: [u8; 1 + MAX_WIRE],
}

/// Everything except the receiver, which lends the frame while this is changed.
#[derive(Clone, Debug)]
struct Session {
    number: u32,
    tag: Option<u16>,
    key: u32,
    /// How long a command is repeated at least.
    patience: u64,
    /// Number of the last command.
    command: u32,
    /// Number of the last heartbeat.
    heartbeat: u32,
    hello: Option<Request>,
    request: Option<Request>,
    newest: u64,
    heard: Option<u64>,
    events: VecDeque<Event>,
}

impl Client {
    /// A session before HELLO: `session` is its number, not 0; `watchdog` is how long the device may continue without a
    /// heartbeat \[us\].
    pub fn new(session: u32, watchdog: u32) -> Self {
        Self {
            receiver: Receiver::new(),
            session: Session {
                number: session,
                tag: None,
                key: 0,
                patience: PATIENCE,
                command: 0,
                heartbeat: 0,
                hello: None,
                request: None,
                newest: 0,
                heard: None,
                events: VecDeque::with_capacity(ROOM),
            },
            watchdog,
            wire: [0; 1 + MAX_WIRE],
        }
    }

    /// A session that another client has opened and used so far: the device's tag and key, and the numbers of the last
    /// command and of the last heartbeat.
    #[must_use]
    pub fn continued(mut self, tag: u16, key: u32, command: u32, heartbeat: u32) -> Self {
        (self.session.tag, self.session.key) = (Some(tag), key);
        self.go_on(command, heartbeat);
        self
    }

    /// Continues after these numbers, which another client has reached. Frames of the device missed meanwhile do not count as lost.
    pub fn go_on(&mut self, command: u32, heartbeat: u32) {
        (self.session.command, self.session.heartbeat) = (command, heartbeat);
        self.session.request = None;
        self.receiver = Receiver::new();
    }

    /// How long the device may continue without a heartbeat, from the next one on \[us\].
    pub fn set_watchdog(&mut self, watchdog: u32) {
        self.watchdog = watchdog;
    }

    // --- incoming -----------------------------------------------------------------------------------

    /// Takes received bytes.
    pub fn receive(&mut self, now: u64, bytes: &[u8]) {
        let session = &mut self.session;
        let before = *self.receiver.counters();
        // during HELLO a device that was reset must be heard, and so are frames kept by a line
        let expected = session.tag.filter(|_| session.hello.is_none());
        let mut foreign = false;
        self.receiver.feed(bytes, |frame| {
            if expected.is_some_and(|tag| tag != frame.header.tag) {
                foreign = true;
            } else {
                session.hear(now, frame);
            }
        });
        let counters = self.receiver.counters();
        if counters.samples > before.samples {
            session.heard = Some(now);
            let newest = self.receiver.newest().map(u64::try_from);
            session.newest = session.newest.max(newest.and_then(Result::ok).unwrap_or(0));
        }
        if foreign || (expected.is_some() && counters.resets > before.resets) {
            session.events.push_back(Event::Reset);
        }
    }

    /// The next event.
    pub fn event(&mut self) -> Option<Event> {
        self.session.events.pop_front()
    }

    /// The receiver of samples: streamed channels, columns, counters.
    pub fn receiver(&mut self) -> &mut Receiver {
        &mut self.receiver
    }

    /// How often frames were lost, refused or late on the way to the host.
    pub const fn counters(&self) -> &Counters {
        self.receiver.counters()
    }

    // --- outgoing -----------------------------------------------------------------------------------

    /// Sends HELLO before anything else, until it is answered or for `patience` \[us\]. HELLO of the same session
    /// changes nothing on the device.
    pub fn greet(&mut self, patience: u64) {
        let body = bodies::hello(self.session.number);
        self.session.hello = Some(Request::new(kind::HELLO, 0, body, patience));
    }

    /// Stops sending HELLO; an earlier pending command continues.
    pub fn end_greeting(&mut self) {
        self.session.hello = None;
    }

    /// Makes a command pending; replaces one that may be.
    pub fn begin(&mut self, kind: u8, body: Body) {
        let session = &mut self.session;
        session.command = session.command.wrapping_add(1);
        let patience = session.patience.max(self.watchdog.into());
        session.request = Some(Request::new(kind, session.command, body, patience));
    }

    /// Makes ARM pending, with the session's key.
    pub fn arm(&mut self) {
        self.begin(kind::ARM, bodies::arm(self.watchdog, self.session.key));
    }

    /// Drops the pending command.
    pub fn forget(&mut self) {
        self.session.request = None;
    }

    /// Gives up a request that was repeated long enough.
    pub fn expire(&mut self, now: u64) -> Option<Unanswered> {
        let frames = self.counters().frames;
        let under_way = self.session.under_way()?;
        if !under_way.as_ref()?.is_exhausted(now) {
            return None;
        }
        under_way
            .take()
            .map(|request| request.given_up(now, frames))
    }

    /// The frame to write now, or nothing: the pending command, if it is new or due for a repeat.
    pub fn transmit(&mut self, now: u64) -> &[u8] {
        let frames = self.counters().frames;
        let due = self.session.under_way().and_then(Option::as_mut);
        let Some(request) = due.filter(|request| now >= request.due()) else {
            return &[];
        };
        let first = request.send(now, frames);
        let (kind, sequence, body) = (request.kind, request.sequence, request.body);
        self.frame(kind, sequence, first, &body)
    }

    /// When [`transmit`](Self::transmit) or [`expire`](Self::expire) must be called at the latest; `None` if nothing is
    /// pending.
    pub fn due(&self) -> Option<u64> {
        let session = &self.session;
        let request = session.hello.as_ref().or(session.request.as_ref());
        request.map(Request::due)
    }

    /// A heartbeat: the host is there.
    pub fn keep(&mut self, now: u64) -> &[u8] {
        self.heartbeat(kind::KEEP, now, &bodies::keep(self.watchdog))
    }

    /// The command of a direct run \[V\]; also a heartbeat.
    pub fn drive(&mut self, now: u64, u: f64) -> &[u8] {
        self.heartbeat(kind::DRIVE, now, &bodies::drive(self.watchdog, u))
    }

    /// Lets the time of a device on credit advance to `until`; also a heartbeat.
    pub fn grant(&mut self, now: u64, until: u64) -> &[u8] {
        self.heartbeat(kind::CREDIT, now, &bodies::credit(self.watchdog, until))
    }

    fn heartbeat(&mut self, kind: u8, now: u64, body: &Body) -> &[u8] {
        self.session.heartbeat = self.session.heartbeat.wrapping_add(1);
        self.frame(kind, self.session.heartbeat, now, body)
    }

    fn frame(&mut self, kind: u8, sequence: u32, now: u64, body: &Body) -> &[u8] {
        // HELLO carries neither boot nor session; the zero before it ends any partial frame kept by a line
        let (greets, session) = (kind == kind::HELLO, &self.session);
        let tag = session.tag.filter(|_| !greets).unwrap_or(0);
        let time = if greets {
            0
        } else {
            Header::host_time(session.number, now)
        };
        let header = Header {
            kind,
            tag,
            sequence,
            time,
        };
        let (_, block) = self.wire.split_at_mut(1);
        let length = body.bytes().and_then(|body| encode(&header, body, block));
        let end = 1 + length.unwrap_or(0);
        self.wire.get(usize::from(!greets)..end).unwrap_or_default()
    }

    // --- state of the session -----------------------------------------------------------------------

    /// Whether a command is pending.
    pub fn is_busy(&self) -> bool {
        self.session.request.is_some()
    }

    /// The latest time in any of the device's frames \[us\], of the boot that HELLO found.
    pub fn newest(&self) -> u64 {
        self.session.newest
    }

    /// When its last frame came.
    pub fn heard(&self) -> Option<u64> {
        self.session.heard
    }

    /// Numbers of the last command and of the last heartbeat.
    pub fn sequences(&self) -> (u32, u32) {
        (self.session.command, self.session.heartbeat)
    }
}

impl Session {
    /// The request whose turn it is: nothing else is sent until HELLO is answered.
    fn under_way(&mut self) -> Option<&mut Option<Request>> {
        let requests = [&mut self.hello, &mut self.request];
        requests.into_iter().find(|request| request.is_some())
    }

    fn hear(&mut self, now: u64, frame: &Frame<'_>) {
        self.heard = Some(now);
        self.newest = self.newest.max(frame.header.time);
        let mut fields = Fields::new(frame.body);
        // a frame too short for its kind is ignored
        let _ = match frame.header.kind {
            kind::EVENT => self.happened(&mut fields, frame.header.time),
            kind::BEAT => Beat::of(&mut fields).map(|beat| self.add(Event::Beat(beat))),
            reply if (kind::REPLY..kind::SAMPLES).contains(&reply) => {
                self.reply(now, reply & !kind::REPLY, frame)
            }
            _ => None,
        };
    }

    fn happened(&mut self, fields: &mut Fields<'_>, time: u64) -> Option<()> {
        let event = bodies::Event::of(fields)?;
        fields.end()?;
        self.add(Event::Happened(event, time));
        Some(())
    }

    fn add(&mut self, event: Event) {
        if self.events.len() < ROOM {
            self.events.push_back(event);
        }
    }

    /// Takes the reply to the pending request; any other reply is a repeat, or another host's.
    fn reply(&mut self, now: u64, kind: u8, frame: &Frame<'_>) -> Option<()> {
        let answer = Answer::of(frame)?;
        if kind == kind::HELLO {
            return self.greeted(now, answer);
        }
        let is_its = |request: &mut Request| {
            (request.kind, request.sequence) == (kind, answer.sequence) && request.first.is_some()
        };
        let request = self.request.take_if(is_its)?;
        self.events.push_back(request.answered(now, answer));
        Some(())
    }

    /// A reply to HELLO has no session in its header: its body shows whether it is for another host.
    fn greeted(&mut self, now: u64, answer: Answer) -> Option<()> {
        self.hello.as_ref()?;
        if answer.result == 0 {
            let greeting = answer.greeting()?;
            if greeting.session != self.number {
                return None;
            }
            let tag = Some(greeting.boot as u16);
            if self.tag != tag {
                // frames that waited in the port may have been of another boot
                self.newest = answer.time;
            }
            (self.tag, self.key) = (tag, greeting.key);
            self.patience = match greeting.capabilities & capability::CREDIT {
                0 => PATIENCE,
                _ => PATIENCE_ON_CREDIT,
            };
            if let Some(request) = &mut self.request {
                request.sent = 0;
            }
        }
        let hello = self.hello.take()?;
        self.events.push_back(hello.answered(now, answer));
        Some(())
    }
}

#[cfg(test)]
mod tests;
