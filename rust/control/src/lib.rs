//! Control arithmetic that runs unchanged on a microcontroller, in simulation and against the virtual machine; and the
//! frames by which such a drive talks to its host.
//!
//! No standard library, no allocation, no dependency.
//!
//! ```
//! use sewfast_control::{Controller, Design, Settings, Standard};
//!
//! let gains = Standard { kp: 0.02, ti: 0.25, td: 0.004 };
//! let settings = Settings { alpha: 0.4, beta: 0.2, u_min: -20.0, u_max: 20.0, ..Settings::new(gains, 1e-3) };
//! let mut controller = Controller::new(Design { filter_samples: 8, ..Design::new(settings) })?;
//! let u = controller.step(100.0, 0.0);
//! let expected: f64 = 0.02 * 60.0 + 0.02 * 100.0 * 1e-3 / 0.25;
//! assert!((u - expected).abs() < 1e-12);
//! # Ok::<(), sewfast_control::Refused>(())
//! ```
#![no_std]

#[cfg(test)]
extern crate std;

pub mod controller;
pub mod design;
pub mod filter;
pub mod gains;
pub mod link;
pub mod model;
pub mod observer;
pub mod pid;
pub mod ramp;
pub mod real;
pub mod refused;
pub mod schedule;

pub use controller::{Controller, Numbers};
pub use design::Design;
pub use filter::{CAPACITY, Feedback};
pub use gains::{Parallel, PerSample, Standard};
pub use observer::Observer;
pub use pid::{Pid, Settings, Terms};
pub use ramp::Ramp;
pub use real::Real;
pub use refused::Refused;
pub use schedule::{POINTS, Point, Row, Schedule};
