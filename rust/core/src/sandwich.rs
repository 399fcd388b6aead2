//! The covariance of an estimate whose model is not quite true, from sums of scores over windows.
//!
//! Residuals of a motor are friction and load that no model has, not white noise, so that the covariance is a sandwich: the long-run
//! covariance of the scores between two inverses of the information (White 1982, Econometrica 50; Newey and West 1987, Econometrica 55).
//! A fit follows a window by its share `h` of the information, and each sum is divided by `sqrt(1 - h)` (Bell and McCaffrey 2002, Survey
//! Methodology 28).

use nalgebra::{DMatrix, DVector};

use crate::{Error, Result};

/// Least eigenvalue of a determined direction, relative to the largest.
const SINGULAR: f64 = 1e-11;
/// Standard deviation of an undetermined direction, at unit noise.
const BOUNDLESS: f64 = 1e6;
/// Window over the root of the number of samples, and with as few windows Student's quantile: what tests of coloured series need to hold
/// their size (Lazarus, Lewis, Stock and Watson 2018, Journal of Business and Economic Statistics 36).
const BANDWIDTH: f64 = 1.3;
/// Steps in which the window advances by its length.
const PARTS: usize = 4;
/// Least part of a direction's information outside a window, for its scores to be usable.
const LEFT: f64 = 0.01;

/// The derivatives and residuals of a fit, sorted by piece, then channel.
#[derive(Clone, Copy, Debug)]
pub struct Scores<'a> {
    /// Derivatives row by row, (m, n).
    pub jacobian: &'a [f64],
    /// Residuals, (m).
    pub residuals: &'a [f64],
    /// Samples of each piece.
    pub lengths: &'a [usize],
    /// Rows per sample.
    pub channels: usize,
}

/// The covariance (n, n). `known` (k, k) is the inverse prior covariance of the first k parameters.
///
/// # Errors
/// Data errors for sizes that do not fit; fit errors for an information that is not finite.
pub fn covariance(scores: &Scores<'_>, known: &DMatrix<f64>) -> Result<DMatrix<f64>> {
    let (m, rows) = (scores.residuals.len(), scores.lengths.iter().sum::<usize>());
    let n = scores.jacobian.len().checked_div(m).unwrap_or(0);
    if m == 0
        || n * m != scores.jacobian.len()
        || rows * scores.channels != m
        || !known.is_square()
        || known.nrows() > n
    {
        return Err(Error::data(format!(
            "expected a row of derivatives for each of {m} residuals, as many as the pieces' samples in {} channels, \
             got others",
            scores.channels
        )));
    }
    let whole = DMatrix::from_row_slice(m, n, scores.jacobian);
    let mut before = DMatrix::zeros(n, n);
    before.view_mut((0, 0), known.shape()).copy_from(known);
    let Root { half, unknown } = root(&(whole.tr_mul(&whole) + &before))?;
    let mut middle = half.tr_mul(&(&before * &half));
    let (mut at, mut total) = (0, 0.0);
    let longest = (BANDWIDTH * (rows as f64).sqrt()).round().max(1.0) as usize;
    for &length in scores.lengths {
        let window = longest.min(length).max(1);
        let count = scores.channels * length;
        let along = whole.rows(at, count) * &half;
        let parts = Parts::new(&along, &scores.residuals[at..][..count], length, window);
        middle += parts.spread();
        at += count;
        total += 1.5 * length as f64 / window as f64;
    }
    // Student's quantile over the normal one
    let student = (1.0 + 1.2 / f64::max(total, 1.0)).powi(2);
    Ok(&half * middle * half.transpose() * student + unknown)
}

/// Scores and information of the parts that windows are sums of.
struct Parts {
    scores: Vec<DVector<f64>>,
    information: Vec<DMatrix<f64>>,
    within: usize,
}

impl Parts {
    fn new(along: &DMatrix<f64>, residuals: &[f64], length: usize, window: usize) -> Self {
        let (n, part) = (along.ncols(), (window / PARTS).max(1));
        let count = length.div_ceil(part);
        let (mut scores, mut information) = (
            vec![DVector::zeros(n); count],
            vec![DMatrix::zeros(n, n); count],
        );
        for (k, (row, residual)) in along.row_iter().zip(residuals).enumerate() {
            let own = k % length / part;
            let row = row.transpose();
            scores[own].axpy(*residual, &row, 1.0);
            information[own].ger(1.0, &row, &row, 1.0);
        }
        Self {
            scores,
            information,
            within: window / part,
        }
    }

    /// Outer products of the windows' sums, including windows that extend beyond the ends.
    fn spread(&self) -> DMatrix<f64> {
        let n = self.scores[0].len();
        let mut found = DMatrix::zeros(n, n);
        for end in 1..self.scores.len() + self.within {
            let own = end.saturating_sub(self.within)..end.min(self.scores.len());
            let score: DVector<f64> = self.scores[own.clone()].iter().sum();
            let share: DMatrix<f64> = self.information[own].iter().sum();
            let eigen = share.symmetric_eigen();
            let mut inside = eigen.eigenvectors.tr_mul(&score);
            for (value, share) in inside.iter_mut().zip(&eigen.eigenvalues) {
                *value /= (1.0 - share).clamp(LEFT, 1.0).sqrt();
            }
            let sum = eigen.eigenvectors * inside;
            found.ger(1.0 / self.within as f64, &sum, &sum, 1.0);
        }
        found
    }
}

/// A root of the inverse of a positive matrix, (n, determined directions), and a huge covariance for the others.
#[derive(Clone, Debug)]
pub struct Root {
    /// `half half'` is the inverse.
    pub half: DMatrix<f64>,
    /// The covariance of directions that hold only rounding, (n, n).
    pub unknown: DMatrix<f64>,
}

/// The root of the inverse.
///
/// A step to a single speed, say, does not separate friction from back-EMF: such a direction holds only rounding. Inverting it would
/// give a false value, omitting it a false certainty.
///
/// # Errors
/// Fit errors for a matrix that is not finite.
pub fn root(matrix: &DMatrix<f64>) -> Result<Root> {
    if matrix.iter().any(|v| !v.is_finite()) {
        return Err(Error::fit(
            "expected a free run that changes with the parameters by finite amounts, got infinite ones; record changes of speed in \
             both directions, faster sampled than the motor settles",
        ));
    }
    let n = matrix.nrows();
    let scale = lengths(matrix);
    let eigen = scaled(matrix, &scale).symmetric_eigen();
    let least = SINGULAR * eigen.eigenvalues.max();
    let (mut half, mut unknown) = (Vec::new(), DMatrix::zeros(n, n));
    for (size, along) in eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter())
    {
        let along = DVector::from_fn(n, |i, _| along[i] / scale[i]);
        if *size > least {
            half.push(along / size.sqrt());
        } else {
            unknown.ger(BOUNDLESS * BOUNDLESS, &along, &along, 1.0);
        }
    }
    let half = match half.is_empty() {
        true => DMatrix::zeros(n, 0),
        false => DMatrix::from_columns(&half),
    };
    Ok(Root { half, unknown })
}

/// Which parameters are in no direction without information: at most by `leak` of such a direction's length, (n).
pub(crate) fn determined(matrix: &DMatrix<f64>, leak: f64) -> Vec<bool> {
    let scale = lengths(matrix);
    let eigen = scaled(matrix, &scale).symmetric_eigen();
    let least = SINGULAR * eigen.eigenvalues.max();
    let share = |i: usize| -> f64 {
        let flat = eigen.eigenvalues.iter().enumerate();
        let flat = flat.filter(|(_, size)| **size <= least);
        flat.map(|(j, _)| eigen.eigenvectors[(i, j)].powi(2)).sum()
    };
    (0..matrix.nrows())
        .map(|i| share(i) < leak * leak)
        .collect()
}

/// Roots of the diagonal, 1 for 0.
fn lengths(matrix: &DMatrix<f64>) -> Vec<f64> {
    let root = |v: &f64| if *v > 0.0 { v.sqrt() } else { 1.0 };
    matrix.diagonal().iter().map(root).collect()
}

fn scaled(matrix: &DMatrix<f64>, scale: &[f64]) -> DMatrix<f64> {
    DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |i, j| {
        matrix[(i, j)] / (scale[i] * scale[j])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// The mean of correlated noise has the variance of its correlation, not that of white noise.
    #[test]
    fn correlated_scores_widen_the_interval() {
        let (mut random, mut noise) = (Random::new(3), 0.0);
        let white: Vec<f64> = (0..20_000).map(|_| random.normal()).collect();
        let slow: Vec<f64> = white
            .iter()
            .map(|e| {
                noise = 0.9 * noise + e;
                noise
            })
            .collect();
        let of = |residuals: &[f64]| {
            let scores = Scores {
                jacobian: &vec![1.0; 20_000],
                residuals,
                lengths: &[20_000],
                channels: 1,
            };
            covariance(&scores, &DMatrix::zeros(0, 0)).unwrap()[(0, 0)]
        };
        let ratio = of(&slow) / of(&white);
        // 1 / (1 - .9)^2
        assert!((ratio / 100.0 - 1.0).abs() < 0.35, "{ratio}");
        assert!((of(&white) * 20_000.0 - 1.0).abs() < 0.35);
    }

    #[test]
    fn what_only_shows_as_a_sum_is_boundless_and_undetermined() {
        let mut random = Random::new(4);
        let rows = DMatrix::from_fn(300, 3, |_, _| random.normal());
        let jacobian: Vec<f64> = (0..300)
            .flat_map(|k| [rows[(k, 0)], rows[(k, 1)], rows[(k, 1)]])
            .collect();
        let residuals: Vec<f64> = rows.column(2).iter().copied().collect();
        let scores = Scores {
            jacobian: &jacobian,
            residuals: &residuals,
            lengths: &[100, 200],
            channels: 1,
        };
        let found = covariance(&scores, &DMatrix::zeros(0, 0)).unwrap();
        assert!(found[(0, 0)] < 0.1 && found[(1, 1)] > 1e6);
        let whole = DMatrix::from_row_slice(300, 3, &jacobian);
        assert_eq!(
            determined(&whole.tr_mul(&whole), 1e-3),
            [true, false, false]
        );
        // a prior parts them
        let known = DMatrix::from_diagonal(&DVector::from_vec(vec![0.0, 100.0]));
        assert!(covariance(&scores, &known).unwrap()[(1, 1)] < 1.0);
    }

    #[test]
    fn sizes_that_differ_are_refused() {
        let scores = Scores {
            jacobian: &[1.0; 6],
            residuals: &[1.0; 3],
            lengths: &[2],
            channels: 1,
        };
        assert!(covariance(&scores, &DMatrix::zeros(0, 0)).is_err());
        assert!(root(&DMatrix::from_element(1, 1, f64::NAN)).is_err());
    }
}
