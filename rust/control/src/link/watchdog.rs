//! How long the device may go on without its host.

/// Runs out by time, and by samples in case the clock stands still.
#[derive(Clone, Debug)]
pub(super) struct Watchdog {
    period: u64,
    fed: u64,
    time: u64,
    samples: u64,
}

impl Watchdog {
    /// One that has run out.
    pub(super) const fn new(period: u32) -> Self {
        Self {
            period: period as u64,
            fed: 0,
            time: 0,
            samples: 0,
        }
    }

    /// Starts anew.
    pub(super) fn feed(&mut self, now: u64, time: u32) {
        self.fed = now;
        self.time = time.into();
        self.samples = 0;
    }

    /// A sample was taken.
    pub(super) fn count(&mut self) {
        self.samples = self.samples.saturating_add(1);
    }

    /// Whether it has run out.
    ///
    /// Two samples more than fit the time may come by their jitter; with more than that the clock is wrong.
    pub(super) fn is_out(&self, now: u64) -> bool {
        let longest = self.time.saturating_add(2 * self.period);
        now.saturating_sub(self.fed) >= self.time
            || self.samples.saturating_mul(self.period) > longest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_out_by_time_or_by_samples() {
        let mut watchdog = Watchdog::new(1000);
        assert!(watchdog.is_out(0));
        watchdog.feed(7, 50_000);
        assert!(!watchdog.is_out(50_006) && watchdog.is_out(50_007));
        watchdog.feed(u64::MAX, 50_000);
        let lasts = (1..).find(|_| {
            watchdog.count();
            watchdog.is_out(u64::MAX)
        });
        assert_eq!(lasts, Some(53));
    }
}
