//! Feedback filters: moving average, first-order lag, and the chain of them with the observer.

use crate::gains::sample_time;
use crate::{Observer, Real, Refused};

/// The longest moving average, in samples.
pub const CAPACITY: usize = 64;

/// Mean of the last `n` samples; a delay of `(n - 1)/2` samples, and an encoder's step is `n` times smaller.
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
        // The order of summation is part of the result's last bits.
        self.next = 0;
    }

    /// Takes a sample, gives the average.
    ///
    /// The sum is formed anew each time: a running sum would drift.
    pub fn step(&mut self, x: T) -> T {
        // get, not an index: firmware is to hold no panic
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
        self.mean()
    }

    fn mean(&self) -> T {
        let memory = self.samples.get(..self.length).unwrap_or_default();
        let sum = memory.iter().fold(T::ZERO, |sum, &x| sum + x);
        sum / T::from_count(self.length)
    }

    /// This average's length with the memory of `other`: all of it, or where the lengths differ its mean.
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

    /// Takes a sample, gives the lagged value.
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

    /// Takes a sample, gives the filtered value.
    pub fn step(&mut self, x: T) -> T {
        self.observer.step(self.lag.step(self.average.step(x)))
    }

    /// Samples of the average, weight of the lag, observer.
    pub(crate) fn parts(&self) -> (usize, T, &Observer<T>) {
        (self.average.length, self.lag.weight, &self.observer)
    }

    /// These settings with the memory of `other`, so that a constant output goes on where that one's was.
    pub(crate) fn after(self, other: &Self) -> Self {
        Self {
            average: self.average.after(&other.average),
            lag: self.lag.after(&other.lag),
            observer: self.observer.after(&other.observer),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

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
}
