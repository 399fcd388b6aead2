//! A run's values in the device's encoding, uploaded piece by piece ahead of playback.

use sewfast_control::link::{Body, MAX_BODY};

use crate::bodies;

/// Results of UPLOAD that do not mean wrong values: not in this state (the run has ended), no room yet, and the number
/// at which the device wants to continue.
const NOT_NOW: u8 = 4;
const NO_ROOM: u8 = 7;
const OUT_OF_ORDER: u8 = 9;
/// Bytes of UPLOAD before its values: table and offset.
const HEAD: usize = 5;

/// Values in the device's steps, and how many have been uploaded.
#[derive(Clone, Debug)]
pub struct Upload {
    table: u8,
    width: usize,
    bytes: Vec<u8>,
    end: usize,
}

impl Upload {
    /// Commands, rounded to steps of the device's command channel and then clipped to `limit`.
    ///
    /// ```
    /// use sewfast_link::Upload;
    ///
    /// let upload = Upload::commands(&[0.0, 1.0004, -2.0], 1000, 1.5);
    /// let body = upload.piece(100).unwrap_or_default();
    /// assert_eq!(body.bytes(), Some(&[0, 0, 0, 0, 0, 0, 0, 0xE8, 3, 0x24, 0xFA][..]));
    /// ```
    #[must_use]
    pub fn commands(values: &[f64], steps_per_unit: u32, limit: f64) -> Self {
        let top = f64::from((limit as f32 * steps_per_unit as f32).floor());
        let steps = |&value: &f64| {
            let step = (value * f64::from(steps_per_unit)).round_ties_even();
            (step.max(-top).min(top) as i16).to_le_bytes()
        };
        Self::new(0, values.iter().map(steps))
    }

    /// References in single precision, clipped to `limit`.
    #[must_use]
    pub fn references(values: &[f64], limit: f64) -> Self {
        let single = |&value: &f64| (value.max(-limit).min(limit) as f32).to_le_bytes();
        Self::new(1, values.iter().map(single))
    }

    /// Goals in single precision \[counts\].
    #[must_use]
    pub fn goals(values: &[f64]) -> Self {
        let single = |&value: &f64| (value as f32).to_le_bytes();
        Self::new(2, values.iter().map(single))
    }

    fn new<const N: usize>(table: u8, values: impl Iterator<Item = [u8; N]>) -> Self {
        Self {
            table,
            width: N,
            bytes: values.flatten().collect(),
            end: 0,
        }
    }

    /// Number of values that the device has.
    pub const fn end(&self) -> usize {
        self.end
    }

    /// Number of all values.
    pub fn len(&self) -> usize {
        self.bytes.len() / self.width
    }

    /// Whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Whether the device has all of them.
    pub fn is_whole(&self) -> bool {
        self.end >= self.len()
    }

    /// Body of the next UPLOAD, if there is room for a full frame or for the rest.
    pub fn piece(&self, room: usize) -> Option<Body> {
        let left = self.bytes.get(self.width * self.end..)?;
        let length = left.len().min((MAX_BODY - HEAD) / self.width * self.width);
        let piece = left.get(..length).filter(|piece| !piece.is_empty())?;
        if room < length / self.width {
            return None;
        }
        Some(bodies::upload(
            self.table,
            u32::try_from(self.end).ok()?,
            piece,
        ))
    }

    /// Takes the reply to an UPLOAD: its end, or where the device wants to continue. False if it refuses the values.
    pub fn answered(&mut self, result: u8, detail: u32, end: Option<u32>) -> bool {
        match (result, end) {
            (0, Some(end)) => self.end = end as usize,
            (OUT_OF_ORDER, _) => self.end = (detail as usize).min(self.len()),
            (NOT_NOW | NO_ROOM, _) => {}
            _ => return false,
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sewfast_control::link::Fields;

    proptest! {
        /// A device that takes what it has room for, and loses or repeats some pieces, gets every value once and in order.
        #[test]
        fn every_value_arrives_once_and_in_order(
            values in prop::collection::vec(-30.0..30.0_f64, 1..600), rooms in prop::collection::vec((0_usize..300, 0_u8..4), 1..60),
        ) {
            let mut upload = Upload::references(&values, 20.0);
            let mut taken: Vec<f32> = Vec::new();
            let steps = rooms.into_iter().chain(std::iter::repeat_n((600, 0), 20));
            for (room, fate) in steps {
                let Some(body) = upload.piece(room) else { continue };
                let mut fields = Fields::new(body.bytes().unwrap());
                prop_assert_eq!((fields.u8(), fields.u32()), (Some(1), Some(upload.end() as u32)));
                let found: Vec<f32> = std::iter::from_fn(|| fields.f32()).collect();
                prop_assert!(found.len() <= room && fields.is_empty());
                let answered = match fate {
                    0 => {
                        taken.extend(found);
                        upload.answered(0, 0, Some(taken.len() as u32))
                    }
                    1 => upload.answered(OUT_OF_ORDER, taken.len() as u32, None),
                    2 => upload.answered(NO_ROOM, 0, None),
                    _ => upload.answered(NOT_NOW, 3, None),
                };
                prop_assert!(answered);
            }
            prop_assert!(upload.is_whole());
            let expected: Vec<f32> = values.iter().map(|v| v.clamp(-20.0, 20.0) as f32).collect();
            prop_assert_eq!(taken, expected);
        }
    }

    #[test]
    fn a_refusal_is_not_taken() {
        let mut upload = Upload::commands(&[1.0; 4], 1000, 10.0);
        assert!(!upload.answered(6, 2, None), "a value beyond a limit");
        assert!(!upload.answered(0, 0, None), "a body that is too short");
        assert_eq!((upload.end(), upload.len()), (0, 4));
        assert!(upload.answered(0, 0, Some(u32::MAX)));
        assert!(upload.is_whole() && upload.piece(9).is_none());
    }

    #[test]
    fn goals_have_a_table_of_their_own() {
        let upload = Upload::goals(&[393.0, -0.5]);
        let body = upload.piece(2).unwrap();
        let mut fields = Fields::new(body.bytes().unwrap());
        assert_eq!((fields.u8(), fields.u32()), (Some(2), Some(0)));
        assert_eq!((fields.f32(), fields.f32()), (Some(393.0), Some(-0.5)));
    }

    #[test]
    fn steps_are_rounded_to_even_and_end_at_the_limit() {
        let upload = Upload::commands(&[0.0005, 0.0015, -0.0025, 9.0, -9.0], 1000, 8.9996);
        let body = upload.piece(5).unwrap();
        let mut fields = Fields::new(body.bytes().unwrap());
        fields.take(HEAD);
        let steps: Vec<i16> = std::iter::from_fn(|| fields.i16()).collect();
        assert_eq!(steps, [0, 2, -2, 8999, -8999]);
    }
}
