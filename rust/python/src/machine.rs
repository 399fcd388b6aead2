//! Bindings of the core's machine.

use std::collections::BTreeMap;

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use sewfast_core::machine::{Machine as Core, Parameters};
use sewfast_core::{Error, Monitor, Result};

use crate::arrays::{array1, raise, slice};
use crate::watch::watched_over;

/// Samples between two looks at a stop request, a few milliseconds of work.
const CHUNK: usize = 4096;

/// The virtual sewing machine; see docs/CONVENTIONS.md for its parameters.
#[pyclass(module = "sewfast._core")]
pub struct Machine {
    pub core: Core,
}

fn named<'py, T: IntoPyObject<'py>>(
    py: Python<'py>,
    values: impl IntoIterator<Item = T>,
) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (entry, value) in Parameters::TABLE.iter().zip(values) {
        dict.set_item(entry.name, value)?;
    }
    Ok(dict)
}

fn run(machine: &mut Core, u: &[f64], monitor: &Monitor) -> Result<(Vec<f64>, Vec<f64>)> {
    let (mut counts, mut speed) = (Vec::with_capacity(u.len()), Vec::with_capacity(u.len()));
    for chunk in u.chunks(CHUNK) {
        if monitor.stopped() {
            return Err(Error::fit("the run was interrupted"));
        }
        let (c, s) = machine.run(chunk)?;
        counts.extend(c);
        speed.extend(s);
    }
    Ok((counts, speed))
}

type Pair<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>);

#[pymethods]
impl Machine {
    #[new]
    #[pyo3(signature = (parameters=None))]
    fn new(py: Python<'_>, parameters: Option<BTreeMap<String, f64>>) -> PyResult<Self> {
        let changes = parameters.unwrap_or_default();
        let changes = changes.iter().map(|(name, value)| (name.as_str(), *value));
        let core = Parameters::default().with(changes).and_then(Core::new);
        core.map(|core| Self { core }).map_err(|e| raise(py, e))
    }

    #[staticmethod]
    fn default_parameters(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        named(py, Parameters::default().values())
    }

    #[staticmethod]
    fn variant_parameters(py: Python<'_>, seed: u64) -> PyResult<Bound<'_, PyDict>> {
        named(py, Parameters::variant(seed).values())
    }

    #[staticmethod]
    fn parameter_units(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        named(py, Parameters::TABLE.iter().map(|entry| entry.unit))
    }

    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        named(py, self.core.parameters().values())
    }

    fn reset(&mut self) {
        self.core.reset();
    }

    fn set_load(&mut self, py: Python<'_>, torque: f64) -> PyResult<()> {
        self.core.set_load(torque).map_err(|e| raise(py, e))
    }

    fn step(&mut self, py: Python<'_>, u: f64) -> PyResult<(f64, f64)> {
        self.core.run(&[u]).map_err(|e| raise(py, e))?;
        Ok((self.core.counts(), self.core.speed_rpm()))
    }

    fn run<'py>(&mut self, py: Python<'py>, u: PyReadonlyArray1<'py, f64>) -> PyResult<Pair<'py>> {
        let u = slice(&u, "u")?;
        let mut machine = self.core.clone();
        let (machine, (counts, speed)) = watched_over(py, u.len(), |monitor| {
            let run = run(&mut machine, u, monitor)?;
            Ok((machine, run))
        })?;
        self.core = machine;
        Ok((array1(py, counts), array1(py, speed)))
    }

    /// What pickle and copy make another of: the parameters, and the memory.
    #[expect(clippy::type_complexity, reason = "the protocol's own tuple")]
    fn __reduce__<'py>(
        slf: PyRef<'py, Self>,
        py: Python<'py>,
    ) -> PyResult<(Bound<'py, PyType>, (Bound<'py, PyDict>,), [f64; 11])> {
        let parameters = named(py, slf.core.parameters().values())?;
        Ok((py.get_type::<Self>(), (parameters,), slf.core.memory()))
    }

    fn __setstate__(&mut self, py: Python<'_>, memory: [f64; 11]) -> PyResult<()> {
        self.core.recall(memory).map_err(|e| raise(py, e))
    }

    fn linearise<'py>(&self, py: Python<'py>, speed_rpm: f64) -> PyResult<Bound<'py, PyDict>> {
        let small = self.core.linearise(speed_rpm).map_err(|e| raise(py, e))?;
        let dict = PyDict::new(py);
        dict.set_item("command", small.command)?;
        dict.set_item("current", small.current)?;
        dict.set_item("gain", small.gain)?;
        dict.set_item("T1", small.time_constants[0])?;
        dict.set_item("T2", small.time_constants[1])?;
        Ok(dict)
    }

    #[getter]
    fn counts(&self) -> f64 {
        self.core.counts()
    }

    #[getter]
    fn speed_rpm(&self) -> f64 {
        self.core.speed_rpm()
    }

    #[getter]
    fn current(&self) -> f64 {
        self.core.current()
    }
}

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Machine>()
}
