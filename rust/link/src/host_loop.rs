//! A controller on the host, for plants slow enough: one thread, absolute deadlines, its lateness on record.
//!
//! The device owns the millisecond in every other mode. Here the host decides each command and says it in a DRIVE heartbeat
//! (docs/PROTOCOL.md, mode 2), so that the jitter of its kernel and of the link is in the loop. What that jitter was is part
//! of the result; that it stays within a bound is promised by nobody.
//!
//! [`HostLoop::tick`] is the loop without port or clock; [`run`] is the thread around it.

mod age;
mod history;
mod listen;
mod memory;
mod outcome;
#[cfg(unix)]
mod port;
mod settings;
mod tick;
mod ticks;

pub use crate::bodies::Status;
pub use history::History;
pub use memory::Locked;
pub use outcome::Outcome;
#[cfg(unix)]
pub use port::run;
pub use settings::Settings;
pub use tick::HostLoop;
pub use ticks::{Tick, Ticks};

/// Room that is made for samples and ticks before the start, so that none is made during all but the longest runs.
const ROOM: usize = 4_000_000;

#[cfg(test)]
mod tests;
