//! The thread-safe seam between long work and whoever watches it: progress out, a stop request in.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Samples between two looks at a monitor in a loop with `products` per sample, a power of two: a few milliseconds.
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

    /// True once a stop has been requested; long loops ask at least every 10 ms.
    pub fn stopped(&self) -> bool {
        let stopped = self.stop.load(Ordering::Relaxed);
        if stopped {
            self.heard.store(true, Ordering::Relaxed);
        }
        stopped
    }

    /// True once the computation has learned of a stop request: its result is then marked as interrupted.
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
        // An Err only says that the kept cost is the lower one.
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
