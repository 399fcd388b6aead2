//! What was decided at each tick, and how well its time was kept.

/// One tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tick {
    /// Its number in the reference.
    pub number: usize,
    /// How long after its deadline the loop awoke \[us\].
    pub late: u64,
    /// Age of the newest sample \[us\]; none before the first.
    pub age: Option<u64>,
    /// True where a sample has come since the tick before.
    pub fresh: bool,
    /// Measured speed; NaN where there was none.
    pub y: f64,
    /// The speed after the feedback filter.
    pub feedback: f64,
    /// The command after the controller's limits.
    pub u: f64,
}

/// All ticks of a run.
#[derive(Clone, Debug, Default)]
pub struct Ticks {
    /// Those that were run, in order.
    pub run: Vec<Tick>,
    /// Those that were skipped, as the loop awoke more than a period late.
    pub missed: u64,
    /// Commands that did not leave, as the port took no more bytes.
    pub unsent: u64,
}

impl Ticks {
    /// Nothing yet, with room for `ticks`.
    pub fn with_capacity(ticks: usize) -> Self {
        Self {
            run: Vec::with_capacity(ticks),
            ..Self::default()
        }
    }

    /// Adds a tick.
    pub fn push(&mut self, tick: Tick) {
        self.run.push(tick);
    }
}
