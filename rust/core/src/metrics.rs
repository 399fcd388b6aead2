//! Errors and fits of a model; rise time and overshoot of a response.
