//! The device's eye on the motor: speed and acceleration from counts, limits, motion.

use super::device::Reason;
use super::identity::Limits;

/// Samples between the counts of which a speed is the difference.
const WINDOW: usize = 8;
/// Samples between the speeds of which an acceleration is the difference.
const APART: usize = 16;
/// A power of two above both together.
const HISTORY: usize = 32;
/// ARM needs this long a standstill \[us\].
const STANDSTILL: u64 = 100_000;
/// A large command may stay without motion for this long \[us\].
const PATIENCE: u64 = 250_000;

/// Why a run must end, with the value that passed its limit.
pub(super) type Trip = (Reason, f32);

/// The last counts, what follows from them.
#[derive(Clone, Debug)]
pub(super) struct Guard {
    counts: [i32; HISTORY],
    newest: usize,
    started: bool,
    period: u64,
    /// RPM of one count in the window, `60/(8 Ts counts_per_rev)`.
    rpm: f32,
    /// RPM/s of one RPM between the speeds, `1/(16 Ts)`.
    rate: f32,
    /// Samples since the last count.
    still: u32,
    /// Samples in a row with a large command and without a count.
    stuck: u32,
}

impl Guard {
    pub(super) const fn new(period: u32, ts: f32, counts_per_rev: f32) -> Self {
        Self {
            counts: [0; HISTORY],
            newest: 0,
            started: false,
            period: period as u64,
            rpm: 60.0 / (WINDOW as f32 * ts * counts_per_rev),
            rate: 1.0 / (APART as f32 * ts),
            still: 0,
            stuck: 0,
        }
    }

    /// The next counts are the first ones: those before belong to another motion.
    pub(super) fn forget(&mut self) {
        self.started = false;
    }

    /// Takes the counts of a sample; a counter may wrap.
    pub(super) fn take(&mut self, counts: i32) {
        if !self.started {
            self.counts = [counts; HISTORY];
            self.started = true;
        }
        let moved = counts != self.before(0);
        self.newest = self.newest.wrapping_add(1) % HISTORY;
        if let Some(slot) = self.counts.get_mut(self.newest) {
            *slot = counts;
        }
        self.still = if moved {
            0
        } else {
            self.still.saturating_add(1)
        };
    }

    /// The counts `samples` ago.
    fn before(&self, samples: usize) -> i32 {
        let at = self.newest.wrapping_sub(samples) % HISTORY;
        self.counts.get(at).copied().unwrap_or(0)
    }

    /// The newest counts.
    pub(super) fn counts(&self) -> i32 {
        self.before(0)
    }

    /// Counts since the sample before.
    pub(super) fn change(&self) -> i32 {
        self.before(0).wrapping_sub(self.before(1))
    }

    /// Counts in the window that ended `samples` ago.
    fn window(&self, samples: usize) -> i32 {
        let start = self.before(samples.wrapping_add(WINDOW));
        self.before(samples).wrapping_sub(start)
    }

    /// Mean speed of the last 8 samples \[RPM\].
    pub(super) fn speed(&self) -> f32 {
        self.window(0) as f32 * self.rpm
    }

    /// Difference of two speeds 16 samples apart \[RPM/s\]; exact in counts, where speeds would cancel.
    pub(super) fn acceleration(&self) -> f32 {
        let change = i64::from(self.window(0)).wrapping_sub(self.window(APART).into());
        change as f32 * self.rpm * self.rate
    }

    /// No count for long enough to arm.
    pub(super) fn at_rest(&self) -> bool {
        u64::from(self.still).saturating_mul(self.period) >= STANDSTILL
    }

    /// # Errors
    /// The limit that is passed; a current of NaN is none.
    pub(super) fn check(&self, limits: &Limits, current: f32) -> Result<(), Trip> {
        let watched = [
            (Reason::Speed, self.speed(), limits.speed),
            (
                Reason::Acceleration,
                self.acceleration(),
                limits.acceleration,
            ),
            (Reason::Current, current, limits.current),
        ];
        for (reason, value, limit) in watched {
            if value.abs() > limit {
                return Err((reason, value));
            }
        }
        Ok(())
    }

    /// The run begins: patience starts anew.
    pub(super) fn begin(&mut self) {
        self.stuck = 0;
    }

    /// # Errors
    /// The command `u`, where the motor has long ignored it: a lost encoder lets a controller push ever harder.
    pub(super) fn expect_motion(&mut self, limits: &Limits, u: f32) -> Result<(), Trip> {
        let large = u.abs() >= 0.5 * limits.volt;
        self.stuck = if large && self.still > 0 {
            self.stuck.saturating_add(1)
        } else {
            0
        };
        if u64::from(self.stuck).saturating_mul(self.period) > PATIENCE {
            return Err((Reason::NoMotion, u));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const FREE: Limits = Limits {
        volt: 20.0,
        speed: f32::INFINITY,
        acceleration: f32::INFINITY,
        current: f32::INFINITY,
    };

    fn guard() -> Guard {
        Guard::new(1000, 1e-3, 1500.0)
    }

    #[test]
    fn speed_and_acceleration_are_their_definitions() {
        let mut guard = guard();
        for k in 0..40 {
            guard.take(k * k);
        }
        let per_count = 60.0 / (8.0 * 1e-3 * 1500.0);
        let window = |k: i32| (k * k - (k - 8) * (k - 8)) as f32;
        assert_eq!(guard.speed(), window(39) * per_count);
        let expected = (window(39) - window(23)) * per_count / 16e-3;
        assert!((guard.acceleration() - expected).abs() < 1e-4 * expected);
    }

    #[test]
    fn trips_within_8_and_24_samples_of_the_excess() {
        let speed = Limits {
            speed: 1000.0,
            ..FREE
        };
        let mut watched = guard();
        watched.take(0);
        // 1040 RPM are 26 counts a sample
        let trip = (1..).find(|k| {
            watched.take(26 * k);
            watched.check(&speed, f32::NAN).is_err()
        });
        assert!(trip.unwrap() <= 8, "{trip:?}");
        let acceleration = Limits {
            acceleration: 10_000.0,
            ..FREE
        };
        let mut watched = guard();
        watched.take(0);
        let trip = (1..).find(|k: &i32| {
            // 12,000 RPM/s are .3 counts/sample^2
            watched.take((0.15 * f64::from(k * k)) as i32);
            watched.check(&acceleration, f32::NAN).is_err()
        });
        assert!(trip.unwrap() <= 24, "{trip:?}");
    }

    #[test]
    fn the_first_counts_are_no_motion_and_a_wrap_is_none() {
        let mut guard = guard();
        guard.take(i32::MAX);
        assert_eq!((guard.speed(), guard.acceleration()), (0.0, 0.0));
        guard.take(i32::MIN);
        assert_eq!(guard.change(), 1);
        assert!((guard.speed() - 5.0).abs() < 1e-5);
        guard.forget();
        guard.take(-77);
        assert_eq!((guard.change(), guard.counts()), (0, -77));
    }

    #[test]
    fn current_counts_where_there_is_one() {
        let mut guard = guard();
        guard.take(0);
        let limits = Limits {
            current: 5.0,
            ..FREE
        };
        assert_eq!(guard.check(&limits, -6.0), Err((Reason::Current, -6.0)));
        assert_eq!(guard.check(&limits, 5.0), Ok(()));
        assert_eq!(guard.check(&limits, f32::NAN), Ok(()));
    }

    #[test]
    fn rests_after_100_ms_and_loses_patience_after_250() {
        let mut guard = guard();
        guard.take(0);
        let rest = (1..).find(|_| {
            guard.take(1);
            guard.at_rest()
        });
        assert_eq!(rest, Some(101));
        guard.begin();
        let stuck = (0..).find(|_| {
            guard.take(1);
            guard.expect_motion(&FREE, -10.0).is_err()
        });
        assert_eq!(stuck, Some(250));
        guard.take(2);
        assert_eq!(guard.expect_motion(&FREE, 10.0), Ok(()));
        for _ in 0..1000 {
            guard.take(2);
            assert_eq!(guard.expect_motion(&FREE, 9.9), Ok(()));
        }
    }

    proptest! {
        #[test]
        fn any_counts_give_numbers(counts in prop::collection::vec(any::<i32>(), 1..60)) {
            let mut guard = guard();
            for count in counts {
                guard.take(count);
                prop_assert!(guard.speed().is_finite() && guard.acceleration().is_finite());
            }
        }
    }
}
