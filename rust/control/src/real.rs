//! The number type of the controller: `f32` or `f64`.
