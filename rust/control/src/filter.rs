//! Filters of the feedback (moving average, first-order lag, alpha-beta observer, and their chain) and of the reference (a ramp).

use crate::gains::sample_time;
use crate::real::one_minus_exp;
use crate::{Real, Refused};

/// The longest moving average, in samples.
pub const CAPACITY: usize = 64;

fn mean<T: Real>(memory: &[T]) -> T {
    let sum = memory.iter().fold(T::ZERO, |sum, &x| sum + x);
    sum / T::from_count(memory.len())
}

/// Mean of the last `n` samples: a delay of `(n - 1)/2` samples, and an encoder step `n` times smaller.
#[derive(Clone, Debug)]
pub struct MovingAverage<T> {
    samples: [T; CAPACITY],
    length: usize,
    next: usize,
    started: bool,
}

impl<T: Real> MovingAverage<T> {
    /// An average of `length` samples; 1 passes its input through.
    ///
    /// # Errors
    /// A length of 0 or above [`CAPACITY`].
    pub fn new(length: usize) -> Result<Self, Refused> {
        let holds = (1..=CAPACITY).contains(&length);
        Refused::unless(holds, "filter_samples", "1 to 64 samples", length as f64)?;
        Ok(Self {
            samples: [T::ZERO; CAPACITY],
            length,
            next: 0,
            started: false,
        })
    }

    /// Forgets everything; the next sample fills the memory.
    pub fn reset(&mut self) {
        self.started = false;
        // Back to the first place: the order of summation determines the last bits of the result.
        self.next = 0;
    }

    /// Takes a sample and returns the average.
    ///
    /// The sum is formed anew each time, because a running sum would drift.
    pub fn step(&mut self, x: T) -> T {
        // get instead of an index: firmware must not contain a panic
        let memory = self.samples.get_mut(..self.length).unwrap_or_default();
        if !self.started {
            memory.fill(x);
            self.started = true;
        }
        if let Some(oldest) = memory.get_mut(self.next) {
            *oldest = x;
        }
        let next = self.next + 1;
        self.next = if next < self.length { next } else { 0 };
        mean(memory)
    }

    /// The last sample; `None` before the first one.
    fn newest(&self) -> Option<T> {
        let last = self.next.checked_sub(1).unwrap_or(self.length - 1);
        self.samples.get(last).copied().filter(|_| self.started)
    }

    fn mean(&self) -> T {
        mean(self.samples.get(..self.length).unwrap_or_default())
    }

    /// This average's length with the memory of `other`: all of it or, if the lengths differ, its mean.
    fn after(mut self, other: &Self) -> Self {
        if self.length == other.length {
            return other.clone();
        }
        self.samples = [other.mean(); CAPACITY];
        self.started = other.started;
        self
    }
}

/// `y(k) = y(k-1) + Ts/(Ts + time) (x(k) - y(k-1))`: a first-order lag by backward difference.
#[derive(Clone, Debug)]
pub struct Lag<T> {
    weight: T,
    y: T,
    started: bool,
}

impl<T: Real> Lag<T> {
    /// A lag with time constant `time` \[s\] at sample time `ts` \[s\]; 0 passes its input through.
    ///
    /// # Errors
    /// A time that is negative or not finite, a sample time that is not above 0.
    pub fn new(time: T, ts: T) -> Result<Self, Refused> {
        sample_time(ts)?;
        let holds = time >= T::ZERO && time.is_finite();
        let expected = "a finite time of 0 s or more";
        Refused::unless(holds, "filter_time", expected, time.to_f64())?;
        Ok(Self {
            weight: ts / (ts + time),
            y: T::ZERO,
            started: false,
        })
    }

    /// Forgets everything; the next sample sets the output.
    pub fn reset(&mut self) {
        self.started = false;
    }

    /// Takes a sample and returns the lagged value.
    pub fn step(&mut self, x: T) -> T {
        let from = if self.started { self.y } else { x };
        self.started = true;
        self.y = from + self.weight * (x - from);
        self.y
    }

    /// This lag's time constant with the memory of `other`.
    fn after(mut self, other: &Self) -> Self {
        self.y = other.y;
        self.started = other.started;
        self
    }
}

/// The feedback filter: a moving average, then a lag, then an observer.
#[derive(Clone, Debug)]
pub struct Feedback<T> {
    average: MovingAverage<T>,
    lag: Lag<T>,
    observer: Observer<T>,
}

impl<T: Real> Feedback<T> {
    /// An average of `samples`, a lag of `time` \[s\], an observer of `observer_time` \[s\], at sample time `ts` \[s\].
    ///
    /// # Errors
    /// What [`MovingAverage::new`], [`Lag::new`] and [`Observer::new`] refuse.
    pub fn new(samples: usize, time: T, observer_time: T, ts: T) -> Result<Self, Refused> {
        Ok(Self {
            average: MovingAverage::new(samples)?,
            lag: Lag::new(time, ts)?,
            observer: Observer::new(observer_time, ts)?,
        })
    }

    /// Forgets everything.
    pub fn reset(&mut self) {
        self.average.reset();
        self.lag.reset();
        self.observer.reset();
    }

    /// Takes a sample and returns the filtered value.
    pub fn step(&mut self, x: T) -> T {
        self.observer.step(self.lag.step(self.average.step(x)))
    }

    /// Samples of the average, weight of the lag, observer.
    pub(crate) fn parts(&self) -> (usize, T, &Observer<T>) {
        (self.average.length, self.lag.weight, &self.observer)
    }

    /// The last measurement; `None` before the first one.
    pub(crate) fn newest(&self) -> Option<T> {
        self.average.newest()
    }

    /// The output for `x` as the next measurement.
    pub(crate) fn given(&self, x: T) -> T {
        self.clone().step(x)
    }

    /// These settings with the memory of `other`: a constant output continues at the same value.
    pub(crate) fn after(self, other: &Self) -> Self {
        Self {
            average: self.average.after(&other.average),
            lag: self.lag.after(&other.lag),
            observer: self.observer.after(&other.observer),
        }
    }
}

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

    /// Forgets its value; the next sample begins at its start.
    pub fn reset(&mut self) {
        self.started = false;
    }

    /// Takes a reference and returns the ramped one; the first ramp after a reset begins at `start`.
    ///
    /// A reference that is not finite is passed on without effect on the ramp.
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

    /// The last ramped reference; `None` before the first one.
    pub(crate) fn newest(&self) -> Option<T> {
        self.started.then_some(self.r)
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

// The alpha-beta observer: speed from a position that is never computed.
//
// The tracker of a position `p(k) = p(k-1) + Ts y(k)` with position and speed as states (Benedict and Bordner 1962),
//
// ```text
// r(k) = p(k) - x(k-1) - Ts v(k-1)        innovation
// x(k) = x(k-1) + Ts v(k-1) + a r(k)
// v(k) = v(k-1) + b/Ts r(k)
// ```
//
// leaves `p(k) - x(k) = (1 - a) r(k)`, so the innovation follows from itself and the measured speed:
// `r(k) = (1 - a) r(k-1) + Ts (y(k) - v(k-1))`. With `s = r/Ts` both the position and the sample time drop out:
//
// ```text
// s(k) = (1 - a) s(k-1) + y(k) - v(k-1)
// v(k) = v(k-1) + b s(k)
// ```
//
// Critically damped: both poles at `theta = exp(-Ts/time)`, `1 - a = theta^2`, `b = (1 - theta)^2`.

/// Filters a measured speed, without error at constant speed.
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

    /// Takes a measured speed and returns the observed one.
    pub fn step(&mut self, y: T) -> T {
        let (from, left) = if self.started && self.on {
            (self.speed, self.innovation)
        } else {
            (y, T::ZERO)
        };
        self.started = true;
        if self.on {
            self.innovation = self.keep * left + (y - from);
            self.speed = from + self.gain * self.innovation;
        } else {
            (self.speed, self.innovation) = (y, T::ZERO);
        }
        self.speed
    }

    /// `1 - a` and `b`; `None` if the input passes through.
    pub(crate) fn weights(&self) -> Option<(T, T)> {
        self.on.then_some((self.keep, self.gain))
    }

    /// This observer's settings with the memory of `other`: its output continues at the same value.
    pub(crate) fn after(mut self, other: &Self) -> Self {
        self.speed = other.speed;
        self.innovation = if self.on { other.innovation } else { T::ZERO };
        self.started = other.started;
        self
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn averages_the_last_samples_and_starts_at_the_first() {
        let mut average = MovingAverage::new(4).unwrap();
        let out: Vec<f64> = [8.0, 0.0, 0.0, 0.0, 0.0, 4.0]
            .map(|x| average.step(x))
            .to_vec();
        assert_eq!(out, [8.0, 6.0, 4.0, 2.0, 0.0, 1.0]);
        average.reset();
        assert_eq!(average.step(-3.0), -3.0);
    }

    #[test]
    fn average_does_not_drift() {
        let mut average = MovingAverage::new(7).unwrap();
        for k in 0..100_000_u32 {
            average.step(if k % 3 == 0 { 1e6_f32 } else { 0.1 });
        }
        let settled = (0..7).map(|_| average.step(0.0)).last().unwrap();
        assert_eq!(settled, 0.0);
    }

    #[test]
    fn lags_as_its_closed_form() {
        let (time, ts) = (0.004, 1e-3);
        let mut lag = Lag::new(time, ts).unwrap();
        lag.step(0.0);
        let pole: f64 = time / (time + ts);
        for k in 1..50 {
            let exact = 1.0 - pole.powi(k);
            assert!((lag.step(1.0) - exact).abs() < 1e-14);
        }
    }

    #[test]
    fn passes_through_where_switched_off_and_refuses_nonsense() {
        let mut off = Feedback::new(1, 0.0, 0.0, 1e-3).unwrap();
        assert_eq!([3.0, -1.0, 2.0].map(|x| off.step(x)), [3.0, -1.0, 2.0]);
        for samples in [0, CAPACITY + 1] {
            assert_eq!(
                Feedback::new(samples, 0.0, 0.0, 1e-3).unwrap_err().name,
                "filter_samples"
            );
        }
        for time in [-1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(
                Feedback::new(1, time, 0.0, 1e-3).unwrap_err().name,
                "filter_time"
            );
        }
        assert!(Feedback::new(CAPACITY, 0.01_f32, 0.004, 1e-3).is_ok());
    }

    proptest! {
        #[test]
        fn a_ramp_moves_no_faster_than_its_rate_and_arrives(
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
    fn a_ramp_begins_at_its_start_and_keeps_what_is_not_finite_out() {
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
    fn a_ramp_passes_through_where_switched_off_and_refuses_nonsense() {
        let mut off = Ramp::new(f64::INFINITY, 1e-3).unwrap();
        assert_eq!(
            [3.0, -1e300, 2.0].map(|r| off.step(r, 9.0)),
            [3.0, -1e300, 2.0]
        );
        for rate in [0.0, -1.0, f64::NAN, 1e-323] {
            assert_eq!(Ramp::new(rate, 1e-3).unwrap_err().name, "r_rate");
        }
    }

    // The observer compared with the textbook's position tracker, and its drift.

    const TS: f64 = 1e-3;

    /// The textbook's tracker, whose position grows.
    struct Tracker {
        alpha: f64,
        beta: f64,
        measured: f64,
        position: f64,
        speed: f64,
    }

    impl Tracker {
        /// Settled at a constant speed.
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
        // After 250,000 counts the textbook form's position has lost the speed's last digits; this form has no position.
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
        // A few rounding errors of 2,600 in single precision (2.4e-4 each), filtered: never more, and at the end no more than at first.
        assert!(worst < 0.01, "{worst}");
        assert!(late < 0.01, "{late}");
    }

    #[test]
    fn an_observer_passes_through_where_switched_off_and_refuses_nonsense() {
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
