//! The one error type of the core.

use std::fmt;

/// The kind of an error, by what a caller can do about it.
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

/// A number for a message: four decimals, or a power of ten if these would show nothing.
pub(crate) fn shown(x: f64) -> String {
    if x == 0.0 || (1e-3..1e6).contains(&x.abs()) {
        format!("{x:.4}")
    } else {
        format!("{x:.3e}")
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Error {}

#[cfg(test)]
mod tests {
    use super::shown;

    #[test]
    fn numbers_in_messages_keep_their_size() {
        let shown: Vec<String> = [0.0, 0.03, -12.5, 1e-7, -4e300].map(shown).into();
        assert_eq!(
            shown,
            ["0.0000", "0.0300", "-12.5000", "1.000e-7", "-4.000e300"]
        );
    }
}
