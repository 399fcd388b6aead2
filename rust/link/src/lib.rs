//! The host's end of the link to a drive (docs/PROTOCOL.md), as parts without a port of their own.

pub mod anomalies;
#[cfg(test)]
mod bench;
pub mod bodies;
pub mod client;
pub mod host_loop;
mod ready;
pub mod receiver;
pub mod samples;
pub mod sequence;
pub mod server;
pub mod upload;

pub use anomalies::{Anomaly, Counters, Kind};
pub use client::Client;
pub use receiver::Receiver;
pub use samples::{Channel, Encoding};
pub use upload::Upload;
