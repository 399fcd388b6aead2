//! The states of a device, the reasons to leave them, the events on the way.

/// What the device is about; values as in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Waits for ten good samples in a row.
    Boot = 0,
    /// Safe.
    Idle = 1,
    /// Safe, ready to start.
    Armed = 2,
    /// Commands.
    Running = 3,
    /// Safe until cleared.
    Tripped = 4,
}

/// Why a run ended before its time; values as in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// It did not.
    None = 0,
    /// The host fell silent.
    Watchdog = 1,
    /// Too fast.
    Speed = 2,
    /// Too fast a change of speed.
    Acceleration = 3,
    /// Too much current.
    Current = 4,
    /// The profile ran dry before its end.
    Underrun = 5,
    /// A command was refused while running.
    BadCommand = 6,
    /// Another host said HELLO while running.
    HostChanged = 7,
    /// A measurement was not finite.
    Measurement = 8,
    /// A large command moved nothing.
    NoMotion = 9,
    /// The firmware's stop input.
    StopInput = 10,
    /// A control period was late, early or lost.
    Late = 11,
    /// The command of a loop swings between its limits.
    Swinging = 12,
}

/// What is worth a frame of its own; values as in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Event {
    Boot = 1,
    Armed = 2,
    Started = 3,
    Finished = 4,
    Stopped = 5,
    Tripped = 6,
    Cleared = 7,
}
