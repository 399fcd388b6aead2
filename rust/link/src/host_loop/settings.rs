//! What a loop on the host is told before it starts.

use sewfast_core::{Error, Result};

/// The longest watchdog time of the protocol \[us\].
const LONGEST_WATCHDOG: u32 = 10_000_000;
/// The shortest watchdog time of the protocol \[us\].
const SHORTEST_WATCHDOG: u32 = 1_000;

/// Numbers of the loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The device's sample time \[us\].
    pub device_period: u32,
    /// Samples of the device in one period of the loop.
    pub ratio: u32,
    /// For how long the device may go on without a command, and the host without a sample \[us\].
    pub watchdog: u32,
    /// Samples in a frame.
    pub batch: u8,
    /// A bit for each channel to stream.
    pub mask: u16,
    /// Counts a second at a speed of one unit.
    pub counts_per_unit: f64,
}

impl Settings {
    /// The loop's sample time \[us\].
    pub fn period(&self) -> u64 {
        u64::from(self.device_period) * u64::from(self.ratio)
    }

    /// Refuses what no loop can run with: `channels` is how many are streamed, `ticks` the reference's
    /// length, `ts` the controller's sample time \[s\].
    ///
    /// # Errors
    /// `ErrorKind::Setting` for the first number outside its range.
    pub fn check(&self, channels: usize, ticks: usize, ts: f64) -> Result<()> {
        let period = self.period() as f64 * 1e-6;
        require(
            self.device_period > 0,
            "a device with a sample time above 0",
            self.device_period,
        )?;
        require(
            self.ratio > 0,
            "a loop of at least one sample of the device",
            self.ratio,
        )?;
        require(
            (ts - period).abs() <= 1e-6 * period,
            &format!("a controller for the loop's sample time of {period} s"),
            ts,
        )?;
        require(ticks > 0, "a reference of at least one sample", ticks)?;
        let samples = (ticks as u64 + 2).saturating_mul(u64::from(self.ratio));
        require(
            samples <= u64::from(u32::MAX),
            "a run of at most 2^32 - 1 samples of the device",
            samples,
        )?;
        require(
            (SHORTEST_WATCHDOG..=LONGEST_WATCHDOG).contains(&self.watchdog),
            "a watchdog time of 1 ms to 10 s, in us",
            self.watchdog,
        )?;
        require(
            u64::from(self.watchdog) > self.period(),
            &format!(
                "a watchdog time longer than the loop's period of {} us",
                self.period()
            ),
            self.watchdog,
        )?;
        require(self.batch > 0, "at least one sample in a frame", self.batch)?;
        require(
            channels == self.mask.count_ones() as usize,
            &format!("a channel for each bit of the mask {:#x}", self.mask),
            channels,
        )?;
        require(
            self.mask & 1 == 1,
            "counts (bit 0) in the mask of channels",
            self.mask,
        )?;
        require(
            self.counts_per_unit > 0.0 && self.counts_per_unit.is_finite(),
            "counts per unit of speed above 0",
            self.counts_per_unit,
        )
    }
}

fn require(holds: bool, expected: &str, received: impl std::fmt::Display) -> Result<()> {
    if holds {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected {expected}, got {received}"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> Settings {
        Settings {
            device_period: 1000,
            ratio: 10,
            watchdog: 50_000,
            batch: 10,
            mask: 3,
            counts_per_unit: 26.2,
        }
    }

    #[test]
    fn takes_a_loop_that_can_run() {
        assert_eq!(settings().check(2, 100, 0.01), Ok(()));
    }

    #[test]
    fn refuses_what_cannot_run_and_names_it() {
        let slow = Settings {
            ratio: 60,
            ..settings()
        };
        assert!(
            slow.check(2, 100, 0.06)
                .unwrap_err()
                .message
                .contains("longer than the loop's period")
        );
        assert!(
            settings()
                .check(2, 100, 0.02)
                .unwrap_err()
                .message
                .contains("0.01 s, got 0.02")
        );
        assert!(settings().check(2, 0, 0.01).is_err());
        assert!(settings().check(2, usize::MAX / 16, 0.01).is_err());
        let blind = Settings {
            mask: 6,
            ..settings()
        };
        assert!(
            blind
                .check(2, 1, 0.01)
                .unwrap_err()
                .message
                .contains("counts (bit 0)")
        );
    }
}
