//! Tuning of controller gains by simulated closed loops.
