//! The one error type of the core.

use std::fmt;

/// What went wrong, as far as a caller can act on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// The data cannot be used: wrong shape, too few samples, not finite, constant.
    Data,
    /// A setting is outside its range or contradicts another.
    Setting,
    /// An iteration found no usable answer.
    Fit,
}

/// An error whose message says what was expected, what came and what to do.
#[derive(Clone, Debug, PartialEq)]
pub struct Error {
    /// The category, from which a binding chooses its exception type.
    pub kind: ErrorKind,
    /// The message for the user.
    pub message: String,
}

/// The result type of the core.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// Unusable data.
    pub fn data(message: impl Into<String>) -> Self {
        Self {
            kind: ErrorKind::Data,
            message: message.into(),
        }
    }

    /// An unusable setting.
    pub fn setting(message: impl Into<String>) -> Self {
        Self {
            kind: ErrorKind::Setting,
            message: message.into(),
        }
    }

    /// An iteration without a usable answer.
    pub fn fit(message: impl Into<String>) -> Self {
        Self {
            kind: ErrorKind::Fit,
            message: message.into(),
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Error {}
