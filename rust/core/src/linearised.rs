//! Small-signal models: the derivatives of one step.

use nalgebra::{DMatrix, DVector};

use crate::lagged::Lags;
use crate::model::Differentiable;
use crate::neural_ss::NeuralSS;
use crate::{Error, Result};

/// `x+ = A x + B v`, `y = C x + D v` for small signals, where `v(k) = u(k - nk)`: the delay is not part of the state.
///
/// Inputs and outputs are in the data's units. The state of a [`NeuralSS`] is its own, in scaled units. The state of a
/// lagged model consists of the past outputs `y(k-1) .. y(k-na)` and, input by input, the past values
/// `v(k-1) .. v(k-nb+1)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Linearised {
    /// `dx+/dx`, row by row.
    pub a: Vec<f64>,
    /// `dx+/dv`, row by row.
    pub b: Vec<f64>,
    /// `dy/dx`, row by row.
    pub c: Vec<f64>,
    /// `dy/dv`, row by row.
    pub d: Vec<f64>,
    /// Number of states.
    pub states: usize,
    /// Number of inputs.
    pub inputs: usize,
}

impl Linearised {
    /// Of a lagged model, from the derivatives of its output with respect to the regressor.
    fn lagged(lags: Lags, slopes: &[f64]) -> Self {
        let Lags {
            na, nb, channels, ..
        } = lags;
        let states = na + channels * (nb - 1);
        let (past, inputs) = slopes.split_at(na);
        let older = inputs.chunks_exact(nb).flat_map(|input| &input[1..]);
        let c: Vec<f64> = past.iter().chain(older).copied().collect();
        let d: Vec<f64> = inputs.iter().step_by(nb).copied().collect();
        let (mut a, mut b) = (vec![0.0; states * states], vec![0.0; states * channels]);
        a[..states].copy_from_slice(&c);
        b[..channels].copy_from_slice(&d);
        (1..na).for_each(|i| a[i * states + i - 1] = 1.0);
        for j in 0..channels {
            let first = na + j * (nb - 1);
            for i in first..first + nb - 1 {
                match i == first {
                    true => b[i * channels + j] = 1.0,
                    false => a[i * states + i - 1] = 1.0,
                }
            }
        }
        Self {
            a,
            b,
            c,
            d,
            states,
            inputs: channels,
        }
    }
}

/// The regressor of a lagged model at this state.
fn regressor(lags: Lags, u: &[f64], state: &[f64]) -> Result<Vec<f64>> {
    let Lags {
        na, nb, channels, ..
    } = lags;
    check(u, state, channels, na + channels * (nb - 1))?;
    let (past, inputs) = state.split_at(na);
    let mut phi = past.to_vec();
    for (j, u) in u.iter().enumerate() {
        phi.push(*u);
        phi.extend_from_slice(&inputs[j * (nb - 1)..(j + 1) * (nb - 1)]);
    }
    Ok(phi)
}

fn check(u: &[f64], state: &[f64], inputs: usize, states: usize) -> Result<()> {
    if u.len() != inputs || state.len() != states {
        return Err(Error::data(format!(
            "expected {inputs} inputs and {states} states to linearise at, got {} and {}; the state of a lagged model is its past outputs, then the past nb - 1 values of each input",
            u.len(),
            state.len()
        )));
    }
    if u.iter().chain(state).all(|v| v.is_finite()) {
        return Ok(());
    }
    Err(Error::data(
        "expected finite inputs and states to linearise at, got NaN or infinity; take values within the training range",
    ))
}

/// Of a lagged model around the input `u`, held for `nk` samples, and a state. At a limit of the output all derivatives
/// are zero.
pub(crate) fn of_lagged(
    model: &impl Differentiable,
    u: &[f64],
    state: &[f64],
) -> Result<Linearised> {
    let phi = regressor(model.lags(), u, state)?;
    Ok(Linearised::lagged(model.lags(), &model.slopes(&phi)))
}

impl NeuralSS {
    /// Linearises around the input `u`, held for `nk` samples, and a state.
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong numbers of inputs or states, or values that are not finite.
    pub fn linearise(&self, u: &[f64], state: &[f64]) -> Result<Linearised> {
        let (shape, scaling) = (self.shape(), self.scaling());
        check(u, state, shape.inputs, shape.nx)?;
        let parts = shape.parts();
        let part = |part: std::ops::Range<usize>, rows: usize| {
            DMatrix::from_row_slice(rows, part.len() / rows, &self.theta()[part])
        };
        let (nx, hidden) = (shape.nx, shape.hidden);
        let scaled = u.iter().enumerate().map(|(j, u)| scaling.input(j, *u));
        let (x, v) = (
            DVector::from_column_slice(state),
            DVector::from_iterator(shape.inputs, scaled),
        );
        let (wx, wu) = (part(parts.wx, hidden), part(parts.wu, hidden));
        let z = &wx * &x + &wu * &v + part(parts.bh, hidden);
        let rises = DMatrix::from_diagonal(&z.map(|z| z.cosh().powi(-2)));
        let (c, d, g) = (part(parts.c, 1), part(parts.d, 1), part(parts.g, 1));
        let sum = &c * &x + &d * &v + part(parts.constant, 1) + &g * z.map(f64::tanh);
        let steepness = self.output().value_and_slope(sum[0]).1 * scaling.y_scale;
        let per_input = DVector::from_fn(shape.inputs, |j, _| scaling.u_scale[j].recip());
        let per_input = DMatrix::from_diagonal(&per_input);
        let bent = part(parts.e, nx) * &rises;
        let bent_output = g * rises;
        let rows = |matrix: DMatrix<f64>| matrix.transpose().as_slice().to_vec();
        Ok(Linearised {
            a: rows(part(parts.a, nx) + &bent * &wx),
            b: rows((part(parts.b, nx) + bent * &wu) * &per_input),
            c: rows(steepness * (c + &bent_output * wx)),
            d: rows(steepness * (d + bent_output * wu) * per_input),
            states: nx,
            inputs: shape.inputs,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagged::Lagged;
    use crate::linear::LinearModel;
    use crate::model::Model;
    use crate::neural::{self, NeuralOE};
    use crate::neural_ss::{OutputFunction, Scaling, Shape, Statistics};
    use crate::random::Random;

    /// Compares with differences of a step, which returns the next state followed by the outputs.
    fn check_against_differences(
        found: &Linearised,
        u: &[f64],
        state: &[f64],
        step: impl Fn(&[f64], &[f64]) -> Vec<f64>,
    ) {
        let (n, nu) = (state.len(), u.len());
        assert_eq!((found.states, found.inputs), (n, nu));
        let rows = found.a.len() / n + found.c.len() / n;
        for j in 0..n + nu {
            let moved = |by: f64| {
                let (mut u, mut state) = (u.to_vec(), state.to_vec());
                match j.checked_sub(n) {
                    None => state[j] += by,
                    Some(j) => u[j] += by,
                }
                step(&u, &state)
            };
            let (ahead, behind) = (moved(1e-5), moved(-1e-5));
            assert_eq!(ahead.len(), rows);
            for i in 0..rows {
                let (left, right) = if i < n {
                    (&found.a[i * n..][..n], &found.b[i * nu..][..nu])
                } else {
                    (&found.c[(i - n) * n..][..n], &found.d[(i - n) * nu..][..nu])
                };
                let row = [left, right].concat();
                let difference = (ahead[i] - behind[i]) / 2e-5;
                let close = 1e-7 * (1.0 + difference.abs());
                assert!(
                    (row[j] - difference).abs() < close,
                    "{i} {j}: {} {difference}",
                    row[j]
                );
            }
        }
    }

    /// The next lags and the output of a lagged model.
    fn lagged_step(model: &impl Lagged, u: &[f64], state: &[f64]) -> Vec<f64> {
        let lags = model.lags();
        let y = model.output(&regressor(lags, u, state).unwrap());
        let (past, inputs) = state.split_at(lags.na);
        let mut next = vec![y];
        next.extend_from_slice(&past[..lags.na - 1]);
        for (j, u) in u.iter().enumerate().filter(|_| lags.nb > 1) {
            next.push(*u);
            next.extend_from_slice(&inputs[j * (lags.nb - 1)..(j + 1) * (lags.nb - 1) - 1]);
        }
        next.push(y);
        next
    }

    #[test]
    fn lagged_models_agree_with_differences() {
        let mut random = Random::new(1);
        for (na, nb, nk, inputs) in [(1, 1, 1, 1), (2, 3, 0, 1), (3, 2, 2, 2), (2, 1, 1, 3)] {
            let mut draw = |count: usize| -> Vec<f64> {
                (0..count).map(|_| random.between(-0.5, 0.5)).collect()
            };
            let linear = LinearModel::new(draw(na), draw(nb * inputs), inputs, nk, 0.3).unwrap();
            let shape = neural::Shape::new(linear.lags(), 5, true).unwrap();
            let scaling = neural::Scaling {
                u_mean: draw(inputs),
                u_scale: (0..inputs).map(|j| 0.5 + j as f64).collect(),
                y_mean: 0.3,
                y_scale: 2.0,
            };
            let theta = draw(shape.parameters());
            let network =
                |limits| NeuralOE::new(shape, theta.clone(), scaling.clone(), limits).unwrap();
            let network_free = network((f64::NEG_INFINITY, f64::INFINITY));
            let (u, state) = (draw(inputs), draw(na + inputs * (nb - 1)));
            let step = |u: &[f64], x: &[f64]| lagged_step(&linear, u, x);
            check_against_differences(&linear.linearise(&u, &state).unwrap(), &u, &state, step);
            let step = |u: &[f64], x: &[f64]| lagged_step(&network_free, u, x);
            let found = network_free.linearise(&u, &state).unwrap();
            check_against_differences(&found, &u, &state, step);
            let clipped = network((-100.0, -99.0)).linearise(&u, &state).unwrap();
            assert!(
                clipped
                    .c
                    .iter()
                    .chain(&clipped.d)
                    .all(|slope| *slope == 0.0)
            );
            assert!(linear.linearise(&u, &state[1..]).is_err());
            assert!(
                network_free
                    .linearise(&[f64::NAN].repeat(inputs), &state)
                    .is_err()
            );
        }
    }

    #[test]
    fn state_space_models_agree_with_differences() {
        let functions = [
            OutputFunction::Linear,
            OutputFunction::Abs { width: 0.3 },
            OutputFunction::Saturation {
                low: -0.6,
                high: 0.7,
                width: 0.2,
            },
        ];
        let mut random = Random::new(2);
        for (i, output) in functions.into_iter().enumerate() {
            let shape = Shape {
                nx: 1 + i,
                nk: i,
                inputs: 1 + i % 2,
                hidden: 3 + 4 * i,
                integrator: false,
            };
            let mut draw = |count: usize| -> Vec<f64> {
                (0..count).map(|_| random.between(-0.6, 0.6)).collect()
            };
            let scaling = Scaling {
                u_mean: draw(shape.inputs),
                u_scale: vec![1.5; shape.inputs],
                y_mean: draw(1)[0],
                y_scale: 2.5,
            };
            let unit =
                (0..shape.nx * shape.nx).map(|i| f64::from(u8::from(i % (shape.nx + 1) == 0)));
            let statistics = Statistics {
                state_mean: vec![0.0; shape.nx],
                state_covariance: unit.collect(),
                residual_variance: 1.0,
                process_noise: 0.0,
            };
            let theta = draw(shape.parameters());
            let model = NeuralSS::new(shape, output, theta, scaling, statistics).unwrap();
            let (u, state) = (draw(shape.inputs), draw(shape.nx));
            let step = |u: &[f64], x: &[f64]| {
                let held = u.repeat(2);
                let states = model.states(&held, shape.inputs, x).unwrap();
                let y = model.simulate(u, shape.inputs, x).unwrap();
                [&states[shape.nx..], &y].concat()
            };
            let found = model.linearise(&u, &state).unwrap();
            check_against_differences(&found, &u, &state, step);
            assert!(model.linearise(&u, &[0.0; 9]).is_err());
        }
    }
}
