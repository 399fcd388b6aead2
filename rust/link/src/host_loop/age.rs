//! How old a sample is on the host's clock, by the quickest arrival of the last seconds.

/// How long an arrival counts \[us\]; clocks that differ by 100 ppm part by .2 ms in two of them.
const WINDOW: u64 = 1_000_000;

/// The least difference between a sample's arrival on the host's clock and its time on the device's.
///
/// It is the difference of the clocks and the link's least delay together: an age taken from it leaves out that delay,
/// which the round trip of a command bounds. The window forgets, so that clocks may drift.
#[derive(Clone, Copy, Debug, Default)]
pub struct Age {
    began: u64,
    before: Option<i64>,
    lately: Option<i64>,
}

impl Age {
    /// A sample of device time `sampled` has come at `now`.
    pub fn arrived(&mut self, now: u64, sampled: i64) {
        if self.lately.is_none() || now.saturating_sub(self.began) >= WINDOW {
            self.before = self.lately.take();
            self.began = now;
        }
        let difference = now.cast_signed().wrapping_sub(sampled);
        self.lately = Some(
            self.lately
                .map_or(difference, |least| least.min(difference)),
        );
    }

    /// Age at `now` of a sample of device time `sampled` \[us\]; none before the first arrival.
    pub fn of(&self, now: u64, sampled: i64) -> Option<u64> {
        let least = self.lately?.min(self.before.unwrap_or(i64::MAX));
        let difference = now.cast_signed().wrapping_sub(sampled);
        Some(u64::try_from(difference.saturating_sub(least)).unwrap_or(0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_from_the_quickest_arrival() {
        let mut age = Age::default();
        assert_eq!(age.of(5, 0), None);
        age.arrived(1_000_300, 7_000);
        age.arrived(1_001_100, 8_000);
        assert_eq!(age.of(1_003_100, 8_000), Some(2_000));
        assert_eq!(age.of(1_003_300, 7_000), Some(3_200));
    }

    #[test]
    fn follows_a_clock_that_drifts() {
        let mut age = Age::default();
        for k in 0..20_i32 {
            // The device's clock loses 1 ms every second.
            age.arrived(500_000 * k.unsigned_abs() as u64, 499_500 * i64::from(k));
        }
        let now = 19 * 500_000;
        assert!(age.of(now, 19 * 499_500).unwrap() <= 2_000);
    }
}
