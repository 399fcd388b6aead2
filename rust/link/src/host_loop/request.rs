//! A command under way: repeated unchanged until its reply comes or it is given up.

use sewfast_control::link::Body;

/// How long a reply is waited for before the command is repeated \[us\].
pub const PATIENCE: u64 = 100_000;
/// How often a command is sent before it is given up.
pub const TRIES: u32 = 10;

/// One command and how often it has been sent.
#[derive(Clone, Copy, Debug)]
pub struct Request {
    /// The command.
    pub kind: u8,
    /// Its number in the session.
    pub sequence: u32,
    /// Its fields.
    pub body: Body,
    /// How often it has been sent.
    pub sent: u32,
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

    /// When it is to be sent again, or given up \[us\].
    pub fn due(&self) -> u64 {
        if self.sent == 0 {
            0
        } else {
            self.at.saturating_add(PATIENCE)
        }
    }

    /// True once the last try has waited long enough.
    pub fn exhausted(&self, now: u64) -> bool {
        self.sent >= TRIES && now >= self.due()
    }
}
