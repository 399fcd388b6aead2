//! The virtual sewing machine behind a pty or TCP port, with the state machine of a real device.
//!
//! A [`Server`] owns a thread that serves the drive until it is stopped. Time is real, or advances by the host's
//! credit; faults and the rate of a serial line apply between device and port.
//!
//! To read: `rig` (the device), `port` and `pty` (where a host connects), `line` and `faults` (the path between them),
//! `serving` (the loop that moves bytes), `trace` (its log of the output).

mod faults;
mod line;
mod port;
#[cfg(unix)]
mod pty;
mod rig;
mod serving;
mod trace;

use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use sewfast_core::machine::Machine;

use faults::FaultLog;
use port::{Port, explained};
use rig::Rig;
use serving::Serving;
use trace::Trace;

pub use faults::{Counts, Fault, Faults, KINDS};
pub use line::Direction;
pub use rig::{CAPACITY, PERIOD};
pub use trace::{Entry, Happening, Heartbeat};

/// Where to serve the drive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Endpoint {
    /// A pseudo-terminal; with a path, a symbolic link to it.
    Pty(Option<PathBuf>),
    /// A TCP port.
    Tcp {
        /// Such as `127.0.0.1:0`.
        address: String,
        /// Whether other computers may reach it: whoever reaches it can start the motor.
        anyone: bool,
    },
}

/// What to serve, where and how.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The drive's machine.
    pub machine: Machine,
    /// The device's name; cut after 24 bytes.
    pub name: String,
    /// The port.
    pub endpoint: Endpoint,
    /// Whether time advances by the host's credit.
    pub fast: bool,
    /// Bits a second in both directions; `None` for no limit.
    pub baud: Option<u32>,
    /// The faults to inject.
    pub faults: Faults,
    /// The seed of the faults.
    pub seed: u64,
    /// End when the first host has gone.
    pub once: bool,
    /// End after this time.
    pub duration: Option<Duration>,
    /// File with a line of JSON for each fault.
    pub fault_log: Option<PathBuf>,
    /// File with a line of JSON for each change of the output or of the connection.
    pub trace: Option<PathBuf>,
}

/// A drive being served.
#[derive(Debug)]
pub struct Server {
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Server {
    /// Opens the port and serves the drive on a new thread.
    ///
    /// # Errors
    /// The port, a file or the thread cannot be created.
    pub fn start(settings: Settings) -> io::Result<Self> {
        let began = Instant::now();
        let port = opened(&settings.endpoint)?;
        let named = |path: &Option<PathBuf>, e: io::Error| match path {
            Some(path) => explained(&e, &path.display().to_string()),
            None => e,
        };
        let log = FaultLog::new(settings.fault_log.as_deref())
            .map_err(|e| named(&settings.fault_log, e))?;
        let trace =
            Trace::new(settings.trace.as_deref(), began).map_err(|e| named(&settings.trace, e))?;
        let shared = Arc::new(Shared::default());
        shared.renamed(port.name());
        let served = Arc::clone(&shared);
        let thread = thread::Builder::new().name("sewfast-device".into());
        let machine = settings.machine.clone();
        let rig = Rig::new(machine, kept(&settings.name), first_boot(), settings.fast);
        let rig = rig.map_err(io::Error::other)?;
        let thread = thread.spawn(move || {
            let _end = End(&served);
            Serving::new(&settings, &served, port, rig, log, trace).run();
        })?;
        Ok(Self {
            shared,
            thread: Mutex::new(Some(thread)),
        })
    }

    /// The name that a host opens; a pseudo-terminal without a link has another name after it was unplugged.
    pub fn port(&self) -> String {
        self.shared.port()
    }

    /// Waits for the end of serving, at most for `timeout`; returns whether it has ended.
    pub fn wait(&self, timeout: Duration) -> bool {
        self.shared.wait(timeout)
    }

    /// Causes a fault: stall, reset and unplug within 20 ms, others with the next frame from the device.
    pub fn cause(&self, fault: Fault, lasts: Option<Duration>) {
        self.shared.order(Order::Fault(fault, lasts));
    }

    /// Faults so far, by [`Direction`] and [`Fault`].
    pub fn faults(&self) -> Counts {
        self.shared.faults()
    }

    /// Statistics so far.
    pub fn statistics(&self) -> Statistics {
        self.shared.statistics()
    }

    /// The log of the output so far.
    pub fn trace(&self) -> Vec<Entry> {
        self.shared.entries()
    }

    /// Why a log file ended early, if one did.
    pub fn problem(&self) -> Option<String> {
        self.shared.problem()
    }

    /// Ends serving and removes the port.
    ///
    /// # Errors
    /// The serving thread has panicked.
    pub fn stop(&self) -> io::Result<()> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        match thread.take().map(JoinHandle::join) {
            Some(Err(_)) => Err(io::Error::other(
                "the thread of the virtual device has died",
            )),
            _ => Ok(()),
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.stop();
    }
}

/// Reports that serving has ended, however it ended.
struct End<'a>(&'a Shared);

impl Drop for End<'_> {
    fn drop(&mut self) {
        self.0.ended();
    }
}

fn opened(endpoint: &Endpoint) -> io::Result<Box<dyn Port>> {
    match endpoint {
        #[cfg(unix)]
        Endpoint::Pty(link) => Ok(Box::new(pty::Pty::open(link.clone())?)),
        #[cfg(not(unix))]
        Endpoint::Pty(_) => Err(io::Error::new(
            io::ErrorKind::Unsupported,
            "this system has no pseudo-terminals; serve on TCP",
        )),
        Endpoint::Tcp { address, anyone } => Ok(Box::new(port::Tcp::listen(address, *anyone)?)),
    }
}

/// A device's name lives as long as the program, as in firmware.
fn kept(name: &str) -> &'static str {
    let end = (0..=name.len().min(24))
        .rev()
        .find(|&end| name.is_char_boundary(end));
    Box::leak(name[..end.unwrap_or(0)].into())
}

/// A boot id from the time; its low 16 bits are not 0, the tag of HELLO.
fn first_boot() -> u32 {
    let time = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    let mixed = (time.as_nanos() as u64 ^ u64::from(std::process::id()) << 32)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (mixed >> 32) as u32 | 1
}

/// Log entries kept in memory; the oldest are dropped first.
const KEPT: usize = 1 << 16;

/// Requests of the owner while the drive is served.
#[derive(Clone, Copy, Debug)]
enum Order {
    /// A fault now, or with the next frame from the device; with its own duration.
    Fault(Fault, Option<Duration>),
}

/// Statistics of serving.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Statistics {
    /// Samples taken.
    pub samples: u64,
    /// Samples taken a period or more after they were due.
    pub late: u64,
    /// The largest delay of a sample [us].
    pub latest_us: u64,
    /// How often the clock was set back because it could not catch up.
    pub set_back: u64,
    /// Bytes sent to hosts.
    pub bytes_to_host: u64,
    /// Hosts turned away because another one was connected.
    pub refused: u64,
}

#[derive(Debug, Default)]
struct Report {
    port: String,
    statistics: Statistics,
    faults: Counts,
    entries: Vec<Entry>,
    problem: Option<String>,
    orders: Vec<Order>,
    ended: bool,
}

/// Flags and the last report, shared between the threads.
#[derive(Debug, Default)]
struct Shared {
    /// Set to end serving.
    stop: AtomicBool,
    ordered: AtomicBool,
    report: Mutex<Report>,
    end: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Report> {
        self.report.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the new orders.
    fn orders(&self) -> Vec<Order> {
        match self.ordered.swap(false, Ordering::Acquire) {
            true => std::mem::take(&mut self.lock().orders),
            false => Vec::new(),
        }
    }

    /// Adds an order.
    fn order(&self, order: Order) {
        self.lock().orders.push(order);
        self.ordered.store(true, Ordering::Release);
    }

    /// Sets the port's new name.
    fn renamed(&self, port: String) {
        self.lock().port = port;
    }

    /// The port's name.
    fn port(&self) -> String {
        self.lock().port.clone()
    }

    /// Publishes the present statistics and logs.
    fn report(&self, statistics: &Statistics, log: &FaultLog, trace: &mut Trace) {
        let mut report = self.lock();
        report.statistics = *statistics;
        report.faults = log.counts();
        report.entries.extend(trace.fresh());
        let excess = report.entries.len().saturating_sub(KEPT);
        report.entries.drain(..excess);
        if report.problem.is_none() {
            let problem = log.broken.as_ref().or(trace.broken.as_ref());
            report.problem = problem.cloned();
        }
    }

    /// Statistics so far.
    fn statistics(&self) -> Statistics {
        self.lock().statistics
    }

    /// Counts of faults so far.
    fn faults(&self) -> Counts {
        self.lock().faults
    }

    /// The log so far.
    fn entries(&self) -> Vec<Entry> {
        self.lock().entries.clone()
    }

    /// Why a log file ended early.
    fn problem(&self) -> Option<String> {
        self.lock().problem.clone()
    }

    /// Reports that serving has ended.
    fn ended(&self) {
        self.lock().ended = true;
        self.end.notify_all();
    }

    /// Waits for the end of serving, at most for `timeout`; returns whether it has ended.
    fn wait(&self, timeout: Duration) -> bool {
        let report = self.lock();
        let waited = self
            .end
            .wait_timeout_while(report, timeout, |report| !report.ended);
        waited.unwrap_or_else(PoisonError::into_inner).0.ended
    }
}
