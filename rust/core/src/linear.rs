//! The linear difference equation with offset, and the result of a fit with its covariance.

use nalgebra::{Complex, DMatrix};

use crate::lagged::{Form, Lagged, Lags, push_past};
use crate::lm::Termination;
use crate::simd::{F64x8, Lanes};
use crate::{Error, Result};

/// `y(k) = -sum_i a[i] y(k-1-i) + sum_j sum_i b[j nb + i] u_j(k-nk-i) + offset`, in the data's units.
///
/// ```
/// use sewfast_core::lagged::Lagged;
/// use sewfast_core::linear::LinearModel;
///
/// let lag = LinearModel::new(vec![-0.9], vec![0.2], 1, 1, 0.0)?;
/// let y = lag.simulate(&[1.0; 200], 1, &[0.0])?;
/// assert!((y[199] - lag.dc_gain()[0]).abs() < 1e-6);
/// # Ok::<(), sewfast_core::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct LinearModel {
    a: Vec<f64>,
    b: Vec<f64>,
    offset: f64,
    lags: Lags,
}

impl LinearModel {
    /// A model from its coefficients; `b` holds the coefficients of one input after the other.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for empty or uneven coefficients or values that are not finite.
    pub fn new(a: Vec<f64>, b: Vec<f64>, channels: usize, nk: usize, offset: f64) -> Result<Self> {
        if channels == 0 || !b.len().is_multiple_of(channels) {
            return Err(Error::setting(format!(
                "expected b with the same number of coefficients for each of {channels} inputs, got {}; give b the shape (n_inputs, nb)",
                b.len()
            )));
        }
        let lags = Lags::new(a.len(), b.len() / channels, nk, channels)?;
        if a.iter().chain(&b).chain([&offset]).any(|v| !v.is_finite()) {
            return Err(Error::setting(
                "expected finite coefficients, got NaN or infinity; identify the model again",
            ));
        }
        Ok(Self { a, b, offset, lags })
    }

    /// Denominator coefficients after the leading 1.
    pub fn a(&self) -> &[f64] {
        &self.a
    }

    /// Numerator coefficients, one input after the other.
    pub fn b(&self) -> &[f64] {
        &self.b
    }

    /// The output's change per sample without any input.
    pub fn offset(&self) -> f64 {
        self.offset
    }

    /// Number of parameters: a, b of every input, offset.
    pub fn parameters(&self) -> usize {
        self.lags.regressors() + 1
    }

    /// Free run in the data's units, and its derivatives row by row: with respect to [a, b input by input, offset],
    /// then to the past outputs.
    ///
    /// `d y(k) = d f - sum_i a_i d y(k-i)`, where `d f/d a_i = -y(k-i)`, `d f/d b_ji = u_j(k-nk-i+1)`, `d f/d offset = 1`.
    ///
    /// # Errors
    /// As [`Lagged::simulate`].
    pub fn jacobian(
        &self,
        u: &[f64],
        channels: usize,
        y_past: &[f64],
    ) -> Result<(Vec<f64>, Vec<f64>)> {
        let run = self.simulate(u, channels, y_past)?;
        let (na, n_phi) = (self.lags.na, self.lags.regressors());
        let columns = n_phi + 1 + na;
        // the rows of the past outputs themselves come first, the oldest on top
        let mut rows = vec![0.0; (na + run.len()) * columns];
        for i in 0..na {
            rows[(na - 1 - i) * columns + n_phi + 1 + i] = 1.0;
        }
        let mut past = y_past.to_vec();
        for (k, &y) in run.iter().enumerate() {
            let (before, rest) = rows.split_at_mut((na + k) * columns);
            let row = &mut rest[..columns];
            for (value, y) in row.iter_mut().zip(&past) {
                *value = -y;
            }
            self.lags.write_inputs(u, k, &mut row[na..n_phi]);
            row[n_phi] = 1.0;
            for (a, old) in self.a.iter().zip(before.rchunks_exact(columns)) {
                for (value, old) in row.iter_mut().zip(old) {
                    *value -= a * old;
                }
            }
            push_past(&mut past, y);
        }
        rows.drain(..na * columns);
        Ok((run, rows))
    }

    /// The poles: roots of `z^na + a_1 z^(na-1) + .. + a_na`; NaN if they overflow.
    pub fn poles(&self) -> Vec<Complex<f64>> {
        poles(&self.a)
    }

    /// True if every pole lies inside the unit circle.
    pub fn is_stable(&self) -> bool {
        is_stable(&self.a, 0.0)
    }

    /// Steady gain from each input; infinite for an integrator.
    pub fn dc_gain(&self) -> Vec<f64> {
        let denominator = 1.0 + self.a.iter().sum::<f64>();
        let gain = |b: &[f64]| b.iter().sum::<f64>() / denominator;
        self.b.chunks_exact(self.lags.nb).map(gain).collect()
    }
}

impl LinearModel {
    /// [`Lagged::output`] in loops that stay in registers.
    #[inline(always)]
    pub(crate) fn next(&self, phi: &[f64]) -> f64 {
        let (past, inputs) = phi.split_at(self.lags.na);
        let (a, b) = (&self.a[..past.len()], &self.b[..inputs.len()]);
        let mut sum = self.offset;
        for i in 0..inputs.len() {
            sum += b[i] * inputs[i];
        }
        for i in 0..past.len() {
            sum -= a[i] * past[i];
        }
        sum
    }

    /// The outputs for eight regressors, one per lane; each has the bits of [`Lagged::output`].
    #[inline(always)]
    pub(crate) fn next_in_lanes<V: F64x8>(&self, phi: &[Lanes]) -> V {
        let (past, inputs) = phi.split_at(self.lags.na);
        let (a, b) = (&self.a[..past.len()], &self.b[..inputs.len()]);
        let mut sum = V::splat(self.offset);
        for i in 0..inputs.len() {
            sum = sum.add(V::splat(b[i]).mul(V::load(&inputs[i].0)));
        }
        for i in 0..past.len() {
            sum = sum.sub(V::splat(a[i]).mul(V::load(&past[i].0)));
        }
        sum
    }
}

impl Lagged for LinearModel {
    fn lags(&self) -> Lags {
        self.lags
    }

    fn output(&self, phi: &[f64]) -> f64 {
        let (past, inputs) = phi.split_at(self.lags.na);
        let moved = self
            .b
            .iter()
            .zip(inputs)
            .fold(self.offset, |sum, (b, u)| sum + b * u);
        self.a
            .iter()
            .zip(past)
            .fold(moved, |sum, (a, y)| sum - a * y)
    }

    fn form(&self) -> Option<Form> {
        Some(Form::Linear(self.clone()))
    }

    fn output_and_slope(&self, phi: &[f64], slope: &mut [f64]) -> f64 {
        for (slope, a) in slope.iter_mut().zip(&self.a) {
            *slope = -a;
        }
        self.output(phi)
    }
}

/// Roots of `z^n + a_1 z^(n-1) + .. + a_n`, the eigenvalues of its companion matrix; NaN if they overflow.
pub(crate) fn poles(a: &[f64]) -> Vec<Complex<f64>> {
    // the QR iteration may not end at a pole at 0 that is repeated, as that of a delay
    let n = a.iter().rposition(|x| *x != 0.0).map_or(0, |last| last + 1);
    let mut found = Vec::with_capacity(a.len());
    if n > 0 {
        // without a limit it never ends if squares of the coefficients overflow
        match companion(&a[..n]).try_schur(f64::EPSILON, 200 * n) {
            Some(schur) => found.extend(schur.complex_eigenvalues().iter()),
            None => found.resize(n, Complex::new(f64::NAN, f64::NAN)),
        }
    }
    found.resize(a.len(), Complex::new(0.0, 0.0));
    found
}

/// The companion matrix of `z^n + a_1 z^(n-1) + .. + a_n`, `-a` in its first row.
pub(crate) fn companion(a: &[f64]) -> DMatrix<f64> {
    DMatrix::from_fn(a.len(), a.len(), |i, j| match i {
        0 => -a[j],
        _ => f64::from(u8::from(i == j + 1)),
    })
}

/// Coefficients `a` of the polynomial with these roots, which come in conjugate pairs.
pub(crate) fn polynomial(roots: &[Complex<f64>]) -> Vec<f64> {
    monic(roots).iter().skip(1).map(|c| c.re).collect()
}

/// All coefficients of the polynomial with these roots; the first is 1.
pub(crate) fn monic(roots: &[Complex<f64>]) -> Vec<Complex<f64>> {
    let mut coefficients = vec![Complex::new(1.0, 0.0)];
    for root in roots {
        coefficients.push(Complex::new(0.0, 0.0));
        for i in (1..coefficients.len()).rev() {
            let lower = coefficients[i - 1];
            coefficients[i] -= root * lower;
        }
    }
    coefficients
}

/// The denominator with every root inside the unit circle: roots outside are mirrored into it.
pub(crate) fn stabilised(a: &[f64]) -> Vec<f64> {
    if is_stable(a, 1e-6) {
        return a.to_vec();
    }
    let inside = |p: Complex<f64>| {
        let radius = p.norm();
        let wanted = if radius > 1.0 { 1.0 / radius } else { radius };
        if radius > 0.0 {
            p * (wanted.min(0.999) / radius)
        } else {
            p
        }
    };
    polynomial(&poles(a).into_iter().map(inside).collect::<Vec<_>>())
}

/// True if every root lies inside the unit circle: all reflection coefficients are below `1 - margin` (Schur-Cohn).
pub(crate) fn is_stable(a: &[f64], margin: f64) -> bool {
    let mut a = a.to_vec();
    while let Some(reflection) = a.pop() {
        // NaN is not inside either.
        let inside = reflection.abs() < 1.0 - margin;
        if !inside {
            return false;
        }
        let scale = 1.0 / (1.0 - reflection * reflection);
        let reversed: Vec<f64> = a.iter().rev().copied().collect();
        for (a, r) in a.iter_mut().zip(reversed) {
            *a = (*a - reflection * r) * scale;
        }
    }
    true
}

/// A linear model fitted in free run, by output error or by instrumental variables.
#[derive(Clone, Debug)]
pub struct LinearFit {
    /// The model.
    pub model: LinearModel,
    /// `1/(2N) sum e^2` in free run, in the output's unit squared.
    pub cost: f64,
    /// Iterations of all refined starts together.
    pub iterations: usize,
    /// How the best one ended.
    pub termination: Termination,
    /// Cost of the best one at its start and after each accepted step.
    pub trace: Vec<f64>,
    /// Past outputs per experiment, newest first, as estimated with the model.
    pub initial_states: Vec<Vec<f64>>,
    /// Covariance of [a, b input by input, offset], row by row, for white measurement noise: the noise's variance times
    /// the inverse of the information matrix. Zero for an offset that was not estimated, infinite if the data do not
    /// determine the parameters.
    pub covariance: Vec<f64>,
}

impl LinearFit {
    /// Square roots of the covariance's diagonal, one for each of [a, b input by input, offset].
    pub fn standard_errors(&self) -> Vec<f64> {
        let n = self.model.parameters();
        self.covariance
            .iter()
            .step_by(n + 1)
            .map(|v| v.sqrt())
            .collect()
    }
}

/// `variance information^-1`, with columns scaled to a unit diagonal for the inversion; `None` if it is singular.
pub(crate) fn spread(information: &DMatrix<f64>, variance: f64) -> Option<DMatrix<f64>> {
    let scale = information.diagonal().map(|d| 1.0 / d.sqrt());
    let n = information.nrows();
    let scaled = DMatrix::from_fn(n, n, |i, j| information[(i, j)] * scale[i] * scale[j]);
    let inverse = scaled.cholesky()?.inverse();
    let entry = |i: usize, j: usize| variance * inverse[(i, j)] * scale[i] * scale[j];
    Some(DMatrix::from_fn(n, n, entry)).filter(|c| c.iter().all(|v| v.is_finite()))
}

/// Schur complement: the information about the first `kept` parameters if the others are free as well.
pub(crate) fn without_nuisance(information: &DMatrix<f64>, kept: usize) -> Option<DMatrix<f64>> {
    let others = information.nrows() - kept;
    if others == 0 {
        return Some(information.clone());
    }
    let mut nuisance = information
        .view((kept, kept), (others, others))
        .into_owned();
    soften(&mut nuisance);
    let across = information.view((kept, 0), (others, kept)).into_owned();
    let taken = across.transpose() * nuisance.cholesky()?.solve(&across);
    Some(information.view((0, 0), (kept, kept)) - taken)
}

/// Adds a ridge of 1e-12 of each diagonal entry: a parameter without effect on the output stays near zero.
pub(crate) fn soften(normal: &mut DMatrix<f64>) {
    for i in 0..normal.nrows() {
        normal[(i, i)] = normal[(i, i)] * (1.0 + 1e-12) + f64::MIN_POSITIVE;
    }
}

/// The covariance row by row for `parameters` parameters; those beyond the matrix were not estimated.
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn second_order() -> LinearModel {
        LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3, -0.2, 0.1], 2, 2, 0.05).unwrap()
    }

    #[test]
    fn simulates_the_difference_equation() {
        let model = second_order();
        let u: Vec<f64> = (0..20).map(|k| (k as f64 * 0.7).sin()).collect();
        let y = model.simulate(&u, 2, &[0.3, -0.4]).unwrap();
        let input = |k: usize, j: usize| u[k * 2 + j];
        let expected = 1.5 * y[4] - 0.7 * y[3] + 0.5 * input(3, 0) + 0.3 * input(2, 0)
            - 0.2 * input(3, 1)
            + 0.1 * input(2, 1)
            + 0.05;
        assert!((y[5] - expected).abs() < 1e-14);
        let first = 1.5 * 0.3 + 0.7 * 0.4 + 0.8 * input(0, 0) - 0.1 * input(0, 1) + 0.05;
        assert!((y[0] - first).abs() < 1e-14);
    }

    #[test]
    fn roots_at_zero_are_exact() {
        // of a motor at a crawl behind a lag and a delay, at which the QR iteration did not end
        let found = poles(&[-1.2827632894166117, 0.3103589064668176, 0.0, 0.0]);
        assert!(found.iter().all(|p| p.norm() < 1.0), "{found:?}");
        assert_eq!(found[2..], [Complex::new(0.0, 0.0); 2]);
        assert_eq!(poles(&[0.0; 3]), [Complex::new(0.0, 0.0); 3]);
    }

    #[test]
    fn sensitivities_agree_with_differences() {
        let model = second_order();
        let u: Vec<f64> = (0..60).map(|k| (k as f64 * 0.9).cos()).collect();
        let past = [0.3, -0.4];
        let (run, rows) = model.jacobian(&u, 2, &past).unwrap();
        assert_eq!(run, model.simulate(&u, 2, &past).unwrap());
        let moved = |i: usize, by: f64| {
            let mut theta = [model.a(), model.b(), &[model.offset()], &past[..]].concat();
            theta[i] += by;
            let b = theta[2..6].to_vec();
            let other = LinearModel::new(theta[..2].to_vec(), b, 2, 2, theta[6]).unwrap();
            other.simulate(&u, 2, &theta[7..]).unwrap()
        };
        for i in 0..9 {
            let (ahead, behind) = (moved(i, 1e-5), moved(i, -1e-5));
            for k in 0..run.len() {
                let difference = (ahead[k] - behind[k]) / 2e-5;
                assert!((rows[k * 9 + i] - difference).abs() < 1e-7, "{i} {k}");
            }
        }
    }

    #[test]
    fn predicts_from_measured_outputs_and_at_a_long_horizon_runs_free() {
        let model = second_order();
        let u: Vec<f64> = (0..60).map(|k| (k as f64 * 0.9).cos()).collect();
        let past = [0.2, 0.1];
        let free = model.simulate(&u, 2, &past).unwrap();
        let measured: Vec<f64> = (0..30).map(|k| k as f64).collect();
        let far = model.predict(&u, 2, &measured, &past, 30).unwrap();
        assert_eq!(far, free);
        let one = model.predict(&u, 2, &measured, &past, 1).unwrap();
        let phi = [9.0, 8.0, u[16], u[14], u[17], u[15]];
        assert_eq!(one[10], model.output(&phi));
        let same = model.predict(&u, 2, &free, &past, 3).unwrap();
        assert_eq!(same, free);
    }

    #[test]
    fn finds_the_state_a_clean_record_started_from() {
        let model = second_order();
        let u: Vec<f64> = (0..40).map(|k| (k as f64 * 1.3).sin()).collect();
        let y = model.simulate(&u, 2, &[2.0, -1.0]).unwrap();
        let state = model.estimate_initial_state(&u, 2, &y).unwrap();
        assert!(
            (state[0] - 2.0).abs() < 1e-5 && (state[1] + 1.0).abs() < 1e-5,
            "{state:?}"
        );
    }

    #[test]
    fn predicts_with_its_own_predictions_where_nothing_was_measured() {
        let model = second_order();
        let u: Vec<f64> = (0..60).map(|k| (k as f64 * 0.9).cos()).collect();
        let past = [0.2, 0.1];
        let free = model.simulate(&u, 2, &past).unwrap();
        let none = model.predict(&u, 2, &[f64::NAN; 30], &past, 1).unwrap();
        assert_eq!(none, free);
        let mut y: Vec<f64> = (0..30).map(|k| (k as f64 * 1.7).sin()).collect();
        let whole = model.predict(&u, 2, &y, &past, 1).unwrap();
        y[11] = f64::NAN;
        let one = model.predict(&u, 2, &y, &past, 1).unwrap();
        assert_eq!(one[..12], whole[..12]);
        let phi = [whole[11], y[10], u[20], u[18], u[21], u[19]];
        assert_eq!(one[12], model.output(&phi));
        let two = model.predict(&u, 2, &y, &past, 2).unwrap();
        assert_eq!(two[12], model.output(&phi));
        assert!(
            model
                .predict(&u, 2, &[f64::INFINITY; 30], &past, 1)
                .is_err()
        );
    }

    #[test]
    fn finds_the_state_behind_a_gap_and_refuses_to_without_any_output() {
        let model = second_order();
        let u: Vec<f64> = (0..60).map(|k| (k as f64 * 1.3).sin()).collect();
        let mut y = model.simulate(&u, 2, &[2.0, -1.0]).unwrap();
        y[..4].fill(f64::NAN);
        y[10..15].fill(f64::NAN);
        let state = model.estimate_initial_state(&u, 2, &y).unwrap();
        assert!(
            (state[0] - 2.0).abs() < 1e-4 && (state[1] + 1.0).abs() < 1e-4,
            "{state:?}"
        );
        y.fill(f64::NAN);
        assert!(model.estimate_initial_state(&u, 2, &y).is_err());
    }

    #[test]
    fn gives_no_wild_state_for_a_short_noisy_record() {
        let model = LinearModel::new(vec![-1.87, 0.8705], vec![0.1228, 0.1224], 1, 1, 0.0).unwrap();
        let y = [1000.0, 1038.0, 962.0];
        let state = model.estimate_initial_state(&[2.0; 3], 1, &y).unwrap();
        assert!(
            state.iter().all(|s| (800.0..1200.0).contains(s)),
            "{state:?}"
        );
    }

    #[test]
    fn knows_its_poles_and_gain() {
        let model = LinearModel::new(vec![-1.5, 0.7], vec![0.5, 0.3], 1, 1, 0.0).unwrap();
        assert!(model.is_stable());
        assert!(
            model
                .poles()
                .iter()
                .all(|p| (p.norm() - 0.7f64.sqrt()).abs() < 1e-12)
        );
        assert!((model.dc_gain()[0] - 4.0).abs() < 1e-12);
        assert!(
            !LinearModel::new(vec![-1.01], vec![1.0], 1, 1, 0.0)
                .unwrap()
                .is_stable()
        );
    }

    #[test]
    fn ends_on_poles_that_overflow() {
        let model = LinearModel::new(vec![1e300, -1e300, 1e300], vec![1.0], 1, 1, 0.0).unwrap();
        assert_eq!(model.poles().len(), 3);
        assert!(!model.is_stable());
    }

    #[test]
    fn refuses_what_is_no_model_and_what_does_not_fit_it() {
        assert!(LinearModel::new(vec![], vec![1.0], 1, 1, 0.0).is_err());
        assert!(LinearModel::new(vec![0.1], vec![1.0, 2.0, 3.0], 2, 1, 0.0).is_err());
        assert!(LinearModel::new(vec![f64::NAN], vec![1.0], 1, 1, 0.0).is_err());
        let model = second_order();
        assert!(model.simulate(&[1.0; 4], 1, &[0.0; 2]).is_err());
        assert!(model.simulate(&[1.0; 4], 2, &[0.0; 1]).is_err());
        assert!(
            model
                .predict(&[1.0; 4], 2, &[0.0; 2], &[0.0; 2], 0)
                .is_err()
        );
        let unstable = LinearModel::new(vec![-3.0], vec![1.0], 1, 1, 0.0).unwrap();
        assert!(
            unstable
                .simulate(&[1.0; 2000], 1, &[0.0])
                .unwrap_err()
                .message
                .contains("unstable")
        );
    }

    proptest! {
        #[test]
        fn schur_cohn_agrees_with_the_roots(radii in prop::collection::vec(-1.3f64..1.3, 1..6)) {
            let roots: Vec<_> = radii.iter().map(|&r| Complex::new(r, 0.0)).collect();
            prop_assume!(radii.iter().all(|r| (r.abs() - 1.0).abs() > 1e-3));
            let stable = radii.iter().all(|r| r.abs() < 1.0);
            prop_assert_eq!(is_stable(&polynomial(&roots), 0.0), stable);
        }
    }
}
