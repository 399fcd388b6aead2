//! Limits hold for any request.

use super::rig::*;
use crate::Biquad;
use crate::link::identity::capability as can;
use crate::link::{Identity, Limits, Reason, State};

fn detail(index: u8) -> Vec<u8> {
    vec![index, 0, 0, 0]
}

use std::vec;
use std::vec::Vec;

#[test]
fn limits_keep_within_the_ceilings() {
    let mut rig = Rig::ready();
    assert_eq!(rig.limits(20.0, 5000.0, INF, 30.0).0, 0);
    for nothing in [f32::NAN, 0.0, -1.0, -INF] {
        assert_eq!(rig.limits(nothing, 1.0, 1.0, 1.0), (3, detail(0)));
        assert_eq!(rig.limits(1.0, nothing, 1.0, 1.0), (3, detail(1)));
        assert_eq!(rig.limits(1.0, 1.0, nothing, 1.0), (3, detail(2)));
        assert_eq!(rig.limits(1.0, 1.0, 1.0, nothing), (3, detail(3)));
    }
    assert_eq!(rig.limits(20.1, 1.0, 1.0, 1.0), (6, detail(0)));
    assert_eq!(rig.limits(1.0, INF, 1.0, 1.0), (6, detail(1)));
    assert_eq!(rig.limits(1.0, 1.0, 1.0, 31.0), (6, detail(3)));
    let (result, body) = rig.limits(0.0, 0.0, -0.0, 0.0);
    let expected = [20.0, 5000.0, INF, 30.0, 20.0, 5000.0, INF, 30.0];
    assert_eq!((result, body), (0, expected.map(f32::to_le_bytes).concat()));
    rig.arm();
    assert_eq!(rig.limits(1.0, 1.0, 1.0, 1.0), (4, detail(2)));
    assert_eq!(rig.limits(0.0, 0.0, 0.0, 0.0).0, 0);
}

#[test]
fn a_current_that_is_not_measured_has_no_limit() {
    let mut rig = Rig::with(Identity {
        capabilities: can::DRIVE,
        ceilings: Limits {
            current: INF,
            ..identity().ceilings
        },
        channels: &CHANNELS[..2],
        ..identity()
    });
    rig.current = f32::NAN;
    rig.hello(1);
    rig.samples(150);
    assert_eq!(rig.limits(1.0, 1.0, 1.0, 20.0), (8, detail(3)));
    assert_eq!(rig.limits(1.0, 1.0, 1.0, INF).0, 0);
    rig.arm();
    assert_eq!(rig.start(2, 0, 0).0, 0);
    rig.watched(30);
    assert_eq!(rig.device.state(), State::Running);
}

#[test]
fn nothing_moves_before_limits_are_set_or_while_the_motor_turns() {
    let mut rig = Rig::new();
    rig.hello(1);
    rig.samples(150);
    assert_eq!(rig.arm(), (12, detail(0)));
    rig.limits(10.0, 4000.0, INF, 20.0);
    rig.counts = 1;
    rig.samples(100);
    assert_eq!(rig.arm(), (11, detail(0)));
    rig.sample();
    assert_eq!(rig.arm().0, 0);
}

#[test]
fn commands_are_clipped_and_the_flag_says_so() {
    let mut rig = Rig::driving(3.0);
    for (asked, given, clipped) in [(11.0, 10.0, 1), (-1e30, -10.0, 1), (10.0, 10.0, 0)] {
        rig.samples(30);
        rig.came.clear();
        for k in 0..20 {
            rig.counts += k % 2;
            rig.drive(asked);
            assert_eq!(rig.sample().u, given);
        }
        rig.listen();
        let last = rig.came.iter().rfind(|came| came.header.kind == 0xC0);
        assert_eq!(last.unwrap().body[0], clipped);
    }
}

#[test]
fn speed_acceleration_and_current_trip() {
    let trip = |limits: [f32; 4], act: fn(&mut Rig, i32)| {
        let mut rig = Rig::ready();
        let [volt, speed, acceleration, current] = limits;
        assert_eq!(rig.limits(volt, speed, acceleration, current).0, 0);
        rig.arm();
        rig.start(2, 0, 0);
        rig.watched(50);
        let at = (1..100).find(|&k| {
            act(&mut rig, k);
            rig.keep();
            !rig.sample().enabled
        });
        (at, rig.device.reason())
    };
    let free = [10.0, 5000.0, INF, 30.0];
    let slow = [10.0, 1000.0, INF, 30.0];
    let smooth = [10.0, 5000.0, 10_000.0, 30.0];
    assert_eq!(trip(free, |rig, _| rig.counts -= 100).0, None);
    assert_eq!(
        trip(slow, |rig, _| rig.counts -= 26),
        (Some(8), Reason::Speed)
    );
    // 25 counts a sample are exactly the limit
    assert_eq!(trip(slow, |rig, _| rig.counts += 25).0, None);
    assert_eq!(
        trip(smooth, |rig, _| rig.counts += 8).1,
        Reason::Acceleration
    );
    assert_eq!(
        trip(free, |rig, _| rig.current = -30.1),
        (Some(1), Reason::Current)
    );
    assert_eq!(
        trip(free, |rig, _| rig.counts = i32::MIN),
        (Some(1), Reason::Speed)
    );
    assert_eq!(
        trip(free, |rig, k| rig.counts = i32::MAX.wrapping_mul(k)).1,
        Reason::Speed
    );
}

#[test]
fn a_large_command_without_motion_trips() {
    let mut rig = Rig::driving(5.0);
    rig.came.clear();
    let at = (2..).find(|_| {
        rig.keep();
        !rig.sample().enabled
    });
    assert_eq!((at, rig.device.reason()), (Some(251), Reason::NoMotion));
    rig.listen();
    let event = rig.came.iter().rfind(|came| came.header.kind == 0xC1);
    assert_eq!(event.unwrap().body[11..], 5f32.to_le_bytes());
    let mut rig = Rig::driving(4.9);
    rig.watched(2000);
    assert_eq!(rig.device.state(), State::Running);
}

#[test]
fn profiles_beyond_the_limits_do_not_start() {
    let mut rig = Rig::ready();
    assert_eq!(rig.upload(0, &[0, 10_000, -10_000]).0, 0);
    assert_eq!(rig.upload(0, &[0, 10_000, -10_001]), (6, detail(2)));
    // the refused one has left the first unchanged
    assert_eq!(rig.upload(3, &[1]).0, 0);
    for value in [4000.1, -4000.1, f32::NAN, INF, -INF] {
        assert_eq!(rig.references(0, &[0.0, value]), (6, detail(1)));
    }
    rig.limits(9.9, 4000.0, INF, 20.0);
    rig.arm();
    assert_eq!(rig.start(0, 0, 3), (6, detail(0)));
    rig.stop();
    rig.limits(10.0, 4000.0, INF, 20.0);
    rig.arm();
    assert_eq!(rig.start(0, 0, 3).0, 0);
}

#[test]
fn gains_do_not_change_behind_a_planned_start() {
    let good = [
        0.02, 0.25, 0.004, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
    ];
    let body = gains(good, 8);
    let mut rig = Rig::armed();
    assert_eq!(rig.command(0x09, body.bytes().unwrap()).0, 0);
    assert_eq!(rig.references(0, &[100.0; 5]).0, 0);
    let at = rig.now + 20_000;
    assert_eq!(rig.start(1, at, 5).0, 0);
    let refused = rig.command(0x09, body.bytes().unwrap());
    assert_eq!(refused, (4, detail(State::Armed as u8)));
    rig.watched(21);
    assert_eq!(rig.device.state(), State::Running);
}

#[test]
fn limits_are_of_the_session_that_set_them() {
    let mut rig = Rig::ready();
    rig.hello(77);
    let (_, same) = rig.limits(0.0, 0.0, 0.0, 0.0);
    assert_eq!(same[..4], 10f32.to_le_bytes());
    rig.new_session(78);
    let (result, anew) = rig.limits(0.0, 0.0, 0.0, 0.0);
    assert_eq!((result, &anew[..16]), (0, &[0; 16][..]));
    assert_eq!(rig.arm(), (12, detail(0)));
    assert_eq!(rig.limits(5.0, 4000.0, INF, 20.0).0, 0);
    assert_eq!(rig.arm().0, 0);
}

#[test]
fn gains_that_make_no_sense_are_refused_by_field() {
    let good = [
        0.02, 0.25, 0.004, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
    ];
    let mut rig = Rig::ready();
    let mut set = |field: usize, value: f32, samples: u8| {
        let mut values = good;
        if let Some(slot) = values.get_mut(field) {
            *slot = value;
        }
        let (result, body) = rig.command(0x09, gains(values, samples).bytes().unwrap());
        (result, body.first().copied().unwrap_or(0))
    };
    assert_eq!(set(12, 0.0, 8), (0, 0));
    for field in 0..12 {
        assert_eq!(set(field, f32::NAN, 8), (3, field as u8), "field {field}");
    }
    assert_eq!((set(12, 0.0, 0), set(12, 0.0, 65)), ((3, 12), (3, 12)));
    assert_eq!((set(1, 0.0, 1), set(11, 0.0, 1)), ((3, 1), (3, 11)));
    assert_eq!((set(11, INF, 1), set(11, 1e-35, 1)), ((3, 11), (3, 11)));
    // the limits of the controller lie on one side of the device's
    assert_eq!(set(7, 11.0, 1), (6, 8));
}

#[test]
fn designs_that_make_no_sense_are_refused_by_field() {
    let good = [
        0.02, 0.25, 0.004, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
    ];
    let mut rig = Rig::ready();
    let mut set = |observer, rate, points: &[[f32; 4]]| {
        let body = design(good, 8, observer, rate, points);
        let (result, body) = rig.command(0x09, body.bytes().unwrap());
        (result, body.first().copied().unwrap_or(0))
    };
    let point = |i: usize| [100.0 * i as f32, 0.01, 0.2, 0.0];
    let points: Vec<_> = (0..10).map(point).collect();
    for count in 0..=8 {
        assert_eq!(set(0.004, 5000.0, &points[..count]), (0, 0));
    }
    assert_eq!(set(0.0, INF, &points[..9]), (3, 15));
    assert_eq!(set(0.0, INF, &points), (3, 15));
    assert_eq!(
        (set(-1.0, INF, &[]), set(INF, INF, &[])),
        ((3, 13), (3, 13))
    );
    assert_eq!(
        (set(0.0, 0.0, &[]), set(0.0, f32::NAN, &[])),
        ((3, 14), (3, 14))
    );
    assert_eq!(set(0.0, INF, &[point(1), point(0)]), (3, 15));
    assert_eq!(set(0.0, INF, &[[0.0, f32::NAN, 1.0, 0.0]]), (3, 15));
    let whole = design(good, 8, 0.004, 5000.0, &points[..8]);
    for length in 50..whole.len() {
        let cut = rig.command(0x09, &whole.bytes().unwrap()[..length]);
        assert_eq!(cut, (2, std::vec![length as u8, 0, 0, 0]));
    }
}

#[test]
fn a_device_without_them_refuses_observer_ramp_and_schedule() {
    let capabilities = identity().capabilities & !crate::link::capability::DESIGN;
    let mut rig = Rig::with(Identity {
        capabilities,
        ..identity()
    });
    rig.hello(77);
    rig.samples(150);
    let good = [
        0.02, 0.25, 0.004, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
    ];
    let long = design(good, 8, 0.0, INF, &[]);
    let answer = rig.command(0x09, long.bytes().unwrap());
    assert_eq!(answer, (8, std::vec![13, 0, 0, 0]));
    assert_eq!(rig.command(0x09, gains(good, 8).bytes().unwrap()).0, 0);
}

#[test]
fn biquads_that_make_no_sense_are_refused_by_field() {
    let good = Biquad::notch(60.0, 0.1, 0.5, 1e-3).unwrap();
    let mut rig = Rig::ready();
    let mut set = |sections: &[Biquad<f32>]| {
        let (result, body) = rig.command(0x0C, biquads(sections).bytes().unwrap());
        (result, body.first().copied().unwrap_or(0))
    };
    assert_eq!(set(&[good]), (3, 0), "no gains");
    let body = gains(
        [
            0.02, 0.25, 0.004, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
        ],
        8,
    );
    assert_eq!(rig.command(0x09, body.bytes().unwrap()).0, 0);
    let mut set = |sections: &[Biquad<f32>]| {
        let (result, body) = rig.command(0x0C, biquads(sections).bytes().unwrap());
        (result, body.first().copied().unwrap_or(0))
    };
    for count in 0..=4 {
        assert_eq!(set(&[good; 4][..count]), (0, 0));
    }
    assert_eq!((set(&[good; 5]), set(&[good; 9])), ((3, 0), (3, 0)));
    let (a2, c0) = (1.0, f32::NAN);
    assert_eq!(set(&[Biquad { a2, ..good }, good]), (3, 1));
    assert_eq!(set(&[good, good, Biquad { c0, ..good }]), (3, 9));
    let whole = biquads(&[good; 3]);
    for length in 0..whole.len() {
        let cut = rig.command(0x0C, &whole.bytes().unwrap()[..length]);
        assert_eq!(cut, (2, std::vec![length as u8, 0, 0, 0]));
    }
}

#[test]
fn a_feedforward_that_makes_no_sense_is_refused_and_gains_take_it_away() {
    let levels = [[-3000.0, -6.0], [3000.0, 6.0]];
    let mut rig = Rig::ready();
    let mut set = |preview, late, levels: &[[f32; 2]], taps: &[f32]| {
        let body = feedforward(preview, late, levels, taps);
        rig.command(0x0E, body.bytes().unwrap()).0
    };
    assert_eq!(set(8, 0.5, &levels, &[0.01]), 3, "no gains");
    let values = [
        0.02, 0.25, 0.004, 0.4, 0.2, INF, 0.0, -20.0, 20.0, INF, 0.0, 25.0,
    ];
    let body = gains(values, 8);
    assert_eq!(rig.command(0x09, body.bytes().unwrap()).0, 0);
    let mut set = |preview, late, levels: &[[f32; 2]], taps: &[f32]| {
        let body = feedforward(preview, late, levels, taps);
        rig.command(0x0E, body.bytes().unwrap()).0
    };
    for (preview, late, levels, taps, result) in [
        (8, 0.5, &levels[..], &[0.01; 16][..], 0),
        (30, 1.0, &levels, &[], 0),
        (0, 0.0, &[], &[0.01], 0),
        (0, 0.0, &[], &[], 0),
        (31, 0.5, &levels, &[], 3),
        (8, 1.1, &levels, &[], 3),
        (8, f32::NAN, &levels, &[], 3),
        (8, 0.5, &[levels[1], levels[0]], &[], 3),
        (8, 0.5, &levels, &[f32::INFINITY], 3),
        (8, 0.5, &levels, &[0.01; 17], 3),
        (8, 0.5, &[[0.0, 0.0]; 12], &[], 3),
    ] {
        assert_eq!(set(preview, late, levels, taps), result, "{preview} {late}");
    }
    let whole = feedforward(8, 0.5, &levels, &[0.01; 3]);
    for length in 0..whole.len() {
        let cut = rig.command(0x0E, &whole.bytes().unwrap()[..length]);
        assert_eq!(cut, (2, std::vec![length as u8, 0, 0, 0]));
    }
}

#[test]
fn a_device_without_it_refuses_feedforward() {
    let capabilities = identity().capabilities & !crate::link::capability::FEEDFORWARD;
    let mut rig = Rig::with(Identity {
        capabilities,
        ..identity()
    });
    rig.hello(77);
    rig.samples(150);
    let refused = rig.command(0x0E, feedforward(0, 0.0, &[], &[]).bytes().unwrap());
    assert_eq!(refused, (8, std::vec![0; 4]));
}

#[test]
fn a_device_without_them_refuses_biquads() {
    let capabilities = identity().capabilities & !crate::link::capability::BIQUADS;
    let mut rig = Rig::with(Identity {
        capabilities,
        ..identity()
    });
    rig.hello(77);
    rig.samples(150);
    let refused = rig.command(0x0C, biquads(&[]).bytes().unwrap());
    assert_eq!(refused, (8, std::vec![0; 4]));
}

#[test]
fn a_device_refuses_to_be_what_it_cannot_be() {
    let name = |identity: Identity| {
        let device = crate::link::Device::<8>::new(identity);
        device.map(|_| "").unwrap_or_else(|refused| refused.name)
    };
    let sound = identity();
    let ceiling = |ceilings| Identity { ceilings, ..sound };
    let volt = |volt| {
        ceiling(Limits {
            volt,
            ..sound.ceilings
        })
    };
    assert_eq!(name(sound), "");
    assert_eq!(
        name(Identity {
            name: "a name of more than 24 bytes",
            ..sound
        }),
        "name"
    );
    assert_eq!(name(Identity { period: 0, ..sound }), "period");
    for counts_per_rev in [f32::NAN, 0.0, -1500.0, f32::MIN_POSITIVE, 0.9, 2e9, INF] {
        let bad = Identity {
            counts_per_rev,
            ..sound
        };
        assert_eq!(name(bad), "counts_per_rev", "{counts_per_rev}");
    }
    for bad in [0.0, -1.0, f32::NAN, INF, 33.0] {
        assert_eq!(name(volt(bad)), "volt", "{bad}");
    }
    assert_eq!(
        name(ceiling(Limits {
            speed: f32::NAN,
            ..sound.ceilings
        })),
        "speed"
    );
    assert_eq!(
        name(Identity {
            capabilities: 0,
            ..sound
        }),
        "current"
    );
    assert_eq!(
        name(Identity {
            channels: &CHANNELS[..1],
            ..sound
        }),
        "channels"
    );
    assert_eq!(
        name(Identity {
            channels: &CHANNELS[1..],
            ..sound
        }),
        "channels"
    );
}
