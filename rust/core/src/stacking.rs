//! Convex weights of predictions: `min |R w|` over `w >= 0`, `sum w = 1`, where each column of `R` is the residual of a
//! model.
//!
//! As the weights sum to one, `R w` is the residual of the combined model (stacking: Wolpert 1992; Breiman 1996; Hansen
//! and Racine 2012). It is the point nearest to the origin in the polytope of the columns, which Wolfe's algorithm
//! (1976) finds in finitely many steps. While a corner lies on the near side of the plane through the present point, it
//! is added. Then the point moves to the nearest point of the corners' affine hull; if that lies outside the corners,
//! those that it leaves behind are dropped.

use nalgebra::{DMatrix, DVector};

use crate::{Error, Result};

/// Relative increase of the diagonal of `R'R`: equal columns then share their weight.
const RIDGE: f64 = 1e-10;
/// Relative decrease of `|R w|^2` below which no corner is added.
const TOLERANCE: f64 = 1e-9;
/// Most corners added, per model.
const ROUNDS: usize = 100;

/// The weights of the `models` columns of `residuals` (row by row); `weights` has a weight for each row.
///
/// # Errors
///
/// [`crate::ErrorKind::Data`] without rows or columns, if sizes differ, or if a value is not finite or a weight negative.
pub fn convex_weights(residuals: &[f64], models: usize, weights: &[f64]) -> Result<Vec<f64>> {
    if models == 0 || weights.is_empty() || residuals.len() != models * weights.len() {
        return Err(Error::data(format!(
            "residuals: expected a row of {models} models for each of {} weights, received {} values",
            weights.len(),
            residuals.len()
        )));
    }
    if !residuals.iter().chain(weights).all(|v| v.is_finite()) || weights.iter().any(|&w| w < 0.0) {
        return Err(Error::data(
            "residuals: expected finite values, and weights of at least 0; leave out models that run away",
        ));
    }
    let gram = products(residuals, models, weights);
    if !gram.iter().all(|v| v.is_finite()) {
        return Err(Error::data(
            "residuals: expected values whose squares are finite; leave out models that run away",
        ));
    }
    let mut point = vec![0.0; models];
    let mut corners = vec![nearest(gram.diagonal().iter().copied())];
    point[corners[0]] = 1.0;
    // each set of corners has one nearest point, so none occurs twice, apart from rounding
    for _ in 0..ROUNDS * models {
        let slopes = &gram * DVector::from_column_slice(&point);
        let next = nearest(slopes.iter().copied());
        let square: f64 = slopes.iter().zip(&point).map(|(s, w)| s * w).sum();
        if corners.contains(&next) || slopes[next] >= square * (1.0 - TOLERANCE) {
            return Ok(point);
        }
        corners.push(next);
        descend(&gram, &mut corners, &mut point);
    }
    Ok(point)
}

/// Moves to the nearest point of the corners' affine hull and drops the corners that it leaves behind.
fn descend(gram: &DMatrix<f64>, corners: &mut Vec<usize>, point: &mut [f64]) {
    loop {
        let hull = affine(gram, corners);
        let outside = corners.iter().zip(hull.iter()).filter(|&(_, &v)| v <= 0.0);
        let share = outside
            .map(|(&i, &v)| {
                if point[i] > v {
                    point[i] / (point[i] - v)
                } else {
                    0.0
                }
            })
            .fold(1.0, f64::min);
        let inside = hull.iter().all(|&v| v > 0.0);
        for (&i, &v) in corners.iter().zip(hull.iter()) {
            point[i] = if inside {
                v
            } else {
                point[i] + share * (v - point[i])
            };
        }
        if inside {
            return;
        }
        // the corner that ends the step is at 0, apart from rounding
        let least = corners
            .iter()
            .copied()
            .min_by(|&i, &j| point[i].total_cmp(&point[j]));
        corners.retain(|&i| {
            let stays = Some(i) != least && point[i] > 0.0;
            if !stays {
                point[i] = 0.0;
            }
            stays
        });
    }
}

/// The point nearest to the origin in the affine hull, as weights with sum 1: `G v = 1`, scaled.
fn affine(gram: &DMatrix<f64>, corners: &[usize]) -> DVector<f64> {
    let own = gram.select_rows(corners).select_columns(corners);
    let ones = DVector::from_element(corners.len(), 1.0);
    let found = own
        .cholesky()
        .map_or_else(|| ones.clone(), |c| c.solve(&ones));
    let sum = found.sum();
    found / sum
}

/// `R'WR`, scaled to a least diagonal of 1, with a ridge in proportion to each diagonal entry.
fn products(residuals: &[f64], models: usize, weights: &[f64]) -> DMatrix<f64> {
    let mut gram = DMatrix::zeros(models, models);
    for (row, &w) in residuals.chunks_exact(models).zip(weights) {
        for i in 0..models {
            for j in 0..=i {
                gram[(i, j)] += w * row[i] * row[j];
            }
        }
    }
    gram.fill_upper_triangle_with_lower_triangle();
    let squares = gram.diagonal();
    let least = squares
        .iter()
        .copied()
        .filter(|&s| s > 0.0)
        .fold(f64::INFINITY, f64::min);
    if least.is_finite() {
        gram /= least;
    }
    for i in 0..models {
        gram[(i, i)] += RIDGE * gram[(i, i)].max(1.0);
    }
    gram
}

fn nearest(values: impl Iterator<Item = f64>) -> usize {
    values
        .enumerate()
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map_or(0, |(i, _)| i)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn square(residuals: &[f64], w: &[f64]) -> f64 {
        let sum = |row: &[f64]| row.iter().zip(w).map(|(r, w)| r * w).sum::<f64>();
        residuals
            .chunks_exact(w.len())
            .map(|row| sum(row).powi(2))
            .sum()
    }

    #[test]
    fn two_models_with_independent_errors_share_by_their_variances() {
        // variances 1 and 4: weights .8 and .2
        let residuals = [1.0, 0.0, 0.0, 2.0];
        let w = convex_weights(&residuals, 2, &[1.0, 1.0]).unwrap();
        assert!(
            (w[0] - 0.8).abs() < 1e-8 && (w[1] - 0.2).abs() < 1e-8,
            "{w:?}"
        );
    }

    #[test]
    fn a_model_that_adds_nothing_has_no_weight() {
        // the second has the errors of the first, enlarged
        let residuals = [1.0, 2.0, -1.0, -2.5, 0.5, 1.5];
        assert_eq!(
            convex_weights(&residuals, 2, &[1.0; 3]).unwrap(),
            [1.0, 0.0]
        );
    }

    #[test]
    fn a_model_that_is_far_off_changes_nothing_for_the_others() {
        for far in [1.0, 1e6, 1e9] {
            let residuals = [1.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 10.0 * far];
            let w = convex_weights(&residuals, 3, &[1.0; 3]).unwrap();
            assert!((w[0] / w[1] - 9.0).abs() < 1e-6 && w[2] < 0.01, "{w:?}");
        }
        assert!(convex_weights(&[1.0, 1e200], 2, &[1.0]).is_err());
    }

    #[test]
    fn a_row_without_weight_does_not_count() {
        let residuals = [1.0, 3.0, 5.0, 0.0];
        let w = convex_weights(&residuals, 2, &[1.0, 0.0]).unwrap();
        assert_eq!(w, [1.0, 0.0]);
    }

    #[test]
    fn exact_models_and_equal_ones_have_weights_too() {
        for residuals in [[0.0; 6], [1.0; 6]] {
            let w = convex_weights(&residuals, 3, &[1.0; 2]).unwrap();
            assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-9, "{w:?}");
        }
    }

    #[test]
    fn values_that_are_not_finite_are_refused() {
        assert!(convex_weights(&[f64::INFINITY, 1.0], 2, &[1.0]).is_err());
        assert!(convex_weights(&[1.0, 1.0], 2, &[-1.0]).is_err());
        assert!(convex_weights(&[1.0, 1.0, 1.0], 2, &[1.0]).is_err());
        assert!(convex_weights(&[], 0, &[]).is_err());
    }

    proptest! {
        #[test]
        fn no_other_weights_do_better(
            residuals in prop::collection::vec(-10.0..10.0f64, 8 * 5),
            others in prop::collection::vec(0.0..1.0f64, 5),
        ) {
            let w = convex_weights(&residuals, 5, &[1.0; 8]).unwrap();
            prop_assert!(w.iter().all(|&v| v >= 0.0));
            prop_assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            let least = square(&residuals, &w);
            let sum: f64 = others.iter().sum::<f64>() + 1e-9;
            let other: Vec<f64> = others.iter().map(|v| (v + 2e-10) / sum).collect();
            prop_assert!(least <= square(&residuals, &other) * (1.0 + 1e-6) + 1e-9);
            for i in 0..5 {
                let mut corner = [0.0; 5];
                corner[i] = 1.0;
                prop_assert!(least <= square(&residuals, &corner) * (1.0 + 1e-6) + 1e-9);
            }
        }
    }
}
