//! The schedule against its definition, and what it refuses.

use super::*;
use proptest::prelude::*;
use std::vec::Vec;

const TS: f64 = 1e-3;

fn gains() -> impl Strategy<Value = Standard<f64>> {
    let ti = prop_oneof![0.01..10.0, Just(f64::INFINITY)];
    (0.0..2.0, ti, 0.0..0.1).prop_map(|(kp, ti, td)| Standard { kp, ti, td })
}

fn points() -> impl Strategy<Value = Vec<Point<f64>>> {
    prop::collection::vec((1.0..500.0, gains()), 1..=POINTS).prop_map(|steps| {
        let mut speed = 0.0;
        let mut next = |(step, gains)| {
            speed += step;
            Point { speed, gains }
        };
        steps.into_iter().map(&mut next).collect()
    })
}

/// `Kp`, `Kp/Ti`, `Kp Td` at a speed, by hand.
fn by_definition(points: &[Point<f64>], size: f64) -> [f64; 3] {
    let parallel = |g: Standard<f64>| [g.kp, g.kp / g.ti, g.kp * g.td];
    let (first, last) = (points[0], points[points.len() - 1]);
    if size <= first.speed {
        return parallel(first.gains);
    }
    if size >= last.speed {
        return parallel(last.gains);
    }
    let next = points.iter().position(|p| p.speed > size).unwrap();
    let (low, high) = (points[next - 1], points[next]);
    let share = (size - low.speed) / (high.speed - low.speed);
    let (a, b) = (parallel(low.gains), parallel(high.gains));
    [0, 1, 2].map(|i| (1.0 - share) * a[i] + share * b[i])
}

fn table(points: &[Point<f64>], n: f64) -> Table<f64> {
    let unused = Standard {
        kp: 9.0,
        ti: 9.0,
        td: 9.0,
    };
    let settings = Settings {
        n,
        ..Settings::new(unused, TS)
    };
    Table::new(&Schedule::new(points).unwrap(), &settings).unwrap()
}

proptest! {
    #[test]
    fn parallel_gains_are_linear_between_points_and_held_outside(
        points in points(), y in -5000.0..5000.0, n in prop_oneof![1.0..20.0, Just(f64::INFINITY)],
    ) {
        let [kp, ki, kd] = by_definition(&points, f64::abs(y));
        // the same by the constant gains of that speed
        let td = if kp == 0.0 { 0.0 } else { kd / kp };
        let exact = Terms::new(kp, ki * TS, td, n, TS);
        prop_assert!(table(&points, n).at(y).close_to(&exact, 1e-9));
    }

    #[test]
    fn equal_points_give_their_gains_to_the_last_bit(
        gains in gains(), y in -2000.0..2000.0, negative: bool, n in 1.0..20.0, count in 1..=POINTS,
    ) {
        let kp = if negative { -gains.kp } else { gains.kp };
        let gains = Standard { kp, ..gains };
        let points: Vec<_> =
            (0..count).map(|i| Point { speed: 137.0 * i as f64, gains }).collect();
        let settings = Settings { n, ..Settings::new(gains, TS) };
        let constant = Terms::constant(&settings);
        prop_assert!(table(&points, n).at(y).close_to(&constant, 0.0));
    }
}

#[test]
fn a_point_gives_its_own_gains() {
    let gains = |kp| Standard {
        kp,
        ti: 0.3,
        td: 0.01,
    };
    let points: Vec<_> = (0..POINTS)
        .map(|i| Point {
            speed: 100.0 * i as f64,
            gains: gains(0.01 + 0.007 * i as f64),
        })
        .collect();
    let table = table(&points, 8.0);
    for Point { speed, gains } in points {
        let settings = Settings {
            n: 8.0,
            ..Settings::new(gains, TS)
        };
        let exact = Terms::constant(&settings);
        assert!(table.at(speed).close_to(&exact, 0.0));
        assert!(table.at(-speed).close_to(&exact, 0.0));
    }
}

#[test]
fn an_empty_schedule_is_none() {
    let settings = Settings::new(
        Standard {
            kp: 1.0,
            ti: 1.0,
            td: 0.0,
        },
        TS,
    );
    assert!(Table::new(&Schedule::NONE, &settings).is_none());
    assert_eq!(Schedule::<f64>::new(&[]), Ok(Schedule::NONE));
    assert!(Schedule::<f32>::NONE.is_empty());
}

#[test]
fn refuses_schedules_that_make_no_sense() {
    let point = |speed, kp, ti, td| Point {
        speed,
        gains: Standard { kp, ti, td },
    };
    let good = point(10.0, 1.0, 1.0, 0.0);
    let refused = |points: &[Point<f64>]| {
        let refused = Schedule::new(points).unwrap_err();
        assert_eq!(refused.name, "schedule");
        refused.expected
    };
    assert!(refused(&[good; 9]).contains("at most 8"));
    assert!(refused(&[good, good]).contains("growing"));
    assert!(refused(&[good, point(5.0, 1.0, 1.0, 0.0)]).contains("growing"));
    assert!(
        refused(&[point(0.0, 1.0, 1.0, 0.0), point(1e-320, 1.0, 1.0, 0.0)]).contains("growing")
    );
    assert!(refused(&[point(-1.0, 1.0, 1.0, 0.0)]).contains("0 or more"));
    assert!(refused(&[point(f64::NAN, 1.0, 1.0, 0.0)]).contains("0 or more"));
    assert!(refused(&[point(f64::INFINITY, 1.0, 1.0, 0.0)]).contains("0 or more"));
    assert!(refused(&[point(0.0, f64::NAN, 1.0, 0.0)]).contains("Kp"));
    assert!(refused(&[point(0.0, 1.0, 0.0, 0.0)]).contains("Ti"));
    assert!(refused(&[point(0.0, 1.0, 1.0, -1.0)]).contains("Td"));
    assert!(refused(&[good, point(20.0, -1.0, 1.0, 0.0)]).contains("sign"));
    assert!(Schedule::new(&[good, point(20.0, 0.0, 1.0, 0.0)]).is_ok());
}
