//! The host's end of the link to a drive (docs/PROTOCOL.md), in parts without a port of their own.
//!
//! To read: [`bodies`] (messages), [`receiver`] with [`sequence`] and [`samples`] (received data, in order, as
//! columns), [`client`] (a session), [`upload`] (values sent ahead of a run), [`host_loop`] (a controller on the host).
//! [`server`] is the other end, the virtual sewing machine behind a port.

pub mod bodies;
pub mod client;
pub mod host_loop;
mod ready;
pub mod receiver;
pub mod samples;
pub mod sequence;
pub mod server;
pub mod upload;

pub use client::Client;
pub use receiver::{Anomaly, Counters, Kind, Receiver};
pub use samples::{Channel, Encoding};
pub use upload::Upload;

/// A device for tests of the host's end: two channels, a period of a millisecond.
#[cfg(test)]
mod bench {
    use sewfast_control::link::{Channel, Encoding, Identity, Limits, Source, Travel, capability};

    pub static CHANNELS: [Channel; 2] = [
        Channel {
            encoding: Encoding::Counts,
            steps_per_unit: 1,
            name: "counts",
            unit: "1",
            source: Source::Counts,
        },
        Channel {
            encoding: Encoding::Steps,
            steps_per_unit: 1000,
            name: "u",
            unit: "V",
            source: Source::Command,
        },
    ];

    pub fn identity() -> Identity {
        Identity {
            boot_id: 3,
            entropy: 0,
            name: "bench",
            firmware: "1",
            period: 1000,
            counts_per_rev: 1572.0,
            capabilities: capability::DRIVE,
            ceilings: Limits {
                volt: 20.0,
                speed: 5000.0,
                acceleration: f32::INFINITY,
                current: f32::INFINITY,
            },
            travel: Travel::ANY,
            channels: &CHANNELS,
        }
    }
}
