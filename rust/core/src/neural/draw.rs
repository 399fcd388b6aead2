//! Start parameters: small random weights, or hidden units beside a linear model.

use super::network::{Network, Shape};
use super::problem::Experiment;
use super::scaling::Scaling;
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::lm::{cholesky, substitute};
use crate::random::Random;
use crate::simd::{LANES, Lanes};
use crate::{Error, Result};

/// Half the width of the interval that weights and biases of hidden units are drawn from.
const HIDDEN: f64 = 0.5;
/// The same for the weights of the output. Both were the best of several pairs on one simulated drive (11 of 12 starts,
/// against 7 with .1 for both); on other drives expect two of three.
const OUTPUT: f64 = 0.02;

/// `b2` and `linear` that make the network, in scaled units, equal to this linear model.
///
/// # Errors
/// `ErrorKind::Setting` if the model's orders are not those of the shape.
pub(super) fn bypass(model: &LinearModel, scaling: &Scaling, shape: Shape) -> Result<Vec<f64>> {
    if model.lags() != shape.lags {
        return Err(Error::setting(format!(
            "expected a linear model with the network's orders {:?}, got {:?}; fit one with the same na, nb, nk and inputs",
            shape.lags,
            model.lags()
        )));
    }
    let nb = shape.lags.nb;
    let moved: f64 = model
        .b()
        .iter()
        .enumerate()
        .map(|(i, b)| b * scaling.u_mean[i / nb])
        .sum();
    let held = 1.0 + model.a().iter().sum::<f64>();
    let constant = (model.offset() + moved - scaling.y_mean * held) / scaling.y_scale;
    let inputs = model.b().iter().enumerate();
    let inputs = inputs.map(|(i, b)| b * scaling.u_scale[i / nb] / scaling.y_scale);
    let past = model.a().iter().map(|a| -a);
    Ok([constant].into_iter().chain(past).chain(inputs).collect())
}

/// Hidden units by Nguyen and Widrow (1990), with output weights of zero, beside the linear model.
pub(super) fn beside(bypass: &[f64], shape: Shape, random: &mut Random) -> Vec<f64> {
    let n_phi = shape.lags.regressors();
    let [bias, second, _, _] = shape.offsets();
    let mut theta = vec![0.0; shape.parameters()];
    // Standardised signals reach about two; Nguyen and Widrow assume one.
    let size = 0.35 * (shape.hidden as f64).powf(1.0 / n_phi as f64);
    for i in 0..shape.hidden {
        let row = &mut theta[i * n_phi..(i + 1) * n_phi];
        row.fill_with(|| random.between(-1.0, 1.0));
        let length = row
            .iter()
            .map(|w| w * w)
            .sum::<f64>()
            .sqrt()
            .max(f64::MIN_POSITIVE);
        row.iter_mut().for_each(|w| *w *= size / length);
        theta[bias + i] = random.between(-2.0 * size, 2.0 * size);
    }
    theta[second + shape.hidden..].copy_from_slice(bypass);
    theta
}

/// Small random weights: the hidden units differ clearly, but contribute little to the output.
pub(super) fn small(shape: Shape, random: &mut Random) -> Vec<f64> {
    let [_, second, _, _] = shape.offsets();
    let width = |i: usize| if i < second { HIDDEN } else { OUTPUT };
    (0..shape.parameters())
        .map(|i| random.between(-width(i), width(i)))
        .collect()
}

/// Added to the diagonal, relative to its mean: with small weights the hidden outputs are nearly collinear.
const RIDGE: f64 = 1e-9;

/// `w2` and `b2` by least squares over the measured regressors, for the hidden units that `network` holds.
///
/// With a random output layer the free run has next to nothing to do with the drive; with this one it is roughly an ARX
/// model from the start (extreme learning machine: Huang, Zhu and Siew 2006). `None` if the system is singular.
pub(super) fn output_layer(network: &Network, experiments: &[Experiment]) -> Option<Vec<f64>> {
    let (lags, hidden) = (network.shape.lags, network.shape.hidden);
    let n = hidden + 1;
    let (mut left, mut right) = (vec![0.0; n * n], vec![0.0; n]);
    let (mut phi, mut row) = (vec![0.0; lags.regressors()], vec![1.0; n]);
    let mut groups = vec![Lanes::ZERO; network.shape.groups()];
    for experiment in experiments {
        let measured = |k: &usize| experiment.y[k - lags.na..=*k].iter().all(|y| !y.is_nan());
        for k in (lags.na..experiment.y.len()).filter(measured) {
            let past = experiment.y[k - lags.na..k].iter().rev();
            phi.iter_mut().zip(past).for_each(|(phi, y)| *phi = *y);
            lags.write_inputs(&experiment.u, k, &mut phi[lags.na..]);
            network.hidden(&phi, &mut groups);
            for (i, value) in row[..hidden].iter_mut().enumerate() {
                *value = groups[i / LANES].0[i % LANES];
            }
            for i in 0..n {
                right[i] += row[i] * experiment.y[k];
                for j in 0..=i {
                    left[i * n + j] += row[i] * row[j];
                }
            }
        }
    }
    let mean = (0..n).map(|i| left[i * n + i]).sum::<f64>() / n as f64;
    (0..n).for_each(|i| left[i * n + i] += RIDGE * mean);
    cholesky(&mut left, n).then(|| {
        substitute(&left, n, &mut right);
        right
    })
}

#[cfg(test)]
mod tests {
    use super::super::train::InitialState;
    use super::*;
    use crate::Record;
    use crate::lagged::Lags;

    #[test]
    fn predicts_one_step_ahead_as_well_as_the_hidden_units_allow() {
        let u: Vec<f64> = (0..3000)
            .map(|k| 0.3 * (1.0 - (1e-2 * k as f64).cos()))
            .collect();
        let mut y = vec![0.0; u.len()];
        for k in 1..u.len() {
            y[k] = 0.98 * y[k - 1] + 0.1 * (2.0 * u[k - 1]).tanh();
        }
        let lags = Lags {
            na: 2,
            nb: 2,
            nk: 1,
            channels: 1,
        };
        let shape = Shape::new(lags, 8, false).unwrap();
        let scaling = Scaling {
            u_mean: vec![0.0],
            u_scale: vec![1.0],
            y_mean: 0.0,
            y_scale: 1.0,
        };
        let record = Record::new(&u, 1, &y).unwrap();
        let experiments = [Experiment::new(
            &record,
            &scaling,
            2,
            InitialState::Measured,
        )];
        let mut network = Network::zero(shape, (f64::NEG_INFINITY, f64::INFINITY));
        let mut theta = small(shape, &mut Random::new(3));
        let second = shape.offsets()[1];
        network.load(&theta);
        let output = output_layer(&network, &experiments).unwrap();
        let mut error = |output: &[f64]| {
            theta[second..second + output.len()].copy_from_slice(output);
            network.load(&theta);
            let one_step = |k: usize| network.output(&[y[k - 1], y[k - 2], u[k - 1], u[k - 2]]);
            (2..y.len())
                .map(|k| (y[k] - one_step(k)).powi(2))
                .sum::<f64>()
        };
        let least = error(&output);
        assert!(
            least < 1e-4 * y.iter().map(|y| y * y).sum::<f64>(),
            "{least}"
        );
        for i in 0..output.len() {
            for sign in [-1.0, 1.0] {
                let mut moved = output.clone();
                moved[i] += sign * 1e-3;
                assert!(error(&moved) > least);
            }
        }
    }
}
