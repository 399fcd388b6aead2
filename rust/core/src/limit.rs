//! The cost that a trial has to stay below.

/// `(before + sum)/(2 samples) + penalty` is the cost of a sum of squared errors, which has to stay below `limit`.
#[derive(Clone, Copy)]
pub(crate) struct Limit {
    pub before: f64,
    pub samples: f64,
    pub penalty: f64,
    pub limit: f64,
}

impl Limit {
    /// For a run that nothing is asked of.
    pub const NONE: Self = Self {
        before: 0.0,
        samples: 1.0,
        penalty: 0.0,
        limit: f64::INFINITY,
    };

    /// The cost with this sum of squares; it grows with the sum, rounding included.
    pub fn cost(&self, sum: f64) -> f64 {
        0.5 * (self.before + sum) / self.samples + self.penalty
    }

    /// What is left after a run with this sum.
    pub fn after(self, sum: f64) -> Self {
        Self {
            before: self.before + sum,
            ..self
        }
    }

    /// Whether a sum that only grows can no longer stay below it.
    pub fn is_reached(&self, sum: f64) -> bool {
        self.cost(sum) >= self.limit
    }
}
