//! Every sample that came during a run, and the speed that its counts say.

use crate::samples::Columns;

/// Samples in the order in which they came; a gap shows in their times.
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

    /// Drops what was taken before `start`, and what a run of `samples` cannot have.
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

    /// Counts a second over `span` \[us\] up to the newest sample; NaN where too few samples came.
    ///
    /// Where the sample `span` before the newest is lost, the next older one within another span stands in. Before
    /// `start`, when the drive was armed, the motor stood.
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
}
