//! Start parameters: a linear model with a hidden layer that hardly reaches it yet.

use nalgebra::{DMatrix, DVector, RowDVector};

use super::problem::Experiment;
use super::realisation::Realisation;
use super::shape::Shape;
use crate::random::Random;

/// Standard deviation of E and G: enough to tell the hidden units apart.
const REACH: f64 = 1e-3;
/// Poles of a start without a linear model: fast and slow ones.
pub(super) const POLES: (f64, f64) = (0.5, 0.99);
/// Added to the normal equations of the outputs, relative to their mean.
const RIDGE: f64 = 1e-9;

/// Half of the starts of an integrator have a unit that switches with the sign of the speed.
const SWITCHING: f64 = 0.5;
/// Slopes of such a unit at rest, in deviations of the speed: friction switches within a small part of them.
const SLOPES: (f64, f64) = (2.0, 30.0);

/// The realisation beside hidden units: weights normal with standard deviation `scale/sqrt(nx + nu)`, biases uniform
/// from -1 to 1, `E` and `G` small.
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

/// Draws the hidden units.
pub(super) fn hide(theta: &mut [f64], shape: Shape, scale: f64, random: &mut Random) {
    let parts = shape.parts();
    let width = scale / (shape.arguments() as f64).sqrt();
    theta[parts.wx.start..parts.wu.end].fill_with(|| width * random.normal());
    theta[parts.bh].fill_with(|| random.between(-1.0, 1.0));
    theta[parts.e].fill_with(|| REACH * random.normal());
    theta[parts.g].fill_with(|| REACH * random.normal());
}

/// The first hidden unit becomes a smooth sign of the speed.
///
/// A position is the sum of a speed, and what resists a motion is friction: dry friction jumps where the speed changes
/// its sign, and training hardly ever finds that jump from smooth random units.
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

/// Random states that decay at different rates, with the outputs that come nearest to the data; none where these are
/// not finite.
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
        c: DMatrix::zeros(shape.outputs, nx),
        d: DMatrix::zeros(shape.outputs, shape.inputs),
        constant: DVector::zeros(shape.outputs),
    };
    (0..free).for_each(|i| states.a[(i, i)] = random.between(POLES.0, POLES.1));
    if shape.integrator {
        (0..free).for_each(|j| states.a[(last, j)] = random.normal());
        states.a[(last, last)] = 1.0;
    }
    states
        .normalised(shape, experiments)?
        .with_outputs(shape, experiments)
}

impl Realisation {
    /// What the states add to the first output from one sample to the next, beside the input's part.
    fn speed(&self) -> RowDVector<f64> {
        self.c.row(0) * &self.a - self.c.row(0)
    }

    /// With `C`, `D` and `c` by least squares over the states.
    fn with_outputs(mut self, shape: Shape, experiments: &[Experiment]) -> Option<Self> {
        let (nx, width) = (shape.nx, shape.arguments() + 1);
        for p in 0..shape.outputs {
            let (mut left, mut right) = (DMatrix::zeros(width, width), DVector::zeros(width));
            for experiment in experiments {
                let mut x = DVector::zeros(nx);
                let outputs = experiment.y.chunks_exact(shape.outputs);
                for (v, y) in experiment.v.chunks_exact(shape.inputs).zip(outputs) {
                    let row = x.iter().chain(v).copied().chain([1.0]);
                    let row = DVector::from_iterator(width, row);
                    if !y[p].is_nan() {
                        left.ger(1.0, &row, &row, 1.0);
                        right.axpy(y[p], &row, 1.0);
                    }
                    x = &self.a * &x + &self.b * DVector::from_column_slice(v);
                }
            }
            let ridge = RIDGE * left.trace() / width as f64;
            let found = (left + DMatrix::identity(width, width) * ridge)
                .cholesky()?
                .solve(&right);
            (0..nx).for_each(|j| self.c[(p, j)] = found[j]);
            (0..shape.inputs).for_each(|j| self.d[(p, j)] = found[nx + j]);
            self.constant[p] = found[width - 1];
        }
        Some(self)
    }
}
