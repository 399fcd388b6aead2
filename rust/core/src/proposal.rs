//! Gains and filters with the largest bandwidth: the merit of a controller on a measured machine, and the search for the best one.
//!
//! The bandwidth is the frequency at which `|S|` reaches `1/sqrt(2)`. Ms is limited on the fitted machine, which shows
//! whether the loop is stable, and on the measured lines with their 95 % circles, which include what the fit misses.
//! Above the lines the machine is unknown, and the loop's gain is kept low.

use sewfast_control::{Biquad, Cascade, Refused, Standard};

use crate::loop_transfer::{Loop, Measured, Path, Plant, peak_sensitivity, weakening};
use crate::simplex::{Corner, descended};
use crate::{Error, Monitor, Result};

/// Safety factor on the loop's gain, from the fit, above the measured lines.
const BLIND: f64 = 1.25;
/// Edges of the simplex in a round of the search, each started from the previous best.
const EDGES: [f64; 3] = [0.4, 0.2, 0.1];
/// Most rounds, and the least gain in bandwidth that justifies another round.
const ROUNDS: usize = 4;
const FURTHER: f64 = 1.01;
/// Steps from each edge length, per searched number.
const STEPS: usize = 100;
/// Difference between the best and the worst corner, in log bandwidth, at which a search ends.
const SAME: f64 = 1e-4;
/// Weight, against the logarithm of the bandwidth, of the relative excess of Ms over its limit, and of a peak of `|S|`
/// above [`LEVEL`] below the bandwidth: the bandwidth itself would jump when such a peak arises.
const OUTSIDE: f64 = 30.0;
/// Level of `|S|` in the search: slightly less than its value at the bandwidth.
const LEVEL: f64 = 0.99 * std::f64::consts::FRAC_1_SQRT_2;
/// Largest integral time, in radians of the bandwidth: with a slow integral a lasting disturbance would not be removed,
/// however large the bandwidth.
const SLOWEST: f64 = 8.0;
const DERIVATIVE_FILTER: f64 = 10.0;
/// Bounds on the numbers of filters.
const DEPTH: (f64, f64) = (0.005, 1.0);
const WIDTH: (f64, f64) = (0.02, 5.0);
const DAMPING: (f64, f64) = (1e-3, 3.0);

/// A machine and the limits for its controller.
#[derive(Clone, Debug)]
pub struct Task {
    /// The fitted machine.
    pub plant: Plant,
    /// Its measured lines.
    pub lines: Measured,
    /// The fit at frequencies above them, with circles of radius 0.
    pub above: Measured,
    /// The controller's path; its gains, lag and biquads are searched.
    pub path: Path,
    /// Largest sensitivity.
    pub ms: f64,
    /// Largest noise gain; infinite for none.
    pub quiet: f64,
}

/// A controller of the search as plain numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposed {
    /// Gains in standard form.
    pub gains: Standard<f64>,
    /// `N` of the derivative's filter.
    pub n: f64,
    /// Time constant of the lag \[s\].
    pub filter_time: f64,
    /// Each filter is a notch (frequency \[Hz\], depth, width) or a biquad (frequency \[Hz\] and damping of the zeros,
    /// then of the poles).
    pub filters: Vec<Vec<f64>>,
}

/// The result of a search.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Logarithm of the bandwidth minus penalties; `None` if nothing found is stable within Ms.
    pub merit: Option<f64>,
    /// The point: logarithms of `Kp`, `Ti`, `Td`, the lag, and the filters' numbers.
    pub x: Vec<f64>,
    /// The controller there.
    pub proposed: Proposed,
}

impl Proposed {
    /// The controller of a point of the search, within what can be realised at sample time `ts`.
    fn of(x: &[f64], ts: f64) -> Self {
        let numbers: Vec<f64> = x.iter().map(|v| v.clamp(-40.0, 40.0).exp()).collect();
        let (gains, filters) = numbers.split_at(4);
        // less than a tenth of a sample counts as 0
        let time = |t: f64| if t < 0.1 * ts { 0.0 } else { t.min(100.0 * ts) };
        let within = |value: f64, (low, high): (f64, f64)| value.clamp(low, high);
        let hertz = |f: f64| within(f, (1e-4 / ts, 0.49 / ts));
        let filters = match filters {
            [f, depth, width] => vec![vec![
                hertz(*f),
                within(*depth, DEPTH),
                within(*width, WIDTH),
            ]],
            free => free
                .chunks_exact(4)
                .map(|c| {
                    let damped = |d| within(d, DAMPING);
                    vec![hertz(c[0]), damped(c[1]), hertz(c[2]), damped(c[3])]
                })
                .collect(),
        };
        Self {
            gains: Standard {
                kp: gains[0],
                ti: within(gains[1], (ts, 1e5)),
                td: time(gains[2]),
            },
            n: DERIVATIVE_FILTER,
            filter_time: time(gains[3]),
            filters,
        }
    }

    fn path(&self, like: &Path) -> std::result::Result<Path, Refused> {
        let section = |f: &Vec<f64>| match f[..] {
            [f, depth, width] => Biquad::notch(f, depth, width, like.ts),
            _ => Biquad::resonance(f[0], f[1], f[2], f[3], like.ts),
        };
        let sections = self.filters.iter().map(section);
        Ok(Path {
            gains: self.gains,
            n: self.n,
            filter_time: self.filter_time,
            biquads: Cascade::new(&sections.collect::<std::result::Result<Vec<_>, _>>()?)?,
            ..*like
        })
    }
}

impl Task {
    /// Logarithm of the bandwidth, minus penalties for excess of Ms, a slow integral and motion of the command; `None`
    /// if the loop is unstable.
    fn merit(&self, path: &Path) -> Option<f64> {
        let closed = Loop::new(path, &self.plant).ok()?;
        let found = weakening(&closed, LEVEL, self.quiet.is_finite())?;
        let blind = 1.0 / (1.0 - (BLIND * self.above.largest_gain(path)).min(0.999));
        let worst = found.ms.max(self.lines.peak_sensitivity(path)).max(blind);
        let excess = (worst / self.ms - 1.0).clamp(0.0, 10.0);
        let reached = |(level, omega): &(f64, f64)| omega / (level / LEVEL).powf(OUTSIDE);
        let bandwidth = found.levels.iter().map(reached).fold(0.0, f64::max);
        let over = |size: f64| size.max(1.0).ln();
        let slow = path.gains.ti * bandwidth / SLOWEST;
        let noise = found.noise_gain.map_or(0.0, |gain| gain / self.quiet);
        Some(bandwidth.ln() - OUTSIDE * excess - over(slow) - over(noise))
    }

    /// The best of the searches from each start (logarithms as in [`Found::x`]); each search is restarted from its end.
    ///
    /// # Errors
    /// `ErrorKind::Setting` without a start or for one with another number of logarithms than 4, 7, 8 or 12, or a path out of range;
    /// `ErrorKind::Fit` on a stop.
    pub fn best(&self, starts: &[Vec<f64>], monitor: &Monitor) -> Result<Found> {
        let known = |x: &Vec<f64>| matches!(x.len(), 4 | 7 | 8 | 12);
        if starts.is_empty() || !starts.iter().all(known) {
            return Err(Error::setting(
                "expected starts of 4, 7, 8 or 12 logarithms: gains, with a notch, with one or two biquads",
            ));
        }
        let ts = self.path.ts;
        let cost = |x: &[f64]| {
            let path = Proposed::of(x, ts).path(&self.path);
            let merit = (!monitor.stopped())
                .then_some(path)
                .and_then(|p| self.merit(&p.ok()?));
            merit.filter(|m| !m.is_nan()).map_or(f64::INFINITY, |m| -m)
        };
        let mut best = (f64::INFINITY, starts[0].clone());
        for start in starts {
            let found = searched(start, &cost);
            if found.0 < best.0 {
                best = found;
            }
        }
        if monitor.stopped() {
            return Err(Error::fit("expected time to search, got a stop"));
        }
        let proposed = Proposed::of(&best.1, ts);
        let path = proposed.path(&self.path)?;
        let ms = Loop::new(&path, &self.plant).map(|closed| peak_sensitivity(&closed))?;
        Ok(Found {
            merit: (best.0.is_finite() && ms <= 1.01 * self.ms).then_some(-best.0),
            x: best.1,
            proposed,
        })
    }
}

fn searched(start: &[f64], cost: &impl Fn(&[f64]) -> f64) -> Corner {
    let mut found = (f64::INFINITY, start.to_vec());
    let same = |corners: &[Corner]| corners[corners.len() - 1].0 - corners[0].0 < SAME;
    for _ in 0..ROUNDS {
        let before = found.0;
        for edge in EDGES {
            found = descended(&found.1, edge, STEPS * start.len(), same, cost);
        }
        // also true if nothing was stable before or is now
        if !matches!(
            (before - found.0).partial_cmp(&FURTHER.ln()),
            Some(std::cmp::Ordering::Greater)
        ) {
            break;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use nalgebra::Complex;

    use super::*;
    use crate::loop_transfer::margins;

    const TS: f64 = 1e-3;

    /// A first-order drive with a delay; its lines go up to 200 Hz and have circles of this relative size.
    fn task(ms: f64, circles: f64, quiet: f64) -> Task {
        let plant = Plant::fopdt(100.0, 0.2, 0.004, TS).unwrap();
        let path = Path::new(
            Standard {
                kp: 1.0,
                ti: 1.0,
                td: 0.0,
            },
            TS,
        );
        let one = Path::new(
            Standard {
                kp: 1.0,
                ti: f64::INFINITY,
                td: 0.0,
            },
            TS,
        );
        let closed = Loop::new(&one, &plant).unwrap();
        let lines = |hertz: Vec<f64>, circles: f64| {
            let omega: Vec<f64> = hertz.iter().map(|f| std::f64::consts::TAU * f).collect();
            let value: Vec<Complex<f64>> = omega.iter().map(|&w| closed.response(w)).collect();
            let radius: Vec<f64> = value.iter().map(|v| circles * v.norm()).collect();
            Measured::new(&omega, &value, &radius, false, TS).unwrap()
        };
        Task {
            lines: lines((1..=200).map(f64::from).collect(), circles),
            above: lines((201..=499).map(f64::from).collect(), 0.0),
            plant,
            path,
            ms,
            quiet,
        }
    }

    fn start() -> Vec<f64> {
        [0.05, 0.1, 0.002, TS].map(f64::ln).to_vec()
    }

    fn best(task: &Task) -> (f64, Path) {
        let found = task.best(&[start()], &Monitor::default()).unwrap();
        (
            found.merit.unwrap(),
            found.proposed.path(&task.path).unwrap(),
        )
    }

    #[test]
    fn the_best_loop_is_at_its_limit_and_no_gains_beside_it_are_better() {
        let task = task(1.7, 0.0, f64::INFINITY);
        let (merit, path) = best(&task);
        let its = margins(&Loop::new(&path, &task.plant).unwrap());
        assert!((its.ms.0 / 1.7 - 1.0).abs() < 0.01, "{its:?}");
        // the level of the search is a percent below that of the bandwidth
        assert!((merit - its.bandwidth.ln()).abs() < 0.05, "{merit} {its:?}");
        for kp in [0.9, 0.97, 1.03, 1.1] {
            for ti in [0.9, 1.0, 1.1] {
                let mut beside = path;
                beside.gains.kp *= kp;
                beside.gains.ti *= ti;
                assert!(task.merit(&beside).unwrap() < merit + 0.01, "{kp} {ti}");
            }
        }
    }

    #[test]
    fn circles_and_noise_cost_bandwidth() {
        let (exact, path) = best(&task(1.7, 0.0, f64::INFINITY));
        let (doubted, careful) = best(&task(1.7, 0.3, f64::INFINITY));
        assert!(doubted < exact - 0.1, "{doubted} {exact}");
        let wide = task(1.7, 0.3, f64::INFINITY);
        assert!(wide.lines.peak_sensitivity(&careful) < 1.7 * 1.02);
        assert!(wide.lines.peak_sensitivity(&path) > 1.9);
        let closed = |path, task: &Task| margins(&Loop::new(path, &task.plant).unwrap()).noise_gain;
        let noisy = closed(&path, &wide);
        let calm = task(1.7, 0.0, 0.3 * noisy);
        let (quiet, still) = best(&calm);
        assert!(quiet < exact, "{quiet} {exact}");
        assert!(closed(&still, &calm) < 0.5 * noisy);
    }

    #[test]
    fn without_a_stable_loop_there_is_no_merit_and_a_stop_is_an_error() {
        // no gains near a million are stable
        let task = task(1.7, 0.0, f64::INFINITY);
        let far = [1e6, 0.1, 1.0, TS].map(f64::ln).to_vec();
        let found = task.best(std::slice::from_ref(&far), &Monitor::default());
        assert_eq!(found.unwrap().merit, None);
        for starts in [vec![], vec![vec![0.0; 5]], vec![start(), vec![0.0; 3]]] {
            assert!(task.best(&starts, &Monitor::default()).is_err());
        }
        let stopped = Monitor::default();
        stopped.request_stop();
        assert!(task.best(&[start()], &stopped).is_err());
    }

    #[test]
    fn filters_stay_within_what_can_be_realised() {
        for x in [-60.0, -3.0, 0.0, 3.0, 60.0] {
            for (n, filters) in [(4, 0), (7, 1), (8, 1), (12, 2)] {
                let proposed = Proposed::of(&vec![x; n], TS);
                let path = proposed.path(&task(1.7, 0.0, f64::INFINITY).path).unwrap();
                assert_eq!(path.biquads.sections().len(), filters);
            }
        }
    }
}
