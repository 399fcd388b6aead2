//! Bindings of the link: frames and their bodies to bytes; received bytes to frames, replies and columns of samples.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::seam::{Raised, Values, array1, raise, slice};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList};
use sewfast_control::link::identity::VERSION;
use sewfast_control::link::{Body, Fields, Header, MAX_BODY, MAX_WIRE, encode};
use sewfast_core::{Error, Result};
use sewfast_link::bodies::{self, Description, Event, Greeting, Start, Status};
use sewfast_link::client::{Client, Event as Heard};
use sewfast_link::{Channel, Receiver, Upload};

#[pyfunction]
pub fn link_frame<'py>(
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
    let length =
        encode(&header, body, &mut wire).ok_or_else(|| too_long(py, &body.len().to_string()))?;
    Ok(PyBytes::new(py, &wire[..length]))
}

fn too_long(py: Python<'_>, received: &str) -> PyErr {
    let message = format!(
        "expected a body of at most {MAX_BODY} bytes, got {received}; split it over several frames"
    );
    raise(py, Error::setting(message))
}

/// The bodies of a host's frames, and of a device's replies; see docs/PROTOCOL.md.
#[pyclass(frozen, module = "sewfast._core")]
pub struct LinkBodies;

type Wire<'py> = PyResult<Bound<'py, PyBytes>>;

fn wire<'py>(py: Python<'py>, body: &Body) -> Wire<'py> {
    let bytes = body.bytes().ok_or_else(|| too_long(py, "more"))?;
    Ok(PyBytes::new(py, bytes))
}

type Greeted = (String, String, u8, u32, u32, u8, u8, u32, u32, u32, f32);
type Described = (u8, u8, u32, String, String);
type Run = (u8, u8, u8, u16, u32, u64, u32, u32, u32);
type Counted = (f32, i32, u32, u32, u32, u32, u32, u32);

#[pymethods]
impl LinkBodies {
    #[classattr]
    const VERSION: u8 = VERSION;
    #[classattr]
    const MAX_BODY: usize = MAX_BODY;
    /// Bytes of a frame on the wire in addition to its body.
    #[classattr]
    const AROUND: usize = MAX_WIRE - MAX_BODY;

    #[staticmethod]
    fn host_time(session: u32, us: u64) -> u64 {
        Header::host_time(session, us)
    }

    #[staticmethod]
    fn hello(py: Python<'_>, session: u32) -> Wire<'_> {
        wire(py, &bodies::hello(session))
    }

    #[staticmethod]
    fn arm(py: Python<'_>, watchdog: u32, key: u32) -> Wire<'_> {
        wire(py, &bodies::arm(watchdog, key))
    }

    #[staticmethod]
    fn keep(py: Python<'_>, watchdog: u32) -> Wire<'_> {
        wire(py, &bodies::keep(watchdog))
    }

    #[staticmethod]
    fn drive(py: Python<'_>, watchdog: u32, u: f64) -> Wire<'_> {
        wire(py, &bodies::drive(watchdog, u))
    }

    #[staticmethod]
    fn credit(py: Python<'_>, watchdog: u32, until: u64) -> Wire<'_> {
        wire(py, &bodies::credit(watchdog, until))
    }

    #[staticmethod]
    fn limits(py: Python<'_>, values: [f64; 4]) -> Wire<'_> {
        wire(py, &bodies::limits(values))
    }

    #[staticmethod]
    fn upload<'py>(py: Python<'py>, table: u8, offset: u32, values: &[u8]) -> Wire<'py> {
        wire(py, &bodies::upload(table, offset, values))
    }

    #[staticmethod]
    #[pyo3(signature = (values, filter_samples, design = None))]
    fn gains(
        py: Python<'_>,
        values: [f64; 12],
        filter_samples: u8,
        design: Option<(f64, f64, Vec<[f64; 4]>)>,
    ) -> Wire<'_> {
        let mut body = bodies::gains(values, filter_samples);
        if let Some((observer_time, r_rate, schedule)) = design {
            bodies::design(&mut body, observer_time, r_rate, &schedule);
        }
        wire(py, &body)
    }

    #[staticmethod]
    fn feedforward(
        py: Python<'_>,
        preview: u8,
        late: f64,
        levels: Vec<[f64; 2]>,
        taps: Vec<f64>,
    ) -> Wire<'_> {
        wire(py, &bodies::feedforward(preview, late, &levels, &taps))
    }

    #[staticmethod]
    fn position(
        py: Python<'_>,
        numbers: [f64; 4],
        smoothing: u8,
        releases: bool,
        rows: Vec<[f64; 3]>,
    ) -> Wire<'_> {
        wire(py, &bodies::position(numbers, smoothing, releases, &rows))
    }

    #[staticmethod]
    fn angle(py: Python<'_>, at: u32, counts: f64, onward: bool) -> Wire<'_> {
        wire(py, &bodies::angle(at, counts, onward))
    }

    #[staticmethod]
    fn travel(py: Python<'_>, low: i32, high: i32) -> Wire<'_> {
        wire(py, &bodies::travel(low, high))
    }

    #[staticmethod]
    fn travel_of(body: &[u8]) -> Option<[i32; 4]> {
        bodies::travel_of(&mut Fields::new(body))
    }

    #[staticmethod]
    fn biquads(py: Python<'_>, sections: Vec<[f64; 4]>) -> Wire<'_> {
        wire(py, &bodies::biquads(&sections))
    }

    #[staticmethod]
    fn controller(py: Python<'_>, kind: u8, counts_per_unit: f64, values: Vec<f64>) -> Wire<'_> {
        wire(py, &bodies::controller(kind, counts_per_unit, &values))
    }

    #[staticmethod]
    fn start(
        py: Python<'_>,
        mode: u8,
        watchdog: u32,
        at: u64,
        length: u32,
        mask: u16,
        batch: u8,
    ) -> Wire<'_> {
        let start = Start {
            mode,
            watchdog,
            at,
            length,
            mask,
            batch,
        };
        wire(py, &start.body())
    }

    #[staticmethod]
    fn reply<'py>(py: Python<'py>, body: &[u8]) -> Option<(u32, u8, Bound<'py, PyBytes>)> {
        let mut fields = Fields::new(body);
        let (sequence, result) = bodies::reply(&mut fields)?;
        Some((sequence, result, PyBytes::new(py, fields.rest())))
    }

    #[staticmethod]
    fn detail(rest: &[u8]) -> Option<u32> {
        let mut fields = Fields::new(rest);
        fields.u32().filter(|_| fields.is_empty())
    }

    #[staticmethod]
    fn greeting(body: &[u8]) -> Option<(Greeted, u32, u32)> {
        let g = Greeting::of(&mut Fields::new(body))?;
        let who = (
            g.name,
            g.firmware,
            g.version,
            g.boot,
            g.schema,
            g.state,
            g.channels,
            g.period,
            g.capabilities,
            g.capacity,
            g.counts_per_rev,
        );
        Some((who, g.session, g.key))
    }

    #[staticmethod]
    fn description(body: &[u8]) -> Option<Described> {
        let d = Description::of(&mut Fields::new(body))?;
        Some((d.number, d.encoding, d.steps_per_unit, d.name, d.unit))
    }

    #[staticmethod]
    fn schema(version: u8, period_us: u32, replies: Vec<Vec<u8>>) -> u32 {
        bodies::schema(version, period_us, replies.iter().map(Vec::as_slice))
    }

    #[staticmethod]
    fn status(body: &[u8]) -> Option<(Run, Counted)> {
        let s = Status::of(&mut Fields::new(body))?;
        let run = (
            s.state, s.reason, s.mode, s.mask, s.run, s.start, s.samples, s.length, s.end,
        );
        let counted = (
            s.speed, s.counts, s.received, s.refused, s.dropped, s.late, s.session, s.foreign,
        );
        Some((run, counted))
    }

    #[staticmethod]
    fn limits_of(body: &[u8]) -> Option<[f32; 8]> {
        bodies::limits_of(&mut Fields::new(body))
    }

    #[staticmethod]
    fn started(body: &[u8]) -> Option<(u32, u64)> {
        bodies::started(&mut Fields::new(body))
    }

    #[staticmethod]
    fn uploaded(body: &[u8]) -> Option<(u32, u32)> {
        bodies::uploaded(&mut Fields::new(body))
    }

    #[staticmethod]
    fn event(body: &[u8]) -> Option<(u8, u8, u8, u32, u32, f32)> {
        let mut fields = Fields::new(body);
        let e = Event::of(&mut fields)?;
        fields.end()?;
        Some((e.code, e.state, e.reason, e.run, e.samples, e.value))
    }
}

/// Receives what a device sends; see docs/PROTOCOL.md.
#[pyclass(frozen, module = "sewfast._core")]
pub struct LinkReceiver {
    // a live view reads the counters on another thread than the one that feeds
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
        expect(py, &mut self.lock(), &channels, period_us)
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
        take(py, &mut self.lock())
    }

    #[getter]
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        counters(py, &self.lock())
    }

    fn anomalies(&self) -> Vec<Listed> {
        anomalies(&mut self.lock())
    }
}

impl LinkReceiver {
    fn lock(&self) -> MutexGuard<'_, Receiver> {
        self.core.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn expect(
    py: Python<'_>,
    receiver: &mut Receiver,
    channels: &[(u8, u32)],
    period_us: u32,
) -> PyResult<()> {
    let described = |&(encoding, steps): &(u8, u32)| Channel::described(encoding, steps);
    let channels: Result<Vec<Channel>> = channels.iter().map(described).collect();
    channels
        .and_then(|channels| receiver.expect(&channels, period_us))
        .raised(py)
}

fn take<'py>(py: Python<'py>, receiver: &mut Receiver) -> PyResult<Columns<'py>> {
    let (times, columns) = receiver.take();
    let columns = columns.into_iter().map(|column| array1(py, column));
    let columns = PyList::new(py, columns.collect::<Vec<_>>())?;
    Ok((PyArray1::from_vec(py, times), columns))
}

fn counters<'py>(py: Python<'py>, receiver: &Receiver) -> PyResult<Bound<'py, PyDict>> {
    let named = PyDict::new(py);
    for (name, count) in receiver.counters().named() {
        named.set_item(name, count)?;
    }
    Ok(named)
}

type Listed = (&'static str, u32, u32);

fn anomalies(receiver: &mut Receiver) -> Vec<Listed> {
    let listed = receiver.anomalies();
    listed
        .map(|a| (a.kind.name(), a.sequence, a.count))
        .collect()
}

/// A session with a device; see docs/PROTOCOL.md.
#[pyclass(frozen, module = "sewfast._core")]
pub struct LinkClient {
    // a live view reads the counters on another thread than the one that uses the client
    core: Mutex<Client>,
}

/// Kind, result, detail, body, time of the device, when the command was sent first.
type Replied<'py> = (u8, u8, u32, Bound<'py, PyBytes>, u64, u64);
/// Code, state, reason, run, samples, value, time of the device.
type Happened = (u8, u8, u8, u32, u32, f32, u64);

#[pymethods]
impl LinkClient {
    #[new]
    fn new(session: u32) -> Self {
        Self {
            core: Mutex::new(Client::new(session, 0)),
        }
    }

    fn set_watchdog(&self, us: u32) {
        self.lock().set_watchdog(us);
    }

    fn receive<'py>(
        &self,
        py: Python<'py>,
        now_us: u64,
        data: &[u8],
    ) -> (Vec<Replied<'py>>, Vec<Happened>, bool) {
        let (mut replies, mut events, mut same_boot) = (Vec::new(), Vec::new(), true);
        let mut core = self.lock();
        core.receive(now_us, data);
        while let Some(heard) = core.event() {
            match heard {
                Heard::Reply(r) => {
                    let body = PyBytes::new(py, r.body.bytes().unwrap_or_default());
                    replies.push((r.kind, r.result, r.detail, body, r.time, r.sent));
                }
                Heard::Happened(e, time) => {
                    events.push((e.code, e.state, e.reason, e.run, e.samples, e.value, time))
                }
                Heard::Beat(_) => {}
                Heard::Reset => same_boot = false,
            }
        }
        (replies, events, same_boot)
    }

    fn greet(&self, patience_us: u64) {
        self.lock().greet(patience_us);
    }

    fn end_greeting(&self) {
        self.lock().end_greeting();
    }

    fn begin(&self, py: Python<'_>, kind: u8, body: &[u8]) -> PyResult<()> {
        let mut whole = Body::new();
        whole.add(body);
        if whole.bytes().is_none() {
            return Err(too_long(py, &body.len().to_string()));
        }
        self.lock().begin(kind, whole);
        Ok(())
    }

    fn forget(&self) {
        self.lock().forget();
    }

    fn expire(&self, now_us: u64) -> Option<(u8, u64, u64, u64)> {
        let unanswered = self.lock().expire(now_us)?;
        let (attempts, waited) = (unanswered.attempts, unanswered.waited);
        Some((unanswered.kind, attempts, waited, unanswered.others))
    }

    fn transmit<'py>(&self, py: Python<'py>, now_us: u64) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.lock().transmit(now_us))
    }

    fn keep<'py>(&self, py: Python<'py>, now_us: u64) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.lock().keep(now_us))
    }

    fn drive<'py>(&self, py: Python<'py>, now_us: u64, u: f64) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.lock().drive(now_us, u))
    }

    fn grant<'py>(&self, py: Python<'py>, now_us: u64, until_us: u64) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.lock().grant(now_us, until_us))
    }

    fn go_on(&self, command: u32, heartbeat: u32) {
        self.lock().go_on(command, heartbeat);
    }

    #[getter]
    fn is_busy(&self) -> bool {
        self.lock().is_busy()
    }

    #[getter]
    fn due(&self) -> Option<u64> {
        self.lock().due()
    }

    #[getter]
    fn newest(&self) -> u64 {
        self.lock().newest()
    }

    #[getter]
    fn heard(&self) -> Option<u64> {
        self.lock().heard()
    }

    #[getter]
    fn sequences(&self) -> (u32, u32) {
        self.lock().sequences()
    }

    fn expect(&self, py: Python<'_>, channels: Vec<(u8, u32)>, period_us: u32) -> PyResult<()> {
        expect(py, self.lock().receiver(), &channels, period_us)
    }

    fn take<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        take(py, self.lock().receiver())
    }

    #[getter]
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        counters(py, self.lock().receiver())
    }

    fn anomalies(&self) -> Vec<Listed> {
        anomalies(self.lock().receiver())
    }
}

impl LinkClient {
    fn lock(&self) -> MutexGuard<'_, Client> {
        self.core.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A run's values as the device stores them; see docs/PROTOCOL.md.
#[pyclass(module = "sewfast._core")]
pub struct LinkUpload {
    core: Upload,
}

#[pymethods]
impl LinkUpload {
    #[staticmethod]
    fn commands(values: Values<'_>, steps_per_unit: u32, limit: f64) -> PyResult<Self> {
        let core = Upload::commands(slice(&values, "values")?, steps_per_unit, limit);
        Ok(Self { core })
    }

    #[staticmethod]
    fn references(values: Values<'_>, limit: f64) -> PyResult<Self> {
        let core = Upload::references(slice(&values, "values")?, limit);
        Ok(Self { core })
    }

    #[staticmethod]
    fn goals(values: Values<'_>) -> PyResult<Self> {
        let core = Upload::goals(slice(&values, "values")?);
        Ok(Self { core })
    }

    #[getter]
    fn end(&self) -> usize {
        self.core.end()
    }

    #[getter]
    fn is_whole(&self) -> bool {
        self.core.is_whole()
    }

    fn piece<'py>(&self, py: Python<'py>, room: i64) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let piece = self.core.piece(usize::try_from(room).unwrap_or(0));
        piece.map(|body| wire(py, &body)).transpose()
    }

    fn answered(&mut self, result: u8, detail: u32, body: &[u8]) -> bool {
        let end = bodies::uploaded(&mut Fields::new(body)).map(|(end, _)| end);
        self.core.answered(result, detail, end)
    }
}
