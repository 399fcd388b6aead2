//! A token bucket: as many bytes a second as a serial line of some rate carries.

use std::time::{Duration, Instant};

/// Bits on the line for one byte: start, eight, stop.
const BITS_PER_BYTE: f64 = 10.0;

/// Bytes that may pass now; over any time `T` at most `rate T + burst`.
#[derive(Clone, Debug)]
pub struct Bucket {
    /// Bytes a second.
    rate: f64,
    burst: f64,
    level: f64,
    filled: Instant,
}

impl Bucket {
    /// For `baud` bits a second. The burst is what passes in 2 ms, and at least the 16 bytes of a common transmitter's memory.
    pub fn new(baud: u32, now: Instant) -> Self {
        let rate = f64::from(baud) / BITS_PER_BYTE;
        Self {
            rate,
            burst: (rate * 2e-3).max(16.0),
            level: 0.0,
            filled: now,
        }
    }

    /// How many bytes may pass.
    pub fn allowance(&mut self, now: Instant) -> usize {
        let passed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.filled = now;
        self.level = (self.level + passed * self.rate).min(self.burst);
        self.level as usize
    }

    /// So many bytes have passed.
    pub fn spend(&mut self, bytes: usize) {
        self.level -= bytes as f64;
    }

    /// When about half a burst may pass again.
    pub fn refilled_in(&self) -> Duration {
        let missing = (0.5 * self.burst - self.level).max(1.0);
        Duration::from_secs_f64(missing / self.rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passes_no_more_than_its_rate_and_a_burst() {
        let start = Instant::now();
        let mut bucket = Bucket::new(115_200, start);
        let mut passed = 0;
        for step in 0..10_000u64 {
            let now = start + Duration::from_micros(137 * step);
            let bytes = bucket.allowance(now);
            bucket.spend(bytes);
            passed += bytes;
            let limit = 11_520.0 * (137e-6 * step as f64) + 24.0;
            assert!(passed as f64 <= limit, "{passed} > {limit}");
        }
        assert!(passed as f64 >= 0.99 * 11_520.0 * 1.37);
    }

    #[test]
    fn keeps_a_burst_at_most_however_long_it_rests() {
        let start = Instant::now();
        let mut bucket = Bucket::new(9600, start);
        assert_eq!(bucket.allowance(start + Duration::from_secs(100)), 16);
    }
}
