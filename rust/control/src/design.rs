//! Everything that a [`PidController`](crate::PidController) is made from.

use crate::{Cascade, Real, Schedule, Settings};

/// The settings of a whole controller; symbols as in docs/CONVENTIONS.md.
///
/// ```
/// use sewfast_control::{PidController, Design, Settings, Standard};
///
/// let gains = Standard { kp: 0.02, ti: 0.25, td: 0.004 };
/// let pid = Settings { u_min: -20.0, u_max: 20.0, ..Settings::new(gains, 1e-3) };
/// let design = Design { observer_time: 0.004, r_rate: 5000.0, ..Design::new(pid) };
/// assert!(PidController::new(design).is_ok());
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Design<T> {
    /// Gains, set-point weights, limits and sample time.
    pub pid: Settings<T>,
    /// Moving average in the feedback \[samples\]; 1 for none.
    pub filter_samples: usize,
    /// First-order lag in the feedback after it \[s\]; 0 for none.
    pub filter_time: T,
    /// Time constant of the alpha-beta observer after that \[s\]; 0 for none.
    pub observer_time: T,
    /// Largest change of the reference that is controlled to \[y/s\]; infinite for none.
    pub r_rate: T,
    /// Gains over speed; empty for the constant ones of `pid`.
    pub schedule: Schedule<T>,
    /// Notches and the like on reference and feedback; none by default.
    pub biquads: Cascade<T>,
}

impl<T: Real> Design<T> {
    /// The PID alone: no filter, no observer, no ramp, no schedule, no biquads.
    pub fn new(pid: Settings<T>) -> Self {
        Self {
            pid,
            filter_samples: 1,
            filter_time: T::ZERO,
            observer_time: T::ZERO,
            r_rate: T::INFINITY,
            schedule: Schedule::NONE,
            biquads: Cascade::NONE,
        }
    }
}
