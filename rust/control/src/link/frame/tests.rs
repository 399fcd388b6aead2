//! Frames as specified and streams cut anywhere. Damaged frames are refused, hostile bytes do no harm, and one whole
//! frame resynchronises the receiver.

use super::*;
use proptest::prelude::*;
use std::vec::Vec;

/// Made by tests/golden/link_frames.py, which shares no code with this: kind tag sequence time, body, frame, wire.
const GOLDEN: &str = include_str!("../../../../../tests/golden/link_frames.txt");

type Found = Result<(Header, Vec<u8>), Rejected>;

fn wire(header: &Header, body: &[u8]) -> Vec<u8> {
    let mut out = [0; MAX_WIRE];
    let length = encode(header, body, &mut out).unwrap();
    out[..length].into()
}

fn found(deframer: &mut Deframer, mut input: &[u8]) -> Vec<Found> {
    let mut frames = Vec::new();
    while let Some(frame) = deframer.next(&mut input) {
        frames.push(frame.map(|frame| (frame.header, frame.body.into())));
    }
    frames
}

fn hex(text: &str) -> Vec<u8> {
    let digits = text.trim_start_matches('-');
    (0..digits.len())
        .step_by(2)
        .map(|k| u8::from_str_radix(&digits[k..k + 2], 16).unwrap())
        .collect()
}

fn golden() -> impl Iterator<Item = (Header, Vec<u8>, Vec<u8>, Vec<u8>)> {
    let lines = GOLDEN.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| {
        let columns: Vec<&str> = line.split(' ').collect();
        let header = Header {
            kind: columns[0].parse().unwrap(),
            tag: columns[1].parse().unwrap(),
            sequence: columns[2].parse().unwrap(),
            time: columns[3].parse().unwrap(),
        };
        (header, hex(columns[4]), hex(columns[5]), hex(columns[6]))
    })
}

#[test]
fn equals_the_golden_vectors() {
    let mut deframer = Deframer::new();
    for (header, body, frame, bytes) in golden() {
        assert_eq!(wire(&header, &body), bytes);
        assert_eq!(
            Frame::of(&frame).unwrap(),
            Frame {
                header,
                body: &body
            }
        );
        assert_eq!(found(&mut deframer, &bytes), [Ok((header, body))]);
    }
    assert!(golden().count() >= 20);
}

#[test]
fn encodes_nothing_where_there_is_no_room() {
    let header = Header::default();
    assert_eq!(encode(&header, &[0; MAX_BODY + 1], &mut [0; 300]), None);
    assert_eq!(encode(&header, &[1; 10], &mut [0; HEADER + 15]), None);
    assert_eq!(encode(&header, &[1; 10], &mut [0; HEADER + 16]), Some(31));
    assert_eq!(wire(&header, &[7; MAX_BODY]).len(), MAX_WIRE);
}

#[test]
fn says_why_bytes_are_no_frame() {
    let good = wire(&Header::default(), b"body");
    let mut deframer = Deframer::new();
    assert_eq!(found(&mut deframer, &[0, 0, 0]), []);
    assert_eq!(found(&mut deframer, &[5, 1, 0]), [Err(Rejected::Stuffing)]);
    assert_eq!(found(&mut deframer, &[3, 1, 1, 0]), [Err(Rejected::Short)]);
    let mut damaged = good.clone();
    damaged[22] ^= 0x10;
    assert_eq!(found(&mut deframer, &damaged), [Err(Rejected::Checksum)]);
    assert_eq!(found(&mut deframer, &good).len(), 1);
}

#[test]
fn reports_an_overlong_run_at_once_and_skips_to_its_end() {
    let mut deframer = Deframer::new();
    let results: Vec<bool> = (0..600).map(|_| deframer.push(9).is_some()).collect();
    assert_eq!(
        results.iter().position(|&reported| reported),
        Some(MAX_FRAME + 1)
    );
    assert_eq!(results.iter().filter(|&&reported| reported).count(), 1);
    let (header, good) = (Header::default(), wire(&Header::default(), b""));
    assert_eq!(found(&mut deframer, &good), []);
    assert_eq!(found(&mut deframer, &good), [Ok((header, Vec::new()))]);
    let closed: Vec<u8> = [9; 300].iter().chain(&[0]).chain(&good).copied().collect();
    let expected = [Err(Rejected::Overlong), Ok((header, Vec::new()))];
    assert_eq!(found(&mut deframer, &closed), expected);
}

#[test]
fn finds_the_first_zero_wherever_it_is() {
    for length in 0..40 {
        for at in 0..=length {
            let mut bytes = std::vec![0x80u8; length];
            bytes[at.min(length)..]
                .iter_mut()
                .step_by(3)
                .for_each(|byte| *byte = 0);
            bytes[..at].iter_mut().step_by(2).for_each(|byte| *byte = 1);
            assert_eq!(zero(&bytes), (at < length).then_some(at));
        }
    }
}

prop_compose! {
    fn header()(
        kind in any::<u8>(), tag in any::<u16>(), sequence in any::<u32>(), time in any::<u64>(),
    ) -> Header {
        Header { kind, tag, sequence, time }
    }
}

fn body() -> impl Strategy<Value = Vec<u8>> {
    prop::collection::vec(prop_oneof![Just(0u8), any::<u8>()], 0..=MAX_BODY)
}

proptest! {
    #[test]
    fn frames_come_back(frames in prop::collection::vec((header(), body()), 1..6)) {
        let stream: Vec<u8> = frames.iter().flat_map(|(header, body)| wire(header, body)).collect();
        let expected: Vec<Found> = frames.into_iter().map(Ok).collect();
        prop_assert_eq!(found(&mut Deframer::new(), &stream), expected);
    }

    #[test]
    fn overhead_is_two_bytes(header in header(), body in body()) {
        prop_assert_eq!(wire(&header, &body).len(), HEADER + body.len() + 4 + 2);
    }

    #[test]
    fn cutting_a_stream_changes_nothing(
        pieces in prop::collection::vec(prop_oneof![
            (header(), body()).prop_map(|(header, body)| wire(&header, &body)),
            prop::collection::vec(any::<u8>(), 0..30),
            prop::collection::vec(1..=255u8, 0..600),
            Just(std::vec![0, 0]),
        ], 0..8),
        cuts in prop::collection::vec(1..300usize, 1..8),
    ) {
        let stream: Vec<u8> = pieces.concat();
        let whole = found(&mut Deframer::new(), &stream);
        let (mut cut, mut single) = (Deframer::new(), Deframer::new());
        let (mut in_pieces, mut left, mut sizes) = (Vec::new(), &stream[..], cuts.iter().cycle());
        while !left.is_empty() {
            let (piece, rest) = left.split_at(left.len().min(*sizes.next().unwrap()));
            in_pieces.extend(found(&mut cut, piece));
            left = rest;
        }
        let mut by_byte = Vec::new();
        for &byte in &stream {
            by_byte.extend(single.push(byte).map(|f| f.map(|f| (f.header, f.body.to_vec()))));
        }
        prop_assert_eq!(&in_pieces, &whole);
        prop_assert_eq!(&by_byte, &whole);
    }
}

/// Random numbers for tests that need very many: SplitMix64 (Steele, Lea and Flood 2014).
pub(crate) struct Dice(pub u64);

impl Dice {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next()) * n as u128) >> 64) as usize
    }

    pub fn byte(&mut self) -> u8 {
        self.next() as u8
    }

    /// Adds `count` bytes, of which about `zeros` in 8 are zero.
    pub fn bytes(&mut self, out: &mut Vec<u8>, count: usize, zeros: usize) {
        for _ in 0..count {
            let byte = if self.below(8) < zeros {
                0
            } else {
                self.byte()
            };
            out.push(byte);
        }
    }
}

/// `short` in every run of the tests, `soak` if SEWFAST_SOAK is set.
pub(crate) fn trials(short: u64, soak: u64) -> u64 {
    if std::env::var_os("SEWFAST_SOAK").is_some() {
        soak
    } else {
        short
    }
}

type Copied = (Header, Vec<u8>);

fn random_header(dice: &mut Dice) -> Header {
    Header {
        kind: dice.byte(),
        tag: dice.next() as u16,
        sequence: dice.next() as u32 >> (8 * dice.below(4)),
        time: dice.next() >> (8 * dice.below(8)),
    }
}

/// Mostly as short as real ones; bodies of samples and commands contain many zeros.
fn random_frame(dice: &mut Dice) -> Copied {
    let length = match dice.below(8) {
        0 => dice.below(MAX_BODY + 1),
        1 => 0,
        _ => dice.below(48),
    };
    let (mut body, zeros) = (Vec::with_capacity(length), dice.below(5));
    dice.bytes(&mut body, length, zeros);
    (random_header(dice), body)
}

/// The ways in which bytes are damaged between both ends.
#[derive(Clone, Copy, Debug)]
enum Damage {
    Flip,
    Flips,
    Burst,
    Replaced,
    Swapped,
    Truncated,
    Torn,
    Inserted,
    Removed,
    Doubled,
    Zeroed,
    Spliced,
    Joined,
    Noise,
}

const DAMAGES: [Damage; 14] = [
    Damage::Flip,
    Damage::Flips,
    Damage::Burst,
    Damage::Replaced,
    Damage::Swapped,
    Damage::Truncated,
    Damage::Torn,
    Damage::Inserted,
    Damage::Removed,
    Damage::Doubled,
    Damage::Zeroed,
    Damage::Spliced,
    Damage::Joined,
    Damage::Noise,
];

fn flip(bytes: &mut [u8], bit: usize) {
    if let Some(byte) = bytes.get_mut(bit / 8) {
        *byte ^= 1 << (bit % 8);
    }
}

/// A range of at least one byte and at most `longest`.
fn range(dice: &mut Dice, length: usize, longest: usize) -> core::ops::Range<usize> {
    let start = dice.below(length);
    start..(start + 1 + dice.below(longest)).min(length)
}

/// Damages `bytes`, one frame with its closing zero; `other` is the next frame.
fn damage(dice: &mut Dice, how: Damage, bytes: &mut Vec<u8>, other: &[u8]) {
    let length = bytes.len();
    match how {
        Damage::Flip => flip(bytes, dice.below(8 * length)),
        Damage::Flips => (0..2 + dice.below(7)).for_each(|_| flip(bytes, dice.below(8 * length))),
        Damage::Burst => {
            let (start, pattern) = (dice.below(8 * length), dice.next() >> dice.below(63) | 1);
            let hit = (0..64).filter(|k| pattern >> k & 1 == 1);
            hit.for_each(|k| flip(bytes, start + k));
        }
        Damage::Replaced => range(dice, length, 16).for_each(|k| bytes[k] = dice.byte()),
        Damage::Swapped => bytes.swap(dice.below(length), dice.below(length)),
        Damage::Truncated => {
            bytes.truncate(dice.below(length));
            bytes.push(0);
        }
        Damage::Torn => bytes.truncate(dice.below(length)),
        Damage::Inserted => {
            for _ in 0..1 + dice.below(4) {
                bytes.insert(dice.below(bytes.len() + 1), dice.byte());
            }
        }
        Damage::Removed => {
            bytes.drain(range(dice, length, 4));
        }
        Damage::Doubled => {
            let piece = range(dice, length, 64);
            let (end, copy) = (piece.end, bytes[piece].to_vec());
            bytes.splice(end..end, copy);
        }
        Damage::Zeroed => range(dice, length, 8).for_each(|k| bytes[k] = 0),
        Damage::Spliced => {
            let at = dice.below(length.min(other.len()));
            bytes.truncate(at);
            bytes.extend(&other[at..]);
        }
        Damage::Joined => {
            bytes.pop();
            bytes.extend(other);
        }
        Damage::Noise => {
            let zeros = dice.below(2);
            let count = 1 + dice.below(300);
            bytes.clear();
            dice.bytes(bytes, count, zeros);
            bytes.push(0);
        }
    }
}

/// Feeds the stream; returns how many accepted frames were not in `sent`, and whether the last one sent came through.
fn foreign(deframer: &mut Deframer, mut stream: &[u8], sent: &[&Copied]) -> (u64, bool) {
    let (mut strangers, mut last) = (0, false);
    while let Some(found) = deframer.next(&mut stream) {
        let Ok(frame) = found else { continue };
        let known = |of: &Copied| frame.header == of.0 && frame.body == of.1;
        strangers += u64::from(!sent.iter().any(|of| known(of)));
        last = sent.last().is_some_and(|of| known(of));
    }
    (strangers, last)
}

/// 1e6 damaged frames, 1e8 in a soak: none is accepted, and the second whole frame after the damage is always found,
/// whether or not the damage hit a zero.
///
/// Flips, replacements and swaps that hit no code byte and make no zero are always detected up to four bits or 32 bits
/// in a row (see below). The rest is detected except for 1 in 2^32, so 1e8 of them would let .02 through on average.
#[test]
fn no_damaged_frame_is_accepted() {
    let mut dice = Dice(20);
    let mut deframer = Deframer::new();
    let follower = (random_header(&mut dice), Vec::from(*b"follower"));
    let last = (random_header(&mut dice), Vec::from(*b"last"));
    let (second, third) = (wire(&follower.0, &follower.1), wire(&last.0, &last.1));
    let (mut damaged, mut stream) = (0, Vec::new());
    while damaged < trials(1_000_000, 100_000_000) {
        let frame = random_frame(&mut dice);
        let whole = wire(&frame.0, &frame.1);
        stream.clear();
        stream.extend(&whole);
        let how = DAMAGES[(damaged % DAMAGES.len() as u64) as usize];
        damage(&mut dice, how, &mut stream, &second);
        if stream == whole {
            continue;
        }
        damaged += 1;
        stream.extend(&second);
        stream.extend(&third);
        let (strangers, in_step) = foreign(&mut deframer, &stream, &[&frame, &follower, &last]);
        assert_eq!(
            strangers, 0,
            "damaged frame {damaged} ({how:?}) accepted: {stream:x?}"
        );
        assert!(in_step, "not in step after {how:?}: {stream:x?}");
    }
}

/// The bits of a frame before stuffing, stuffed again after damage.
fn refused(frame: &[u8]) -> bool {
    let mut block = std::vec![0];
    block.extend(frame);
    cobs::stuff(&mut block).unwrap();
    block.push(0);
    let mut stream = &block[..];
    Deframer::new().next(&mut stream) == Some(Err(Rejected::Checksum))
}

fn unstuffed(frame: &Copied) -> Vec<u8> {
    let mut block = wire(&frame.0, &frame.1);
    block.pop();
    cobs::unstuff(&mut block).unwrap().to_vec()
}

#[test]
fn every_error_of_one_or_two_bits_is_found() {
    let mut dice = Dice(21);
    let mut body = Vec::new();
    dice.bytes(&mut body, 43, 3);
    let frame = unstuffed(&(random_header(&mut dice), body));
    for first in 0..8 * frame.len() {
        let mut once = frame.clone();
        flip(&mut once, first);
        assert!(refused(&once), "bit {first}");
        for second in first + 1..8 * frame.len() {
            let mut twice = once.clone();
            flip(&mut twice, second);
            assert!(refused(&twice), "bits {first} and {second}");
        }
    }
}

#[test]
fn every_error_of_four_bits_and_every_burst_of_32_is_found() {
    let mut dice = Dice(22);
    for _ in 0..trials(100_000, 10_000_000) {
        let frame = unstuffed(&random_frame(&mut dice));
        let bits = 8 * frame.len();
        let mut few = frame.clone();
        (0..1 + dice.below(4)).for_each(|_| flip(&mut few, dice.below(bits)));
        assert!(few == frame || refused(&few));
        let (start, pattern) = (dice.below(bits), dice.next() as u32);
        let mut burst = frame.clone();
        let hit = (0..32).filter(|k| pattern >> k & 1 == 1);
        hit.for_each(|k| flip(&mut burst, start + k));
        assert!(burst == frame || refused(&burst));
    }
}

/// 1e6 blocks of hostile bytes, 1e7 in a soak: nothing panics, nothing is accepted, and the second whole frame is found.
#[test]
fn hostile_bytes_do_no_harm() {
    let mut dice = Dice(23);
    let mut deframer = Deframer::new();
    let good = (random_header(&mut dice), Vec::from(*b"good"));
    let whole = wire(&good.0, &good.1);
    let mut stream = Vec::new();
    for _ in 0..trials(1_000_000, 10_000_000) {
        stream.clear();
        let (count, zeros) = (dice.below(96) << (3 * dice.below(2)), dice.below(3));
        dice.bytes(&mut stream, count, zeros);
        if dice.below(4) == 0 {
            // code bytes that lead on, so that unstuffing succeeds and the CRC decides
            stream.iter_mut().for_each(|byte| *byte = 1 + (*byte & 3));
        }
        stream.extend(&whole);
        stream.extend(&whole);
        assert_eq!(
            foreign(&mut deframer, &stream, &[&good]),
            (0, true),
            "{stream:x?}"
        );
    }
}
