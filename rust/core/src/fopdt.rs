//! First-order-plus-dead-time approximation (paper Eq. 10-11) of a measured step response.

mod confidence;

use nalgebra::{Matrix3, Vector3};

use crate::error::shown;
use crate::{Error, Monitor, Record, Result};

/// `K e^(-sL) / (1 + sT)` around an operating point, and how it was fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fopdt {
    /// Gain \[y/u\].
    pub k: f64,
    /// Time constant \[s\].
    pub t: f64,
    /// Dead time \[s\].
    pub l: f64,
    /// Output at zero input: the output settles at `K u + offset`.
    pub offset: f64,
    /// Input before the step.
    pub u_low: f64,
    /// Input after the step.
    pub u_high: f64,
    /// `100 (1 - |y - model| / |y - mean(y)|)` over the samples used.
    pub fit_percent: f64,
    /// Standard errors of `K`, `T` and `L`, for residuals of any spectrum.
    pub errors: [f64; 3],
    /// Samples at a limit of the output; they had no weight.
    pub limited: usize,
    /// Whether the machine was still moving before the step; its free response was fitted too.
    pub moving: bool,
    /// Overshoot of the response beyond its final level, as a share of its rise; 0 unless it stands out of the noise. A
    /// response with overshoot is not of first order.
    pub overshoot: f64,
}

/// A change of the input by more than this share of its range is a step.
const STEP_SHARE: f64 = 0.05;
/// The fewest samples after the step.
const FEWEST: usize = 10;
/// A response is settled once this share of it has passed.
const SETTLED: f64 = 0.95;
/// A free response is accepted only if it lowers the squares to this share.
const CLEARLY: f64 = 0.99;
/// Least excess of a response beyond a limit, as a share of its rise.
const BEYOND: f64 = 0.005;
/// Grid points of the search in each direction.
const GRID: usize = 21;
/// How often the search is narrowed around the best point, each time by half.
const ROUNDS: usize = 26;
/// Shares of `T` in the sum of `T` and `L` at which the polish begins as well.
const SHARES: [f64; 9] = [0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.6, 1.0];
/// Most steps of the polish, and most halvings of a step.
const STEPS: usize = 30;
const HALVINGS: usize = 12;

/// Fits the response to the first step in a record with one input.
///
/// For each `T` and `L` of the search, `K` and the level before the step follow by linear least squares; the search is narrowed until its
/// steps are below a millionth. The record is used up to the next step of the input. A free response with the same `T` that began before
/// the record is part of the fit if it lowers the squares by a percent and is three of its standard errors. Samples at the largest output
/// have no weight if the response fitted without them continues beyond it: the output was limited there.
///
/// # Errors
/// `ErrorKind::Data` without a step, with too few samples after it, or for a response that does not settle or is buried
/// in noise; `ErrorKind::Setting` for several inputs or an unusable sample time; `ErrorKind::Fit` on a stop.
pub fn fit_fopdt(record: Record<'_>, ts: f64, monitor: &Monitor) -> Result<Fopdt> {
    if record.channels != 1 || !(ts > 0.0 && ts.is_finite()) {
        return Err(Error::setting(format!(
            "expected one input and a sample time above 0 s, got {} inputs and {ts} s",
            record.channels
        )));
    }
    let mut step = Step::find(record, monitor)?;
    let mut best = step.best();
    if let Some((used, beyond)) = step.without_limit(&best) {
        (step.used, best) = (used, beyond);
    }
    if monitor.stopped() {
        return Err(Error::fit("expected time to search, got a stop"));
    }
    step.check(&best)?;
    let gain = best.rise / (step.u_high - step.u_low);
    let [rise, t, l] = confidence::errors(&step, &best);
    Ok(Fopdt {
        k: gain,
        t: best.t * ts,
        l: (best.l + step.early) * ts,
        offset: best.level - gain * step.u_low,
        u_low: step.u_low,
        u_high: step.u_high,
        fit_percent: 100.0 * (1.0 - (best.cost / step.spread()).sqrt()),
        errors: [rise / (step.u_high - step.u_low).abs(), t * ts, l * ts],
        limited: step.used.iter().filter(|used| !**used).count(),
        moving: step.moving,
        overshoot: confidence::overshoot(&step, &best),
    })
}

/// One step of the input and the outputs around it; times in samples.
struct Step<'a> {
    y: &'a [f64],
    /// The first sample with the input at its new level.
    at: usize,
    /// Time of the step before that sample, less than one sample: resampled inputs are averaged, so the sample in which
    /// the step falls lies between the levels.
    early: f64,
    u_low: f64,
    u_high: f64,
    /// Whether a sample has weight.
    used: Vec<bool>,
    /// Whether the fit includes a free response.
    moving: bool,
    monitor: &'a Monitor,
}

/// A candidate: `y(k) = level + rise (1 - exp(-(k - at - l)/t)) + free exp(-k/t)`.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    t: f64,
    l: f64,
    level: f64,
    rise: f64,
    free: f64,
    cost: f64,
}

impl Candidate {
    /// The response to the step, of size 1, at sample `k`.
    fn share(&self, k: usize, at: usize) -> f64 {
        let since = k as f64 - at as f64 - self.l;
        if since > 0.0 {
            -(-since / self.t).exp_m1()
        } else {
            0.0
        }
    }

    fn output(&self, k: usize, at: usize) -> f64 {
        self.level + self.rise * self.share(k, at) + self.free * (-(k as f64) / self.t).exp()
    }
}

impl<'a> Step<'a> {
    fn find(record: Record<'a>, monitor: &'a Monitor) -> Result<Self> {
        let u = record.u;
        let fold = |f: fn(f64, f64) -> f64| u.iter().copied().reduce(f).unwrap_or(0.0);
        let threshold = STEP_SHARE * (fold(f64::max) - fold(f64::min));
        let next_after = |from: usize| {
            (from + 1..u.len()).find(|&k| threshold > 0.0 && (u[k] - u[k - 1]).abs() > threshold)
        };
        let mut at = next_after(0).ok_or_else(|| {
            Error::data(
                "expected a step in the input, got one that stays where it is or only drifts; record some samples \
                 before the step too",
            )
        })?;
        let mut end = next_after(at).unwrap_or(u.len());
        let before = at;
        let mut early = 0.0;
        // one sample between two levels: the step fell within the time of that sample
        let between = at + 1 < u.len() && (u[at + 1] - u[at]) * (u[at] - u[at - 1]) > 0.0;
        if end == at + 1 && between {
            early = (u[at] - u[at - 1]) / (u[at + 1] - u[at - 1]);
            at += 1;
            end = next_after(at).unwrap_or(u.len());
        }
        if end - at < FEWEST {
            return Err(Error::data(format!(
                "expected at least {FEWEST} samples at the input's new level, got {} from sample {at} on; record a \
                 step that holds, not a ramp",
                end - at
            )));
        }
        let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        Ok(Self {
            y: &record.y[..end],
            at,
            early,
            u_low: mean(&u[..before]),
            u_high: mean(&u[at..end]),
            used: vec![true; end],
            moving: false,
            monitor,
        })
    }

    /// Samples after the step.
    fn length(&self) -> f64 {
        (self.y.len() - self.at) as f64
    }

    /// Outputs with weight, and their indices.
    fn samples(&self) -> impl Iterator<Item = (usize, f64)> {
        let with_weight = |(k, &y): (usize, &f64)| self.used[k].then_some((k, y));
        self.y.iter().enumerate().filter_map(with_weight)
    }

    fn count(&self) -> usize {
        self.samples().count()
    }

    fn spread(&self) -> f64 {
        let mean = self.samples().map(|(_, y)| y).sum::<f64>() / self.count() as f64;
        self.samples().map(|(_, y)| (y - mean).powi(2)).sum()
    }

    /// The best candidate from rest, or with a free response if that is clearly better.
    fn best(&mut self) -> Candidate {
        self.moving = false;
        let from_rest = self.search();
        let clearly = |other: &Candidate| {
            other.cost < CLEARLY * from_rest.cost && from_rest.cost > self.rounding()
        };
        if self.at >= FEWEST {
            let in_motion = Step {
                used: self.used.clone(),
                moving: true,
                ..*self
            };
            // If a free response helps at the best point of the other search, it gets a search of its own. A plant that stands still
            // before the step was not moving: an improvement is then a second lag, which this response does not model.
            if confidence::drifts(self) && clearly(&in_motion.candidate(from_rest.t, from_rest.l)) {
                let found = in_motion.search();
                if clearly(&found) && confidence::moves(&in_motion, &found) {
                    self.moving = true;
                    return found;
                }
            }
        }
        from_rest
    }

    /// Squares at the level of rounding for an exact response.
    fn rounding(&self) -> f64 {
        1e-10 * self.spread()
    }

    /// The samples before a limit of the output and the response fitted to them, if there is a limit: many samples
    /// share the outermost value, and the response without them continues beyond it.
    fn without_limit(&mut self, all: &Candidate) -> Option<(Vec<bool>, Candidate)> {
        let outward = all.rise.signum();
        let edge = self
            .y
            .iter()
            .map(|y| outward * y)
            .fold(f64::NEG_INFINITY, f64::max);
        let used: Vec<bool> = self.y.iter().map(|y| outward * y < edge).collect();
        let on_edge = used.iter().filter(|used| !**used).count();
        let before = used[self.at..].iter().filter(|used| **used).count();
        if on_edge < FEWEST.max(self.y.len() / 50) || before < FEWEST {
            return None;
        }
        let (kept, moving) = (std::mem::replace(&mut self.used, used), self.moving);
        let beyond = self.best();
        let noise = (beyond.cost / self.count() as f64).sqrt();
        let excess = (0..self.y.len())
            .filter(|&k| !self.used[k])
            .map(|k| outward * beyond.output(k, self.at) - edge);
        let excess = excess.sum::<f64>() / on_edge as f64;
        // relative to the rise as well: even an exact response settles at its last digit
        let limited = excess > (3.0 * noise).max(BEYOND * beyond.rise.abs());
        let used = std::mem::replace(&mut self.used, kept);
        if !limited {
            self.moving = moving;
        }
        limited.then_some((used, beyond))
    }

    /// The grid over `ln T` and `L`, narrowed around its best point until it is fine.
    fn search(&self) -> Candidate {
        let (mut ln_t, mut l) = (
            (0.05_f64.ln(), (4.0 * self.length()).ln()),
            (-self.early, self.length() / 2.0),
        );
        let mut best = self.candidate(self.length() / 5.0, 0.0);
        for _ in 0..ROUNDS {
            for i in 0..GRID {
                if self.monitor.stopped() {
                    return best;
                }
                for j in 0..GRID {
                    let found = self.candidate(at_share(ln_t, i).exp(), at_share(l, j));
                    if found.cost < best.cost {
                        best = found;
                    }
                }
            }
            ln_t = narrowed(ln_t, best.t.ln(), f64::NEG_INFINITY);
            l = narrowed(l, best.l, -self.early);
        }
        // A response determines the sum of T and L best. If T is a small part of it, the grid can miss the basin of the
        // best split.
        let sum = best.t + best.l;
        let shared = SHARES.map(|share| self.candidate(share * sum, (1.0 - share) * sum));
        let other = shared
            .into_iter()
            .reduce(|x, y| if y.cost < x.cost { y } else { x });
        let other = other.map(|other| self.polished(other));
        let best = self.polished(best);
        other.filter(|other| other.cost < best.cost).unwrap_or(best)
    }

    /// Gauss-Newton steps from the end of the grid search, as long as they lower the squares.
    ///
    /// `T` and `L` trade off along a narrow valley. A grid narrowed around its best point can leave the lowest place of
    /// a valley beside it: for one exact response in some 5,000 the gain was off by 1e-4.
    fn polished(&self, mut best: Candidate) -> Candidate {
        for _ in 0..STEPS {
            if self.monitor.stopped() {
                return best;
            }
            let Some((t, l)) = confidence::step(self, &best, false) else {
                return best;
            };
            let held = best.l + l < -self.early || best.l + l > self.length() / 2.0;
            // at the edge of dead times only T moves
            let (t, l) = if held {
                confidence::step(self, &best, true).unwrap_or((t, l))
            } else {
                (t, l)
            };
            let at = |share: f64| {
                let l = (best.l + share * l).clamp(-self.early, self.length() / 2.0);
                let t = best.t + share * t;
                (t > 0.0).then(|| self.candidate(t, l))
            };
            let shares = (0..HALVINGS).map(|halving| 0.5_f64.powi(halving as i32));
            let lower = |found: &Candidate| found.cost < best.cost * (1.0 - 1e-9);
            let Some(found) = shares.filter_map(at).find(lower) else {
                return best;
            };
            best = found;
        }
        best
    }

    /// Level, rise and free response by least squares for one `T` and `L`.
    fn candidate(&self, t: f64, l: f64) -> Candidate {
        let first = (self.at as f64 + l.floor() + 1.0) as usize;
        let decay = (-1.0 / t).exp();
        let mut left = (-(first as f64 - self.at as f64 - l) / t).exp();
        let mut free = if self.moving { 1.0 } else { 0.0 };
        // Relative to the first output: the sums of squares must not be lost in a large level.
        let from = self.y[0];
        let [mut n, mut p, mut pp, mut y, mut py, mut yy] = [0.0; 6];
        let [mut f, mut ff, mut pf, mut fy] = [0.0; 4];
        for (k, (&value, &used)) in self.y.iter().zip(&self.used).enumerate() {
            let phi = if k < first { 0.0 } else { 1.0 - left };
            if k >= first {
                left *= decay;
            }
            if used {
                let value = value - from;
                n += 1.0;
                p += phi;
                pp += phi * phi;
                y += value;
                py += phi * value;
                yy += value * value;
                if self.moving {
                    f += free;
                    ff += free * free;
                    pf += phi * free;
                    fy += free * value;
                }
            }
            free *= decay;
        }
        let x = if self.moving {
            let squares = Matrix3::new(n, p, f, p, pp, pf, f, pf, ff);
            let solved = squares
                .cholesky()
                .map(|c| c.solve(&Vector3::new(y, py, fy)));
            solved.unwrap_or_else(|| Vector3::repeat(f64::NAN))
        } else {
            let rise = (n * py - p * y) / (n * pp - p * p);
            Vector3::new((y - rise * p) / n, rise, 0.0)
        };
        let cost = yy - x.dot(&Vector3::new(y, py, fy));
        Candidate {
            t,
            l,
            level: from + x[0],
            rise: x[1],
            free: x[2],
            cost: if cost.is_finite() {
                cost.max(0.0)
            } else {
                f64::INFINITY
            },
        }
    }

    fn check(&self, found: &Candidate) -> Result<()> {
        let noise = (found.cost / self.count() as f64).sqrt();
        // For a constant output the rise is a rounding error.
        let least = (2.0 * noise).max(1e-9 * found.level.abs());
        let stands_out = found.rise.abs() > least && found.cost < 0.5 * self.spread();
        if !stands_out {
            return Err(Error::data(format!(
                "expected a response that stands out of the noise, got a rise of {} over a residual of {} rms; use a \
                 larger step, or check that u and y belong together",
                shown(found.rise),
                shown(noise)
            )));
        }
        let passed = 1.0 - (-(self.length() - found.l) / found.t).exp();
        if passed < SETTLED {
            return Err(Error::data(format!(
                "expected a response that settles, got {:.0} % of its rise within the record; hold the input about {:.1} \
                 times as long",
                100.0 * passed,
                (found.l + 4.0 * found.t) / self.length()
            )));
        }
        Ok(())
    }
}

fn at_share((low, high): (f64, f64), i: usize) -> f64 {
    low + (high - low) * i as f64 / (GRID - 1) as f64
}

fn narrowed((low, high): (f64, f64), about: f64, least: f64) -> (f64, f64) {
    let half = (high - low) / 4.0;
    ((about - half).max(least), about + half)
}

#[cfg(test)]
mod tests;
