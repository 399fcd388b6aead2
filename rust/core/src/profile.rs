//! References within what a drive can do: bounded level, rate and jerk, in the least time.
//!
//! What a drive can do is taken from its model in the large ([`Reach`]): the model runs at one limit of its command and back at the
//! other, and how fast the output passes a level is the rate that is left there. This includes whatever limits the model knows: voltage, current, friction.
//!
//! ```text
//! level ^        ______ high      up(y): time from level to level under the largest command
//!       |      /        \         down(y): the same under the least
//!       | ____/          \____    jerk: how fast the rate comes up after the command has jumped
//!       +--------------------> t
//! ```
//!
//! [`Reach::profile`] follows a reference within it: the rate goes towards the target by the largest jerk, is held at its
//! bound, and goes back so that the target is met with rate 0. For one target this is the quickest way
//! (Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, chapter 3; here with a bound that depends on the level).

use crate::closed_loop::{Plant, check_reference};
use crate::{Error, Result};

/// Intervals of levels.
const INTERVALS: usize = 64;
/// Of these, so many at a reversal are passed while the rate still changes.
const REVERSAL: usize = 4;
/// The most samples of a run at a limit.
const LONGEST: usize = 1 << 20;

/// What a drive can do between a least and a largest level.
#[derive(Clone, Debug, PartialEq)]
pub struct Reach {
    /// Least and largest level \[y\].
    pub low: f64,
    /// See `low`.
    pub high: f64,
    /// Levels \[y\], growing.
    pub levels: Vec<f64>,
    /// Largest rate upwards at each level \[y/s\].
    pub up: Vec<f64>,
    /// Largest rate downwards at each level, as a positive number \[y/s\].
    pub down: Vec<f64>,
    /// Largest change of the rate \[y/s^2\]; infinite for none.
    pub jerk: f64,
}

/// A reference within a reach.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    /// The samples; more than before if the last level is met later.
    pub r: Vec<f64>,
    /// Whether a level, the rate and the jerk were at their bounds.
    pub bounds: [bool; 3],
}

impl Reach {
    /// The same bounds at every level.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for levels out of order, or a rate or jerk that is not above 0.
    pub fn constant(low: f64, high: f64, rate: f64, jerk: f64) -> Result<Self> {
        if !(low <= high && rate > 0.0 && jerk > 0.0) {
            return Err(Error::setting(format!(
                "expected levels in order and a rate and a jerk above 0, got {low} to {high}, {rate} and {jerk}; give inf for none"
            )));
        }
        Ok(Self {
            low,
            high,
            levels: vec![0.0],
            up: vec![rate],
            down: vec![rate],
            jerk,
        })
    }

    /// Of a plant at rest, between two levels around its rest, with commands from `u.0` to `u.1`. Levels that it does
    /// not hold are left out.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for levels or commands out of order; `ErrorKind::Fit` for a plant that does not move under them.
    pub fn of(plant: &mut dyn Plant, ts: f64, u: (f64, f64), levels: (f64, f64)) -> Result<Self> {
        let (low, high) = levels;
        plant.reset();
        let rest = plant.output();
        let holds = u.0 < u.1 && low <= rest && rest <= high && low < high && ts > 0.0;
        if !(holds && u.0.is_finite() && u.1.is_finite() && low.is_finite() && high.is_finite()) {
            return Err(Error::setting(format!(
                "expected finite commands in order and levels around the rest of {rest}, got {} to {} and {low} to {high}",
                u.0, u.1
            )));
        }
        let grid: Vec<f64> = (0..=INTERVALS)
            .map(|i| low + (high - low) * i as f64 / INTERVALS as f64)
            .collect();
        let mut least = rest;
        if low < rest {
            let (_, end) = passed(plant, ts, u.0, &grid, rest, -1.0);
            least = end;
        }
        // from the lower end upwards, and back
        let (up, most) = passed(plant, ts, u.1, &grid, least, 1.0);
        let (down, back) = passed(plant, ts, u.0, &grid, most, -1.0);
        let (low, high) = (low.max(least.max(back.min(rest))), high.min(most));
        let known = |rates: &[f64]| rates.iter().any(|rate| *rate > 0.0);
        if !(known(&up) && known(&down) && low < high) {
            return Err(Error::fit(format!(
                "expected a model that moves up and down between commands of {} and {}, got one that does not; give wider limits",
                u.0, u.1
            )));
        }
        let jerk = rise(plant, ts, u.1, up.iter().fold(0.0, |a, b| f64::max(a, *b)));
        Ok(Self {
            low,
            high,
            levels: grid,
            up: filled(up),
            down: filled(down),
            jerk,
        })
    }

    /// What all of several reaches allow, by `share` of their rates. Their levels are those of the first.
    ///
    /// # Errors
    /// `ErrorKind::Setting` without one, or for reaches without a common level.
    pub fn common(all: &[Self], share: f64) -> Result<Self> {
        let refused = || Error::setting("expected models that reach common levels, got none");
        let mut common = all.first().cloned().ok_or_else(refused)?;
        for other in all {
            common.low = common.low.max(other.low);
            common.high = common.high.min(other.high);
            common.jerk = common.jerk.min(other.jerk);
            for (i, level) in common.levels.iter().enumerate() {
                let (up, down) = other.at(*level);
                common.up[i] = common.up[i].min(up);
                common.down[i] = common.down[i].min(down);
            }
        }
        if !(common.low < common.high && share > 0.0 && share <= 1.0) {
            return Err(refused());
        }
        let rates = common.up.iter_mut().chain(&mut common.down);
        rates.for_each(|rate| *rate *= share);
        common.jerk *= share;
        Ok(common)
    }

    /// The same within further bounds.
    pub fn within(mut self, low: f64, high: f64, rate: f64, jerk: f64) -> Self {
        (self.low, self.high) = (self.low.max(low), self.high.min(high));
        let rates = self.up.iter_mut().chain(&mut self.down);
        rates.for_each(|own| *own = own.min(rate));
        self.jerk = self.jerk.min(jerk);
        self
    }

    /// Largest rates up and down at a level.
    pub fn at(&self, y: f64) -> (f64, f64) {
        let next = self.levels.partition_point(|level| *level <= y);
        let last = self.levels.len() - 1;
        let (i, j) = (next.saturating_sub(1), next.min(last));
        let way = self.levels[j] - self.levels[i];
        let part = if way > 0.0 {
            (y - self.levels[i]) / way
        } else {
            0.0
        };
        let at = |rates: &[f64]| match i == j {
            true => rates[i],
            false => rates[i] + part.clamp(0.0, 1.0) * (rates[j] - rates[i]),
        };
        (at(&self.up), at(&self.down))
    }

    /// The reference within the reach, from its first value on.
    ///
    /// # Errors
    /// `ErrorKind::Data` for a reference that is empty or not finite, `ErrorKind::Setting` for a sample time that is not above 0,
    /// `ErrorKind::Fit` if the last level is not met within a million samples.
    pub fn profile(&self, reference: &[f64], ts: f64) -> Result<Profile> {
        check_reference(reference)?;
        if !(ts > 0.0 && ts.is_finite() && self.low <= self.high) {
            return Err(Error::setting(format!(
                "expected a sample time above 0 and levels in order, got {ts} s and {} to {}",
                self.low, self.high
            )));
        }
        let target = |k: usize| {
            let asked = reference
                .get(k)
                .or(reference.last())
                .copied()
                .unwrap_or(0.0);
            (asked, asked.max(self.low).min(self.high))
        };
        let (mut y, mut rate) = (target(0).1, 0.0);
        let (mut r, mut bounds) = (Vec::with_capacity(reference.len()), [false; 3]);
        let step = self.jerk * ts;
        for k in 0..reference.len() + LONGEST {
            let (asked, wanted) = target(k);
            bounds[0] |= asked != wanted;
            // the first sample stands where the reference begins
            if k > 0 {
                let bound = if wanted >= y {
                    self.at(y).0
                } else {
                    self.at(y).1
                };
                let free = stopping(wanted - y, step, ts);
                let held = free.clamp(-bound, bound);
                // the last sample of a way may be told from the bound by rounding only
                bounds[1] |= held.abs() < free.abs() * (1.0 - 1e-9);
                let next = held.clamp(rate - step, rate + step);
                bounds[2] |= (next - held).abs() > 1e-9 * held.abs();
                rate = next;
                y += rate * ts;
                let met = (wanted - y).abs() <= 1e-12 * (1.0 + wanted.abs());
                if met && rate.abs() <= step {
                    y = wanted;
                }
            }
            r.push(y);
            let (_, next) = target(k + 1);
            if k + 1 >= reference.len() && y == next {
                return Ok(Profile { r, bounds });
            }
        }
        Err(Error::fit(format!(
            "expected a last level of {} that is met, got one that the drive does not reach within a million samples; give wider limits",
            target(reference.len()).1
        )))
    }
}

/// The rate with which a distance ends at rate 0, if the rate then falls by `step` from sample to sample.
fn stopping(distance: f64, step: f64, ts: f64) -> f64 {
    let way = distance.abs() / ts;
    if !step.is_finite() {
        return way.copysign(distance);
    }
    // after n further samples the rate is 0: way = (n + 1) rate - step n (n + 1)/2
    let n = (((1.0 + 8.0 * way / step).sqrt() - 1.0) / 2.0).floor();
    (way / (n + 1.0) + step * n / 2.0).copysign(distance)
}

/// Rates at which a plant passes the levels under a constant command in one direction, 0 for those that it does not pass, and the last level.
fn passed(
    plant: &mut dyn Plant,
    ts: f64,
    u: f64,
    grid: &[f64],
    from: f64,
    direction: f64,
) -> (Vec<f64>, f64) {
    let mut times = vec![f64::NAN; grid.len()];
    let ahead = |level: f64, y: f64| direction * (level - y) >= 0.0;
    let order: Vec<usize> = match direction > 0.0 {
        true => (0..grid.len()).collect(),
        false => (0..grid.len()).rev().collect(),
    };
    let mut left = order
        .iter()
        .copied()
        .filter(|&i| ahead(grid[i], from))
        .peekable();
    let (mut before, mut newest, mut last, mut k) = (plant.output(), 0, from, 0);
    // it has settled once nothing new comes for longer than all of the way before has taken
    while let Some(&i) = left.peek() {
        if k > 2 * newest + 256 + LONGEST / 1024 || k > LONGEST {
            break;
        }
        let y = plant.output();
        if !y.is_finite() {
            break;
        }
        if !ahead(grid[i], y) || y == grid[i] {
            let way = y - before;
            let part = if way != 0.0 {
                ((grid[i] - before) / way).clamp(0.0, 1.0)
            } else {
                1.0
            };
            times[i] = (k as f64 - 1.0 + part) * ts;
            (newest, last) = (k, grid[i]);
            left.next();
            continue;
        }
        before = y;
        plant.advance(u);
        k += 1;
    }
    let mut rates = vec![0.0; grid.len()];
    let width = grid[1] - grid[0];
    for pair in order.windows(2) {
        let &[a, b] = pair else { continue };
        let time = times[b] - times[a];
        if time.is_finite() && time >= 0.0 {
            let rate = width / time.max(ts * 1e-3);
            rates[b] = rate;
            if rates[a] == 0.0 {
                rates[a] = rate;
            }
        }
    }
    // at the reversal the rate still comes up
    let moving: Vec<usize> = order.into_iter().filter(|&i| rates[i] > 0.0).collect();
    for n in (0..REVERSAL.min(moving.len().saturating_sub(1))).rev() {
        rates[moving[n]] = rates[moving[n]].max(rates[moving[n + 1]]);
    }
    (rates, last)
}

/// Rates with those of levels that were not passed replaced by the nearest known one.
fn filled(mut rates: Vec<f64>) -> Vec<f64> {
    let known = rates.clone();
    let nearest = |i: usize| {
        let all = known.iter().enumerate().filter(|(_, rate)| **rate > 0.0);
        all.min_by_key(|(j, _)| j.abs_diff(i))
            .map_or(0.0, |(_, rate)| *rate)
    };
    for (i, rate) in rates.iter_mut().enumerate() {
        if *rate == 0.0 {
            *rate = nearest(i);
        }
    }
    rates
}

/// The jerk after a jump of the command from rest: the largest rate over the time in which the rate comes up.
fn rise(plant: &mut dyn Plant, ts: f64, u: f64, largest: f64) -> f64 {
    plant.reset();
    let mut before = plant.output();
    let (mut from, mut most, mut rates) = (None, 0.0_f64, Vec::new());
    for k in 0..1024 {
        plant.advance(u);
        let rate = (plant.output() - before).abs() / ts;
        before = plant.output();
        if !rate.is_finite() {
            break;
        }
        rates.push(rate);
        most = most.max(rate);
        if from.is_none() && rate > 0.0 {
            from = Some(k);
        }
    }
    let Some(from) = from else {
        return largest / ts;
    };
    let end = rates
        .iter()
        .position(|rate| *rate >= 0.9 * most)
        .unwrap_or(from);
    largest / (ts * (end - from + 1) as f64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::closed_loop::LaggedPlant;
    use crate::linear::LinearModel;
    use crate::machine::{Machine, Parameters};

    const TS: f64 = 1e-3;

    proptest! {
        #[test]
        fn bounds_are_kept_and_the_last_level_is_met(
            steps in prop::collection::vec((-100.0f64..100.0, 1usize..200), 1..6),
            rate in 1.0f64..5000.0, jerk in prop_oneof![Just(f64::INFINITY), 10.0f64..1e6],
        ) {
            let r: Vec<f64> = steps.iter().flat_map(|&(y, n)| vec![y; n]).collect();
            let reach = Reach::constant(-80.0, 80.0, rate, jerk).unwrap();
            let found = reach.profile(&r, TS).unwrap().r;
            let last = r.last().unwrap().clamp(-80.0, 80.0);
            prop_assert!(found.len() >= r.len() && *found.last().unwrap() == last);
            let rates: Vec<f64> = found.windows(2).map(|y| (y[1] - y[0]) / TS).collect();
            prop_assert!(rates.iter().all(|v| v.abs() <= rate * (1.0 + 1e-9) + 1e-6));
            let change = rates.windows(2).map(|v| (v[1] - v[0]).abs() / TS);
            prop_assert!(change.into_iter().all(|j| j <= jerk * (1.0 + 1e-6) + 1e-3));
        }

        #[test]
        fn one_step_takes_the_least_time(way in 1.0f64..1e3, rate in 100.0f64..1e4, jerk in 1e4f64..1e6) {
            let found = Reach::constant(0.0, way, rate, jerk).unwrap().profile(&[0.0, way], TS).unwrap().r;
            // an S-curve: up to the rate, held, down; or up and down again
            let least = if way > rate * rate / jerk { way / rate + rate / jerk } else { 2.0 * (way / jerk).sqrt() };
            let took = TS * found.iter().filter(|y| **y < way).count() as f64;
            prop_assert!(took < least + 3.0 * TS, "{took} {least}");
            prop_assert!(found.windows(2).all(|y| y[1] >= y[0]));
        }
    }

    #[test]
    fn the_reach_of_a_lag_is_its_step_response() {
        // y' = (490 u - y)/.05 within 8 V either way
        let model = LinearModel::new(vec![-0.98], vec![9.8], 1, 1, 0.0).unwrap();
        let mut plant = LaggedPlant::new(&model, TS).unwrap();
        let reach = Reach::of(&mut plant, TS, (-8.0, 8.0), (-3000.0, 3000.0)).unwrap();
        assert_eq!((reach.low, reach.high), (-3000.0, 3000.0));
        for y in [-2000.0, 0.0, 2500.0] {
            let (up, down) = reach.at(y);
            let exact = |limit: f64| (490.0 * limit - y).abs() / 0.05;
            assert!(
                (up / exact(8.0) - 1.0).abs() < 0.05,
                "{y} {up} {}",
                exact(8.0)
            );
            assert!((down / exact(-8.0) - 1.0).abs() < 0.05, "{y} {down}");
        }
        // beyond the steady output
        let mut plant = LaggedPlant::new(&model, TS).unwrap();
        let reach = Reach::of(&mut plant, TS, (-2.0, 8.0), (-3000.0, 5000.0)).unwrap();
        assert!(reach.low > -1000.0 && reach.low < -850.0, "{}", reach.low);
        assert!(reach.high < 3930.0 && reach.high > 3700.0, "{}", reach.high);
        let both = Reach::common(&[reach.clone(), reach.clone()], 0.5).unwrap();
        assert!((both.up[20] / reach.up[20] - 0.5).abs() < 1e-12);
        let found = both.profile(&[0.0, 9000.0], TS).unwrap();
        assert_eq!(found.bounds[..2], [true; 2]);
        assert_eq!(*found.r.last().unwrap(), reach.high);
    }

    #[test]
    fn the_reach_of_the_machine_has_its_current_limit() {
        let mut machine = Machine::new(Parameters::default()).unwrap();
        let reach = Reach::of(&mut machine, TS, (-20.0, 20.0), (0.0, 3000.0)).unwrap();
        let (up, down) = reach.at(1500.0);
        assert!((20_000.0..35_000.0).contains(&up), "{up}");
        assert!((20_000.0..40_000.0).contains(&down), "{down}");
        assert!(reach.jerk > up && reach.jerk < up / TS, "{}", reach.jerk);
        // twice the voltage brings nearly nothing, as the current is limited
        let twice = Reach::of(&mut machine, TS, (-40.0, 40.0), (0.0, 3000.0)).unwrap();
        assert!(twice.at(1500.0).0 < 1.1 * up);
    }

    #[test]
    fn what_has_no_reach_is_refused() {
        let dead = LinearModel::new(vec![-0.5], vec![0.0], 1, 1, 0.0).unwrap();
        let mut plant = LaggedPlant::new(&dead, TS).unwrap();
        assert!(Reach::of(&mut plant, TS, (-1.0, 1.0), (-1.0, 1.0)).is_err());
        assert!(Reach::of(&mut plant, TS, (1.0, -1.0), (-1.0, 1.0)).is_err());
        assert!(Reach::of(&mut plant, TS, (-1.0, 1.0), (1.0, 2.0)).is_err());
        assert!(Reach::constant(0.0, 1.0, 0.0, 1.0).is_err());
        assert!(Reach::constant(1.0, 0.0, 1.0, 1.0).is_err());
        assert!(Reach::common(&[], 1.0).is_err());
        let reach = Reach::constant(0.0, 1.0, 1.0, f64::INFINITY).unwrap();
        assert!(reach.profile(&[], TS).is_err() && reach.profile(&[f64::NAN], TS).is_err());
        assert!(reach.profile(&[1.0], 0.0).is_err());
    }
}
