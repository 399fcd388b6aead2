//! A setting that the controller refuses.

use core::fmt;

/// The setting's name, what was expected, what came.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refused {
    /// Name of the setting, as in docs/CONVENTIONS.md.
    pub name: &'static str,
    /// What is accepted.
    pub expected: &'static str,
    /// What came.
    pub received: f64,
}

impl Refused {
    /// `Ok` where `holds`, else the refusal.
    pub(crate) fn unless(
        holds: bool,
        name: &'static str,
        expected: &'static str,
        received: f64,
    ) -> Result<(), Self> {
        let refused = Self {
            name,
            expected,
            received,
        };
        if holds { Ok(()) } else { Err(refused) }
    }
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            name,
            expected,
            received,
        } = self;
        write!(f, "expected {expected} for {name}, got {received}")
    }
}

impl core::error::Error for Refused {}
