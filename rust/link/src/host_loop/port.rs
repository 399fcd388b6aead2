//! The thread that owns the port and the deadline.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::io::{Errno, read, write};
use rustix::time::{ClockId, clock_gettime};
use sewfast_core::Monitor;

use super::Outcome;
use super::tick::HostLoop;
use crate::ready::{Interest, wait};

/// The longest time between two checks for a stop request \[us\].
const LOOK: u64 = 20_000;
/// Most bytes kept for a port that takes none: a few commands, of which only the last counts.
const BACKLOG: usize = 256;
/// More than a terminal's input memory.
const CHUNK: usize = 8192;

/// Runs the loop on an open port until it is done; every failure of the port becomes an outcome.
///
/// Between deadlines the thread sleeps; it never spins. Deadlines are instants of the monotonic clock, so a late one
/// does not delay the next.
pub fn run(port: BorrowedFd<'_>, host_loop: &mut HostLoop, monitor: &Monitor) {
    let outcome = Port::new(port).and_then(|mut port| port.serve(host_loop, monitor));
    if let Err(lost) = outcome {
        host_loop.abandon(Outcome::PortLost(lost.to_string()));
    }
}

/// The host's monotonic clock \[us\], the same as Python's `time.monotonic`.
pub fn now() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    seconds * 1_000_000 + u64::try_from(time.tv_nsec).unwrap_or(0) / 1000
}

/// A port that never blocks, and the bytes it has not taken yet.
struct Port<'a> {
    port: BorrowedFd<'a>,
    flags: OFlags,
    unsent: Vec<u8>,
}

impl<'a> Port<'a> {
    fn new(port: BorrowedFd<'a>) -> Result<Self, Errno> {
        let flags = fcntl_getfl(port)?;
        fcntl_setfl(port, flags | OFlags::NONBLOCK)?;
        Ok(Self {
            port,
            flags,
            unsent: Vec::with_capacity(BACKLOG),
        })
    }

    fn serve(&mut self, host_loop: &mut HostLoop, monitor: &Monitor) -> Result<(), Errno> {
        punctual();
        let mut chunk = [0; CHUNK];
        let mut received = 0;
        let mut told = 0;
        while !host_loop.done() {
            if monitor.stopped() {
                host_loop.stop(Outcome::Interrupted);
            }
            let said = host_loop.tick(now(), chunk.get(..received).unwrap_or_default());
            if !self.send(said)? {
                host_loop.unsent();
            }
            let (over, all) = host_loop.progress();
            monitor.set_total(all as u64);
            monitor.advance((over - told) as u64);
            told = over;
            received = self.wait(host_loop.wake(), &mut chunk)?;
        }
        Ok(())
    }

    /// Sends the remaining bytes and `frame`; false if too many bytes remain to add it.
    fn send(&mut self, frame: &[u8]) -> Result<bool, Errno> {
        let fits = self.unsent.len() + frame.len() <= self.unsent.capacity();
        if fits {
            self.unsent.extend_from_slice(frame);
        }
        self.flush()?;
        Ok(fits)
    }

    fn flush(&mut self) -> Result<(), Errno> {
        while !self.unsent.is_empty() {
            match write(self.port, &self.unsent) {
                Ok(sent) => drop(self.unsent.drain(..sent)),
                Err(Errno::AGAIN) => return Ok(()),
                Err(Errno::INTR) => {}
                Err(lost) => return Err(lost),
            }
        }
        Ok(())
    }

    /// Sleeps until bytes come, but at most until `wake`; returns how many came.
    fn wait(&self, wake: u64, chunk: &mut [u8]) -> Result<usize, Errno> {
        let interest = Interest {
            read: true,
            write: !self.unsent.is_empty(),
        };
        let span = Duration::from_micros(wake.saturating_sub(now()).min(LOOK));
        let [found] = wait([(self.port, interest)], span)?;
        if found.read || found.gone {
            return self.read(chunk);
        }
        Ok(0)
    }

    /// A port that has vanished is readable, but has no bytes.
    fn read(&self, chunk: &mut [u8]) -> Result<usize, Errno> {
        match read(self.port, chunk) {
            Ok(0) => Err(Errno::IO),
            Ok(length) => Ok(length),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(lost) => Err(lost),
        }
    }
}

impl Drop for Port<'_> {
    fn drop(&mut self) {
        // A port that has vanished has no flags to restore.
        let _ = fcntl_setfl(self.port, self.flags);
    }
}

/// Asks the kernel not to coalesce this thread's timers with others, which costs up to 50 us.
#[cfg(target_os = "linux")]
fn punctual() {
    // Without it the loop is later, as its histogram shows.
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
}

#[cfg(not(target_os = "linux"))]
fn punctual() {}
