//! The discrete Fourier transform of a power of two of samples (Cooley and Tukey, *Mathematics of Computation* 19, 1965), and the
//! correlations over all shifts that it gives.

use std::f64::consts::TAU;

use nalgebra::Complex;

/// `sum_k x[k] e^(-2 pi i j k / n)` in place, `n` a power of two.
fn transform(x: &mut [Complex<f64>]) {
    let n = x.len();
    let mut j = 0;
    for i in 1..n {
        let mut bit = n >> 1;
        while j & bit != 0 {
            j ^= bit;
            bit >>= 1;
        }
        j |= bit;
        if i < j {
            x.swap(i, j);
        }
    }
    let turn: Vec<Complex<f64>> = (0..n / 2)
        .map(|k| Complex::from_polar(1.0, -TAU * k as f64 / n as f64))
        .collect();
    let mut half = 1;
    while half < n {
        for block in x.chunks_exact_mut(2 * half) {
            let (low, high) = block.split_at_mut(half);
            let turns = turn.iter().step_by(n / (2 * half));
            for ((a, b), w) in low.iter_mut().zip(high).zip(turns) {
                let turned = *b * w;
                *b = *a - turned;
                *a += turned;
            }
        }
        half *= 2;
    }
}

/// Spectrum of real samples, followed by zeros up to `size`, a power of two.
pub(crate) fn spectrum(x: &[f64], size: usize) -> Vec<Complex<f64>> {
    let mut found: Vec<_> = x.iter().map(|x| Complex::new(*x, 0.0)).collect();
    found.resize(size, Complex::new(0.0, 0.0));
    transform(&mut found);
    found
}

/// Spectrum of real samples of any number: `j k = (j^2 + k^2 - (j - k)^2) / 2` turns the sum into a convolution with a chirp (Bluestein,
/// *IEEE Trans. Audio and Electroacoustics* 18, 1970).
pub(crate) fn lines(x: &[f64]) -> Vec<Complex<f64>> {
    let n = x.len();
    if n.is_power_of_two() {
        return spectrum(x, n);
    }
    // the square is reduced before it is a phase: it would lose digits
    let turn =
        |k: usize| Complex::from_polar(1.0, -TAU / 2.0 * ((k * k) % (2 * n)) as f64 / n as f64);
    let chirp: Vec<_> = (0..n).map(turn).collect();
    let size = (2 * n - 1).next_power_of_two();
    let zero = Complex::new(0.0, 0.0);
    let (mut a, mut b) = (vec![zero; size], vec![zero; size]);
    for (k, chirp) in chirp.iter().enumerate() {
        a[k] = chirp * x[k];
        b[k] = chirp.conj();
        b[(size - k) % size] = chirp.conj();
    }
    transform(&mut a);
    transform(&mut b);
    // the inverse transform of z is the conjugate of that of z', over the size
    let mut product: Vec<_> = a.iter().zip(&b).map(|(a, b)| (a * b).conj()).collect();
    transform(&mut product);
    let found = product.iter().zip(&chirp);
    found
        .map(|(z, chirp)| z.conj() * chirp / size as f64)
        .collect()
}

/// `sum_k x[k] y[k + s]` for every `s`, from the spectra; negative `s` count from the end.
pub(crate) fn correlation(x: &[Complex<f64>], y: &[Complex<f64>]) -> Vec<f64> {
    // the inverse transform of z is the conjugate of that of z', over n
    let mut product: Vec<_> = x.iter().zip(y).map(|(x, y)| x * y.conj()).collect();
    transform(&mut product);
    let n = product.len() as f64;
    product.iter().map(|z| z.re / n).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn lines_are_sums_over_samples(x in prop::collection::vec(-1.0..1.0_f64, 1..70)) {
            let n = x.len();
            for (j, line) in lines(&x).iter().enumerate() {
                let turn = |k: usize| Complex::from_polar(1.0, -TAU * ((j * k) % n) as f64 / n as f64);
                let sum: Complex<f64> = x.iter().enumerate().map(|(k, x)| turn(k) * x).sum();
                prop_assert!((line - sum).norm() < 1e-12);
            }
        }

        #[test]
        fn correlations_are_sums_over_shifted_samples(
            x in prop::collection::vec(-1.0..1.0_f64, 1..40),
            y in prop::collection::vec(-1.0..1.0_f64, 1..40),
        ) {
            let size = (x.len() + y.len()).next_power_of_two();
            let found = correlation(&spectrum(&x, size), &spectrum(&y, size));
            for s in -(x.len() as isize - 1)..y.len() as isize {
                let at = |k: usize| k.checked_add_signed(s).and_then(|k| y.get(k)).copied().unwrap_or(0.0);
                let sum: f64 = x.iter().enumerate().map(|(k, x)| x * at(k)).sum();
                let place = s.rem_euclid(size as isize) as usize;
                prop_assert!((found[place] - sum).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_sine_is_one_line() {
        let x: Vec<f64> = (0..64)
            .map(|k| (TAU * 5.0 * f64::from(k) / 64.0).cos())
            .collect();
        for (j, line) in spectrum(&x, 64).iter().enumerate() {
            let wanted = if j == 5 || j == 59 { 32.0 } else { 0.0 };
            assert!((line - Complex::new(wanted, 0.0)).norm() < 1e-12);
        }
    }
}
