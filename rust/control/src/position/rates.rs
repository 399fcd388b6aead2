//! The rates of a drive's speed, over the speed, and the ways from a speed to rest at them.

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

    /// The row at a speed, as a magnitude, with this part of its rates, and the way from its own speed to rest.
    pub(super) fn at(&self, speed: T, part: T) -> (Rate<T>, T) {
        self.last(part, |row, _| row.speed <= speed)
    }

    /// The last of the rows that hold, which are the first ones, and its way, with this part of the rates; the first row if none holds.
    fn last(&self, part: T, holds: impl Fn(&Rate<T>, T) -> bool) -> (Rate<T>, T) {
        let ([first, ..], [none, ..]) = (&self.rows, &self.ways);
        let known = self.rows().iter().zip(&self.ways);
        let (row, way) = known
            .take_while(|(row, way)| holds(row, **way / part))
            .last()
            .unwrap_or((first, none));
        let rate = Rate {
            speed: row.speed,
            up: row.up * part,
            down: row.down * part,
        };
        (rate, *way / part)
    }

    /// The way from a speed, as a magnitude, to rest \[y s\].
    pub fn way(&self, speed: T) -> T {
        self.way_by(speed, T::ONE)
    }

    /// The same with this part of the rates.
    pub(super) fn way_by(&self, speed: T, part: T) -> T {
        let (row, way) = self.at(speed, part);
        way + (speed * speed - row.speed * row.speed) / (row.down + row.down)
    }

    /// The speed of the next sample from which a distance of 0 or more ends at rest, if the speed then falls from sample to sample
    /// at this part of these rates: it solves `way(v) + v ts/2 = distance`, and is exact for sampled steps of one rate.
    pub(super) fn from(&self, distance: T, ts: T, part: T) -> T {
        let half = T::ONE / (T::ONE + T::ONE);
        let ([first, ..], last) = (&self.rows, distance / ts);
        // the last step of the speed, in which the distance is met in one sample
        if last <= first.down * part * ts {
            return last;
        }
        let (row, way) = self.last(part, |row, way| way + half * row.speed * ts <= distance);
        let (lost, left) = (half * row.down * ts, distance - way);
        let v = (lost * lost + row.speed * row.speed + (row.down + row.down) * left).sqrt() - lost;
        v.limit(T::ZERO, last)
    }
}

impl<T: PartialEq> PartialEq for Rates<T> {
    fn eq(&self, other: &Self) -> bool {
        self.rows.get(..self.count.into()) == other.rows.get(..other.count.into())
    }
}
