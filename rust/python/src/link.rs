//! Bindings of the link: frames out, received bytes to frames and columns of samples.

use std::sync::{Mutex, MutexGuard, PoisonError};

use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList};
use sewfast_control::link::{Header, MAX_BODY, MAX_WIRE, encode};
use sewfast_core::{Error, Result};
use sewfast_link::{Channel, Receiver};

use crate::arrays::{array1, raise};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LinkReceiver>()?;
    module.add_function(wrap_pyfunction!(link_frame, module)?)
}

#[pyfunction]
fn link_frame<'py>(
    py: Python<'py>,
    kind: u8,
    tag: u16,
    sequence: u32,
    time: u64,
    body: &[u8],
) -> PyResult<Bound<'py, PyBytes>> {
    let header = Header {
        kind,
        tag,
        sequence,
        time,
    };
    let mut wire = [0; MAX_WIRE];
    let length = encode(&header, body, &mut wire).ok_or_else(|| {
        let message = format!(
            "expected a body of at most {MAX_BODY} bytes, got {}; split it over several frames",
            body.len()
        );
        raise(py, Error::setting(message))
    })?;
    Ok(PyBytes::new(py, &wire[..length]))
}

/// Receives what a device sends; see docs/PROTOCOL.md.
#[pyclass(frozen, module = "sewfast._core")]
struct LinkReceiver {
    // a live view reads the counters from another thread than the one that feeds
    core: Mutex<Receiver>,
}

type Frame<'py> = (u8, u16, u32, u64, Bound<'py, PyBytes>);
type Columns<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyList>);

#[pymethods]
impl LinkReceiver {
    #[new]
    fn new() -> Self {
        Self {
            core: Mutex::new(Receiver::new()),
        }
    }

    fn expect(&self, py: Python<'_>, channels: Vec<(u8, u32)>, period_us: u32) -> PyResult<()> {
        let described = |&(encoding, steps): &(u8, u32)| Channel::described(encoding, steps);
        let channels: Result<Vec<Channel>> = channels.iter().map(described).collect();
        channels
            .and_then(|channels| self.lock().expect(&channels, period_us))
            .map_err(|e| raise(py, e))
    }

    fn feed<'py>(&self, py: Python<'py>, data: &[u8]) -> Vec<Frame<'py>> {
        let mut frames = Vec::new();
        self.lock().feed(data, |frame| {
            let header = frame.header;
            let body = PyBytes::new(py, frame.body);
            frames.push((header.kind, header.tag, header.sequence, header.time, body));
        });
        frames
    }

    fn take<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let (times, columns) = self.lock().take();
        let columns = columns.into_iter().map(|column| array1(py, column));
        let columns = PyList::new(py, columns.collect::<Vec<_>>())?;
        Ok((PyArray1::from_vec(py, times), columns))
    }

    #[getter]
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let named = PyDict::new(py);
        for (name, count) in self.lock().counters().named() {
            named.set_item(name, count)?;
        }
        Ok(named)
    }

    fn anomalies(&self) -> Vec<(&'static str, u32, u32)> {
        let mut core = self.lock();
        let listed = core.anomalies();
        listed
            .map(|a| (a.kind.name(), a.sequence, a.count))
            .collect()
    }
}

impl LinkReceiver {
    fn lock(&self) -> MutexGuard<'_, Receiver> {
        self.core.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
