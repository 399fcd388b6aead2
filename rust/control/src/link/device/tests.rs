//! The device under its laws.

#[allow(dead_code)]
mod rig;
mod safety;
