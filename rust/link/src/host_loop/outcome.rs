//! How a loop on the host ended.

/// The ends that a loop knows; the samples up to there are kept in every one.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The whole reference was run.
    Completed,
    /// A stop was asked for.
    Interrupted,
    /// The device tripped, for this reason of the protocol; what passed the limit, where the device's event came through.
    Tripped {
        /// The protocol's number of the reason.
        reason: u8,
        /// What passed the limit; NaN where that is not known.
        value: f32,
    },
    /// The device ended the run before the reference did.
    Ended,
    /// The device refused a command.
    Refused {
        /// Kind of the command.
        command: u8,
        /// The protocol's number of the result.
        result: u8,
        /// What the result says more.
        detail: u32,
    },
    /// A command of this kind was repeated and never answered.
    Unanswered(u8),
    /// No sample came within the watchdog time.
    Silent,
    /// The device has reset.
    Reset,
    /// The port failed, in the system's words.
    PortLost(String),
}

impl Outcome {
    /// A name for files and bindings.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::Interrupted => "interrupted",
            Self::Tripped { .. } => "tripped",
            Self::Ended => "ended",
            Self::Refused { .. } => "refused",
            Self::Unanswered(_) => "unanswered",
            Self::Silent => "silent",
            Self::Reset => "reset",
            Self::PortLost(_) => "port_lost",
        }
    }
}
