//! The virtual sewing machine: a physical model of drive, crank and load.
