//! The whole controller of the paper's Fig. 16: feedback filter, then two-degree-of-freedom PID.

use crate::{Feedback, Pid, Real, Refused, Settings};

/// Feedback filter and PID behind one step.
#[derive(Clone, Debug)]
pub struct Controller<T> {
    filter: Feedback<T>,
    pid: Pid<T>,
    filtered: T,
}

impl<T: Real> Controller<T> {
    /// A controller whose feedback is averaged over `filter_samples`, then lagged by `filter_time` \[s\].
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn new(
        settings: Settings<T>,
        filter_samples: usize,
        filter_time: T,
    ) -> Result<Self, Refused> {
        Ok(Self {
            pid: Pid::new(settings)?,
            filter: Feedback::new(filter_samples, filter_time, settings.ts)?,
            filtered: T::ZERO,
        })
    }

    /// Back to the state before the first sample.
    pub fn reset(&mut self) {
        self.filter.reset();
        self.pid.reset();
        self.filtered = T::ZERO;
    }

    /// From reference and measured output to the command: filter, control, limit.
    ///
    /// A measurement that is not finite is skipped: the filter keeps its memory, the command its value.
    pub fn step(&mut self, r: T, y: T) -> T {
        if !y.is_finite() {
            return self.pid.output();
        }
        self.filtered = self.filter.step(y);
        self.pid.step(r, self.filtered)
    }

    /// The feedback after its filter, at the last step.
    pub fn filtered(&self) -> T {
        self.filtered
    }

    /// The settings of the PID.
    pub fn settings(&self) -> &Settings<T> {
        self.pid.settings()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Standard;

    #[test]
    fn feeds_back_the_filtered_output_and_skips_a_lost_measurement() {
        let gains = Standard {
            kp: 1.0,
            ti: f64::INFINITY,
            td: 0.0,
        };
        let mut controller = Controller::new(Settings::new(gains, 1e-3), 2, 0.0).unwrap();
        assert_eq!(controller.step(0.0, 4.0), -4.0);
        assert_eq!(controller.step(0.0, 0.0), -2.0);
        assert_eq!(controller.filtered(), 2.0);
        assert_eq!(controller.step(0.0, f64::NAN), -2.0);
        assert_eq!(controller.step(0.0, 0.0), 0.0);
    }
}
