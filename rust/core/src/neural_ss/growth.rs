//! A model with more states and hidden units that runs as before: where the training of a larger one may begin.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::NeuralSS;
use super::shape::Shape;
use super::state::Statistics;
use crate::random::Random;
use crate::{Error, Result};

/// Poles of new states: fast and slow ones.
const POLES: (f64, f64) = (0.5, 0.98);
/// Weights by which old states and inputs drive a new one, beside the `sqrt(1 - a^2)` of its pole `a`.
const DRIVE: f64 = 0.5;
/// Weights by which what is new acts on what was there.
const REACH: f64 = 1e-3;

/// Where the rows and the columns of a matrix come to stand.
type Places<'a> = (&'a dyn Fn(usize) -> usize, &'a dyn Fn(usize) -> usize);

impl NeuralSS {
    /// This model with `nx` states and `hidden` units: those it has, with all their weights, and new ones.
    ///
    /// New states follow the old ones and the inputs with poles from .5 to .98, new hidden units see everything; weights
    /// of about 1e-3 lead from there to the rest, so that the free run hardly changes and a training has a slope to
    /// begin with. An integrated state stays the last one, all others keep their places; a state of this model
    /// corresponds to the one with the new states' means beside it.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for sizes below those it has, or out of range.
    pub fn grown(&self, nx: usize, hidden: usize, seed: u64) -> Result<Self> {
        let old = self.shape();
        if nx < old.nx || hidden < old.hidden {
            return Err(Error::setting(format!(
                "expected at least the {} states and {} hidden units that the model has, got nx {nx} and hidden {hidden}; train a smaller model anew",
                old.nx, old.hidden
            )));
        }
        let new = Shape { nx, hidden, ..old }.checked()?;
        let mut random = Random::new(seed);
        let (from, to) = (old.parts(), new.parts());
        let fresh = old.nx - usize::from(old.integrator)..nx - usize::from(old.integrator);
        let place = |i: usize| if i < fresh.start { i } else { i + fresh.len() };
        // all is drawn, and what is kept is written over it
        let mut theta = vec![0.0; new.parameters()];
        let width = 1.0 / (new.arguments() as f64).sqrt();
        for (part, scale) in [
            (&to.e, REACH),
            (&to.g, REACH),
            (&to.wx, width),
            (&to.wu, width),
        ] {
            theta[part.clone()].fill_with(|| scale * random.normal());
        }
        theta[to.bh.clone()].fill_with(|| random.between(-1.0, 1.0));
        self.tame(&mut theta[to.e.clone()], hidden, place);
        for i in 0..old.hidden {
            theta[to.wx.start + i * nx..][fresh.clone()].fill(0.0);
        }
        let same = |i: usize| i;
        let mut keep =
            |from: Range<usize>, to: Range<usize>, columns: (usize, usize), places: Places| {
                for (k, value) in self.theta[from].iter().enumerate() {
                    let (row, column) = (places.0(k / columns.0), places.1(k % columns.0));
                    theta[to.start + row * columns.1 + column] = *value;
                }
            };
        keep(from.a, to.a.clone(), (old.nx, nx), (&place, &place));
        keep(
            from.b,
            to.b.clone(),
            (old.inputs, old.inputs),
            (&place, &same),
        );
        keep(from.e, to.e, (old.hidden, hidden), (&place, &same));
        keep(from.wx, to.wx, (old.nx, nx), (&same, &place));
        keep(from.wu, to.wu, (old.inputs, old.inputs), (&same, &same));
        keep(from.bh, to.bh, (1, 1), (&same, &same));
        keep(from.c, to.c.clone(), (old.nx, nx), (&same, &place));
        keep(from.d, to.d, (old.inputs, old.inputs), (&same, &same));
        keep(from.constant, to.constant, (1, 1), (&same, &same));
        keep(from.g, to.g, (old.hidden, hidden), (&same, &same));
        let mut statistics = self.grown_statistics(nx, place);
        for state in fresh.clone() {
            let pole = random.between(POLES.0, POLES.1);
            let drive = DRIVE * (1.0 - pole * pole).sqrt();
            let row = &mut theta[to.a.start + state * nx..][..nx];
            row[..fresh.start].fill_with(|| drive * random.normal());
            let means = row.iter().zip(&statistics.state_mean);
            let mean = means
                .take(fresh.start)
                .map(|(a, mean)| a * mean)
                .sum::<f64>();
            let variances = statistics.state_covariance.iter().step_by(nx + 1);
            let states = row.iter().zip(variances).take(fresh.start);
            let of_states = states.map(|(a, variance)| a * a * variance).sum::<f64>();
            row[state] = pole;
            let row = &mut theta[to.b.start + state * new.inputs..][..new.inputs];
            row.fill_with(|| drive * random.normal());
            let of_inputs = row.iter().map(|b| b * b).sum::<f64>();
            statistics.state_mean[state] = mean / (1.0 - pole);
            // what changes slowly brings it to this size, at which it is to move the output no further than at 1
            let size = (of_states + of_inputs).sqrt() / (1.0 - pole);
            for p in 0..new.outputs {
                theta[to.c.start + p * nx + state] = REACH * random.normal() / size.max(1.0);
            }
        }
        new.hold(&mut theta);
        Self::new(new, self.output(), theta, self.scaling.clone(), statistics)
    }

    /// Multiplies the weights `e` of all units on the old states by `1 - dx+/dx` at the mean state: a slow state sums up
    /// what moves it, and comes to rest that much further away.
    fn tame(&self, e: &mut [f64], hidden: usize, place: impl Fn(usize) -> usize) {
        let nx = self.shape().nx;
        let (parts, mean) = (self.shape().parts(), &self.statistics.state_mean);
        let wx = DMatrix::from_row_slice(self.shape().hidden, nx, &self.theta[parts.wx]);
        let (a, own) = (&self.theta[parts.a], &self.theta[parts.e]);
        let argument = &wx * DVector::from_column_slice(mean)
            + DVector::from_column_slice(&self.theta[parts.bh]);
        let slopes = argument.map(|z| 1.0 - z.tanh() * z.tanh());
        let passed = DMatrix::from_row_slice(nx, self.shape().hidden, own)
            * DMatrix::from_diagonal(&slopes)
            * wx;
        let left = DMatrix::identity(nx, nx) - DMatrix::from_row_slice(nx, nx, a) - passed;
        let drawn = DMatrix::from_fn(nx, hidden, |i, unit| e[place(i) * hidden + unit]);
        let tamed = left * drawn;
        for i in 0..nx {
            (0..hidden).for_each(|unit| e[place(i) * hidden + unit] = tamed[(i, unit)]);
        }
    }

    /// Mean and covariance with room for new states, of zero mean and unit variance.
    fn grown_statistics(&self, nx: usize, place: impl Fn(usize) -> usize) -> Statistics {
        let (kept, own) = (self.shape().nx, &self.statistics);
        let mut state_mean = vec![0.0; nx];
        let unit = (0..nx * nx).map(|i| f64::from(u8::from(i % (nx + 1) == 0)));
        let mut state_covariance: Vec<f64> = unit.collect();
        for i in 0..kept {
            state_mean[place(i)] = own.state_mean[i];
            for j in 0..kept {
                state_covariance[place(i) * nx + place(j)] = own.state_covariance[i * kept + j];
            }
        }
        Statistics {
            state_mean,
            state_covariance,
            ..own.clone()
        }
    }
}
