//! Bindings of the virtual device's server.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_link::server::{Direction, Endpoint, Entry, Fault, Faults, Server, Settings};

use crate::arrays::raise;
use crate::machine::Machine;

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
    let dict = PyDict::new(py);
    dict.set_item("event", entry.happening.name())?;
    dict.set_item("device_us", entry.device_us)?;
    dict.set_item("seconds", entry.seconds)?;
    dict.set_item("state", entry.state)?;
    dict.set_item("late_us", entry.late_us)?;
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
    #[allow(
        clippy::too_many_arguments,
        reason = "one keyword each, named in the Python layer"
    )]
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
            faults: Faults::parse(faults).map_err(|e| raise(py, e))?,
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
        let fault = Fault::named(fault).map_err(|e| raise(py, e))?;
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
        let dict = PyDict::new(py);
        dict.set_item("samples", statistics.samples)?;
        dict.set_item("late", statistics.late)?;
        dict.set_item("latest_us", statistics.latest_us)?;
        dict.set_item("set_back", statistics.set_back)?;
        dict.set_item("bytes_to_host", statistics.bytes_to_host)?;
        dict.set_item("refused", statistics.refused)?;
        Ok(dict)
    }

    fn trace<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let entries = py.detach(|| self.server.trace());
        entries.iter().map(|found| entry(py, found)).collect()
    }

    fn problem(&self, py: Python<'_>) -> Option<String> {
        py.detach(|| self.server.problem())
    }
}

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<DeviceServer>()
}
