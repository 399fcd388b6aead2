//! Start parameters: small random weights, or hidden units beside a linear model.

use super::network::Shape;
use super::scaling::Scaling;
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::random::Random;
use crate::{Error, Result};

/// Half the width of the interval that weights and biases of hidden units are drawn from.
const HIDDEN: f64 = 0.5;
/// The same for the weights of the output. Both are the best of several pairs on one simulated drive (11 of 12 starts
/// against 7 with .1 for both); on other drives expect two of three.
const OUTPUT: f64 = 0.02;

/// `b2` and `linear` with which the network, in scaled units, is this linear model.
///
/// # Errors
/// `ErrorKind::Setting` where the model's orders are not those of the shape.
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

/// Hidden units by Nguyen and Widrow (1990) that do not reach the output yet, beside the linear model.
pub(super) fn beside(bypass: &[f64], shape: Shape, random: &mut Random) -> Vec<f64> {
    let n_phi = shape.lags.regressors();
    let [bias, second, _, _] = shape.offsets();
    let mut theta = vec![0.0; shape.parameters()];
    // Standardised signals reach about two, where Nguyen and Widrow assume one.
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

/// Small random weights; the hidden units differ clearly, but reach the output only weakly.
pub(super) fn small(shape: Shape, random: &mut Random) -> Vec<f64> {
    let [_, second, _, _] = shape.offsets();
    let width = |i: usize| if i < second { HIDDEN } else { OUTPUT };
    (0..shape.parameters())
        .map(|i| random.between(-width(i), width(i)))
        .collect()
}
