//! Waiting for a port until bytes can go.

#[cfg(unix)]
mod unix;

#[cfg(unix)]
pub use unix::{Ready, wait};

/// What a port is waited for.
#[derive(Clone, Copy, Debug)]
pub struct Interest {
    /// Bytes from the other side can be taken.
    pub read: bool,
    /// Bytes for the other side are there.
    pub write: bool,
}

impl Interest {
    /// In bytes from the other side alone.
    pub const READ: Self = Self {
        read: true,
        write: false,
    };
}
