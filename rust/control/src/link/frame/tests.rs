//! Frames as specified, and streams cut anywhere.

use super::*;
use proptest::prelude::*;
use std::vec::Vec;

/// Made by tests/golden/link_frames.py, which shares no code with this: kind tag sequence time, body, frame, wire.
const GOLDEN: &str = include_str!("../../../../../tests/golden/link_frames.txt");

type Found = Result<(Header, Vec<u8>), Rejected>;

pub fn wire(header: &Header, body: &[u8]) -> Vec<u8> {
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
