//! Errors and fits of a model; rise time, overshoot and effort of a response.

use crate::{Error, Result};

/// Root mean square of `y - model`, in the output's unit.
pub fn rmse(y: &[f64], model: &[f64]) -> f64 {
    let sum: f64 = y.iter().zip(model).map(|(a, b)| (a - b).powi(2)).sum();
    (sum / y.len() as f64).sqrt()
}

/// `100 (1 - |y - model| / |y - mean(y)|)` percent, Euclidean norms; minus infinity for a constant `y`.
pub fn fit_percent(y: &[f64], model: &[f64]) -> f64 {
    let mean = y.iter().sum::<f64>() / y.len() as f64;
    let spread = rms(y.iter().map(|v| v - mean));
    100.0 * (1.0 - rmse(y, model) / spread)
}

/// Root mean square of values; 0 of none.
pub(crate) fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len().max(1) as f64;
    (values.map(|v| v * v).sum::<f64>() / n).sqrt()
}

/// The effort of a controller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effort {
    /// Root mean square of the command \[u\].
    pub u_rms: f64,
    /// Root mean square of its change from sample to sample \[u\].
    pub du_rms: f64,
    /// Share of the samples at a limit, 0 to 1.
    pub saturated: f64,
}

impl Effort {
    /// Effort of a command under limits `low` and `high`.
    pub fn of(u: &[f64], low: f64, high: f64) -> Self {
        let at_limit = u.iter().filter(|&&u| u <= low || u >= high).count();
        Self {
            u_rms: rms(u.iter().copied()),
            du_rms: rms(u.windows(2).map(|pair| pair[1] - pair[0])),
            saturated: at_limit as f64 / u.len().max(1) as f64,
        }
    }
}

/// A rise or fall of a reference from one level to another that it then holds; indices of samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Last sample at the first level.
    pub start: usize,
    /// First sample at the final level.
    pub top: usize,
    /// Last sample at the final level.
    pub end: usize,
    /// First level.
    pub low: f64,
    /// Final level.
    pub high: f64,
}

impl Edge {
    /// The first edge of a step or trapezoid; `None` if the reference holds no level after its first edge.
    pub fn first(reference: &[f64]) -> Option<Self> {
        let change = |k: usize| reference[k + 1] - reference[k];
        let last = reference.len().checked_sub(1)?;
        let start = (0..last).find(|&k| change(k) != 0.0)?;
        let direction = change(start).signum();
        let top = (start..last)
            .find(|&k| change(k) * direction <= 0.0)
            .unwrap_or(last);
        let (low, high) = (reference[start], reference[top]);
        // Ramps computed in floating point end a rounding error away from their level.
        let holds = |k: &usize| (reference[*k] - high).abs() <= 1e-9 * (high - low).abs();
        let end = (top..=last).take_while(holds).last()?;
        let long_enough = end - top >= 3.max((top - start) / 5);
        long_enough.then_some(Self {
            start,
            top,
            end,
            low,
            high,
        })
    }

    /// Time in samples from 10 % to 90 % of the step; NaN if `y` does not reach 90 % before the reference moves on.
    pub fn rise(&self, y: &[f64]) -> f64 {
        self.crossing(y, 0.9) - self.crossing(y, 0.1)
    }

    fn share(&self, y: f64) -> f64 {
        (y - self.low) / (self.high - self.low)
    }

    fn crossing(&self, y: &[f64], share: f64) -> f64 {
        let reached = (self.start..=self.end).find(|&k| self.share(y[k]) >= share);
        match reached {
            None => f64::NAN,
            Some(k) if k == self.start => k as f64,
            Some(k) => {
                let (before, after) = (self.share(y[k - 1]), self.share(y[k]));
                (k - 1) as f64 + (share - before) / (after - before)
            }
        }
    }

    /// Largest excess of `y` over the final level while the reference holds it, in percent of the step.
    pub fn overshoot_percent(&self, y: &[f64]) -> f64 {
        let highest = y[self.start..=self.end]
            .iter()
            .fold(0.0, |most, &y| f64::max(most, self.share(y)));
        100.0 * (highest - 1.0).max(0.0)
    }
}

/// How a response follows the first edge of its reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepMetrics {
    /// 10 % to 90 % \[s\]; NaN if the response does not reach 90 % before the reference moves on.
    pub rise_time: f64,
    /// The same of the reference itself \[s\].
    pub reference_rise_time: f64,
    /// Largest excess over the final level, in percent of the step.
    pub overshoot_percent: f64,
}

/// Rise time and overshoot on the first edge of a step or trapezoid, after a centred moving average of `smoothing` seconds.
///
/// # Errors
/// `ErrorKind::Data` for lengths that differ or a reference without an edge followed by a level, `ErrorKind::Setting`
/// for an unusable sample time or smoothing.
pub fn step_metrics(y: &[f64], reference: &[f64], ts: f64, smoothing: f64) -> Result<StepMetrics> {
    if y.len() != reference.len() {
        return Err(Error::data(format!(
            "expected as many outputs as reference samples, got {} and {}; give both for the same time",
            y.len(),
            reference.len()
        )));
    }
    if !(ts > 0.0 && ts.is_finite() && (0.0..1e6 * ts).contains(&smoothing)) {
        return Err(Error::setting(format!(
            "expected Ts above 0 and smoothing of 0 s or more, got {ts} and {smoothing}; 0.005 s is customary"
        )));
    }
    let edge = Edge::first(reference).ok_or_else(|| {
        Error::data(
            "expected a reference that moves to a level and holds it, got one without such an edge; rise time and \
             overshoot are defined for steps and trapezoids",
        )
    })?;
    let y = smooth(y, ts, smoothing);
    Ok(StepMetrics {
        rise_time: edge.rise(&y) * ts,
        reference_rise_time: edge.rise(reference) * ts,
        overshoot_percent: edge.overshoot_percent(&y),
    })
}

/// Centred moving average over about `smoothing` seconds, an odd number of samples; fewer at the ends.
pub(crate) fn smooth(y: &[f64], ts: f64, smoothing: f64) -> Vec<f64> {
    let half = (smoothing / ts / 2.0).floor() as usize;
    let mean = |k: usize| {
        let window = &y[k.saturating_sub(half)..y.len().min(k + half + 1)];
        window.iter().sum::<f64>() / window.len() as f64
    };
    (0..y.len()).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trapezoid() -> Vec<f64> {
        (0..1000)
            .map(|k| (f64::from((k - 100).min(700 - k)) / 150.0).clamp(0.0, 1.0) * 3000.0)
            .collect()
    }

    #[test]
    fn measures_errors_as_defined() {
        let (y, model) = ([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 2.0]);
        assert_eq!(rmse(&y, &model), 1.0);
        assert!((fit_percent(&y, &model) - 100.0 * (1.0 - 2.0 / 5.0_f64.sqrt())).abs() < 1e-12);
        assert_eq!(fit_percent(&[1.0, 1.0], &[0.0, 0.0]), f64::NEG_INFINITY);
    }

    #[test]
    fn finds_the_rise_of_the_trapezoid_itself() {
        let r = trapezoid();
        let metrics = step_metrics(&r, &r, 1e-3, 0.0).unwrap();
        assert!((metrics.rise_time - 0.12).abs() < 1e-9 && metrics.overshoot_percent == 0.0);
        assert!((metrics.reference_rise_time - 0.12).abs() < 1e-9);
    }

    #[test]
    fn measures_a_response_that_lags_and_overshoots() {
        let r = trapezoid();
        let y: Vec<f64> = (0..1000_usize)
            .map(|k| {
                if (300..=400).contains(&k) {
                    3090.0
                } else {
                    r[k.saturating_sub(20)]
                }
            })
            .collect();
        let metrics = step_metrics(&y, &r, 1e-3, 0.005).unwrap();
        assert!(
            (metrics.overshoot_percent - 3.0).abs() < 1e-9,
            "{metrics:?}"
        );
        assert!((metrics.rise_time - 0.12).abs() < 1e-9);
        // The smoothing reduces a single sample of noise to a fifth.
        let mut spike = r.clone();
        spike[500] = 3150.0;
        let spiked = step_metrics(&spike, &r, 1e-3, 0.005).unwrap();
        assert!((spiked.overshoot_percent - 1.0).abs() < 1e-9);
    }

    #[test]
    fn measures_falling_steps_and_says_when_the_level_is_not_reached() {
        let r: Vec<f64> = (0..100).map(|k| if k < 10 { 5.0 } else { 1.0 }).collect();
        let y: Vec<f64> = (0..100)
            .map(|k| {
                if k < 10 {
                    5.0
                } else {
                    1.0 + 4.0 * (-f64::from(k - 10) / 10.0).exp()
                }
            })
            .collect();
        let metrics = step_metrics(&y, &r, 0.01, 0.0).unwrap();
        let exact = 0.1 * 9.0_f64.ln();
        assert!((metrics.rise_time - exact).abs() < 1e-3, "{metrics:?}");
        assert!(
            step_metrics(&[5.0; 100], &r, 0.01, 0.0)
                .unwrap()
                .rise_time
                .is_nan()
        );
    }

    #[test]
    fn refuses_references_without_a_level() {
        let sine: Vec<f64> = (0..500).map(|k| (f64::from(k) / 50.0).sin()).collect();
        for r in [&sine[..], &[1.0; 50], &[], &[1.0]] {
            assert!(step_metrics(r, r, 1e-3, 0.0).is_err());
        }
        assert!(step_metrics(&[0.0; 3], &trapezoid(), 1e-3, 0.0).is_err());
        assert!(step_metrics(&trapezoid(), &trapezoid(), 0.0, 0.0).is_err());
    }

    #[test]
    fn counts_the_effort() {
        let effort = Effort::of(&[10.0, -10.0, 0.0, 0.0], -10.0, 10.0);
        assert_eq!(effort.saturated, 0.5);
        assert!((effort.u_rms - 50.0_f64.sqrt()).abs() < 1e-12);
        assert!((effort.du_rms - (500.0_f64 / 3.0).sqrt()).abs() < 1e-12);
    }
}
