//! [`PidController`] in storage of the caller.

use crate::{place, tell};
use core::ffi::c_void;
use core::ptr::null_mut;
use sewfast_control::{
    BIQUADS, Biquad, Cascade, Design, Feedforward, LEVELS, Level, POINTS, PidController, Point,
    Refused, Schedule, Settings, Standard, TAPS,
};

/// `sewfast_pid_point`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CPoint {
    /// \[y\].
    pub speed: f32,
    /// \[u/y\].
    pub kp: f32,
    /// \[s\].
    pub ti: f32,
    /// \[s\].
    pub td: f32,
}

/// `sewfast_pid_biquad`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CBiquad {
    /// Step response at the step's own sample, minus 1.
    pub c0: f32,
    /// The same a sample later, before the poles.
    pub c1: f32,
    /// Coefficients of the denominator.
    pub a1: f32,
    /// Coefficients of the denominator.
    pub a2: f32,
}

/// `sewfast_pid_level`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CLevel {
    /// Output \[y\].
    pub y: f32,
    /// The command that holds it \[u\].
    pub u: f32,
}

/// `sewfast_pid_settings`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CSettings {
    /// \[u/y\].
    pub kp: f32,
    /// \[s\].
    pub ti: f32,
    /// \[s\].
    pub td: f32,
    /// Share of the reference taken out of the proportional term.
    pub alpha: f32,
    /// Share of the reference taken out of the derivative term.
    pub beta: f32,
    /// The derivative's filter has the time constant `td/n`.
    pub n: f32,
    /// Anti-windup \[s\].
    pub tt: f32,
    /// \[u\].
    pub u_min: f32,
    /// \[u\].
    pub u_max: f32,
    /// \[u/s\].
    pub slew: f32,
    /// Sample time \[s\].
    pub ts: f32,
    /// Lag of the feedback \[s\].
    pub filter_time: f32,
    /// Moving average of the feedback.
    pub filter_samples: u8,
    /// Observer of the feedback \[s\].
    pub observer_time: f32,
    /// Ramp of the reference \[y/s\].
    pub r_rate: f32,
    /// Number of points in the schedule.
    pub schedule_count: u8,
    /// Gains over speed.
    pub schedule: [CPoint; POINTS],
    /// Number of biquads.
    pub biquad_count: u8,
    /// Biquads on reference and feedback.
    pub biquads: [CBiquad; BIQUADS],
    /// Number of levels of the feedforward.
    pub level_count: u8,
    /// Number of its taps; with no level either there is none.
    pub tap_count: u8,
    /// Samples by which the reference arrives early.
    pub preview: u8,
    /// Share of a sample by which the measurement is late.
    pub late: f32,
    /// Commands that hold outputs.
    pub levels: [CLevel; LEVELS],
    /// Command per change of the reference, the newest change's first.
    pub taps: [f32; TAPS],
}

/// The number of the setting, in the header's order from 1; 0 for none.
fn number(name: &str) -> i32 {
    let names = [
        "Kp",
        "Ti",
        "Td",
        "alpha",
        "beta",
        "N",
        "Tt",
        "u_min",
        "u_max",
        "slew",
        "Ts",
        "filter_time",
        "filter_samples",
        "observer_time",
        "r_rate",
        "schedule",
        "biquads",
        "feedforward",
    ];
    let found = (1..).zip(names).find(|(_, known)| *known == name);
    found.map_or(-1, |(number, _)| number)
}

/// Size of a controller in bytes.
#[unsafe(no_mangle)]
pub extern "C" fn sewfast_pid_size() -> usize {
    size_of::<PidController<f32>>()
}

/// Makes a controller at rest in `storage`; null if it is refused.
///
/// # Safety
/// `storage` is `size` bytes of memory that nothing else uses; `settings` is null or readable; `refusal` is null or
/// writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_init(
    storage: *mut c_void,
    size: usize,
    settings: *const CSettings,
    refusal: *mut i32,
) -> *mut PidController<f32> {
    // SAFETY: by contract.
    let settings = unsafe { settings.as_ref() };
    let made = match (place::<PidController<f32>>(storage, size), settings) {
        (Some(place), Some(settings)) => {
            settings.controller().map(|controller| {
                // SAFETY: place is fit for a controller.
                unsafe { place.write(controller) };
                place
            })
        }
        _ => Err(-1),
    };
    // SAFETY: by contract.
    unsafe { tell(refusal, made.err().unwrap_or(0)) };
    made.unwrap_or(null_mut())
}

impl CSettings {
    fn controller(&self) -> Result<PidController<f32>, i32> {
        let made = self.design().and_then(PidController::new);
        made.map_err(|refused| number(refused.name))
    }

    fn schedule(&self) -> Result<Schedule<f32>, Refused> {
        let mut points = [Point {
            speed: 0.0,
            gains: Standard {
                kp: 0.0,
                ti: 0.0,
                td: 0.0,
            },
        }; POINTS + 1];
        for (place, point) in points.iter_mut().zip(&self.schedule) {
            let CPoint { speed, kp, ti, td } = *point;
            *place = Point {
                speed,
                gains: Standard { kp, ti, td },
            };
        }
        // a count beyond the array means one point too many, and is refused
        let named = points.get(..self.schedule_count.into());
        Schedule::new(named.unwrap_or(&points))
    }

    fn biquads(&self) -> Result<Cascade<f32>, Refused> {
        let mut sections = [Biquad::NONE; BIQUADS + 1];
        for (place, section) in sections.iter_mut().zip(&self.biquads) {
            let CBiquad { c0, c1, a1, a2 } = *section;
            *place = Biquad { c0, c1, a1, a2 };
        }
        // a count beyond the array means one section too many, and is refused
        let named = sections.get(..self.biquad_count.into());
        Cascade::new(named.unwrap_or(&sections))
    }

    fn feedforward(&self) -> Result<Feedforward<f32>, Refused> {
        if self.level_count == 0 && self.tap_count == 0 {
            return Ok(Feedforward::NONE);
        }
        let mut levels = [Level { y: 0.0, u: 0.0 }; LEVELS + 1];
        for (place, level) in levels.iter_mut().zip(&self.levels) {
            let CLevel { y, u } = *level;
            *place = Level { y, u };
        }
        let mut taps = [0.0; TAPS + 1];
        for (place, tap) in taps.iter_mut().zip(&self.taps) {
            *place = *tap;
        }
        // a count beyond the array means one too many, and is refused
        Feedforward::new(
            self.preview.into(),
            self.late,
            levels.get(..self.level_count.into()).unwrap_or(&levels),
            taps.get(..self.tap_count.into()).unwrap_or(&taps),
        )
    }

    fn design(&self) -> Result<Design<f32>, Refused> {
        let pid = Settings {
            gains: Standard {
                kp: self.kp,
                ti: self.ti,
                td: self.td,
            },
            alpha: self.alpha,
            beta: self.beta,
            n: self.n,
            tt: self.tt,
            u_min: self.u_min,
            u_max: self.u_max,
            slew: self.slew,
            ts: self.ts,
        };
        Ok(Design {
            pid,
            filter_samples: self.filter_samples.into(),
            filter_time: self.filter_time,
            observer_time: self.observer_time,
            r_rate: self.r_rate,
            schedule: self.schedule()?,
            biquads: self.biquads()?,
            feedforward: self.feedforward()?,
        })
    }
}

/// Whether `made` is a section; if so, it is written to `place`.
///
/// # Safety
/// `place` is null or writable.
unsafe fn put(place: *mut CBiquad, made: Result<Biquad<f32>, Refused>) -> bool {
    // SAFETY: by contract.
    let (Some(place), Ok(made)) = (unsafe { place.as_mut() }, made) else {
        return false;
    };
    let Biquad { c0, c1, a1, a2 } = made;
    *place = CBiquad { c0, c1, a1, a2 };
    true
}

/// [`Biquad::notch`].
///
/// # Safety
/// `biquad` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_notch(
    biquad: *mut CBiquad,
    frequency: f32,
    depth: f32,
    width: f32,
    ts: f32,
) -> bool {
    let made = Biquad::notch(frequency.into(), depth.into(), width.into(), ts.into());
    // SAFETY: by contract.
    unsafe { put(biquad, made) }
}

/// [`Biquad::low_pass`].
///
/// # Safety
/// `biquad` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_low_pass(
    biquad: *mut CBiquad,
    frequency: f32,
    damping: f32,
    ts: f32,
) -> bool {
    let made = Biquad::low_pass(frequency.into(), damping.into(), ts.into());
    // SAFETY: by contract.
    unsafe { put(biquad, made) }
}

/// [`Biquad::lead_lag`].
///
/// # Safety
/// `biquad` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_lead_lag(
    biquad: *mut CBiquad,
    zero: f32,
    pole: f32,
    ts: f32,
) -> bool {
    let made = Biquad::lead_lag(zero.into(), pole.into(), ts.into());
    // SAFETY: by contract.
    unsafe { put(biquad, made) }
}

/// [`Biquad::resonance`].
///
/// # Safety
/// `biquad` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_resonance(
    biquad: *mut CBiquad,
    zero_frequency: f32,
    zero_damping: f32,
    pole_frequency: f32,
    pole_damping: f32,
    ts: f32,
) -> bool {
    let [
        zero_frequency,
        zero_damping,
        pole_frequency,
        pole_damping,
        ts,
    ] = [
        zero_frequency,
        zero_damping,
        pole_frequency,
        pole_damping,
        ts,
    ]
    .map(f64::from);
    let made = Biquad::resonance(
        zero_frequency,
        zero_damping,
        pole_frequency,
        pole_damping,
        ts,
    );
    // SAFETY: by contract.
    unsafe { put(biquad, made) }
}

/// [`PidController::step`]; 0 if there is no controller.
///
/// # Safety
/// `pid` is null, or came from [`sewfast_pid_init`] and is used by one context at a time.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_step(pid: *mut PidController<f32>, r: f32, y: f32) -> f32 {
    // SAFETY: by contract.
    let pid = unsafe { pid.as_mut() };
    pid.map_or(0.0, |pid| pid.step(r, y))
}

/// [`PidController::step_with`]; 0 if there is no controller.
///
/// # Safety
/// As for [`sewfast_pid_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_step_with(
    pid: *mut PidController<f32>,
    r: f32,
    y: f32,
    feedforward: f32,
) -> f32 {
    // SAFETY: by contract.
    let pid = unsafe { pid.as_mut() };
    pid.map_or(0.0, |pid| pid.step_with(r, y, feedforward))
}

/// [`PidController::set_design`]; returns 0, the number of the refused setting, or -1 if a pointer is null.
///
/// # Safety
/// As for [`sewfast_pid_step`]; `settings` is null or readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_change(
    pid: *mut PidController<f32>,
    settings: *const CSettings,
) -> i32 {
    // SAFETY: by contract.
    let (Some(pid), Some(settings)) = (unsafe { pid.as_mut() }, unsafe { settings.as_ref() })
    else {
        return -1;
    };
    let done = settings.design().and_then(|design| pid.set_design(design));
    done.map_or_else(|refused| number(refused.name), |()| 0)
}

/// [`PidController::set_manual`]; returns whether `u` is finite.
///
/// # Safety
/// As for [`sewfast_pid_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_set_manual(pid: *mut PidController<f32>, u: f32) -> bool {
    // SAFETY: by contract.
    let pid = unsafe { pid.as_mut() };
    pid.is_some_and(|pid| pid.set_manual(u).is_ok())
}

/// [`PidController::set_automatic`].
///
/// # Safety
/// As for [`sewfast_pid_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_set_automatic(pid: *mut PidController<f32>) {
    // SAFETY: by contract.
    if let Some(pid) = unsafe { pid.as_mut() } {
        pid.set_automatic();
    }
}

/// [`PidController::reset`].
///
/// # Safety
/// As for [`sewfast_pid_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_pid_reset(pid: *mut PidController<f32>) {
    // SAFETY: by contract.
    if let Some(pid) = unsafe { pid.as_mut() } {
        pid.reset();
    }
}
