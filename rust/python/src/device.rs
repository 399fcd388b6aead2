//! Bindings of the virtual machine, and of the device that serves it.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use crate::seam::{Raised, Values, Vector, array1, slice, watched_over};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use sewfast_core::machine::{Machine as Core, Parameters};
use sewfast_core::{Error, Monitor, Result};
use sewfast_link::server::{Direction, Endpoint, Entry, Fault, Faults, Server, Settings};

/// A virtual device that is being served on a thread of its own.
#[pyclass(module = "sewfast._core", frozen)]
pub struct DeviceServer {
    server: Server,
}

/// `sewfast.errors.LinkError` with the message of `error`.
fn link_error(py: Python<'_>, error: &io::Error) -> PyErr {
    let class = py
        .import("sewfast.errors")
        .and_then(|module| module.getattr("LinkError"));
    match class.and_then(|class| class.call1((error.to_string(),))) {
        Ok(exception) => PyErr::from_value(exception),
        Err(import_error) => import_error,
    }
}

fn seconds(value: Option<f64>) -> Option<Duration> {
    value.and_then(|value| Duration::try_from_secs_f64(value).ok())
}

fn entry<'py>(py: Python<'py>, entry: &Entry) -> PyResult<Bound<'py, PyDict>> {
    let dict = dict! { py;
        "event" => entry.happening.name(), "device_us" => entry.device_us, "seconds" => entry.seconds,
        "state" => entry.state, "late_us" => entry.late_us,
    };
    let heartbeat = entry.heartbeat;
    dict.set_item("heartbeat_us", heartbeat.map(|h| h.device_us))?;
    dict.set_item("heartbeat_seconds", heartbeat.map(|h| h.seconds))?;
    dict.set_item("watchdog_us", heartbeat.map(|h| h.watchdog_us))?;
    Ok(dict)
}

#[pymethods]
impl DeviceServer {
    #[new]
    #[pyo3(signature = (
        machine, *, name, pty, link, address, anyone, fast, baud, faults, seed, once, duration, fault_log, trace
    ))]
    fn new(
        py: Python<'_>,
        machine: &Machine,
        name: String,
        pty: bool,
        link: Option<PathBuf>,
        address: String,
        anyone: bool,
        fast: bool,
        baud: Option<u32>,
        faults: &str,
        seed: u64,
        once: bool,
        duration: Option<f64>,
        fault_log: Option<PathBuf>,
        trace: Option<PathBuf>,
    ) -> PyResult<Self> {
        let mut machine = machine.core.clone();
        machine.reset();
        let settings = Settings {
            machine,
            name,
            endpoint: match pty {
                true => Endpoint::Pty(link),
                false => Endpoint::Tcp { address, anyone },
            },
            fast,
            baud,
            faults: Faults::parse(faults).raised(py)?,
            seed,
            once,
            duration: seconds(duration),
            fault_log,
            trace,
        };
        let server = py.detach(|| Server::start(settings));
        let server = server.map_err(|e| link_error(py, &e))?;
        Ok(Self { server })
    }

    #[getter]
    fn port(&self, py: Python<'_>) -> String {
        py.detach(|| self.server.port())
    }

    fn wait(&self, py: Python<'_>, timeout: f64) -> bool {
        let timeout = seconds(Some(timeout)).unwrap_or_default();
        py.detach(|| self.server.wait(timeout))
    }

    fn stop(&self, py: Python<'_>) -> PyResult<()> {
        let stopped = py.detach(|| self.server.stop());
        stopped.map_err(|e| link_error(py, &e))
    }

    #[pyo3(signature = (fault, seconds=None))]
    fn cause(&self, py: Python<'_>, fault: &str, seconds: Option<f64>) -> PyResult<()> {
        let fault = Fault::named(fault).raised(py)?;
        let lasts = self::seconds(seconds);
        py.detach(|| self.server.cause(fault, lasts));
        Ok(())
    }

    fn faults<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counts = py.detach(|| self.server.faults());
        let dict = PyDict::new(py);
        for way in [Direction::ToHost, Direction::ToDevice] {
            let by_name = PyDict::new(py);
            for fault in Fault::ALL {
                by_name.set_item(fault.name(), counts[way as usize][fault as usize])?;
            }
            dict.set_item(way.name(), by_name)?;
        }
        Ok(dict)
    }

    fn statistics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let statistics = py.detach(|| self.server.statistics());
        Ok(dict! { py;
            "samples" => statistics.samples, "late" => statistics.late, "latest_us" => statistics.latest_us,
            "set_back" => statistics.set_back, "bytes_to_host" => statistics.bytes_to_host,
            "refused" => statistics.refused,
        })
    }

    fn trace<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let entries = py.detach(|| self.server.trace());
        entries.iter().map(|found| entry(py, found)).collect()
    }

    fn problem(&self, py: Python<'_>) -> Option<String> {
        py.detach(|| self.server.problem())
    }
}

/// Samples between two checks for a stop request: a few milliseconds of work.
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

type Pair<'py> = (Vector<'py>, Vector<'py>);

#[pymethods]
impl Machine {
    #[new]
    #[pyo3(signature = (parameters=None))]
    fn new(py: Python<'_>, parameters: Option<BTreeMap<String, f64>>) -> PyResult<Self> {
        let changes = parameters.unwrap_or_default();
        let changes = changes.iter().map(|(name, value)| (name.as_str(), *value));
        let core = Parameters::default().with(changes).and_then(Core::new);
        core.map(|core| Self { core }).raised(py)
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
        self.core.set_load(torque).raised(py)
    }

    fn step(&mut self, py: Python<'_>, u: f64) -> PyResult<(f64, f64)> {
        self.core.run(&[u]).raised(py)?;
        Ok((self.core.counts(), self.core.speed_rpm()))
    }

    fn run<'py>(&mut self, py: Python<'py>, u: Values<'py>) -> PyResult<Pair<'py>> {
        let u = slice(&u, "u")?;
        let mut machine = self.core.clone();
        let (machine, (counts, speed)) = watched_over(py, u.len(), |monitor| {
            let run = run(&mut machine, u, monitor)?;
            Ok((machine, run))
        })?;
        self.core = machine;
        Ok((array1(py, counts), array1(py, speed)))
    }

    /// For pickle and copy: the parameters, and the memory.
    #[expect(clippy::type_complexity, reason = "the protocol's own tuple")]
    fn __reduce__<'py>(
        slf: PyRef<'py, Self>,
        py: Python<'py>,
    ) -> PyResult<(Bound<'py, PyType>, (Bound<'py, PyDict>,), [f64; 11])> {
        let parameters = named(py, slf.core.parameters().values())?;
        Ok((py.get_type::<Self>(), (parameters,), slf.core.memory()))
    }

    fn __setstate__(&mut self, py: Python<'_>, memory: [f64; 11]) -> PyResult<()> {
        self.core.recall(memory).raised(py)
    }

    fn linearise<'py>(&self, py: Python<'py>, speed_rpm: f64) -> PyResult<Bound<'py, PyDict>> {
        let small = self.core.linearise(speed_rpm).raised(py)?;
        Ok(dict! { py;
            "command" => small.command, "current" => small.current, "gain" => small.gain,
            "T1" => small.time_constants[0], "T2" => small.time_constants[1],
        })
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
