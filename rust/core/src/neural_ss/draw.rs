//! Start parameters: a linear model with a hidden layer that hardly affects it yet, or a smaller trained model.

use std::ops::Range;

use nalgebra::{DMatrix, DVector, RowDVector};

use super::NeuralSS;
use super::problem::Experiment;
use super::shape::{Scaling, Shape};
use super::state::Statistics;
use crate::lagged::Lagged;
use crate::linear::{LinearModel, companion};
use crate::random::Random;
use crate::{Error, Result};

/// Most first samples of an experiment that do not count, because they depend on its initial state.
const SETTLING: usize = 200;
/// Directions in which the states vary less than this, relative to all of them, are scaled as if they varied by it.
const FLOOR: f64 = 1e-13;

/// Standard deviation of E and G: enough to distinguish the hidden units.
const REACH: f64 = 1e-3;
/// Poles of a start without a linear model: fast and slow ones.
pub(super) const POLES: (f64, f64) = (0.5, 0.99);
/// Added to the normal equations of the output, relative to their mean.
const RIDGE: f64 = 1e-9;

/// Share of an integrator's starts that have a unit which switches with the sign of the speed.
const SWITCHING: f64 = 0.5;
/// Slopes of such a unit at rest, per standard deviation of the speed: friction switches within a small part of it.
const SLOPES: (f64, f64) = (2.0, 30.0);

// --- A linear model as state equations, with states of unit covariance on the training inputs ---

/// `x+ = A x + B v`, `y = C x + D v + c` in scaled units.
#[derive(Clone, Debug)]
pub(super) struct Realisation {
    pub a: DMatrix<f64>,
    pub b: DMatrix<f64>,
    pub c: DMatrix<f64>,
    pub d: DMatrix<f64>,
    pub constant: f64,
}

impl Realisation {
    /// The observer form of a linear difference equation (Ljung 1999, section 4.3), its states scaled.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a model that does not fit the shape, `ErrorKind::Fit` for one that is not stable.
    pub fn of(
        linear: &LinearModel,
        shape: Shape,
        scaling: &Scaling,
        experiments: &[Experiment],
    ) -> Result<Self> {
        let observer = Self::observer(linear, shape, scaling)?;
        let split = if shape.integrator {
            observer.integrating()?
        } else {
            observer
        };
        split.normalised(shape, experiments).ok_or_else(|| {
            Error::fit("expected a linear model whose states stay finite on the training inputs, got one that runs away; identify it with output error, whose poles are stable")
        })
    }

    fn observer(linear: &LinearModel, shape: Shape, scaling: &Scaling) -> Result<Self> {
        let (lags, nx) = (linear.lags(), shape.nx);
        let shift = lags.nk.checked_sub(shape.nk);
        let reach = shift.map(|shift| lags.na.max(shift + lags.nb - 1));
        let (Some(shift), true) = (shift, reach.is_some_and(|n| n <= nx)) else {
            return Err(Error::setting(format!(
                "expected a linear model of order {nx} with a delay of {} or a little more, got {lags:?}; fit one with na = nx, nb of at most nx + 1 and the same nk",
                shape.nk
            )));
        };
        if lags.channels != shape.inputs {
            return Err(Error::setting(format!(
                "expected a linear model with {} inputs, got one with {}; fit it to the same record",
                shape.inputs, lags.channels
            )));
        }
        let mut a = vec![0.0; nx + 1];
        a[1..=lags.na].copy_from_slice(linear.a());
        let scale = |j: usize| scaling.u_scale[j] / scaling.y_scale;
        let b = |i: usize, j: usize| match i.checked_sub(shift) {
            Some(i) if i < lags.nb => linear.b()[j * lags.nb + i] * scale(j),
            _ => 0.0,
        };
        let held = a.iter().sum::<f64>() + 1.0;
        let gains = linear.b().chunks_exact(lags.nb).zip(&scaling.u_mean);
        let moved: f64 = gains.map(|(b, u)| b.iter().sum::<f64>() * u).sum();
        let level = (linear.offset() + moved) / held;
        // An integrator has no level of its own: its state holds it.
        let constant = if held.abs() > 1e-9 {
            scaling.output(level)
        } else {
            0.0
        };
        Ok(Self {
            a: companion(&a[1..=nx]).transpose(),
            b: DMatrix::from_fn(nx, shape.inputs, |i, j| b(i + 1, j) - a[i + 1] * b(0, j)),
            c: DMatrix::from_fn(1, nx, |_, j| f64::from(u8::from(j == 0))),
            d: DMatrix::from_fn(1, shape.inputs, |_, j| b(0, j)),
            constant,
        })
    }

    /// The same with the slowest real mode as the last state, its pole moved to 1.
    fn integrating(&self) -> Result<Self> {
        let n = self.a.nrows();
        let poles = self.a.complex_eigenvalues();
        let real = poles
            .iter()
            .filter(|p| p.im.abs() <= 1e-9 * p.re.abs() && p.re > 0.0);
        let pole = real.map(|p| p.re).max_by(f64::total_cmp).ok_or_else(|| {
            Error::setting("expected a linear model with a slow real pole to become the integrator, got none; leave the integrator out")
        })?;
        let shifted = &self.a - DMatrix::identity(n, n) * pole;
        let singular = shifted.svd(true, true);
        let (Some(u), Some(vt)) = (singular.u, singular.v_t) else {
            return Err(Error::fit(
                "expected modes of the linear model, found none; leave the integrator out",
            ));
        };
        let smallest = singular.singular_values.imin();
        // the other right singular vectors span the orthogonal complement of the mode: states that it does not affect
        let others = (0..n)
            .filter(|&i| i != smallest)
            .map(|i| vt.row(i).into_owned());
        let rows: Vec<_> = others.chain([u.column(smallest).transpose()]).collect();
        let transform = DMatrix::from_rows(&rows);
        let mut moved = self.transformed(&transform).ok_or_else(|| {
            Error::fit("expected a slow mode apart from the others, got one that repeats; leave the integrator out")
        })?;
        (0..n).for_each(|i| moved.a[(i, n - 1)] = 0.0);
        moved.a[(n - 1, n - 1)] = 1.0;
        Ok(moved)
    }

    /// The same system in the coordinates `T x`.
    fn transformed(&self, transform: &DMatrix<f64>) -> Option<Self> {
        let inverse = transform.clone().try_inverse()?;
        Some(Self {
            a: transform * &self.a * &inverse,
            b: transform * &self.b,
            c: &self.c * &inverse,
            ..self.clone()
        })
    }

    /// With states of unit covariance on the inputs of these experiments; `None` if they do not stay finite.
    pub fn normalised(&self, shape: Shape, experiments: &[Experiment]) -> Option<Self> {
        let n = self.a.nrows();
        let covariance = self.covariance(shape, experiments)?;
        let free = if shape.integrator { n - 1 } else { n };
        let mut transform = DMatrix::identity(n, n);
        if free > 0 {
            let block = covariance.view((0, 0), (free, free)).into_owned();
            transform
                .view_mut((0, 0), (free, free))
                .copy_from(&whitening(block)?);
        }
        if shape.integrator {
            transform[(n - 1, n - 1)] =
                1.0 / covariance[(n - 1, n - 1)].sqrt().max(f64::MIN_POSITIVE);
        }
        let scaled = self.transformed(&transform)?;
        let parts = [&scaled.a, &scaled.b, &scaled.c, &scaled.d];
        let finite = parts.iter().all(|part| part.iter().all(|v| v.is_finite()));
        finite.then_some(scaled)
    }

    /// Covariance of the states; `None` if they do not stay finite.
    fn covariance(&self, shape: Shape, experiments: &[Experiment]) -> Option<DMatrix<f64>> {
        let n = self.a.nrows();
        let (mut sum, mut products, mut count) = (DVector::zeros(n), DMatrix::zeros(n, n), 0.0);
        for experiment in experiments {
            let samples = experiment.v.len() / shape.inputs;
            let mut x = DVector::zeros(n);
            for (k, v) in experiment.v.chunks_exact(shape.inputs).enumerate() {
                if k >= SETTLING.min(samples / 10) {
                    sum += &x;
                    products.ger(1.0, &x, &x, 1.0);
                    count += 1.0;
                }
                x = &self.a * &x + &self.b * DVector::from_column_slice(v);
            }
        }
        let mean = sum / count;
        let covariance = products / count - &mean * mean.transpose();
        covariance
            .iter()
            .all(|v: &f64| v.is_finite())
            .then_some(covariance)
    }

    /// The parameters, with a hidden layer of zeros.
    pub fn theta(&self, shape: Shape) -> Vec<f64> {
        let parts = shape.parts();
        let mut theta = vec![0.0; shape.parameters()];
        let mut put = |range: std::ops::Range<usize>, matrix: &DMatrix<f64>| {
            let rows = matrix
                .row_iter()
                .flat_map(|row| row.iter().copied().collect::<Vec<_>>());
            theta[range].iter_mut().zip(rows).for_each(|(t, v)| *t = v);
        };
        put(parts.a, &self.a);
        put(parts.b, &self.b);
        put(parts.c, &self.c);
        put(parts.d, &self.d);
        theta[parts.constant.start] = self.constant;
        theta
    }
}

/// The inverse of the symmetric square root of a covariance.
fn whitening(covariance: DMatrix<f64>) -> Option<DMatrix<f64>> {
    let eigen = covariance.try_symmetric_eigen(f64::EPSILON, 1000)?;
    let floor = (FLOOR * eigen.eigenvalues.sum()).max(f64::MIN_POSITIVE);
    let inverse_roots = eigen.eigenvalues.map(|v| 1.0 / v.max(floor).sqrt());
    Some(
        &eigen.eigenvectors
            * DMatrix::from_diagonal(&inverse_roots)
            * eigen.eigenvectors.transpose(),
    )
}

// --- The start of a network ---

/// The realisation beside hidden units: normal weights with standard deviation `scale/sqrt(nx + nu)`, uniform biases
/// from -1 to 1, small `E` and `G`.
pub(super) fn beside(
    linear: &Realisation,
    shape: Shape,
    scale: f64,
    random: &mut Random,
) -> Vec<f64> {
    let mut theta = linear.theta(shape);
    hide(&mut theta, shape, scale, random);
    if shape.integrator && random.between(0.0, 1.0) < SWITCHING {
        switch(&mut theta, linear, shape, random);
    }
    shape.hold(&mut theta);
    theta
}

/// Draws the weights of the hidden units.
pub(super) fn hide(theta: &mut [f64], shape: Shape, scale: f64, random: &mut Random) {
    let parts = shape.parts();
    let width = scale / (shape.arguments() as f64).sqrt();
    theta[parts.wx.start..parts.wu.end].fill_with(|| width * random.normal());
    theta[parts.bh].fill_with(|| random.between(-1.0, 1.0));
    theta[parts.e].fill_with(|| REACH * random.normal());
    theta[parts.g].fill_with(|| REACH * random.normal());
}

/// Turns the first hidden unit into a smooth sign of the speed.
///
/// A position is the sum of a speed, and motion is resisted by friction. Dry friction jumps when the speed changes its
/// sign, and training hardly ever finds that jump from smooth random units.
fn switch(theta: &mut [f64], linear: &Realisation, shape: Shape, random: &mut Random) {
    let parts = shape.parts();
    let slope = random.between(SLOPES.0.ln(), SLOPES.1.ln()).exp();
    let speed = linear.speed();
    let deviation = speed.norm();
    if deviation > 0.0 {
        (0..shape.nx).for_each(|j| theta[parts.wx.start + j] = slope * speed[j] / deviation);
        theta[parts.wu.start..][..shape.inputs].fill(0.0);
        theta[parts.bh.start] = 0.0;
    }
}

/// Random states that decay at different rates, with an output equation fitted to the data; `None` if these are not
/// finite.
pub(super) fn small(
    shape: Shape,
    experiments: &[Experiment],
    random: &mut Random,
) -> Option<Realisation> {
    let (nx, last) = (shape.nx, shape.nx - 1);
    let free = if shape.integrator { last } else { nx };
    let mut states = Realisation {
        a: DMatrix::zeros(nx, nx),
        b: DMatrix::from_fn(nx, shape.inputs, |_, _| random.normal()),
        c: DMatrix::zeros(1, nx),
        d: DMatrix::zeros(1, shape.inputs),
        constant: 0.0,
    };
    (0..free).for_each(|i| states.a[(i, i)] = random.between(POLES.0, POLES.1));
    if shape.integrator {
        (0..free).for_each(|j| states.a[(last, j)] = random.normal());
        states.a[(last, last)] = 1.0;
    }
    states
        .normalised(shape, experiments)?
        .with_output(shape, experiments)
}

impl Realisation {
    /// The states' part in the change of the output from one sample to the next.
    fn speed(&self) -> RowDVector<f64> {
        self.c.row(0) * &self.a - self.c.row(0)
    }

    /// With `C`, `D` and `c` fitted to the output by least squares.
    fn with_output(mut self, shape: Shape, experiments: &[Experiment]) -> Option<Self> {
        let (nx, width) = (shape.nx, shape.arguments() + 1);
        let (mut left, mut right) = (DMatrix::zeros(width, width), DVector::zeros(width));
        for experiment in experiments {
            let mut x = DVector::zeros(nx);
            for (v, y) in experiment.v.chunks_exact(shape.inputs).zip(&experiment.y) {
                let row = x.iter().chain(v).copied().chain([1.0]);
                let row = DVector::from_iterator(width, row);
                if !y.is_nan() {
                    left.ger(1.0, &row, &row, 1.0);
                    right.axpy(*y, &row, 1.0);
                }
                x = &self.a * &x + &self.b * DVector::from_column_slice(v);
            }
        }
        let ridge = RIDGE * left.trace() / width as f64;
        let found = (left + DMatrix::identity(width, width) * ridge)
            .cholesky()?
            .solve(&right);
        (0..nx).for_each(|j| self.c[j] = found[j]);
        (0..shape.inputs).for_each(|j| self.d[j] = found[nx + j]);
        self.constant = found[width - 1];
        Some(self)
    }
}

/// Poles of new states: fast and slow ones.
const NEW_POLES: (f64, f64) = (0.5, 0.98);
/// Weights of old states and inputs on a new state, times `sqrt(1 - a^2)` for its pole `a`.
const DRIVE: f64 = 0.5;
/// Weights of new states and units on the old model.
const NEW_REACH: f64 = 1e-3;

/// Maps of the row and column indices of a matrix to their new places.
type Places<'a> = (&'a dyn Fn(usize) -> usize, &'a dyn Fn(usize) -> usize);

impl NeuralSS {
    /// This model with `nx` states and `hidden` units: the existing ones with all their weights, and new ones.
    ///
    /// New states follow the old ones and the inputs with poles from .5 to .98; new hidden units see everything. Their
    /// weights on the rest are about 1e-3: the free run hardly changes, and training has a slope to begin with. An
    /// integrated state stays the last one, all others keep their places. A state of this model corresponds to the same
    /// state extended by the new states' means.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for sizes below the present ones, or out of range.
    pub fn grown(&self, nx: usize, hidden: usize, seed: u64) -> Result<Self> {
        let old = self.shape();
        if nx < old.nx || hidden < old.hidden {
            return Err(Error::setting(format!(
                "expected at least the {} states and {} hidden units that the model has, got nx {nx} and hidden {hidden}; train a smaller model anew",
                old.nx, old.hidden
            )));
        }
        let new = Shape { nx, hidden, ..old }.checked()?;
        let mut random = Random::new(seed);
        let (from, to) = (old.parts(), new.parts());
        let fresh = old.nx - usize::from(old.integrator)..nx - usize::from(old.integrator);
        let place = |i: usize| if i < fresh.start { i } else { i + fresh.len() };
        // everything is drawn, then existing weights overwrite their places
        let mut theta = vec![0.0; new.parameters()];
        let width = 1.0 / (new.arguments() as f64).sqrt();
        for (part, scale) in [
            (&to.e, NEW_REACH),
            (&to.g, NEW_REACH),
            (&to.wx, width),
            (&to.wu, width),
        ] {
            theta[part.clone()].fill_with(|| scale * random.normal());
        }
        theta[to.bh.clone()].fill_with(|| random.between(-1.0, 1.0));
        self.tame(&mut theta[to.e.clone()], hidden, place);
        for i in 0..old.hidden {
            theta[to.wx.start + i * nx..][fresh.clone()].fill(0.0);
        }
        let same = |i: usize| i;
        let mut keep =
            |from: Range<usize>, to: Range<usize>, columns: (usize, usize), places: Places| {
                for (k, value) in self.theta[from].iter().enumerate() {
                    let (row, column) = (places.0(k / columns.0), places.1(k % columns.0));
                    theta[to.start + row * columns.1 + column] = *value;
                }
            };
        keep(from.a, to.a.clone(), (old.nx, nx), (&place, &place));
        keep(
            from.b,
            to.b.clone(),
            (old.inputs, old.inputs),
            (&place, &same),
        );
        keep(from.e, to.e, (old.hidden, hidden), (&place, &same));
        keep(from.wx, to.wx, (old.nx, nx), (&same, &place));
        keep(from.wu, to.wu, (old.inputs, old.inputs), (&same, &same));
        keep(from.bh, to.bh, (1, 1), (&same, &same));
        keep(from.c, to.c.clone(), (old.nx, nx), (&same, &place));
        keep(from.d, to.d, (old.inputs, old.inputs), (&same, &same));
        keep(from.constant, to.constant, (1, 1), (&same, &same));
        keep(from.g, to.g, (old.hidden, hidden), (&same, &same));
        let mut statistics = self.grown_statistics(nx, place);
        for state in fresh.clone() {
            let pole = random.between(NEW_POLES.0, NEW_POLES.1);
            let drive = DRIVE * (1.0 - pole * pole).sqrt();
            let row = &mut theta[to.a.start + state * nx..][..nx];
            row[..fresh.start].fill_with(|| drive * random.normal());
            let means = row.iter().zip(&statistics.state_mean);
            let mean = means
                .take(fresh.start)
                .map(|(a, mean)| a * mean)
                .sum::<f64>();
            let variances = statistics.state_covariance.iter().step_by(nx + 1);
            let states = row.iter().zip(variances).take(fresh.start);
            let of_states = states.map(|(a, variance)| a * a * variance).sum::<f64>();
            row[state] = pole;
            let row = &mut theta[to.b.start + state * new.inputs..][..new.inputs];
            row.fill_with(|| drive * random.normal());
            let of_inputs = row.iter().map(|b| b * b).sum::<f64>();
            statistics.state_mean[state] = mean / (1.0 - pole);
            // a slow input brings the state to this size, at which it should move the output no further than at size 1
            let size = (of_states + of_inputs).sqrt() / (1.0 - pole);
            theta[to.c.start + state] = NEW_REACH * random.normal() / size.max(1.0);
        }
        new.hold(&mut theta);
        Self::new(new, self.output(), theta, self.scaling.clone(), statistics)
    }

    /// Multiplies the weights `e` of all units on the old states by `1 - dx+/dx` at the mean state: a slow state sums
    /// up its inputs and would settle that much further away.
    fn tame(&self, e: &mut [f64], hidden: usize, place: impl Fn(usize) -> usize) {
        let nx = self.shape().nx;
        let (parts, mean) = (self.shape().parts(), &self.statistics.state_mean);
        let wx = DMatrix::from_row_slice(self.shape().hidden, nx, &self.theta[parts.wx]);
        let (a, own) = (&self.theta[parts.a], &self.theta[parts.e]);
        let argument = &wx * DVector::from_column_slice(mean)
            + DVector::from_column_slice(&self.theta[parts.bh]);
        let slopes = argument.map(|z| 1.0 - z.tanh() * z.tanh());
        let passed = DMatrix::from_row_slice(nx, self.shape().hidden, own)
            * DMatrix::from_diagonal(&slopes)
            * wx;
        let left = DMatrix::identity(nx, nx) - DMatrix::from_row_slice(nx, nx, a) - passed;
        let drawn = DMatrix::from_fn(nx, hidden, |i, unit| e[place(i) * hidden + unit]);
        let tamed = left * drawn;
        for i in 0..nx {
            (0..hidden).for_each(|unit| e[place(i) * hidden + unit] = tamed[(i, unit)]);
        }
    }

    /// Mean and covariance, extended by new states of zero mean and unit variance.
    fn grown_statistics(&self, nx: usize, place: impl Fn(usize) -> usize) -> Statistics {
        let (kept, own) = (self.shape().nx, &self.statistics);
        let mut state_mean = vec![0.0; nx];
        let unit = (0..nx * nx).map(|i| f64::from(u8::from(i % (nx + 1) == 0)));
        let mut state_covariance: Vec<f64> = unit.collect();
        for i in 0..kept {
            state_mean[place(i)] = own.state_mean[i];
            for j in 0..kept {
                state_covariance[place(i) * nx + place(j)] = own.state_covariance[i * kept + j];
            }
        }
        Statistics {
            state_mean,
            state_covariance,
            ..own.clone()
        }
    }
}
