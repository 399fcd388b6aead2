//! A controller on the host, for plants slow enough: one thread, absolute deadlines, its lateness on record.
//!
//! The device owns the millisecond in every other mode. Here the host decides each command and says it in a DRIVE heartbeat
//! (docs/PROTOCOL.md, mode 2), so that the jitter of its kernel and of the link is in the loop. What that jitter was is part
//! of the result; that it stays within a bound is promised by nobody.
//!
//! Here is what goes in and comes out. [`HostLoop::tick`] (`tick`) is the loop without port or clock; [`run`] (`port`) is the
//! thread around it; `history` holds the samples that came.

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

/// Room that is made for samples and ticks before the start, so that none is made during all but the longest runs.
const ROOM: usize = 4_000_000;

/// The longest watchdog time of the protocol \[us\].
const LONGEST_WATCHDOG: u32 = 10_000_000;
/// The shortest watchdog time of the protocol \[us\].
const SHORTEST_WATCHDOG: u32 = 1_000;

/// Numbers of the loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The device's sample time \[us\].
    pub device_period: u32,
    /// Samples of the device in one period of the loop.
    pub ratio: u32,
    /// For how long the device may go on without a command, and the host without a sample \[us\].
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

    /// Refuses what no loop can run with: `channels` is how many are streamed, `ticks` the reference's
    /// length, `ts` the controller's sample time \[s\].
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

/// The ends that a loop knows; the samples up to there are kept in every one.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The whole reference was run.
    Completed,
    /// A stop was asked for.
    Interrupted,
    /// The device tripped, for this reason of the protocol; what passed the limit, where the device's event came through.
    Tripped {
        /// The protocol's number of the reason.
        reason: u8,
        /// What passed the limit; NaN where that is not known.
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
        /// What the result says more.
        detail: u32,
    },
    /// A command of this kind was repeated and never answered.
    Unanswered(u8),
    /// No sample came within the watchdog time.
    Silent,
    /// The device has reset.
    Reset,
    /// The port failed, in the system's words.
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
    /// How long after its deadline the loop awoke \[us\].
    pub late: u64,
    /// Age of the newest sample \[us\]; none before the first.
    pub age: Option<u64>,
    /// True where a sample has come since the tick before.
    pub fresh: bool,
    /// Measured speed; NaN where there was none.
    pub y: f64,
    /// The speed after the feedback filter.
    pub feedback: f64,
    /// The command after the controller's limits.
    pub u: f64,
}

/// All ticks of a run.
#[derive(Clone, Debug, Default)]
pub struct Ticks {
    /// Those that were run, in order.
    pub run: Vec<Tick>,
    /// Those that were skipped, as the loop awoke more than a period late.
    pub missed: u64,
    /// Commands that did not leave, as the port took no more bytes.
    pub unsent: u64,
}

impl Ticks {
    /// Nothing yet, with room for `ticks`.
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
    /// Locks what there is and what is to come.
    ///
    /// # Errors
    /// The system's words where it refuses: without privilege `RLIMIT_MEMLOCK` bounds the process.
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
    // Memory that stays locked does no harm.
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
