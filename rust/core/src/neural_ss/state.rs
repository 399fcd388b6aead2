//! States of a model on new data: the maximum a posteriori estimate from a record's first samples, and the state at rest.

use super::network::{Network, Scratch, rises_of};
use super::shape::Shape;
use crate::lm::{cholesky, substitute};
use crate::simd::{self, F64x8, Kernel};
use crate::{Error, Result};

/// Most steps of one descent, which almost always ends earlier.
const STEPS: usize = 40;
/// Added to the diagonal of a covariance, relative to its mean: states may be linearly dependent.
const RIDGE: f64 = 1e-8;
/// Most times that the ridge is multiplied by a hundred.
const MOST_RIDGES: usize = 10;

/// Training results of a model beside its parameters, in scaled units: the prior of a state before any output is
/// measured, and the variances of output and equations.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistics {
    /// Mean of the training states.
    pub state_mean: Vec<f64>,
    /// Their covariance, row by row.
    pub state_covariance: Vec<f64>,
    /// Variance of the output's residual in free run.
    pub residual_variance: f64,
    /// Process noise of the Kalman filter, relative to the states' covariance.
    pub process_noise: f64,
}

impl Statistics {
    /// Refuses invalid statistics.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for wrong lengths, values that are not finite, negative variances, or a residual variance
    /// of zero.
    pub(super) fn check(&self, shape: Shape) -> Result<()> {
        let nx = shape.nx;
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        let sound = self.state_mean.len() == nx
            && self.state_covariance.len() == nx * nx
            && finite(&self.state_mean)
            && finite(&self.state_covariance)
            && (0..nx).all(|i| self.state_covariance[i * nx + i] >= 0.0)
            && self.residual_variance > 0.0
            && self.residual_variance.is_finite()
            && self.process_noise >= 0.0
            && self.process_noise.is_finite();
        if sound {
            return Ok(());
        }
        Err(Error::setting(format!(
            "expected state_mean ({nx},), state_covariance ({nx}, {nx}), residual_variance above 0 and process_noise of 0 or more, all finite, got {self:?}; identify the model again"
        )))
    }

    /// The lower Cholesky factor of the covariance.
    fn factor(&self) -> Vec<f64> {
        let n = self.state_mean.len();
        let mean = (0..n)
            .map(|i| self.state_covariance[i * n + i])
            .sum::<f64>()
            / n as f64;
        let mut ridge = RIDGE * mean.max(1e-300);
        for _ in 0..MOST_RIDGES {
            let mut factor = self.state_covariance.clone();
            (0..n).for_each(|i| factor[i * n + i] += ridge);
            if cholesky(&mut factor, n) {
                return factor;
            }
            ridge *= 100.0;
        }
        // No usable covariance: every state gets a variance of 1.
        (0..n * n)
            .map(|i| f64::from(u8::from(i % (n + 1) == 0)))
            .collect()
    }

    /// The mean, and points one standard deviation to either side along each column of the factor.
    fn starts(&self, factor: &[f64]) -> Vec<Vec<f64>> {
        let n = self.state_mean.len();
        let beside = |c: usize, sign: f64| {
            (0..n).map(move |i| {
                let part = if c <= i { factor[i * n + c] } else { 0.0 };
                self.state_mean[i] + sign * part
            })
        };
        let sides = (0..n).flat_map(|c| [1.0, -1.0].map(|sign| beside(c, sign).collect()));
        std::iter::once(self.state_mean.clone())
            .chain(sides)
            .collect()
    }
}

/// A sum of squares with its normal equations at a state.
trait Squares {
    /// The sum at `x`; fills `normal` (row by row) and `gradient`.
    fn evaluate(&mut self, x: &[f64], normal: &mut [f64], gradient: &mut [f64]) -> f64;
}

/// Levenberg-Marquardt for few variables: the least sum and its place, if it is finite.
fn descend(squares: &mut impl Squares, mut x: Vec<f64>) -> Option<(f64, Vec<f64>)> {
    let n = x.len();
    let (mut normal, mut gradient) = (vec![0.0; n * n], vec![0.0; n]);
    let (mut other_normal, mut other_gradient) = (normal.clone(), gradient.clone());
    let mut sum = squares.evaluate(&x, &mut normal, &mut gradient);
    let mut damping = 1e-3;
    for _ in 0..STEPS {
        if !sum.is_finite() {
            return None;
        }
        let mut factor = normal.clone();
        for i in 0..n {
            factor[i * n + i] *= 1.0 + damping;
            factor[i * n + i] += f64::MIN_POSITIVE;
        }
        let mut trial = gradient.clone();
        if !cholesky(&mut factor, n) {
            damping *= 10.0;
            continue;
        }
        substitute(&factor, n, &mut trial);
        trial.iter_mut().zip(&x).for_each(|(step, x)| *step += x);
        let reached = squares.evaluate(&trial, &mut other_normal, &mut other_gradient);
        if reached <= sum {
            let done = sum - reached <= 1e-13 * sum;
            (x, sum) = (trial, reached);
            std::mem::swap(&mut normal, &mut other_normal);
            std::mem::swap(&mut gradient, &mut other_gradient);
            damping *= 0.05;
            if done {
                break;
            }
        } else {
            damping = (damping * 8.0).max(1e-6);
        }
    }
    sum.is_finite().then_some((sum, x))
}

fn best(found: impl Iterator<Item = (f64, Vec<f64>)>) -> Option<Vec<f64>> {
    found.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, x)| x)
}

/// The state `x(0)` that maximises the posterior: least `sum e^2/r + (x - m)' P^-1 (x - m)`; `None` if every start
/// diverges. Outputs that are NaN do not count. `also` are further starts.
pub(super) fn estimate(
    network: &Network,
    prior: &Statistics,
    v: &[f64],
    y: &[f64],
    also: &[Vec<f64>],
) -> Option<Vec<f64>> {
    let factor = prior.factor();
    let starts = prior.starts(&factor);
    let mut posterior = Posterior::new(network, prior, &factor, v, y);
    best(
        starts
            .iter()
            .chain(also)
            .filter_map(|start| descend(&mut posterior, start.clone())),
    )
}

/// As [`estimate`], but only from the given starts: for a model that moved little since the last estimate.
pub(super) fn update(
    network: &Network,
    prior: &Statistics,
    v: &[f64],
    y: &[f64],
    starts: &[Vec<f64>],
) -> Option<Vec<f64>> {
    let factor = prior.factor();
    let mut posterior = Posterior::new(network, prior, &factor, v, y);
    best(
        starts
            .iter()
            .filter_map(|start| descend(&mut posterior, start.clone())),
    )
}

/// The state at which the model rests: least `|x+ - x|^2 + |y|^2` at input zero, where `y` is the output in scaled
/// units above `zero`.
pub(super) fn rest(network: &Network, prior: &Statistics, v: &[f64], zero: f64) -> Vec<f64> {
    let factor = prior.factor();
    let mut starts = prior.starts(&factor);
    starts.push(vec![0.0; prior.state_mean.len()]);
    let mut still = Still {
        network,
        v,
        zero,
        scratch: Scratch::new(network.shape),
    };
    best(
        starts
            .into_iter()
            .filter_map(|start| descend(&mut still, start)),
    )
    .unwrap_or_else(|| prior.state_mean.clone())
}

struct Posterior<'a> {
    network: &'a Network,
    prior: &'a Statistics,
    /// Inverse of the prior's covariance.
    inverse: Vec<f64>,
    v: &'a [f64],
    y: &'a [f64],
    scratch: Scratch,
    /// `dx/dx0`, row by row, and a buffer for the next.
    sensitivity: Vec<f64>,
    moved: Vec<f64>,
}

impl<'a> Posterior<'a> {
    fn new(
        network: &'a Network,
        prior: &'a Statistics,
        factor: &[f64],
        v: &'a [f64],
        y: &'a [f64],
    ) -> Self {
        let n = prior.state_mean.len();
        let mut inverse = vec![0.0; n * n];
        for (i, column) in inverse.chunks_exact_mut(n).enumerate() {
            column[i] = 1.0;
            substitute(factor, n, column);
        }
        Self {
            network,
            prior,
            inverse,
            v,
            y,
            scratch: Scratch::new(network.shape),
            sensitivity: vec![0.0; n * n],
            moved: vec![0.0; n * n],
        }
    }
}

impl Squares for Posterior<'_> {
    fn evaluate(&mut self, x: &[f64], normal: &mut [f64], gradient: &mut [f64]) -> f64 {
        simd::run(Evaluation {
            posterior: self,
            x,
            normal,
            gradient,
        })
    }
}

/// One evaluation of a posterior, as a kernel.
struct Evaluation<'e, 'a> {
    posterior: &'e mut Posterior<'a>,
    x: &'e [f64],
    normal: &'e mut [f64],
    gradient: &'e mut [f64],
}

impl Kernel for Evaluation<'_, '_> {
    type Output = f64;

    #[inline(always)]
    fn run<V: F64x8>(self) -> f64 {
        let Self {
            posterior,
            x,
            normal,
            gradient,
        } = self;
        let Posterior {
            network,
            prior,
            inverse,
            v,
            y,
            scratch,
            sensitivity,
            moved,
        } = posterior;
        let Shape { nx, inputs, .. } = network.shape;
        let mut sum = 0.0;
        normal.copy_from_slice(inverse);
        for (i, gradient) in gradient.iter_mut().enumerate() {
            let off = |j: usize| prior.state_mean[j] - x[j];
            *gradient = (0..nx).map(|j| inverse[i * nx + j] * off(j)).sum();
            sum += *gradient * off(i);
        }
        sensitivity.fill(0.0);
        (0..nx).for_each(|i| sensitivity[i * nx + i] = 1.0);
        scratch.next.copy_from_slice(x);
        let weight = 1.0 / prior.residual_variance;
        for (v, y) in v.chunks_exact(inputs).zip(*y) {
            step_with_slopes::<V>(network, scratch, v);
            if !y.is_nan() {
                let (value, steepness) = network.output.value_and_slope(scratch.sum);
                sum += weight * (y - value) * (y - value);
                let row = &mut moved[..nx];
                for (i, row) in row.iter_mut().enumerate() {
                    let slope = |j: usize| scratch.slope(nx * nx + j);
                    *row = steepness
                        * (0..nx)
                            .map(|j| slope(j) * sensitivity[j * nx + i])
                            .sum::<f64>();
                }
                for i in 0..nx {
                    gradient[i] += weight * (y - value) * row[i];
                    (0..nx).for_each(|j| normal[i * nx + j] += weight * row[i] * row[j]);
                }
            }
            for q in 0..nx {
                for i in 0..nx {
                    moved[q * nx + i] = (0..nx)
                        .map(|j| scratch.slope(q * nx + j) * sensitivity[j * nx + i])
                        .sum();
                }
            }
            std::mem::swap(sensitivity, moved);
        }
        sum
    }
}

/// A step from `scratch.next`, and its slopes.
#[inline(always)]
pub(super) fn step_with_slopes<V: F64x8>(network: &Network, scratch: &mut Scratch, v: &[f64]) {
    scratch.go_on(v);
    let Scratch {
        arguments,
        hidden,
        next,
        sum,
        rises,
        slopes,
    } = scratch;
    *sum = network.step::<V, 0>(arguments, hidden, next);
    rises_of::<V>(hidden, rises);
    network.slopes::<V>(rises, slopes);
}

/// The distance from rest, as a sum of squares.
struct Still<'a> {
    network: &'a Network,
    v: &'a [f64],
    zero: f64,
    scratch: Scratch,
}

impl Squares for Still<'_> {
    fn evaluate(&mut self, x: &[f64], normal: &mut [f64], gradient: &mut [f64]) -> f64 {
        self.scratch.next.copy_from_slice(x);
        simd::run(Step {
            network: self.network,
            scratch: &mut self.scratch,
            v: self.v,
        });
        let (nx, scratch) = (x.len(), &self.scratch);
        normal.fill(0.0);
        gradient.fill(0.0);
        let mut sum = 0.0;
        for (row, at) in x.iter().chain([&self.zero]).enumerate() {
            // residuals x - x+ and -y, and the derivatives of their negatives
            let (value, steepness) = match scratch.next.get(row) {
                Some(next) => (*next, 1.0),
                None => self.network.output.value_and_slope(scratch.sum),
            };
            let residual = at - value;
            let slope =
                |j: usize| steepness * scratch.slope(row * nx + j) - f64::from(u8::from(row == j));
            sum += residual * residual;
            for i in 0..nx {
                gradient[i] += residual * slope(i);
                (0..nx).for_each(|j| normal[i * nx + j] += slope(i) * slope(j));
            }
        }
        sum
    }
}

/// One step with its slopes, as a kernel.
pub(super) struct Step<'a> {
    pub network: &'a Network,
    pub scratch: &'a mut Scratch,
    pub v: &'a [f64],
}

impl Kernel for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        step_with_slopes::<V>(self.network, self.scratch, self.v);
    }
}

/// One step without slopes, as a kernel.
pub(super) struct Next<'a> {
    pub network: &'a Network,
    pub scratch: &'a mut Scratch,
    pub v: &'a [f64],
}

impl Kernel for Next<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        self.scratch.go_on(self.v);
        let Scratch {
            arguments,
            hidden,
            next,
            sum,
            ..
        } = self.scratch;
        *sum = self.network.step::<V, 0>(arguments, hidden, next);
    }
}
