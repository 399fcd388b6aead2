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
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

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
    fn a_watch_trips_on_speed_on_a_lost_encoder_and_on_swinging() {
        let limits = Limits {
            speed: 1000.0,
            ..FREE
        };
        let watch = || Watch::new(1e-3, 1500.0, limits, Some((-20.0, 20.0)));
        // 25 counts a millisecond are 1000 RPM; of 200 counts one is the encoder's step; a counter may wrap
        let mut turning = watch();
        let turned = |k: i32| (i32::MAX - 200).wrapping_add(26 * k);
        let fast = (0..20).position(|k| turning.take(turned(k), 1).is_err());
        assert_eq!(fast, Some(8));
        let said = turning.take(turned(9), 1).err();
        assert!(said.is_some_and(|(why, rpm)| why == Reason::Speed && (rpm - 1035.0).abs() < 0.01));
        // 60 counts in a millisecond are far more: exact samples show it at once, others in their mean
        let leaps = |k: i32| if k < 5 { 0 } else { 60 * (k - 4) };
        let (mut exact, mut late) = (watch(), watch());
        let position = (0..20).position(|k| exact.take_on_time(leaps(k), 1).is_err());
        assert_eq!(position, Some(5));
        let position = (0..20).position(|k| late.take(leaps(k), 1).is_err());
        assert_eq!(position, Some(8));
        late.forget();
        assert_eq!(late.take(9000, 1), Ok(()));
        // one step of a sensor with 6 steps a turn is 1,250 RPM in 8 samples of a millisecond
        let mut coarse = Watch::new(1e-3, 6.0, limits, None);
        assert!((0..2000).all(|k| coarse.take(k / 12, 1).is_ok()));
        let mut lost = watch();
        let mut stands = |u| lost.take(7, 1).is_err() || lost.sent(u).is_err();
        let stuck = (0..1000).position(|_| stands(15.0));
        assert_eq!(stuck, Some(250));
        assert!(lost.at_rest());
        let mut swings = watch();
        let ended = (0..1000).find_map(|k| {
            assert_eq!(swings.take(k, 1), Ok(()));
            swings.sent(if k % 40 < 20 { 20.0 } else { -20.0 }).err()
        });
        assert!(matches!(
            ended,
            Some(Alarm::Trip((Reason::Swinging, hertz))) if (hertz - 25.0).abs() < 1.0
        ));
        // at a period of a second ten samples pass before a motor counts as standing
        let mut slow = Watch::new(1.0, 1500.0, limits, None);
        let mut stands = |u| slow.take(7, 1).is_err() || slow.sent(u).is_err();
        let stuck = (0..100).position(|_| stands(15.0));
        assert_eq!(stuck, Some(10));
    }

    /// The sample of 200 at which a watch alarms, of an encoder that counts `counts(k)` under `u(k)`.
    fn alarmed(counts: impl Fn(i32) -> i32, u: impl Fn(i32) -> f32) -> Option<(i32, Alarm)> {
        let limits = Limits {
            speed: 4000.0,
            ..FREE
        };
        let mut watch = Watch::new(1e-3, 1500.0, limits, None);
        (0..200).find_map(|k| {
            assert_eq!(watch.take(counts(k), 1), Ok(()));
            watch.sent(u(k)).err().map(|alarm| (k, alarm))
        })
    }

    #[test]
    fn counts_that_stop_halve_or_turn_within_a_sample_alarm_after_ten() {
        // 20 counts a sample until sample 100, then `after` a sample; 800 RPM
        let faulty = |after: i32| move |k: i32| 20 * k.min(100) + after * (k - 100).max(0);
        for after in [0, 10, -20] {
            // a loop pushes harder, or a steady command stays
            for harder in [0.0, 0.1] {
                let u = |k: i32| 4.0 + harder * (k - 100).max(0) as f32;
                let found = alarmed(faulty(after), u);
                assert_eq!(found, Some((110, Alarm::Lost(u(110)))), "{after}");
            }
            // a command that falls with the speed, or brakes, explains it
            assert_eq!(
                alarmed(faulty(after), |k| if k < 98 { 4.0 } else { 2.0 }),
                None
            );
            assert_eq!(alarmed(faulty(after), |_| -4.0), None);
        }
        // what a shaft can do: lose a third, speed up, stop within 10 ms, or stand for less than that
        let brakes =
            |k: i32| 20 * k.min(100) + (0..(k - 100).clamp(0, 10)).map(|i| 18 - 2 * i).sum::<i32>();
        let pauses = |k: i32| 20 * k.min(100) + 20 * (k - 108).max(0);
        assert_eq!(alarmed(faulty(13), |_| 4.0), None);
        assert_eq!(alarmed(faulty(60), |_| 4.0), None);
        assert_eq!(alarmed(brakes, |_| 4.0), None);
        // a turned command brakes with a quarter of the speed a sample
        let turned = |k: i32| {
            if k < 100 {
                20 * k
            } else {
                2000 + [15, 26, 34, 39, 42, 42, 39, 33, 24, 12, -3, -20, -40]
                    [(k as usize - 100).min(12)]
            }
        };
        assert_eq!(alarmed(turned, |_| 4.0), None);
        assert_eq!(alarmed(pauses, |_| 4.0), None);
        // a creeping shaft may be held by friction: 3 counts a sample are 120 RPM of 4,000
        assert_eq!(alarmed(|k| 3 * k.min(100), |_| 4.0), None);
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

    /// The largest detected acceleration of a swinging speed, relative to its largest true one.
    ///
    /// `size` is the true acceleration [RPM/s], `phase` the part of a period at the first sample.
    fn seen(counts_per_rev: f64, frequency: f64, size: f64, base: f64, phase: f64) -> f64 {
        let mut guard = Guard::new(1000, 1e-3, counts_per_rev as f32);
        let omega = core::f64::consts::TAU * frequency;
        let turns = size / 60.0 / (omega * omega);
        let count = |k: i32| {
            let t = 1e-3 * f64::from(k);
            let angle = omega * t + core::f64::consts::TAU * phase;
            (counts_per_rev * (base / 60.0 * t + turns * angle.sin())).floor() as i32
        };
        // the first second: the history is full, and a swing of 1 Hz has passed its maximum
        let samples = (0..1100).map(|k| {
            guard.take(count(k));
            if k < 40 {
                0.0
            } else {
                guard.acceleration().abs()
            }
        });
        f64::from(samples.fold(0.0, f32::max)) / size
    }

    /// Frequencies from 1 to 400 Hz, including the blind one and fractions of the sample rate.
    fn frequencies() -> impl Iterator<Item = f64> {
        let odd = [
            62.5,
            83.333_333,
            125.0,
            142.857,
            166.666_667,
            333.333_333,
            0.5 * 62.5,
        ];
        (1..=400).map(f64::from).chain(odd)
    }

    #[test]
    fn sees_two_thirds_of_any_acceleration_from_1_to_400_hz_and_no_more_than_all() {
        // A swing so large that the encoder's steps do not matter.
        let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
        for frequency in frequencies() {
            for phase in 0..8 {
                // at most 2000 RPM in either direction: beyond it the counter exceeds what a test counts
                let size = (2000.0 * core::f64::consts::TAU * frequency).min(5e6);
                let ratio = seen(1572e3, frequency, size, 500.0, f64::from(phase) / 16.0);
                assert!(ratio > 1.0 / 1.5 && ratio < 1.02, "{frequency} Hz: {ratio}");
                (least, most) = (least.min(ratio), most.max(ratio));
            }
        }
        std::println!("seen over true: {least:.3} to {most:.3}");
    }

    #[test]
    fn sees_a_shaft_that_swings_at_62_hz_on_the_encoder_of_the_machine() {
        // 138,000 RPM/s at 62.5 Hz, of which only 3,600 used to be detected
        for phase in 0..32 {
            let ratio = seen(1572.0, 62.5, 138_000.0, 300.0, f64::from(phase) / 64.0);
            assert!(ratio > 1.0 / 1.5 && ratio < 1.02, "{ratio}");
        }
        for frequency in 1..=80 {
            let ratio = seen(1572.0, frequency.into(), 138_000.0, 300.0, 0.1);
            assert!(ratio > 1.0 / 1.5 && ratio < 1.02, "{frequency} Hz: {ratio}");
        }
    }

    proptest! {
        #[test]
        fn steps_of_the_encoder_are_no_acceleration(
            counts_per_rev in 4.0..5000.0_f64, speed in -6000.0..6000.0_f64, phase in 0.0..1.0_f64, wobble in 0.0..20_000.0_f64,
            frequency in 1.0..400.0_f64,
        ) {
            // the detected value is at most the true one plus the step of the widest span
            let mut guard = Guard::new(1000, 1e-3, counts_per_rev as f32);
            let omega = core::f64::consts::TAU * frequency;
            let turns = wobble / 60.0 / (omega * omega);
            for k in 0..200 {
                let t = 1e-3 * f64::from(k);
                let place = speed / 60.0 * t + turns * (omega * t).sin();
                guard.take((counts_per_rev * place + phase).floor() as i32);
                if k >= 40 {
                    let step = 2.0 * 60.0 / (128e-6 * counts_per_rev);
                    let most = (wobble * 1.02).max(wobble + step);
                    prop_assert!(f64::from(guard.acceleration().abs()) <= most * 1.0001, "{}", guard.acceleration());
                }
            }
        }

        #[test]
        fn a_command_that_does_not_reach_both_limits_may_swing(
            u in prop::collection::vec(-8.9_f32..10.0, 400), high in 10.0_f32..20.0,
        ) {
            let mut guard = guard();
            guard.take(0);
            for u in u {
                prop_assert_eq!(guard.expect_calm(-high, high, u), Ok(()));
            }
        }
    }

    /// The sample at which a square wave of `half` samples a side trips, and the reported frequency.
    fn swung(half: u32, size: f32) -> Option<(u32, f32)> {
        let mut guard = guard();
        guard.begin();
        (0..20 * half).find_map(|k| {
            let u = if (k / half).is_multiple_of(2) {
                size
            } else {
                -size
            };
            guard.expect_calm(-10.0, 10.0, u).err().map(|(reason, f)| {
                assert_eq!(reason, Reason::Swinging);
                (k, f)
            })
        })
    }

    #[test]
    fn swinging_between_the_limits_trips_and_its_frequency_is_named() {
        for half in [1, 8, 60, 250] {
            let (at, frequency) = swung(half, 9.5).unwrap();
            assert_eq!(at, 8 * half);
            assert!(
                (frequency * 2e-3 * half as f32 - 1.0).abs() < 1e-5,
                "{frequency}"
            );
        }
        assert_eq!(swung(251, 10.0), None);
        assert_eq!(swung(8, 8.9), None);
        let mut guard = guard();
        // a command that stays at one limit, or returns to it, does not swing
        let calm: Vec<_> = (0..400)
            .map(|k| guard.expect_calm(0.0, 10.0, [10.0, 5.0][k % 2]))
            .collect();
        assert!(calm.iter().all(Result::is_ok));
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
