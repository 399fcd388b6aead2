//! The device's answer to STATUS: what it says of the run that has ended.

use sewfast_control::link::Fields;

/// Fields of the reply that concern the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Status {
    /// The device's state.
    pub state: u8,
    /// Reason of its last trip.
    pub reason: u8,
    /// Samples taken in the run.
    pub samples: u32,
    /// Frames that it received.
    pub received: u32,
    /// Frames that it refused.
    pub refused: u32,
    /// Frames that it dropped, as its transmit memory was full.
    pub dropped: u32,
    /// Its latest control period \[us late\].
    pub late: u32,
}

impl Status {
    /// The fields of a reply's body after sequence and result; none where the body is too short.
    pub fn of(fields: &mut Fields<'_>) -> Option<Self> {
        let (state, reason) = (fields.u8()?, fields.u8()?);
        // mode, mask, run, start
        fields.take(1 + 2 + 4 + 8)?;
        let samples = fields.u32()?;
        // length, end of the profile, speed, counts
        fields.take(4 * 4)?;
        Some(Self {
            state,
            reason,
            samples,
            received: fields.u32()?,
            refused: fields.u32()?,
            dropped: fields.u32()?,
            late: fields.u32()?,
        })
    }
}
