//! The two-degree-of-freedom PID controller, one sample at a time.
