//! The device under its laws.

mod hostile;
mod laws;
mod limits;
mod playback;
mod rig;
mod safety;
mod words;
