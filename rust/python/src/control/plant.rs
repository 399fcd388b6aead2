//! Whatever Python calls a plant: a model of any kind, or a virtual machine.

use std::sync::Arc;

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use sewfast_core::closed_loop::{KernelPlant, Plant};
use sewfast_core::encoder::Encoder;
use sewfast_core::machine::{self, SAMPLE_TIME};
use sewfast_core::model::{self, ClonePlant};
use sewfast_core::{Error, Result};

use crate::machine::Machine;
use crate::models;

/// The Python object's value, which work on other threads may use.
pub enum Model {
    Identified(Arc<dyn model::Model>),
    Machine(Box<machine::Machine>),
}

impl Model {
    pub fn of(object: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(model) = object.cast::<models::Model>() {
            return Ok(Self::Identified(model.get().inner.clone()));
        }
        if let Ok(machine) = object.cast::<Machine>() {
            return Ok(Self::Machine(Box::new(machine.try_borrow()?.core.clone())));
        }
        Err(PyTypeError::new_err(format!(
            "expected a compiled model or a Machine, got {}",
            object.get_type().name()?
        )))
    }

    /// This model as a plant at sample time `ts`.
    pub fn plant(&self, ts: f64) -> Result<AnyPlant<'_>> {
        match self {
            Self::Identified(model) => Ok(AnyPlant(model.plant(ts)?)),
            Self::Machine(_) if (ts / SAMPLE_TIME - 1.0).abs() > 1e-9 => {
                Err(Error::setting(format!(
                    "expected a controller with the machine's sample time of {SAMPLE_TIME} s, got {ts} s; convert its gains"
                )))
            }
            Self::Machine(machine) => Ok(AnyPlant(machine.copied())),
        }
    }
}

/// One of the plants.
pub struct AnyPlant<'a>(Box<dyn ClonePlant + 'a>);

impl Clone for AnyPlant<'_> {
    fn clone(&self) -> Self {
        Self(self.0.copied())
    }
}

impl Plant for AnyPlant<'_> {
    fn reset(&mut self) {
        self.0.reset();
    }

    fn output(&self) -> f64 {
        self.0.output()
    }

    fn position(&self) -> f64 {
        self.0.position()
    }

    fn advance(&mut self, u: f64) {
        self.0.advance(u);
    }

    fn encoder(&self) -> Option<&Encoder> {
        self.0.encoder()
    }

    fn known(&self) -> Option<KernelPlant<'_>> {
        self.0.known()
    }
}
