//! Whatever Python calls a plant: a linear model, a network, a state-space model, a virtual machine.

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use sewfast_core::closed_loop::{KernelPlant, LaggedPlant, Plant, StatePlant};
use sewfast_core::encoder::Encoder;
use sewfast_core::machine::{self, SAMPLE_TIME};
use sewfast_core::{Error, Result, linear, neural, neural_ss};

use crate::machine::Machine;
use crate::models::linear::LinearModel;
use crate::models::neural::NeuralOE;
use crate::models::neural_ss::NeuralSS;

/// A copy of the Python object's value, which work on other threads may use.
pub enum Model {
    Linear(linear::LinearModel),
    Neural(neural::NeuralOE),
    States(neural_ss::NeuralSS),
    Machine(Box<machine::Machine>),
}

impl Model {
    pub fn of(object: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(model) = object.cast::<LinearModel>() {
            return Ok(Self::Linear(model.get().inner.clone()));
        }
        if let Ok(model) = object.cast::<NeuralOE>() {
            return Ok(Self::Neural(model.get().inner.clone()));
        }
        if let Ok(model) = object.cast::<NeuralSS>() {
            return Ok(Self::States(model.get().inner.clone()));
        }
        if let Ok(machine) = object.cast::<Machine>() {
            return Ok(Self::Machine(Box::new(machine.try_borrow()?.core.clone())));
        }
        Err(PyTypeError::new_err(format!(
            "expected a LinearModel, a NeuralOE, a NeuralSS or a Machine, got {}",
            object.get_type().name()?
        )))
    }

    /// This model as a plant at sample time `ts`.
    pub fn plant(&self, ts: f64) -> Result<AnyPlant<'_>> {
        match self {
            Self::Linear(model) => Ok(AnyPlant::Linear(LaggedPlant::new(model, ts)?)),
            Self::Neural(model) => Ok(AnyPlant::Neural(LaggedPlant::new(model, ts)?)),
            Self::States(model) => Ok(AnyPlant::States(Box::new(StatePlant::new(model, ts)?))),
            Self::Machine(_) if (ts / SAMPLE_TIME - 1.0).abs() > 1e-9 => {
                Err(Error::setting(format!(
                    "expected a controller with the machine's sample time of {SAMPLE_TIME} s, got {ts} s; convert its gains"
                )))
            }
            Self::Machine(machine) => Ok(AnyPlant::Machine(machine.clone())),
        }
    }
}

/// One of the plants.
#[derive(Clone)]
pub enum AnyPlant<'a> {
    Linear(LaggedPlant<'a, linear::LinearModel>),
    Neural(LaggedPlant<'a, neural::NeuralOE>),
    States(Box<StatePlant>),
    Machine(Box<machine::Machine>),
}

macro_rules! each {
    ($plant:expr, $inner:ident => $call:expr) => {
        match $plant {
            AnyPlant::Linear($inner) => $call,
            AnyPlant::Neural($inner) => $call,
            AnyPlant::States($inner) => $call,
            AnyPlant::Machine($inner) => $call,
        }
    };
}

impl Plant for AnyPlant<'_> {
    fn reset(&mut self) {
        each!(self, plant => plant.reset());
    }

    fn output(&self) -> f64 {
        each!(self, plant => plant.output())
    }

    fn position(&self) -> f64 {
        each!(self, plant => plant.position())
    }

    fn advance(&mut self, u: f64) {
        each!(self, plant => plant.advance(u));
    }

    fn encoder(&self) -> Option<&Encoder> {
        match self {
            AnyPlant::Linear(plant) => plant.encoder(),
            AnyPlant::Neural(plant) => plant.encoder(),
            AnyPlant::States(plant) => plant.encoder(),
            AnyPlant::Machine(plant) => Plant::encoder(plant.as_ref()),
        }
    }

    fn known(&self) -> Option<KernelPlant<'_>> {
        each!(self, plant => plant.known())
    }
}
