//! Every drop, repeat, late frame and reset is detected, and no sample enters twice, whatever the link does.

use super::*;
use crate::receiver::LISTED;
use std::ops::RangeInclusive;

use sewfast_control::link::{Body, Header, MAX_WIRE, encode};

const PERIOD: u64 = 1000;

/// SplitMix64 (Steele, Lea and Flood 2014).
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: u64) -> u64 {
        ((u128::from(self.next()) * u128::from(n)) >> 64) as u64
    }

    fn within(&mut self, range: RangeInclusive<u64>) -> u64 {
        range.start() + self.below(range.end() - range.start() + 1)
    }
}

fn trials(short: u64, soak: u64) -> u64 {
    if std::env::var_os("SEWFAST_SOAK").is_some() {
        soak
    } else {
        short
    }
}

/// A frame of the device and what the receiver should report about it.
#[derive(Clone)]
struct Sent {
    wire: Vec<u8>,
    sequence: u32,
    /// Its samples, numbered since the test began; none in a beat.
    samples: std::ops::Range<u64>,
}

/// Sends batches and beats; each sample's counts are its own number, so that no two look alike.
struct Device {
    tag: u16,
    sequence: u32,
    sample: u64,
}

impl Device {
    fn send(&mut self, dice: &mut Dice) -> Sent {
        let count = if dice.below(4) == 0 {
            0
        } else {
            1 + dice.below(10)
        };
        let samples = self.sample..self.sample + count;
        let mut body = Body::new();
        if count > 0 {
            body.u8(0).i32(self.sample as i32);
            (1..count).for_each(|_| {
                body.i16(1);
            });
            samples.clone().for_each(|k| {
                body.i16((k % 20_000) as i16);
            });
        }
        let header = Header {
            kind: if count == 0 { 0xC2 } else { SAMPLES },
            tag: self.tag,
            sequence: self.sequence,
            time: self.sample * PERIOD,
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body.bytes().unwrap(), &mut wire).unwrap();
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        self.sample += count;
        Sent {
            wire: wire[..length].into(),
            sequence,
            samples,
        }
    }
}

/// The frames that the link delivers, and what the receiver should report.
#[derive(Default)]
struct Story {
    stream: Vec<u8>,
    samples: Vec<u64>,
    beats: Vec<u32>,
    anomalies: Vec<Anomaly>,
}

impl Story {
    fn used(&mut self, sent: &Sent) {
        self.stream.extend(&sent.wire);
        self.samples.extend(sent.samples.clone());
        if sent.samples.is_empty() {
            self.beats.push(sent.sequence);
        }
    }

    fn unused(&mut self, kind: Kind, sent: &Sent) {
        self.stream.extend(&sent.wire);
        self.says(kind, sent.sequence, 1);
    }

    fn says(&mut self, kind: Kind, sequence: u32, count: u32) {
        self.anomalies.push(Anomaly {
            kind,
            sequence,
            count,
        });
    }

    fn clean(&mut self, device: &mut Device, dice: &mut Dice, count: RangeInclusive<u64>) {
        for _ in 0..dice.within(count) {
            let sent = device.send(dice);
            self.used(&sent);
        }
    }

    fn drop(&mut self, device: &mut Device, dice: &mut Dice) {
        let (first, count) = (device.sequence, 1 + dice.below(5));
        (0..count).for_each(|_| drop(device.send(dice)));
        self.says(Kind::Missing, first, count as u32);
        self.clean(device, dice, 1..=1);
    }

    fn repeat(&mut self, device: &mut Device, dice: &mut Dice) {
        let sent = device.send(dice);
        self.used(&sent);
        self.clean(device, dice, 0..=3);
        (0..dice.within(1..=2)).for_each(|_| self.unused(Kind::Repeated, &sent));
    }

    fn reorder(&mut self, device: &mut Device, dice: &mut Dice) {
        let sent = device.send(dice);
        self.says(Kind::Missing, sent.sequence, 1);
        self.clean(device, dice, 1..=4);
        self.unused(Kind::Late, &sent);
    }

    fn reset(&mut self, device: &mut Device, dice: &mut Dice) {
        let leftover = device.send(dice);
        device.tag = device.tag.wrapping_add(1 + dice.below(30_000) as u16);
        device.sequence = 0;
        let lost = dice.below(3);
        (0..lost).for_each(|_| drop(device.send(dice)));
        self.says(Kind::Reset, lost as u32, lost as u32);
        self.clean(device, dice, 1..=3);
        if dice.below(2) == 0 {
            self.unused(Kind::Late, &leftover);
        }
    }

    fn damage(&mut self, device: &mut Device, dice: &mut Dice) {
        let mut sent = device.send(dice);
        let at = dice.below(sent.wire.len() as u64 - 1) as usize;
        sent.wire[at] ^= if sent.wire[at] == 0x20 { 1 } else { 0x20 };
        self.stream.extend(&sent.wire);
        self.says(Kind::Rejected, sent.sequence, 1);
        self.says(Kind::Missing, sent.sequence, 1);
        self.clean(device, dice, 1..=1);
    }

    /// The end of a frame is lost, including its zero: the next whole frame is joined to it, and the one after is in step.
    fn tear(&mut self, device: &mut Device, dice: &mut Dice) {
        let (torn, joined) = (device.send(dice), device.send(dice));
        let kept = 1 + dice.below(torn.wire.len() as u64 - 1) as usize;
        self.stream.extend(&torn.wire[..kept]);
        self.stream.extend(&joined.wire);
        self.says(Kind::Rejected, torn.sequence, 1);
        self.says(Kind::Missing, torn.sequence, 2);
        self.clean(device, dice, 1..=1);
    }

    fn go_on(&mut self, device: &mut Device, dice: &mut Dice) {
        match dice.below(6) {
            0 => self.drop(device, dice),
            1 => self.repeat(device, dice),
            2 => self.reorder(device, dice),
            3 => self.reset(device, dice),
            4 => self.damage(device, dice),
            _ => self.tear(device, dice),
        }
        self.clean(device, dice, 1..=3);
    }
}

fn receiver() -> Receiver {
    let mut receiver = Receiver::new();
    let channels = [(0, 1), (1, 1)].map(|(e, s)| Channel::described(e, s).unwrap());
    receiver.expect(&channels, PERIOD as u32).unwrap();
    receiver
}

/// Feeds the stream in pieces; the numbers of the beats that came out.
fn fed(receiver: &mut Receiver, dice: &mut Dice, mut stream: &[u8]) -> Vec<u32> {
    let mut beats = Vec::new();
    while !stream.is_empty() {
        let (piece, rest) = stream.split_at(stream.len().min(1 + dice.below(200) as usize));
        receiver.feed(piece, |frame| beats.push(frame.header.sequence));
        stream = rest;
    }
    beats
}

/// 1e5 injected faults, 1e6 in a soak: every one is reported with its place and number, nothing else is, and all whole
/// frames in order come out once.
#[test]
fn every_injected_fault_is_flagged() {
    let mut dice = Dice(31);
    let mut receiver = receiver();
    let mut device = Device {
        tag: 9,
        sequence: u32::MAX - 1000,
        sample: 0,
    };
    let mut story = Story::default();
    story.clean(&mut device, &mut dice, 1..=1);
    for fault in 0..trials(100_000, 1_000_000) {
        story.go_on(&mut device, &mut dice);
        let told = std::mem::take(&mut story);
        assert_eq!(
            fed(&mut receiver, &mut dice, &told.stream),
            told.beats,
            "fault {fault}"
        );
        assert!(receiver.anomalies().eq(told.anomalies), "fault {fault}");
        let (times, columns) = receiver.take();
        let numbers: Vec<f64> = told.samples.iter().map(|&k| k as i32 as f64).collect();
        assert_eq!(columns[0], numbers, "fault {fault}");
        let stamps = told.samples.iter().map(|&k| (k * PERIOD) as i64);
        assert!(times.into_iter().eq(stamps), "fault {fault}");
    }
    assert_eq!(
        receiver.counters().unlisted + receiver.counters().untaken,
        0
    );
}

#[test]
fn counters_add_up() {
    let mut dice = Dice(32);
    let mut receiver = receiver();
    let mut device = Device {
        tag: 1,
        sequence: 0,
        sample: 0,
    };
    let mut story = Story::default();
    story.clean(&mut device, &mut dice, 1..=1);
    (0..2000).for_each(|_| story.go_on(&mut device, &mut dice));
    fed(&mut receiver, &mut dice, &story.stream);
    let of = |kind: Kind| story.anomalies.iter().filter(move |a| a.kind == kind);
    let sum = |kind: Kind| of(kind).map(|a| u64::from(a.count)).sum::<u64>();
    let counters = *receiver.counters();
    assert_eq!(counters.missing, sum(Kind::Missing));
    assert_eq!(counters.rejected, sum(Kind::Rejected));
    assert_eq!(counters.repeated, sum(Kind::Repeated));
    assert_eq!(counters.late, sum(Kind::Late));
    assert_eq!(counters.resets, of(Kind::Reset).count() as u64);
    assert_eq!(counters.samples, story.samples.len() as u64);
    assert!(counters.resets > 100 && counters.late > 100 && counters.missing > 100);
}

#[test]
fn memory_is_bounded_where_nobody_takes() {
    let mut dice = Dice(33);
    let mut receiver = receiver();
    let mut device = Device {
        tag: 1,
        sequence: 0,
        sample: 0,
    };
    for _ in 0..60_000 {
        let sent = device.send(&mut dice);
        receiver.feed(&sent.wire, |_| {});
        receiver.feed(&sent.wire, |_| {});
    }
    let counters = *receiver.counters();
    assert_eq!(counters.samples + counters.untaken, device.sample);
    assert!(counters.samples as usize <= Samples::ROOM && counters.untaken > 0);
    assert_eq!(receiver.anomalies().len(), LISTED);
    assert!(counters.unlisted > 0);
    assert_eq!(receiver.take().0.len() as u64, counters.samples);
    let sent = device.send(&mut dice);
    let more = sent.samples.end - sent.samples.start;
    receiver.feed(&sent.wire, |_| {});
    assert_eq!(receiver.take().0.len() as u64, more);
}

#[test]
fn noise_is_one_entry_and_echoes_do_not_count_as_the_device() {
    let mut receiver = receiver();
    (0..1000).for_each(|_| receiver.feed(&[3, 3, 3, 0], |_| {}));
    let noise = Anomaly {
        kind: Kind::Rejected,
        sequence: 0,
        count: 1000,
    };
    assert!(receiver.anomalies().eq([noise]));
    let header = Header {
        kind: 0x20,
        tag: 5,
        sequence: 77,
        time: 0,
    };
    let mut wire = [0; MAX_WIRE];
    let length = encode(&header, &[0; 4], &mut wire).unwrap();
    receiver.feed(&wire[..length], |frame| panic!("{frame:?} came out"));
    assert_eq!(
        (receiver.counters().echoed, receiver.counters().frames),
        (1, 0)
    );
}

#[test]
fn counts_start_anew_after_a_reset() {
    let mut receiver = receiver();
    for (tag, counts) in [(1, i32::MAX), (2, i32::MIN)] {
        let mut body = Body::new();
        body.u8(0).i32(counts).i16(0);
        let header = Header {
            kind: SAMPLES,
            tag,
            ..Header::default()
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body.bytes().unwrap(), &mut wire).unwrap();
        receiver.feed(&wire[..length], |_| {});
    }
    assert_eq!(
        receiver.take().1[0],
        [f64::from(i32::MAX), f64::from(i32::MIN)]
    );
}

#[test]
fn samples_come_out_as_frames_until_channels_are_expected() {
    let (mut dice, mut receiver) = (Dice(34), Receiver::new());
    let mut device = Device {
        tag: 1,
        sequence: 0,
        sample: 0,
    };
    let (mut kinds, mut sent) = (Vec::new(), device.send(&mut dice));
    while sent.samples.is_empty() {
        sent = device.send(&mut dice);
    }
    receiver.feed(&sent.wire, |frame| kinds.push(frame.header.kind));
    assert_eq!((kinds, receiver.take().0.len()), (vec![SAMPLES], 0));
}

/// 1e6 blocks, 1e7 in a soak: noise, frames with valid CRC but random fields, and real frames damaged.
#[test]
fn hostile_frames_do_no_harm() {
    let mut dice = Dice(35);
    let mut receiver = receiver();
    let mut stream = Vec::new();
    for block in 0..trials(1_000_000, 10_000_000) {
        let body: Vec<u8> = (0..dice.below(60)).map(|_| dice.next() as u8).collect();
        if dice.below(3) == 0 {
            stream.extend(body);
        } else {
            let header = Header {
                kind: if dice.below(2) == 0 {
                    SAMPLES
                } else {
                    dice.next() as u8
                },
                tag: dice.below(3) as u16,
                sequence: (dice.next() as u32) >> dice.below(32),
                time: dice.next() >> dice.below(64),
            };
            let mut wire = [0; MAX_WIRE];
            let length = encode(&header, &body, &mut wire).unwrap();
            stream.extend(&wire[..length]);
        }
        if dice.below(8) == 0 && !stream.is_empty() {
            let at = dice.below(stream.len() as u64) as usize;
            stream[at] ^= dice.next() as u8;
        }
        if block % 64 == 0 {
            receiver.feed(&stream, |frame| assert!(frame.header.kind >= 0x80));
            stream.clear();
        }
        if block % 4096 == 0 {
            let (times, columns) = receiver.take();
            assert!(columns.iter().all(|column| column.len() == times.len()));
            assert!(times.len() <= Samples::ROOM && receiver.anomalies().len() <= LISTED);
        }
    }
    let counters = *receiver.counters();
    assert!(counters.samples > 0 && counters.malformed > 0 && counters.resets > 0);
}
