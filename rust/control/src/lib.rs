#![doc = include_str!("../README.md")]
#![no_std]

#[cfg(test)]
extern crate std;

pub mod biquad;
pub mod controller;
pub mod feedforward;
pub mod filter;
pub mod gains;
pub mod link;
pub mod model;
pub mod pid;
pub mod pid_controller;
pub mod position;
pub mod real;
mod ring;
pub mod schedule;
pub mod tracker;

pub use biquad::{BIQUADS, Biquad, Cascade};
pub use controller::*;
pub use feedforward::{AHEAD, Feedforward, LEVELS, Level, TAPS};
pub use filter::{CAPACITY, Feedback, Observer, Ramp};
pub use gains::{Parallel, PerSample, Standard};
pub use pid::{Pid, Settings, Terms};
pub use pid_controller::{Correction, Design, Numbers, PidController};
pub use position::{FARTHEST, PositionDesign, PositionLoop, RATES, Rate, Rates, SMOOTHED, Turning};
pub use real::Real;
pub use schedule::{POINTS, Point, Row, Schedule};
pub use tracker::{Listening, TRACKED, Tracker};
