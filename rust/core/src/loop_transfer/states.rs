//! The closed loop as a state space: its poles, and the command that measurement noise makes.

use nalgebra::{DMatrix, DVector};

use super::{Loop, Path, Plant};

/// Doublings of the horizon; the last one spans 2^60 samples.
const DOUBLINGS: usize = 60;

/// The most states whose eigenvalues are worth their time.
const MOST: usize = 250;

/// `x(k+1) = A x(k) + B n(k)`, `u(k) = C x(k) + D n(k)` with noise `n` on the measured output.
pub(super) struct States {
    a: DMatrix<f64>,
    b: DVector<f64>,
    c: DVector<f64>,
    d: f64,
}

impl States {
    /// Column by column, by stepping the loop from each unit vector; `None` beyond [`MOST`] states.
    pub fn of(closed: &Loop<'_>) -> Option<Self> {
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

    /// The largest size of a pole; NaN where the eigenvalues cannot be found.
    pub fn largest_pole(&self) -> f64 {
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
    pub fn noise_gain(&self) -> f64 {
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

/// What the parts of the loop remember, one after the other in one vector.
struct Memory<'a> {
    path: &'a Path,
    plant: &'a Plant,
    /// Where each part begins: plant, encoder, average, lag, observer, biquads, integral, derivative.
    at: [usize; 9],
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
        ];
        let mut at = [0; 9];
        for (i, size) in sizes.into_iter().enumerate() {
            at[i + 1] = at[i] + size;
        }
        Self { path, plant, at }
    }

    fn size(&self) -> usize {
        self.at[8]
    }

    /// One sample with reference 0: the command, and `x` becomes the next state.
    fn step(&self, x: &mut [f64], noise: f64) -> f64 {
        let mut y = x[0];
        if self.path.encoder {
            let before = std::mem::replace(&mut x[self.at[1]], y);
            y = 0.5 * (y + before);
        }
        y += noise;
        y = self.averaged(&mut x[self.at[2]..self.at[3]], y);
        y = self.lagged(&mut x[self.at[3]..self.at[4]], y);
        y = self.observed(&mut x[self.at[4]..self.at[5]], y);
        y = self.notched(&mut x[self.at[5]..self.at[6]], y);
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

    /// Section by section the last input and the two states of transposed direct form II on its change.
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

    /// Observer form: `x_i` is what past inputs and outputs contribute to the output `i` samples ahead.
    fn advance(&self, x: &mut [f64], u: f64) {
        let y = x[0];
        for i in 0..x.len() {
            let later = x.get(i + 1).copied().unwrap_or(0.0);
            let coefficient = |c: &[f64]| c.get(i + 1).copied().unwrap_or(0.0);
            x[i] = later - coefficient(&self.plant.den) * y + coefficient(&self.plant.num) * u;
        }
    }
}
