//! Tracks a motor's parameters while it runs: command per speed, per acceleration and against friction, sample by sample.
//!
//! With the speed `w`, its derivative and the command `u` after the winding's lag,
//!
//! ```text
//! u = k_v w + k_a dw/dt + k_s sign(w) + offset
//! ```
//!
//! also holds for filtered signals: speed, its sign and the command go through the same two lags. The filtered speed is
//! differentiated, so that encoder steps do not bury the acceleration (state variable filters, Young 1981). Then least
//! squares with forgetting, with the covariance as `U D U'`, which stays positive in single precision (Bierman 1977,
//! Factorization Methods for Discrete Sequential Estimation, chapter V).

use crate::gains::sample_time;
use crate::real::one_minus_exp;
use crate::{Real, Refused};

/// Number of tracked parameters: `k_v`, `k_a`, `k_s`, `offset`.
pub const TRACKED: usize = 4;

/// Variance of an unknown parameter, in units of its scale.
const UNKNOWN: usize = 1_000_000;

/// Factor on the textbook's variance: the residuals are correlated for longer than the filters' lag.
const TOGETHER: usize = 4;

/// Standard deviations beyond the tolerance at which a parameter counts as moved.
const CLEAR: usize = 3;

/// Updates in a row that must agree.
const IN_A_ROW: u8 = 10;

/// The settings of a [`Tracker`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Listening<T> {
    /// Sample time \[s\].
    pub ts: T,
    /// Time constant of each of the two lags \[s\]: some 20 samples, but well below the motor's own time constant.
    pub smoothing: T,
    /// Lag of the current after the command \[s\]; 0 if unknown.
    pub lag: T,
    /// Time over which the past is forgotten \[s\].
    pub memory: T,
    /// The largest speed, in the unit of the speed: a scale for the arithmetic, not a limit.
    pub speed: T,
}

/// Parameters watched against a reference.
#[derive(Clone, Copy, Debug)]
struct Watch<T> {
    reference: [T; TRACKED],
    /// Allowed deviations, in the parameters' units.
    tolerance: [T; TRACKED],
    in_a_row: [u8; TRACKED],
}

/// Least squares with forgetting over filtered signals.
#[derive(Clone, Debug)]
pub struct Tracker<T> {
    ts: T,
    /// Weight of a new sample in a lag; and in the command's first lag.
    smoothing: T,
    lag: T,
    forget: T,
    every: usize,
    scales: [T; TRACKED],
    /// Speed, its sign, command and one through the first and the second lag.
    first: [T; 4],
    second: [T; 4],
    before: [T; 4],
    lagged: T,
    command: T,
    samples: usize,
    theta: [T; TRACKED],
    u: [[T; TRACKED]; TRACKED],
    d: [T; TRACKED],
    /// Exponentially forgotten mean of the squared prediction errors.
    squares: T,
    updates: usize,
    watch: Option<Watch<T>>,
}

impl<T: Real> Tracker<T> {
    /// A tracker without any knowledge.
    ///
    /// # Errors
    /// Times or a speed that are not above 0 and finite, a lag below 0, a memory that is not longer than the smoothing.
    pub fn new(of: Listening<T>) -> Result<Self, Refused> {
        sample_time(of.ts)?;
        for (name, value) in [
            ("smoothing", of.smoothing),
            ("memory", of.memory),
            ("speed", of.speed),
        ] {
            let holds = value > T::ZERO && value.is_finite();
            Refused::unless(holds, name, "a finite number above 0", value.to_f64())?;
        }
        let holds = of.lag >= T::ZERO && of.lag.is_finite();
        Refused::unless(
            holds,
            "lag",
            "a finite time of 0 s or more",
            of.lag.to_f64(),
        )?;
        let holds = of.memory > of.smoothing && of.smoothing >= of.ts;
        let expected = "at least a sample, and less than the memory";
        Refused::unless(holds, "smoothing", expected, of.smoothing.to_f64())?;
        // one update per time constant of the filters: in between there is hardly any new information
        let every = count_of(of.smoothing / of.ts);
        let step = T::from_count(every) * of.ts;
        let lag = if of.lag > T::ZERO {
            one_minus_exp(of.ts / of.lag)
        } else {
            T::ONE
        };
        let mut tracker = Self {
            ts: of.ts,
            smoothing: one_minus_exp(of.ts / of.smoothing),
            lag,
            forget: T::ONE - one_minus_exp(step / of.memory),
            every,
            scales: [of.speed, of.speed / of.memory, T::ONE, T::ONE],
            first: [T::ZERO; 4],
            second: [T::ZERO; 4],
            before: [T::ZERO; 4],
            lagged: T::ZERO,
            command: T::ZERO,
            samples: 0,
            theta: [T::ZERO; TRACKED],
            u: [[T::ZERO; TRACKED]; TRACKED],
            d: [T::ZERO; TRACKED],
            squares: T::ZERO,
            updates: 0,
            watch: None,
        };
        tracker.reset();
        Ok(tracker)
    }

    /// Forgets everything except what it watches.
    pub fn reset(&mut self) {
        self.first = [T::ZERO; 4];
        self.second = [T::ZERO; 4];
        self.before = [T::ZERO; 4];
        (self.lagged, self.command) = (T::ZERO, T::ZERO);
        (self.samples, self.updates) = (0, 0);
        self.theta = [T::ZERO; TRACKED];
        self.d = [T::from_count(UNKNOWN); TRACKED];
        self.squares = T::ZERO;
        for (i, row) in self.u.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                *entry = if i == j { T::ONE } else { T::ZERO };
            }
        }
        if let Some(watch) = &mut self.watch {
            watch.in_a_row = [0; TRACKED];
        }
    }

    /// Takes the mean speed over the last sample, and the command that acts from now on.
    ///
    /// A sample that is not finite is skipped, and the filters start over.
    pub fn step(&mut self, u: T, y: T) {
        if !(u.is_finite() && y.is_finite()) {
            self.samples = 0;
            return;
        }
        let sign = if y > T::ZERO {
            T::ONE
        } else if y < T::ZERO {
            T::ZERO - T::ONE
        } else {
            T::ZERO
        };
        self.lagged += self.lag * (self.command - self.lagged);
        self.command = u;
        let signals = [y, sign, self.lagged, T::ONE];
        if self.samples == 0 {
            (self.first, self.second) = (signals, signals);
        }
        self.before = self.second;
        for ((first, second), x) in self.first.iter_mut().zip(&mut self.second).zip(signals) {
            *first += self.smoothing * (x - *first);
            *second += self.smoothing * (*first - *second);
        }
        self.samples = if self.samples < usize::MAX {
            self.samples + 1
        } else {
            1
        };
        // six time constants, until everything before the start has faded
        if self.samples > 6 * self.every && self.samples.is_multiple_of(self.every) {
            self.update();
        }
    }

    /// One step of least squares with forgetting, on signals in units of their scales.
    fn update(&mut self) {
        let [speed, sign, command, one] = self.second;
        let [speed_before, sign_before, command_before, _] = self.before;
        let [lagged, ..] = self.first;
        let half = T::ONE / T::from_count(2);
        let raw = [
            half * (speed + speed_before),
            // the change of the last lag in this sample, without the difference of two large numbers
            self.smoothing * (lagged - speed_before) / self.ts,
            half * (sign + sign_before),
            one,
        ];
        let mut phi = [T::ZERO; TRACKED];
        for ((p, r), scale) in phi.iter_mut().zip(raw).zip(self.scales) {
            *p = r / scale;
        }
        let mut error = half * (command + command_before);
        for (p, t) in phi.iter().zip(self.theta) {
            error = error - *p * t;
        }
        let (gain, size) = self.gain(&phi);
        for (t, g) in self.theta.iter_mut().zip(gain) {
            *t += g * error / size;
        }
        // the first errors reflect missing knowledge
        self.updates = if self.updates < usize::MAX {
            self.updates + 1
        } else {
            self.updates
        };
        if self.updates > 2 * TRACKED {
            let fresh = T::ONE - self.forget;
            let weight = if self.squares > T::ZERO {
                fresh
            } else {
                T::ONE
            };
            let square = error * error * self.forget / size;
            self.squares += weight * (square - self.squares);
        }
        self.look();
    }

    /// Bierman's update of `U` and `D`; returns the gain and its divisor.
    fn gain(&mut self, phi: &[T; TRACKED]) -> ([T; TRACKED], T) {
        let mut gain = [T::ZERO; TRACKED];
        let mut size = self.forget;
        let unknown = T::from_count(UNKNOWN);
        for j in 0..TRACKED {
            // f = U' phi, v = D f
            let mut f = T::ZERO;
            for (row, p) in self.u.iter().zip(phi).take(j + 1) {
                f += row.get(j).copied().unwrap_or(T::ZERO) * *p;
            }
            let Some(d) = self.d.get_mut(j) else { break };
            let v = *d * f;
            let before = size;
            size += f * v;
            // forgetting alone would let directions without excitation grow without bound
            let next = *d * before / (size * self.forget);
            *d = if next < unknown { next } else { unknown };
            let turn = T::ZERO - f / before;
            for (row, g) in self.u.iter_mut().zip(&mut gain).take(j) {
                if let Some(entry) = row.get_mut(j) {
                    let old = *entry;
                    *entry = old + *g * turn;
                    *g += old * v;
                }
            }
            if let Some(g) = gain.get_mut(j) {
                *g = v;
            }
        }
        (gain, size)
    }

    /// `k_v`, `k_a`, `k_s` and `offset`, in commands per unit of speed, commands per unit of acceleration, and commands.
    pub fn estimate(&self) -> [T; TRACKED] {
        let mut found = self.theta;
        for (t, scale) in found.iter_mut().zip(self.scales) {
            *t = *t / scale;
        }
        found
    }

    /// Their variances; infinite while nothing is known.
    pub fn variance(&self) -> [T; TRACKED] {
        if self.updates <= 4 * TRACKED {
            return [T::INFINITY; TRACKED];
        }
        let factor = T::from_count(TOGETHER) * self.squares;
        let mut found = [T::ZERO; TRACKED];
        for ((v, row), scale) in found.iter_mut().zip(&self.u).zip(self.scales) {
            for (entry, d) in row.iter().zip(&self.d) {
                *v += *entry * *entry * *d;
            }
            *v = *v * factor / (scale * scale);
        }
        found
    }

    /// From now on, watches whether a parameter moves away from its reference by more than its tolerance, both in the
    /// units of [`estimate`](Self::estimate). The estimate itself is a good reference once its variance is small.
    ///
    /// # Errors
    /// A reference that is not finite, a tolerance that is not above 0; an infinite one switches a parameter off.
    pub fn watch(
        &mut self,
        reference: [T; TRACKED],
        tolerance: [T; TRACKED],
    ) -> Result<(), Refused> {
        for (value, allowed) in reference.iter().zip(tolerance) {
            let expected = "finite numbers";
            Refused::unless(value.is_finite(), "reference", expected, value.to_f64())?;
            let expected = "numbers above 0";
            Refused::unless(allowed > T::ZERO, "tolerance", expected, allowed.to_f64())?;
        }
        self.watch = Some(Watch {
            reference,
            tolerance,
            in_a_row: [0; TRACKED],
        });
        Ok(())
    }

    fn look(&mut self) {
        let (estimate, variance) = (self.estimate(), self.variance());
        let Some(watch) = &mut self.watch else { return };
        let clear = T::from_count(CLEAR * CLEAR);
        let moved = estimate
            .iter()
            .zip(variance)
            .zip(watch.reference.iter().zip(watch.tolerance))
            .zip(&mut watch.in_a_row);
        for (((value, variance), (reference, allowed)), count) in moved {
            let off = *value - *reference;
            let beyond = (if off < T::ZERO { T::ZERO - off } else { off }) - allowed;
            let far = beyond > T::ZERO && beyond * beyond > clear * variance;
            *count = if far { count.saturating_add(1) } else { 0 };
        }
    }

    /// Which parameters have moved: beyond their tolerance by three standard deviations for ten updates in a row.
    pub fn moved(&self) -> [bool; TRACKED] {
        self.watch.map_or([false; TRACKED], |watch| {
            watch.in_a_row.map(|count| count >= IN_A_ROW)
        })
    }
}

/// The integer part of a number of samples from 1 to 1,000, without the library's conversion, which may panic.
fn count_of<T: Real>(samples: T) -> usize {
    (1..1000)
        .take_while(|&n| T::from_count(n) <= samples)
        .last()
        .unwrap_or(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const LISTENING: Listening<f64> = Listening {
        ts: 0.001,
        smoothing: 0.02,
        lag: 0.0,
        memory: 0.8,
        speed: 300.0,
    };

    /// `k_a dw/dt = u - k_v w - k_s sign(w) - offset`, ten steps a sample; mean speeds and commands.
    fn motor(n: usize, k_a: impl Fn(usize) -> f64, quantum: f64) -> Vec<(f64, f64)> {
        let (mut w, mut angle, mut last, mut seed) = (0.0_f64, 0.0_f64, 0.0_f64, 1_u64);
        let mut u = 0.0;
        (0..n)
            .map(|k| {
                if k % 240 == 0 {
                    seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    u = 16.0 * ((seed >> 33) as f64 / f64::from(1_u32 << 31)) - 8.0;
                }
                let shown = if quantum > 0.0 {
                    (angle / quantum).floor() * quantum
                } else {
                    angle
                };
                let y = (shown - last) / 0.001;
                last = shown;
                for _ in 0..10 {
                    let free = w + 1e-4 * (u - 0.02 * w - 0.05) / k_a(k);
                    let most = 1e-4 * 0.3 / k_a(k);
                    let next = if free.abs() <= most {
                        0.0
                    } else {
                        free - most * free.signum()
                    };
                    angle += 1e-4 * 0.5 * (w + next);
                    w = next;
                }
                (u, y)
            })
            .collect()
    }

    fn followed<T: Real>(
        mut tracker: Tracker<T>,
        samples: &[(f64, f64)],
        number: impl Fn(f64) -> T,
    ) -> Tracker<T> {
        for &(u, y) in samples {
            tracker.step(number(u), number(y));
        }
        tracker
    }

    #[test]
    fn it_finds_a_motor_and_says_how_sure_it_is() {
        for quantum in [0.0, core::f64::consts::TAU / 1572.0] {
            let samples = motor(8000, |_| 0.006, quantum);
            let found = followed(Tracker::new(LISTENING).unwrap(), &samples, |x| x);
            let truth = [0.02, 0.006, 0.3, 0.05];
            for ((value, variance), (truth, most)) in found
                .estimate()
                .iter()
                .zip(found.variance())
                .zip(truth.iter().zip([0.02, 0.01, 0.1, 0.3]))
            {
                assert!((value / truth - 1.0).abs() < most, "{value} {truth}");
                let sd = variance.sqrt();
                assert!(
                    (value - truth).abs() < 5.0 * sd + 2e-3 * truth,
                    "{value} {truth} {sd}"
                );
                assert!(sd < 0.3 * truth, "{sd}");
            }
        }
    }

    #[test]
    fn single_precision_follows_as_well() {
        let samples = motor(60_000, |_| 0.006, core::f64::consts::TAU / 1572.0);
        let double = followed(Tracker::new(LISTENING).unwrap(), &samples, |x| x);
        let listening = Listening {
            ts: 0.001_f32,
            smoothing: 0.02,
            lag: 0.0,
            memory: 0.8,
            speed: 300.0,
        };
        let single = followed(Tracker::new(listening).unwrap(), &samples, |x| x as f32);
        let sure = double.variance();
        for ((a, b), variance) in single.estimate().iter().zip(double.estimate()).zip(sure) {
            assert!((f64::from(*a) - b).powi(2) < variance, "{a} {b} {variance}");
        }
    }

    #[test]
    fn a_tenth_more_inertia_is_seen_within_two_seconds_and_nothing_else() {
        let quantum = core::f64::consts::TAU / 1572.0;
        let samples = motor(20_000, |k| if k < 10_000 { 0.006 } else { 0.0066 }, quantum);
        let mut tracker = Tracker::new(LISTENING).unwrap();
        let mut seen = None;
        for (k, &(u, y)) in samples.iter().enumerate() {
            tracker.step(u, y);
            if k == 5000 {
                let now = tracker.estimate();
                let allowed = [0.05 * now[0], 0.03 * now[1], 0.3 * now[2], f64::INFINITY];
                tracker.watch(now, allowed).unwrap();
            }
            let [k_v, k_a, k_s, offset] = tracker.moved();
            assert!(!(k_s || offset), "{k}");
            assert!(k >= 10_000 || !(k_v || k_a), "{k}");
            if k_a && seen.is_none() {
                seen = Some(k - 10_000);
            }
        }
        assert!(seen.is_some_and(|samples| samples < 2000), "{seen:?}");
    }

    #[test]
    fn standstill_and_gaps_destroy_nothing() {
        let samples = motor(8000, |_| 0.006, 0.0);
        let mut tracker = followed(Tracker::new(LISTENING).unwrap(), &samples, |x| x);
        let before = tracker.estimate();
        for _ in 0..200_000 {
            tracker.step(0.1, 0.0);
        }
        assert!(tracker.estimate().iter().all(|v| v.is_finite()));
        tracker.step(f64::NAN, 0.0);
        tracker.step(0.0, f64::INFINITY);
        let again = followed(tracker, &samples, |x| x).estimate();
        for (a, b) in again.iter().zip(before) {
            assert!((a / b - 1.0).abs() < 0.02, "{a} {b}");
        }
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        for change in [
            |l: &mut Listening<f64>| l.ts = 0.0,
            |l: &mut Listening<f64>| l.smoothing = 2.0,
            |l: &mut Listening<f64>| l.lag = -1.0,
            |l: &mut Listening<f64>| l.memory = f64::NAN,
            |l: &mut Listening<f64>| l.speed = 0.0,
        ] {
            let mut listening = LISTENING;
            change(&mut listening);
            assert!(Tracker::new(listening).is_err());
        }
        let mut tracker = Tracker::new(LISTENING).unwrap();
        assert!(tracker.watch([f64::NAN; 4], [1.0; 4]).is_err());
        assert!(tracker.watch([1.0; 4], [0.0; 4]).is_err());
    }
}
