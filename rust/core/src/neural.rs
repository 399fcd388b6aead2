//! The network output-error model: a free-running network with its scaling.

mod draw;
mod free_run;
mod network;
mod problem;
mod scaling;
mod sensitivities;
mod train;

pub(crate) use network::{Meanwhile, Nothing};
pub use network::{Network, Shape};
pub use scaling::Scaling;
pub use train::{InitialState, NeuralFit, Settings, fit};

use sensitivities::{Recursion, Rows};

use crate::gram::Gram;
use crate::lagged::{Form, Lagged, Lags, finite};
use crate::{Error, Result};

/// `f = w2 . tanh(W1 phi + b1) + b2 [+ linear . phi]` in scaled units, clipped to the limits (docs/CONVENTIONS.md).
#[derive(Clone, Debug)]
pub struct NeuralOE {
    theta: Vec<f64>,
    scaling: Scaling,
    network: Network,
}

impl NeuralOE {
    /// A model from its parameters; `limits` are in scaled units, infinite if the output does not saturate.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a wrong number of parameters or scales, values that are not finite, or limits that
    /// leave no room.
    pub fn new(
        shape: Shape,
        theta: Vec<f64>,
        scaling: Scaling,
        limits: (f64, f64),
    ) -> Result<Self> {
        if theta.len() != shape.parameters() {
            return Err(Error::setting(format!(
                "expected {} parameters for this shape, got {}; theta is W1 row by row, b1, w2, b2 and, with a bypass, linear",
                shape.parameters(),
                theta.len()
            )));
        }
        if theta.iter().any(|v| !v.is_finite()) {
            return Err(Error::setting(
                "expected finite parameters, got NaN or infinity; train the model again",
            ));
        }
        scaling.check(shape.lags.channels)?;
        let room = limits.0 < limits.1;
        if !room {
            return Err(Error::setting(format!(
                "expected output_low below output_high, got {} and {}; exchange or widen them",
                limits.0, limits.1
            )));
        }
        let mut network = Network::zero(shape, limits);
        network.load(&theta);
        Ok(Self {
            theta,
            scaling,
            network,
        })
    }

    /// Parameters, in the order of docs/CONVENTIONS.md.
    pub fn theta(&self) -> &[f64] {
        &self.theta
    }

    /// Orders, hidden units, bypass.
    pub fn shape(&self) -> Shape {
        self.network.shape
    }

    /// Scaling of inputs and output.
    pub fn scaling(&self) -> &Scaling {
        &self.scaling
    }

    /// Limits of the output in scaled units.
    pub fn limits(&self) -> (f64, f64) {
        self.network.limits
    }

    /// Free run in the data's units, and its derivatives row by row: with respect to theta, then to the past outputs.
    ///
    /// # Errors
    /// As [`Lagged::simulate`].
    pub fn jacobian(
        &self,
        u: &[f64],
        channels: usize,
        y_past: &[f64],
    ) -> Result<(Vec<f64>, Vec<f64>)> {
        let samples = self.lags().check(u, channels, y_past)?;
        let (u, state) = (self.scaling.inputs(u), self.scaled_state(y_past));
        let scaled = free_run::outputs(&self.network, &u, 0, &state, samples);
        let (shape, na) = (self.shape(), self.lags().na);
        let mut rows = Recording::of(self, samples);
        for i in 0..na {
            rows.gram.past_mut(i + 1)[shape.state_column() + i] = 1.0;
        }
        Recursion {
            network: &self.network,
            u: &u,
            first: 0,
            state: &state,
            run: &scaled,
            hidden: None,
            y: &scaled,
            weights: &[],
            rows: &mut rows,
            monitor: None,
        }
        .go();
        let rows = rows.rows;
        Ok((finite(self.restored(scaled))?, rows))
    }

    /// The derivatives of the output with respect to the whole regressor, in the data's units.
    pub(crate) fn slopes(&self, phi: &[f64]) -> Vec<f64> {
        let Lags { na, nb, .. } = self.lags();
        let mut scaled = vec![0.0; phi.len()];
        self.scaling.regressor(phi, na, nb, &mut scaled);
        let mut slopes = vec![0.0; phi.len()];
        self.network.output_and_slope(&scaled, &mut slopes);
        for (i, slope) in slopes[na..].iter_mut().enumerate() {
            *slope *= self.scaling.y_scale / self.scaling.u_scale[i / nb];
        }
        slopes
    }

    fn scaled_state(&self, y_past: &[f64]) -> Vec<f64> {
        y_past.iter().map(|y| self.scaling.output(*y)).collect()
    }

    fn restored(&self, mut run: Vec<f64>) -> Vec<f64> {
        run.iter_mut().for_each(|y| *y = self.scaling.restored(*y));
        run
    }
}

/// The rows of a free run in the data's units, in the order of theta, then the past outputs.
struct Recording {
    gram: Gram,
    columns: Vec<usize>,
    /// Columns of the past outputs; they have the unit of the output.
    states: std::ops::Range<usize>,
    y_scale: f64,
    rows: Vec<f64>,
}

impl Recording {
    fn of(model: &NeuralOE, samples: usize) -> Self {
        let (shape, columns) = (model.shape(), model.shape().columns());
        let states = shape.state_column()..shape.state_column() + shape.lags.na;
        Self {
            gram: shape.gram(true),
            y_scale: model.scaling.y_scale,
            rows: Vec::with_capacity(samples * (columns.len() + states.len())),
            columns,
            states,
        }
    }
}

impl Rows for Recording {
    fn ahead(&mut self, count: usize) -> &mut [f64] {
        self.gram.ahead(count)
    }

    fn keep(&mut self, errors: &[f64], weights: &[f64]) {
        self.gram.keep_all(errors, weights);
        for back in (1..=errors.len()).rev() {
            let row = self.gram.past_mut(back);
            let scaled = self.columns.iter().map(|&c| row[c] * self.y_scale);
            self.rows.extend(scaled);
            self.rows.extend_from_slice(&row[self.states.clone()]);
        }
    }
}

impl Lagged for NeuralOE {
    fn lags(&self) -> Lags {
        self.network.shape.lags
    }

    fn output(&self, phi: &[f64]) -> f64 {
        self.output_and_slope(phi, &mut [])
    }

    fn output_and_slope(&self, phi: &[f64], slope: &mut [f64]) -> f64 {
        let Lags { na, nb, .. } = self.lags();
        // regressors of the usual size need no allocation
        let (mut few, mut many) = ([0.0; 32], Vec::new());
        let scaled = match few.get_mut(..phi.len()) {
            Some(few) => few,
            None => {
                many.resize(phi.len(), 0.0);
                &mut many[..]
            }
        };
        self.scaling.regressor(phi, na, nb, scaled);
        self.scaling
            .restored(self.network.output_and_slope(scaled, slope))
    }

    fn form(&self) -> Option<Form> {
        Some(Form::Network(self.in_data_units()))
    }

    fn simulate(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<Vec<f64>> {
        let samples = self.lags().check(u, channels, y_past)?;
        if self.scaling.is_moderate() {
            // with weights in the data's units the signals need no scaling: no copy of the inputs, no second pass over the outputs
            let network = self.in_data_units();
            return finite(free_run::outputs(&network, u, 0, y_past, samples));
        }
        let (u, state) = (self.scaling.inputs(u), self.scaled_state(y_past));
        finite(self.restored(free_run::outputs(&self.network, &u, 0, &state, samples)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::{Monitor, Record};
    use proptest::prelude::*;

    #[test]
    fn a_mean_far_beyond_its_scale_costs_no_digits() {
        let near = random_model(3, 8, true, false);
        let random = &mut Random::new(5);
        let v: Vec<f64> = (0..400).map(|_| random.between(-1.0, 1.0)).collect();
        let of = |scaling: Scaling| {
            let limits = (f64::NEG_INFINITY, f64::INFINITY);
            let far = NeuralOE::new(near.shape(), near.theta().to_vec(), scaling.clone(), limits);
            let far = far.unwrap();
            let u: Vec<f64> = v
                .chunks_exact(2)
                .flat_map(|v| [0, 1].map(|j| v[j] * scaling.u_scale[j] + scaling.u_mean[j]))
                .collect();
            let y = far.simulate(&u, 2, &[scaling.y_mean; 2]).unwrap();
            let scaled = y.iter().map(|y| (y - scaling.y_mean) / scaling.y_scale);
            scaled.collect::<Vec<_>>()
        };
        let power = |n: i32| 2f64.powi(n);
        let scaling = |mean: f64, u_scale: f64, y_scale: f64| Scaling {
            u_mean: vec![mean * u_scale; 2],
            u_scale: vec![u_scale; 2],
            y_mean: mean * y_scale,
            y_scale,
        };
        let expected = of(scaling(0.0, 1.0, 1.0));
        // the remaining error is the rounding of u and y themselves
        for (found, most) in [
            (of(scaling(power(20), 1.0, 1.0)), 1e-8),
            (of(scaling(0.0, power(-700), power(700))), 1e-13),
        ] {
            for (a, b) in found.iter().zip(&expected) {
                assert!((a - b).abs() <= most, "{a} {b}");
            }
        }
    }

    fn random_model(seed: u64, hidden: usize, bypass: bool, clipped: bool) -> NeuralOE {
        let mut random = Random::new(seed);
        let shape = Shape::new(Lags::new(2, 2, 1, 2).unwrap(), hidden, bypass).unwrap();
        let theta = (0..shape.parameters())
            .map(|_| random.between(-0.4, 0.4))
            .collect();
        let scaling = Scaling {
            u_mean: vec![0.1, -0.2],
            u_scale: vec![2.0, 0.5],
            y_mean: 3.0,
            y_scale: 20.0,
        };
        let limits = if clipped {
            (-0.3, 0.3)
        } else {
            (f64::NEG_INFINITY, f64::INFINITY)
        };
        NeuralOE::new(shape, theta, scaling, limits).unwrap()
    }

    fn moved(model: &NeuralOE, i: usize, by: f64) -> NeuralOE {
        let mut theta = model.theta().to_vec();
        theta[i] += by;
        NeuralOE::new(
            model.shape(),
            theta,
            model.scaling().clone(),
            model.limits(),
        )
        .unwrap()
    }

    proptest! {
        #![proptest_config(crate::laws::cases(80))]
        #[test]
        fn sensitivities_agree_with_differences(seed in any::<u64>(), hidden in 1usize..10, bypass in any::<bool>()) {
            let model = random_model(seed, hidden, bypass, false);
            let mut random = Random::stream(seed, 1);
            let u: Vec<f64> = (0..80).map(|_| random.normal()).collect();
            let past = [4.0, 2.0];
            let (run, rows) = model.jacobian(&u, 2, &past).unwrap();
            let columns = model.theta().len() + 2;
            for i in 0..model.theta().len() {
                let ahead = moved(&model, i, 1e-5).simulate(&u, 2, &past).unwrap();
                let behind = moved(&model, i, -1e-5).simulate(&u, 2, &past).unwrap();
                for k in 0..run.len() {
                    let difference = (ahead[k] - behind[k]) / 2e-5;
                    prop_assert!((rows[k * columns + i] - difference).abs() < 1e-5 * (1.0 + difference.abs()));
                }
            }
        }

        #[test]
        fn a_clean_record_gives_its_state_back(seed in any::<u64>()) {
            let model = random_model(seed, 5, true, false);
            let mut random = Random::stream(seed, 2);
            let u: Vec<f64> = (0..80).map(|_| random.normal()).collect();
            let y = model.simulate(&u, 2, &[12.0, -5.0]).unwrap();
            let state = model.estimate_initial_state(&u, 2, &y).unwrap();
            let again = model.simulate(&u, 2, &state).unwrap();
            let worst = y.iter().zip(&again).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            prop_assert!(worst < 1e-3 * model.scaling().y_scale, "{worst}");
        }
    }

    #[test]
    fn a_state_that_is_soon_forgotten_comes_back_from_a_clean_record() {
        // a state far from the outputs: its prior once outweighed the few outputs that depend on it
        for (seed, inputs) in [
            (17_557_077_261_666_588_454, 80),
            (12_707_694_688_172_175_531, 40),
            // another basin is left by one of the further starts, whose prior has to be relaxed as well
            (319_957_315_622_008_337, 80),
        ] {
            let model = random_model(seed, 5, true, false);
            let mut random = Random::stream(seed, 2);
            let u: Vec<f64> = (0..inputs).map(|_| random.normal()).collect();
            let y = model.simulate(&u, 2, &[12.0, -5.0]).unwrap();
            let state = model.estimate_initial_state(&u, 2, &y).unwrap();
            assert!(
                (state[0] - 12.0).abs() < 1e-3 && (state[1] + 5.0).abs() < 1e-3,
                "{state:?}"
            );
        }
    }

    #[test]
    fn a_clipped_sample_has_the_limit_and_no_slope() {
        let model = random_model(3, 4, true, true);
        let u: Vec<f64> = (0..100).map(|k| 2.0 * (k as f64).sin()).collect();
        let (run, rows) = model.jacobian(&u, 2, &[3.0, 3.0]).unwrap();
        let columns = model.theta().len() + 2;
        let clipped: Vec<usize> = (0..run.len())
            .filter(|&k| (run[k] - 3.0).abs() >= 6.0 - 1e-12)
            .collect();
        assert!(!clipped.is_empty() && clipped.len() < run.len());
        for k in clipped {
            assert!(
                rows[k * columns..(k + 1) * columns]
                    .iter()
                    .all(|&v| v == 0.0)
            );
        }
    }

    #[test]
    fn an_interrupted_training_returns_its_best() {
        let u: Vec<f64> = (0..4000).map(|k| (k as f64 * 0.01).sin()).collect();
        let y: Vec<f64> = u.iter().map(|u| u.powi(3)).collect();
        let settings = Settings {
            na: 1,
            nb: 1,
            nk: 0,
            hidden: 8,
            linear: None,
            scaling: None,
            saturate: None,
            initial_state: InitialState::Measured,
            weight_decay: 0.0,
            max_iterations: 100_000,
            starts: 3,
            initial_theta: None,
            seed: 0,
            threads: 1,
        };
        let monitor = Monitor::default();
        let record = Record::new(&u, 1, &y).unwrap();
        let fit = std::thread::scope(|scope| {
            scope.spawn(|| {
                while monitor.progress().0 < 5 {
                    std::thread::yield_now();
                }
                monitor.request_stop();
            });
            fit(&[record], &[], &settings, &monitor)
        });
        let fit = fit.unwrap();
        assert_eq!(fit.termination, crate::lm::Termination::Interrupted);
        assert!(fit.cost <= fit.trace[0] && fit.start == 0);
    }
}
