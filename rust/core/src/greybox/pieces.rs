//! A joint's equations at the least squares of the position's free run over pieces of a record.
//!
//! A position drifts in free run: a force that is off by a thousandth moves a joint by metres in the end. So the speed and position at
//! which each piece begins are fitted together with the parameters. The unknowns are theta, then speed and position of piece after piece;
//! the normal equations of a piece only touch theta and its own two.

use nalgebra::{DMatrix, DVector};

use super::GreyBox;
use crate::bounded::{Ends, Normal, Squares, minimised};
use crate::data::Samples;
use crate::gram::Gram;
use crate::model::{Model, RunAndRows};
use crate::sandwich::{self, Scores};
use crate::simd::{self, F64x8, Kernel};
use crate::{Error, Monitor, Result};

/// First measured outputs of a piece, which tell its state.
const FIRST: usize = 30;
/// Least part of a parameter in a direction without information, for it to be undetermined.
const LEAK: f64 = 1e-3;

/// Pieces of a record, to which one model is fitted.
#[derive(Clone, Debug)]
pub struct Pieces<'a>(Vec<Piece<'a>>);

#[derive(Clone, Debug)]
struct Piece<'a> {
    u: &'a [f64],
    /// Sample of the first measured output. The commands before it may still act.
    first: usize,
    /// Outputs from there on.
    y: &'a [f64],
    /// Roots of their weights; 0 where nothing was measured.
    root: Vec<f64>,
}

impl Piece<'_> {
    /// Weighted errors of a run.
    fn errors<'b>(&'b self, run: &'b [f64]) -> impl Iterator<Item = f64> + 'b {
        let pairs = self.root.iter().zip(run.iter().zip(self.y));
        pairs.map(|(root, (run, y))| if *root > 0.0 { root * (run - y) } else { 0.0 })
    }

    fn squares(&self, run: &[f64]) -> f64 {
        self.errors(run).map(|e| e * e).sum()
    }

    /// The state at the beginning, from the first outputs.
    fn first_state(&self, model: &GreyBox) -> Result<Vec<f64>> {
        let measured = self.y.iter().enumerate();
        let mut measured = measured.filter(|(_, y)| !y.is_nan()).map(|(k, _)| k + 1);
        let n = measured.by_ref().take(FIRST).last().unwrap_or(self.y.len());
        model.state_at(self.first, &self.u[..self.first + n], &self.y[..n])
    }

    fn run(&self, model: &GreyBox, state: &[f64]) -> Result<Vec<f64>> {
        model.run_from(self.first, self.u, state)
    }

    fn slopes(&self, model: &GreyBox, state: &[f64]) -> Result<RunAndRows> {
        model.slopes_from(self.first, self.u, state)
    }
}

/// How a model is fitted.
#[derive(Clone, Copy, Debug)]
pub struct Fit<'a> {
    /// Inverse standard deviations of theta about 0, in units of the residuals.
    pub prior: &'a [f64],
    /// Lower and upper bounds of theta.
    pub low: &'a [f64],
    /// Upper bounds.
    pub high: &'a [f64],
    /// Squared distance to the minimum in standard errors that is close enough.
    pub enough: f64,
    /// Most Jacobians.
    pub iterations: usize,
}

/// The least sum of squares.
#[derive(Clone, Debug)]
pub struct Descent {
    /// The model there.
    pub model: GreyBox,
    /// Its weighted squared errors, with the prior's.
    pub cost: f64,
    /// States at which the pieces begin.
    pub states: Vec<Vec<f64>>,
}

impl<'a> Pieces<'a> {
    /// Pieces of one command each.
    ///
    /// # Errors
    /// Data errors for records that cannot be used, and for more than one input.
    pub fn new(pieces: &[Samples<'a>]) -> Result<Self> {
        let piece = |samples: &Samples<'a>| {
            let record = samples.record()?;
            if record.channels != 1 {
                return Err(Error::data(format!(
                    "expected one input, the joint's command, got {}; choose its column",
                    record.channels
                )));
            }
            let root = |(k, y): (usize, &f64)| match record.weights {
                _ if y.is_nan() => 0.0,
                Some(weights) => weights[k].sqrt(),
                None => 1.0,
            };
            let root: Vec<f64> = record.y.iter().enumerate().map(root).collect();
            let first = root.iter().position(|root| *root > 0.0).unwrap_or(0);
            Ok(Piece {
                u: record.u,
                first,
                y: &record.y[first..],
                root: root[first..].to_vec(),
            })
        };
        pieces.iter().map(piece).collect::<Result<_>>().map(Self)
    }

    /// States at which the pieces begin, from their first outputs.
    ///
    /// # Errors
    /// As [`Model::estimate_state`].
    pub fn states(&self, model: &GreyBox) -> Result<Vec<Vec<f64>>> {
        self.0.iter().map(|p| p.first_state(model)).collect()
    }

    /// Weighted squared errors of free runs from these states; infinite if one diverges.
    pub fn squares(&self, model: &GreyBox, states: &[Vec<f64>]) -> f64 {
        let mut total = 0.0;
        for (piece, state) in self.0.iter().zip(states) {
            match piece.run(model, state) {
                Ok(run) => total += piece.squares(&run),
                Err(_) => return f64::INFINITY,
            }
        }
        if total.is_finite() {
            total
        } else {
            f64::INFINITY
        }
    }

    fn measured(&self) -> f64 {
        let roots = self.0.iter().flat_map(|p| &p.root);
        roots.filter(|root| **root > 0.0).count() as f64
    }

    /// The least squares from theta as it is. The model's residual variance becomes that of the weighted errors.
    ///
    /// # Errors
    /// Setting errors for sizes that do not fit; fit errors for a start that diverges, and after a stop request before the first step.
    pub fn descend(&self, model: &GreyBox, fit: &Fit<'_>, monitor: &Monitor) -> Result<Descent> {
        let theta = model.theta();
        let p = theta.len();
        if [fit.prior.len(), fit.low.len(), fit.high.len()] != [p; 3] {
            return Err(Error::setting(format!(
                "expected a prior and bounds of {p} parameters, got {}, {} and {}; give one of each per parameter",
                fit.prior.len(),
                fit.low.len(),
                fit.high.len()
            )));
        }
        let starts = self.states(model)?;
        let places = model.begun();
        let fitted = |state: &Vec<f64>| places.iter().map(|&j| state[j]).collect::<Vec<_>>();
        let begun = starts.iter().flat_map(fitted);
        let x: Vec<f64> = theta.into_iter().chain(begun).collect();
        let bounds = |of: &[f64], none: f64| {
            let mut all = of.to_vec();
            all.resize(x.len(), none);
            all
        };
        let (low, high) = (
            bounds(fit.low, f64::NEG_INFINITY),
            bounds(fit.high, f64::INFINITY),
        );
        let ends = Ends {
            low: &low,
            high: &high,
            count: self.measured(),
            enough: fit.enough,
            iterations: fit.iterations,
        };
        let mut problem = Problem {
            pieces: &self.0,
            model,
            starts,
            prior: fit.prior,
            monitor,
        };
        let found = minimised(&mut problem, x, &ends)?;
        let weights = self.0.iter().flat_map(|p| &p.root).map(|root| root * root);
        let variance = found.cost / weights.sum::<f64>().max(1e-300);
        let mut frame = model.frame().clone();
        frame.residual_variance = variance.max(1e-300);
        Ok(Descent {
            model: GreyBox::new(frame, &found.x[..p])?,
            cost: found.cost,
            states: problem.states(&found.x),
        })
    }

    /// Covariance of theta, row by row (p, p), with the pieces' states estimated beside it, and which parameters the record determines.
    ///
    /// # Errors
    /// As [`Model::jacobian`] and [`sandwich::covariance`].
    pub fn covariance(
        &self,
        model: &GreyBox,
        states: &[Vec<f64>],
    ) -> Result<(Vec<f64>, Vec<bool>)> {
        let (p, order, places) = (model.theta().len(), model.order(), model.begun());
        let n = p + places.len() * self.0.len();
        let (mut jacobian, mut residuals, mut lengths) = (Vec::new(), Vec::new(), Vec::new());
        for (i, (piece, state)) in self.0.iter().zip(states).enumerate() {
            let (run, rows) = piece.slopes(model, state)?;
            for (row, root) in rows.chunks_exact(p + order).zip(&piece.root) {
                let at = jacobian.len();
                jacobian.resize(at + n, 0.0);
                let own = &mut jacobian[at..];
                own[..p].copy_from_slice(&row[..p]);
                for (j, place) in places.iter().enumerate() {
                    own[p + places.len() * i + j] = row[p + place];
                }
                own.iter_mut().for_each(|v| *v *= root);
            }
            residuals.extend(piece.errors(&run));
            lengths.push(run.len());
        }
        let scores = Scores {
            jacobian: &jacobian,
            residuals: &residuals,
            lengths: &lengths,
            channels: 1,
        };
        let whole = sandwich::covariance(&scores, &DMatrix::zeros(0, 0))?;
        let rows = DMatrix::from_row_slice(residuals.len(), n, &jacobian);
        let mut determined = sandwich::determined(&rows.tr_mul(&rows), LEAK);
        determined.truncate(p);
        let own = whole.view((0, 0), (p, p));
        Ok((own.iter().copied().collect(), determined))
    }

    /// Number of samples that are as good as independent, by the residuals' correlation up to its first zero.
    ///
    /// # Errors
    /// As [`Model::simulate`].
    pub fn independent(&self, model: &GreyBox, states: &[Vec<f64>]) -> Result<f64> {
        let (mut total, mut spread) = (0.0, 0.0);
        for (piece, state) in self.0.iter().zip(states) {
            let run = piece.run(model, state)?;
            let errors: Vec<f64> = piece.errors(&run).collect();
            let at = |lag: usize| -> f64 {
                let pairs = errors.iter().zip(&errors[lag..]);
                pairs.map(|(a, b)| a * b).sum()
            };
            let own = at(0);
            let positive = (1..errors.len() / 4).map(at).take_while(|r| *r > 0.0);
            spread += own + 2.0 * positive.sum::<f64>();
            total += own;
        }
        Ok((self.measured() * total / f64::max(spread, 1e-300)).max(3.0))
    }
}

struct Problem<'a> {
    pieces: &'a [Piece<'a>],
    model: &'a GreyBox,
    starts: Vec<Vec<f64>>,
    prior: &'a [f64],
    monitor: &'a Monitor,
}

impl Problem<'_> {
    fn parameters(&self) -> usize {
        self.prior.len()
    }

    /// The model with other parameters; `None` for some that no joint has.
    fn with(&self, x: &[f64]) -> Option<GreyBox> {
        GreyBox::new(self.model.frame().clone(), &x[..self.parameters()]).ok()
    }

    fn states(&self, x: &[f64]) -> Vec<Vec<f64>> {
        let places = self.model.begun();
        let fitted = x[self.parameters()..].chunks_exact(places.len());
        let states = self.starts.iter().zip(fitted);
        let state = |(start, fitted): (&Vec<f64>, &[f64])| {
            let mut state = start.clone();
            for (&j, value) in places.iter().zip(fitted) {
                state[j] = *value;
            }
            state
        };
        states.map(state).collect()
    }

    fn of_prior(&self, x: &[f64]) -> f64 {
        let terms = self.prior.iter().zip(x);
        terms.map(|(known, x)| (known * x).powi(2)).sum()
    }

    fn look(&self) -> Result<()> {
        if self.monitor.stopped() {
            return Err(Error::fit(
                "expected to be left alone, got a request to stop",
            ));
        }
        Ok(())
    }
}

impl Squares for Problem<'_> {
    type Stop = Error;

    fn normal(&mut self, x: &[f64]) -> Result<Normal> {
        let (p, order, places) = (self.parameters(), self.model.order(), self.model.begun());
        let fitted = places.len();
        let infinite = || {
            Error::fit(
                "expected a free run that changes with the parameters by finite amounts, got infinite ones; record more moves in \
                 both directions",
            )
        };
        let model = self.with(x).ok_or_else(infinite)?;
        let (n, mut cost) = (x.len(), self.of_prior(x));
        let (mut gradient, mut matrix) = (DVector::zeros(n), DMatrix::zeros(n, n));
        for (j, known) in self.prior.iter().enumerate() {
            (gradient[j], matrix[(j, j)]) = (known * known * x[j], known * known);
        }
        for (i, (piece, state)) in self.pieces.iter().zip(self.states(x)).enumerate() {
            self.look()?;
            let (run, rows) = piece.slopes(&model, &state).map_err(|_| infinite())?;
            let mut gram = Gram::new(p + fitted + 1, 0);
            simd::run(Sum(piece, &run, &rows, [p, order], places, &mut gram));
            let sums = gram.matrix();
            let at = |j: usize| if j < p { j } else { p + fitted * i + j - p };
            for j in 0..p + fitted {
                gradient[at(j)] += sums[(p + fitted, j)];
                for k in 0..p + fitted {
                    matrix[(at(j), at(k))] += sums[(j.max(k), j.min(k))];
                }
            }
            cost += sums[(p + fitted, p + fitted)];
        }
        if !cost.is_finite() || matrix.iter().any(|v| !v.is_finite()) {
            return Err(infinite());
        }
        Ok(Normal {
            cost,
            gradient,
            matrix,
        })
    }

    fn cost(&mut self, x: &[f64]) -> Result<f64> {
        let Some(model) = self.with(x) else {
            return Ok(f64::INFINITY);
        };
        let mut total = self.of_prior(x);
        for (piece, state) in self.pieces.iter().zip(self.states(x)) {
            self.look()?;
            match piece.run(&model, &state) {
                Ok(run) => total += piece.squares(&run),
                Err(_) => return Ok(f64::INFINITY),
            }
        }
        Ok(if total.is_finite() {
            total
        } else {
            f64::INFINITY
        })
    }
}

/// Sums a piece's rows: by theta, by the states of its start at these places, and the error.
struct Sum<'a>(
    &'a Piece<'a>,
    &'a [f64],
    &'a [f64],
    [usize; 2],
    &'static [usize],
    &'a mut Gram,
);

impl Kernel for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(self) {
        let Self(piece, run, rows, [p, order], places, gram) = self;
        let rows = rows.chunks_exact(p + order).zip(&piece.root);
        for ((row, root), (run, y)) in rows.zip(run.iter().zip(piece.y)) {
            if *root == 0.0 {
                continue;
            }
            gram.add(|sum| {
                for (sum, by) in sum.iter_mut().zip(&row[..p]) {
                    *sum = root * by;
                }
                for (sum, place) in sum[p..].iter_mut().zip(places) {
                    *sum = root * row[p + place];
                }
                sum[p + places.len()] = root * (run - y);
            });
        }
    }
}

#[cfg(test)]
mod tests;
