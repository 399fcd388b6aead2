//! The alpha-beta observer: speed from a position that is never formed.
//!
//! The tracker of a position `p(k) = p(k-1) + Ts y(k)` with position and speed as its state (Benedict and Bordner 1962),
//!
//! ```text
//! r(k) = p(k) - x(k-1) - Ts v(k-1)        innovation
//! x(k) = x(k-1) + Ts v(k-1) + a r(k)
//! v(k) = v(k-1) + b/Ts r(k)
//! ```
//!
//! leaves `p(k) - x(k) = (1 - a) r(k)` behind, so that the innovation follows from itself and from the measured speed:
//! `r(k) = (1 - a) r(k-1) + Ts (y(k) - v(k-1))`. With `s = r/Ts` neither a position nor the sample time is left:
//!
//! ```text
//! s(k) = (1 - a) s(k-1) + y(k) - v(k-1)
//! v(k) = v(k-1) + b s(k)
//! ```
//!
//! Critically damped: both poles at `theta = exp(-Ts/time)`, `1 - a = theta^2`, `b = (1 - theta)^2`.

use crate::gains::sample_time;
use crate::real::one_minus_exp;
use crate::{Real, Refused};

/// Speed out of a measured speed, without error where the speed is constant.
#[derive(Clone, Debug)]
pub struct Observer<T> {
    /// `1 - a`.
    keep: T,
    /// `b`.
    gain: T,
    /// `v`.
    speed: T,
    /// `s`.
    innovation: T,
    on: bool,
    started: bool,
}

impl<T: Real> Observer<T> {
    /// An observer of time constant `time` \[s\] at sample time `ts` \[s\]; 0 passes its input through.
    ///
    /// # Errors
    /// A time that is negative or not finite, a sample time that is not above 0.
    pub fn new(time: T, ts: T) -> Result<Self, Refused> {
        sample_time(ts)?;
        let holds = time >= T::ZERO && time.is_finite();
        let expected = "a finite time of 0 s or more";
        Refused::unless(holds, "observer_time", expected, time.to_f64())?;
        let step = one_minus_exp(ts / time);
        let pole = T::ONE - step;
        Ok(Self {
            keep: pole * pole,
            gain: step * step,
            speed: T::ZERO,
            innovation: T::ZERO,
            on: time > T::ZERO,
            started: false,
        })
    }

    /// Forgets everything; the next sample sets the speed.
    pub fn reset(&mut self) {
        self.started = false;
    }

    /// Takes a measured speed, gives the observed one.
    pub fn step(&mut self, y: T) -> T {
        let (from, left) = if self.started {
            (self.speed, self.innovation)
        } else {
            (y, T::ZERO)
        };
        let innovation = self.keep * left + (y - from);
        let speed = from + self.gain * innovation;
        (self.speed, self.innovation) = if self.on {
            (speed, innovation)
        } else {
            (y, T::ZERO)
        };
        self.started = true;
        self.speed
    }

    /// `1 - a` and `b`; `None` where it passes its input through.
    pub(crate) fn weights(&self) -> Option<(T, T)> {
        self.on.then_some((self.keep, self.gain))
    }

    /// This observer's settings with the memory of `other`, so that its output goes on where that one's was.
    pub(crate) fn after(mut self, other: &Self) -> Self {
        self.speed = other.speed;
        self.innovation = if self.on { other.innovation } else { T::ZERO };
        self.started = other.started;
        self
    }
}

#[cfg(test)]
mod tests {
    //! The observer against the position tracker of the textbook, and its drift.

    use super::*;
    use proptest::prelude::*;

    const TS: f64 = 1e-3;

    /// The tracker as it stands in the books, with the position that grows.
    struct Tracker {
        alpha: f64,
        beta: f64,
        measured: f64,
        position: f64,
        speed: f64,
    }

    impl Tracker {
        /// In step with a constant speed.
        fn new(time: f64, speed: f64) -> Self {
            let theta = (-TS / time).exp();
            Self {
                alpha: 1.0 - theta * theta,
                beta: (1.0 - theta) * (1.0 - theta),
                measured: 0.0,
                position: 0.0,
                speed,
            }
        }

        fn step(&mut self, y: f64) -> f64 {
            self.measured += TS * y;
            let predicted = self.position + TS * self.speed;
            let innovation = self.measured - predicted;
            self.position = predicted + self.alpha * innovation;
            self.speed += self.beta / TS * innovation;
            self.speed
        }
    }

    proptest! {
        #[test]
        fn equals_the_position_tracker(
            time in prop_oneof![1e-4..1e-2, 1e-2..1.0],
            y in prop::collection::vec(-1.0..1.0, 300),
        ) {
            let (mut observer, mut tracker) = (Observer::new(time, TS).unwrap(), Tracker::new(time, y[0]));
            for (k, &y) in y.iter().enumerate() {
                let (v, exact) = (observer.step(y), tracker.step(y));
                prop_assert!((v - exact).abs() < 1e-12, "{k}: {v} {exact}");
            }
        }
    }

    #[test]
    fn follows_a_constant_speed_without_error_and_a_step_without_overshoot() {
        let mut observer = Observer::new(0.005, TS).unwrap();
        observer.step(0.0);
        let mut last = 0.0;
        for _ in 0..1000 {
            let v = observer.step(1000.0);
            assert!(v >= last - 1e-9);
            last = v;
        }
        assert!((last - 1000.0).abs() < 1e-9, "{last}");
    }

    #[test]
    fn a_position_ramp_leaves_no_error_where_the_position_does() {
        // 250,000 counts in, the position of the textbook form has lost the speed's last digits; this one has none.
        let mut observer = Observer::<f32>::new(0.01, 1e-3).unwrap();
        for _ in 0..1000 {
            observer.step(12_345.0);
        }
        assert!((observer.step(12_345.0) - 12_345.0).abs() < 0.01);
    }

    #[test]
    fn single_precision_does_not_drift_over_a_million_samples() {
        let (mut single, mut double) = (
            Observer::<f32>::new(0.004, 1e-3).unwrap(),
            Observer::<f64>::new(0.004, 1e-3).unwrap(),
        );
        let (mut worst, mut late) = (0.0_f64, 0.0_f64);
        for k in 0..1_000_000_u32 {
            let y = 2000.0 + 600.0 * (f64::from(k) / 5000.0).sin() + f64::from(k * 7919 % 40);
            let y = y as f32;
            let error = (f64::from(single.step(y)) - double.step(f64::from(y))).abs();
            worst = worst.max(error);
            if k >= 990_000 {
                late = late.max(error);
            }
        }
        // A few roundings of 2,600 in single precision (2.4e-4 each), filtered: never more, and at the end no more than at first.
        assert!(worst < 0.01, "{worst}");
        assert!(late < 0.01, "{late}");
    }

    #[test]
    fn passes_through_where_switched_off_and_refuses_nonsense() {
        let mut off = Observer::new(0.0, TS).unwrap();
        assert_eq!([3.0, -1.0, 2.0].map(|y| off.step(y)), [3.0, -1.0, 2.0]);
        for time in [-1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(Observer::new(time, TS).unwrap_err().name, "observer_time");
        }
        assert_eq!(Observer::new(1.0, 0.0).unwrap_err().name, "Ts");
    }

    #[test]
    fn starts_at_its_first_sample() {
        let mut observer = Observer::new(0.01, TS).unwrap();
        assert_eq!(observer.step(700.0), 700.0);
        assert_eq!(observer.step(700.0), 700.0);
        observer.reset();
        assert_eq!(observer.step(-3.0), -3.0);
    }
}
