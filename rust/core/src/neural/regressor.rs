//! Entries of the regressor over many samples at once.

use crate::lagged::Lags;

/// Entry `entry` of the regressor's input part for the samples from `start` on; inputs before the first sample are held
/// at their first value.
#[inline]
pub(super) fn inputs(lags: Lags, u: &[f64], start: usize, entry: usize, out: &mut [f64]) {
    let (channel, lag) = (entry / lags.nb, lags.nk + entry % lags.nb);
    let held = lag.saturating_sub(start).min(out.len());
    let (before, known) = out.split_at_mut(held);
    before.fill(u[channel]);
    let from = (start + held).saturating_sub(lag);
    if lags.channels == 1 {
        known.copy_from_slice(&u[from..from + known.len()]);
        return;
    }
    let rows = u[from * lags.channels..].chunks_exact(lags.channels);
    for (out, row) in known.iter_mut().zip(rows) {
        *out = row[channel];
    }
}

/// The output `back` samples before each of those from `start` of the run on; `state` holds those before the run, newest
/// first.
#[inline]
pub(super) fn outputs(run: &[f64], state: &[f64], start: usize, back: usize, out: &mut [f64]) {
    let held = back.saturating_sub(start).min(out.len());
    let (before, known) = out.split_at_mut(held);
    for (i, out) in before.iter_mut().enumerate() {
        *out = state[back - 1 - start - i];
    }
    let from = (start + held).saturating_sub(back);
    known.copy_from_slice(&run[from..from + known.len()]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_the_regressor_sample_by_sample() {
        let u: Vec<f64> = (0..60).map(f64::from).collect();
        for channels in [1, 2, 3] {
            let lags = Lags::new(2, 3, 2, channels).unwrap();
            let samples = u.len() / channels;
            for (start, count) in [(0, 3), (0, 20), (1, 1), (2, 9), (3, 1), (11, 9)] {
                for entry in 0..3 * channels {
                    let mut out = vec![f64::NAN; count];
                    inputs(lags, &u, start, entry, &mut out);
                    let mut phi = vec![0.0; 3 * channels];
                    for (k, out) in out.iter().enumerate() {
                        assert!(start + k < samples);
                        lags.write_inputs(&u, start + k, &mut phi);
                        assert_eq!(*out, phi[entry]);
                    }
                }
            }
        }
    }

    #[test]
    fn takes_outputs_before_the_run_from_its_state() {
        let (run, state) = ([10.0, 11.0, 12.0, 13.0, 14.0], [9.0, 8.0, 7.0]);
        let taken = |start: usize, back: usize, count: usize| {
            let mut out = vec![f64::NAN; count];
            outputs(&run, &state, start, back, &mut out);
            out
        };
        assert_eq!(taken(0, 1, 5), [9.0, 10.0, 11.0, 12.0, 13.0]);
        assert_eq!(taken(0, 3, 4), [7.0, 8.0, 9.0, 10.0]);
        assert_eq!(taken(0, 3, 2), [7.0, 8.0]);
        assert_eq!(taken(1, 3, 3), [8.0, 9.0, 10.0]);
        assert_eq!(taken(3, 2, 2), [11.0, 12.0]);
    }
}
