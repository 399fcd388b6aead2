//! Which of the processor's register widths are used.

use std::sync::OnceLock;

use crate::{Error, Result};

/// What kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// What every processor of the architecture has.
    Baseline,
    /// AVX2 with fused multiply-add.
    Avx2,
    /// AVX-512, its doubles and quadwords (DQ) included.
    Avx512,
}

impl Level {
    /// All levels, the narrowest first.
    pub const ALL: [Self; 3] = [Self::Baseline, Self::Avx2, Self::Avx512];

    /// The name by which `SEWFAST_CPU` asks for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Baseline => "baseline",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Whether this processor has it.
    pub fn is_here(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        let (half, wide) = (
            is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq"),
        );
        #[cfg(not(target_arch = "x86_64"))]
        let (half, wide) = (false, false);
        match self {
            Self::Baseline => true,
            Self::Avx2 => half,
            Self::Avx512 => half && wide,
        }
    }

    fn best() -> Self {
        let here = Self::ALL.into_iter().rev().find(|level| level.is_here());
        here.unwrap_or(Self::Baseline)
    }
}

/// The variable that forces a level.
const VARIABLE: &str = "SEWFAST_CPU";

/// The level in use: the processor's best one, or the one that the environment variable `SEWFAST_CPU` names.
///
/// # Errors
/// `ErrorKind::Setting` where the variable names no level, or one that this processor does not have; the best one is in
/// use then.
pub fn level() -> Result<Level> {
    asked_for().map(|_| in_use())
}

fn asked_for() -> Result<Level> {
    let Some(name) = std::env::var_os(VARIABLE) else {
        return Ok(Level::best());
    };
    named(&name.to_string_lossy())
}

fn named(name: &str) -> Result<Level> {
    let known = Level::ALL.into_iter().find(|level| level.name() == name);
    match known {
        Some(level) if level.is_here() => Ok(level),
        Some(_) => Err(Error::setting(format!(
            "expected a processor with {name} for {VARIABLE}={name}, got one without; its best is {}",
            Level::best().name()
        ))),
        None => Err(Error::setting(format!(
            "expected baseline, avx2 or avx512 for {VARIABLE}, got {name:?}; without the variable the best is taken"
        ))),
    }
}

/// The level that every kernel runs on; it does not change while the program runs.
#[inline]
pub(super) fn in_use() -> Level {
    static IN_USE: OnceLock<Level> = OnceLock::new();
    *IN_USE.get_or_init(|| asked_for().unwrap_or_else(|_| Level::best()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn takes_a_level_by_its_name_where_the_processor_has_it() {
        for level in Level::ALL {
            assert_eq!(named(level.name()).is_ok(), level.is_here());
        }
        assert_eq!(named("baseline"), Ok(Level::Baseline));
        let refused = named("sse9").unwrap_err().message;
        assert!(refused.contains("avx2") && refused.contains("sse9"));
        assert!(Level::best().is_here());
    }
}
