//! The sampled linear loop: a plant under a zero-order hold and the controller's feedback path, as functions of frequency.
//!
//! The loop is broken at the plant's input. With `z = exp(j w Ts)`, `G` the plant, `E` the encoder and `R` the path
//! from the measured output to the command,
//!
//! ```text
//! L = R E G,    S = 1/(1 + L),    T = L/(1 + L),    u = -R/(1 + L) n    (n: noise on the measured output)
//! ```
//!
//! [`Path`] is `R E`; [`Plant`] and [`Measured`] are `G`. [`margins`] says how far the loop is from instability;
//! [`peak_sensitivity`] only `max |S|`, fast enough for a search; [`Changing`] the same when a resonance moves.

mod margins;
mod plant;
mod tolerance;

use nalgebra::{Complex, DMatrix, DVector};
use sewfast_control::{Biquad, CAPACITY, Cascade, Refused, Standard};

use crate::{Error, Result};

pub(crate) use margins::weakening;
pub use margins::{Margins, margins, peak_sensitivity, position_sensitivity};
pub use plant::{Measured, Plant};
pub use tolerance::{Change, Changing};

/// A point on the unit circle: `z^-1 = exp(-j theta)` and `1 - z^-1`, which keeps its digits at small angles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place {
    theta: f64,
    back: Complex<f64>,
    difference: Complex<f64>,
}

impl Place {
    fn at(theta: f64) -> Self {
        let (half, whole) = ((0.5 * theta).sin(), theta.sin());
        Self {
            theta,
            back: Complex::new(theta.cos(), -whole),
            difference: Complex::new(2.0 * half * half, whole),
        }
    }
}

/// A feedback path closed around a plant.
#[derive(Clone, Copy, Debug)]
pub struct Loop<'a> {
    path: &'a Path,
    plant: &'a Plant,
}

impl<'a> Loop<'a> {
    /// The loop of `path` around `plant`, whose coefficients are for the path's sample time.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a setting of the path out of range, or a plant whose output depends on the command of
    /// the same sample.
    pub fn new(path: &'a Path, plant: &'a Plant) -> Result<Self> {
        path.check()?;
        if plant.num.first().is_some_and(|&b| b != 0.0) {
            return Err(Error::setting(
                "expected a plant that answers a sample later at the earliest, got one whose y(k) depends on u(k); shift \
                 it by a sample (nk = 1), as the command is decided after the output was measured",
            ));
        }
        Ok(Self { path, plant })
    }

    /// `L` at `omega` \[rad/s\].
    pub fn response(&self, omega: f64) -> Complex<f64> {
        self.at(&Place::at(omega * self.path.ts))
    }

    fn at(&self, place: &Place) -> Complex<f64> {
        self.path.response(place) * self.path.encoder_response(place) * self.plant.response(place)
    }
}

/// The part of a controller that is in the loop, as plain numbers; alpha, beta and the limits are not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Path {
    /// Gains in standard form.
    pub gains: Standard<f64>,
    /// Gain that a schedule adds to the proportional gain \[u/y\]: if `Kp` depends on the output, so does
    /// `-Kp alpha r`, and `alpha r dKp/dy` acts on the output's deviation.
    pub slope: f64,
    /// The derivative is filtered with time constant `Td/N`; infinite for no filter.
    pub n: f64,
    /// Samples of the moving average; 1 for none.
    pub filter_samples: usize,
    /// Time constant of the lag \[s\]; 0 for none.
    pub filter_time: f64,
    /// Time constant of the alpha-beta observer \[s\]; 0 for none.
    pub observer_time: f64,
    /// Biquads, such as notches, on the feedback.
    pub biquads: Cascade<f64>,
    /// Whether the output is measured as a difference of positions: the mean over the last sample.
    pub encoder: bool,
    /// Gain of a position loop around it, whose position is the sum of what is measured \[1/s\]; 0 for none.
    pub position: f64,
    /// Sample time \[s\].
    pub ts: f64,
}

impl Path {
    /// Gains at a sample time, without filters.
    pub fn new(gains: Standard<f64>, ts: f64) -> Self {
        Self {
            gains,
            slope: 0.0,
            n: f64::INFINITY,
            filter_samples: 1,
            filter_time: 0.0,
            observer_time: 0.0,
            biquads: Cascade::NONE,
            encoder: false,
            position: 0.0,
            ts,
        }
    }

    pub(super) fn check(&self) -> Result<()> {
        self.gains.checked()?;
        let unless = |holds: bool, name, expected, received| match holds {
            true => Ok(()),
            false => Err(Error::from(Refused {
                name,
                expected,
                received,
            })),
        };
        let time = |t: f64| t >= 0.0 && t.is_finite();
        let finite_time = "a finite time of 0 s or more";
        let average = (1..=CAPACITY).contains(&self.filter_samples);
        unless(
            self.ts > 0.0 && self.ts.is_finite(),
            "Ts",
            "a sample time above 0 s",
            self.ts,
        )?;
        unless(self.n > 0.0, "N", "a number above 0, or inf", self.n)?;
        unless(self.slope.is_finite(), "slope", "a finite gain", self.slope)?;
        let position = self.position >= 0.0 && self.position.is_finite();
        unless(
            position,
            "position gain",
            "a finite gain of 0 or more",
            self.position,
        )?;
        unless(
            average,
            "filter_samples",
            "1 to 64 samples",
            self.filter_samples as f64,
        )?;
        unless(
            time(self.filter_time),
            "filter_time",
            finite_time,
            self.filter_time,
        )?;
        unless(
            time(self.observer_time),
            "observer_time",
            finite_time,
            self.observer_time,
        )
    }

    /// Gain on the sum of errors, `Kp Ts/Ti`.
    pub(super) fn ki(&self) -> f64 {
        self.gains.kp * self.ts / self.gains.ti
    }

    /// Gain on the output's difference, `Kp Td/(Td/N + Ts)`.
    pub(super) fn kd(&self) -> f64 {
        self.gains.kp * self.gains.td / (self.gains.td / self.n + self.ts)
    }

    /// Pole of the derivative's filter, `(Td/N)/(Td/N + Ts)`.
    pub(super) fn pole(&self) -> f64 {
        let filter = self.gains.td / self.n;
        filter / (filter + self.ts)
    }

    /// Weight of the newest sample in the lag, `Ts/(Ts + filter_time)`.
    pub(super) fn weight(&self) -> f64 {
        self.ts / (self.ts + self.filter_time)
    }

    /// `exp(-Ts/observer_time)`, both poles of the observer.
    pub(super) fn theta(&self) -> f64 {
        (-self.ts / self.observer_time).exp()
    }

    /// From the measured output to the command, with reversed sign:
    ///
    /// ```text
    /// R = (Kp + slope + Ki/(1 - 1/z) + Kd (1 - 1/z)/(1 - pole/z)) (F + position Ts/(1 - 1/z)) H,
    /// F = (1 - z^-n)/(n (1 - 1/z))  w/(1 - (1 - w)/z)  ((1 - theta)/(1 - theta/z))^2,
    /// H = product of 1 + (1 - 1/z) (c0 + c1/z)/(1 + a1/z + a2/z^2) over the biquads
    /// ```
    pub(super) fn response(&self, at: &Place) -> Complex<f64> {
        let (d, one) = (at.difference, Complex::new(1.0, 0.0));
        let lag = |pole: f64| one * (1.0 - pole) / (d * pole + (1.0 - pole));
        let pole = self.pole();
        let mut response = Complex::new(self.gains.kp + self.slope, 0.0)
            + d * self.kd() / (d * pole + (1.0 - pole));
        if self.ki() != 0.0 {
            response += one * self.ki() / d;
        }
        // the position does not pass the filters of the speed
        let outer = response * (self.position * self.ts);
        // at frequency 0 the mean is 1
        if self.filter_samples > 1 && at.theta > 0.0 {
            let n = self.filter_samples as f64;
            response *= Place::at(n * at.theta).difference / (d * n);
        }
        if self.filter_time > 0.0 {
            response *= lag(1.0 - self.weight());
        }
        if self.observer_time > 0.0 {
            let once = lag(self.theta());
            response *= once * once;
        }
        if self.position > 0.0 {
            response += outer / d;
        }
        for &Biquad { c0, c1, a1, a2 } in self.biquads.sections() {
            let poles = one + at.back * a1 + at.back * at.back * a2;
            response *= one + d * (at.back * c1 + c0) / poles;
        }
        response
    }

    /// The encoder: `(1 + 1/z)/2`, as the output is taken to be linear between samples.
    pub(super) fn encoder_response(&self, at: &Place) -> Complex<f64> {
        let half = if self.encoder { 0.5 } else { 0.0 };
        Complex::new(1.0, 0.0) - at.difference * half
    }
}

/// Doublings of the horizon; the last one spans 2^60 samples.
const DOUBLINGS: usize = 60;

/// Most states whose eigenvalues are worth the time.
const MOST: usize = 250;

/// `x(k+1) = A x(k) + B n(k)`, `u(k) = C x(k) + D n(k)` with noise `n` on the measured output.
struct States {
    a: DMatrix<f64>,
    b: DVector<f64>,
    c: DVector<f64>,
    d: f64,
}

impl States {
    /// Computed column by column, by stepping the loop from each unit vector; `None` beyond [`MOST`] states.
    fn of(closed: &Loop<'_>) -> Option<Self> {
        let memory = Memory::of(closed);
        let n = memory.size();
        if n > MOST {
            return None;
        }
        let (mut a, mut c) = (DMatrix::zeros(n, n), DVector::zeros(n));
        let mut x = vec![0.0; n];
        for i in 0..n {
            x.fill(0.0);
            x[i] = 1.0;
            c[i] = memory.step(&mut x, 0.0);
            a.column_mut(i).copy_from_slice(&x);
        }
        x.fill(0.0);
        let d = memory.step(&mut x, 1.0);
        Some(Self {
            a,
            b: DVector::from_vec(x),
            c,
            d,
        })
    }

    /// The largest magnitude of a pole; NaN if the eigenvalues cannot be found.
    fn largest_pole(&self) -> f64 {
        let n = self.a.nrows();
        let schur = self.a.clone().try_schur(f64::EPSILON, 200 * n.max(1));
        schur.map_or(f64::NAN, |schur| {
            schur
                .complex_eigenvalues()
                .iter()
                .map(|p| p.norm())
                .fold(0.0, f64::max)
        })
    }

    /// Root of the sum of squares of the impulse response, `D^2 + C P C'` with `P = A P A' + B B'`, by doubling:
    /// `P <- P + A P A'`, `A <- A A` (R. A. Smith, *SIAM J. Appl. Math.* 16, 1968).
    fn noise_gain(&self) -> f64 {
        let mut power = self.a.clone();
        let mut p = &self.b * self.b.transpose();
        for _ in 0..DOUBLINGS {
            let more = &power * &p * power.transpose();
            let settled = more.trace() <= f64::EPSILON * f64::EPSILON * p.trace();
            p += more;
            if settled || !p.trace().is_finite() {
                break;
            }
            power = &power * &power;
        }
        (self.d * self.d + self.c.dot(&(p * &self.c))).sqrt()
    }
}

/// The states of all parts of the loop, one after the other in one vector.
struct Memory<'a> {
    path: &'a Path,
    plant: &'a Plant,
    /// Start of each part: plant, encoder, average, lag, observer, biquads, integral, derivative, position.
    at: [usize; 10],
}

impl<'a> Memory<'a> {
    fn of(closed: &Loop<'a>) -> Self {
        let (path, plant) = (closed.path, closed.plant);
        let one = usize::from;
        let sizes = [
            plant.order(),
            one(path.encoder),
            path.filter_samples - 1,
            one(path.filter_time > 0.0),
            2 * one(path.observer_time > 0.0),
            3 * path.biquads.sections().len(),
            one(path.ki() != 0.0),
            2 * one(path.kd() != 0.0),
            one(path.position > 0.0),
        ];
        let mut at = [0; 10];
        for (i, size) in sizes.into_iter().enumerate() {
            at[i + 1] = at[i] + size;
        }
        Self { path, plant, at }
    }

    fn size(&self) -> usize {
        self.at[9]
    }

    /// One sample with reference 0: returns the command, and `x` becomes the next state.
    fn step(&self, x: &mut [f64], noise: f64) -> f64 {
        let mut y = x[0];
        if self.path.encoder {
            let before = std::mem::replace(&mut x[self.at[1]], y);
            y = 0.5 * (y + before);
        }
        y += noise;
        let mut moved = 0.0;
        if let [position] = &mut x[self.at[8]..self.at[9]] {
            *position += self.path.ts * y;
            moved = self.path.position * *position;
        }
        y = self.averaged(&mut x[self.at[2]..self.at[3]], y);
        y = self.lagged(&mut x[self.at[3]..self.at[4]], y);
        y = self.observed(&mut x[self.at[4]..self.at[5]], y);
        y = self.notched(&mut x[self.at[5]..self.at[6]], y + moved);
        let u = self.commanded(x, y);
        self.advance(&mut x[..self.at[1]], u);
        u
    }

    fn averaged(&self, past: &mut [f64], y: f64) -> f64 {
        let mean = (past.iter().sum::<f64>() + y) / self.path.filter_samples as f64;
        if !past.is_empty() {
            past.rotate_right(1);
            past[0] = y;
        }
        mean
    }

    fn lagged(&self, memory: &mut [f64], y: f64) -> f64 {
        let [state] = memory else { return y };
        *state += self.path.weight() * (y - *state);
        *state
    }

    /// Speed and position error of the alpha-beta observer in innovation form.
    fn observed(&self, memory: &mut [f64], y: f64) -> f64 {
        let [speed, error] = memory else { return y };
        let theta = self.path.theta();
        let innovation = *error + y - *speed;
        *error = theta * theta * innovation;
        *speed += (1.0 - theta) * (1.0 - theta) * innovation;
        *speed
    }

    /// For each section the last input and the two states of the transposed direct form II on its change.
    fn notched(&self, memory: &mut [f64], mut y: f64) -> f64 {
        let sections = self.path.biquads.sections().iter();
        for (state, section) in memory.chunks_exact_mut(3).zip(sections) {
            let change = y - state[0];
            let d = section.c0 * change + state[1];
            state[0] = y;
            state[1] = section.c1 * change - section.a1 * d + state[2];
            state[2] = -(section.a2 * d);
            y += d;
        }
        y
    }

    fn commanded(&self, x: &mut [f64], y: f64) -> f64 {
        let mut u = -(self.path.gains.kp + self.path.slope) * y;
        if let [sum] = &mut x[self.at[6]..self.at[7]] {
            *sum -= self.path.ki() * y;
            u += *sum;
        }
        if let [derivative, before] = &mut x[self.at[7]..self.at[8]] {
            *derivative = self.path.pole() * *derivative - self.path.kd() * (y - *before);
            *before = y;
            u += *derivative;
        }
        u
    }

    /// Observer form: `x_i` is the contribution of past inputs and outputs to the output `i` samples ahead.
    fn advance(&self, x: &mut [f64], u: f64) {
        let y = x[0];
        for i in 0..x.len() {
            let later = x.get(i + 1).copied().unwrap_or(0.0);
            let coefficient = |c: &[f64]| c.get(i + 1).copied().unwrap_or(0.0);
            x[i] = later - coefficient(&self.plant.den) * y + coefficient(&self.plant.num) * u;
        }
    }
}

#[cfg(test)]
mod tests;
