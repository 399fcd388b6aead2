//! Speed from encoder counts: by differences and by Savitzky and Golay here, by a Kalman filter with its smoother in `kalman`, for
//! loads that repeat over the turn in `ripple`; `counts` checks what all of them take.

mod counts;
mod kalman;
mod ripple;

use nalgebra::DMatrix;

use crate::{Error, Result};
use counts::check;

pub use counts::{Encoder, Scale, unwrap};
pub use kalman::Kalman;

/// Backward difference `(c(k) - c(k-1)) / (Ts counts_per_unit)`; the first sample repeats the second.
///
/// # Errors
/// `ErrorKind::Data` for fewer than two counts, or counts that are not finite or jump as a wrapped counter does.
pub fn difference(counts: &[f64], scale: Scale) -> Result<Vec<f64>> {
    counts::check(counts, 2)?;
    let factor = scale.per_count();
    let first = counts[1] - counts[0];
    let rest = counts.windows(2).map(|w| w[1] - w[0]);
    Ok(std::iter::once(first)
        .chain(rest)
        .map(|d| d * factor)
        .collect())
}

/// The widest window: wider ones cost seconds and average over motion anyway.
const MAX_WINDOW: usize = 10_001;
/// The highest order of the local polynomial.
const MAX_ORDER: usize = 15;

/// Derivative of the polynomial of `order` fitted by least squares to the `window` counts around each sample.
///
/// Within half a window of an end the polynomial of the first or last whole window is differentiated there, so
/// polynomial motion of that order is exact everywhere (Savitzky and Golay, Anal. Chem. 36, 1964).
///
/// # Errors
/// `ErrorKind::Setting` for an even window, one outside 3 to 10,001, or an order outside 1 to `window - 1` (15 at
/// most); `ErrorKind::Data` for fewer counts than the window, or counts that cannot be used.
pub fn savgol(counts: &[f64], scale: Scale, window: usize, order: usize) -> Result<Vec<f64>> {
    settings(window, order)?;
    check(counts, window)?;
    let (factor, half, n) = (scale.per_count(), window / 2, counts.len());
    let weights = Weights::new(window, order);
    let mut speed = vec![0.0; n];
    let centre = weights.at(half);
    for (v, around) in speed[half..].iter_mut().zip(counts.windows(window)) {
        // Counted from the middle, so that a large count costs no digits.
        let middle = around[half];
        *v = factor * dot(&centre, around, middle);
    }
    let (head, tail) = (&counts[..window], &counts[n - window..]);
    for k in 0..half {
        speed[k] = factor * weights.slope(head, k);
        speed[n - half + k] = factor * weights.slope(tail, half + 1 + k);
    }
    Ok(speed)
}

fn settings(window: usize, order: usize) -> Result<()> {
    if window.is_multiple_of(2) || !(3..=MAX_WINDOW).contains(&window) {
        return Err(Error::setting(format!(
            "expected an odd window of 3 to {MAX_WINDOW} samples, got {window}; try {}",
            (window | 1).clamp(3, MAX_WINDOW)
        )));
    }
    if order == 0 || order >= window || order > MAX_ORDER {
        return Err(Error::setting(format!(
            "expected an order of 1 to {}, got {order}; 3 suits most motion",
            MAX_ORDER.min(window - 1)
        )));
    }
    Ok(())
}

fn dot(weights: &[f64], counts: &[f64], middle: f64) -> f64 {
    let terms = weights.iter().zip(counts);
    terms.map(|(w, c)| w * (c - middle)).sum()
}

/// Least squares over one window in Legendre polynomials of `x` in [-1, 1], which stay well conditioned.
struct Weights {
    /// Coefficients from samples, `(order + 1) x window`.
    fit: DMatrix<f64>,
    /// Derivatives of the polynomials with respect to the sample number, `window x (order + 1)`.
    slopes: DMatrix<f64>,
}

impl Weights {
    fn new(window: usize, order: usize) -> Self {
        let half = (window / 2) as f64;
        let x = |k: usize| k as f64 / half - 1.0;
        let values = DMatrix::from_fn(window, order + 1, |k, j| legendre(j, x(k)).0);
        let slopes = DMatrix::from_fn(window, order + 1, |k, j| legendre(j, x(k)).1 / half);
        let qr = values.qr();
        let mut fit = qr.q().transpose();
        // R has a zero on its diagonal only where order >= window, which the settings exclude.
        qr.r().solve_upper_triangular_mut(&mut fit);
        Self { fit, slopes }
    }

    /// The weights of the counts in the slope at sample `k` of the window.
    fn at(&self, k: usize) -> Vec<f64> {
        (self.slopes.row(k) * &self.fit).iter().copied().collect()
    }

    fn slope(&self, counts: &[f64], k: usize) -> f64 {
        dot(&self.at(k), counts, counts[counts.len() / 2])
    }
}

/// Legendre polynomial `P_j(x)` and its derivative, by Bonnet's recursion.
fn legendre(j: usize, x: f64) -> (f64, f64) {
    let (mut p, mut d) = ([1.0, x], [0.0, 1.0]);
    for i in 1..j {
        let i = i as f64;
        let next = ((2.0 * i + 1.0) * x * p[1] - i * p[0]) / (i + 1.0);
        let slope = d[0] + (2.0 * i + 1.0) * p[1];
        (p, d) = ([p[1], next], [d[1], slope]);
    }
    if j == 0 { (1.0, 0.0) } else { (p[1], d[1]) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn differences_in_the_unit() {
        let scale = Scale::new(1e-3, 26.2).unwrap();
        let v = difference(&[5.0, 5.0, 7.0], scale).unwrap();
        assert_eq!(v[..2], [0.0, 0.0]);
        assert!((v[2] - 2.0 * 38.167_938_931).abs() < 1e-6);
        assert!(difference(&[1.0], scale).is_err());
    }

    fn scale() -> Scale {
        Scale::new(1.0, 1.0).unwrap()
    }

    #[test]
    fn has_the_published_weights() {
        // Savitzky and Golay 1964, table for the first derivative, quadratic, 5 and 7 points.
        let five = Weights::new(5, 2).at(2);
        let expected = [-0.2, -0.1, 0.0, 0.1, 0.2];
        assert!(
            five.iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-14)
        );
        let seven = Weights::new(7, 3).at(3);
        let expected = [22.0, -67.0, -58.0, 0.0, 58.0, 67.0, -22.0].map(|v| v / 252.0);
        assert!(
            seven
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-14)
        );
    }

    #[test]
    fn refuses_windows_and_orders_without_meaning() {
        let counts = vec![0.0; 50];
        for (window, order) in [(4, 2), (1, 1), (5, 5), (5, 0), (41, 16), (20_001, 3)] {
            assert!(
                savgol(&counts, scale(), window, order).is_err(),
                "{window} {order}"
            );
        }
        assert!(savgol(&counts, scale(), 51, 3).is_err());
        assert!(savgol(&counts, scale(), 49, 3).is_ok());
    }

    proptest! {
        #[test]
        fn polynomial_motion_is_exact_up_to_the_ends(
            half in 2usize..60, order in 1usize..4, a in -1e3..1e3f64, b in -5.0..5.0f64, c in -0.1..0.1f64, d in -1e-3..1e-3f64,
        ) {
            let window = 2 * half + 1;
            let (c, d) = (if order > 1 { c } else { 0.0 }, if order > 2 { d } else { 0.0 });
            let position = |k: usize| { let t = k as f64; a + t * (b + t * (c + t * d)) };
            let counts: Vec<f64> = (0..window + 30).map(position).collect();
            let speed = savgol(&counts, scale(), window, order).unwrap();
            for (k, v) in speed.iter().enumerate() {
                let t = k as f64;
                let truth = b + t * (2.0 * c + 3.0 * t * d);
                prop_assert!((v - truth).abs() < 1e-8 * (1.0 + truth.abs()), "{k}: {v} {truth}");
            }
        }
    }
}
