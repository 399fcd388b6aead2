//! The device's watch over the motor: speed and acceleration from counts, limits, motion, swinging.
//!
//! **Acceleration.** The difference of two speeds over `W` samples each, `D` samples apart, shows a swing of frequency
//! `f` with the factor `sinc(f W Ts) sinc(f D Ts)`. With 8 and 16 samples it is exact for a motor that speeds up, but
//! blind to a swing of 62.5 Hz. So shorter spans are tested as well: `c(k) - 2 c(k-s) + c(k-2s)` over `(s Ts)^2` for
//! `s` of 8, 4 and 2, and over one sample the fourth-order difference `(-1, 16, -30, 16, -1)/12`, whose factor stays
//! above 3/4 up to 400 Hz at a period of 1 ms. The largest value counts.
//!
//! A count is a floor, so its error is below 1: a difference with weights `w` is wrong by less than the sum of its
//! positive weights, which is 2 counts, or 32/12 for the fourth order. This bound is subtracted, so that encoder steps
//! alone never count as acceleration. The price: a swing that moves the encoder by only a few counts appears too small.

use super::device::Reason;
use super::identity::Limits;

/// Samples between the two counts of a speed.
const WINDOW: usize = 8;
/// Samples between the two speeds of an acceleration.
const APART: usize = 16;
/// Samples of the spans of second differences.
const SPANS: [usize; 3] = [8, 4, 2];
/// Error of a second difference that encoder steps can cause \[counts\].
const STEPS: i64 = 2;
/// The same for the fourth-order difference \[counts/12\].
const STEPS_OF_4: i64 = 32;
/// A command this near to a limit, as a part of the range between both, counts as at it.
const NEAR: f32 = 0.05;
/// Number of consecutive ways from one limit to the other that make a swing.
const SWINGS: u32 = 8;
/// Two ways further apart than this are not consecutive \[us\].
const SWING: u64 = 250_000;
/// A power of two above all spans together.
const HISTORY: usize = 32;
/// Standstill that ARM requires \[us\].
const STANDSTILL: u64 = 100_000;
/// Longest time that a large command may cause no motion \[us\].
const PATIENCE: u64 = 250_000;
/// For a host: least number of samples of a large command without motion, or between two ways that are not consecutive.
const LEAST: u64 = 10;

/// Shorter spans over which a host tests a speed \[samples\], ...
const SHORT: [usize; 3] = [4, 2, 1];
/// ... if it exceeds its limit by this factor.
const FAR: f32 = 1.25;

/// For a host: from one sample to the next no shaft falls below this share of its speed and stays slow while its
/// command stays, ...
const KEPT: f32 = 0.6;
/// ... if it turned at this share of the largest speed, by this many steps in each of the [`STEADY`] samples before, ...
const FAST: f32 = 0.1;
const CLEAR: i64 = 4;
const STEADY: usize = 4;
/// ... with a command that is not smaller than this share of the largest one of the last [`HISTORY`] samples, ...
const STAYS: f32 = 0.9;
/// ... and stays slow for this time \[us\] and number of samples.
const SLOW: u64 = 10_000;
const SLOW_SAMPLES: u64 = 8;

/// Why a run must end, with the value that exceeded its limit.
pub type Trip = (Reason, f32);

/// What a host's guard saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Alarm {
    /// What a device would trip on.
    Trip(Trip),
    /// The counts stopped, fell or turned from one sample to the next, at this command.
    Lost(f32),
}

/// The guard for a machine without its own device: a host passes it the counts and the command of each sample.
#[derive(Clone, Debug)]
pub struct Watch {
    guard: Guard,
    limits: Limits,
    between: Option<(f32, f32)>,
    /// One step of the encoder \[counts\].
    step: i64,
    /// The last commands.
    commands: [f32; HISTORY],
    /// The loss of speed that is being watched.
    fall: Option<Fall>,
}

/// A speed that fell from one sample to the next.
#[derive(Clone, Copy, Debug)]
struct Fall {
    /// Least counts of the [`STEADY`] samples before, each.
    pace: i64,
    /// Least command that keeps the machine turning, in the direction of the counts.
    push: f32,
    /// Samples since then.
    samples: u64,
}

impl Fall {
    /// Whether a command should keep the machine turning.
    fn stays(&self, u: f32) -> bool {
        u * self.pace.signum() as f32 >= self.push
    }
}

impl Watch {
    /// A guard for a sample time \[s\]; `between` are the limits of a loop's command, between which it must not swing.
    pub fn new(ts: f32, counts_per_rev: f32, limits: Limits, between: Option<(f32, f32)>) -> Self {
        let period = (ts * 1e6) as u32;
        let mut guard = Guard::new(period, ts, counts_per_rev);
        guard.least = LEAST.saturating_mul(guard.period);
        Self {
            guard,
            limits,
            between,
            step: 1,
            commands: [0.0; HISTORY],
            fall: None,
        }
    }

    /// Takes the counts of a sample, read before its command acts, with an error below `step`; the counter may wrap.
    ///
    /// # Errors
    /// A mean speed over 8 samples that exceeds its limit for any position of the encoder's steps.
    pub fn take(&mut self, counts: i32, step: u32) -> Result<(), Trip> {
        self.guard.take(counts);
        self.step = step.into();
        self.is_within(WINDOW, step, self.limits.speed)
    }

    /// The same for a machine whose samples are on time: a speed far too high is detected within a sample or two.
    ///
    /// # Errors
    /// As [`take`](Self::take), and a speed over 4, 2 or 1 samples far above its limit.
    pub fn take_on_time(&mut self, counts: i32, step: u32) -> Result<(), Trip> {
        self.take(counts, step)?;
        let far = FAR * self.limits.speed;
        SHORT
            .iter()
            .try_for_each(|&span| self.is_within(span, step, far))
    }

    fn is_within(&self, span: usize, step: u32, limit: f32) -> Result<(), Trip> {
        let moved = self.guard.moved(0, span).saturating_abs();
        let surely = moved.saturating_sub(step.into());
        let speed = surely as f32 * self.guard.rpm * (WINDOW / span) as f32;
        if speed > limit {
            return Err((Reason::Speed, speed));
        }
        Ok(())
    }

    /// Treats the next counts as the first, as after lost samples.
    pub fn forget(&mut self) {
        self.guard.forget();
        self.fall = None;
    }

    /// Takes the command of the sample.
    ///
    /// # Errors
    /// A command that causes no motion or that swings between its limits, and an encoder that is lost while it turns.
    pub fn sent(&mut self, u: f32) -> Result<(), Alarm> {
        self.guard
            .expect_motion(&self.limits, u)
            .map_err(Alarm::Trip)?;
        if let Some((low, high)) = self.between {
            self.guard.expect_calm(low, high, u).map_err(Alarm::Trip)?;
        }
        self.expect_pace(u)
    }

    /// A shaft has mass: counts that stop, halve or turn within a sample, and stay so under a command that stays, are
    /// those of an encoder that is lost (or of a shaft that hit something).
    fn expect_pace(&mut self, u: f32) -> Result<(), Alarm> {
        let fall = self.fall.or_else(|| self.falls(u));
        self.fall = fall.filter(|fall| self.is_slow(fall.pace) && fall.stays(u));
        self.commands.copy_within(1.., 0);
        if let Some(last) = self.commands.last_mut() {
            *last = u;
        }
        let Some(fall) = self.fall.as_mut() else {
            return Ok(());
        };
        fall.samples = fall.samples.saturating_add(1);
        let long = SLOW.max(SLOW_SAMPLES.saturating_mul(self.guard.period));
        if fall.samples.saturating_mul(self.guard.period) < long {
            return Ok(());
        }
        Err(Alarm::Lost(u))
    }

    /// Whether the last sample has far fewer counts than `pace`, in its direction.
    fn is_slow(&self, pace: i64) -> bool {
        let along = self.guard.moved(0, 1).saturating_mul(pace.signum());
        (along as f32) < KEPT * pace.saturating_abs() as f32
    }

    /// The fall of the speed with this sample, after some of steady speed.
    fn falls(&self, u: f32) -> Option<Fall> {
        let moved = self.guard.moved(1, STEADY);
        let towards = moved.signum();
        let paces = || (1..=STEADY).map(|ago| self.guard.moved(ago, 1).saturating_mul(towards));
        let (least, most) = paces().fold((i64::MAX, 0), |(a, b), x| (a.min(x), b.max(x)));
        let is_clear = least >= CLEAR.saturating_mul(self.step);
        let is_fast = least as f32 * self.guard.rpm * WINDOW as f32 >= FAST * self.limits.speed;
        // half of the least, or two steps
        let spread = (least / 2).max(self.step.saturating_mul(2));
        let is_steady = most.saturating_sub(least) <= spread;
        let pace = least.saturating_mul(towards);
        if !(is_clear && is_fast && is_steady && self.is_slow(pace)) {
            return None;
        }
        let along = |u: f32| u * towards as f32;
        let largest = self.commands.iter().fold(0.0_f32, |a, &u| a.max(along(u)));
        let push = STAYS * largest;
        let fall = Fall {
            pace,
            push,
            samples: 0,
        };
        (push > 0.0 && fall.stays(u)).then_some(fall)
    }

    /// Whether there was no count for a tenth of a second.
    pub fn at_rest(&self) -> bool {
        self.guard.at_rest()
    }
}

/// The last counts, and what follows from them.
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
    /// RPM/s of one count of a second difference over one sample, `60/(Ts^2 counts_per_rev)`.
    bend: f32,
    /// Samples since the last count.
    still: u32,
    /// Samples in a row with a large command and without a count.
    stuck: u32,
    /// The limit at which the command was last: below 0, above 0, or 0 for none yet.
    side: i8,
    /// Consecutive ways from limit to limit.
    swings: u32,
    /// Samples since the last of them, and since the first.
    since: u32,
    swinging: u32,
    /// Shortest patience of a host \[us\]; 0 on a device.
    least: u64,
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
            bend: 60.0 / (ts * ts * counts_per_rev),
            still: 0,
            stuck: 0,
            side: 0,
            swings: 0,
            since: 0,
            swinging: 0,
            least: 0,
        }
    }

    /// Treats the next counts as the first: the earlier ones belong to another motion.
    pub(super) fn forget(&mut self) {
        self.started = false;
    }

    /// Takes the counts of a sample; the counter may wrap.
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

    /// Counts since the previous sample.
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

    /// The largest acceleration over all spans \[RPM/s\].
    pub(super) fn acceleration(&self) -> f32 {
        let mut largest = self.slow_acceleration();
        let mut consider = |seen: f32| {
            if seen.abs() > largest.abs() {
                largest = seen;
            }
        };
        for span in SPANS {
            let bend = self.moved(0, span).wrapping_sub(self.moved(span, span));
            let scale = self.bend / (span * span) as f32;
            consider(beyond(bend, STEPS) * scale);
        }
        let [a, b, c, d] = [0, 1, 2, 3].map(|ago| self.moved(ago, 1));
        let inner = b.wrapping_sub(c).wrapping_mul(15);
        let fourth = inner.wrapping_sub(a.wrapping_sub(d));
        consider(beyond(fourth, STEPS_OF_4) * (self.bend / 12.0));
        largest
    }

    /// Difference of two speeds 16 samples apart \[RPM/s\]; exact in counts, whereas speeds would cancel.
    fn slow_acceleration(&self) -> f32 {
        let change = i64::from(self.window(0)).wrapping_sub(self.window(APART).into());
        change as f32 * self.rpm * self.rate
    }

    /// Counts in the `span` samples that ended `ago` samples before.
    fn moved(&self, ago: usize, span: usize) -> i64 {
        let start = self.before(ago.wrapping_add(span));
        self.before(ago).wrapping_sub(start).into()
    }

    /// Whether there was no count for long enough to arm.
    pub(super) fn at_rest(&self) -> bool {
        u64::from(self.still).saturating_mul(self.period) >= STANDSTILL
    }

    /// # Errors
    /// The limit that is exceeded; a current of NaN has none.
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

    /// A run begins: patience starts anew.
    pub(super) fn begin(&mut self) {
        self.stuck = 0;
        (self.side, self.swings) = (0, 0);
    }

    /// Watches a loop's command `u` between its limits `low` and `high`. A command that goes from one to the other
    /// again and again swings, and can damage a shaft without exceeding any limit of speed or acceleration.
    ///
    /// # Errors
    /// The frequency \[Hz\], after eight ways from limit to limit at most 250 ms apart.
    pub(super) fn expect_calm(&mut self, low: f32, high: f32, u: f32) -> Result<(), Trip> {
        let near = NEAR * (high - low);
        let side = i8::from(u >= high - near) - i8::from(u <= low + near);
        self.since = self.since.saturating_add(1);
        self.swinging = self.swinging.saturating_add(1);
        if side == 0 || side == self.side {
            return Ok(());
        }
        let first = self.side == 0;
        self.side = side;
        let in_row = u64::from(self.since).saturating_mul(self.period) <= SWING.max(self.least);
        if first || !in_row || self.swings == 0 {
            (self.swings, self.swinging) = (u32::from(!first), 0);
        } else {
            self.swings = self.swings.saturating_add(1);
        }
        self.since = 0;
        if self.swings < SWINGS {
            return Ok(());
        }
        let ways = self.swings.saturating_sub(1) as f32;
        let seconds = self.swinging as f32 * self.period as f32 * 1e-6;
        Err((Reason::Swinging, ways / (2.0 * seconds)))
    }

    /// # Errors
    /// The command `u`, if the motor has long ignored it: with a lost encoder a controller would push ever harder.
    pub(super) fn expect_motion(&mut self, limits: &Limits, u: f32) -> Result<(), Trip> {
        let large = u.abs() >= 0.5 * limits.volt;
        self.stuck = if large && self.still > 0 {
            self.stuck.saturating_add(1)
        } else {
            0
        };
        if u64::from(self.stuck).saturating_mul(self.period) > PATIENCE.max(self.least) {
            return Err((Reason::NoMotion, u));
        }
        Ok(())
    }
}

/// The part of `value` beyond `tolerance` in either direction.
fn beyond(value: i64, tolerance: i64) -> f32 {
    let beyond = value.saturating_abs().saturating_sub(tolerance).max(0);
    (beyond * value.signum()) as f32
}

#[cfg(test)]
mod tests;
