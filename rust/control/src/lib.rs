//! Control arithmetic that runs unchanged on a microcontroller, in simulation and against the virtual machine.
//!
//! No standard library, no allocation, no dependency.
#![no_std]

pub mod filter;
pub mod gains;
pub mod pid;
pub mod real;
