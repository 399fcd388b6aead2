//! Speed from encoder counts: difference, Savitzky-Golay, Kalman/RTS smoother.
