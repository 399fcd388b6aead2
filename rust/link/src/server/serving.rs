//! The loop between port and drive: read, advance, write, wait.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::faults::{Fault, FaultLog, Faults};
use super::line::{Direction, Line};
use super::port::{Gate, Port};
use super::rig::{Clock, PERIOD, Rig};
use super::trace::{Happening, Trace};
use super::{Order, Settings, Shared, Statistics};
use crate::ready::Interest;

/// Longest time until a stop request is noticed.
const ATTENTION: Duration = Duration::from_millis(20);

/// Samples on credit between two checks of the port.
const BATCH: usize = 512;

/// Delay beyond which the clock is set back instead of catching up [us].
const HOPELESS: u64 = 1_000_000;

/// Bytes for the host kept outside the device: a serial port's own memory is small, so the device's memory should be
/// the one that overflows. On credit, time waits instead.
const WAITING_PACED: usize = 256;
const WAITING: usize = 4096;
const WAITING_ON_CREDIT: usize = 16_384;

/// A drive being served: everything that the loop owns.
pub struct Serving<'a> {
    shared: &'a Shared,
    port: Box<dyn Port>,
    rig: Rig,
    clock: Clock,
    inbound: Line,
    outbound: Line,
    log: FaultLog,
    trace: Trace,
    faults: Faults,
    events: Vec<Fault>,
    fast: bool,
    once: bool,
    /// When serving ends at the latest.
    ends: Option<Instant>,
    room: usize,
    connected: bool,
    /// The connection's gate, on a network.
    gate: Option<Gate>,
    /// A host has disconnected by itself, and none has come since.
    left: bool,
    stalled: Option<Instant>,
    unplugged: Option<Instant>,
    statistics: Statistics,
    /// Delay of this turn, from the first sample that it finds due [us].
    behind: u64,
}

impl<'a> Serving<'a> {
    /// A drive that boots now behind `port`.
    pub fn new(
        settings: &Settings,
        shared: &'a Shared,
        port: Box<dyn Port>,
        rig: Rig,
        log: FaultLog,
        trace: Trace,
    ) -> Self {
        let now = Instant::now();
        let line = |direction| {
            Line::new(
                direction,
                settings.faults,
                settings.seed,
                settings.baud,
                now,
            )
        };
        Self {
            shared,
            port,
            rig,
            clock: Clock::new(now),
            inbound: line(Direction::ToDevice),
            outbound: line(Direction::ToHost),
            log,
            trace,
            faults: settings.faults,
            events: Vec::new(),
            fast: settings.fast,
            once: settings.once,
            ends: settings.duration.map(|duration| now + duration),
            room: match (settings.fast, settings.baud) {
                (true, _) => WAITING_ON_CREDIT,
                (false, Some(_)) => WAITING_PACED,
                (false, None) => WAITING,
            },
            connected: false,
            gate: None,
            left: false,
            stalled: None,
            unplugged: None,
            statistics: Statistics::default(),
            behind: 0,
        }
    }

    /// Serves until a stop is requested.
    pub fn run(mut self) {
        while !self.finished() {
            self.orders();
            self.restore();
            self.presence();
            self.receive();
            self.advance();
            self.transmit();
            self.happen();
            self.report();
            self.wait();
        }
        self.report();
    }

    fn finished(&self) -> bool {
        self.shared.stop.load(Ordering::Relaxed)
            || self.ends.is_some_and(|ends| Instant::now() >= ends)
            // leave the watchdog the time to end what was left running
            || self.once && self.left && !self.rig.output().enabled
    }

    /// Carries out the requests of the server's owner.
    fn orders(&mut self) {
        for order in self.shared.orders() {
            match order {
                Order::Fault(fault @ (Fault::Stall | Fault::Reset | Fault::Unplug), seconds) => {
                    self.log.record(fault, Direction::ToHost, &[]);
                    self.strike(fault, seconds);
                }
                Order::Fault(fault, _) => self.outbound.force(fault),
            }
        }
    }

    /// Ends a stall; plugs the port in again.
    fn restore(&mut self) {
        let now = Instant::now();
        self.stalled = self.stalled.filter(|&until| until > now);
        if self.unplugged.is_some_and(|until| until <= now) {
            // the name may be taken for a moment: then try again
            let plugged = self.port.plug().is_ok();
            self.unplugged = (!plugged).then_some(now + Duration::from_millis(50));
            if plugged {
                self.note(Happening::Plugged);
                self.shared.renamed(self.port.name());
            }
        }
    }

    fn presence(&mut self) {
        let connected = self.unplugged.is_none() && self.port.connected();
        if connected == self.connected {
            return;
        }
        self.connected = connected;
        self.left = !connected && self.unplugged.is_none();
        self.inbound.clear();
        self.outbound.clear();
        self.gate = (connected && self.port.is_network()).then(Gate::new);
        if connected {
            // whatever the last host did not read is dropped here
            self.outbound
                .push(&[0], Instant::now(), &mut self.log, &mut self.events);
            self.note(Happening::Connected);
        } else {
            self.rig.disconnect();
            self.note(Happening::Gone);
        }
    }

    fn flows(&self) -> bool {
        self.connected && self.stalled.is_none()
    }

    /// Moves bytes from the port through the line to the device, frame by frame.
    fn receive(&mut self) {
        let now = Instant::now();
        if self.flows() && self.inbound.backlog() < WAITING {
            let mut buffer = [0; 4096];
            let room = self.inbound.allowance(now).min(buffer.len());
            let length = if room > 0 {
                self.port.read(&mut buffer[..room])
            } else {
                0
            };
            self.inbound.spend(length);
            let tag = self.rig.boot_id() as u16;
            let gate = self.gate.as_mut();
            if gate.is_some_and(|gate| !gate.admits(&buffer[..length], tag)) {
                self.port.hang_up();
                return self.presence();
            }
            self.inbound
                .push(&buffer[..length], now, &mut self.log, &mut self.events);
        }
        self.inbound.settle(now, &mut self.log);
        self.keep_time();
        if self.inbound.has_arrived() && self.flows() {
            let time = self.clock.read(Instant::now()).min(self.rig.next());
            self.deliver(time, usize::MAX);
        }
    }

    /// Passes the device at most `frames` of those that have arrived.
    fn deliver(&mut self, time: u64, frames: usize) {
        let boot_id = self.rig.boot_id();
        let mut length = 0;
        for frame in each_frame(self.inbound.arrived()).take(frames) {
            self.trace
                .observe(frame, boot_id, time, self.behind, Instant::now());
            self.rig.receive(time, frame);
            let output = self.rig.output();
            self.trace
                .output(output.enabled, time, &self.clock, self.rig.state());
            length += frame.len();
        }
        self.inbound.consume(length);
    }

    /// How far the host lets time advance; `None` if it runs by itself.
    fn credit(&self) -> Option<u64> {
        let granted = (self.fast && self.connected).then(|| self.rig.credit());
        granted.flatten()
    }

    /// Starts or stops the clock, and takes the samples that are due.
    fn keep_time(&mut self) {
        let now = Instant::now();
        self.log.time = self.clock.read(now);
        self.behind = 0;
        if self.credit().is_some() {
            self.clock.stand(self.log.time.min(self.rig.next()));
            return;
        }
        self.clock.run(now);
        let time = self.clock.read(now);
        self.behind = time.saturating_sub(self.rig.next());
        self.trace.late(self.behind);
        if time > self.rig.next() + HOPELESS {
            self.clock.set(self.rig.next(), now);
            self.statistics.set_back += 1;
        }
        self.catch_up(self.clock.read(now));
    }

    /// Takes the samples due at `time`.
    ///
    /// Heartbeats that waited while this thread was late arrived at unknown times in between. They are spread evenly
    /// over that time, so that a busy computer alone does not trip a watchdog.
    fn catch_up(&mut self, time: u64) {
        let due = (time + u64::from(PERIOD)).saturating_sub(self.rig.next()) / u64::from(PERIOD);
        let waiting = match due > 1 && self.flows() {
            true => heartbeats(self.inbound.arrived()),
            false => 0,
        };
        let mut given = 0;
        for k in 1..=due {
            let by_now = ((waiting as u64 * k + due / 2) / due) as usize;
            self.deliver(self.rig.next(), by_now - given);
            given = by_now;
            let late = time - self.rig.next();
            self.statistics.late += u64::from(late >= u64::from(PERIOD));
            self.statistics.latest_us = self.statistics.latest_us.max(late);
            self.sample();
        }
    }

    fn sample(&mut self) {
        let due = self.rig.next();
        self.rig.sample();
        self.statistics.samples += 1;
        self.trace.output(
            self.rig.output().enabled,
            due,
            &self.clock,
            self.rig.state(),
        );
        self.collect();
    }

    /// Spends the host's credit.
    fn advance(&mut self) {
        let Some(until) = self.credit() else { return };
        let mut left = BATCH;
        while self.rig.next() <= until && left > 0 && self.outbound.backlog() < self.room {
            self.clock.stand(self.rig.next());
            self.sample();
            left -= 1;
        }
        if self.rig.next() > until {
            let time = self.clock.read(Instant::now()).max(until);
            self.clock.stand(time);
        }
    }

    /// Moves bytes from the device into the line; without a host they are dropped.
    fn collect(&mut self) {
        let mut buffer = [0; 1024];
        while self.outbound.backlog() < self.room {
            let length = self.rig.transmit(&mut buffer);
            if length == 0 {
                return;
            }
            if self.connected {
                let (now, bytes) = (Instant::now(), &buffer[..length]);
                self.outbound
                    .push(bytes, now, &mut self.log, &mut self.events);
            }
        }
    }

    /// Moves bytes from the line to the port.
    fn transmit(&mut self) {
        self.collect();
        let now = Instant::now();
        self.outbound.settle(now, &mut self.log);
        if !self.flows() || !self.outbound.has_arrived() {
            return;
        }
        let allowance = self.outbound.allowance(now);
        let bytes = self.outbound.arrived();
        let bytes = &bytes[..bytes.len().min(allowance)];
        let written = if bytes.is_empty() {
            0
        } else {
            self.port.write(bytes)
        };
        self.outbound.spend(written);
        self.outbound.consume(written);
        self.statistics.bytes_to_host += written as u64;
    }

    /// Carries out the lines' faults of link and device.
    fn happen(&mut self) {
        for fault in std::mem::take(&mut self.events) {
            self.strike(fault, None);
        }
    }

    fn strike(&mut self, fault: Fault, lasts: Option<Duration>) {
        let until = Instant::now() + lasts.unwrap_or(self.faults.duration(fault));
        match fault {
            Fault::Stall => {
                self.stalled = Some(until);
                self.note(Happening::Stalled);
            }
            Fault::Unplug => {
                self.port.unplug();
                self.unplugged = Some(until);
                self.note(Happening::Unplugged);
            }
            Fault::Reset => self.reset(),
            _ => {}
        }
    }

    fn reset(&mut self) {
        let time = self.clock.read(Instant::now());
        self.trace
            .output(false, time, &self.clock, self.rig.state());
        self.trace.rebooted();
        self.rig.reboot();
        self.clock.set(0, Instant::now());
        self.note(Happening::Reset);
    }

    fn note(&mut self, happening: Happening) {
        let time = self.clock.read(Instant::now());
        self.trace
            .note(happening, time, &self.clock, self.rig.state());
    }

    fn report(&mut self) {
        self.statistics.refused = self.port.refused();
        self.shared
            .report(&self.statistics, &self.log, &mut self.trace);
    }

    fn wait(&mut self) {
        let now = Instant::now();
        let credit = self.credit();
        let flows = self.flows();
        let busy = credit.is_some_and(|until| self.rig.next() <= until)
            && self.outbound.backlog() < self.room;
        let write = flows && self.outbound.has_arrived() && self.outbound.allowance(now) > 0;
        let read = flows && self.inbound.backlog() < WAITING && self.inbound.allowance(now) > 0;
        let paced = |line: &Line, open: bool| line.wakes_in(now, flows && !open);
        let due = [
            self.clock.until(self.rig.next(), now),
            paced(&self.inbound, read),
            paced(&self.outbound, write || !self.outbound.has_arrived()),
            self.ends.map(|ends| ends.saturating_duration_since(now)),
        ];
        let until = |moment: Option<Instant>| moment.map(|m| m.saturating_duration_since(now));
        let moments = [until(self.stalled), until(self.unplugged)];
        let timeout = due.into_iter().chain(moments).flatten().min();
        let timeout = timeout.unwrap_or(ATTENTION).min(ATTENTION);
        let timeout = if busy { Duration::ZERO } else { timeout };
        self.port.wait(Interest { read, write }, timeout);
    }
}

fn each_frame(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    bytes.split_inclusive(|&byte| byte == 0)
}

/// Number of heartbeats before the first command. COBS leaves a frame's first bytes unchanged if they contain no zero,
/// so the kind is visible.
fn heartbeats(bytes: &[u8]) -> usize {
    let is_heartbeat = |frame: &&[u8]| matches!(frame, [2..=255, 0x20..=0x22, ..]);
    each_frame(bytes).take_while(is_heartbeat).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use sewfast_control::link::{Header, MAX_WIRE, encode};

    #[test]
    fn sees_heartbeats_up_to_the_first_command() {
        let wire = |kinds: &[u8]| {
            let frame = |&kind: &u8| {
                let header = Header {
                    kind,
                    ..Header::default()
                };
                let mut wire = [0; MAX_WIRE];
                let length = encode(&header, &[0, 1], &mut wire).unwrap();
                wire[..length].to_vec()
            };
            kinds.iter().flat_map(frame).collect::<Vec<_>>()
        };
        assert_eq!(heartbeats(&wire(&[0x20, 0x21, 0x22, 0x06, 0x20])), 3);
        assert_eq!(heartbeats(&wire(&[0x0A, 0x20])), 0);
        assert_eq!(heartbeats(&wire(&[0, 0x20])), 0);
        assert_eq!(heartbeats(&[]), 0);
    }
}
