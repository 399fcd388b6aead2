//! Feedback filters: moving average, first order lag.
