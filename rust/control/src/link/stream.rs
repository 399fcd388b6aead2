//! Data on its way to the host: the batch of samples being filled, and the ring of frames waiting for the port.

use super::identity::{Channel, Encoding, Source};
use super::{Body, Header, MAX_BODY, MAX_WIRE, encode};

/// A command of this batch was clipped.
const CLIPPED: u8 = 1;
/// The transmit memory has overflowed since the last batch.
const OVERFLOWED: u8 = 2;

/// The batch in progress, channel by channel.
#[derive(Clone, Debug)]
pub(super) struct Stream {
    channels: &'static [Channel],
    mask: u16,
    batch: usize,
    taken: usize,
    time: u64,
    counts: i32,
    clipped: bool,
    columns: [u8; MAX_BODY - 1],
}

impl Stream {
    pub(super) const fn new(channels: &'static [Channel]) -> Self {
        Self {
            channels,
            mask: 1,
            batch: 1,
            taken: 0,
            time: 0,
            counts: 0,
            clipped: false,
            columns: [0; MAX_BODY - 1],
        }
    }

    /// The channels of a mask; the counts are always among them.
    fn chosen(&self, mask: u16) -> impl Iterator<Item = &'static Channel> + use<> {
        let bits = (0..16).map(move |bit| (mask | 1) >> bit & 1 == 1);
        let channels = self.channels.iter().zip(bits);
        channels.filter_map(|(channel, on)| on.then_some(channel))
    }

    /// Whether the mask names existing channels only.
    pub(super) fn knows(&self, mask: u16) -> bool {
        u32::from(mask) >> self.channels.len().min(16) == 0
    }

    /// Whether a batch fits a frame.
    pub(super) fn fits(&self, mask: u16, batch: u8) -> bool {
        let size = |channel: &Channel| channel.encoding.size(batch.into());
        batch > 0 && self.chosen(mask).map(size).sum::<usize>() < MAX_BODY
    }

    /// Begins a run.
    pub(super) fn begin(&mut self, mask: u16, batch: u8) {
        self.mask = mask | 1;
        self.batch = batch.into();
        self.empty();
    }

    /// The mask in force.
    pub(super) fn mask(&self) -> u16 {
        self.mask
    }

    /// Whether nothing is waiting.
    pub(super) fn is_empty(&self) -> bool {
        self.taken == 0
    }

    /// Whether the batch has all its samples.
    pub(super) fn is_full(&self) -> bool {
        self.taken >= self.batch
    }

    /// Whether a sample with these counts can join the batch.
    pub(super) fn accepts(&self, counts: i32) -> bool {
        let difference = counts.wrapping_sub(self.counts);
        self.is_empty() || !self.is_full() && i16::try_from(difference).is_ok()
    }

    /// Time of the first sample.
    pub(super) fn time(&self) -> u64 {
        self.time
    }

    /// Adds a sample that [`accepts`](Self::accepts) has allowed.
    pub(super) fn push(
        &mut self,
        time: u64,
        counts: i32,
        clipped: bool,
        value: impl Fn(Source) -> f32,
    ) {
        if self.is_empty() {
            self.time = time;
        }
        let mut column = 0;
        for channel in self.chosen(self.mask) {
            let at = column + channel.encoding.size(self.taken);
            match channel.encoding {
                Encoding::Counts if self.is_empty() => self.write(at, counts.to_le_bytes()),
                Encoding::Counts => {
                    let difference = counts.wrapping_sub(self.counts) as i16;
                    self.write(at, difference.to_le_bytes());
                }
                Encoding::Steps => {
                    let steps = to_steps(value(channel.source), channel.steps_per_unit);
                    self.write(at, steps.to_le_bytes());
                }
                Encoding::Float => self.write(at, value(channel.source).to_le_bytes()),
            }
            column += channel.encoding.size(self.batch);
        }
        self.counts = counts;
        self.clipped |= clipped;
        self.taken += 1;
    }

    fn write<const N: usize>(&mut self, at: usize, bytes: [u8; N]) {
        let place = self.columns.get_mut(at..);
        if let Some(place) = place.and_then(|place| place.first_chunk_mut()) {
            *place = bytes;
        }
    }

    /// Writes the batch to the body; the batch is empty afterwards.
    pub(super) fn flush(&mut self, overflowed: bool, body: &mut Body) {
        let flag = |on, bit| if on { bit } else { 0 };
        body.u8(flag(self.clipped, CLIPPED) | flag(overflowed, OVERFLOWED));
        let mut column = 0;
        for channel in self.chosen(self.mask) {
            let end = column + channel.encoding.size(self.taken);
            body.add(self.columns.get(column..end).unwrap_or(&[]));
            column += channel.encoding.size(self.batch);
        }
        self.empty();
    }

    fn empty(&mut self) {
        self.taken = 0;
        self.clipped = false;
    }
}

/// The nearest step, or the end of the range; NaN is 0.
pub(super) fn to_steps(value: f32, steps_per_unit: u32) -> i16 {
    let steps = value * steps_per_unit as f32;
    (steps + 0.5f32.copysign(steps)) as i16
}

/// A ring of whole frames as sent; a frame that does not fit is dropped, but its number is used up.
#[derive(Clone, Debug)]
pub(super) struct Transmit<const SIZE: usize> {
    bytes: [u8; SIZE],
    first: usize,
    length: usize,
    tag: u16,
    sequence: u32,
    dropped: u32,
    /// Whether a frame was dropped since this was last cleared.
    pub(super) overflowed: bool,
}

/// Which frames may be lost so that a reply finds room.
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

    /// Sets the tag of all frames; sends a zero first, as the reset may have cut a frame short.
    pub(super) fn boot(&mut self, tag: u16) {
        self.tag = tag;
        self.append(&[0]);
    }

    /// Frames dropped since boot.
    pub(super) fn dropped(&self) -> u32 {
        self.dropped
    }

    /// Takes a frame; returns whether it found room. Streams leave room for a reply.
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

    /// Moves the oldest bytes to `out`; returns how many.
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
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::super::{Deframer, Fields};
    use super::*;

    const fn channel(encoding: Encoding, source: Source) -> Channel {
        Channel {
            encoding,
            steps_per_unit: 1000,
            name: "x",
            unit: "V",
            source,
        }
    }

    static CHANNELS: [Channel; 4] = [
        channel(Encoding::Counts, Source::Counts),
        channel(Encoding::Steps, Source::Command),
        channel(Encoding::Float, Source::Current),
        channel(Encoding::Counts, Source::Counts),
    ];

    #[test]
    fn ten_samples_of_counts_and_command_take_43_bytes() {
        let mut stream = Stream::new(&CHANNELS);
        stream.begin(0b11, 10);
        for k in 0..10 {
            assert!(!stream.is_full() && stream.accepts(k));
            stream.push(1000 * k as u64, k, k == 5, |_| 1.0);
        }
        assert!(stream.is_full());
        let mut body = Body::new();
        stream.flush(false, &mut body);
        assert_eq!((body.len(), body.bytes().unwrap()[0]), (43, CLIPPED));
    }

    #[test]
    fn batches_that_fit_a_frame() {
        let stream = Stream::new(&CHANNELS);
        assert!(stream.fits(0b1, 114) && !stream.fits(0b1, 115));
        assert!(stream.fits(0b10, 57) && !stream.fits(0b10, 58) && !stream.fits(0b10, 0));
        assert!(stream.knows(0b1111) && !stream.knows(0b1_0000));
    }

    #[test]
    fn steps_are_the_nearest_and_end_at_the_ends() {
        let cases = [
            (0.0014, 1),
            (0.0016, 2),
            (-0.0016, -2),
            (1e9, i16::MAX),
            (-1e9, i16::MIN),
        ];
        for (value, steps) in cases {
            assert_eq!(to_steps(value, 1000), steps);
        }
        assert_eq!(to_steps(f32::NAN, 1000), 0);
        for steps in i16::MIN..=i16::MAX {
            assert_eq!(to_steps(f32::from(steps) / 1000.0, 1000), steps);
        }
    }

    /// Samples of one batch, read back.
    fn read(body: &[u8], samples: usize) -> Vec<(i32, i16, f32)> {
        let mut fields = Fields::new(body);
        fields.u8();
        let counts = |fields: &mut Fields<'_>| -> Vec<i32> {
            let first = fields.i32().unwrap();
            let rest = (1..samples).scan(first, |count, _| {
                *count = count.wrapping_add(fields.i16().unwrap().into());
                Some(*count)
            });
            [first]
                .into_iter()
                .chain(rest.collect::<Vec<_>>())
                .collect()
        };
        let first = counts(&mut fields);
        let steps: Vec<i16> = (0..samples).map(|_| fields.i16().unwrap()).collect();
        let floats: Vec<f32> = (0..samples).map(|_| fields.f32().unwrap()).collect();
        assert_eq!(counts(&mut fields), first);
        assert_eq!(fields.end(), Some(()));
        (0..samples)
            .map(|k| (first[k], steps[k], floats[k]))
            .collect()
    }

    proptest! {
        #[test]
        fn what_goes_in_comes_out(
            samples in prop::collection::vec((any::<i16>(), any::<bool>(), -30_000i16..30_000), 1..60),
            batch in 1u8..20,
        ) {
            let mut stream = Stream::new(&CHANNELS);
            stream.begin(0xF, batch);
            let (mut counts, mut sent, mut back) = (i32::MAX - 5, Vec::new(), Vec::new());
            let mut body = Body::new();
            let mut flush = |stream: &mut Stream| {
                let held = stream.taken;
                stream.flush(false, &mut body);
                back.extend(read(body.bytes().unwrap(), held));
                body.clear();
            };
            for (move_by, jump, u) in samples {
                counts = counts.wrapping_add(i32::from(move_by) * if jump { 50_000 } else { 1 });
                if !stream.accepts(counts) {
                    flush(&mut stream);
                }
                let u = f32::from(u) / 1000.0;
                stream.push(0, counts, false, |_| u);
                sent.push((counts, (u * 1000.0).round() as i16, u));
            }
            if !stream.is_empty() {
                flush(&mut stream);
            }
            prop_assert_eq!(back, sent);
        }
    }

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
