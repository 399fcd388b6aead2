//! Every way in which an output could stay on unwatched.

use super::rig::*;
use crate::link::{Measurement, Output, Reason, State};

#[track_caller]
fn tripped(rig: &mut Rig, reason: Reason) {
    assert_eq!(
        (rig.device.state(), rig.device.reason()),
        (State::Tripped, reason)
    );
    assert_eq!(rig.device.poll(rig.now), Output::SAFE);
}

#[test]
fn a_silent_host_trips_within_a_period_of_the_stated_time() {
    let mut rig = Rig::driving(3.0);
    let fed = rig.now - PERIOD;
    while rig.sample().enabled {}
    assert_eq!(rig.now - fed, 50_000);
    tripped(&mut rig, Reason::Watchdog);
    assert_eq!(rig.events().last(), Some(&(6, 1)));
}

#[test]
fn a_silent_host_trips_between_samples_by_poll() {
    let mut rig = Rig::driving(3.0);
    rig.samples(48);
    let now = rig.now;
    assert!(rig.device.poll(now + 999).enabled);
    assert_eq!(rig.device.poll(now + 1000), Output::SAFE);
}

#[test]
fn a_word_that_comes_too_late_revives_nothing() {
    let mut rig = Rig::driving(3.0);
    rig.samples(48);
    rig.now += 1000;
    rig.drive(5.0);
    tripped(&mut rig, Reason::Watchdog);
    rig.drive(5.0);
    assert_eq!(rig.sample(), Output::SAFE);
}

#[test]
fn an_armed_device_falls_back_to_idle() {
    let mut rig = Rig::armed();
    rig.samples(49);
    assert_eq!(rig.device.state(), State::Armed);
    rig.sample();
    assert_eq!(rig.device.state(), State::Idle);
    assert_eq!(rig.events().last(), Some(&(5, 1)));
    assert_eq!(rig.start(2, 0, 0), (4, std::vec![1, 0, 0, 0]));
}

#[test]
fn repeats_old_numbers_damage_and_other_boots_do_not_feed() {
    let mut rig = Rig::driving(3.0);
    let old = rig.wire(0x20, rig.tag, rig.beats, &50_000u32.to_le_bytes());
    let other = rig.wire(0x20, rig.tag ^ 1, rig.beats + 9, &50_000u32.to_le_bytes());
    let mut damaged = rig.wire(0x20, rig.tag, rig.beats + 9, &50_000u32.to_le_bytes());
    damaged[12] ^= 0x40;
    let half = rig.wire(0x20, rig.tag, rig.beats + 9, &50_000u32.to_le_bytes());
    let repeat = start(2, 0, 0, 0b11, 10);
    for _ in 0..49 {
        for bytes in [&old, &other, &damaged] {
            rig.put(bytes);
        }
        rig.again(0x0A, repeat.bytes().unwrap());
        rig.hello(77);
        rig.put(&half[..20]);
        rig.put(&[0]);
        rig.sample();
    }
    tripped(&mut rig, Reason::Watchdog);
}

#[test]
fn after_a_trip_nothing_but_clear_arm_and_start_runs() {
    let mut rig = Rig::driving(3.0);
    rig.samples(60);
    rig.samples(100);
    assert_eq!(rig.start(2, 0, 0).0, 4);
    assert_eq!(rig.arm().0, 4);
    assert_eq!(rig.stop(), (0, std::vec![4]));
    rig.watched(10);
    assert_eq!(rig.clear().0, 0);
    assert_eq!(rig.start(2, 0, 0).0, 4);
    assert_eq!(rig.arm().0, 0);
    rig.watched(10);
    assert_eq!(rig.device.state(), State::Armed);
    assert_eq!(rig.start(2, 0, 0).0, 0);
    assert!(rig.sample().enabled);
    // the command driven before the trip is not held
    assert_eq!(rig.sample().u, 0.0);
}

#[test]
fn a_run_that_ended_or_was_stopped_is_not_armed() {
    let mut rig = Rig::armed();
    assert_eq!(rig.upload(0, &[1000; 5]).0, 0);
    assert_eq!(rig.start(0, 0, 5).0, 0);
    rig.watched(6);
    assert_eq!(rig.device.state(), State::Idle);
    assert_eq!(rig.start(0, 0, 5).0, 4);
    let mut rig = Rig::driving(3.0);
    assert_eq!(rig.stop(), (0, std::vec![1]));
    assert_eq!(rig.sample(), Output::SAFE);
    assert_eq!(rig.events().last(), Some(&(5, 0)));
}

#[test]
fn stop_is_answered_only_when_the_safe_output_has_been_handed_out() {
    let mut rig = Rig::driving(3.0);
    rig.listen();
    rig.commands += 1;
    let (tag, number) = (rig.tag, rig.commands);
    rig.say(0x06, tag, number, &[]);
    let mut out = [0; 300];
    assert_eq!(rig.device.transmit(&mut out), 0);
    assert_eq!(rig.device.poll(rig.now), Output::SAFE);
    assert!(rig.device.transmit(&mut out) > 0);
}

#[test]
fn another_host_trips_and_the_same_one_goes_on() {
    let mut rig = Rig::driving(3.0);
    rig.hello(77);
    assert!(rig.sample().enabled);
    rig.hello(78);
    tripped(&mut rig, Reason::HostChanged);
    let mut rig = Rig::armed();
    rig.new_session(78);
    assert_eq!(rig.device.state(), State::Idle);
    assert_eq!(rig.events().last(), Some(&(5, 7)));
}

#[test]
fn a_new_host_starts_nothing_that_the_old_one_left() {
    let mut rig = Rig::ready();
    rig.upload(0, &[1000; 5]);
    rig.new_session(78);
    rig.limits(10.0, 4000.0, INF, 20.0);
    assert_eq!(rig.arm().0, 0);
    assert_eq!(rig.start(0, 0, 5), (3, std::vec![3, 0, 0, 0]));
}

#[test]
fn nonsense_from_the_host_trips() {
    let nonsense: [(u8, &[u8]); 6] = [
        (0x05, &[0; 8]),
        (0x1F, &[]),
        (0x0A, &[1]),
        (0x04, &[0x41; 16]),
        (0x02, &[99]),
        (0x08, &[0, 9, 9, 9, 9]),
    ];
    for (kind, body) in nonsense {
        let mut rig = Rig::driving(3.0);
        assert_ne!(rig.command(kind, body).0, 0);
        tripped(&mut rig, Reason::BadCommand);
    }
    for u in [f32::NAN, f32::INFINITY, -f32::INFINITY] {
        let mut rig = Rig::driving(3.0);
        rig.drive(u);
        tripped(&mut rig, Reason::BadCommand);
    }
    for time in [0, 999, 10_000_001, u32::MAX] {
        let mut rig = Rig::driving(3.0);
        rig.beat(0x20, &time.to_le_bytes());
        tripped(&mut rig, Reason::BadCommand);
    }
}

#[test]
fn frames_of_another_boot_are_refused_without_harm() {
    let mut rig = Rig::driving(3.0);
    let tag = rig.tag;
    rig.say(0x06, tag ^ 1, rig.commands + 1, &[]);
    let came = rig.listen().pop().unwrap();
    assert_eq!((came.header.kind, came.body[4]), (0x86, 5));
    assert_eq!(came.body[5..7], (tag ^ 1).to_le_bytes());
    assert!(rig.sample().enabled);
    // the number was not used up
    assert_eq!(rig.stop().0, 0);
}

#[test]
fn a_device_without_session_hears_hello_only() {
    let mut rig = Rig::new();
    rig.samples(150);
    rig.listen();
    let tag = rig.tag;
    rig.say(0x03, tag, 1, &[]);
    rig.say(0x1F, tag, 2, &[]);
    rig.keep();
    assert!(rig.listen().is_empty());
}

#[test]
fn a_device_hears_none_of_its_own_frames() {
    let mut rig = Rig::driving(3.0);
    rig.listen();
    let tag = rig.tag;
    for kind in 0x40..=0xFF {
        rig.say(kind, tag, 1_000_000, &[0; 4]);
    }
    assert!(rig.listen().is_empty());
    assert!(rig.sample().enabled);
}

#[test]
fn the_firmware_can_stop_in_every_state() {
    let mut rig = Rig::driving(3.0);
    rig.device.trip(rig.now, Reason::StopInput);
    tripped(&mut rig, Reason::StopInput);
    let mut rig = Rig::armed();
    rig.device.trip(rig.now, Reason::StopInput);
    tripped(&mut rig, Reason::StopInput);
    rig.device.trip(rig.now, Reason::Current);
    assert_eq!(rig.device.reason(), Reason::StopInput);
    let mut rig = Rig::new();
    for _ in 0..50 {
        rig.device.trip(rig.now, Reason::StopInput);
        rig.sample();
        assert_eq!(rig.device.state(), State::Boot);
    }
}

#[test]
fn samples_that_stop_coming_are_noticed_by_poll() {
    let mut rig = Rig::driving(3.0);
    assert!(rig.device.poll(rig.now + 1999).enabled);
    rig.now += 2000;
    assert_eq!(rig.device.poll(rig.now), Output::SAFE);
    tripped(&mut rig, Reason::Late);
}

#[test]
fn samples_off_their_grid_trip() {
    // a period late; permanently half a period late; early; the clock back; the clock far ahead
    let cases: [&[i64]; 5] = [&[2000], &[1600, 1000], &[400], &[-100_000], &[i64::MAX / 2]];
    for steps in cases {
        let mut rig = Rig::driving(3.0);
        for (k, step) in steps.iter().enumerate() {
            rig.now = rig.now.saturating_add_signed(*step);
            let output = rig.sample_at(rig.now);
            assert_eq!(output.enabled, k + 1 < steps.len(), "{steps:?}");
        }
        assert!(
            matches!(rig.device.reason(), Reason::Late | Reason::Watchdog),
            "{steps:?}"
        );
    }
}

#[test]
fn jitter_is_borne_and_reported() {
    let mut rig = Rig::driving(3.0);
    let due = rig.now;
    for (k, jitter) in [900i64, 0, -400, 0, 499, 499, 700, 100]
        .into_iter()
        .enumerate()
    {
        rig.now = (due + (k as u64 + 1) * PERIOD).saturating_add_signed(jitter);
        assert!(rig.sample_at(rig.now).enabled, "{jitter}");
    }
    let (_, status) = rig.command(0x03, &[]);
    let latest = &status[status.len() - 12..status.len() - 8];
    assert_eq!(latest, 900u32.to_le_bytes());
}

#[test]
fn a_clock_that_stands_still_ends_the_run() {
    let mut rig = Rig::driving(3.0);
    let enabled = (0..60).filter(|_| rig.sample_at(rig.now).enabled).count();
    assert_eq!(enabled, 0);
    tripped(&mut rig, Reason::Late);
}

#[test]
fn time_at_its_end_is_safe() {
    let mut rig = Rig::driving(3.0);
    rig.now = u64::MAX;
    assert!(!rig.sample_at(u64::MAX).enabled);
    rig.clear();
    assert_eq!(rig.arm().0, 0);
    assert_eq!(rig.start(2, 0, 0).0, 0);
    for _ in 0..100 {
        rig.sample_at(u64::MAX);
    }
    assert_ne!(rig.device.state(), State::Running);
}

#[test]
fn half_a_frame_is_no_command_and_the_next_one_is() {
    let mut rig = Rig::ready();
    let arm = rig.wire(0x05, rig.tag, rig.commands + 1, &rig.arming(50_000));
    rig.put(&arm[..arm.len() - 1]);
    assert_eq!(rig.device.state(), State::Idle);
    rig.put(&[0]);
    assert_eq!(rig.device.state(), State::Armed);
    let mut rig = Rig::ready();
    rig.put(&arm[..10]);
    rig.put(&arm);
    assert_eq!(rig.device.state(), State::Idle);
    rig.put(&arm);
    assert_eq!(rig.device.state(), State::Armed);
}

#[test]
fn boot_takes_ten_good_samples_in_a_row() {
    let mut rig = Rig::new();
    rig.samples(9);
    rig.current = f32::NAN;
    rig.samples(20);
    rig.current = 0.0;
    rig.further = [f32::INFINITY];
    rig.samples(20);
    rig.further = [0.0];
    rig.samples(9);
    assert_eq!(rig.device.state(), State::Boot);
    rig.hello(1);
    assert_eq!(rig.arm(), (4, std::vec![0; 4]));
    rig.sample();
    assert_eq!(rig.device.state(), State::Idle);
}

#[test]
fn a_measurement_that_is_lost_trips() {
    for (current, further) in [(f32::NAN, 0.0), (f32::INFINITY, 0.0), (0.0, f32::NAN)] {
        let mut rig = Rig::driving(3.0);
        (rig.current, rig.further) = (current, [further]);
        assert!(!rig.sample().enabled);
        tripped(&mut rig, Reason::Measurement);
    }
}

#[test]
fn a_start_in_the_future_is_watched() {
    let mut rig = Rig::armed();
    let at = rig.now + 500_000;
    assert_eq!(rig.start(2, at, 0).0, 0);
    rig.watched(300);
    rig.samples(60);
    assert_eq!(rig.device.state(), State::Idle);
    rig.watched(300);
    assert_eq!(rig.device.state(), State::Idle);
    for (at, result) in [(rig.now - 1, 3), (rig.now + 10_000_001, 3), (u64::MAX, 3)] {
        assert_eq!(rig.arm().0, 0);
        assert_eq!(rig.start(2, at, 0), (result, std::vec![2, 0, 0, 0]));
        rig.stop();
    }
}

#[test]
fn a_lost_sample_before_a_planned_start_disarms() {
    let mut rig = Rig::armed();
    assert_eq!(rig.start(2, rig.now + 20_000, 0).0, 0);
    rig.watched(5);
    rig.now += PERIOD;
    rig.keep();
    rig.sample();
    assert_eq!(rig.device.state(), State::Idle);
    assert_eq!(rig.events().last(), Some(&(5, 11)));
}

#[test]
fn a_device_that_is_not_sampled_is_safe() {
    let mut rig = Rig::armed();
    assert_eq!(rig.start(2, 0, 0).0, 0);
    for _ in 0..100 {
        rig.now += PERIOD;
        rig.keep();
        assert_eq!(rig.device.poll(rig.now), Output::SAFE);
    }
    let measurement = Measurement {
        counts: 0,
        current: 0.0,
        further: &[],
    };
    assert_eq!(rig.device.sample(rig.now, &measurement), Output::SAFE);
    assert_eq!(rig.device.state(), State::Idle);
}

#[test]
fn stop_is_executed_whatever_its_number() {
    let mut rig = Rig::driving(3.0);
    let tag = identity().boot_id as u16;
    // from a host that was replaced and had counted further
    rig.say(0x03, tag, 5000, &[]);
    assert!(rig.sample().enabled);
    rig.say(0x06, tag, 7, &[]);
    assert_eq!(rig.device.poll(rig.now), Output::SAFE);
    assert_eq!(rig.device.state(), State::Idle);
    let last = rig.listen().pop().expect("an answer");
    assert_eq!(
        (last.header.kind, &last.body[..5]),
        (0x86, &[7, 0, 0, 0, 0][..])
    );
}

/// Two hosts: the second drives, and the line still holds the first one's frames, with far higher numbers.
fn replaced(u: f32) -> Rig {
    let mut rig = Rig::ready();
    rig.new_session(78);
    assert_eq!(rig.limits(10.0, 4000.0, INF, 20.0).0, 0);
    assert_eq!((rig.arm().0, rig.start(2, 0, 0).0), (0, 0));
    rig.sample();
    rig.drive(u);
    assert_eq!(rig.sample().u, u);
    rig
}

/// A frame of the first one arrives.
fn stale(rig: &mut Rig, kind: u8, sequence: u32, body: &[u8]) {
    let (session, tag) = (core::mem::replace(&mut rig.session, 77), rig.tag);
    rig.say(kind, tag, sequence, body);
    rig.session = session;
}

#[test]
fn a_replaced_host_neither_drives_nor_feeds() {
    let mut rig = replaced(3.0);
    let until = rig.now + 48_000;
    while rig.now < until {
        let drive = [50_000u32.to_le_bytes(), 9f32.to_le_bytes()].concat();
        let number = 1_000_000 + rig.now as u32;
        stale(&mut rig, 0x21, number, &drive);
        stale(&mut rig, 0x20, number + 1, &drive[..4]);
        assert_eq!(rig.sample().u, 3.0);
    }
    // only the second host's last message counts
    rig.sample();
    tripped(&mut rig, Reason::Watchdog);
    let (_, status) = rig.command(0x03, &[]);
    assert_eq!(status[status.len() - 4..], (2 * 48u32).to_le_bytes());
}

#[test]
fn the_new_host_is_heard_after_high_numbers_of_the_old_one() {
    let mut rig = replaced(3.0);
    for k in 0..200 {
        stale(&mut rig, 0x20, 5_000_000 + k, &50_000u32.to_le_bytes());
        stale(&mut rig, 0x03, 5_000_000 + k, &[]);
        // unknown, with another tag: not even a refusal, and no trip
        stale(&mut rig, 0x1F, 6_000_000 + k, &[]);
        rig.tag ^= 1;
        stale(&mut rig, 0x03, 7_000_000 + k, &[]);
        rig.tag ^= 1;
        assert!(rig.listen().iter().all(|came| came.header.kind >= 0xC0));
        rig.drive(4.0);
        assert_eq!(rig.sample().u, 4.0);
    }
    assert_eq!(rig.stop().0, 0);
}

#[test]
fn stop_of_either_host_is_executed_and_uses_no_number_of_the_other() {
    let mut rig = replaced(3.0);
    let last = rig.commands;
    for number in [1, last, 9_000_000] {
        stale(&mut rig, 0x06, number, &[]);
        assert_eq!(rig.device.poll(rig.now), Output::SAFE);
        let reply = rig.listen().pop().expect("an answer");
        assert_eq!((reply.header.kind, reply.body[4]), (0x86, 0));
        assert_eq!(reply.body[..4], number.to_le_bytes());
        assert_eq!(rig.device.state(), State::Idle);
        rig.samples(150);
        assert_eq!((rig.arm().0, rig.start(2, 0, 0).0), (0, 0));
        rig.sample();
        rig.drive(3.0);
        assert!(rig.sample().enabled);
    }
    assert_eq!(rig.stop().0, 0);
    assert_eq!(rig.device.state(), State::Idle);
}
