//! The place where a host connects: a pseudo-terminal or a TCP port.

use std::fmt::Debug;
use std::io;
use std::time::Duration;

use crate::ready::Interest;

/// A port with at most one host; nothing in it blocks but [`Port::wait`].
pub trait Port: Debug + Send {
    /// What a host opens.
    fn name(&self) -> String;

    /// Looks who is there; true while a host is.
    fn connected(&mut self) -> bool;

    /// Bytes from the host; 0 where none are there. A host that has gone shows in [`Port::connected`] next.
    fn read(&mut self, buffer: &mut [u8]) -> usize;

    /// Bytes to the host; how many went.
    fn write(&mut self, bytes: &[u8]) -> usize;

    /// Sleeps until `interest` can be served, and at most for `timeout`.
    fn wait(&mut self, interest: Interest, timeout: Duration);

    /// Makes the port vanish.
    fn unplug(&mut self);

    /// Makes it come back.
    ///
    /// # Errors
    /// Where the system does not give it.
    fn plug(&mut self) -> io::Result<()>;

    /// Whether others than this computer's users may reach it, a web page among them.
    fn is_network(&self) -> bool {
        false
    }

    /// Sends the host that is there away.
    fn hang_up(&mut self) {}

    /// Hosts that were sent away, as one was there or as they were none.
    fn refused(&self) -> u64 {
        0
    }
}

/// An error that says what was being done.
pub fn explained(error: &io::Error, what: &str) -> io::Error {
    io::Error::new(error.kind(), format!("{what}: {error}"))
}
