//! `Model`: what every identified model can do, whatever its equations.
//!
//! In reading order: [`Model`] is what Python, the closed loop and the deployment use. A lagged model has its step,
//! from which [`Lagged`] makes free run, prediction and state; it adds [`Differentiable`], and the rest of [`Model`]
//! follows. [`NeuralSS`](crate::neural_ss::NeuralSS) has its own states and implements [`Model`] itself.

use crate::closed_loop::{LaggedPlant, Plant};
use crate::embedded::Embedded;
use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::linearised::{self, Linearised};
use crate::neural::NeuralOE;
use crate::{Error, Result};

/// A free run and its derivatives, row by row: with respect to the parameters, then to the initial state.
pub type RunAndRows = (Vec<f64>, Vec<f64>);

/// A model of one plant. Arrays have time first; the state is the model's own (past outputs, newest first, or states).
pub trait Model: Send + Sync {
    /// All parameters, in the order of docs/CONVENTIONS.md, Models.
    fn theta(&self) -> Vec<f64>;

    /// The state of a plant at rest.
    fn rest_state(&self) -> Vec<f64>;

    /// Free run from a state.
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong shapes, `ErrorKind::Fit` for a run that leaves the finite numbers.
    fn simulate(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<Vec<f64>>;

    /// The output `horizon` steps ahead of measured ones.
    ///
    /// # Errors
    /// As [`Model::simulate`]; `ErrorKind::Setting` for a horizon of 0.
    fn predict(
        &self,
        u: &[f64],
        channels: usize,
        y: &[f64],
        state: &[f64],
        horizon: usize,
    ) -> Result<Vec<f64>>;

    /// The state whose free run fits `y` best.
    ///
    /// # Errors
    /// As [`Model::simulate`]; `ErrorKind::Data` without a measured sample.
    fn estimate_state(&self, u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<f64>>;

    /// Free run and its derivatives.
    ///
    /// # Errors
    /// As [`Model::simulate`].
    fn jacobian(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<RunAndRows>;

    /// Small-signal model around a held input and a state (see [`Linearised`]).
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong numbers of inputs or states, or values that are not finite.
    fn linearise(&self, u: &[f64], state: &[f64]) -> Result<Linearised>;

    /// The model at rest as a plant for a loop, at a sample time \[s\].
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a model around which no loop can be closed.
    fn plant(&self, ts: f64) -> Result<Box<dyn ClonePlant + '_>>;

    /// The microcontroller's form; `scaled` keeps more digits in single precision.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a kind that has no such form.
    fn embedded(&self, scaled: bool) -> Result<Embedded>;
}

/// A boxed plant that a search can copy.
pub trait ClonePlant: Plant + Send + Sync {
    /// A copy in the same state.
    fn copied<'a>(&self) -> Box<dyn ClonePlant + 'a>
    where
        Self: 'a;
}

impl<P: Plant + Clone + Send + Sync> ClonePlant for P {
    fn copied<'a>(&self) -> Box<dyn ClonePlant + 'a>
    where
        Self: 'a,
    {
        Box::new(self.clone())
    }
}

/// What a lagged model adds to its step ([`Lagged`]) to be a [`Model`].
pub trait Differentiable: Lagged + Clone + Send + Sync {
    /// The parameters.
    fn theta(&self) -> Vec<f64>;

    /// The derivatives of the output with respect to the whole regressor.
    fn slopes(&self, phi: &[f64]) -> Vec<f64>;

    /// Free run and its derivatives.
    ///
    /// # Errors
    /// As [`Lagged::simulate`].
    fn jacobian(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<RunAndRows>;

    /// The microcontroller's form; a kind without one keeps this refusal.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a kind that has no such form.
    fn embedded(&self, _scaled: bool) -> Result<Embedded> {
        Err(Error::setting(
            "expected a linear model or a network to deploy, got a kind that has no form for microcontrollers; identify \
             with model oe, neural-oe or neural-ss",
        ))
    }
}

impl<M: Differentiable> Model for M {
    fn theta(&self) -> Vec<f64> {
        Differentiable::theta(self)
    }

    fn rest_state(&self) -> Vec<f64> {
        vec![0.0; self.lags().na]
    }

    fn simulate(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<Vec<f64>> {
        Lagged::simulate(self, u, channels, state)
    }

    fn predict(
        &self,
        u: &[f64],
        channels: usize,
        y: &[f64],
        state: &[f64],
        horizon: usize,
    ) -> Result<Vec<f64>> {
        Lagged::predict(self, u, channels, y, state, horizon)
    }

    fn estimate_state(&self, u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<f64>> {
        self.estimate_initial_state(u, channels, y)
    }

    fn jacobian(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<RunAndRows> {
        Differentiable::jacobian(self, u, channels, state)
    }

    fn linearise(&self, u: &[f64], state: &[f64]) -> Result<Linearised> {
        linearised::of_lagged(self, u, state)
    }

    fn plant(&self, ts: f64) -> Result<Box<dyn ClonePlant + '_>> {
        Ok(Box::new(LaggedPlant::new(self, ts)?))
    }

    fn embedded(&self, scaled: bool) -> Result<Embedded> {
        Differentiable::embedded(self, scaled)
    }
}

impl Differentiable for LinearModel {
    fn theta(&self) -> Vec<f64> {
        [self.a(), self.b(), &[self.offset()]].concat()
    }

    fn slopes(&self, _phi: &[f64]) -> Vec<f64> {
        let past = self.a().iter().map(|a| -a);
        past.chain(self.b().iter().copied()).collect()
    }

    fn jacobian(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<RunAndRows> {
        LinearModel::jacobian(self, u, channels, y_past)
    }

    fn embedded(&self, _scaled: bool) -> Result<Embedded> {
        Ok(LinearModel::embedded(self))
    }
}

impl Differentiable for NeuralOE {
    fn theta(&self) -> Vec<f64> {
        NeuralOE::theta(self).to_vec()
    }

    fn slopes(&self, phi: &[f64]) -> Vec<f64> {
        NeuralOE::slopes(self, phi)
    }

    fn jacobian(&self, u: &[f64], channels: usize, y_past: &[f64]) -> Result<RunAndRows> {
        NeuralOE::jacobian(self, u, channels, y_past)
    }

    fn embedded(&self, scaled: bool) -> Result<Embedded> {
        Ok(NeuralOE::embedded(self, scaled))
    }
}
