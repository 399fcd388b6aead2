//! Bindings of the position loop: its compiled controller, its runs on a plant, and the stops of a search.

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::{
    AnyDesign, PidController, PositionDesign, PositionLoop, Rate, Rates, Turning,
};
use sewfast_core::closed_loop::{self as looped, Varied};
use sewfast_core::model::ClonePlant;
use sewfast_core::position::{self, Scripted, Stop, Stops};
use sewfast_core::{Error, Result};

use super::Model;
use super::controller::{AnyGiven, single};
use super::moves::{Reached, reached};
use crate::seam::{Values, Vector, array1, raise, slice, watched, watched_over};

/// Speed, rates away from rest and towards it.
type Row = (f64, f64, f64);

fn rates_of(rows: &[Row]) -> Result<Rates<f64>> {
    let row = |&(speed, up, down): &Row| Rate { speed, up, down };
    Ok(Rates::new(&rows.iter().map(row).collect::<Vec<_>>())?)
}

/// Samples before it, angle and turn \[counts\], whether it goes onward.
type StopGiven = (usize, f64, f64, bool);

fn stop_of(given: Option<StopGiven>) -> Option<Stop> {
    given.map(|(after, angle, turn, onward)| Stop {
        after,
        angle,
        turn,
        onward,
    })
}

/// A position loop over a PID with what it is to do: goals \[counts\], or a speed \[y\] and a stop.
#[pyclass(module = "sewfast._core")]
pub struct PositionController {
    core: Scripted,
    per_sample: f64,
}

#[pymethods]
impl PositionController {
    #[new]
    #[pyo3(signature = (speed, *, gain, counts_per_unit, fastest, rates, smoothing, landing, creep, releases, stop=None))]
    #[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
    fn new(
        py: Python<'_>,
        speed: AnyGiven<'_>,
        gain: f64,
        counts_per_unit: f64,
        fastest: f64,
        rates: Vec<Row>,
        smoothing: usize,
        landing: f64,
        creep: f64,
        releases: bool,
        stop: Option<StopGiven>,
    ) -> PyResult<Self> {
        let speed = speed.design();
        let made = || {
            let design = PositionDesign {
                gain,
                counts_per_unit,
                speed: fastest,
                rates: rates_of(&rates)?,
                smoothing,
                landing,
                creep,
                releases,
            };
            Scripted::new(design, &speed, stop_of(stop))
        };
        Ok(Self {
            core: made().map_err(|e: Error| raise(py, e))?,
            per_sample: counts_per_unit * speed.ts(),
        })
    }

    /// The command, from a reference that is early and the speed that the counts show. The counts of the sample are computed back from
    /// it: whole ones, so that it does not matter how the speed was rounded.
    fn step(&mut self, py: Python<'_>, r: f64, y: f64) -> PyResult<f64> {
        let moved = y * self.per_sample;
        let whole = moved.round();
        let rounded = (moved - whole).abs() <= 1e-9 * (1.0 + whole.abs());
        let done = self.core.step(r, if rounded { whole } else { moved });
        done.map_err(|e| raise(py, e))
    }

    fn reset(&mut self) {
        self.core.reset();
    }

    #[getter]
    fn filtered(&self) -> f64 {
        self.core.law().filtered()
    }

    /// Where the profile is at this sample \[counts\].
    #[getter]
    fn place(&self) -> f64 {
        self.core.law().place()
    }

    #[getter]
    fn goal(&self) -> f64 {
        self.core.law().goal()
    }

    /// References as the steps take them, early by the preview.
    fn early<'py>(
        &self,
        py: Python<'py>,
        reference: Values<'py>,
    ) -> PyResult<Bound<'py, numpy::PyArray1<f64>>> {
        let early = position::early(&self.core, slice(&reference, "reference")?);
        Ok(array1(py, early))
    }

    /// What a device computes in single precision from early references and the counts that it had: commands, and places and goals, NaN
    /// while it is a speed loop. Where counts are missing it ends.
    fn single<'py>(
        &self,
        py: Python<'py>,
        early: Values<'py>,
        counts: Values<'py>,
    ) -> PyResult<[Vector<'py>; 3]> {
        let (early, counts) = (slice(&early, "early")?, slice(&counts, "counts")?);
        let made = self.on_device().map_err(|e| raise(py, e))?;
        let found = replayed(made, self.core.stop(), early, counts);
        let found = found.map_err(|e| raise(py, e))?;
        Ok(found.map(|column| array1(py, column)))
    }
}

impl PositionController {
    /// The loop of a device at rest.
    fn on_device(&self) -> Result<Turning> {
        let (law, design) = (self.core.law(), self.core.law().design());
        let row = |r: &Rate<f64>| Rate {
            speed: r.speed as f32,
            up: r.up as f32,
            down: r.down as f32,
        };
        let rows: Vec<_> = design.rates.rows().iter().map(row).collect();
        let design = PositionDesign {
            gain: design.gain as f32,
            counts_per_unit: design.counts_per_unit as f32,
            speed: design.speed as f32,
            rates: Rates::new(&rows)?,
            smoothing: design.smoothing,
            landing: design.landing as f32,
            creep: design.creep as f32,
            releases: design.releases,
        };
        let speed = PidController::new(single(law.speed().design())?)?;
        Ok(Turning::new(PositionLoop::new(design, speed)?))
    }
}

/// Commands, places and goals of a device's loop.
fn replayed(
    mut law: Turning,
    stop: Option<Stop>,
    early: &[f64],
    counts: &[f64],
) -> Result<[Vec<f64>; 3]> {
    if stop.is_none() {
        law.follow();
    }
    let mut found = [(); 3].map(|()| vec![f64::NAN; counts.len()]);
    let mut before = counts.first().copied().unwrap_or(0.0);
    for (k, (&r, &now)) in early.iter().zip(counts).enumerate() {
        if let Some(stop) = stop
            && stop.after == k
        {
            law.stop(stop.angle as f32, stop.turn as f32, stop.onward)?;
        }
        let moved = now - before;
        if !moved.is_finite() {
            break;
        }
        before = now;
        let u = law.step(r as f32, moved as i32);
        let shown = |counts: f32| match law.goal() {
            Some(_) => law.origin() as f64 + f64::from(counts),
            None => f64::NAN,
        };
        let values = [u.into(), shown(law.law().place()), shown(law.law().goal())];
        for (column, value) in found.iter_mut().zip(values) {
            column[k] = value;
        }
    }
    Ok(found)
}

/// A run of a position loop on a model or a virtual machine.
#[pyfunction]
#[pyo3(signature = (plant, controller, reference, *, counts_per_unit, encoder_phase=0.5, disturbance=None))]
pub fn position_run<'py>(
    py: Python<'py>,
    plant: &Bound<'py, PyAny>,
    controller: &PositionController,
    reference: Values<'py>,
    counts_per_unit: f64,
    encoder_phase: f64,
    disturbance: Option<Values<'py>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (model, mut scripted) = (Model::of(plant)?, controller.core.clone());
    let reference = slice(&reference, "reference")?;
    let given = disturbance.as_ref().map(|d| slice(d, "disturbance"));
    let disturbance = given.transpose()?;
    let run = watched_over(py, reference.len(), |monitor| {
        let encoder = looped::encoder(counts_per_unit, encoder_phase)?;
        let mut plant = model.plant(scripted.law().speed().settings().ts)?;
        let encoder = encoder.as_ref();
        position::run(
            &mut plant,
            &mut scripted,
            reference,
            encoder,
            disturbance,
            monitor,
        )
    })?;
    let dict = PyDict::new(py);
    for (name, values) in [
        ("u", run.u),
        ("y", run.y),
        ("feedback", run.feedback),
        ("counts", run.counts),
        ("position", run.position),
        ("place", run.place),
        ("goal", run.goal),
    ] {
        dict.set_item(name, array1(py, values))?;
    }
    Ok(dict)
}

/// Rows of rates from rest on, and the largest speed that a reach knows.
#[pyfunction]
pub fn position_rates(py: Python<'_>, reach: Reached) -> PyResult<(Vec<Row>, f64)> {
    let found = reached(reach).and_then(|reach| position::rates(&reach));
    let (rates, top) = found.map_err(|e| raise(py, e))?;
    let rows = rates.rows().iter().map(|r| (r.speed, r.up, r.down));
    Ok((rows.collect(), top))
}

/// A reference that comes up to a speed at the rates and holds it for so many samples.
#[pyfunction]
#[pyo3(signature = (rates, speed, *, hold, Ts))]
#[expect(non_snake_case, reason = "the field's name for the sample time")]
pub fn approach<'py>(
    py: Python<'py>,
    rates: Vec<Row>,
    speed: f64,
    hold: usize,
    Ts: f64,
) -> PyResult<Bound<'py, numpy::PyArray1<f64>>> {
    let rates = rates_of(&rates).map_err(|e| raise(py, e))?;
    Ok(array1(py, position::approach(&rates, speed, hold, Ts)))
}

/// Gain, rates, smoothing, landing \[counts\] and creep of a design.
type DesignGiven = (f64, Vec<Row>, usize, f64, f64);

/// Error, passing, rest and swing of the stops of each design, and how far it yields to a load \[counts\].
#[pyfunction]
#[pyo3(signature = (plants, speed, designs, *, counts_per_unit, fastest, turn, speeds, before, after, load, variations, encoder_phase=0.5, progress=None))]
#[expect(clippy::too_many_arguments, reason = "Python's keywords, one by one")]
pub fn judge_stops(
    py: Python<'_>,
    plants: Vec<Bound<'_, PyAny>>,
    speed: AnyGiven<'_>,
    designs: Vec<DesignGiven>,
    counts_per_unit: f64,
    fastest: f64,
    turn: f64,
    speeds: Vec<f64>,
    before: usize,
    after: usize,
    load: f64,
    variations: Vec<(f64, usize)>,
    encoder_phase: f64,
    progress: Option<&Bound<'_, PyAny>>,
) -> PyResult<Vec<[f64; 5]>> {
    let models = plants.iter().map(Model::of).collect::<PyResult<Vec<_>>>()?;
    let speed: AnyDesign<f64> = speed.design();
    let found = watched(py, progress, |monitor| {
        let encoder = looped::encoder(counts_per_unit, encoder_phase)?;
        let mut made: Vec<Box<dyn ClonePlant + '_>> = Vec::new();
        for model in &models {
            let plant = model.plant(speed.ts())?;
            for &(gain, delay) in &variations {
                made.push(Box::new(Varied::new(plant.clone(), gain, delay)?));
            }
        }
        let design = |(gain, rates, smoothing, landing, creep): &DesignGiven| -> Result<_> {
            Ok(PositionDesign {
                gain: *gain,
                counts_per_unit,
                speed: fastest,
                rates: rates_of(rates)?,
                smoothing: *smoothing,
                landing: *landing,
                creep: *creep,
                releases: false,
            })
        };
        let designs = designs.iter().map(design).collect::<Result<Vec<_>>>()?;
        let stops = Stops {
            speeds,
            turn,
            before,
            after,
            load,
        };
        position::judge(&made, &designs, &speed, &stops, encoder.as_ref(), monitor)
    })?;
    Ok(found
        .iter()
        .map(|one| [one.error, one.past, one.off, one.swing, one.yields])
        .collect())
}
