//! The device's clock: runs with the real time, or stands still while the host grants time by credit.

use std::time::{Duration, Instant};

/// Microseconds since the device's boot.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    time: u64,
    /// When it showed `time`; `None` while it stands still.
    since: Option<Instant>,
}

impl Clock {
    /// Zero now, running.
    pub fn new(now: Instant) -> Self {
        Self {
            time: 0,
            since: Some(now),
        }
    }

    /// What it shows.
    pub fn read(&self, now: Instant) -> u64 {
        let passed = self
            .since
            .map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
        self.time + passed.as_micros() as u64
    }

    /// Stands still at `time`.
    pub fn stand(&mut self, time: u64) {
        *self = Self { time, since: None };
    }

    /// Runs on from what it shows.
    pub fn run(&mut self, now: Instant) {
        self.since.get_or_insert(now);
    }

    /// Shows `time` now and runs on from there.
    pub fn set(&mut self, time: u64, now: Instant) {
        *self = Self {
            time,
            since: Some(now),
        };
    }

    /// How long until it shows `time`; `None` while it stands still.
    pub fn until(&self, time: u64, now: Instant) -> Option<Duration> {
        let due = self.since? + Duration::from_micros(time.saturating_sub(self.time));
        Some(due.saturating_duration_since(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_stands_and_runs_on() {
        let start = Instant::now();
        let after = |ms| start + Duration::from_millis(ms);
        let mut clock = Clock::new(start);
        assert_eq!(clock.read(after(5)), 5000);
        assert_eq!(clock.until(7000, after(5)), Some(Duration::from_millis(2)));
        clock.stand(6000);
        assert_eq!(
            (clock.read(after(9)), clock.until(7000, after(9))),
            (6000, None)
        );
        clock.run(after(10));
        clock.run(after(11));
        assert_eq!(clock.read(after(12)), 8000);
    }
}
