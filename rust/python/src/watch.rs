//! Long work on its own thread while the interpreter stays free: progress is shown and Ctrl-C is heard.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use sewfast_core::{Monitor, Result};

use crate::arrays::raise;

/// How long Ctrl-C may go unheard.
const PERIOD: Duration = Duration::from_millis(20);

/// Runs `work` on a thread of its own, calls `progress(done, total, best_cost)` meanwhile and forwards Ctrl-C.
///
/// After Ctrl-C the work is asked to stop and its best result so far is returned, marked as interrupted by
/// the work itself; where it has none, or was done before it heard, `KeyboardInterrupt` is raised. Any other exception, of a signal handler
/// or of `progress`, stops the work and is raised.
pub fn watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce(&Monitor) -> Result<T> + Send,
) -> PyResult<T> {
    let (monitor, done) = (Monitor::default(), AtomicBool::new(false));
    thread::scope(|scope| {
        let (shared, done, watcher) = (&monitor, &done, thread::current());
        let worker = scope.spawn(move || {
            let result = work(shared);
            done.store(true, Ordering::Release);
            watcher.unpark();
            result
        });
        let mut raised = None;
        // A worker that panics never says that it is done, but it finishes.
        while !done.load(Ordering::Acquire) && !worker.is_finished() {
            py.detach(|| thread::park_timeout(PERIOD));
            if raised.is_none() {
                raised = look(py, progress, shared).err();
                if raised.is_some() {
                    shared.request_stop();
                }
            }
        }
        let outcome = py.detach(|| worker.join());
        let result = outcome.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        match raised {
            Some(error) if !error.is_instance_of::<PyKeyboardInterrupt>(py) => Err(error),
            Some(interrupt) => result.ok().filter(|_| monitor.heard()).ok_or(interrupt),
            None => result.map_err(|e| raise(py, e)),
        }
    })
}

/// So many samples of one loop or machine take a few milliseconds, in which nobody misses Ctrl-C.
const BRIEF: usize = 5_000;

/// [`watched`] for work over so many samples of a loop or a machine; brief work is done where it was asked for, since a
/// thread of its own would take longer than some of it.
pub fn watched_over<T: Send>(
    py: Python<'_>,
    samples: usize,
    work: impl FnOnce(&Monitor) -> Result<T> + Send,
) -> PyResult<T> {
    if samples > BRIEF {
        return watched(py, None, work);
    }
    py.detach(|| work(&Monitor::default()))
        .map_err(|e| raise(py, e))
}

fn look(py: Python<'_>, progress: Option<&Bound<'_, PyAny>>, monitor: &Monitor) -> PyResult<()> {
    py.check_signals()?;
    progress.map_or(Ok(()), |callback| {
        callback.call1(monitor.progress()).map(drop)
    })
}
