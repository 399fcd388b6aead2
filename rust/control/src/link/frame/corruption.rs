//! Damaged frames are refused, hostile bytes do no harm, and one whole frame brings the receiver back into step.

use super::super::cobs;
use super::super::dice::{Dice, trials};
use super::tests::wire;
use super::*;
use std::vec::Vec;

type Copied = (Header, Vec<u8>);

fn random_header(dice: &mut Dice) -> Header {
    Header {
        kind: dice.byte(),
        tag: dice.next() as u16,
        sequence: dice.next() as u32 >> (8 * dice.below(4)),
        time: dice.next() >> (8 * dice.below(8)),
    }
}

/// Mostly as short as real ones; bodies of samples and commands are full of zeros.
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

/// The ways in which bytes are damaged between two ends.
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

/// Damage `bytes`, one frame with its closing zero; `other` is the frame that comes next.
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

/// Takes the stream in; how many frames are accepted and none of `sent`, and whether the last one sent came through.
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

/// 1e6 damaged frames, 1e8 in a soak: none is taken for a frame, and the second whole frame after the damage is
/// always found, whether or not the damage hit a zero.
///
/// Flips, replacements and swaps that hit no code byte and make no zero are found with certainty up to four bits or 32 bits in
/// a row (see below); the rest is found but for 1 in 2^32, so that 1e8 of them would let .02 through on average.
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

/// The bits of a frame before stuffing, stuffed again after the damage.
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
