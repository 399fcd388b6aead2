//! The link between a drive and its host: frames and their fields (docs/PROTOCOL.md).
//!
//! ```
//! use sewfast_control::link::{Deframer, Header, MAX_WIRE, encode};
//!
//! let header = Header { kind: 0x0b, tag: 7, sequence: 1, time: 1_000 };
//! let mut wire = [0; MAX_WIRE];
//! let length = encode(&header, b"hello", &mut wire).unwrap_or(0);
//!
//! let mut deframer = Deframer::new();
//! let mut input = &wire[..length];
//! while let Some(frame) = deframer.next(&mut input) {
//!     assert!(frame.is_ok_and(|frame| frame.header == header && frame.body == b"hello"));
//! }
//! ```

pub mod cobs;
pub mod crc;
pub mod frame;
pub mod wire;

#[cfg(test)]
mod dice;

pub use frame::{Deframer, Frame, HEADER, Header, MAX_BODY, MAX_FRAME, MAX_WIRE, Rejected, encode};
pub use wire::{Body, Fields};
