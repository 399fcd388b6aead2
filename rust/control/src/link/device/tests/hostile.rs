//! Malicious bytes.

use super::rig::*;
use crate::Biquad;
use crate::link::frame::tests::{Dice, trials};
use crate::link::identity::capability as can;
use crate::link::{Deframer, Identity, MAX_BODY, Measurement, Reason, State};
use std::vec::Vec;

/// Numbers likely to break things.
const HARMFUL: [f32; 12] = [
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::MAX,
    f32::MIN,
    f32::MIN_POSITIVE,
    1e-45,
    0.0,
    -0.0,
    1.0,
    10.0,
    1000.0,
];

fn number(dice: &mut Dice, out: &mut Vec<u8>) {
    let choice = dice.below(4);
    let harmful = HARMFUL[dice.below(HARMFUL.len())].to_le_bytes();
    match choice {
        0 => out.extend(harmful),
        1 => out.extend([0xFF; 4]),
        2 => out.extend((dice.below(20_000) as u32).to_le_bytes()),
        _ => out.extend((dice.next() as u32).to_le_bytes()),
    }
}

/// A body that a command could have; only a few have a fault.
fn body(dice: &mut Dice, kind: u8, now: u64) -> Vec<u8> {
    let watchdog = (1000 + dice.below(100_000) as u32).to_le_bytes();
    let mut body = match kind {
        0x01 => [&[3, 3], &(1 + dice.below(2) as u32).to_le_bytes()[..]].concat(),
        0x02 => std::vec![dice.below(7) as u8],
        0x04 => [10f32, 4000.0, f32::INFINITY, 20.0]
            .map(f32::to_le_bytes)
            .concat(),
        0x05 | 0x20 => watchdog.to_vec(),
        0x08 => {
            let mut body = upload(dice.below(80) as u32, &[100i16; 40]);
            let table = dice.below(9) as u8;
            if table == 1 || table == 2 {
                body.clear();
                body.u8(table).u32(dice.below(80) as u32);
                (0..40).for_each(|k| _ = body.f32(10.0 * k as f32));
            }
            body.bytes().unwrap().to_vec()
        }
        0x0F => {
            let count = dice.below(11);
            let rows: Vec<_> = (0..count).map(|i| [500.0 * i as f32, 2e4, 1e4]).collect();
            let (smoothing, releases) = (dice.below(33) as u8, dice.below(2) as u8);
            position([30.0, 3000.0, 20.0, 60.0], smoothing, releases, &rows)
                .bytes()
                .unwrap()
                .to_vec()
        }
        0x10 => {
            let at = [0, dice.below(300) as u32][dice.below(2)];
            let turn = (dice.below(4000) as f32) - 2000.0;
            angle(at, turn, dice.below(2) as u8)
                .bytes()
                .unwrap()
                .to_vec()
        }
        0x11 => {
            let (low, high) = [(0, 0), (-500, 500), (i32::MIN, i32::MAX)][dice.below(3)];
            travel(low, high).bytes().unwrap().to_vec()
        }
        0x09 => {
            let good = [
                0.02, 0.25, 0.0, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
            ];
            let points = [[0.0, 0.01, 0.2, 0.0], [900.0, 0.02, 0.2, 0.0]];
            let body = match dice.below(2) {
                0 => gains(good, 8),
                _ => design(good, 8, 0.004, 5000.0, &points),
            };
            body.bytes().unwrap().to_vec()
        }
        0x0C => {
            let section = Biquad::notch(60.0, 0.1, 0.5, 1e-3).unwrap();
            let count = dice.below(6);
            biquads(&std::vec![section; count])
                .bytes()
                .unwrap()
                .to_vec()
        }
        0x0E => {
            let (levels, taps) = (dice.below(11), dice.below(19));
            let rising: Vec<_> = (0..levels).map(|i| [i as f32, 0.1 * i as f32]).collect();
            let preview = dice.below(34) as u8;
            feedforward(preview, 0.5, &rising, &std::vec![0.01; taps])
                .bytes()
                .unwrap()
                .to_vec()
        }
        0x0A => {
            let at = if dice.below(2) == 0 {
                0
            } else {
                now + dice.below(9000) as u64
            };
            let body = start(
                dice.below(4) as u8,
                at,
                1 + dice.below(200) as u32,
                0b1_1011,
                9,
            );
            body.bytes().unwrap().to_vec()
        }
        0x21 => [watchdog, 3f32.to_le_bytes()].concat(),
        0x22 => [&watchdog[..], &(now + 9_000_000).to_le_bytes()].concat(),
        _ => Vec::new(),
    };
    match dice.below(48) {
        0 => {
            let field = dice.below(body.len() / 4 + 1) * 4;
            body.truncate(field);
            let count = dice.below(4);
            (0..count).for_each(|_| number(dice, &mut body));
        }
        1 => {
            body.clear();
            let count = dice.below(MAX_BODY + 1);
            dice.bytes(&mut body, count, 2);
        }
        2 if !body.is_empty() => {
            let at = dice.below(body.len());
            body[at] ^= dice.byte();
        }
        3 if body.len() >= 4 => {
            let at = dice.below(body.len() - 3);
            let harmful = HARMFUL[dice.below(HARMFUL.len())].to_le_bytes();
            body[at..at + 4].copy_from_slice(&harmful);
        }
        _ => {}
    }
    body
}

/// Mostly commands that start a run and keep it going.
const KINDS: [u8; 33] = [
    0x05, 0x0A, 0x20, 0x22, 0x0F, 0x0E, 0x0C, 0x01, 0x02, 0x03, 0x04, 0x04, 0x05, 0x05, 0x06, 0x07,
    0x07, 0x08, 0x09, 0x0A, 0x0A, 0x0B, 0x20, 0x20, 0x21, 0x22, 0xC0, 0x05, 0x0A, 0x0A, 0x20, 0x21,
    0x22,
];

/// A frame, whole or not, with the next number or another.
fn bytes(dice: &mut Dice, rig: &mut Rig) -> Vec<u8> {
    let kind = match dice.below(64) {
        0 => dice.byte(),
        _ => KINDS[dice.below(KINDS.len())],
    };
    let kind = if kind == 0x0F {
        kind + dice.below(3) as u8
    } else {
        kind
    };
    let counter = if kind < 0x20 {
        &mut rig.commands
    } else {
        &mut rig.beats
    };
    *counter += 1;
    let sequence = match dice.below(64) {
        0 => dice.next() as u32,
        1..4 => *counter - 1,
        _ => *counter,
    };
    let tag = if dice.below(64) == 0 {
        dice.next() as u16
    } else {
        rig.tag
    };
    let mut body = body(dice, kind, rig.now);
    if kind == 0x05 && body.len() == 4 {
        body.extend(rig.key().to_le_bytes());
    }
    let session = rig.session;
    if dice.below(64) == 0 {
        rig.session = dice.next() as u32;
    }
    let mut wire = rig.wire(kind, tag, sequence, &body);
    rig.session = session;
    if kind == 0x01 && body.len() == 6 {
        rig.session = u32::from_le_bytes([body[2], body[3], body[4], body[5]]);
    }
    match dice.below(32) {
        0 => {
            let at = dice.below(wire.len());
            wire[at] ^= 1 << dice.below(8);
        }
        1 => wire.truncate(dice.below(wire.len())),
        2 => {
            wire.clear();
            let count = dice.below(600);
            dice.bytes(&mut wire, count, 1);
        }
        _ => {}
    }
    wire
}

/// A million frames (ten with SEWFAST_SOAK): no panic, the output always safe, every frame of the device whole.
#[test]
fn no_bytes_break_the_device() {
    let mut dice = Dice(20);
    let sound = Identity {
        capabilities: can::PROFILE
            | can::PID
            | can::DRIVE
            | can::CURRENT
            | can::CREDIT
            | can::FEEDFORWARD
            | can::POSITIONS,
        ..identity()
    };
    let mut rig = Rig::with(sound);
    let mut deframer = Deframer::new();
    let (mut ran, mut whole) = ([0u32; 5], 0u32);
    for _ in 0..trials(1_000_000, 10_000_000) {
        let wire = bytes(&mut dice, &mut rig);
        rig.put(&wire);
        let output = step(&mut dice, &mut rig);
        let bound = if output.enabled { 10.0 } else { 0.0 };
        assert!(output.u.abs() <= bound && output.u.is_finite());
        assert_eq!(output.enabled, rig.device.state() == State::Running);
        ran[rig.device.state() as usize] += 1;
        let mut out = [0; 700];
        let count = dice.below(out.len());
        let sent = rig.device.transmit(&mut out[..count]);
        let mut sent = &out[..sent];
        while let Some(frame) = deframer.next(&mut sent) {
            assert!(frame.unwrap().header.kind >= 0x80);
            whole += 1;
        }
        if dice.below(400) == 0 {
            rig.session = dice.next() as u32;
            let session = rig.session.to_le_bytes();
            rig.put(&[0]);
            rig.say(0x01, 0, 0, &[&[2, 2], &session[..]].concat());
            (rig.commands, rig.beats) = (0, 0);
        }
    }
    assert!(
        ran[1..].iter().all(|&count| count > 5_000),
        "not all states were visited: {ran:?}"
    );
    assert!(whole > 100_000);
}

/// Time passes, mostly correctly.
fn step(dice: &mut Dice, rig: &mut Rig) -> crate::link::Output {
    let before = rig.now;
    match dice.below(4000) {
        0 => rig.now += dice.next() >> 30,
        1 => rig.now = rig.now.saturating_sub(dice.next() >> 40),
        2 => rig.device.trip(rig.now, Reason::StopInput),
        3 => rig.device.disconnect(),
        4 => rig.counts = dice.next() as i32,
        5 => {
            rig.current = HARMFUL[dice.below(HARMFUL.len())];
        }
        _ => rig.current = 0.0,
    }
    // the device's time does not run backwards, and must not reach its end either
    if rig.now > u64::MAX / 2 {
        rig.now = before;
    }
    let mut output = rig.device.poll(rig.now);
    let samples = [0, 1, 1, 1, 2, 100][dice.below(6)];
    for _ in 0..if samples == 100 && dice.below(20) > 0 {
        1
    } else {
        samples
    } {
        rig.now += PERIOD;
        let measurement = Measurement {
            counts: rig.counts,
            current: rig.current,
            further: &rig.further,
        };
        output = rig.device.sample(rig.now, &measurement);
    }
    output
}
