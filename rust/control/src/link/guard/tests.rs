use super::*;
use proptest::prelude::*;
use std::vec::Vec;

const FREE: Limits = Limits {
    volt: 20.0,
    speed: f32::INFINITY,
    acceleration: f32::INFINITY,
    current: f32::INFINITY,
};

fn guard() -> Guard {
    Guard::new(1000, 1e-3, 1500.0)
}

#[test]
fn a_watch_trips_on_speed_on_a_lost_encoder_and_on_swinging() {
    let limits = Limits {
        speed: 1000.0,
        ..FREE
    };
    let watch = || Watch::new(1e-3, 1500.0, limits, Some((-20.0, 20.0)));
    // 25 counts a millisecond are 1000 RPM; of 200 counts one is the encoder's step; a counter may wrap
    let mut turning = watch();
    let turned = |k: i32| (i32::MAX - 200).wrapping_add(26 * k);
    let fast = (0..20).position(|k| turning.take(turned(k), 1).is_err());
    assert_eq!(fast, Some(8));
    let said = turning.take(turned(9), 1).err();
    assert!(said.is_some_and(|(why, rpm)| why == Reason::Speed && (rpm - 1035.0).abs() < 0.01));
    // 60 counts in a millisecond are far more: exact samples show it at once, others in their mean
    let leaps = |k: i32| if k < 5 { 0 } else { 60 * (k - 4) };
    let (mut exact, mut late) = (watch(), watch());
    let position = (0..20).position(|k| exact.take_on_time(leaps(k), 1).is_err());
    assert_eq!(position, Some(5));
    let position = (0..20).position(|k| late.take(leaps(k), 1).is_err());
    assert_eq!(position, Some(8));
    late.forget();
    assert_eq!(late.take(9000, 1), Ok(()));
    // one step of a sensor with 6 steps a turn is 1,250 RPM in 8 samples of a millisecond
    let mut coarse = Watch::new(1e-3, 6.0, limits, None);
    assert!((0..2000).all(|k| coarse.take(k / 12, 1).is_ok()));
    let mut lost = watch();
    let mut stands = |u| lost.take(7, 1).is_err() || lost.sent(u).is_err();
    let stuck = (0..1000).position(|_| stands(15.0));
    assert_eq!(stuck, Some(250));
    assert!(lost.at_rest());
    let mut swings = watch();
    let ended = (0..1000).find_map(|k| {
        assert_eq!(swings.take(k, 1), Ok(()));
        swings.sent(if k % 40 < 20 { 20.0 } else { -20.0 }).err()
    });
    assert!(matches!(
        ended,
        Some(Alarm::Trip((Reason::Swinging, hertz))) if (hertz - 25.0).abs() < 1.0
    ));
    // at a period of a second ten samples pass before a motor counts as standing
    let mut slow = Watch::new(1.0, 1500.0, limits, None);
    let mut stands = |u| slow.take(7, 1).is_err() || slow.sent(u).is_err();
    let stuck = (0..100).position(|_| stands(15.0));
    assert_eq!(stuck, Some(10));
}

/// The sample of 200 at which a watch alarms, of an encoder that counts `counts(k)` under `u(k)`.
fn alarmed(counts: impl Fn(i32) -> i32, u: impl Fn(i32) -> f32) -> Option<(i32, Alarm)> {
    let limits = Limits {
        speed: 4000.0,
        ..FREE
    };
    let mut watch = Watch::new(1e-3, 1500.0, limits, None);
    (0..200).find_map(|k| {
        assert_eq!(watch.take(counts(k), 1), Ok(()));
        watch.sent(u(k)).err().map(|alarm| (k, alarm))
    })
}

#[test]
fn counts_that_stop_halve_or_turn_within_a_sample_alarm_after_ten() {
    // 20 counts a sample until sample 100, then `after` a sample; 800 RPM
    let faulty = |after: i32| move |k: i32| 20 * k.min(100) + after * (k - 100).max(0);
    for after in [0, 10, -20] {
        // a loop pushes harder, or a steady command stays
        for harder in [0.0, 0.1] {
            let u = |k: i32| 4.0 + harder * (k - 100).max(0) as f32;
            let found = alarmed(faulty(after), u);
            assert_eq!(found, Some((110, Alarm::Lost(u(110)))), "{after}");
        }
        // a command that falls with the speed, or brakes, explains it
        assert_eq!(
            alarmed(faulty(after), |k| if k < 98 { 4.0 } else { 2.0 }),
            None
        );
        assert_eq!(alarmed(faulty(after), |_| -4.0), None);
    }
    // what a shaft can do: lose a third, speed up, stop within 10 ms, or stand for less than that
    let brakes =
        |k: i32| 20 * k.min(100) + (0..(k - 100).clamp(0, 10)).map(|i| 18 - 2 * i).sum::<i32>();
    let pauses = |k: i32| 20 * k.min(100) + 20 * (k - 108).max(0);
    assert_eq!(alarmed(faulty(13), |_| 4.0), None);
    assert_eq!(alarmed(faulty(60), |_| 4.0), None);
    assert_eq!(alarmed(brakes, |_| 4.0), None);
    // a turned command brakes with a quarter of the speed a sample
    let turned = |k: i32| {
        if k < 100 {
            20 * k
        } else {
            2000 + [15, 26, 34, 39, 42, 42, 39, 33, 24, 12, -3, -20, -40]
                [(k as usize - 100).min(12)]
        }
    };
    assert_eq!(alarmed(turned, |_| 4.0), None);
    assert_eq!(alarmed(pauses, |_| 4.0), None);
    // a creeping shaft may be held by friction: 3 counts a sample are 120 RPM of 4,000
    assert_eq!(alarmed(|k| 3 * k.min(100), |_| 4.0), None);
}

#[test]
fn speed_and_acceleration_are_their_definitions() {
    let mut guard = guard();
    for k in 0..40 {
        guard.take(k * k);
    }
    let per_count = 60.0 / (8.0 * 1e-3 * 1500.0);
    let window = |k: i32| (k * k - (k - 8) * (k - 8)) as f32;
    assert_eq!(guard.speed(), window(39) * per_count);
    let expected = (window(39) - window(23)) * per_count / 16e-3;
    assert!((guard.acceleration() - expected).abs() < 1e-4 * expected);
}

/// The largest detected acceleration of a swinging speed, relative to its largest true one.
///
/// `size` is the true acceleration [RPM/s], `phase` the part of a period at the first sample.
fn seen(counts_per_rev: f64, frequency: f64, size: f64, base: f64, phase: f64) -> f64 {
    let mut guard = Guard::new(1000, 1e-3, counts_per_rev as f32);
    let omega = core::f64::consts::TAU * frequency;
    let turns = size / 60.0 / (omega * omega);
    let count = |k: i32| {
        let t = 1e-3 * f64::from(k);
        let angle = omega * t + core::f64::consts::TAU * phase;
        (counts_per_rev * (base / 60.0 * t + turns * angle.sin())).floor() as i32
    };
    // the first second: the history is full, and a swing of 1 Hz has passed its maximum
    let samples = (0..1100).map(|k| {
        guard.take(count(k));
        if k < 40 {
            0.0
        } else {
            guard.acceleration().abs()
        }
    });
    f64::from(samples.fold(0.0, f32::max)) / size
}

/// Frequencies from 1 to 400 Hz, including the blind one and fractions of the sample rate.
fn frequencies() -> impl Iterator<Item = f64> {
    let odd = [
        62.5,
        83.333_333,
        125.0,
        142.857,
        166.666_667,
        333.333_333,
        0.5 * 62.5,
    ];
    (1..=400).map(f64::from).chain(odd)
}

#[test]
fn sees_two_thirds_of_any_acceleration_from_1_to_400_hz_and_no_more_than_all() {
    // A swing so large that the encoder's steps do not matter.
    let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
    for frequency in frequencies() {
        for phase in 0..8 {
            // at most 2000 RPM in either direction: beyond it the counter exceeds what a test counts
            let size = (2000.0 * core::f64::consts::TAU * frequency).min(5e6);
            let ratio = seen(1572e3, frequency, size, 500.0, f64::from(phase) / 16.0);
            assert!(ratio > 1.0 / 1.5 && ratio < 1.02, "{frequency} Hz: {ratio}");
            (least, most) = (least.min(ratio), most.max(ratio));
        }
    }
    std::println!("seen over true: {least:.3} to {most:.3}");
}

#[test]
fn sees_a_shaft_that_swings_at_62_hz_on_the_encoder_of_the_machine() {
    // 138,000 RPM/s at 62.5 Hz, of which only 3,600 used to be detected
    for phase in 0..32 {
        let ratio = seen(1572.0, 62.5, 138_000.0, 300.0, f64::from(phase) / 64.0);
        assert!(ratio > 1.0 / 1.5 && ratio < 1.02, "{ratio}");
    }
    for frequency in 1..=80 {
        let ratio = seen(1572.0, frequency.into(), 138_000.0, 300.0, 0.1);
        assert!(ratio > 1.0 / 1.5 && ratio < 1.02, "{frequency} Hz: {ratio}");
    }
}

proptest! {
    #[test]
    fn steps_of_the_encoder_are_no_acceleration(
        counts_per_rev in 4.0..5000.0_f64, speed in -6000.0..6000.0_f64, phase in 0.0..1.0_f64, wobble in 0.0..20_000.0_f64,
        frequency in 1.0..400.0_f64,
    ) {
        // the detected value is at most the true one plus the step of the widest span
        let mut guard = Guard::new(1000, 1e-3, counts_per_rev as f32);
        let omega = core::f64::consts::TAU * frequency;
        let turns = wobble / 60.0 / (omega * omega);
        for k in 0..200 {
            let t = 1e-3 * f64::from(k);
            let place = speed / 60.0 * t + turns * (omega * t).sin();
            guard.take((counts_per_rev * place + phase).floor() as i32);
            if k >= 40 {
                let step = 2.0 * 60.0 / (128e-6 * counts_per_rev);
                let most = (wobble * 1.02).max(wobble + step);
                prop_assert!(f64::from(guard.acceleration().abs()) <= most * 1.0001, "{}", guard.acceleration());
            }
        }
    }

    #[test]
    fn a_command_that_does_not_reach_both_limits_may_swing(
        u in prop::collection::vec(-8.9_f32..10.0, 400), high in 10.0_f32..20.0,
    ) {
        let mut guard = guard();
        guard.take(0);
        for u in u {
            prop_assert_eq!(guard.expect_calm(-high, high, u), Ok(()));
        }
    }
}

/// The sample at which a square wave of `half` samples a side trips, and the reported frequency.
fn swung(half: u32, size: f32) -> Option<(u32, f32)> {
    let mut guard = guard();
    guard.begin();
    (0..20 * half).find_map(|k| {
        let u = if (k / half).is_multiple_of(2) {
            size
        } else {
            -size
        };
        guard.expect_calm(-10.0, 10.0, u).err().map(|(reason, f)| {
            assert_eq!(reason, Reason::Swinging);
            (k, f)
        })
    })
}

#[test]
fn swinging_between_the_limits_trips_and_its_frequency_is_named() {
    for half in [1, 8, 60, 250] {
        let (at, frequency) = swung(half, 9.5).unwrap();
        assert_eq!(at, 8 * half);
        assert!(
            (frequency * 2e-3 * half as f32 - 1.0).abs() < 1e-5,
            "{frequency}"
        );
    }
    assert_eq!(swung(251, 10.0), None);
    assert_eq!(swung(8, 8.9), None);
    let mut guard = guard();
    // a command that stays at one limit, or returns to it, does not swing
    let calm: Vec<_> = (0..400)
        .map(|k| guard.expect_calm(0.0, 10.0, [10.0, 5.0][k % 2]))
        .collect();
    assert!(calm.iter().all(Result::is_ok));
}

#[test]
fn trips_within_8_and_24_samples_of_the_excess() {
    let speed = Limits {
        speed: 1000.0,
        ..FREE
    };
    let mut watched = guard();
    watched.take(0);
    // 1040 RPM are 26 counts a sample
    let trip = (1..).find(|k| {
        watched.take(26 * k);
        watched.check(&speed, f32::NAN).is_err()
    });
    assert!(trip.unwrap() <= 8, "{trip:?}");
    let acceleration = Limits {
        acceleration: 10_000.0,
        ..FREE
    };
    let mut watched = guard();
    watched.take(0);
    let trip = (1..).find(|k: &i32| {
        // 12,000 RPM/s are .3 counts/sample^2
        watched.take((0.15 * f64::from(k * k)) as i32);
        watched.check(&acceleration, f32::NAN).is_err()
    });
    assert!(trip.unwrap() <= 24, "{trip:?}");
}

#[test]
fn the_first_counts_are_no_motion_and_a_wrap_is_none() {
    let mut guard = guard();
    guard.take(i32::MAX);
    assert_eq!((guard.speed(), guard.acceleration()), (0.0, 0.0));
    guard.take(i32::MIN);
    assert_eq!(guard.change(), 1);
    assert!((guard.speed() - 5.0).abs() < 1e-5);
    guard.forget();
    guard.take(-77);
    assert_eq!((guard.change(), guard.counts()), (0, -77));
}

#[test]
fn current_counts_where_there_is_one() {
    let mut guard = guard();
    guard.take(0);
    let limits = Limits {
        current: 5.0,
        ..FREE
    };
    assert_eq!(guard.check(&limits, -6.0), Err((Reason::Current, -6.0)));
    assert_eq!(guard.check(&limits, 5.0), Ok(()));
    assert_eq!(guard.check(&limits, f32::NAN), Ok(()));
}

#[test]
fn rests_after_100_ms_and_loses_patience_after_250() {
    let mut guard = guard();
    guard.take(0);
    let rest = (1..).find(|_| {
        guard.take(1);
        guard.at_rest()
    });
    assert_eq!(rest, Some(101));
    guard.begin();
    let stuck = (0..).find(|_| {
        guard.take(1);
        guard.expect_motion(&FREE, -10.0).is_err()
    });
    assert_eq!(stuck, Some(250));
    guard.take(2);
    assert_eq!(guard.expect_motion(&FREE, 10.0), Ok(()));
    for _ in 0..1000 {
        guard.take(2);
        assert_eq!(guard.expect_motion(&FREE, 9.9), Ok(()));
    }
}

proptest! {
    #[test]
    fn any_counts_give_numbers(counts in prop::collection::vec(any::<i32>(), 1..60)) {
        let mut guard = guard();
        for count in counts {
            guard.take(count);
            prop_assert!(guard.speed().is_finite() && guard.acceleration().is_finite());
        }
    }
}
