//! A command under way: repeated unchanged until its reply comes or it is given up.

use sewfast_control::link::Body;

use super::kind;

/// How long a reply is waited for before a command is repeated \[us\].
const REPEAT: u64 = 100_000;
/// The same for STOP, within any usual watchdog time.
const STOP_REPEAT: u64 = 10_000;
/// How long a command is repeated before it is given up, where the watchdog's time is not longer \[us\].
const PATIENCE: u64 = 1_000_000;

/// One command and when it was sent.
#[derive(Clone, Copy, Debug)]
pub struct Request {
    /// The command.
    pub kind: u8,
    /// Its number in the session.
    pub sequence: u32,
    /// Its fields.
    pub body: Body,
    /// How often it has been sent.
    pub sent: u64,
    /// When it was last sent \[us\].
    pub at: u64,
}

impl Request {
    /// A command that has not been sent.
    pub fn new(kind: u8, sequence: u32, body: Body) -> Self {
        Self {
            kind,
            sequence,
            body,
            sent: 0,
            at: 0,
        }
    }

    fn repeat(&self) -> u64 {
        if self.kind == kind::STOP {
            STOP_REPEAT
        } else {
            REPEAT
        }
    }

    /// When it is to be sent again, or given up \[us\].
    pub fn due(&self) -> u64 {
        if self.sent == 0 {
            0
        } else {
            self.at.saturating_add(self.repeat())
        }
    }

    /// True once the last try has waited long enough; STOP is repeated for as long as the `watchdog` lets the motor turn \[us\].
    pub fn exhausted(&self, now: u64, watchdog: u32) -> bool {
        let tries = PATIENCE.max(watchdog.into()) / self.repeat();
        self.sent >= tries && now >= self.due()
    }
}
