//! Gains over speed: points as given, and rows as used.

use crate::pid::Terms;
use crate::{Real, Refused, Settings, Standard};

/// The most points of a schedule.
pub const POINTS: usize = 8;

/// Gains at one speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point<T> {
    /// Size of the filtered output \[y\], 0 or more.
    pub speed: T,
    /// The gains there, in standard form.
    pub gains: Standard<T>,
}

/// Up to [`POINTS`] points with growing speeds; empty for constant gains.
///
/// ```
/// use sewfast_control::{Point, Schedule, Standard};
///
/// let slow = Point { speed: 300.0, gains: Standard { kp: 0.01, ti: 0.3, td: 0.0 } };
/// let fast = Point { speed: 2000.0, gains: Standard { kp: 0.02, ti: 0.2, td: 0.0 } };
/// assert_eq!(Schedule::new(&[slow, fast])?.points(), [slow, fast]);
/// assert!(Schedule::new(&[fast, slow]).is_err());
/// # Ok::<(), sewfast_control::Refused>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Schedule<T> {
    points: [Point<T>; POINTS],
    length: usize,
}

impl<T: Real> Schedule<T> {
    /// No points: constant gains.
    pub const NONE: Self = Self {
        points: [Point {
            speed: T::ZERO,
            gains: Standard {
                kp: T::ZERO,
                ti: T::INFINITY,
                td: T::ZERO,
            },
        }; POINTS],
        length: 0,
    };

    /// A schedule through `points`.
    ///
    /// # Errors
    /// More than [`POINTS`] points; speeds that are not finite, below 0 or not increasing; invalid gains; `Kp` of both
    /// signs.
    pub fn new(points: &[Point<T>]) -> Result<Self, Refused> {
        let mut schedule = Self::NONE;
        let refuse = |holds, expected, received: T| {
            Refused::unless(holds, "schedule", expected, received.to_f64())
        };
        let room = schedule.points.get_mut(..points.len());
        let Some(room) = room else {
            let count = T::from_count(points.len());
            refuse(false, "at most 8 points", count)?;
            return Ok(schedule);
        };
        room.copy_from_slice(points);
        let (mut last, mut positive, mut negative) = (None, false, false);
        for &Point { speed, gains } in points {
            refuse(
                speed >= T::ZERO && speed.is_finite(),
                "finite speeds of 0 or more",
                speed,
            )?;
            let grows = |last| speed > last && (T::ONE / (speed - last)).is_finite();
            refuse(last.is_none_or(grows), "growing speeds", speed)?;
            gains.checked().map_err(|refused| Refused {
                name: "schedule",
                expected: expected_in_point(refused.name),
                received: refused.received,
            })?;
            positive |= gains.kp > T::ZERO;
            negative |= gains.kp < T::ZERO;
            refuse(
                !(positive && negative),
                "Kp of one sign in all points",
                gains.kp,
            )?;
            last = Some(speed);
        }
        schedule.length = points.len();
        Ok(schedule)
    }

    /// The points, by increasing speed.
    pub fn points(&self) -> &[Point<T>] {
        self.points.get(..self.length).unwrap_or_default()
    }

    /// Whether the gains are constant.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }
}

impl<T: PartialEq> PartialEq for Schedule<T> {
    fn eq(&self, other: &Self) -> bool {
        self.points.get(..self.length) == other.points.get(..other.length)
    }
}

fn expected_in_point(name: &str) -> &'static str {
    match name {
        "Kp" => "a finite Kp in every point",
        "Ti" => "a Ti above 0 s, or inf, in every point",
        _ => "a finite Td of 0 s or more in every point",
    }
}

/// A point in the form that is interpolated, and the distance to the next one.
#[derive(Clone, Copy, Debug)]
pub struct Row<T> {
    /// Size of the filtered output \[y\].
    pub speed: T,
    /// `Kp`.
    pub kp: T,
    /// `Kp Ts/Ti`.
    pub ki: T,
    /// `Td`.
    pub td: T,
    /// One over the distance to the next point; 0 after the last.
    pub inverse: T,
}

/// A schedule as the step uses it: one row more than points, the last one repeated, so that every lookup takes the same
/// number of steps.
#[derive(Clone, Debug)]
pub(crate) struct Table<T> {
    rows: [Row<T>; POINTS + 1],
    n: T,
    ts: T,
}

impl<T: Real> Table<T> {
    /// `None` for an empty schedule.
    pub(crate) fn new(schedule: &Schedule<T>, settings: &Settings<T>) -> Option<Self> {
        let Settings { n, ts, .. } = *settings;
        let row = |point: &Point<T>, inverse| Row {
            speed: point.speed,
            kp: point.gains.kp,
            ki: point.gains.kp * ts / point.gains.ti,
            td: point.gains.td,
            inverse,
        };
        let mut rows = [row(schedule.points().last()?, T::ZERO); POINTS + 1];
        for (place, pair) in rows.iter_mut().zip(schedule.points().windows(2)) {
            if let [this, next] = pair {
                *place = row(this, T::ONE / (next.speed - this.speed));
            }
        }
        Some(Self { rows, n, ts })
    }

    /// All rows.
    pub(crate) fn rows(&self) -> &[Row<T>] {
        &self.rows
    }

    /// The gains for the filtered output `y`.
    ///
    /// `Kp`, `Kp/Ti` and `Kp Td` are linear between points. `Td` itself, a share of which is the derivative's filter, is then the mean of
    /// both ends' with their `Kp` as weights; in this form equal points give their gains to the last bit.
    pub(crate) fn at(&self, y: T) -> Terms<T> {
        let negated = -y;
        let size = if y < T::ZERO { negated } else { y };
        let [first, ..] = self.rows;
        let (mut low, mut high) = (first, first);
        for pair in self.rows.windows(2) {
            if let [this, next] = pair
                && size >= this.speed
            {
                (low, high) = (*this, *next);
            }
        }
        let share = ((size - low.speed) * low.inverse).limit(T::ZERO, T::ONE);
        let between = |low: T, high: T| low + share * (high - low);
        let kp = between(low.kp, high.kp);
        let weight = share * high.kp / kp;
        let weight = if kp == T::ZERO { T::ZERO } else { weight };
        let td = low.td + weight * (high.td - low.td);
        Terms::new(kp, between(low.ki, high.ki), td, self.n, self.ts)
    }
}

#[cfg(test)]
mod tests {
    //! The schedule compared with its definition, and what it refuses.

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
            // the same with the constant gains at that speed
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
}
