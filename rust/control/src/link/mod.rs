//! The link between a drive and its host (docs/PROTOCOL.md).
//!
//! To read: [`frame`] with [`cobs`] and [`crc`] (bytes), [`wire`] and `command` (fields of a body), [`identity`] (the
//! device's description of itself), then [`device`] with the parts it uses: `session` (the host), `guard` (the motor's
//! limits), `profile` (values to play), `stream` (data for the host).
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
mod command;
pub mod crc;
pub mod device;
pub mod frame;
mod guard;
pub mod identity;
mod positions;
mod profile;
mod session;
mod stream;
pub mod wire;

pub use device::{Device, Measurement, Output, Reason, State};
pub use frame::{Deframer, Frame, HEADER, Header, MAX_BODY, MAX_FRAME, MAX_WIRE, Rejected, encode};
pub use guard::{Alarm, Trip, Watch};
pub use identity::{Channel, Encoding, Identity, Limits, Source, Travel, capability};
pub use wire::{Body, Fields};
