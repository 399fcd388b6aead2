//! The process's memory, kept from being swapped while a loop runs.

/// Keeps all memory of the process resident until it is dropped.
#[derive(Debug)]
pub struct Locked(());

impl Locked {
    /// Locks what there is and what is to come.
    ///
    /// # Errors
    /// The system's words where it refuses: without privilege `RLIMIT_MEMLOCK` bounds the process.
    pub fn new() -> Result<Self, String> {
        lock().map(|()| Self(()))
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        unlock();
    }
}

#[cfg(target_os = "linux")]
fn lock() -> Result<(), String> {
    use rustix::mm::{MlockAllFlags, mlockall};
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).map_err(|refused| refused.to_string())
}

#[cfg(target_os = "linux")]
fn unlock() {
    // Memory that stays locked does no harm.
    let _ = rustix::mm::munlockall();
}

#[cfg(not(target_os = "linux"))]
fn lock() -> Result<(), String> {
    Err("not offered on this system".to_owned())
}

#[cfg(not(target_os = "linux"))]
fn unlock() {}
