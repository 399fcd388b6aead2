//! The taps of a feedforward: a truncated non-causal inverse of a plant, by least squares.
//!
//! The command for a reference `r` is, with a preview of `p` samples, that which holds the level, of slope `s` \[u/y\], and
//! the taps `h_0 ..` on the last changes of `r`:
//!
//! ```text
//! u(k) = s r(k+p) + sum_j h_j (r(k+p-j) - r(k+p-j-1))
//! ```
//!
//! For a step of the reference at sample 0 a plant with the impulse response `g` then answers
//! `y(k) = s G(k+p) + sum_j h_j g(k+p-j)`, where `G` is the sum of `g`. The taps make the sum of `(y(k) - step(k))^2` least, over all plants and
//! from `-p` on, plus a small multiple of the sum of `h_j^2`: the square of the command that a step of the reference asks for beyond its level. Without it the
//! inverse would be exact, and each corner of a reference a jerk. Neither a zero outside the unit circle nor a delay is a special case: with enough preview the sum reaches
//! what comes before (Tomizuka, Zero phase error tracking algorithm, ASME J. Dyn. Syst. Meas. Control 109, 1987, for
//! the idea of preview; Zou and Devasia, same journal 121, 1999, for the truncated one).

use nalgebra::{DMatrix, DVector};

use crate::{Error, Result};

/// Samples of a step response over which the error counts, beyond preview and taps.
pub const HORIZON: usize = 256;

/// A plant about a level.
#[derive(Clone, Debug, PartialEq)]
pub struct Local {
    /// Answer to a unit impulse of the command, from its own sample on \[y/u\].
    pub response: Vec<f64>,
    /// Change of the command that holds the level, over that of the level \[u/y\]; 0 for a plant that integrates.
    pub slope: f64,
}

impl Local {
    /// From `x+ = A x + B v`, `y = C x + D v`, `v(k) = u(k - delay)`; `a` row by row.
    pub fn new(a: &[f64], b: &[f64], c: &[f64], d: f64, delay: usize, slope: f64) -> Self {
        let n = b.len();
        let mut response = vec![0.0; delay];
        response.push(d);
        let (mut x, mut next) = (b.to_vec(), vec![0.0; n]);
        while response.len() < HORIZON {
            response.push(c.iter().zip(&x).map(|(c, x)| c * x).sum());
            for (to, row) in next.iter_mut().zip(a.chunks_exact(n.max(1))) {
                *to = row.iter().zip(&x).map(|(a, x)| a * x).sum();
            }
            std::mem::swap(&mut x, &mut next);
        }
        response.truncate(HORIZON);
        Self { response, slope }
    }
}

/// The `count` taps for a preview in samples; `smoothing` is the multiple of the squared taps, relative to the plants' power.
///
/// # Errors
/// `ErrorKind::Setting` without a plant or tap, for a smoothing that is not above 0, and for plants that do not answer
/// within the horizon or whose answer is not finite.
pub fn taps(plants: &[Local], preview: usize, count: usize, smoothing: f64) -> Result<Vec<f64>> {
    if plants.is_empty() || count == 0 || !(smoothing > 0.0 && smoothing.is_finite()) {
        return Err(Error::setting(format!(
            "expected at least one plant and one tap and a finite smoothing above 0, got {}, {count} and {smoothing}",
            plants.len()
        )));
    }
    let (mut normal, mut right) = (
        DMatrix::<f64>::zeros(count, count),
        DVector::<f64>::zeros(count),
    );
    for Local { response, slope } in plants {
        let mut held = 0.0;
        let shifted = |i: usize, j: usize| i.checked_sub(j).map_or(0.0, |lag| response[lag]);
        for (i, now) in response.iter().enumerate() {
            held += now;
            // sample i - preview: the step of the reference comes at 0
            let wanted = f64::from(u8::from(i >= preview)) - slope * held;
            for j in 0..count {
                let own = shifted(i, j);
                right[j] += own * wanted;
                for other in 0..=j {
                    normal[(j, other)] += own * shifted(i, other);
                }
            }
        }
    }
    let power: f64 = normal.diagonal().mean();
    for j in 0..count {
        normal[(j, j)] += smoothing * power;
    }
    let solved = normal.cholesky().map(|factor| factor.solve(&right));
    let found = solved.filter(|taps| power > 0.0 && taps.iter().all(|tap| tap.is_finite()));
    found.map(|taps| taps.as_slice().to_vec()).ok_or_else(|| {
        Error::setting(format!(
            "expected plants whose answer to a command is finite and not 0 within {HORIZON} samples, to invert them; \
             leave the feedforward out"
        ))
    })
}

#[cfg(test)]
mod tests {
    use std::slice::from_ref;

    use super::*;

    fn answer(plant: &Local, preview: usize, taps: &[f64]) -> Vec<f64> {
        let command = |k: usize| plant.slope + taps.get(k).copied().unwrap_or(0.0);
        let held = (0..HORIZON - preview).map(|k| {
            let k = k + preview;
            (0..=k).map(|j| plant.response[k - j] * command(j)).sum()
        });
        held.collect()
    }

    #[test]
    fn a_lag_with_a_delay_is_inverted_to_the_smoothing() {
        // y(k+1) = .98 y(k) + .5 u(k-2)
        let plant = Local::new(&[0.98], &[0.5], &[1.0], 0.0, 2, 0.02 / 0.5);
        assert_eq!(plant.response[..5], [0.0, 0.0, 0.0, 0.5, 0.5 * 0.98]);
        let found = taps(from_ref(&plant), 3, 4, 1e-9).unwrap();
        assert!((found[0] - 0.98 / 0.5).abs() < 1e-3, "{found:?}");
        assert!(found[1..].iter().all(|tap| tap.abs() < 1e-3), "{found:?}");
        let y = answer(&plant, 3, &found);
        assert!(y.iter().all(|y| (y - 1.0).abs() < 1e-3));
    }

    #[test]
    fn a_zero_outside_the_unit_circle_asks_for_preview_and_is_inverted_with_it() {
        // b(q) = q (-.5 + q): y(k) = .9 y(k-1) - .5 u(k-1) + u(k-2)
        let plant = Local::new(&[0.9], &[1.0], &[-0.5 * 0.9 + 1.0], -0.5, 1, 0.1 / 0.5);
        let worst = |preview: usize| {
            let found = taps(from_ref(&plant), preview, 16, 1e-6).unwrap();
            let y = answer(&plant, preview, &found);
            y.iter().map(|y| (y - 1.0).abs()).fold(0.0, f64::max)
        };
        assert!(worst(1) > 0.3);
        assert!(worst(12) < 0.01, "{}", worst(12));
    }

    #[test]
    fn an_integrator_is_moved_by_its_taps_alone_and_several_plants_share_them() {
        let integrator = Local::new(&[1.0], &[0.1], &[1.0], 0.0, 1, 0.0);
        let found = taps(from_ref(&integrator), 2, 4, 1e-9).unwrap();
        assert!((found.iter().sum::<f64>() - 10.0).abs() < 1e-3, "{found:?}");
        let faster = Local::new(&[1.0], &[0.2], &[1.0], 0.0, 1, 0.0);
        let both = taps(&[integrator, faster], 2, 4, 1e-9).unwrap();
        let sum: f64 = both.iter().sum();
        assert!(sum > 5.0 && sum < 10.0, "{sum}");
    }

    #[test]
    fn plants_that_cannot_be_inverted_are_refused() {
        let dead = Local::new(&[0.5], &[0.0], &[1.0], 0.0, 1, 0.0);
        let unstable = Local::new(&[100.0], &[1.0], &[1.0], 0.0, 1, 0.0);
        for plants in [vec![dead], vec![unstable], vec![]] {
            assert!(taps(&plants, 2, 4, 1e-3).is_err());
        }
        let plant = Local::new(&[0.9], &[1.0], &[1.0], 0.0, 1, 0.1);
        assert!(taps(from_ref(&plant), 2, 0, 1e-3).is_err());
        assert!(taps(&[plant], 2, 4, 0.0).is_err());
    }
}
