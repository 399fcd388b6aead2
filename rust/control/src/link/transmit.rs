//! Frames that wait for the port.

use super::{Header, MAX_WIRE, encode};

/// A ring of whole frames as they go on the wire; one that does not fit is dropped and its number used up.
#[derive(Clone, Debug)]
pub(super) struct Transmit<const SIZE: usize> {
    bytes: [u8; SIZE],
    first: usize,
    length: usize,
    tag: u16,
    sequence: u32,
    dropped: u32,
    /// A frame was dropped since this was last taken back.
    pub(super) overflowed: bool,
}

/// What may be lost rather than keep a reply from its place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Weight {
    Stream,
    Answer,
}

impl<const SIZE: usize> Transmit<SIZE> {
    pub(super) const fn new() -> Self {
        const { assert!(SIZE >= 2 * MAX_WIRE, "room for a reply beside a batch") };
        Self {
            bytes: [0; SIZE],
            first: 0,
            length: 0,
            tag: 0,
            sequence: 0,
            dropped: 0,
            overflowed: false,
        }
    }

    /// Sets the tag of all frames; a zero goes first, as one may have been cut short by the reset.
    pub(super) fn boot(&mut self, tag: u16) {
        self.tag = tag;
        self.append(&[0]);
    }

    /// Frames dropped since boot.
    pub(super) fn dropped(&self) -> u32 {
        self.dropped
    }

    /// Takes a frame; whether it found room. Streams leave room for a reply.
    pub(super) fn send(&mut self, weight: Weight, kind: u8, time: u64, body: &[u8]) -> bool {
        let header = Header {
            kind,
            tag: self.tag,
            sequence: self.sequence,
            time,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let reserve = if weight == Weight::Stream {
            MAX_WIRE
        } else {
            0
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body, &mut wire).unwrap_or(usize::MAX);
        let room = SIZE.saturating_sub(self.length).saturating_sub(reserve);
        let frame = wire.get(..length).filter(|_| length <= room);
        match frame {
            Some(frame) => self.append(frame),
            None => {
                self.dropped = self.dropped.wrapping_add(1);
                self.overflowed = true;
            }
        }
        frame.is_some()
    }

    fn append(&mut self, frame: &[u8]) {
        let start = self.first.wrapping_add(self.length) % SIZE;
        let (before, after) = self.bytes.split_at_mut_checked(start).unwrap_or_default();
        for (slot, byte) in after.iter_mut().chain(before).zip(frame) {
            *slot = *byte;
        }
        self.length = self.length.wrapping_add(frame.len());
    }

    /// Moves the oldest bytes to `out`; how many.
    pub(super) fn take(&mut self, out: &mut [u8]) -> usize {
        let count = self.length.min(out.len());
        let (before, after) = self.bytes.split_at_checked(self.first).unwrap_or_default();
        let waiting = after.iter().chain(before).take(count);
        for (slot, byte) in out.iter_mut().zip(waiting) {
            *slot = *byte;
        }
        self.first = self.first.wrapping_add(count) % SIZE;
        self.length = self.length.wrapping_sub(count);
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::Deframer;
    use proptest::prelude::*;
    use std::vec::Vec;

    proptest! {
        /// Frames come out whole and in order, and a missing number is a dropped frame.
        #[test]
        fn loses_whole_frames_only(
            steps in prop::collection::vec((0usize..232, any::<bool>(), 0usize..600), 1..200),
        ) {
            let mut transmit = Transmit::<1024>::new();
            let mut deframer = Deframer::new();
            let (mut accepted, mut came, mut dropped) = (Vec::new(), Vec::new(), 0);
            for (sequence, (length, stream, take)) in steps.into_iter().enumerate() {
                let weight = if stream { Weight::Stream } else { Weight::Answer };
                if transmit.send(weight, 0xC0, 5, &[sequence as u8; 231][..length]) {
                    accepted.push((sequence as u32, length));
                } else {
                    dropped += 1;
                }
                let mut out = [0; 600];
                let count = transmit.take(&mut out[..take]);
                let mut bytes = &out[..count];
                while let Some(frame) = deframer.next(&mut bytes) {
                    let frame = frame.unwrap();
                    came.push((frame.header.sequence, frame.body.len()));
                }
            }
            prop_assert_eq!(&came[..], &accepted[..came.len()]);
            prop_assert_eq!(transmit.dropped(), dropped);
            prop_assert_eq!(transmit.overflowed, dropped > 0);
        }
    }

    #[test]
    fn a_stream_leaves_room_for_a_reply() {
        let mut transmit = Transmit::<1024>::new();
        while transmit.send(Weight::Stream, 0xC0, 0, &[0; 43]) {}
        assert!(transmit.send(Weight::Answer, 0x83, 0, &[0; 231]));
    }
}
