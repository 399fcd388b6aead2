//! Binding of the loop on the host.

use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use sewfast_core::{Error, Result};
use sewfast_link::host_loop::{HostLoop, Locked, Outcome, Settings, Tick};
use sewfast_link::{Channel, Client};

use numpy::PyArray1;

use crate::control::Controller;
use crate::seam::{Values, array1, slice, watched};

#[pyfunction]
#[pyo3(signature = (port, controller, reference, *, tag, session, key, command, heartbeat, device_period, ratio, watchdog, batch,
    mask, channels, counts_per_unit, lock_memory=false, progress=None))]
pub fn host_loop<'py>(
    py: Python<'py>,
    port: i32,
    controller: &Bound<'py, Controller>,
    reference: Values<'py>,
    tag: u16,
    session: u32,
    key: u32,
    command: u32,
    heartbeat: u32,
    device_period: u32,
    ratio: u32,
    watchdog: u32,
    batch: u8,
    mask: u16,
    channels: Vec<(u8, u32)>,
    counts_per_unit: f64,
    lock_memory: bool,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let client = Client::new(session, watchdog).continued(tag, key, command, heartbeat);
    let settings = Settings {
        device_period,
        ratio,
        watchdog,
        batch,
        mask,
        counts_per_unit,
    };
    let controller = controller.borrow().core.clone();
    let reference = slice(&reference, "reference")?.to_vec();
    let (looped, memory) = watched(py, progress, |monitor| {
        let channels = channels
            .iter()
            .map(|&(code, steps)| Channel::described(code, steps));
        let channels = channels.collect::<Result<Vec<_>>>()?;
        let mut looped = HostLoop::new(client, settings, &channels, controller, reference)?;
        let memory = lock_memory.then(Locked::new);
        run(port, &mut looped, monitor)?;
        Ok((
            looped,
            memory.map(|locked| locked.err().unwrap_or_default()),
        ))
    })?;
    let record = record(py, &looped)?;
    record.set_item("memory", memory)?;
    Ok(record)
}

#[cfg(unix)]
fn run(port: i32, looped: &mut HostLoop, monitor: &sewfast_core::Monitor) -> Result<()> {
    use std::os::fd::{AsFd, BorrowedFd};

    if port < 0 {
        return Err(Error::setting(format!(
            "expected an open port's descriptor, got {port}"
        )));
    }
    // SAFETY: the caller keeps the descriptor open for this statement; the run owns a duplicate.
    let port = unsafe { BorrowedFd::borrow_raw(port) }
        .try_clone_to_owned()
        .map_err(|lost| {
            Error::setting(format!("expected an open port, got {lost}; open it again"))
        })?;
    sewfast_link::host_loop::run(port.as_fd(), looped, monitor);
    Ok(())
}

#[cfg(not(unix))]
fn run(_: i32, _: &mut HostLoop, _: &sewfast_core::Monitor) -> Result<()> {
    Err(Error::setting(
        "expected Linux or macOS for a loop on the host, got another system; run the controller on the device",
    ))
}

fn record<'py>(py: Python<'py>, looped: &HostLoop) -> PyResult<Bound<'py, PyDict>> {
    let record = dict! { py;
        "outcome" => outcome(py, looped.outcome())?, "ticks" => ticks(py, &looped.ticks().run)?,
        "missed" => looped.ticks().missed, "unsent" => looped.ticks().unsent,
    };
    let (times, columns) = &looped.history().columns;
    record.set_item("times", PyArray1::from_slice(py, times))?;
    let columns = columns
        .iter()
        .map(|column| PyArray1::from_slice(py, column));
    record.set_item("columns", PyList::new(py, columns)?)?;
    record.set_item("start", looped.start())?;
    record.set_item("round_trip", looped.round_trip())?;
    record.set_item("stopped", looped.stopped())?;
    let status = looped.status();
    record.set_item("taken", status.map(|status| status.samples))?;
    record.set_item("device_late", status.map(|status| status.late))?;
    record.set_item(
        "counters",
        PyDict::from_sequence(&looped.counters().named().into_pyobject(py)?)?,
    )?;
    record.set_item("sequences", looped.sequences())?;
    Ok(record)
}

fn outcome<'py>(py: Python<'py>, outcome: Option<&Outcome>) -> PyResult<Bound<'py, PyDict>> {
    let told = PyDict::new(py);
    told.set_item("name", outcome.map_or("ended", Outcome::name))?;
    match outcome {
        Some(Outcome::Tripped { reason, value }) => {
            told.set_item("reason", reason)?;
            told.set_item("value", value)?;
        }
        Some(Outcome::Refused {
            command,
            result,
            detail,
        }) => {
            told.set_item("command", command)?;
            told.set_item("result", result)?;
            told.set_item("detail", detail)?;
        }
        Some(Outcome::Unanswered(command)) => told.set_item("command", command)?,
        Some(Outcome::PortLost(text)) => told.set_item("text", text)?,
        _ => {}
    }
    Ok(told)
}

/// A column for each field of the ticks; an unknown age is NaN.
fn ticks<'py>(py: Python<'py>, ticks: &[Tick]) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    let column = |of: fn(&Tick) -> f64| array1(py, ticks.iter().map(of).collect());
    columns.set_item("number", column(|tick| tick.number as f64))?;
    columns.set_item("late", column(|tick| tick.late as f64))?;
    columns.set_item(
        "age",
        column(|tick| tick.age.map_or(f64::NAN, |age| age as f64)),
    )?;
    columns.set_item("fresh", column(|tick| f64::from(u8::from(tick.fresh))))?;
    columns.set_item("y", column(|tick| tick.y))?;
    columns.set_item("feedback", column(|tick| tick.feedback))?;
    columns.set_item("u", column(|tick| tick.u))?;
    Ok(columns)
}
