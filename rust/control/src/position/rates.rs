//! The rates of a drive's speed, over the speed, and the ways from a speed to rest at them.

use crate::ring::last_holding;
use crate::{Real, Refused};

/// The most rows of rates.
pub const RATES: usize = 8;

/// How fast a drive's speed can change from a speed on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate<T> {
    /// Speed, as a magnitude \[y\].
    pub speed: T,
    /// Largest rate away from rest \[y/s\].
    pub up: T,
    /// Largest rate towards rest \[y/s\].
    pub down: T,
}

/// Rates over the speed, the same in both directions; each holds from its speed to the next one.
///
/// ```
/// use sewfast_control::{Rate, Rates};
///
/// let rates = Rates::new(&[
///     Rate { speed: 0.0, up: 20e3, down: 20e3 },
///     Rate { speed: 1e3, up: 10e3, down: 25e3 },
/// ])?;
/// assert_eq!(rates.way(1e3), 25.0);
/// assert_eq!(rates.way(2e3), 25.0 + 60.0);
/// # Ok::<(), sewfast_control::Refused>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Rates<T> {
    rows: [Rate<T>; RATES],
    /// The way from the speed of each row to rest \[y s\].
    ways: [T; RATES],
    count: u8,
}

impl<T: Real> Rates<T> {
    /// Rates by growing speeds, the first of which is 0.
    ///
    /// # Errors
    /// No row or more than [`RATES`], speeds that do not grow from 0, rates that are not above 0 and finite.
    pub fn new(rows: &[Rate<T>]) -> Result<Self, Refused> {
        let refuse = |holds, expected, received: T| {
            Refused::unless(holds, "rates", expected, received.to_f64())
        };
        let none = Rate {
            speed: T::ZERO,
            up: T::ZERO,
            down: T::ZERO,
        };
        let mut made = Self {
            rows: [none; RATES],
            ways: [T::ZERO; RATES],
            count: rows.len() as u8,
        };
        let some = (1..=RATES).contains(&rows.len());
        refuse(some, "1 to 8 rows", T::from_count(rows.len()))?;
        let (mut before, mut way): (Option<Rate<T>>, T) = (None, T::ZERO);
        let places = made.rows.iter_mut().zip(&mut made.ways);
        for (row, (place, passed)) in rows.iter().zip(places) {
            let grows = before.map_or(row.speed == T::ZERO, |last| row.speed > last.speed);
            refuse(
                grows && row.speed.is_finite(),
                "growing speeds from 0 on",
                row.speed,
            )?;
            for rate in [row.up, row.down] {
                refuse(
                    rate > T::ZERO && rate.is_finite(),
                    "finite rates above 0",
                    rate,
                )?;
            }
            if let Some(last) = before {
                way += (row.speed * row.speed - last.speed * last.speed) / (last.down + last.down);
            }
            (*place, *passed, before) = (*row, way, Some(*row));
        }
        refuse(way.is_finite(), "a finite way to rest", way)?;
        Ok(made)
    }

    /// The rows, by growing speed.
    pub fn rows(&self) -> &[Rate<T>] {
        self.rows.get(..self.count.into()).unwrap_or_default()
    }

    /// The place of the row at a speed, as a magnitude; the search begins at the row `near`.
    pub(super) fn place(&self, speed: T, near: usize) -> usize {
        let last = usize::from(self.count) - 1;
        last_holding(last, near, |place| self.row(place).speed <= speed)
    }

    /// The same for a speed that is not above that of the row `near`.
    pub(super) fn below(&self, speed: T, near: usize) -> usize {
        last_holding(near, near, |place| self.row(place).speed <= speed)
    }

    /// A row by its place, which is below their number: the remainder only tells the compiler so.
    fn row(&self, place: usize) -> Rate<T> {
        self.rows[place % RATES]
    }

    /// A row with this part of its rates.
    pub(super) fn at(&self, place: usize, part: T) -> Rate<T> {
        let row = self.row(place);
        Rate {
            speed: row.speed,
            up: row.up * part,
            down: row.down * part,
        }
    }

    /// The way from the speed of a row to rest at this part of the rates.
    fn passed(&self, place: usize, part: T) -> T {
        self.ways[place % RATES] / part
    }

    /// The way from a speed, as a magnitude, to rest \[y s\].
    pub fn way(&self, speed: T) -> T {
        self.way_by(speed, T::ONE)
    }

    /// The same with this part of the rates.
    pub(super) fn way_by(&self, speed: T, part: T) -> T {
        let place = self.place(speed, 0);
        let row = self.at(place, part);
        self.passed(place, part) + (speed * speed - row.speed * row.speed) / (row.down + row.down)
    }

    /// The speed of the next sample from which a distance of 0 or more ends at rest, if the speed then falls from sample to sample
    /// at this part of these rates: it solves `way(v) + v ts/2 = distance`, and is exact for sampled steps of one rate. The search for
    /// its row begins at the row `near`.
    pub(super) fn from(&self, distance: T, ts: T, part: T, near: usize) -> T {
        let half = T::ONE / (T::ONE + T::ONE);
        let ([first, ..], last) = (&self.rows, distance / ts);
        // the last step of the speed, in which the distance is met in one sample
        if last <= first.down * part * ts {
            return last;
        }
        let top = usize::from(self.count) - 1;
        let place = last_holding(top, near, |place| {
            self.passed(place, part) + half * self.row(place).speed * ts <= distance
        });
        let row = self.at(place, part);
        let (lost, left) = (half * row.down * ts, distance - self.passed(place, part));
        let v = (lost * lost + row.speed * row.speed + (row.down + row.down) * left).sqrt() - lost;
        v.limit(T::ZERO, last)
    }
}

impl<T: PartialEq> PartialEq for Rates<T> {
    fn eq(&self, other: &Self) -> bool {
        self.rows.get(..self.count.into()) == other.rows.get(..other.count.into())
    }
}
