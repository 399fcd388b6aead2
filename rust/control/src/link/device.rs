//! A device without its hardware: bytes and time in, bytes and command out (docs/PROTOCOL.md). Begin reading at [`Device`].
//!
//! ```
//! use sewfast_control::link::{Channel, Device, Encoding, Identity, Limits, Measurement, Source, State, Travel, capability};
//!
//! static CHANNELS: [Channel; 2] = [
//!     Channel { encoding: Encoding::Counts, steps_per_unit: 1, name: "counts", unit: "1", source: Source::Counts },
//!     Channel { encoding: Encoding::Steps, steps_per_unit: 1000, name: "u", unit: "V", source: Source::Command },
//! ];
//! let mut device = Device::<1000>::new(Identity {
//!     boot_id: 1,
//!     entropy: 0x3D8A_51C7,
//!     name: "my drive",
//!     firmware: "0.1",
//!     period: 1000,
//!     counts_per_rev: 1572.0,
//!     capabilities: capability::PROFILE | capability::PID | capability::DRIVE | capability::DESIGN
//!         | capability::BIQUADS,
//!     ceilings: Limits { volt: 20.0, speed: 4000.0, acceleration: f32::INFINITY, current: f32::INFINITY },
//!     travel: Travel::ANY,
//!     channels: &CHANNELS,
//! })?;
//! for k in 1..=10 {
//!     let output = device.sample(1000 * k, &Measurement { counts: 0, current: f32::NAN, further: &[] });
//!     assert!(!output.enabled && output.u == 0.0);
//! }
//! assert_eq!(device.state(), State::Idle);
//! # Ok::<(), sewfast_control::Refused>(())
//! ```

mod execute;
mod run;

use core::num::NonZeroU64;

use super::command::{Gains, Start};
use super::guard::Guard;
use super::identity::{Identity, Limits, Travel, capability};
use super::positions::{self, Asked, Law};
use super::profile::Profile;
use super::session::{Session, Watchdog};
use super::stream::{Stream, Transmit, Weight};
use super::{Body, Deframer};
use crate::Refused;

/// Period of BEAT while not running \[us\].
const BEAT: u64 = 200_000;

/// The hardware's measurements at a sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement<'a> {
    /// The counter; it may wrap.
    pub counts: i32,
    /// \[A\]; NaN if the device measures none.
    pub current: f32,
    /// The values named by [`Source::Further`](super::Source::Further).
    pub further: &'a [f32],
}

/// What the hardware has to apply until the next output.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Output {
    /// Command \[V\]; 0 if not enabled.
    pub u: f32,
    /// Whether the drive may be switched on.
    pub enabled: bool,
}

impl Output {
    /// Command 0, drive off.
    pub const SAFE: Self = Self {
        u: 0.0,
        enabled: false,
    };
}

/// A run: planned, in progress or finished.
#[derive(Clone, Debug)]
struct Run {
    number: u32,
    start: Start,
    /// Planned start; `None` once it has begun.
    planned: Option<u64>,
    began: u64,
    samples: u32,
    /// The command of mode 2.
    drive: f32,
    /// What it steps.
    law: Option<Law>,
    /// The counter where positions are 0.
    from: i32,
    /// Largest delay of a sample \[us\].
    latest: u32,
    late_before: bool,
}

impl Run {
    const NONE: Self = Self {
        number: 0,
        start: Start {
            mode: 0,
            watchdog: 0,
            at: 0,
            length: 0,
            mask: 0,
            batch: 0,
        },
        planned: None,
        began: 0,
        samples: 0,
        drive: 0.0,
        law: None,
        from: 0,
        latest: 0,
        late_before: false,
    };
}

/// A device that holds `CAPACITY` values of a profile and `TRANSMIT` bytes of frames to be sent.
///
/// Call all methods from one context, or guard them: [`sample`](Self::sample) once each period,
/// [`receive`](Self::receive) when bytes have arrived, then [`poll`](Self::poll), whose output must be applied, then
/// [`transmit`](Self::transmit). Between a command that makes the output safe and the call that returns that output,
/// nothing is sent. Time is in microseconds and must not run backwards; if it does, it stands still here.
#[derive(Clone, Debug)]
pub struct Device<const CAPACITY: usize, const TRANSMIT: usize = 2048> {
    deframer: Deframer,
    core: Core<CAPACITY, TRANSMIT>,
}

impl<const CAPACITY: usize, const TRANSMIT: usize> Device<CAPACITY, TRANSMIT> {
    /// A device at boot.
    ///
    /// # Errors
    /// The first field of the identity that is outside its range.
    pub fn new(identity: Identity) -> Result<Self, Refused> {
        let mut device = Self::off();
        device.boot(identity)?;
        Ok(device)
    }

    /// A device before its boot, for a static variable: it can do nothing, and its limits are 0.
    ///
    /// Inlined, so that it is built in place: a constant to copy from would occupy flash once more, almost all zeros.
    #[inline(always)]
    pub const fn off() -> Self {
        Self {
            deframer: Deframer::new(),
            core: Core::off(),
        }
    }

    /// Boots in place; [`new`](Self::new) would need the device's size on the stack. The previous state is forgotten.
    ///
    /// # Errors
    /// As for [`new`](Self::new); then nothing is changed.
    pub fn boot(&mut self, identity: Identity) -> Result<(), Refused> {
        identity.check()?;
        *self = Self::off();
        self.core.boot(identity);
        Ok(())
    }

    /// Takes received bytes, in pieces of any length. Apply the output of [`poll`](Self::poll) afterwards.
    pub fn receive(&mut self, now: u64, bytes: &[u8]) {
        self.core.watch(now);
        let mut input = bytes;
        while let Some(frame) = self.deframer.next(&mut input) {
            match frame {
                Ok(frame) => self.core.frame(&frame),
                Err(_) => self.core.refused = self.core.refused.wrapping_add(1),
            }
        }
    }

    /// Takes the measurement of a control period and returns the command until the next one.
    ///
    /// `now` is the time of the sample. A sample that is missing or much too late ends a run, as its times would be
    /// wrong.
    pub fn sample(&mut self, now: u64, measurement: &Measurement<'_>) -> Output {
        self.core.sample(now, measurement);
        self.hand_out()
    }

    /// The command at any time between samples; checks the watchdog and whether samples are being taken.
    pub fn poll(&mut self, now: u64) -> Output {
        self.core.watch(now);
        self.core.beat();
        self.hand_out()
    }

    fn hand_out(&mut self) -> Output {
        self.core.owed = false;
        self.core.output
    }

    /// Moves bytes to be sent to `out`; returns how many.
    pub fn transmit(&mut self, out: &mut [u8]) -> usize {
        if self.core.owed {
            return 0;
        }
        self.core.transmit.take(out)
    }

    /// Ends the run in progress for a reason of the firmware. Apply the output of [`poll`](Self::poll) afterwards.
    pub fn trip(&mut self, now: u64, reason: Reason) {
        self.core.watch(now);
        self.core.trip(reason, 0.0);
    }

    /// The connection is closed: a partial frame is dropped, and time no longer depends on credit.
    pub fn disconnect(&mut self) {
        self.deframer = Deframer::new();
        self.core.credit = None;
    }

    /// The device's state.
    pub fn state(&self) -> State {
        self.core.state
    }

    /// The reason of its last trip.
    pub fn reason(&self) -> Reason {
        self.core.reason
    }

    /// The time up to which a host lets a device on credit advance; `None` if its time runs by itself.
    pub fn credit(&self) -> Option<u64> {
        self.core.credit
    }

    /// How often ARM was executed since boot: when this changes, a computed machine returns to its initial state before
    /// the next sample.
    pub fn armed_count(&self) -> u32 {
        self.core.armed
    }

    /// The device's description of itself.
    pub fn identity(&self) -> &Identity {
        &self.core.identity
    }
}

/// The state machine, without the framing of bytes.
#[derive(Clone, Debug)]
struct Core<const CAPACITY: usize, const TRANSMIT: usize> {
    identity: Identity,
    period: NonZeroU64,
    /// Period \[s\].
    ts: f32,
    transmit: Transmit<TRANSMIT>,
    session: Option<Session>,
    credit: Option<u64>,
    watchdog: Watchdog,
    limits: Option<Limits>,
    travel: Option<Travel>,
    guard: Guard,
    gains: Option<Gains>,
    profile: Profile<CAPACITY>,
    stream: Stream,
    run: Run,
    /// A stop that has not begun, of the run in progress or of the next one.
    asked: Option<Asked>,
    state: State,
    reason: Reason,
    output: Output,
    /// Whether a safe output has not been returned yet.
    owed: bool,
    /// The latest known time.
    now: u64,
    /// When the last sample was due: the grid of a run, independent of the samples' jitter.
    due: u64,
    last_beat: u64,
    good: u8,
    armed: u32,
    received: u32,
    refused: u32,
}

impl<const CAPACITY: usize, const TRANSMIT: usize> Core<CAPACITY, TRANSMIT> {
    #[inline(always)]
    const fn off() -> Self {
        Self {
            identity: Identity::NONE,
            period: NonZeroU64::MIN,
            ts: 1.0,
            transmit: Transmit::new(),
            session: None,
            credit: None,
            watchdog: Watchdog::new(1),
            limits: None,
            travel: None,
            guard: Guard::new(1, 1.0, 1.0),
            gains: None,
            profile: Profile::new(),
            stream: Stream::new(&[]),
            run: Run::NONE,
            asked: None,
            state: State::Boot,
            reason: Reason::None,
            output: Output::SAFE,
            owed: false,
            now: 0,
            due: 0,
            last_beat: 0,
            good: 0,
            armed: 0,
            received: 0,
            refused: 0,
        }
    }

    /// Boots from off, with an identity that has been checked.
    fn boot(&mut self, identity: Identity) {
        self.identity = identity;
        if !positions::HAS {
            self.identity.capabilities &= !capability::POSITIONS;
        }
        self.period = NonZeroU64::new(identity.period.into()).unwrap_or(NonZeroU64::MIN);
        self.ts = (f64::from(identity.period) / 1e6) as f32;
        self.transmit.boot(identity.tag());
        self.watchdog = Watchdog::new(identity.period);
        self.guard = Guard::new(identity.period, self.ts, identity.counts_per_rev);
        self.stream = Stream::new(identity.channels);
        self.event(Event::Boot, Reason::None, 0.0);
    }

    /// Advances time: checks the watchdog and whether samples still come.
    fn watch(&mut self, now: u64) {
        self.now = self.now.max(now);
        self.check_watchdog();
        let overdue = self.now.saturating_sub(self.due);
        if self.state == State::Running && overdue >= self.period.get().saturating_mul(2) {
            self.trip(Reason::Late, overdue as f32);
        }
    }

    fn check_watchdog(&mut self) {
        if !self.watchdog.is_out(self.now) {
            return;
        }
        match self.state {
            State::Running => self.trip(Reason::Watchdog, 0.0),
            State::Armed => self.stop(Reason::Watchdog),
            _ => {}
        }
    }

    /// Ends what is in progress; only CLEAR leads out of it.
    fn trip(&mut self, reason: Reason, value: f32) {
        match self.state {
            State::Boot => self.good = 0,
            State::Tripped => {}
            _ => {
                self.halt(State::Tripped);
                self.reason = reason;
                self.event(Event::Tripped, reason, value);
            }
        }
    }

    /// Ends what is in progress.
    fn stop(&mut self, reason: Reason) {
        self.halt(State::Idle);
        self.event(Event::Stopped, reason, 0.0);
    }

    /// The only way out of running and armed.
    fn halt(&mut self, state: State) {
        self.owed |= self.output.enabled;
        self.output = Output::SAFE;
        self.state = state;
        self.run.planned = None;
        self.asked = None;
        self.flush();
        self.profile.rewind();
    }

    /// Sends the batch in progress.
    fn flush(&mut self) {
        if self.stream.is_empty() {
            return;
        }
        let (time, mut body) = (self.stream.time(), Body::new());
        self.stream.flush(self.transmit.overflowed, &mut body);
        let bytes = body.bytes().unwrap_or(&[]);
        if self.transmit.send(Weight::Stream, 0xC0, time, bytes) {
            self.transmit.overflowed = false;
        }
    }

    fn event(&mut self, event: Event, reason: Reason, value: f32) {
        let mut body = Body::new();
        body.u8(event as u8).u8(self.state as u8).u8(reason as u8);
        body.u32(self.run.number).u32(self.run.samples).f32(value);
        self.send(Weight::Answer, 0xC1, &body);
    }

    /// Sends BEAT if it is due.
    fn beat(&mut self) {
        let due = self.now.saturating_sub(self.last_beat) >= BEAT;
        if self.state == State::Running || !due {
            return;
        }
        self.last_beat = self.now;
        let mut body = Body::new();
        body.u32(self.identity.boot_id).u8(self.state as u8);
        body.u8(self.reason as u8).f32(self.guard.speed());
        self.send(Weight::Stream, 0xC2, &body);
    }

    fn send(&mut self, weight: Weight, kind: u8, body: &Body) {
        let bytes = body.bytes().unwrap_or(&[]);
        self.transmit.send(weight, kind, self.now, bytes);
    }

    fn can(&self, bits: u32) -> bool {
        self.identity.can(bits)
    }

    /// The limits in force: the device's own, until others are set.
    fn bounds(&self) -> Limits {
        self.limits.unwrap_or(self.identity.ceilings)
    }

    /// Where the counter may be: the device's own, until others are set.
    fn travel(&self) -> Travel {
        self.travel.unwrap_or(self.identity.travel)
    }

    fn on_credit(&self) -> bool {
        self.can(capability::CREDIT)
    }
}

/// The device's state; values as in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Waits for ten good samples in a row.
    Boot = 0,
    /// Safe.
    Idle = 1,
    /// Safe, ready to start.
    Armed = 2,
    /// Commands the drive.
    Running = 3,
    /// Safe until cleared.
    Tripped = 4,
}

/// Why a run ended early; values as in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// It did not end early.
    None = 0,
    /// The host fell silent.
    Watchdog = 1,
    /// Too fast.
    Speed = 2,
    /// Too fast a change of speed.
    Acceleration = 3,
    /// Too much current.
    Current = 4,
    /// The profile ran dry before its end.
    Underrun = 5,
    /// A command was refused while running.
    BadCommand = 6,
    /// Another host said HELLO while running.
    HostChanged = 7,
    /// A measurement was not finite.
    Measurement = 8,
    /// A large command caused no motion.
    NoMotion = 9,
    /// The firmware's stop input.
    StopInput = 10,
    /// A control period was late, early or lost.
    Late = 11,
    /// The command of a loop swings between its limits.
    Swinging = 12,
    /// The counter, or the goal of a stop, is beyond its limits.
    Travel = 13,
}

/// An event that is sent in its own frame; values as in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Event {
    Boot = 1,
    Armed = 2,
    Started = 3,
    Finished = 4,
    Stopped = 5,
    Tripped = 6,
    Cleared = 7,
}

#[cfg(test)]
mod tests {
    mod hostile;
    mod laws;
    mod limits;
    mod playback;
    mod positions;
    mod rig;
    mod safety;
    mod words;
}
