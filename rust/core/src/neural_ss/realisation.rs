//! A linear model as state equations whose states have unit covariance on the training inputs.

use nalgebra::{DMatrix, DVector};

use super::problem::Experiment;
use super::shape::{Scaling, Shape};
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::{Error, Result};

/// First samples of an experiment that do not count, as they hang on the state it starts from: at most this many.
const SETTLING: usize = 200;
/// Directions in which the states vary less than this, relative to all of them, are scaled as if they varied so much.
const FLOOR: f64 = 1e-13;

/// `x+ = A x + B v`, `y = C x + D v + c` in scaled units.
#[derive(Clone, Debug)]
pub(super) struct Realisation {
    pub a: DMatrix<f64>,
    pub b: DMatrix<f64>,
    pub c: DMatrix<f64>,
    pub d: DMatrix<f64>,
    pub constant: DVector<f64>,
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
        if lags.channels != shape.inputs || shape.outputs != 1 {
            return Err(Error::setting(format!(
                "expected a linear model with {} inputs for one output, got {} inputs for {} outputs; with several outputs leave the linear model out",
                shape.inputs, lags.channels, shape.outputs
            )));
        }
        let mut a = vec![0.0; nx + 1];
        a[1..=lags.na].copy_from_slice(linear.a());
        let scale = |j: usize| scaling.u_scale[j] / scaling.y_scale[0];
        let b = |i: usize, j: usize| match i.checked_sub(shift) {
            Some(i) if i < lags.nb => linear.b()[j * lags.nb + i] * scale(j),
            _ => 0.0,
        };
        let held = a.iter().sum::<f64>() + 1.0;
        let gains = linear.b().chunks_exact(lags.nb).zip(&scaling.u_mean);
        let moved: f64 = gains.map(|(b, u)| b.iter().sum::<f64>() * u).sum();
        let level = (linear.offset() + moved) / held;
        // An integrator has no level of its own: its state carries it.
        let constant = if held.abs() > 1e-9 {
            scaling.output(0, level)
        } else {
            0.0
        };
        Ok(Self {
            a: DMatrix::from_fn(nx, nx, |i, j| match j {
                0 => -a[i + 1],
                j => f64::from(u8::from(j == i + 1)),
            }),
            b: DMatrix::from_fn(nx, shape.inputs, |i, j| b(i + 1, j) - a[i + 1] * b(0, j)),
            c: DMatrix::from_fn(1, nx, |_, j| f64::from(u8::from(j == 0))),
            d: DMatrix::from_fn(1, shape.inputs, |_, j| b(0, j)),
            constant: DVector::from_element(1, constant),
        })
    }

    /// The same with the slowest real mode as last state, its pole moved to 1.
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
        // right vectors beside the smallest one span what is orthogonal to the mode: states that it does not reach
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

    /// In the coordinates `T x`.
    fn transformed(&self, transform: &DMatrix<f64>) -> Option<Self> {
        let inverse = transform.clone().try_inverse()?;
        Some(Self {
            a: transform * &self.a * &inverse,
            b: transform * &self.b,
            c: &self.c * &inverse,
            ..self.clone()
        })
    }

    /// With states of unit covariance on the inputs of these experiments; none where they do not stay finite.
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

    /// Covariance of the states; none where they do not stay finite.
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

    /// The parameters, those of the hidden layer zero.
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
        theta[parts.constant].copy_from_slice(self.constant.as_slice());
        theta
    }
}

/// The inverse of the symmetric root of a covariance.
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
