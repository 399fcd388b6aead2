//! How often a law of the tests is tried.

use proptest::test_runner::Config;

/// So many cases, as one of these takes long; with `PROPTEST_CASES` as many as that says, for every law alike.
pub(crate) fn cases(few: u32) -> Config {
    match std::env::var_os("PROPTEST_CASES") {
        Some(_) => Config::default(),
        None => Config::with_cases(few),
    }
}
