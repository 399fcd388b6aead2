//! The controller interface, the kinds of controllers behind it, and how they refuse a setting.

mod state_feedback;

use core::fmt;

use crate::{Design, PidController, Real};

pub use state_feedback::{NUMBERS, STATES, StateDesign, StateFeedback, Weights, lqg};

/// One sampled controller from reference and measured output to the command.
///
/// For any input the command is finite, within the limits, and no further from the last one than the slew rate allows;
/// every implementation is tested with the laws of `pid_controller/tests/any.rs`.
pub trait Controller<T: Real> {
    /// Back to the state before the first sample.
    fn reset(&mut self);

    /// From reference `r` and measured output `y` to the command of this sample; `feedforward` is added before the limits.
    fn step_with(&mut self, r: T, y: T, feedforward: T) -> T;

    /// [`step_with`](Self::step_with) without feedforward.
    fn step(&mut self, r: T, y: T) -> T {
        // x + (-0) is x for every x, even for -0
        self.step_with(r, y, -T::ZERO)
    }

    /// The output as the controller sees it, after its filter or observer, at the last step.
    fn filtered(&self) -> T;

    /// Sample time \[s\].
    fn ts(&self) -> T;

    /// Least and largest command \[u\].
    fn limits(&self) -> (T, T);
}

/// The settings of a controller of any kind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AnyDesign<T> {
    /// Of a PID with its filters.
    Pid(Design<T>),
    /// Of state feedback with an observer.
    StateFeedback(StateDesign<T>),
}

impl<T: Real> AnyDesign<T> {
    /// The controller, at rest.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn controller(&self) -> Result<AnyController<T>, Refused> {
        match self {
            Self::Pid(design) => PidController::new(*design).map(AnyController::Pid),
            Self::StateFeedback(design) => {
                StateFeedback::new(*design).map(AnyController::StateFeedback)
            }
        }
    }

    /// The refusal that [`controller`](Self::controller) would give, without making the controller, which would fill
    /// most of a small processor's stack.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub fn check(&self) -> Result<(), Refused> {
        match self {
            Self::Pid(design) => PidController::check(design),
            Self::StateFeedback(design) => design.check(),
        }
    }

    /// Sample time \[s\].
    pub fn ts(&self) -> T {
        match self {
            Self::Pid(design) => design.pid.ts,
            Self::StateFeedback(design) => design.ts,
        }
    }

    /// Least and largest command \[u\].
    pub fn limits(&self) -> (T, T) {
        match self {
            Self::Pid(design) => (design.pid.u_min, design.pid.u_max),
            Self::StateFeedback(design) => (design.u_min, design.u_max),
        }
    }

    /// A controller of kind number `kind`, as sent to a device, from the numbers that `next` returns one by one,
    /// without its sample time. `None` if the numbers end too early, or for an unknown kind. The PID has no kind
    /// number: it has its own commands.
    pub(crate) fn from_numbers(kind: u8, next: impl FnMut() -> Option<T>) -> Option<Self> {
        match kind {
            1 => StateDesign::from_numbers(next, T::ZERO).map(Self::StateFeedback),
            _ => None,
        }
    }

    /// The index of a setting among those numbers.
    pub(crate) fn place_of(&self, name: &str) -> Option<u32> {
        match self {
            Self::Pid(_) => None,
            Self::StateFeedback(_) => Some(StateDesign::<T>::place_of(name)),
        }
    }

    /// The settings of a PID; `None` for another kind.
    pub fn pid(&self) -> Option<&Design<T>> {
        match self {
            Self::Pid(design) => Some(design),
            Self::StateFeedback(_) => None,
        }
    }

    /// The settings of a PID, to be changed.
    pub(crate) fn pid_mut(&mut self) -> Option<&mut Design<T>> {
        match self {
            Self::Pid(design) => Some(design),
            Self::StateFeedback(_) => None,
        }
    }

    /// Takes another sample time \[s\], and limits no wider than `bound` in either direction. In its place: a copy is half a kilobyte
    /// of a small processor's stack.
    pub(crate) fn bound(&mut self, bound: T, ts: T) {
        let (u_min, u_max, own_ts) = match self {
            Self::Pid(Design { pid, .. }) => (&mut pid.u_min, &mut pid.u_max, &mut pid.ts),
            Self::StateFeedback(d) => (&mut d.u_min, &mut d.u_max, &mut d.ts),
        };
        // comparisons instead of min and max, which would hide a NaN
        if *u_min < -bound {
            *u_min = -bound;
        }
        if *u_max > bound {
            *u_max = bound;
        }
        *own_ts = ts;
    }
}

impl<T> From<Design<T>> for AnyDesign<T> {
    fn from(design: Design<T>) -> Self {
        Self::Pid(design)
    }
}

/// A controller of any kind.
#[derive(Clone, Debug)]
pub enum AnyController<T> {
    /// A PID with its filters.
    Pid(PidController<T>),
    /// State feedback with an observer.
    StateFeedback(StateFeedback<T>),
}

/// Runs an expression on the controller inside, of any kind.
macro_rules! within {
    ($any:expr, $controller:ident => $do:expr) => {
        match $any {
            AnyController::Pid($controller) => $do,
            AnyController::StateFeedback($controller) => $do,
        }
    };
}

impl<T: Real> Controller<T> for AnyController<T> {
    #[inline]
    fn reset(&mut self) {
        within!(self, controller => controller.reset());
    }

    #[inline]
    fn step_with(&mut self, r: T, y: T, feedforward: T) -> T {
        within!(self, controller => controller.step_with(r, y, feedforward))
    }

    #[inline]
    fn filtered(&self) -> T {
        within!(self, controller => controller.filtered())
    }

    #[inline]
    fn ts(&self) -> T {
        within!(self, controller => controller.ts())
    }

    #[inline]
    fn limits(&self) -> (T, T) {
        within!(self, controller => controller.limits())
    }
}

impl<T: Real> AnyController<T> {
    /// The PID; `None` for another kind.
    pub fn pid(&self) -> Option<&PidController<T>> {
        match self {
            Self::Pid(controller) => Some(controller),
            Self::StateFeedback(_) => None,
        }
    }

    /// The state feedback; `None` for another kind.
    pub fn state_feedback(&self) -> Option<&StateFeedback<T>> {
        match self {
            Self::StateFeedback(controller) => Some(controller),
            Self::Pid(_) => None,
        }
    }
}

impl<T> From<StateDesign<T>> for AnyDesign<T> {
    fn from(design: StateDesign<T>) -> Self {
        Self::StateFeedback(design)
    }
}

impl<T> From<PidController<T>> for AnyController<T> {
    fn from(controller: PidController<T>) -> Self {
        Self::Pid(controller)
    }
}

/// Refuses limits that leave no command between them.
pub(crate) fn check_limits<T: Real>((u_min, u_max): (T, T)) -> Result<(), Refused> {
    let (bounded, above) = (u_min < T::INFINITY, u_max > u_min);
    Refused::unless(bounded, "u_min", "a finite limit or -inf", u_min.to_f64())?;
    Refused::unless(above, "u_max", "a limit above u_min", u_max.to_f64())
}

/// The command for a wanted one: within the limits, and no further than `change` from the `last` one. Limits narrowed
/// since the last command are approached at the slew rate.
///
/// The last command is finite: first it is 0 or the nearest limit, later it comes from here. No comparison holds for
/// NaN, which passes any clamp; if the result is not finite, the last command is returned.
pub(crate) fn limited<T: Real>(wanted: T, last: T, (u_min, u_max): (T, T), change: T) -> T {
    let limited = wanted
        .limit(u_min, u_max)
        .limit(last - change, last + change);
    if limited.is_finite() { limited } else { last }
}

/// The setting's name, what was expected, what was received.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refused {
    /// Name of the setting, as in docs/CONVENTIONS.md.
    pub name: &'static str,
    /// What is accepted.
    pub expected: &'static str,
    /// What came.
    pub received: f64,
}

impl Refused {
    /// `Ok` if `holds`, else the refusal.
    pub(crate) fn unless(
        holds: bool,
        name: &'static str,
        expected: &'static str,
        received: f64,
    ) -> Result<(), Self> {
        let refused = Self {
            name,
            expected,
            received,
        };
        if holds { Ok(()) } else { Err(refused) }
    }
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            name,
            expected,
            received,
        } = self;
        write!(f, "expected {expected} for {name}, got {received}")
    }
}

impl core::error::Error for Refused {}
