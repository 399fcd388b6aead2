//! Identification, simulation and tuning of motor drives, without Python.
//!
//! A recording becomes a model ([`arx`], [`iv`], [`oe`], [`neural`]), a model and demands become a controller
//! ([`fopdt`], [`rules`], [`tune`]), and [`closed_loop`] runs that controller on a model or on the
//! [`machine`]. Times are in seconds; outputs and inputs carry the caller's units.

pub mod arx;
mod banded;
pub mod bounded;
pub mod causes;
pub mod changes;
pub mod closed_loop;
mod colour;
pub mod column;
pub mod data;
pub mod dead_time;
mod descent;
pub mod embedded;
pub mod error;
pub mod excitation;
pub mod explained;
pub mod faults;
pub mod feedback;
pub mod fopdt;
mod fourier;
mod gram;
pub mod greybox;
pub mod guard;
pub mod hammerstein;
pub mod innovations;
pub mod inverse;
pub mod iv;
pub mod lagged;
#[cfg(test)]
mod laws;
pub mod least_squares;
mod level;
pub mod linear;
pub mod linearised;
pub mod lm;
pub mod local_polynomial;
pub mod loop_transfer;
pub mod machine;
pub mod metrics;
pub mod model;
pub mod monitor;
pub mod moves;
pub mod neural;
pub mod neural_ss;
pub mod oe;
pub mod orders;
pub mod output_error;
pub mod position;
pub mod profile;
pub mod proposal;
pub mod random;
mod regression;
pub mod residuals;
pub mod rules;
pub mod sandwich;
pub mod search;
pub mod sensor;
pub mod shaft;
pub mod signals;
pub mod simd;
mod simplex;
pub mod speed;
pub mod stacking;
mod starts;
pub mod tune;

pub use data::Record;
pub use error::{Error, ErrorKind, Result};
pub use monitor::Monitor;
