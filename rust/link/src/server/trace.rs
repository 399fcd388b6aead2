//! The server's own log: when the output was switched on and off, and when the last heartbeat before that had arrived.

use std::fs::File;
use std::io::{self, LineWriter, Write};
use std::path::Path;
use std::time::Instant;

use sewfast_control::link::{Deframer, Fields, State};

use super::rig::Clock;

/// A logged event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Happening {
    /// The output was enabled.
    On,
    /// The output was made safe.
    Off,
    /// A host came.
    Connected,
    /// The host went.
    Gone,
    /// Nothing passes from now on.
    Stalled,
    /// The port vanished.
    Unplugged,
    /// The port came back.
    Plugged,
    /// The device rebooted.
    Reset,
}

impl Happening {
    /// Its name in the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::On => "on",
            Self::Off => "off",
            Self::Connected => "connected",
            Self::Gone => "gone",
            Self::Stalled => "stalled",
            Self::Unplugged => "unplugged",
            Self::Plugged => "plugged",
            Self::Reset => "reset",
        }
    }
}

/// The last intact frame with a watchdog time that reached the device since its boot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heartbeat {
    /// Time of arrival by the device's clock [us].
    pub device_us: u64,
    /// Time of arrival in seconds since the server began.
    pub seconds: f64,
    /// Its watchdog time [us].
    pub watchdog_us: u32,
}

/// One line of the log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Entry {
    /// The event.
    pub happening: Happening,
    /// Its time by the device's clock [us].
    pub device_us: u64,
    /// Its time in seconds since the server began.
    pub seconds: f64,
    /// The device's state after it.
    pub state: u8,
    /// The last heartbeat before it.
    pub heartbeat: Option<Heartbeat>,
    /// Largest delay of the server since that heartbeat and at this entry, from the samples that it had to catch up
    /// with [us]. The device's clock does not show it, because the server drives that clock.
    pub late_us: u64,
}

impl Entry {
    fn json(&self) -> String {
        let heartbeat = self.heartbeat.map_or_else(String::new, |h| {
            format!(
                ",\"heartbeat_us\":{},\"heartbeat_seconds\":{:.6},\"watchdog_us\":{}",
                h.device_us, h.seconds, h.watchdog_us
            )
        });
        format!(
            "{{\"event\":\"{}\",\"device_us\":{},\"seconds\":{:.6},\"state\":{},\"late_us\":{}{heartbeat}}}",
            self.happening.name(),
            self.device_us,
            self.seconds,
            self.state,
            self.late_us,
        )
    }
}

/// The growing log. It finds heartbeats with its own receiver instead of asking the device that it watches.
#[derive(Debug)]
pub struct Trace {
    began: Instant,
    entries: Vec<Entry>,
    file: Option<LineWriter<File>>,
    deframer: Deframer,
    /// Session of the last HELLO.
    session: u32,
    heartbeat: Option<Heartbeat>,
    /// Largest delay since that heartbeat.
    late_us: u64,
    enabled: bool,
    /// Why the file ended early.
    pub broken: Option<String>,
}

impl Trace {
    /// With a file if `path` names one.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn new(path: Option<&Path>, began: Instant) -> io::Result<Self> {
        let file = path.map(File::create).transpose()?;
        Ok(Self {
            began,
            entries: Vec::new(),
            file: file.map(LineWriter::new),
            deframer: Deframer::new(),
            session: 0,
            heartbeat: None,
            late_us: 0,
            enabled: false,
            broken: None,
        })
    }

    /// Takes the entries since the last call.
    pub fn fresh(&mut self) -> impl Iterator<Item = Entry> + '_ {
        self.entries.drain(..)
    }

    /// Notes that the server is late by this much.
    #[inline]
    pub fn late(&mut self, late_us: u64) {
        self.late_us = self.late_us.max(late_us);
    }

    /// Looks at bytes that reach the device of boot id `boot_id` at `device_us` and arrived some time within the last `late_us`.
    pub fn observe(
        &mut self,
        mut bytes: &[u8],
        boot_id: u32,
        device_us: u64,
        late_us: u64,
        now: Instant,
    ) {
        let seconds = self.seconds(now);
        while let Some(frame) = self.deframer.next(&mut bytes) {
            let Ok(frame) = frame else { continue };
            let mut body = Fields::new(frame.body);
            if frame.header.kind == 0x01 {
                self.session = body.take(2).and_then(|_| body.u32()).unwrap_or(0);
            }
            if frame.header.tag != boot_id as u16 || frame.header.session() != self.session {
                continue;
            }
            let watchdog_us = match frame.header.kind {
                0x05 | 0x20..=0x22 => body.u32(),
                0x0A => body.u8().and_then(|_| body.u32()),
                _ => None,
            };
            if let Some(watchdog_us) = watchdog_us {
                self.heartbeat = Some(Heartbeat {
                    device_us,
                    seconds,
                    watchdog_us,
                });
                self.late_us = late_us;
            }
        }
    }

    /// Notes a change of the output.
    #[inline]
    pub fn output(&mut self, enabled: bool, device_us: u64, clock: &Clock, state: State) {
        if enabled != self.enabled {
            self.enabled = enabled;
            let change = if enabled {
                Happening::On
            } else {
                Happening::Off
            };
            self.note(change, device_us, clock, state);
        }
    }

    /// Notes any event at `device_us`; `clock` may be ahead of that.
    pub fn note(&mut self, happening: Happening, device_us: u64, clock: &Clock, state: State) {
        let now = Instant::now();
        self.late(clock.read(now).saturating_sub(device_us));
        let entry = Entry {
            happening,
            device_us,
            seconds: self.seconds(now),
            state: state as u8,
            heartbeat: self.heartbeat,
            late_us: self.late_us,
        };
        self.entries.push(entry);
        if let Some(file) = &mut self.file
            && let Err(error) = writeln!(file, "{}", entry.json())
        {
            self.broken = Some(error.to_string());
            self.file = None;
        }
    }

    /// Forgets the heartbeats of the previous boot.
    pub fn rebooted(&mut self) {
        self.heartbeat = None;
        self.late_us = 0;
        self.enabled = false;
    }

    fn seconds(&self, now: Instant) -> f64 {
        now.saturating_duration_since(self.began).as_secs_f64()
    }
}
