//! Every sample received during a run: the speed from its counts, and its age on the host's clock.

use crate::samples::Columns;

/// Samples in order of arrival; a gap shows in their times.
#[derive(Clone, Debug, Default)]
pub struct History {
    /// Device times \[us\] and a column for each channel of the mask, counts first.
    pub columns: Columns,
}

impl History {
    /// An empty history with room for `samples` of `channels`.
    pub fn with_capacity(samples: usize, channels: usize) -> Self {
        let columns = (0..channels).map(|_| Vec::with_capacity(samples));
        Self {
            columns: (Vec::with_capacity(samples), columns.collect()),
        }
    }

    /// Device times of the samples \[us\].
    pub fn times(&self) -> &[i64] {
        &self.columns.0
    }

    /// Counts of the samples, without the counter's wrap.
    pub fn counts(&self) -> &[f64] {
        self.columns.1.first().map_or(&[], Vec::as_slice)
    }

    /// Device time of the newest sample \[us\].
    pub fn newest(&self) -> Option<i64> {
        self.times().last().copied()
    }

    /// Drops samples from before `start`, and those beyond the run's `samples`.
    pub fn keep(&mut self, start: i64, samples: usize) {
        let before = self
            .times()
            .iter()
            .take_while(|&&time| time < start)
            .count();
        let (times, columns) = &mut self.columns;
        times.drain(..before);
        times.truncate(samples);
        for column in columns {
            column.drain(..before);
            column.truncate(samples);
        }
    }

    /// Counts a second over `span` \[us\] up to the newest sample; NaN if too few samples arrived.
    ///
    /// If the sample `span` before the newest is lost, the next older one within another span replaces it. Before
    /// `start`, when the drive was armed, the motor stood still.
    pub fn rate(&self, span: i64, start: i64) -> f64 {
        let (Some(newest), Some(&counts)) = (self.newest(), self.counts().last()) else {
            return f64::NAN;
        };
        let wanted = newest.saturating_sub(span);
        let before = self
            .times()
            .iter()
            .rposition(|&time| time <= wanted.max(start));
        let then = before.and_then(|k| Some((*self.times().get(k)?, *self.counts().get(k)?)));
        let Some((at, then)) = then else {
            return f64::NAN;
        };
        let stood = wanted < start && at == start;
        let elapsed = if stood {
            span
        } else {
            newest.saturating_sub(at)
        };
        if elapsed <= 0 || elapsed > span.saturating_mul(2) {
            return f64::NAN;
        }
        (counts - then) / (elapsed as f64 * 1e-6)
    }
}

/// How long an arrival counts \[us\]; in two of them, clocks that differ by 100 ppm drift apart by .2 ms.
const WINDOW: u64 = 1_000_000;

/// The least difference between a sample's arrival on the host's clock and its time on the device's.
///
/// It is the difference of the clocks plus the link's least delay: an age computed from it omits that delay, which is
/// at most a command's round trip. Old arrivals are forgotten, so the clocks may drift.
#[derive(Clone, Copy, Debug, Default)]
pub struct Age {
    began: u64,
    before: Option<i64>,
    lately: Option<i64>,
}

impl Age {
    /// A sample of device time `sampled` has arrived at `now`.
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

    /// Age at `now` of a sample of device time `sampled` \[us\]; `None` before the first arrival.
    pub fn of(&self, now: u64, sampled: i64) -> Option<u64> {
        let least = self.lately?.min(self.before.unwrap_or(i64::MAX));
        let difference = now.cast_signed().wrapping_sub(sampled);
        Some(u64::try_from(difference.saturating_sub(least)).unwrap_or(0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn history(samples: &[(i64, f64)]) -> History {
        let (times, counts) = samples.iter().copied().unzip();
        History {
            columns: (times, vec![counts]),
        }
    }

    #[test]
    fn takes_the_rate_over_one_span() {
        let history = history(&[(0, 0.0), (1000, 1.0), (2000, 5.0), (3000, 10.0)]);
        assert_eq!(history.rate(2000, 0), 4500.0);
    }

    #[test]
    fn knows_that_the_motor_stood_before_the_start() {
        assert_eq!(
            history(&[(7000, 3.0), (8000, 5.0)]).rate(2000, 7000),
            1000.0
        );
        let lost = history(&[(8000, 5.0)]).rate(2000, 7000);
        assert!(lost.is_nan(), "the first sample is lost");
    }

    #[test]
    fn reaches_back_over_a_gap_but_not_too_far() {
        let samples = [(1000, 1.0), (4000, 7.0), (9000, 8.0)];
        assert_eq!(history(&samples[..2]).rate(2000, 0), 2000.0);
        assert!(history(&samples).rate(2000, 0).is_nan());
        assert!(History::default().rate(2000, 0).is_nan());
    }

    #[test]
    fn keeps_what_belongs_to_the_run() {
        let mut history = history(&[(0, 0.0), (1000, 1.0), (2000, 2.0), (3000, 3.0)]);
        history.keep(1000, 2);
        assert_eq!(
            (history.times(), history.counts()),
            (&[1000, 2000][..], &[1.0, 2.0][..])
        );
    }

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
