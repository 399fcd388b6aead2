//! Injected faults: how often, how long and when, reproducible for a seed and given traffic; with their counts and their log.

use std::fs::File;
use std::io::{self, LineWriter, Write};
use std::path::Path;
use std::time::Duration;

use sewfast_control::link::{Deframer, Header};
use sewfast_core::random::Random;
use sewfast_core::{Error, Result};

use super::line::Direction;

/// Faults on the way between a device and its host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The frame does not arrive.
    Drop,
    /// One bit of the frame, including its closing zero, is inverted.
    Flip,
    /// The frame arrives twice.
    Duplicate,
    /// The frame arrives after the next one.
    Reorder,
    /// The frame and those after it arrive late.
    Delay,
    /// Nothing passes in either direction for a time.
    Stall,
    /// The device reboots; its motor is off.
    Reset,
    /// The port vanishes for a time.
    Unplug,
}

/// The number of kinds.
pub const KINDS: usize = 8;

impl Fault {
    /// Every kind, in the order in which they are drawn.
    pub const ALL: [Self; KINDS] = [
        Self::Drop,
        Self::Flip,
        Self::Duplicate,
        Self::Reorder,
        Self::Delay,
        Self::Stall,
        Self::Reset,
        Self::Unplug,
    ];

    /// Its name in `--faults`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Drop => "drop",
            Self::Flip => "flip",
            Self::Duplicate => "duplicate",
            Self::Reorder => "reorder",
            Self::Delay => "delay",
            Self::Stall => "stall",
            Self::Reset => "reset",
            Self::Unplug => "unplug",
        }
    }

    /// The kind of this name.
    ///
    /// # Errors
    /// A setting error for any other name.
    pub fn named(name: &str) -> Result<Self> {
        let found = Self::ALL.into_iter().find(|fault| fault.name() == name);
        found.ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::setting(format!("expected a fault out of {names}, got {name:?}"))
        })
    }

    /// Its default duration; `None` if it has none.
    fn lasts(self) -> Option<Duration> {
        match self {
            Self::Delay => Some(Duration::from_millis(20)),
            Self::Stall => Some(Duration::from_millis(200)),
            Self::Unplug => Some(Duration::from_millis(300)),
            _ => None,
        }
    }
}

/// Rates per frame, and durations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    rates: [f64; KINDS],
    durations: [Duration; KINDS],
}

impl Default for Faults {
    fn default() -> Self {
        Self {
            rates: [0.0; KINDS],
            durations: Fault::ALL.map(|fault| fault.lasts().unwrap_or_default()),
        }
    }
}

impl Faults {
    /// Rates such as `drop=.001,flip=1e-4,stall=1e-4:0.2`: a probability per frame, and after a colon the seconds.
    ///
    /// ```
    /// use sewfast_link::server::{Fault, Faults};
    /// let faults = Faults::parse("drop=.001, stall=1e-4:0.2")?;
    /// assert_eq!(faults.rate(Fault::Drop), 0.001);
    /// assert_eq!(faults.duration(Fault::Stall).as_secs_f64(), 0.2);
    /// # Ok::<(), sewfast_core::Error>(())
    /// ```
    ///
    /// # Errors
    /// A setting error for an unknown or repeated kind, a rate outside 0 to 1, a duration that is not above 0 and at
    /// most 60 s, or a duration for a kind that takes no time.
    pub fn parse(text: &str) -> Result<Self> {
        let mut faults = Self::default();
        let mut seen = [false; KINDS];
        for item in text
            .split(',')
            .map(str::trim)
            .filter(|item| !item.is_empty())
        {
            let (name, value) = item.split_once('=').ok_or_else(|| malformed(item))?;
            let fault = Fault::named(name.trim())?;
            if std::mem::replace(&mut seen[fault as usize], true) {
                return Err(Error::setting(format!(
                    "expected each fault once, got {item:?} again; name it once"
                )));
            }
            faults.set(fault, value, item)?;
        }
        Ok(faults)
    }

    fn set(&mut self, fault: Fault, value: &str, item: &str) -> Result<()> {
        let (rate, seconds) = match value.split_once(':') {
            Some((rate, seconds)) => (rate, Some(seconds)),
            None => (value, None),
        };
        self.rates[fault as usize] = number(rate)
            .filter(|rate| (0.0..=1.0).contains(rate))
            .ok_or_else(|| malformed(item))?;
        if let Some(seconds) = seconds {
            let seconds = number(seconds).filter(|&s| s > 0.0 && s <= 60.0);
            let known = seconds.filter(|_| fault.lasts().is_some());
            let seconds = known.ok_or_else(|| malformed(item))?;
            self.durations[fault as usize] = Duration::from_secs_f64(seconds);
        }
        Ok(())
    }

    /// The probability of a kind per frame.
    pub fn rate(&self, fault: Fault) -> f64 {
        self.rates[fault as usize]
    }

    /// How long a kind lasts; zero if it takes no time.
    pub fn duration(&self, fault: Fault) -> Duration {
        self.durations[fault as usize]
    }
}

fn number(text: &str) -> Option<f64> {
    text.trim().parse().ok()
}

fn malformed(item: &str) -> Error {
    Error::setting(format!(
        "expected faults as KIND=RATE with a rate from 0 to 1 per frame, or KIND=RATE:SECONDS (up to 60) for delay, stall and \
         unplug, got {item:?}; for example drop=0.001,stall=1e-4:0.2"
    ))
}

/// The faults of one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fate {
    /// The fault of the frame itself, at most one.
    pub frame: Option<Fault>,
    /// The faults of the link or the device at that moment.
    pub events: [Option<Fault>; 3],
    /// Chooses the bit of a flip.
    pub chance: u64,
}

/// Draws the faults of each frame of one direction.
#[derive(Clone, Debug)]
pub struct Injector {
    faults: Faults,
    random: Random,
    quiet: bool,
}

impl Injector {
    /// `stream` distinguishes the directions.
    pub fn new(faults: Faults, seed: u64, stream: u64) -> Self {
        Self {
            faults,
            random: Random::stream(seed, stream),
            quiet: faults.rates.iter().all(|&rate| rate == 0.0),
        }
    }

    /// The faults of the next frame; always uses as many random numbers, so the result depends only on the frame's index.
    pub fn next(&mut self) -> Fate {
        if self.quiet {
            return Fate::default();
        }
        let hits = Fault::ALL.map(|fault| {
            let hit = self.random.uniform() < self.faults.rate(fault);
            hit.then_some(fault)
        });
        let [frame @ .., stall, reset, unplug] = hits;
        Fate {
            frame: frame.into_iter().flatten().next(),
            events: [stall, reset, unplug],
            chance: self.random.next_u64(),
        }
    }
}

/// Counts by direction and kind.
pub type Counts = [[u64; KINDS]; 2];

/// The counts of faults, and the file that lists each of them.
#[derive(Debug, Default)]
pub struct FaultLog {
    counts: Counts,
    file: Option<LineWriter<File>>,
    /// The device's time, for the lines.
    pub time: u64,
    /// Why the file ended early.
    pub broken: Option<String>,
}

impl FaultLog {
    /// With a file if `path` names one.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn new(path: Option<&Path>) -> io::Result<Self> {
        let file = path.map(File::create).transpose()?;
        Ok(Self {
            file: file.map(LineWriter::new),
            ..Self::default()
        })
    }

    /// Counts of all faults so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// The count of one kind in one direction.
    #[cfg(test)]
    pub fn count(&self, fault: Fault, direction: Direction) -> u64 {
        self.counts[direction as usize][fault as usize]
    }

    /// Records a fault of `frame`, given as it was before.
    pub fn record(&mut self, fault: Fault, direction: Direction, frame: &[u8]) {
        self.counts[direction as usize][fault as usize] += 1;
        let Some(file) = &mut self.file else { return };
        let header = header(frame);
        let named = header.map_or_else(String::new, |header| {
            format!(
                ",\"kind\":{},\"sequence\":{},\"time\":{}",
                header.kind, header.sequence, header.time
            )
        });
        let line = writeln!(
            file,
            "{{\"fault\":\"{}\",\"direction\":\"{}\",\"device_us\":{}{named}}}",
            fault.name(),
            direction.name(),
            self.time,
        );
        if let Err(error) = line {
            self.broken = Some(error.to_string());
            self.file = None;
        }
    }
}

fn header(mut frame: &[u8]) -> Option<Header> {
    let mut deframer = Deframer::new();
    let frame = deframer.next(&mut frame)?;
    frame.ok().map(|frame| frame.header)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_rates_and_durations() {
        let faults = Faults::parse("drop=.001,flip=1e-4 , stall=1e-4:0.5,").unwrap();
        assert_eq!(faults.rate(Fault::Flip), 1e-4);
        assert_eq!(faults.duration(Fault::Stall), Duration::from_millis(500));
        assert_eq!(faults.duration(Fault::Unplug), Duration::from_millis(300));
        assert_eq!(Faults::parse("").unwrap(), Faults::default());
    }

    #[test]
    fn refuses_what_it_cannot_mean() {
        for text in [
            "drop",
            "drop=2",
            "drop=-1",
            "drop=nan",
            "drop=x",
            "drip=.1",
            "drop=.1:1",
            "stall=.1:0",
            "stall=.1:inf",
            "stall=.1:61",
            "drop=.1,drop=.2",
        ] {
            let message = Faults::parse(text).unwrap_err().message;
            assert!(message.contains("expected"), "{text}: {message}");
        }
    }

    #[test]
    fn has_its_rates_and_repeats_for_a_seed() {
        let faults = Faults::parse("drop=.1,flip=.2,reset=.05").unwrap();
        let draw = |seed, stream| {
            let mut injector = Injector::new(faults, seed, stream);
            (0..20_000).map(|_| injector.next()).collect::<Vec<_>>()
        };
        let fates = draw(3, 0);
        assert_eq!(fates, draw(3, 0));
        assert_ne!(fates, draw(4, 0));
        assert_ne!(fates, draw(3, 1));
        let share = |wanted: fn(&Fate) -> bool| {
            fates.iter().filter(|fate| wanted(fate)).count() as f64 / fates.len() as f64
        };
        assert!((share(|fate| fate.frame == Some(Fault::Drop)) - 0.1).abs() < 0.01);
        // no flip is drawn for a dropped frame
        assert!((share(|fate| fate.frame == Some(Fault::Flip)) - 0.18).abs() < 0.01);
        assert!((share(|fate| fate.events[1].is_some()) - 0.05).abs() < 0.01);
    }
}
