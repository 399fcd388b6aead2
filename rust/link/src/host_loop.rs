//! A controller on the host, for plants slow enough: one thread, absolute deadlines, its delays recorded.
//!
//! In every other mode the device owns the millisecond. Here the host decides each command and sends it in a DRIVE
//! heartbeat (docs/PROTOCOL.md, mode 2), so the jitter of its kernel and of the link is in the loop. The result
//! includes that jitter; nothing bounds it.
//!
//! This file has the settings and results. [`HostLoop::tick`] (`tick`) is the loop without port or clock; [`run`]
//! (`port`) is the thread around it; `history` keeps the samples.

mod history;
#[cfg(unix)]
mod port;
mod tick;

use sewfast_core::Error;

pub use crate::bodies::Status;
pub use history::History;
pub use tick::HostLoop;

#[cfg(unix)]
pub use port::run;

/// Memory allocated for samples and ticks before the start, so that only the longest runs allocate later.
const ROOM: usize = 4_000_000;

/// The longest watchdog time of the protocol \[us\].
const LONGEST_WATCHDOG: u32 = 10_000_000;
/// The shortest watchdog time of the protocol \[us\].
const SHORTEST_WATCHDOG: u32 = 1_000;

/// The settings of the loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The device's sample time \[us\].
    pub device_period: u32,
    /// Samples of the device in one period of the loop.
    pub ratio: u32,
    /// How long the device may continue without a command, and the host without a sample \[us\].
    pub watchdog: u32,
    /// Samples in a frame.
    pub batch: u8,
    /// A bit for each channel to stream.
    pub mask: u16,
    /// Counts a second at a speed of one unit.
    pub counts_per_unit: f64,
}

impl Settings {
    /// The loop's sample time \[us\].
    pub fn period(&self) -> u64 {
        u64::from(self.device_period) * u64::from(self.ratio)
    }

    /// Refuses settings with which no loop can run: `channels` is the number of streamed channels, `ticks` the
    /// reference's length, `ts` the controller's sample time \[s\].
    ///
    /// # Errors
    /// `ErrorKind::Setting` for the first number outside its range.
    pub fn check(&self, channels: usize, ticks: usize, ts: f64) -> sewfast_core::Result<()> {
        let period = self.period() as f64 * 1e-6;
        require(
            self.device_period > 0,
            "a device with a sample time above 0",
            self.device_period,
        )?;
        require(
            self.ratio > 0,
            "a loop of at least one sample of the device",
            self.ratio,
        )?;
        require(
            (ts - period).abs() <= 1e-6 * period,
            &format!("a controller for the loop's sample time of {period} s"),
            ts,
        )?;
        require(ticks > 0, "a reference of at least one sample", ticks)?;
        let samples = (ticks as u64 + 2).saturating_mul(u64::from(self.ratio));
        require(
            samples <= u64::from(u32::MAX),
            "a run of at most 2^32 - 1 samples of the device",
            samples,
        )?;
        require(
            (SHORTEST_WATCHDOG..=LONGEST_WATCHDOG).contains(&self.watchdog),
            "a watchdog time of 1 ms to 10 s, in us",
            self.watchdog,
        )?;
        require(
            u64::from(self.watchdog) > self.period(),
            &format!(
                "a watchdog time longer than the loop's period of {} us",
                self.period()
            ),
            self.watchdog,
        )?;
        require(self.batch > 0, "at least one sample in a frame", self.batch)?;
        require(
            channels == self.mask.count_ones() as usize,
            &format!("a channel for each bit of the mask {:#x}", self.mask),
            channels,
        )?;
        require(
            self.mask & 1 == 1,
            "counts (bit 0) in the mask of channels",
            self.mask,
        )?;
        require(
            self.counts_per_unit > 0.0 && self.counts_per_unit.is_finite(),
            "counts per unit of speed above 0",
            self.counts_per_unit,
        )
    }
}

fn require(
    holds: bool,
    expected: &str,
    received: impl std::fmt::Display,
) -> sewfast_core::Result<()> {
    if holds {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected {expected}, got {received}"
    )))
}

/// How a loop can end; all samples up to then are kept in each case.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The whole reference was run.
    Completed,
    /// A stop was requested.
    Interrupted,
    /// The device tripped, for this reason of the protocol.
    Tripped {
        /// The protocol's number of the reason.
        reason: u8,
        /// The value that exceeded the limit; NaN if the device's event did not arrive.
        value: f32,
    },
    /// The device ended the run before the reference did.
    Ended,
    /// The device refused a command.
    Refused {
        /// Kind of the command.
        command: u8,
        /// The protocol's number of the result.
        result: u8,
        /// The detail of the result.
        detail: u32,
    },
    /// A command of this kind was repeated and never answered.
    Unanswered(u8),
    /// No sample came within the watchdog time.
    Silent,
    /// The device has reset.
    Reset,
    /// The port failed, with the system's message.
    PortLost(String),
}

impl Outcome {
    /// A name for files and bindings.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::Interrupted => "interrupted",
            Self::Tripped { .. } => "tripped",
            Self::Ended => "ended",
            Self::Refused { .. } => "refused",
            Self::Unanswered(_) => "unanswered",
            Self::Silent => "silent",
            Self::Reset => "reset",
            Self::PortLost(_) => "port_lost",
        }
    }
}

/// One tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tick {
    /// Its number in the reference.
    pub number: usize,
    /// Delay after its deadline at which the loop woke \[us\].
    pub late: u64,
    /// Age of the newest sample \[us\]; `None` before the first.
    pub age: Option<u64>,
    /// True if a sample has arrived since the last tick.
    pub fresh: bool,
    /// Measured speed; NaN if there was none.
    pub y: f64,
    /// The speed after the feedback filter.
    pub feedback: f64,
    /// The command after the controller's limits.
    pub u: f64,
}

/// All ticks of a run.
#[derive(Clone, Debug, Default)]
pub struct Ticks {
    /// The ticks that were run, in order.
    pub run: Vec<Tick>,
    /// The number skipped, because the loop woke more than a period late.
    pub missed: u64,
    /// Commands that were not sent because the port took no more bytes.
    pub unsent: u64,
}

impl Ticks {
    /// Empty, with memory for `ticks`.
    pub fn with_capacity(ticks: usize) -> Self {
        Self {
            run: Vec::with_capacity(ticks),
            ..Self::default()
        }
    }

    /// Adds a tick.
    pub fn push(&mut self, tick: Tick) {
        self.run.push(tick);
    }
}

/// Keeps all memory of the process resident until it is dropped.
#[derive(Debug)]
pub struct Locked(());

impl Locked {
    /// Locks all present and future memory.
    ///
    /// # Errors
    /// The system's message if it refuses: without privilege `RLIMIT_MEMLOCK` limits the process.
    pub fn new() -> Result<Self, String> {
        lock().map(|()| Self(()))
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        unlock();
    }
}

#[cfg(target_os = "linux")]
fn lock() -> Result<(), String> {
    use rustix::mm::{MlockAllFlags, mlockall};
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).map_err(|refused| refused.to_string())
}

#[cfg(target_os = "linux")]
fn unlock() {
    // Memory that stays locked is harmless.
    let _ = rustix::mm::munlockall();
}

#[cfg(not(target_os = "linux"))]
fn lock() -> Result<(), String> {
    Err("not offered on this system".to_owned())
}

#[cfg(not(target_os = "linux"))]
fn unlock() {}

#[cfg(test)]
mod tests;
