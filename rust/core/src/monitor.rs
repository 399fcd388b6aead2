//! What ends long work early: a stop request from a thread-safe watcher, or a cost that is too high.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Samples between two checks of a monitor in a loop with `products` per sample, a power of two: a few milliseconds.
pub(crate) fn look(products: usize) -> usize {
    let samples = (1 << 22) / products.max(1);
    1 << samples.clamp(16, 4096).ilog2()
}

/// Shared by a long computation (which reports and asks) and its watcher (which reads and requests a stop).
#[derive(Debug)]
pub struct Monitor {
    stop: AtomicBool,
    heard: AtomicBool,
    done: AtomicU64,
    total: AtomicU64,
    best: AtomicU64,
}

impl Default for Monitor {
    fn default() -> Self {
        Self {
            stop: AtomicBool::new(false),
            heard: AtomicBool::new(false),
            done: AtomicU64::new(0),
            total: AtomicU64::new(0),
            best: AtomicU64::new(f64::INFINITY.to_bits()),
        }
    }
}

impl Monitor {
    /// Asks the computation to return its best result so far.
    pub fn request_stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// True after a stop request; long loops ask at least every 10 ms.
    pub fn stopped(&self) -> bool {
        let stopped = self.stop.load(Ordering::Relaxed);
        if stopped {
            self.heard.store(true, Ordering::Relaxed);
        }
        stopped
    }

    /// True if the computation has seen a stop request: its result is then marked as interrupted.
    pub fn heard(&self) -> bool {
        self.heard.load(Ordering::Relaxed)
    }

    /// Announces how many steps the work has.
    pub fn set_total(&self, steps: u64) {
        self.total.store(steps, Ordering::Relaxed);
    }

    /// Reports `steps` more steps as done.
    pub fn advance(&self, steps: u64) {
        self.done.fetch_add(steps, Ordering::Relaxed);
    }

    /// Reports a cost; the lowest one is kept for display. A cost that is not a number is ignored.
    pub fn report_cost(&self, cost: f64) {
        let lower = |bits: u64| (cost < f64::from_bits(bits)).then_some(cost.to_bits());
        // An Err only means that the stored cost is lower.
        let _ = self
            .best
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, lower);
    }

    /// Steps done, steps in all, lowest cost reported.
    pub fn progress(&self) -> (u64, u64, f64) {
        (
            self.done.load(Ordering::Relaxed),
            self.total.load(Ordering::Relaxed),
            f64::from_bits(self.best.load(Ordering::Relaxed)),
        )
    }
}

/// The cost that a trial has to stay below.
///
/// `(before + sum)/(2 samples) + penalty` is the cost of a sum of squared errors, which has to stay below `limit`.
#[derive(Clone, Copy)]
pub(crate) struct Limit {
    pub before: f64,
    pub samples: f64,
    pub penalty: f64,
    pub limit: f64,
}

impl Limit {
    /// For a run without a limit.
    pub const NONE: Self = Self {
        before: 0.0,
        samples: 1.0,
        penalty: 0.0,
        limit: f64::INFINITY,
    };

    /// The cost for this sum of squares; it increases with the sum, even with rounding.
    pub fn cost(&self, sum: f64) -> f64 {
        0.5 * (self.before + sum) / self.samples + self.penalty
    }

    /// The limit that remains after a run with this sum.
    pub fn after(self, sum: f64) -> Self {
        Self {
            before: self.before + sum,
            ..self
        }
    }

    /// Whether a sum that only grows can no longer stay below the limit.
    pub fn is_reached(&self, sum: f64) -> bool {
        self.cost(sum) >= self.limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_lowest_cost_and_ignores_nan() {
        let monitor = Monitor::default();
        for cost in [3.0, f64::NAN, 1.0, 2.0] {
            monitor.report_cost(cost);
        }
        monitor.set_total(4);
        monitor.advance(3);
        assert_eq!(monitor.progress(), (3, 4, 1.0));
    }

    #[test]
    fn looks_more_often_where_a_sample_takes_long() {
        assert_eq!([0, 100, 2_000, 1 << 30].map(look), [4096, 4096, 2048, 16]);
    }

    #[test]
    fn stops_only_on_request() {
        let monitor = Monitor::default();
        assert!(!monitor.stopped());
        monitor.request_stop();
        assert!(!monitor.heard() && monitor.stopped() && monitor.heard());
    }
}
