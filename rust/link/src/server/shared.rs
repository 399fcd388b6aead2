//! What the serving thread and the server's owner share.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::faults::Fault;
use super::log::{Counts, FaultLog};
use super::trace::{Entry, Trace};

/// Entries of the account kept in memory; the oldest go first.
const KEPT: usize = 1 << 16;

/// What the owner may ask for while the drive is served.
#[derive(Clone, Copy, Debug)]
pub enum Order {
    /// One fault now, or with the next frame from the device; with a duration of its own.
    Fault(Fault, Option<Duration>),
}

/// How serving went so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Statistics {
    /// Samples taken.
    pub samples: u64,
    /// Samples that were taken a period or more after they were due.
    pub late: u64,
    /// The latest sample [us].
    pub latest_us: u64,
    /// How often the clock was set back because catching up was hopeless.
    pub set_back: u64,
    /// Bytes that went to hosts.
    pub bytes_to_host: u64,
    /// Hosts that were sent away because one was there.
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

/// Flags and the last report.
#[derive(Debug, Default)]
pub struct Shared {
    /// Set to end serving.
    pub stop: AtomicBool,
    ordered: AtomicBool,
    report: Mutex<Report>,
    end: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Report> {
        self.report.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the orders that have come.
    pub fn orders(&self) -> Vec<Order> {
        match self.ordered.swap(false, Ordering::Acquire) {
            true => std::mem::take(&mut self.lock().orders),
            false => Vec::new(),
        }
    }

    /// Adds an order.
    pub fn order(&self, order: Order) {
        self.lock().orders.push(order);
        self.ordered.store(true, Ordering::Release);
    }

    /// The port's name, now.
    pub fn renamed(&self, port: String) {
        self.lock().port = port;
    }

    /// The port's name.
    pub fn port(&self) -> String {
        self.lock().port.clone()
    }

    /// Publishes how serving goes.
    pub fn report(&self, statistics: &Statistics, log: &FaultLog, trace: &mut Trace) {
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

    /// How serving went so far.
    pub fn statistics(&self) -> Statistics {
        self.lock().statistics
    }

    /// Counts of faults so far.
    pub fn faults(&self) -> Counts {
        self.lock().faults
    }

    /// The account so far.
    pub fn entries(&self) -> Vec<Entry> {
        self.lock().entries.clone()
    }

    /// Why a log file ended early.
    pub fn problem(&self) -> Option<String> {
        self.lock().problem.clone()
    }

    /// Says that serving has ended.
    pub fn ended(&self) {
        self.lock().ended = true;
        self.end.notify_all();
    }

    /// Waits for the end of serving, at most for `timeout`; whether it has come.
    pub fn wait(&self, timeout: Duration) -> bool {
        let report = self.lock();
        let waited = self
            .end
            .wait_timeout_while(report, timeout, |report| !report.ended);
        waited.unwrap_or_else(PoisonError::into_inner).0.ended
    }
}
