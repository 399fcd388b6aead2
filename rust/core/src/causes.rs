//! What has changed in a machine: finds the single change of a simple motor that explains a run best.
//!
//! The motor is of first order with delay, Coulomb friction and a constant load,
//! `T w' = K (u(t - L) + bias - friction sgn w) - w`, at rest before each run. It is fitted to earlier runs or, if
//! there are none, to the run itself before the change. Then one thing changes at one sample ([`Change`]): each pair of
//! change and sample is simulated and compared with the counts, and the smallest error names the cause. The simulation
//! uses the recorded command, so a loop need not be known.

use crate::least_squares::{self, Residuals, Settings};
use crate::{Error, Monitor, Result};

/// One run from rest: commands, and the counts read before each of them acts.
#[derive(Clone, Copy, Debug)]
pub struct Run<'a> {
    /// Command \[u\].
    pub u: &'a [f64],
    /// Counts of the encoder.
    pub counts: &'a [f64],
}

/// A possible change, with one value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// The command acts with this factor: below 0 its sign is reversed, at 0 nothing acts.
    Gain,
    /// This command acts whatever is commanded.
    Stuck,
    /// A load of this size \[u\] sets in.
    Load,
    /// The encoder counts this factor of the motion: below 0 its sign is reversed, at 0 it is lost.
    Counts,
    /// The counts jump once by this number.
    Jump,
    /// The response is delayed by this additional time \[s\].
    Delay,
    /// The time constant is this many times as long, at the same gain.
    Inertia,
    /// Friction grows by this command \[u\].
    Friction,
}

impl Change {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Gain,
        Self::Stuck,
        Self::Load,
        Self::Counts,
        Self::Jump,
        Self::Delay,
        Self::Inertia,
        Self::Friction,
    ];

    /// The name used in Python.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gain => "gain",
            Self::Stuck => "stuck",
            Self::Load => "load",
            Self::Counts => "counts",
            Self::Jump => "jump",
            Self::Delay => "delay",
            Self::Inertia => "inertia",
            Self::Friction => "friction",
        }
    }
}

/// The motor before the change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motor {
    /// Steady speed per command \[RPM/u\].
    pub gain: f64,
    /// Time constant \[s\].
    pub lag: f64,
    /// Delay of the command \[s\].
    pub delay: f64,
    /// Command that friction uses up \[u\].
    pub friction: f64,
    /// Command that acts on its own \[u\].
    pub bias: f64,
}

/// A change that explains the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Finding {
    /// What changed.
    pub change: Change,
    /// See [`Change`].
    pub value: f64,
    /// When it happened \[s\].
    pub at: f64,
    /// Rms error of the speed with the change, over the whole run \[RPM\].
    pub error: f64,
    /// The motor before it.
    pub motor: Motor,
}

/// The result of the search.
#[derive(Clone, Debug)]
pub struct Causes {
    /// The motor without any change, fitted to earlier runs or to this one.
    pub motor: Motor,
    /// Its rms error on the earlier runs, as a share of their rms speed; NaN without any.
    pub unsure: f64,
    /// The same for a motor that turns against its command, on this run.
    pub backwards: f64,
    /// Rms error of the speed of the run without a change \[RPM\].
    pub error: f64,
    /// What the run adds to the errors of earlier runs if one motor is fitted to all, as an rms over the run \[RPM\];
    /// NaN without earlier runs.
    pub together: f64,
    /// Rms of the speed itself \[RPM\].
    pub size: f64,
    /// The part of the error that comes from rounding to counts \[RPM\].
    pub rounding: f64,
    /// The changes, each at its best sample and value, the smallest error first.
    pub findings: Vec<Finding>,
}

/// Most blocks of samples into which a run is averaged.
const BLOCKS: usize = 2000;
/// Number of samples tried as the time of a change.
const PLACES: usize = 40;
/// How often the steps around the best are halved, and the share to which the squares must fall for another round before that.
const HALVINGS: usize = 10;
const FALLS: f64 = 0.999;
/// The number of samples tried if a motor is fitted up to each of them.
const OWN_PLACES: usize = 12;
/// A motor is fitted to at least this many blocks, and must explain them within this share of their speed.
const FEWEST: usize = 12;
const UNSURE: f64 = 0.1;
/// Error of each block, as a share of the largest speed, that is charged for a load of the largest command.
const UNLIKELY: f64 = 1e-3;

/// Names the changes that explain `run`; `before` are earlier runs of the sound machine, `most` is its largest command
/// \[u\], infinite if unknown: beyond it no stage can be stuck.
///
/// # Errors
/// `ErrorKind::Data` for columns of different lengths, with fewer than three samples or not finite;
/// `ErrorKind::Setting` for numbers that are not above zero.
pub fn causes(
    before: &[Run<'_>],
    run: Run<'_>,
    ts: f64,
    counts_per_rev: f64,
    most: f64,
    monitor: &Monitor,
) -> Result<Causes> {
    for (name, value) in [("Ts", ts), ("counts_per_rev", counts_per_rev)] {
        if !(value.is_finite() && value > 0.0) {
            return Err(Error::setting(format!(
                "expected {name} above 0, got {value}"
            )));
        }
    }
    let known = before
        .iter()
        .map(|earlier| Blocks::new(*earlier, ts, counts_per_rev))
        .collect::<Result<Vec<_>>>()?;
    let blocks = Blocks::new(run, ts, counts_per_rev)?;
    let whole = std::slice::from_ref(&blocks);
    let earlier = if known.is_empty() { whole } else { &known };
    let motor = fitted(earlier, &LAGS, 1.0, monitor)?;
    let without = blocks.squares(&motor, None);
    // if one motor for all runs fits as well as a change does, nothing has changed
    let together = if known.is_empty() {
        f64::NAN
    } else {
        let all: Vec<Blocks> = known.iter().chain(whole).cloned().collect();
        let one = fitted(&all, &LAGS, 1.0, monitor)?;
        (squares(&all, &one) - squares(&known, &motor)).max(0.0)
    };
    let mut tried = Vec::new();
    if known.is_empty() {
        for place in places(blocks.len(), OWN_PLACES) {
            if place >= FEWEST && blocks.len() - place >= 2 && !monitor.stopped() {
                let first = [blocks.until(place)];
                let motor = fitted(&first, &LAGS[1..3], 1.0, monitor)?;
                // if the motor did not move, or not long enough, or not like such a motor, it says nothing about what follows
                let is_long = 2.0 * motor.lag < place as f64 * blocks.step;
                if is_long && unexplained(&first, &motor) <= UNSURE {
                    tried.extend(considered(&blocks, &motor, &[place]));
                }
            }
        }
    } else {
        tried = considered(&blocks, &motor, &places(blocks.len(), PLACES));
    }
    for candidate in &mut tried {
        candidate.refine(&blocks, most, monitor);
    }
    tried.sort_by(|a, b| a.squares.total_cmp(&b.squares));
    let best = Change::ALL
        .iter()
        .filter_map(|&change| tried.iter().find(|c| c.change == change));
    let rms = |squares: f64| (squares / blocks.len() as f64).sqrt();
    let mut findings: Vec<Finding> = best
        .map(|c| Finding {
            change: c.change,
            value: c.value,
            at: c.at as f64 * blocks.step,
            error: rms(c.squares),
            motor: c.motor,
        })
        .collect();
    findings.sort_by(|a, b| a.error.total_cmp(&b.error));
    let backwards = fitted(whole, &LAGS, -1.0, monitor)?;
    Ok(Causes {
        motor,
        unsure: unexplained(&known, &motor),
        backwards: unexplained(whole, &backwards),
        error: rms(without),
        together: rms(together),
        size: rms(blocks.energy()),
        // a block's speed is the difference of two roundings of variance 1/12
        rounding: blocks.per_count / 6.0_f64.sqrt(),
        findings,
    })
}

/// Sum of the squares of a motor's errors over runs.
fn squares(runs: &[Blocks], motor: &Motor) -> f64 {
    runs.iter().map(|r| r.squares(motor, None)).sum()
}

/// Rms error of a motor on runs as a share of their rms speed; NaN if nothing moves.
fn unexplained(runs: &[Blocks], motor: &Motor) -> f64 {
    (squares(runs, motor) / runs.iter().map(Blocks::energy).sum::<f64>()).sqrt()
}

/// `many` numbers spread evenly from 0 to below `end`, without repetition.
fn places(end: usize, many: usize) -> Vec<usize> {
    let mut found: Vec<usize> = (0..many).map(|i| i * end / many).collect();
    found.dedup();
    found
}

// --- Runs in blocks -------------------------------------------------------------------------------------------------------

/// A run as mean speeds over blocks of samples, with the integral of its command, which gives the mean over any span.
#[derive(Clone, Debug)]
struct Blocks {
    /// Mean speeds \[RPM\].
    speed: Vec<f64>,
    /// Integral of the command up to each sample \[u samples\].
    integral: Vec<f64>,
    /// Samples in a block.
    samples: usize,
    ts: f64,
    /// Length of a block \[s\].
    step: f64,
    /// RPM of one count in a block.
    per_count: f64,
    /// Largest command \[u\].
    largest: f64,
}

impl Blocks {
    fn new(run: Run<'_>, ts: f64, counts_per_rev: f64) -> Result<Self> {
        let Run { u, counts } = run;
        if u.len() != counts.len() || u.len() < 3 {
            return Err(Error::data(format!(
                "expected three samples or more, a count for each command, got {} commands and {} counts",
                u.len(),
                counts.len()
            )));
        }
        if !u.iter().chain(counts).all(|x| x.is_finite()) {
            return Err(Error::data("expected finite commands and counts"));
        }
        let samples = (u.len() - 1).div_ceil(BLOCKS);
        let step = samples as f64 * ts;
        let per_count = 60.0 / (counts_per_rev * step);
        // the last sample must be included: the run may have ended because of it
        let first = (u.len() - 1) % samples;
        let (u, counts) = (&u[first..], &counts[first..]);
        let ends: Vec<f64> = counts.iter().step_by(samples).copied().collect();
        let mut integral = vec![0.0];
        for value in u {
            integral.push(integral[integral.len() - 1] + value);
        }
        Ok(Self {
            speed: ends.windows(2).map(|w| per_count * (w[1] - w[0])).collect(),
            integral,
            samples,
            ts,
            step,
            per_count,
            largest: u.iter().fold(0.0, |a: f64, x| a.max(x.abs())),
        })
    }

    fn len(&self) -> usize {
        self.speed.len()
    }

    /// Sum of the squares of its speeds.
    fn energy(&self) -> f64 {
        self.speed.iter().map(|y| y * y).sum()
    }

    /// The first `end` blocks.
    fn until(&self, end: usize) -> Self {
        Self {
            speed: self.speed[..end].to_vec(),
            ..self.clone()
        }
    }

    /// Mean command in block `k` of a command delayed by `delay` \[s\].
    fn command(&self, k: usize, delay: f64) -> f64 {
        let at = |sample: f64| {
            let sample = sample.clamp(0.0, (self.integral.len() - 1) as f64);
            let whole = (sample as usize).min(self.integral.len() - 2);
            let (low, high) = (self.integral[whole], self.integral[whole + 1]);
            low + (sample - whole as f64) * (high - low)
        };
        let start = (k * self.samples) as f64 - delay / self.ts;
        (at(start + self.samples as f64) - at(start)) / self.samples as f64
    }

    /// Simulates the motor, with a change from a block on; passes each block's error to `each`.
    fn simulate(
        &self,
        motor: &Motor,
        change: Option<(Change, f64, usize)>,
        mut each: impl FnMut(f64),
    ) {
        // the share that an exponential keeps over a block, and its mean over the block
        let over_a_block = |lag: f64| {
            let decay = self.step / lag;
            let mean = if decay > 1e-6 {
                -(-decay).exp_m1() / decay
            } else {
                1.0
            };
            ((-decay).exp(), mean)
        };
        let healthy = (motor.delay, motor.friction, over_a_block(motor.lag));
        let changed = match change {
            Some((Change::Delay, value, _)) => (motor.delay + value, healthy.1, healthy.2),
            Some((Change::Friction, value, _)) => (healthy.0, motor.friction + value, healthy.2),
            Some((Change::Inertia, value, _)) => {
                (healthy.0, healthy.1, over_a_block(motor.lag * value))
            }
            _ => healthy,
        };
        let mut turning = 0.0;
        for (k, measured) in self.speed.iter().enumerate() {
            let now = change.filter(|&(_, _, at)| k >= at);
            let (delay, friction, (kept, mean)) = if now.is_some() { changed } else { healthy };
            let mut drive = self.command(k, delay);
            match now {
                Some((Change::Gain, value, _)) => drive *= value,
                Some((Change::Stuck, value, _)) => drive = value,
                Some((Change::Load, value, _)) => drive += value,
                _ => {}
            }
            drive += motor.bias;
            // friction holds a standing shaft until the drive exceeds it, and never reverses its motion
            let against = if turning * motor.gain != 0.0 {
                friction * (turning * motor.gain).signum()
            } else {
                drive.clamp(-friction, friction)
            };
            let target = motor.gain * (drive - against);
            let mut next = target + (turning - target) * kept;
            let mut speed = target + (turning - target) * mean;
            if next * turning < 0.0 && drive.abs() <= friction {
                next = 0.0;
                speed = 0.5 * turning;
            }
            turning = next;
            match now {
                Some((Change::Counts, value, _)) => speed *= value,
                Some((Change::Jump, value, at)) if k == at => speed += value * self.per_count,
                _ => {}
            }
            each(measured - speed);
        }
    }

    fn squares(&self, motor: &Motor, change: Option<(Change, f64, usize)>) -> f64 {
        let mut sum = 0.0;
        self.simulate(motor, change, |error| sum += error * error);
        sum
    }
}

// --- The motor ------------------------------------------------------------------------------------------------------------

/// Runs to which a motor is fitted: parameters `gain`, `ln lag`, `delay`, `friction`, `bias`, scaled to about 1.
struct Fit<'a> {
    runs: &'a [Blocks],
    /// Approximate gain \[RPM/u\], largest command \[u\].
    gain: f64,
    largest: f64,
}

impl Fit<'_> {
    fn motor(&self, theta: &[f64]) -> Motor {
        Motor {
            gain: theta[0] * self.gain,
            lag: theta[1].exp(),
            delay: theta[2].exp(),
            friction: theta[3] * self.largest,
            bias: theta[4] * self.largest,
        }
    }
}

impl Residuals for Fit<'_> {
    fn parameters(&self) -> usize {
        5
    }

    fn len(&self) -> usize {
        1 + self.runs.iter().map(Blocks::len).sum::<usize>()
    }

    fn residuals(&mut self, theta: &[f64], r: &mut [f64]) -> bool {
        let motor = self.motor(theta);
        let mut at = 0;
        for run in self.runs {
            run.simulate(&motor, None, |error| {
                r[at] = error;
                at += 1;
            });
        }
        // in one direction friction and a load are equivalent: this prefers friction
        r[at] = UNLIKELY * self.gain * self.largest * (at as f64).sqrt() * theta[4];
        r.iter().all(|x| x.is_finite())
    }

    fn jacobian(&mut self, theta: &[f64], r: &[f64], j: &mut [f64]) -> bool {
        let n = theta.len();
        let mut moved = vec![0.0; r.len()];
        for i in 0..n {
            let mut shifted = theta.to_vec();
            shifted[i] += 1e-5;
            if !self.residuals(&shifted, &mut moved) {
                return false;
            }
            for (k, (after, before)) in moved.iter().zip(r).enumerate() {
                j[k * n + i] = (after - before) / 1e-5;
            }
        }
        true
    }
}

/// Time constants at which the fit begins, as shares of the longest run.
const LAGS: [f64; 5] = [0.003, 0.02, 0.1, 1.0, 10.0];

/// The motor with a gain of this sign that fits the runs best; the zero motor if they do not move.
fn fitted(runs: &[Blocks], lags: &[f64], sign: f64, monitor: &Monitor) -> Result<Motor> {
    let largest = runs.iter().fold(0.0, |a: f64, r| a.max(r.largest));
    let fastest = runs
        .iter()
        .flat_map(|r| &r.speed)
        .fold(0.0, |a: f64, y| a.max(y.abs()));
    let still = Motor {
        gain: 0.0,
        lag: 1.0,
        delay: 0.0,
        friction: 0.0,
        bias: 0.0,
    };
    if fastest == 0.0 || largest == 0.0 || runs.iter().map(Blocks::len).sum::<usize>() < 6 {
        return Ok(still);
    }
    let shortest = runs.iter().fold(f64::INFINITY, |a, r| a.min(r.step));
    let longest = runs
        .iter()
        .fold(0.0, |a: f64, r| a.max(r.len() as f64 * r.step));
    let mut fit = Fit {
        runs,
        gain: sign * fastest / largest,
        largest,
    };
    let (low, high) = ((0.2 * shortest).ln(), (100.0 * longest).ln());
    let settings = Settings {
        ftol: 1e-5,
        xtol: 1e-5,
        max_evaluations: 40,
        precision: 1e-5,
        lower: Some(vec![0.0, low, (1e-3 * shortest).ln(), 0.0, -1.0]),
        upper: Some(vec![1e6, high, (0.3 * longest).ln(), 1.0, 1.0]),
        ..Settings::default()
    };
    let mut best = (f64::INFINITY, still);
    for &lag in lags {
        // of a slow motor only the rise is visible
        let gain = 1.0 + lag;
        let lag = (lag * longest).ln().clamp(low, high);
        let delay = (0.5 * shortest).min(0.2 * longest).ln();
        let start = vec![gain, lag, delay, 0.01, 0.0];
        let found = least_squares::solve(&mut fit, start, &settings, monitor)?;
        if found.cost < best.0 {
            best = (found.cost, fit.motor(&found.theta));
        }
    }
    Ok(best.1)
}

// --- Changes --------------------------------------------------------------------------------------------------------------

/// A change at its best block and value so far.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    change: Change,
    value: f64,
    at: usize,
    squares: f64,
    motor: Motor,
    /// Step sizes with which block and value are refined.
    wide: usize,
    apart: f64,
}

/// Every change at the best of the given samples with the best of its values.
fn considered(blocks: &Blocks, motor: &Motor, at: &[usize]) -> Vec<Candidate> {
    let wide = (blocks.len() / at.len().max(OWN_PLACES)).max(1);
    let best = |&change: &Change| {
        let everywhere = at.iter().flat_map(|&place| {
            values(change, blocks, motor, place)
                .into_iter()
                .map(move |(value, apart)| Candidate {
                    change,
                    value,
                    at: place,
                    squares: blocks.squares(motor, Some((change, value, place))),
                    motor: *motor,
                    wide,
                    apart,
                })
        });
        everywhere.min_by(|a, b| a.squares.total_cmp(&b.squares))
    };
    Change::ALL.iter().filter_map(best).collect()
}

/// Values to try, each with the distance to its neighbours.
fn values(change: Change, blocks: &Blocks, motor: &Motor, at: usize) -> Vec<(f64, f64)> {
    let spread = |values: &[f64], scale: f64| -> Vec<(f64, f64)> {
        let near = |i: usize| {
            let gap = |a: usize, b: usize| (values[b] - values[a]).abs();
            let left = if i > 0 { gap(i - 1, i) } else { f64::INFINITY };
            let right = if i + 1 < values.len() {
                gap(i, i + 1)
            } else {
                f64::INFINITY
            };
            left.min(right)
        };
        (0..values.len())
            .map(|i| (scale * values[i], scale * near(i)))
            .collect()
    };
    match change {
        Change::Gain => spread(
            &[-2.0, -1.0, -0.5, 0.0, 0.25, 0.5, 0.75, 1.5, 2.0, 4.0, 8.0],
            1.0,
        ),
        Change::Counts => spread(&[-1.0, -0.5, 0.0, 0.25, 0.5, 0.75, 1.5, 2.0, 4.0], 1.0),
        Change::Stuck => spread(&[-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0], blocks.largest),
        Change::Load => spread(
            &[-1.0, -0.5, -0.25, -0.1, 0.1, 0.25, 0.5, 1.0],
            blocks.largest,
        ),
        Change::Jump => {
            let before = if at > 0 { blocks.speed[at - 1] } else { 0.0 };
            vec![((blocks.speed[at] - before) / blocks.per_count, 0.0)]
        }
        Change::Delay => spread(&[0.05, 0.1, 0.2, 0.4, 0.8], motor.lag.min(1.0)),
        Change::Inertia => spread(&[0.25, 0.5, 2.0, 4.0, 16.0], 1.0),
        Change::Friction => spread(&[0.1, 0.25, 0.5, 1.0], blocks.largest),
    }
}

impl Candidate {
    /// Moves block and value while the error falls, then halves the steps (Hooke and Jeeves 1961).
    fn refine(&mut self, blocks: &Blocks, most: f64, monitor: &Monitor) {
        if self.change == Change::Jump {
            self.place_the_jump(blocks);
            return;
        }
        let (mut wide, mut apart) = (self.wide, self.apart);
        let mut halvings = 0;
        while halvings < HALVINGS && !monitor.stopped() {
            let before = self.squares;
            for (ways, by) in [
                (-1, 0.0),
                (1, 0.0),
                (0, -1.0),
                (0, 1.0),
                (1, 1.0),
                (1, -1.0),
                (-1, 1.0),
                (-1, -1.0),
            ] {
                self.take_if_better(blocks, most, ways * wide as isize, by * apart);
            }
            // a short change of twice the size is much like a longer one
            for (ways, factor) in [(0, 2.0), (1, 2.0), (0, 0.5), (-1, 0.5)] {
                let more = (factor - 1.0) * self.value;
                self.take_if_better(blocks, most, ways * wide as isize, more);
            }
            if self.squares >= FALLS * before {
                (wide, apart) = (wide.div_ceil(2), 0.5 * apart);
                halvings += 1;
            }
        }
    }

    fn take_if_better(&mut self, blocks: &Blocks, most: f64, later: isize, more: f64) {
        let at = self.at.saturating_add_signed(later).min(blocks.len() - 1);
        let value = self.value + more;
        let is_possible = match self.change {
            Change::Delay => value >= 0.0,
            // friction beyond the largest command would only hold the shaft
            Change::Friction => (0.0..=blocks.largest).contains(&value),
            // a larger load would have turned the machine before
            Change::Load => value.abs() <= blocks.largest,
            Change::Stuck => value.abs() <= most,
            Change::Inertia => value > 0.05,
            // a decoder makes 1, 2 or 4 counts of a line
            Change::Counts => value.abs() <= 4.0,
            _ => true,
        };
        if is_possible {
            let squares = blocks.squares(&self.motor, Some((self.change, value, at)));
            if squares < self.squares {
                (self.squares, self.value, self.at) = (squares, value, at);
            }
        }
    }

    /// Puts a jump where the motor's error is largest.
    fn place_the_jump(&mut self, blocks: &Blocks) {
        let mut errors = Vec::with_capacity(blocks.len());
        blocks.simulate(&self.motor, None, |error| errors.push(error));
        let largest =
            (0..errors.len()).max_by(|&a, &b| errors[a].abs().total_cmp(&errors[b].abs()));
        if let Some(at) = largest {
            self.at = at;
            self.value = errors[at] / blocks.per_count;
            self.squares = blocks.squares(&self.motor, Some((Change::Jump, self.value, at)));
        }
    }
}

#[cfg(test)]
mod tests;
