//! Pseudo-random binary sequence of maximal length.

use super::check::{MAX_SAMPLES, finite, samples};
use crate::Result;
use crate::random::Random;

/// Feedback masks of primitive polynomials for registers of 2 to 27 bits (taps of Xilinx XAPP 052; Golomb 1967).
const MASKS: [u32; 26] = [
    mask(&[2, 1]),
    mask(&[3, 2]),
    mask(&[4, 3]),
    mask(&[5, 3]),
    mask(&[6, 5]),
    mask(&[7, 6]),
    mask(&[8, 6, 5, 4]),
    mask(&[9, 5]),
    mask(&[10, 7]),
    mask(&[11, 9]),
    mask(&[12, 6, 4, 1]),
    mask(&[13, 4, 3, 1]),
    mask(&[14, 5, 3, 1]),
    mask(&[15, 14]),
    mask(&[16, 15, 13, 4]),
    mask(&[17, 14]),
    mask(&[18, 11]),
    mask(&[19, 6, 2, 1]),
    mask(&[20, 17]),
    mask(&[21, 19]),
    mask(&[22, 21]),
    mask(&[23, 18]),
    mask(&[24, 23, 22, 17]),
    mask(&[25, 22]),
    mask(&[26, 6, 2, 1]),
    mask(&[27, 5, 2, 1]),
];

const fn mask(taps: &[u32]) -> u32 {
    let (mut bits, mut i) = (0, 0);
    while i < taps.len() {
        bits |= 1 << (taps[i] - 1);
        i += 1;
    }
    bits
}

/// The shortest register whose period `2^n - 1` covers `bits`.
pub fn register_length(bits: usize) -> u32 {
    (2..=27).find(|&n| (1usize << n) > bits).unwrap_or(27)
}

/// One step of the Galois register; its lowest bit is the output.
fn advance(register: u32, mask: u32) -> u32 {
    (register >> 1) ^ (mask & (register & 1).wrapping_neg())
}

/// A maximum length sequence between `low` and `high`, each bit held for `hold` seconds.
///
/// The register is the shortest whose period covers the signal, so nothing repeats; the seed chooses where in the
/// period the signal starts.
///
/// # Errors
/// `ErrorKind::Setting` for values that are not finite, a hold below one sample, or a length outside 1 to
/// [`MAX_SAMPLES`] samples.
pub fn prbs(duration: f64, ts: f64, low: f64, high: f64, hold: f64, seed: u64) -> Result<Vec<f64>> {
    let n = samples("duration", duration, ts)?;
    let held = samples("hold", hold, ts)?.min(MAX_SAMPLES);
    finite(&[("low", low), ("high", high)])?;
    let length = register_length(n.div_ceil(held));
    let mask = MASKS[length as usize - 2];
    let mut register = start(length, seed);
    let mut signal = Vec::with_capacity(n);
    while signal.len() < n {
        let level = if register & 1 == 1 { high } else { low };
        signal.extend(std::iter::repeat_n(level, held.min(n - signal.len())));
        register = advance(register, mask);
    }
    Ok(signal)
}

/// A register content other than zero.
fn start(length: u32, seed: u64) -> u32 {
    let period = (1u64 << length) - 1;
    (1 + Random::new(seed).next_u64() % period) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_register_has_the_longest_period() {
        for (length, mask) in (2..).zip(MASKS) {
            let mut register = advance(1, mask);
            let mut period = 1u32;
            while register != 1 {
                register = advance(register, mask);
                period += 1;
            }
            assert_eq!(period, (1 << length) - 1, "{length} bits");
        }
    }

    #[test]
    fn one_period_is_balanced_and_white() {
        let bits = 127;
        let u = prbs(bits as f64, 1.0, -1.0, 1.0, 1.0, 5).unwrap();
        assert_eq!(u.iter().sum::<f64>(), 1.0);
        for lag in 1..bits {
            let correlation: f64 = (0..bits).map(|k| u[k] * u[(k + lag) % bits]).sum();
            assert_eq!(correlation, -1.0);
        }
    }

    #[test]
    fn chooses_its_register_by_the_length_and_its_start_by_the_seed() {
        assert_eq!([3, 4, 127, 128].map(register_length), [2, 3, 7, 8]);
        let draw = |seed| prbs(10.0, 1e-3, 0.0, 5.0, 0.05, seed).unwrap();
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
        assert!(draw(3).chunks(50).all(|c| c.iter().all(|v| *v == c[0])));
    }

    #[test]
    fn refuses_a_hold_below_one_sample() {
        assert!(prbs(10.0, 1e-3, 0.0, 5.0, 1e-4, 0).is_err());
        assert!(prbs(10.0, 1e-3, 0.0, f64::INFINITY, 0.1, 0).is_err());
    }
}
