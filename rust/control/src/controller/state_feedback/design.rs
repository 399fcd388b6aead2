//! Optimal gains: the linear-quadratic regulator and the Kalman filter of a sampled plant.
//!
//! The regulator minimises the sum of `y^2 + rho u^2 + (integral Ts z)^2`, where `z` is the sum of errors. The filter
//! is for a plant whose command is disturbed by white noise of variance 1 and whose output is measured with noise of
//! variance `noise`. Both are the stabilising solution `X` of a Riccati equation
//!
//! ```text
//! X = A' X A - A' X B (R + B' X B)^-1 B' X A + Q
//! ```
//!
//! found by doubling (Chu, Fan, Lin and Wang, Int. J. Control 77, 2004): each step squares the closed loop's transition
//! matrix, so a pole at 1 - 1e-6 takes some 24 steps. In double precision, for a host: firmware that does not call this
//! code does not contain it.

use super::{STATES, StateDesign};
use crate::{Real, Refused};

/// States of the plant, plus the sum of errors.
const N: usize = STATES + 1;
type Square = [[f64; N]; N];

/// Doublings after which there is no solution.
const DOUBLINGS: usize = 60;
/// Relative change of the solution that counts as none.
const CONVERGED: f64 = 1e-13;

/// The design parameters of the gains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights<T> {
    /// Weight of the command's square relative to that of the output's error \[(y/u)^2\].
    pub rho: T,
    /// Weight of the error's integral \[1/s\]; 0 for no integral action.
    pub integral: T,
    /// Variance of the measurement noise relative to that of a disturbance of the command \[(y/u)^2\].
    pub noise: T,
    /// Set-point weight: 1 brings the model to the reference without help from the integral; less leaves it a share.
    pub reference: T,
}

impl<T: Real> Weights<T> {
    /// For gains that came without weights.
    pub(super) const NONE: Self = Self {
        rho: T::ZERO,
        integral: T::ZERO,
        noise: T::ZERO,
        reference: T::ONE,
    };
}

/// `design` with the gains that follow from `weights` for its plant `a`, `b`.
///
/// # Errors
/// A weight that is outside its range, a plant whose output no command can hold, or a plant without such gains.
pub fn lqg(
    mut design: StateDesign<f64>,
    weights: Weights<f64>,
) -> Result<StateDesign<f64>, Refused> {
    let unless = Refused::unless;
    let positive = |x: f64| x > 0.0 && x.is_finite();
    let above_0 = "a finite number above 0";
    unless(positive(weights.rho), "rho", above_0, weights.rho)?;
    unless(positive(weights.noise), "noise", above_0, weights.noise)?;
    let holds = weights.integral >= 0.0 && weights.integral.is_finite();
    unless(
        holds,
        "integral",
        "a finite number of 0 or more",
        weights.integral,
    )?;
    let finite = "a finite number";
    unless(
        weights.reference.is_finite(),
        "weight",
        finite,
        weights.reference,
    )?;
    let StateDesign { a, b, ts, .. } = design;
    let gain: f64 = b.iter().sum();
    let expected = "a plant whose output a constant command moves";
    unless(gain != 0.0 && gain.is_finite(), "num", expected, gain)?;

    let plant = transition(a);
    let (mut augmented, mut cost) = (plant, [[0.0; N]; N]);
    cost[0][0] = 1.0;
    if weights.integral > 0.0 {
        augmented[STATES][0] = -1.0;
        augmented[STATES][STATES] = 1.0;
        cost[STATES][STATES] = (weights.integral * ts) * (weights.integral * ts);
    }
    let input = vector(b);
    let none = Refused {
        name: "model",
        expected: "a plant that a regulator and an observer can be found for",
        received: f64::NAN,
    };
    let x = riccati(augmented, input, weights.rho, cost).ok_or(none)?;
    let xb = times(&x, input);
    let divisor = weights.rho + dot(input, xb);
    let all = times(&transposed(&augmented), xb).map(|gain| gain / divisor);
    for (place, gain) in design.k.iter_mut().zip(all) {
        *place = gain;
    }
    design.ki = -all[STATES];

    let mut output = [0.0; N];
    output[0] = 1.0;
    let disturbed = outer(input, input);
    let p = riccati(transposed(&plant), output, weights.noise, disturbed).ok_or(none)?;
    let seen = times(&p, output);
    for (place, gain) in design.l.iter_mut().zip(seen) {
        *place = gain / (seen[0] + weights.noise);
    }

    // at rest x1 = 1, and each row of the plant gives the next state
    let command = (1.0 + a.iter().sum::<f64>()) / gain;
    let mut state = 1.0;
    for ((place, a), b) in design.rest.iter_mut().zip(a).zip(b) {
        *place = state;
        state += a - b * command;
    }
    let held: f64 = design.k.iter().zip(design.rest).map(|(k, x)| k * x).sum();
    design.kr = weights.reference * (command + held);
    design.weights = weights;
    design.check()?;
    Ok(design)
}

/// The transition matrix of a plant in observer form.
fn transition(a: [f64; STATES]) -> Square {
    let mut matrix = [[0.0; N]; N];
    for (i, (row, a)) in matrix.iter_mut().zip(a).enumerate() {
        row[0] = -a;
        if i + 1 < STATES {
            row[i + 1] = 1.0;
        }
    }
    matrix
}

/// The stabilising solution for one input `b` of weight `r`; `None` if there is none.
fn riccati(mut a: Square, b: [f64; N], r: f64, q: Square) -> Option<Square> {
    let mut g = outer(b, b.map(|b| b / r));
    let mut h = q;
    for _ in 0..DOUBLINGS {
        // (1 + G H)^-1 of A and of G A'
        let mut weighed = product(&g, &h);
        for (i, row) in weighed.iter_mut().enumerate() {
            row[i] += 1.0;
        }
        let forward = solved(weighed, a)?;
        let gain = solved(weighed, product(&g, &transposed(&a)))?;
        let added = product(&transposed(&a), &product(&h, &forward));
        g = sum(&g, &product(&a, &gain));
        h = sum(&h, &added);
        a = product(&a, &forward);
        let (size, change) = (largest(&h), largest(&added));
        if !size.is_finite() {
            return None;
        }
        if change <= CONVERGED * size {
            return Some(h);
        }
    }
    None
}

/// `matrix^-1 right` by elimination with pivoting; `None` for a singular matrix.
fn solved(mut matrix: Square, mut right: Square) -> Option<Square> {
    for i in 0..N {
        let larger = |&j: &usize, &k: &usize| matrix[j][i].abs().total_cmp(&matrix[k][i].abs());
        let pivot = (i..N).max_by(larger)?;
        matrix.swap(i, pivot);
        right.swap(i, pivot);
        let lead = matrix[i][i];
        if !(lead.abs() > 0.0 && lead.is_finite()) {
            return None;
        }
        for j in 0..N {
            if j == i {
                continue;
            }
            let share = matrix[j][i] / lead;
            for k in 0..N {
                matrix[j][k] -= share * matrix[i][k];
                right[j][k] -= share * right[i][k];
            }
        }
    }
    for (i, row) in right.iter_mut().enumerate() {
        for x in row.iter_mut() {
            *x /= matrix[i][i];
        }
    }
    Some(right)
}

fn vector(b: [f64; STATES]) -> [f64; N] {
    let mut all = [0.0; N];
    for (place, b) in all.iter_mut().zip(b) {
        *place = b;
    }
    all
}

fn dot(a: [f64; N], b: [f64; N]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn times(matrix: &Square, x: [f64; N]) -> [f64; N] {
    matrix.map(|row| dot(row, x))
}

fn outer(a: [f64; N], b: [f64; N]) -> Square {
    a.map(|a| b.map(|b| a * b))
}

fn transposed(matrix: &Square) -> Square {
    core::array::from_fn(|i| core::array::from_fn(|j| matrix[j][i]))
}

fn product(a: &Square, b: &Square) -> Square {
    let columns = transposed(b);
    a.map(|row| columns.map(|column| dot(row, column)))
}

fn sum(a: &Square, b: &Square) -> Square {
    core::array::from_fn(|i| core::array::from_fn(|j| a[i][j] + b[i][j]))
}

fn largest(matrix: &Square) -> f64 {
    let all = matrix.as_flattened().iter();
    all.fold(0.0, |most, x| {
        if x.abs() > most || x.is_nan() {
            x.abs()
        } else {
            most
        }
    })
}
