//! The filter that predicts a grey box from measured outputs.

use super::Dual;
use super::model::{FILTERED, GreyBox, POSITION, STATES};
use super::stepper::{Moving, Stepper};

/// The states with their covariance, corrected by measured outputs (extended Kalman filter: Anderson and Moore 1979, section 8.2).
pub(super) struct Filter<'a, const N: usize> {
    pub model: &'a GreyBox,
    pub stepper: Stepper<N>,
    pub state: [f64; STATES],
    pub covariance: [[f64; FILTERED.len()]; FILTERED.len()],
}

impl<const N: usize> Filter<'_, N> {
    /// The predicted output and the state that follows, each with derivatives.
    pub fn step(&self, v: f64) -> (Dual<N>, Moving<N>) {
        let mut at = Moving::at(self.model, &self.state).seeded(self.model, 0);
        let y = self.stepper.step(&mut at, &Dual::constant(v));
        (y, at)
    }

    /// Corrects the state by one output; NaN is skipped.
    pub fn measure(&mut self, v: f64, y: f64) {
        if y.is_nan() {
            return;
        }
        let (predicted, _) = self.step(v);
        let places = self.model.filtered();
        let p = self.covariance;
        let mut gain = [0.0; FILTERED.len()];
        let mut spread = self.model.frame.residual_variance;
        for (i, gain) in gain.iter_mut().enumerate().take(places.len()) {
            for (j, &place) in places.iter().enumerate() {
                *gain += p[i][j] * predicted.by[place];
            }
            spread += predicted.by[places[i]] * *gain;
        }
        for (i, &place) in places.iter().enumerate() {
            self.state[place] += gain[i] * (y - predicted.value) / spread;
            for j in 0..places.len() {
                self.covariance[i][j] -= gain[i] * gain[j] / spread;
            }
        }
    }

    pub fn advance(&mut self, v: f64) {
        let (_, at) = self.step(v);
        let next = at.scaled(self.model);
        let places = self.model.filtered();
        let p = self.covariance;
        for (i, &a) in places.iter().enumerate() {
            for (j, &b) in places.iter().enumerate() {
                self.covariance[i][j] = places
                    .iter()
                    .enumerate()
                    .flat_map(|(k, c)| places.iter().enumerate().map(move |(l, d)| (k, c, l, d)))
                    .map(|(k, &c, l, &d)| next[a].by[c] * p[k][l] * next[b].by[d])
                    .sum();
            }
            // positions move with the speeds only
            if a < POSITION || a == 6 {
                self.covariance[i][i] += self.model.frame.process_noise;
            }
        }
        self.state = at.state(self.model);
    }
}
