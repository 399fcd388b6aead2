//! The start of a joint's fit: a regression of smoothed signals.
//!
//! With bells of some samples' width, and their derivatives, what drives a joint is regressed on speed, acceleration, the speed's sign and
//! 1. A wide bell suits coarse encoder steps, a narrow one quick moves: which is best shows in a free run.

use crate::data::Samples;
use crate::regression::{solve_scaled, triangle};
use crate::{Record, Result};

/// Longest gap that is interpolated \[samples\], if the bell is not wider.
const BRIDGED: f64 = 3.0;
/// Least speed whose sign is believed, relative to the largest of its piece.
const CLEAR: f64 = 0.05;
/// Least samples to regress.
const LEAST: usize = 20;
/// Width of a bell's taps to each side, in its standard deviations.
const REACH: f64 = 3.5;

/// How signals are smoothed and what drives.
#[derive(Clone, Copy, Debug)]
pub struct Smoothing<'a> {
    /// Standard deviation of the bell \[samples\].
    pub width: f64,
    /// Delays of the command to try \[samples\].
    pub delays: &'a [f64],
    /// Sample time \[s\].
    pub sample_time: f64,
    /// One unit of the output \[rad or m\].
    pub unit: f64,
    /// Gain of a controller inside, commands per rad or m; 0 for none.
    pub k_q: f64,
}

/// For each delay what drives per speed, per acceleration, per sign of the speed, and in any case; `None` with too few samples.
///
/// Slow moves do not show the inertia, and noise then makes it negative. Such a start has the inertia with which the joint follows
/// within about a sample, as one that is faster cannot be told from it.
///
/// # Errors
/// Data errors for records that cannot be used.
pub fn regressed(pieces: &[Samples<'_>], how: &Smoothing<'_>) -> Result<Vec<Option<[f64; 4]>>> {
    let found = |rows: Vec<Row>| {
        let (r, count) = triangle(5, rows.into_iter().map(|row| row.into_iter().take(5)));
        if count < LEAST {
            return None;
        }
        let goal = r.column(4).into_owned();
        let all = r.columns(0, 4).into_owned();
        let found = solve_scaled(all.clone(), &goal, 1e-13).theta;
        if found[1] > 0.0 {
            return Some(std::array::from_fn(|j| found[j]));
        }
        let found = solve_scaled(all.remove_column(1), &goal, 1e-13).theta;
        let fast = how.sample_time * (found[0].max(0.0) + how.k_q * how.sample_time);
        Some([found[0], fast, found[1], found[2]])
    };
    Ok(smoothed(pieces, how)?.into_iter().map(found).collect())
}

/// What drives less friction, inertia and gravity, at the first delay: its squares that a wave of each order over the position leaves.
///
/// # Errors
/// As [`regressed`].
pub fn waves(pieces: &[Samples<'_>], how: &Smoothing<'_>, orders: &[f64]) -> Result<Vec<f64>> {
    let rows = smoothed(pieces, how)?.swap_remove(0);
    let left = |order: &f64| {
        let wave = |&[v, bend, side, one, drive, q]: &Row| {
            let ((s, c), (sin, cos)) = (q.sin_cos(), (order * q).sin_cos());
            [v, bend, side, one, c, s, cos, sin, drive]
        };
        triangle(9, rows.iter().map(wave)).0[(8, 8)].powi(2)
    };
    Ok(orders.iter().map(left).collect())
}

/// Speed, acceleration, sign of the speed, 1, what drives, position.
type Row = [f64; 6];

/// Rows of smoothed signals, for each delay.
fn smoothed(pieces: &[Samples<'_>], how: &Smoothing<'_>) -> Result<Vec<Vec<Row>>> {
    let bell = Bell::new(how);
    let mut rows = vec![Vec::new(); how.delays.len()];
    for piece in pieces {
        let record = piece.record()?;
        if record.y.len() > bell.taps.len() + 3 {
            bell.add(&record, how, &mut rows);
        }
    }
    Ok(rows)
}

/// Taps that smooth, and smooth derivatives per second.
struct Bell {
    taps: Vec<f64>,
    slope: Vec<f64>,
    bend: Vec<f64>,
}

impl Bell {
    fn new(how: &Smoothing<'_>) -> Self {
        let half = (REACH * how.width).ceil() as i64;
        let at: Vec<f64> = (-half..=half).map(|k| k as f64).collect();
        let square = how.width * how.width;
        let bell = |k: &f64| (-0.5 * k * k / square).exp();
        let total: f64 = at.iter().map(bell).sum();
        let taps: Vec<f64> = at.iter().map(|k| bell(k) / total).collect();
        let bent = |(k, tap): (&f64, &f64)| (k * k / square - 1.0) / square * tap;
        let bend: Vec<f64> = at.iter().zip(&taps).map(bent).collect();
        // a constant has no bend, however few taps there are
        let off: f64 = bend.iter().sum();
        let per = how.sample_time;
        Self {
            slope: at
                .iter()
                .zip(&taps)
                .map(|(k, tap)| -k / square * tap / per)
                .collect(),
            bend: bend
                .iter()
                .zip(&taps)
                .map(|(b, tap)| (b - off * tap) / (per * per))
                .collect(),
            taps,
        }
    }

    /// Appends a piece's rows for every delay.
    fn add(&self, record: &Record<'_>, how: &Smoothing<'_>, rows: &mut [Vec<Row>]) {
        let (mut q, known) = bridged(record.y, how.width.max(BRIDGED));
        q.iter_mut().for_each(|q| *q *= how.unit);
        let speeds = filtered(&q, &self.slope);
        let whole: Vec<bool> = known
            .windows(self.taps.len())
            .map(|w| w.iter().all(|k| *k))
            .collect();
        let most = speeds.iter().zip(&whole).filter(|(_, whole)| **whole);
        let most = most.map(|(v, _)| v.abs()).fold(0.0, f64::max);
        let clear: Vec<usize> = (0..speeds.len())
            .filter(|&k| whole[k] && speeds[k].abs() > CLEAR * most)
            .collect();
        let (smooth, bends) = (filtered(&q, &self.taps), filtered(&q, &self.bend));
        for (rows, delay) in rows.iter_mut().zip(how.delays) {
            let late: Vec<f64> = (0..q.len())
                .map(|k| between(record.u, k as f64 - 0.5 - delay))
                .collect();
            let drive = filtered(&late, &self.taps);
            rows.extend(clear.iter().map(|&k| {
                let v = speeds[k];
                let left = drive[k] - how.k_q * smooth[k];
                [v, bends[k], v.signum(), 1.0, left, smooth[k]]
            }));
        }
    }
}

/// A signal through symmetric or antisymmetric taps, where all of them have a sample.
fn filtered(x: &[f64], taps: &[f64]) -> Vec<f64> {
    let sum = |part: &[f64]| {
        part.iter()
            .zip(taps.iter().rev())
            .map(|(x, tap)| x * tap)
            .sum()
    };
    x.windows(taps.len()).map(sum).collect()
}

/// A signal between its samples, held beyond its ends.
fn between(x: &[f64], at: f64) -> f64 {
    let last = x.len() - 1;
    let at = at.clamp(0.0, last as f64);
    let k = (at as usize).min(last.saturating_sub(1));
    x[k] + (at - k as f64) * (x[(k + 1).min(last)] - x[k])
}

/// Outputs with interpolated gaps, and whether each is measured or in a gap that is not long.
fn bridged(y: &[f64], longest: f64) -> (Vec<f64>, Vec<bool>) {
    let (mut found, mut known) = (y.to_vec(), vec![true; y.len()]);
    let mut next = 0;
    while let Some(start) = (next..y.len()).find(|&k| y[k].is_nan()) {
        next = (start..y.len())
            .find(|&k| !y[k].is_nan())
            .unwrap_or(y.len());
        let (before, after) = (start.checked_sub(1).map(|k| y[k]), y.get(next).copied());
        let inside = before.is_some() && after.is_some();
        let ends = [
            before.or(after).unwrap_or(0.0),
            after.or(before).unwrap_or(0.0),
        ];
        for k in start..next {
            let share = (k + 1 - start) as f64 / (next + 1 - start) as f64;
            found[k] = ends[0] + share * (ends[1] - ends[0]);
            known[k] = inside && (next - start) as f64 <= longest;
        }
    }
    (found, known)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A record of `drive = 0.4 v + 0.05 a + 0.2 sign v + 0.1`, whose command is late by half a sample and a delay.
    fn moved(n: usize, delay: f64) -> (Vec<f64>, Vec<f64>) {
        let (h, w) = (0.01, 2.0);
        let q = |k: f64| (w * h * k).sin();
        let drive = |k: f64| {
            let (v, a) = (w * (w * h * k).cos(), -w * w * (w * h * k).sin());
            0.4 * v + 0.05 * a + 0.2 * v.signum() + 0.1
        };
        let u = (0..n).map(|k| drive(k as f64 + 0.5 + delay)).collect();
        (u, (0..n).map(|k| q(k as f64)).collect())
    }

    fn how(delays: &[f64]) -> Smoothing<'_> {
        Smoothing {
            width: 2.0,
            delays,
            sample_time: 0.01,
            unit: 1.0,
            k_q: 0.0,
        }
    }

    #[test]
    fn a_joint_is_found_with_gaps_and_without() {
        let (u, mut y) = moved(2000, 3.0);
        for gap in [None, Some(500..502), Some(700..760)] {
            gap.into_iter().flatten().for_each(|k| y[k] = f64::NAN);
            let piece = Samples::new(&u, 1, &y).unwrap();
            let found = regressed(&[piece], &how(&[3.0])).unwrap()[0].unwrap();
            for (found, true_) in found.iter().zip([0.4, 0.05, 0.2, 0.1]) {
                assert!((found - true_).abs() < 0.01, "{found:?} for {true_}");
            }
        }
    }

    #[test]
    fn a_wave_over_the_position_is_seen_at_its_order() {
        let (mut u, y) = moved(2000, 0.0);
        u.iter_mut()
            .zip(&y)
            .for_each(|(u, q)| *u += 0.05 * (11.0 * q + 0.4).cos());
        let piece = Samples::new(&u, 1, &y).unwrap();
        let left = waves(&[piece], &how(&[0.0]), &[5.0, 8.0, 11.0, 14.0, 30.0]).unwrap();
        let others = [0, 1, 3, 4].map(|j| left[j]);
        assert!(others.iter().all(|other| left[2] < 0.5 * other), "{left:?}");
    }

    #[test]
    fn slow_moves_start_with_an_inertia_of_about_a_sample() {
        let (_, y) = moved(2000, 0.0);
        // a controller inside that holds a position error of .2 against friction, and moves no mass
        let u: Vec<f64> = y
            .windows(2)
            .map(|q| q[1] + 0.2 * (q[1] - q[0]).signum())
            .collect();
        let piece = Samples::new(&u, 1, &y[..u.len()]).unwrap();
        let inside = Smoothing {
            k_q: 1.0,
            ..how(&[0.0])
        };
        let [_, inertia, friction, _] = regressed(&[piece], &inside).unwrap()[0].unwrap();
        assert!((1e-5..1e-3).contains(&inertia), "{inertia}");
        assert!((friction - 0.2).abs() < 0.01, "{friction}");
    }

    #[test]
    fn a_short_record_has_no_start() {
        let (u, y) = moved(25, 0.0);
        let piece = Samples::new(&u, 1, &y).unwrap();
        assert_eq!(
            regressed(&[piece], &how(&[0.0, 1.0])).unwrap(),
            [None, None]
        );
    }

    proptest! {
        #![proptest_config(crate::laws::cases(50))]
        #[test]
        fn a_gap_in_a_line_is_bridged_by_the_line(start in 0_usize..40, length in 1_usize..20, longest in 1.0..9.0_f64) {
            let line: Vec<f64> = (0..50).map(|k| 3.0 - 0.5 * k as f64).collect();
            let mut y = line.clone();
            y[start..(start + length).min(50)].fill(f64::NAN);
            let (found, known) = bridged(&y, longest);
            for k in 0..50 {
                let gap = y[k].is_nan();
                if start > 0 && start + length < 50 {
                    prop_assert!((found[k] - line[k]).abs() < 1e-12);
                    prop_assert_eq!(known[k], !gap || length as f64 <= longest);
                } else {
                    prop_assert_eq!(known[k], !gap);
                }
            }
        }
    }
}
