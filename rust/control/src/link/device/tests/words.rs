//! The layout of the device's messages.

use super::rig::*;
use crate::link::identity::capability as can;
use crate::link::{Body, Fields, Identity, Limits, State};
use std::vec;

#[test]
fn the_first_frame_is_the_boot_after_a_zero() {
    let mut rig = Rig::new();
    let mut first = [7; 1];
    rig.device.transmit(&mut first);
    assert_eq!(first, [0]);
    let boot = rig.listen().remove(0);
    assert_eq!((boot.header.kind, boot.header.tag), (0xC1, 0x2345));
    assert_eq!((boot.header.sequence, boot.header.time), (0, 0));
    assert_eq!(boot.body, [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn hello_tells_the_identity() {
    let mut rig = Rig::new();
    let (result, body) = rig.hello(9);
    let mut fields = Fields::new(&body);
    assert_eq!(
        (result, fields.u8(), fields.u32()),
        (0, Some(4), Some(0x1_2345))
    );
    // zlib.crc32 of the same fields, packed by Python
    assert_eq!(fields.u32(), Some(SCHEMA));
    assert_eq!((fields.u8(), fields.u8()), (Some(0), Some(6)));
    assert_eq!(
        (fields.u32(), fields.u32()),
        (Some(1000), Some(0b111_1101_0111))
    );
    assert_eq!((fields.u32(), fields.f32()), (Some(64), Some(1500.0)));
    assert_eq!(
        (fields.text(24), fields.text(16)),
        (Some("rig"), Some("test"))
    );
    let key = rig.key();
    assert_eq!((fields.u32(), fields.u32()), (Some(9), Some(key)));
    assert_eq!(fields.end(), Some(()));
}

#[test]
fn arm_repeats_the_key_of_the_last_hello() {
    let mut rig = Rig::ready();
    let (key, watchdog) = (rig.key(), 50_000u32.to_le_bytes());
    for wrong in [0, !key, key ^ 1, key.swap_bytes()] {
        let body = [watchdog, wrong.to_le_bytes()].concat();
        assert_eq!(rig.command(0x05, &body), (13, vec![0; 4]));
    }
    assert_eq!(rig.command(0x05, &watchdog), (2, vec![4, 0, 0, 0]));
    // the same session again keeps its key; another session or another boot gets another key
    rig.hello(77);
    assert_eq!(rig.key(), key);
    let old = rig.arming(50_000);
    assert_eq!(rig.command(0x05, &old).0, 0);
    rig.new_session(78);
    rig.limits(10.0, 4000.0, INF, 20.0);
    assert_ne!(rig.key(), key);
    assert_eq!(rig.command(0x05, &old), (13, vec![0; 4]));
    let mut other = Rig::with(Identity {
        entropy: 0x5EEE,
        ..identity()
    });
    other.hello(77);
    assert_ne!(other.key(), key);
}

const SCHEMA: u32 = 0xB2EB_A4A0;
/// That of version 3.
const OLDER: u32 = 0x6B97_08E2;

#[test]
fn hello_needs_a_common_version() {
    let mut rig = Rig::new();
    for (from, to) in [(0, 0), (1, 2), (5, 9), (4, 1)] {
        rig.say(0x01, 0, 0, &[from, to, 1, 0, 0, 0]);
        let reply = rig.listen().pop().unwrap();
        assert_eq!(reply.body, [0, 0, 0, 0, 10, 4, 0, 0, 0]);
    }
    // a host of version 3 is answered as ever
    for (from, to, version, schema) in [(3, 3, 3, OLDER), (1, 3, 3, OLDER), (4, 9, 4, SCHEMA)] {
        rig.say(0x01, 0, 0, &[from, to, 1, 0, 0, 0]);
        let reply = rig.listen().pop().unwrap();
        let mut fields = Fields::new(&reply.body[4..]);
        assert_eq!((fields.u8(), fields.u8()), (Some(0), Some(version)));
        assert_eq!((fields.u32(), fields.u32()), (Some(0x1_2345), Some(schema)));
    }
    rig.say(0x01, 0, 0, &[1]);
    assert_eq!(rig.listen().pop().unwrap().body[4..], [2, 1, 0, 0, 0]);
    // session 0 does not exist
    assert_eq!(rig.hello(0), (3, vec![2, 0, 0, 0]));
}

#[test]
fn describe_and_echo_and_unknown() {
    let mut rig = Rig::ready();
    let mut body = Body::new();
    body.u8(1).u8(1).u32(1000).text("u", 15).text("1", 7);
    assert_eq!(rig.command(0x02, &[1]), (0, body.bytes().unwrap().to_vec()));
    assert_eq!(rig.command(0x02, &[6]), (3, vec![0; 4]));
    assert_eq!(rig.command(0x0B, &[5; 200]), (0, vec![5; 200]));
    assert_eq!(rig.command(0x0B, &[5; 201]), (2, vec![201, 0, 0, 0]));
    assert_eq!(rig.command(0x00, &[]), (1, vec![0; 4]));
    assert_eq!(rig.command(0x1F, &[]), (1, vec![0x1F, 0, 0, 0]));
    assert_eq!(rig.command(0x03, &[0]), (2, vec![1, 0, 0, 0]));
}

#[test]
fn status_tells_the_run() {
    let mut rig = Rig::driving(3.0);
    let begin = rig.now - PERIOD;
    rig.counts = 3;
    rig.watched(4);
    rig.put(&[5, 5, 0]);
    let (result, body) = rig.command(0x03, &[]);
    let mut fields = Fields::new(&body);
    assert_eq!(
        (result, fields.u8(), fields.u8(), fields.u8()),
        (0, Some(3), Some(0), Some(2))
    );
    assert_eq!(
        (fields.u16(), fields.u32(), fields.u64()),
        (Some(3), Some(1), Some(begin))
    );
    // samples, length, end of the profile
    assert_eq!(
        (fields.u32(), fields.u32(), fields.u32()),
        (Some(6), Some(0), Some(0))
    );
    assert!(
        fields
            .f32()
            .is_some_and(|speed| (speed - 15.0).abs() < 1e-4)
    );
    assert_eq!(fields.i32(), Some(3));
    // HELLO, LIMITS, ARM, START, STATUS and five heartbeats; one invalid frame; nothing dropped
    assert_eq!(
        (fields.u32(), fields.u32(), fields.u32()),
        (Some(10), Some(1), Some(0))
    );
    assert_eq!((fields.u32(), fields.u32()), (Some(0), Some(77)));
    assert_eq!((fields.u32(), fields.end()), (Some(0), Some(())));
}

#[test]
fn beats_come_every_200_ms_while_not_running() {
    let mut rig = Rig::new();
    rig.samples(1000);
    rig.listen();
    let beats: vec::Vec<_> = rig
        .came
        .iter()
        .filter(|came| came.header.kind == 0xC2)
        .collect();
    assert_eq!(beats.len(), 5);
    assert!(
        beats
            .windows(2)
            .all(|pair| pair[1].header.time - pair[0].header.time == 200_000)
    );
    assert_eq!(beats[4].body, [0x45, 0x23, 1, 0, 1, 0, 0, 0, 0, 0]);
    let mut rig = Rig::driving(3.0);
    rig.listen();
    rig.came.clear();
    rig.watched(1000);
    rig.listen();
    assert!(rig.came.iter().all(|came| came.header.kind == 0xC0));
}

#[test]
fn numbers_of_frames_have_no_gap_but_for_dropped_ones() {
    let mut rig = Rig::driving(3.0);
    rig.watched(2000);
    let (result, status) = rig.command(0x03, &[]);
    let dropped = u32::from_le_bytes(status[45..49].try_into().unwrap());
    assert_eq!((result, dropped > 0), (0, true));
    rig.watched(10);
    rig.listen();
    let numbers: vec::Vec<u32> = rig.came.iter().map(|came| came.header.sequence).collect();
    let gaps: u32 = numbers.windows(2).map(|pair| pair[1] - pair[0] - 1).sum();
    assert_eq!((numbers[0], gaps), (0, dropped));
    let flag = |came: &&Came| came.header.kind == 0xC0 && came.body[0] & 2 != 0;
    assert_eq!(rig.came.iter().filter(flag).count(), 1);
}

#[test]
fn the_same_number_gets_the_same_reply_and_is_not_executed_again() {
    let mut rig = Rig::ready();
    let body = rig.arming(50_000);
    let first = rig.command(0x05, &body);
    let count = rig.device.armed_count();
    assert_eq!(rig.again(0x05, &body), Some(first));
    assert_eq!(rig.device.armed_count(), count);
    let tag = rig.tag;
    rig.listen();
    rig.say(0x03, tag, rig.commands - 1, &[]);
    assert!(rig.listen().is_empty());
    assert_eq!(rig.device.state(), State::Armed);
    // a number far ahead is accepted, and from then on those before it are old
    rig.commands = 0x7000_0000;
    assert_eq!(rig.stop().0, 0);
    rig.commands = 0xE000_0000;
    assert_eq!(rig.stop().0, 0);
    rig.commands = u32::MAX;
    assert_eq!(rig.stop().0, 0);
}

#[test]
fn a_device_on_credit_waits_for_its_host() {
    let mut rig = Rig::with(Identity {
        capabilities: can::DRIVE | can::CREDIT | can::CURRENT | can::COMPUTED,
        ..identity()
    });
    let credit = |rig: &mut Rig, until: u64| {
        let mut body = Body::new();
        body.u32(50_000).u64(until);
        rig.beat(0x22, body.bytes().unwrap());
        rig.device.credit()
    };
    rig.samples(150);
    assert_eq!((rig.device.credit(), credit(&mut rig, 7)), (None, None));
    rig.beats = 0;
    rig.hello(1);
    assert_eq!(rig.device.credit(), Some(rig.now));
    assert_eq!(credit(&mut rig, u64::MAX), Some(u64::MAX));
    rig.hello(1);
    assert_eq!(rig.device.credit(), Some(u64::MAX));
    rig.device.disconnect();
    assert_eq!(rig.device.credit(), None);
    rig.hello(1);
    assert_eq!(rig.device.credit(), Some(rig.now));
    // its counts restart when it is armed, which is no motion
    rig.limits(10.0, 4000.0, INF, 20.0);
    rig.arm();
    assert_eq!(rig.device.armed_count(), 1);
    rig.start(2, 0, 0);
    rig.counts = -100_000;
    rig.watched(40);
    assert_eq!(rig.device.state(), State::Running);
    rig.hello(2);
    assert_eq!(rig.device.credit(), Some(rig.now));
    let mut without = Rig::driving(1.0);
    assert_eq!(credit(&mut without, 5), None);
    assert_eq!(without.device.state(), State::Running);
}

#[test]
fn capabilities_that_are_missing_are_named() {
    let mut rig = Rig::with(Identity {
        capabilities: 0,
        ceilings: Limits {
            current: INF,
            ..identity().ceilings
        },
        channels: &CHANNELS[..2],
        ..identity()
    });
    rig.hello(1);
    rig.samples(150);
    rig.limits(1.0, 1.0, 1.0, INF);
    let none = (8, vec![0; 4]);
    assert_eq!(rig.upload(0, &[1]), none);
    assert_eq!(rig.references(0, &[1.0]), none);
    assert_eq!(
        rig.command(0x09, gains([1.0; 12], 1).bytes().unwrap()),
        none
    );
    rig.arm();
    for mode in 0..3 {
        assert_eq!(rig.start(mode, 0, 1), none);
    }
}
