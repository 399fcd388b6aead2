//! A controller and a plant in closed loop, with encoder, feedback filter and limits inside the loop.

/// What a controller can be closed around: one input, one output, stepped sample by sample.
pub trait Plant {
    /// Back to rest; position back to zero.
    fn reset(&mut self);
    /// The true output at this instant, in its unit.
    fn output(&self) -> f64;
    /// The integral of the output over time [unit s]: what an encoder sees.
    fn position(&self) -> f64;
    /// Holds `u` for one sample time.
    fn advance(&mut self, u: f64);
}
