//! Gains of the two-degree-of-freedom PID in their three forms, with exact conversions.
