//! The reference ramp.

use crate::gains::sample_time;
use crate::{Real, Refused};

/// A reference that moves by at most `rate` \[y/s\].
#[derive(Clone, Debug)]
pub struct Ramp<T> {
    /// Largest change in one sample \[y\].
    change: T,
    r: T,
    started: bool,
}

impl<T: Real> Ramp<T> {
    /// A ramp of at most `rate` \[y/s\] at sample time `ts` \[s\]; infinite passes its input through.
    ///
    /// # Errors
    /// A rate that is not above 0, a sample time that is not above 0.
    pub fn new(rate: T, ts: T) -> Result<Self, Refused> {
        sample_time(ts)?;
        let holds = rate > T::ZERO && rate * ts > T::ZERO;
        Refused::unless(holds, "r_rate", "a number above 0, or inf", rate.to_f64())?;
        Ok(Self {
            change: rate * ts,
            r: T::ZERO,
            started: false,
        })
    }

    /// Forgets where it was; the next sample begins at its start.
    pub fn reset(&mut self) {
        self.started = false;
    }

    /// Takes a reference, gives the one to control to; the first after a reset is counted from `start`.
    ///
    /// One that is not finite passes and leaves no trace.
    pub fn step(&mut self, r: T, start: T) -> T {
        let from = if self.started { self.r } else { start };
        let moved = r.limit(from - self.change, from + self.change);
        if !r.is_finite() {
            return r;
        }
        self.r = moved;
        self.started = true;
        moved
    }

    /// Largest change in one sample \[y\].
    pub(crate) fn change(&self) -> T {
        self.change
    }

    /// This ramp's rate with the memory of `other`.
    pub(crate) fn after(mut self, other: &Self) -> Self {
        self.r = other.r;
        self.started = other.started;
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    proptest! {
        #[test]
        fn moves_no_faster_than_its_rate_and_arrives(
            rate in 1.0..1e5, start in -10.0..10.0, r in prop::collection::vec(-1e3..1e3, 50),
        ) {
            let mut ramp = Ramp::new(rate, 1e-3).unwrap();
            let mut last: f64 = start;
            for &r in &r {
                let now = ramp.step(r, start);
                prop_assert!((now - last).abs() <= 1e-3 * rate + 1e-9);
                prop_assert!((now - r).abs() <= (last - r).abs());
                last = now;
            }
            let samples = (2e3 / (1e-3 * rate)) as usize + 2;
            let arrived = (0..samples).map(|_| ramp.step(5.0, start)).last();
            prop_assert_eq!(arrived, Some(5.0));
        }
    }

    #[test]
    fn begins_at_its_start_and_keeps_what_is_not_finite_out() {
        let mut ramp = Ramp::new(1000.0, 1e-3).unwrap();
        let out: Vec<f64> = [100.0, 100.0, f64::NAN, 100.0]
            .map(|r| ramp.step(r, 40.0))
            .to_vec();
        assert_eq!(out[..2], [41.0, 42.0]);
        assert!(out[2].is_nan());
        assert_eq!(out[3], 43.0);
        assert_eq!(ramp.step(f64::INFINITY, 0.0), f64::INFINITY);
        ramp.reset();
        assert_eq!(ramp.step(0.0, 7.0), 6.0);
    }

    #[test]
    fn passes_through_where_switched_off_and_refuses_nonsense() {
        let mut off = Ramp::new(f64::INFINITY, 1e-3).unwrap();
        assert_eq!(
            [3.0, -1e300, 2.0].map(|r| off.step(r, 9.0)),
            [3.0, -1e300, 2.0]
        );
        for rate in [0.0, -1.0, f64::NAN, 1e-323] {
            assert_eq!(Ramp::new(rate, 1e-3).unwrap_err().name, "r_rate");
        }
    }
}
