//! The Hammerstein-Wiener model: a linear difference equation between two static characteristics.
//!
//! ```text
//!   u_j --> [ f_j ] --> w_j --> [ B_j / A ] --> x --> [ g ] --> y
//!
//!   x(k) = -sum_i a_i x(k-i) + sum_j sum_i b_ji w_j(k-nk-i+1) + offset
//! ```
//!
//! A dead band, a saturation or a servo valve's curve is an `f`; a nonlinear sensor is a `g`. Both are piecewise linear
//! over evenly spaced knots of the training range and continue straight beyond it. `g` is strictly increasing, so
//! `x(k-i) = g^-1(y(k-i))` and the model is a [`Lagged`] one: its state is past *outputs*, as for every other kind.
//!
//! A factor can be moved from `f` to `b` and on to `g` without changing `y`. The ends of the curves' ranges fix it:
//! there `f(u) = u` and `g(x) = x`.

use std::ops::Range;

use crate::lagged::{Lagged, Lags};
use crate::linear::is_stable;
use crate::output_error::{self, Fit, Parametric};
use crate::{Error, Monitor, Record, Result, oe};

/// Least distance of a reflection coefficient from the unit circle in a fit.
const MARGIN: f64 = 1e-9;
/// Least slope of a piece of `g`, as a share of the mean slope: below it, one step of the output's noise would be a jump of x.
const LEAST_SLOPE: f64 = 0.02;
/// More pieces than this describe noise.
const MOST_PIECES: usize = 100;
/// Weight of the ridge: a curve that the data do not determine stays straight. A curve off by a tenth of its range at
/// ten knots costs an rms error of 0.1 % of the output's.
const RIDGE: f64 = 1e-5;

/// The knots of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knots {
    /// First knot.
    pub low: f64,
    /// Last knot.
    pub high: f64,
    /// Pieces between them; 1 is a straight line.
    pub pieces: usize,
}

impl Knots {
    fn check(&self, name: &str) -> Result<()> {
        let ordered = self.low < self.high && self.low.is_finite() && self.high.is_finite();
        if ordered && (1..=MOST_PIECES).contains(&self.pieces) {
            return Ok(());
        }
        Err(Error::setting(format!(
            "expected 1 to {MOST_PIECES} pieces between two different levels for the {name} characteristic, got {} from {} \
             to {}; record an {name} that moves",
            self.pieces, self.low, self.high
        )))
    }

    fn width(&self) -> f64 {
        (self.high - self.low) / self.pieces as f64
    }

    /// Knot `i`.
    pub fn at(&self, i: usize) -> f64 {
        self.low + (self.high - self.low) * i as f64 / self.pieces as f64
    }

    /// The piece that contains `x`, and the position on it; below 0 or above 1 beyond the ends.
    fn place(&self, x: f64) -> (usize, f64) {
        // Knots are evenly spaced, so the piece is found by a division, not a search. `along` is not clipped: beyond
        // the ends the first and the last piece continue straight.
        let along = (x - self.low) / self.width();
        // NaN and values below the first knot become piece 0
        let piece = (along.max(0.0) as usize).min(self.pieces - 1);
        (piece, along - piece as f64)
    }
}

/// `f(u) = u + (high - low) c(u)`; `c` is 0 at both ends and a free number at each inner knot.
#[derive(Clone, Debug)]
struct Bent {
    knots: Knots,
    c: Vec<f64>,
}

impl Bent {
    /// With the zeros at the ends added.
    fn new(knots: Knots, inner: &[f64]) -> Self {
        Self {
            knots,
            c: [&[0.0], inner, &[0.0]].concat(),
        }
    }

    fn value_and_slope(&self, u: f64) -> (f64, f64) {
        let (i, t) = self.knots.place(u);
        // c is in parts of the range: a bend has the same size for every unit of the input, so one ridge fits all.
        let range = self.knots.high - self.knots.low;
        let (left, rise) = (self.c[i], self.c[i + 1] - self.c[i]);
        (
            u + range * (left + t * rise),
            // df/du = 1 + range rise/width, and range/width is the number of pieces.
            1.0 + self.knots.pieces as f64 * rise,
        )
    }

    /// Adds `factor df/dc` to `by_c`.
    fn add_gradient(&self, u: f64, factor: f64, by_c: &mut [f64]) {
        let (i, t) = self.knots.place(u);
        let range = self.knots.high - self.knots.low;
        // f depends on the two knots next to u, by 1 - t and t; the end knots are 0 and no parameters.
        for (knot, share) in [(i, 1.0 - t), (i + 1, t)] {
            if let Some(place) = knot.checked_sub(1).and_then(|inner| by_c.get_mut(inner)) {
                *place += factor * range * share;
            }
        }
    }
}

/// `g` from the logarithms `d` of its pieces' slopes over the first one's: with `s = softmax(0, d)` piece `i` rises by
/// `(high - low) (LEAST_SLOPE/n + (1 - LEAST_SLOPE) s_i)`. It increases strictly for every `d`, so no constraint is needed.
#[derive(Clone, Debug)]
struct Rising {
    knots: Knots,
    /// `g` at the knots.
    values: Vec<f64>,
    shares: Vec<f64>,
}

impl Rising {
    fn new(knots: Knots, d: &[f64]) -> Self {
        let n = knots.pieces;
        // exp(d - largest): the softmax is the same, and no exponential overflows. `largest` starts at 0, the first
        // piece's own d: of n shares n - 1 are free.
        let largest = d.iter().fold(0.0, |most: f64, d| most.max(*d));
        let mut shares: Vec<f64> = std::iter::once(&0.0)
            .chain(d)
            .map(|d| (d - largest).exp())
            .collect();
        let sum: f64 = shares.iter().sum();
        shares.iter_mut().for_each(|share| *share /= sum);
        let range = knots.high - knots.low;
        let mut values = vec![knots.low];
        for share in &shares {
            // Shares sum to 1, so the rises sum to the range: g(high) = high, which fixes the factor between the
            // curves.
            let rise = range * (LEAST_SLOPE / n as f64 + (1.0 - LEAST_SLOPE) * share);
            values.push(values[values.len() - 1] + rise);
        }
        Self {
            knots,
            values,
            shares,
        }
    }

    fn rise(&self, i: usize) -> f64 {
        self.values[i + 1] - self.values[i]
    }

    fn value_and_slope(&self, x: f64) -> (f64, f64) {
        // Exactly the identity: a Hammerstein model gets no rounding from a curve that it does not have.
        if self.knots.pieces == 1 {
            return (x, 1.0);
        }
        let (i, t) = self.knots.place(x);
        let rise = self.rise(i);
        (self.values[i] + t * rise, rise / self.knots.width())
    }

    /// `g^-1(y)` and the slope of `g` there.
    fn inverse(&self, y: f64) -> (f64, f64) {
        if self.knots.pieces == 1 {
            return (y, 1.0);
        }
        let inner = &self.values[1..self.knots.pieces];
        // The values increase but are not evenly spaced: a binary search. Over inner values only, so that values beyond
        // the ends are on the first or the last piece.
        let i = inner.partition_point(|value| *value <= y);
        let (rise, width) = (self.rise(i), self.knots.width());
        let t = (y - self.values[i]) / rise;
        // The noise of a past output is multiplied by 1/g', which `LEAST_SLOPE` bounds.
        (self.knots.at(i) + t * width, rise / width)
    }

    /// Adds `factor dg/dd` at `x`: with `C_i = s_0 + .. + s_(i-1)`,
    /// `dg/dd_m = R (1 - LEAST_SLOPE) s_m ([m < i] - C_i + t ([m = i] - s_i))`.
    fn add_gradient(&self, x: f64, factor: f64, by_d: &mut [f64]) {
        let (i, t) = self.knots.place(x);
        // From ds_i/dd_m = s_m ([i = m] - s_i): the pieces before x count in full, its own by t, and the least slope
        // not at all, as it does not depend on d.
        let before: f64 = self.shares[..i].iter().sum();
        let range = (self.knots.high - self.knots.low) * (1.0 - LEAST_SLOPE);
        for (m, (place, share)) in (1..).zip(by_d.iter_mut().zip(&self.shares[1..])) {
            let whole = f64::from(u8::from(m < i)) - before;
            let part = f64::from(u8::from(m == i)) - self.shares[i];
            *place += factor * range * share * (whole + t * part);
        }
    }
}

/// A Hammerstein-Wiener model in the data's units.
///
/// `theta = [a, b input by input, offset, c input by input, d]`: bends of `f` at the inner knots in parts of the
/// input's range, then logarithms of the slopes of `g` over that of its first piece.
#[derive(Clone, Debug)]
pub struct HammersteinWiener {
    theta: Vec<f64>,
    lags: Lags,
    inputs: Vec<Bent>,
    output: Rising,
}

/// The ranges of the parts of theta.
struct Parts {
    offset: usize,
    bends: usize,
    slopes: usize,
    end: usize,
}

impl Parts {
    fn of(lags: Lags, inputs: &[Knots], output: Knots) -> Self {
        //   theta   | a | b, input by input | offset | c, input by input | d |
        //           ^ 0 .. regressors        ^ offset ^ bends             ^ slopes
        // A curve of n pieces has n - 1 free numbers: the ends of f and the first slope of g are fixed.
        let offset = lags.regressors();
        let bends = offset + 1;
        let slopes = bends + inputs.iter().map(|k| k.pieces - 1).sum::<usize>();
        Self {
            offset,
            bends,
            slopes,
            end: slopes + output.pieces - 1,
        }
    }
}

impl HammersteinWiener {
    /// A model from its parameters.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for knots that form no range, a wrong number of parameters, or values that are not finite.
    pub fn new(lags: Lags, inputs: &[Knots], output: Knots, theta: Vec<f64>) -> Result<Self> {
        if inputs.len() != lags.channels {
            return Err(Error::setting(format!(
                "expected a characteristic for each of {} inputs, got {}; give one range an input",
                lags.channels,
                inputs.len()
            )));
        }
        inputs.iter().try_for_each(|knots| knots.check("input"))?;
        output.check("output")?;
        let parts = Parts::of(lags, inputs, output);
        if theta.len() != parts.end {
            return Err(Error::setting(format!(
                "expected {} parameters for this structure, got {}; theta is a, b input by input, offset, bends of the \
                 inputs' curves, slopes of the output's",
                parts.end,
                theta.len()
            )));
        }
        if theta.iter().any(|value| !value.is_finite()) {
            return Err(Error::setting(
                "expected finite parameters, got NaN or infinity; identify the model again",
            ));
        }
        Ok(Self::made(lags, inputs, output, theta))
    }

    fn made(lags: Lags, inputs: &[Knots], output: Knots, theta: Vec<f64>) -> Self {
        let parts = Parts::of(lags, inputs, output);
        let mut next = parts.bends;
        let bent = |knots: &Knots| {
            let first = next;
            next += knots.pieces - 1;
            Bent::new(*knots, &theta[first..next])
        };
        Self {
            lags,
            inputs: inputs.iter().map(bent).collect(),
            output: Rising::new(output, &theta[parts.slopes..]),
            theta,
        }
    }

    /// Parameters.
    pub fn theta(&self) -> &[f64] {
        &self.theta
    }

    /// Knots of each input's curve.
    pub fn input_knots(&self) -> Vec<Knots> {
        self.inputs.iter().map(|bent| bent.knots).collect()
    }

    /// Knots of the output's curve.
    pub fn output_knots(&self) -> Knots {
        self.output.knots
    }

    /// `f_j` at values of input `j`.
    pub fn input_curve(&self, j: usize, u: &[f64]) -> Vec<f64> {
        let bent = &self.inputs[j];
        u.iter().map(|u| bent.value_and_slope(*u).0).collect()
    }

    /// `g` at values of the linear part's output.
    pub fn output_curve(&self, x: &[f64]) -> Vec<f64> {
        x.iter()
            .map(|x| self.output.value_and_slope(*x).0)
            .collect()
    }

    fn parts(&self) -> Parts {
        Parts::of(self.lags, &self.input_knots(), self.output.knots)
    }

    /// Returns `x`, the linear part's output; calls `each` for every term with its index, coefficient, value and slope.
    fn linear_part(&self, phi: &[f64], mut each: impl FnMut(usize, f64, f64, f64)) -> f64 {
        let Lags { na, nb, .. } = self.lags;
        let mut x = self.theta[phi.len()];
        for (i, value) in phi.iter().enumerate() {
            let coefficient = self.theta[i];
            // phi has past outputs y, but the difference equation -a_i x(k-i) needs the x of each: x = g^-1(y) and
            // dx/dy = 1/g'.
            let (value, slope) = if i < na {
                let (past, slope) = self.output.inverse(*value);
                (-past, -1.0 / slope)
            } else {
                self.inputs[(i - na) / nb].value_and_slope(*value)
            };
            x += coefficient * value;
            each(i, coefficient, value, slope);
        }
        x
    }
}

impl Lagged for HammersteinWiener {
    fn lags(&self) -> Lags {
        self.lags
    }

    fn output(&self, phi: &[f64]) -> f64 {
        // With an empty closure the output alone costs no derivatives.
        let x = self.linear_part(phi, |_, _, _, _| ());
        self.output.value_and_slope(x).0
    }

    fn output_and_slope(&self, phi: &[f64], slope: &mut [f64]) -> f64 {
        let x = self.linear_part(phi, |i, coefficient, _, steep| {
            // As many as requested, the past outputs first.
            if let Some(slope) = slope.get_mut(i) {
                *slope = coefficient * steep;
            }
        });
        let (y, steep) = self.output.value_and_slope(x);
        // dy/dphi_i = g'(x) dx/dphi_i.
        slope.iter_mut().for_each(|slope| *slope *= steep);
        y
    }
}

impl Parametric for HammersteinWiener {
    fn theta(&self) -> Vec<f64> {
        self.theta.clone()
    }

    fn with_theta(&self, theta: &[f64]) -> Option<Self> {
        let finite = theta.iter().all(|value| value.is_finite());
        // A trial with a pole outside the unit circle is refused like one that diverges: over a short record its free
        // run may still be finite.
        (finite && is_stable(&theta[..self.lags.na], MARGIN)).then(|| {
            Self::made(
                self.lags,
                &self.input_knots(),
                self.output.knots,
                theta.to_vec(),
            )
        })
    }

    /// With `x` as above, `dy = g'(x) dx + (dg/dd)(x)`; a past `x = g^-1(y)` gives `dx/dy = 1/g'` and
    /// `dx/dd = -(dg/dd)/g'`.
    fn gradient(&self, phi: &[f64], by_theta: &mut [f64], by_phi: &mut [f64]) -> f64 {
        let (Lags { na, nb, .. }, parts) = (self.lags, self.parts());
        // Derivatives of the curves are sums over several terms of phi, so they begin at 0; a and b have one term each.
        by_theta[parts.offset..].fill(0.0);
        by_theta[parts.offset] = 1.0;
        let (linear, curves) = by_theta.split_at_mut(parts.bends);
        let (bends, slopes) = curves.split_at_mut(parts.slopes - parts.bends);
        let mut first = 0;
        let x = self.linear_part(phi, |i, coefficient, value, steep| {
            linear[i] = value;
            by_phi[i] = coefficient * steep;
            if i < na {
                // value is -x, steep is -1/g'
                self.output
                    .add_gradient(-value, -coefficient * steep, slopes);
                return;
            }
            let (j, of_input) = ((i - na) / nb, (i - na) % nb);
            // Terms come input by input: at an input's first term, its bends begin after those of the previous input.
            if of_input == 0 && j > 0 {
                first += self.inputs[j - 1].knots.pieces - 1;
            }
            let inner = self.inputs[j].knots.pieces - 1;
            let own = &mut bends[first..first + inner];
            self.inputs[j].add_gradient(phi[i], coefficient, own);
        });
        // So far all is dx; dy = g'(x) dx, plus the direct effect of d at x.
        let (y, steep) = self.output.value_and_slope(x);
        by_theta.iter_mut().for_each(|value| *value *= steep);
        by_phi.iter_mut().for_each(|value| *value *= steep);
        self.output
            .add_gradient(x, 1.0, &mut by_theta[parts.slopes..]);
        y
    }

    fn shrunk(&self) -> Range<usize> {
        // Bends and slopes, not a and b: a curve without data stays straight, and the dynamics are not biased.
        let parts = self.parts();
        parts.bends..parts.end
    }
}

/// Fits a Hammerstein-Wiener model in free run over all experiments, with an initial state per experiment.
///
/// It begins as the linear output-error model of the same orders, with straight curves over the ranges of the data.
/// `pieces` are those of every input's curve, then of the output's.
///
/// ```
/// use sewfast_core::{Monitor, Record, hammerstein};
///
/// // a dead band in front of a lag
/// let band = |u: f64| u - u.clamp(-0.5, 0.5);
/// let u: Vec<f64> = (0..600).map(|k| f64::from(k / 7 * 13 % 9) / 4.0 - 1.0).collect();
/// let mut y = vec![0.0; 600];
/// for k in 1..600 {
///     y[k] = 0.8 * y[k - 1] + 0.4 * band(u[k - 1]);
/// }
/// let records = [Record::new(&u, 1, &y)?];
/// let fit = hammerstein::fit(&records, 1, 1, 1, (8, 1), 100, &Monitor::default())?;
/// assert!(fit.cost < 1e-6);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
///
/// # Errors
/// As [`oe::fit`]; `ErrorKind::Setting` for pieces out of range.
pub fn fit(
    records: &[Record],
    na: usize,
    nb: usize,
    nk: usize,
    pieces: (usize, usize),
    max_iterations: usize,
    monitor: &Monitor,
) -> Result<Fit<HammersteinWiener>> {
    let linear = oe::fit(records, na, nb, nk, true, max_iterations, monitor)?;
    let (lags, channels) = (linear.model.lags(), linear.model.lags().channels);
    let inputs: Vec<Knots> = (0..channels)
        .map(|j| {
            let values = records
                .iter()
                .flat_map(|r| r.u.iter().skip(j).step_by(channels));
            knots(values, pieces.0)
        })
        .collect();
    // Curves over the ranges of the data. g begins as the identity, so the range of x is that of y.
    let output = knots(records.iter().flat_map(|r| r.y), pieces.1);
    output.check("output")?;
    inputs.iter().try_for_each(|knots| knots.check("input"))?;
    let straight = Parts::of(lags, &inputs, output);
    let mut theta = [linear.model.a(), linear.model.b(), &[linear.model.offset()]].concat();
    // Zeros are straight curves: the start runs like the linear model.
    theta.resize(straight.end, 0.0);
    let start = HammersteinWiener::new(lags, &inputs, output, theta)?;
    let states = &linear.initial_states;
    monitor.set_total(max_iterations as u64);
    output_error::fit(&start, states, records, RIDGE, max_iterations, monitor)
}

/// Knots over the range of the known values.
fn knots<'a>(values: impl Iterator<Item = &'a f64>, pieces: usize) -> Knots {
    // Gaps are NaN, which `min` and `max` skip.
    let empty = (f64::INFINITY, f64::NEG_INFINITY);
    let (low, high) = values.fold(empty, |(low, high), v| (low.min(*v), high.max(*v)));
    Knots { low, high, pieces }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Differentiable, Model};
    use crate::random::Random;
    use proptest::prelude::*;

    /// A stable model with bent curves.
    fn bent(seed: u64, channels: usize, nk: usize) -> HammersteinWiener {
        let mut random = Random::new(seed);
        let lags = Lags::new(2, 2, nk, channels).unwrap();
        let inputs: Vec<Knots> = (0..channels)
            .map(|j| Knots {
                low: -1.0,
                high: 2.0 + j as f64,
                pieces: 4 + j,
            })
            .collect();
        let output = Knots {
            low: -3.0,
            high: 5.0,
            pieces: 5,
        };
        let parts = Parts::of(lags, &inputs, output);
        let mut theta: Vec<f64> = (0..parts.end).map(|_| random.between(-0.3, 0.3)).collect();
        theta[..2].copy_from_slice(&[-1.2, 0.4]);
        for d in &mut theta[parts.slopes..] {
            *d *= 5.0;
        }
        HammersteinWiener::new(lags, &inputs, output, theta).unwrap()
    }

    fn inputs(seed: u64, channels: usize, samples: usize) -> Vec<f64> {
        let mut random = Random::new(seed);
        (0..samples * channels)
            .map(|_| random.between(-1.5, 3.5))
            .collect()
    }

    proptest! {
        #![proptest_config(crate::laws::cases(60))]
        #[test]
        fn the_output_curve_rises_and_is_inverted(seed in any::<u64>(), y in -20.0f64..20.0) {
            let g = bent(seed, 1, 1).output;
            let (x, slope) = g.inverse(y);
            let (back, same) = g.value_and_slope(x);
            prop_assert!((back - y).abs() <= 1e-12 * (1.0 + y.abs()), "{back} {y}");
            prop_assert!(slope >= 0.99 * LEAST_SLOPE && (slope - same).abs() < 1e-9 * slope || (x / g.knots.width()).fract().abs() < 1e-9);
            for end in [g.knots.low, g.knots.high] {
                prop_assert!((g.value_and_slope(end).0 - end).abs() < 1e-12);
            }
        }

        #[test]
        fn sensitivities_agree_with_differences(seed in any::<u64>(), channels in 1usize..3, nk in 0usize..3) {
            let model = bent(seed, channels, nk);
            let (u, past) = (inputs(seed ^ 1, channels, 25), [0.7, -0.4]);
            let (run, rows) = Differentiable::jacobian(&model, &u, channels, &past).unwrap();
            prop_assert_eq!(&run, &Lagged::simulate(&model, &u, channels, &past).unwrap());
            let shared = model.theta.len();
            let moved = |i: usize, by: f64| {
                let (mut theta, mut state) = (model.theta.clone(), past);
                match i.checked_sub(shared) {
                    None => theta[i] += by,
                    Some(m) => state[m] += by,
                }
                let other = model.with_theta(&theta).unwrap();
                Lagged::simulate(&other, &u, channels, &state).unwrap()
            };
            let columns = shared + 2;
            for i in 0..columns {
                let (ahead, behind) = (moved(i, 1e-6), moved(i, -1e-6));
                for k in 0..run.len() {
                    // a run that passes a knot within the step has two slopes there, and different ones after it
                    let forward = (ahead[k] - run[k]) / 1e-6;
                    let backward = (run[k] - behind[k]) / 1e-6;
                    if (forward - backward).abs() > 1e-3 * (1.0 + forward.abs()) {
                        break;
                    }
                    let difference = (forward + backward) / 2.0;
                    let found = rows[k * columns + i];
                    prop_assert!((found - difference).abs() < 1e-3 * (1.0 + difference.abs()), "{i} {k}: {found} {difference}");
                }
            }
        }
    }

    #[test]
    fn small_signals_are_those_of_the_pieces() {
        let model = bent(3, 1, 1);
        let (u, state) = ([0.4], [1.1, 0.9, 0.3]);
        let found = Model::linearise(&model, &u, &state).unwrap();
        let step = |u: f64, x: [f64; 3]| model.output(&[x[0], x[1], u, x[2]]);
        let difference = (step(0.4 + 1e-6, state) - step(0.4 - 1e-6, state)) / 2e-6;
        assert!((found.d[0] - difference).abs() < 1e-6);
        for i in 0..3 {
            let moved = |by: f64| {
                let mut x = state;
                x[i] += by;
                step(u[0], x)
            };
            let difference = (moved(1e-6) - moved(-1e-6)) / 2e-6;
            assert!((found.c[i] - difference).abs() < 1e-6, "{i}");
        }
    }

    #[test]
    fn finds_the_curves_that_made_the_data() {
        for seed in 1..=3 {
            let truth = bent(seed, 1, 1);
            let u: Vec<f64> = inputs(seed, 1, 300).iter().flat_map(|u| [*u; 5]).collect();
            let mut random = Random::new(9);
            let clean = Lagged::simulate(&truth, &u, 1, &[0.0, 0.0]).unwrap();
            let y: Vec<f64> = clean.iter().map(|y| y + 0.01 * random.normal()).collect();
            let records = [Record::new(&u, 1, &y).unwrap()];
            let monitor = Monitor::default();
            let linear = oe::fit(&records, 2, 2, 1, true, 100, &monitor).unwrap();
            // knots are not where the true ones are: many pieces come close, few do not
            let found = fit(&records, 2, 2, 1, (16, 16), 200, &monitor).unwrap();
            assert!(
                found.cost < 0.25 * linear.cost,
                "{seed}: {} {}",
                found.cost,
                linear.cost
            );
            let new = inputs(seed + 100, 1, 300);
            let (truth, own) = (
                Lagged::simulate(&truth, &new, 1, &[0.0, 0.0]).unwrap(),
                Lagged::simulate(&found.model, &new, 1, &[0.0, 0.0]).unwrap(),
            );
            let error: f64 = truth.iter().zip(&own).map(|(a, b)| (a - b).powi(2)).sum();
            let size: f64 = truth.iter().map(|a| a * a).sum();
            assert!(error < 0.02 * size, "{seed}: {}", error / size);
        }
    }

    #[test]
    fn puts_gaps_weights_and_several_records_into_one_cost() {
        let truth = bent(5, 1, 1);
        let u: Vec<f64> = inputs(5, 1, 60).iter().flat_map(|u| [*u; 5]).collect();
        let mut y = Lagged::simulate(&truth, &u, 1, &[0.2, 0.1]).unwrap();
        let mut random = Random::new(3);
        y.iter_mut().for_each(|y| *y += 0.05 * random.normal());
        y[40..60].fill(f64::NAN);
        let w = crate::laws::weights(300, 1);
        let records = [Record::with_gaps(&u, 1, &y).unwrap(); 2];
        let records = [records[0].with_weights(&w).unwrap(), records[1]];
        let monitor = Monitor::default();
        let found = fit(&records, 2, 2, 1, (16, 16), 60, &monitor).unwrap();
        assert_eq!(found.initial_states.len(), 2);
        assert!(found.trace.windows(2).all(|pair| pair[1] < pair[0]));
        assert!(found.cost < 5e-3 && found.cost > 0.0, "{}", found.cost);
    }

    #[test]
    fn refuses_what_is_no_model() {
        let model = bent(1, 1, 1);
        let (lags, inputs, output) = (model.lags, model.input_knots(), model.output_knots());
        let flat = Knots {
            low: 1.0,
            high: 1.0,
            pieces: 3,
        };
        let none = Knots {
            pieces: 0,
            ..output
        };
        let theta = model.theta.clone();
        let refused = |inputs: &[Knots], output, theta| {
            HammersteinWiener::new(lags, inputs, output, theta)
                .unwrap_err()
                .message
        };
        assert!(refused(&[flat], output, theta.clone()).contains("input"));
        assert!(refused(&inputs, none, theta.clone()).contains("0 from"));
        assert!(refused(&[], output, theta.clone()).contains("each of 1 inputs"));
        assert!(refused(&inputs, output, theta[1..].to_vec()).contains("parameters"));
        let mut wild = theta;
        wild[4] = f64::NAN;
        assert!(refused(&inputs, output, wild).contains("finite"));
        let unstable = [vec![-2.5, 1.0], model.theta[2..].to_vec()].concat();
        assert!(model.with_theta(&unstable).is_none());
    }
}
