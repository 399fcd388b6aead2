//! A fitted linear model with the story of its fit.

use nalgebra::DMatrix;

use crate::linear::LinearModel;
use crate::lm::Termination;

/// A linear model fitted in free run, by output error or by instrumental variables.
#[derive(Clone, Debug)]
pub struct LinearFit {
    /// The model.
    pub model: LinearModel,
    /// `1/(2N) sum e^2` in free run, in the output's unit squared.
    pub cost: f64,
    /// Iterations over all refined starts.
    pub iterations: usize,
    /// How the best one ended.
    pub termination: Termination,
    /// Cost of the best one at its start and after each accepted step.
    pub trace: Vec<f64>,
    /// Past outputs per experiment, newest first, as estimated with the model.
    pub initial_states: Vec<Vec<f64>>,
    /// Covariance of [a, b input by input, offset], row by row, for white measurement noise: the noise's variance times
    /// the inverse of the information matrix. Zero for an offset that was not estimated, infinite where the data do
    /// not fix the parameters.
    pub covariance: Vec<f64>,
}

impl LinearFit {
    /// Square roots of the covariance's diagonal: one for each of [a, b input by input, offset].
    pub fn standard_errors(&self) -> Vec<f64> {
        let n = self.model.parameters();
        self.covariance
            .iter()
            .step_by(n + 1)
            .map(|v| v.sqrt())
            .collect()
    }
}

/// `variance information^-1`, with columns scaled to a diagonal of ones on the way; none where it is singular.
pub(crate) fn spread(information: &DMatrix<f64>, variance: f64) -> Option<DMatrix<f64>> {
    let scale = information.diagonal().map(|d| 1.0 / d.sqrt());
    let n = information.nrows();
    let scaled = DMatrix::from_fn(n, n, |i, j| information[(i, j)] * scale[i] * scale[j]);
    let inverse = scaled.cholesky()?.inverse();
    let entry = |i: usize, j: usize| variance * inverse[(i, j)] * scale[i] * scale[j];
    Some(DMatrix::from_fn(n, n, entry)).filter(|c| c.iter().all(|v| v.is_finite()))
}

/// What is left of the first `kept` rows and columns of an information matrix when the others are free, too.
pub(crate) fn without_nuisance(information: &DMatrix<f64>, kept: usize) -> Option<DMatrix<f64>> {
    let others = information.nrows() - kept;
    let mut nuisance = information
        .view((kept, kept), (others, others))
        .into_owned();
    soften(&mut nuisance);
    let across = information.view((kept, 0), (others, kept)).into_owned();
    let taken = across.transpose() * nuisance.cholesky()?.solve(&across);
    Some(information.view((0, 0), (kept, kept)) - taken)
}

/// A ridge of 1e-12 of each diagonal entry: what leaves no trace in the output stays near zero.
pub(crate) fn soften(normal: &mut DMatrix<f64>) {
    for i in 0..normal.nrows() {
        normal[(i, i)] = normal[(i, i)] * (1.0 + 1e-12) + f64::MIN_POSITIVE;
    }
}

/// The covariance row by row for `parameters` parameters; those beyond its size are not estimated.
pub(crate) fn covariance_rows(found: Option<&DMatrix<f64>>, parameters: usize) -> Vec<f64> {
    let entry = |i: usize, j: usize| match found {
        Some(c) => c.get((i, j)).copied().unwrap_or(0.0),
        None if i == j => f64::INFINITY,
        None => 0.0,
    };
    (0..parameters * parameters)
        .map(|at| entry(at / parameters, at % parameters))
        .collect()
}
