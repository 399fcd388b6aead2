//! What was injected: counts by kind and way, and a line of JSON for each.

use std::fs::File;
use std::io::{self, LineWriter, Write};
use std::path::Path;

use sewfast_control::link::{Deframer, Header};

use super::faults::{Fault, KINDS};
use super::line::Direction;

/// Counts by way and kind.
pub type Counts = [[u64; KINDS]; 2];

/// The count of faults, and the file that names each one.
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
    /// With a file where `path` names one.
    ///
    /// # Errors
    /// Where the file cannot be made.
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

    /// A fault that befell `frame`, as it was before.
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
