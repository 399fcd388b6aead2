//! Bindings of known moves: their tables, learning from repetitions, and references within the reach of a drive.

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::AnyDesign;
use sewfast_core::closed_loop::Varied;
use sewfast_core::moves::{self, Member};
use sewfast_core::profile::Reach;
use sewfast_core::{Error, Result};

use super::controller::AnyGiven;
use super::{AnyPlant, Model};
use crate::seam::{Raised, Values, Vector, array1, released, slice, watched};

fn models(plants: &[Bound<'_, PyAny>]) -> PyResult<Vec<Model>> {
    plants.iter().map(Model::of).collect()
}

/// Each model in each variation, with the controller of its loop.
fn members<'a>(
    models: &'a [Model],
    design: &AnyDesign<f64>,
    counted: bool,
    variations: &[(f64, usize)],
) -> Result<Vec<Member<'a>>> {
    let mut made = Vec::with_capacity(models.len() * variations.len());
    for model in models {
        let plant = model.plant(design.ts())?;
        for &(gain, delay) in variations {
            made.push(Member {
                plant: Box::new(Varied::new(plant.clone(), gain, delay)?),
                controller: design.controller()?,
                counted,
            });
        }
    }
    Ok(made)
}

/// Samples by which a controller gets its reference early.
fn preview(design: &AnyDesign<f64>) -> usize {
    design.pid().map_or(0, |pid| pid.feedforward.preview())
}

/// The table of a move for a controller on these plants.
#[pyfunction]
#[pyo3(signature = (plants, controller, reference, *, counted, threads, progress=None))]
pub fn plan_move<'py>(
    py: Python<'py>,
    plants: Vec<Bound<'py, PyAny>>,
    controller: AnyGiven<'py>,
    reference: Values<'py>,
    counted: bool,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (models, design) = (models(&plants)?, controller.design());
    let reference = slice(&reference, "reference")?;
    let found = watched(py, progress, |monitor| {
        let members = members(&models, &design, counted, &[(1.0, 0)])?;
        moves::plan(&members, reference, preview(&design), threads, monitor)
    })?;
    Ok(dict! { py;
        "setpoint" => array1(py, found.setpoint), "y" => array1(py, found.y), "u" => array1(py, found.u),
        "errors" => found.errors, "limited" => found.limited, "interrupted" => found.interrupted,
    })
}

/// Improves the table of a move from the errors of its repetitions.
#[pyclass(module = "sewfast._core")]
pub struct MoveLearner {
    core: moves::Learner,
}

#[pymethods]
impl MoveLearner {
    #[new]
    #[pyo3(signature = (plants, controller, reference, table, *, variations, counted, threads, progress=None))]
    fn new(
        py: Python<'_>,
        plants: Vec<Bound<'_, PyAny>>,
        controller: AnyGiven<'_>,
        reference: Values<'_>,
        table: Values<'_>,
        variations: Vec<(f64, usize)>,
        counted: bool,
        threads: usize,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let (models, design) = (models(&plants)?, controller.design());
        let (reference, table) = (slice(&reference, "reference")?, slice(&table, "table")?);
        let core = watched(py, progress, |monitor| {
            let members = members(&models, &design, counted, &variations)?;
            let ahead = preview(&design);
            moves::Learner::new(&members, reference, table, ahead, threads, monitor)
        })?;
        Ok(Self { core })
    }

    #[getter]
    fn size(&self) -> usize {
        self.core.size()
    }

    #[getter]
    fn period(&self) -> f64 {
        self.core.period
    }

    #[getter]
    fn contraction(&self) -> f64 {
        self.core.contraction
    }

    fn signal<'py>(&self, py: Python<'py>, correction: Values<'py>) -> PyResult<Vector<'py>> {
        let found = self.core.signal(slice(&correction, "correction")?);
        Ok(array1(py, found.raised(py)?))
    }

    /// The next correction, and the error that is left by it.
    fn next<'py>(
        &self,
        py: Python<'py>,
        correction: Values<'py>,
        error: Values<'py>,
        gain: f64,
    ) -> PyResult<(Vector<'py>, Vector<'py>)> {
        let (correction, error) = (slice(&correction, "correction")?, slice(&error, "error")?);
        let (next, left) = released(py, || self.core.next(correction, error, gain))?;
        Ok((array1(py, next), array1(py, left)))
    }
}

// --- References within the reach of a drive ---

/// Least and largest level, levels, rates up and down at each, jerk.
pub(super) type Reached = (f64, f64, Vec<f64>, Vec<f64>, Vec<f64>, f64);

fn told(of: Reach) -> Reached {
    (of.low, of.high, of.levels, of.up, of.down, of.jerk)
}

pub(super) fn reached((low, high, levels, up, down, jerk): Reached) -> Result<Reach> {
    if levels.is_empty() || up.len() != levels.len() || down.len() != levels.len() {
        return Err(Error::setting(format!(
            "expected rates at one or more levels, got {} and {} at {}; take those of a reach",
            up.len(),
            down.len(),
            levels.len()
        )));
    }
    Ok(Reach {
        low,
        high,
        levels,
        up,
        down,
        jerk,
    })
}

/// What all of these plants can do by a share of their rates.
#[pyfunction]
#[pyo3(signature = (plants, *, Ts, u, levels, share))]
pub fn reach(
    py: Python<'_>,
    plants: Vec<Bound<'_, PyAny>>,
    Ts: f64,
    u: (f64, f64),
    levels: (f64, f64),
    share: f64,
) -> PyResult<Reached> {
    let models = models(&plants)?;
    let found = watched(py, None, |_| {
        let each = models.iter().map(|model| {
            let mut plant: AnyPlant<'_> = model.plant(Ts)?;
            Reach::of(&mut plant, Ts, u, levels)
        });
        Reach::common(&each.collect::<Result<Vec<_>>>()?, share)
    })?;
    Ok(told(found))
}

/// The same bounds at every level.
#[pyfunction]
#[pyo3(signature = (*, low, high, rate, jerk))]
pub fn constant_reach(
    py: Python<'_>,
    low: f64,
    high: f64,
    rate: f64,
    jerk: f64,
) -> PyResult<Reached> {
    let made = Reach::constant(low, high, rate, jerk);
    made.map(told).raised(py)
}

/// A reference within a reach and further bounds of levels, rate and jerk, and whether levels, rate and jerk were at their bounds.
#[pyfunction]
#[pyo3(signature = (reference, reach, *, Ts, low, high, rate, jerk))]
pub fn profile<'py>(
    py: Python<'py>,
    reference: Values<'py>,
    reach: Reached,
    Ts: f64,
    low: f64,
    high: f64,
    rate: f64,
    jerk: f64,
) -> PyResult<(Vector<'py>, [bool; 3])> {
    let reference = slice(&reference, "reference")?;
    let found = watched(py, None, |_| {
        let reach = reached(reach)?;
        reach.within(low, high, rate, jerk).profile(reference, Ts)
    })?;
    Ok((array1(py, found.r), found.bounds))
}
