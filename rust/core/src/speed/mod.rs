//! Speed from encoder counts: difference, Savitzky-Golay, Kalman/RTS smoother.

mod counts;
mod kalman;
mod ripple;
mod savgol;

pub use counts::{Encoder, Scale, unwrap};
pub use kalman::Kalman;
pub use savgol::savgol;

use crate::Result;

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_in_the_unit() {
        let scale = Scale::new(1e-3, 26.2).unwrap();
        let v = difference(&[5.0, 5.0, 7.0], scale).unwrap();
        assert_eq!(v[..2], [0.0, 0.0]);
        assert!((v[2] - 2.0 * 38.167_938_931).abs() < 1e-6);
        assert!(difference(&[1.0], scale).is_err());
    }
}
