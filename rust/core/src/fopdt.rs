//! First-order-plus-dead-time approximation (paper Eq. 10-11) of a measured step response.

use crate::{Error, Record, Result};

/// `K e^(-sL) / (1 + sT)` about an operating point, with the story of its fit.
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
}

/// A change of the input by more than this share of its range is a step.
const STEP_SHARE: f64 = 0.05;
/// The fewest samples after the step.
const FEWEST: usize = 10;
/// A response is settled once this share of it has passed.
const SETTLED: f64 = 0.95;
/// Points of the search in each direction.
const GRID: usize = 21;
/// Times that the search is narrowed about the best point, each time to a half.
const ROUNDS: usize = 26;

/// Fits the response to the first step in a record with one input.
///
/// `K` and the level before the step follow by linear least squares for each `T` and `L` of a search that is narrowed
/// until its steps are below a millionth. The record is used from its start to the next step of the input.
///
/// # Errors
/// `ErrorKind::Data` without a step, with too few samples after it or a response that does not settle or drowns in
/// noise; `ErrorKind::Setting` for several inputs or an unusable sample time.
pub fn fit_fopdt(record: Record<'_>, ts: f64) -> Result<Fopdt> {
    if record.channels != 1 || !(ts > 0.0 && ts.is_finite()) {
        return Err(Error::setting(format!(
            "expected one input and a sample time above 0 s, got {} inputs and {ts} s",
            record.channels
        )));
    }
    let step = Step::find(record)?;
    let best = step.search();
    step.check(&best)?;
    let gain = best.rise / (step.u_high - step.u_low);
    Ok(Fopdt {
        k: gain,
        t: best.t * ts,
        l: best.l * ts,
        offset: best.level - gain * step.u_low,
        u_low: step.u_low,
        u_high: step.u_high,
        fit_percent: 100.0 * (1.0 - (best.cost / step.spread()).sqrt()),
    })
}

/// One step of the input and the outputs about it; times in samples.
struct Step<'a> {
    y: &'a [f64],
    /// The sample from which on the input is at its new level.
    at: usize,
    u_low: f64,
    u_high: f64,
}

/// A candidate: `y(k) = level + rise (1 - exp(-(k - at - l)/t))`.
#[derive(Clone, Copy)]
struct Candidate {
    t: f64,
    l: f64,
    level: f64,
    rise: f64,
    cost: f64,
}

impl<'a> Step<'a> {
    fn find(record: Record<'a>) -> Result<Self> {
        let u = record.u;
        let fold = |f: fn(f64, f64) -> f64| u.iter().copied().reduce(f).unwrap_or(0.0);
        let threshold = STEP_SHARE * (fold(f64::max) - fold(f64::min));
        let next_after = |from: usize| {
            (from + 1..u.len()).find(|&k| threshold > 0.0 && (u[k] - u[k - 1]).abs() > threshold)
        };
        let at = next_after(0).ok_or_else(|| {
            Error::data(
                "expected a step in the input, got one that stays where it is or only drifts; record some samples \
                 before the step too",
            )
        })?;
        let end = next_after(at).unwrap_or(u.len());
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
            u_low: mean(&u[..at]),
            u_high: mean(&u[at..end]),
        })
    }

    /// Samples after the step.
    fn length(&self) -> f64 {
        (self.y.len() - self.at) as f64
    }

    fn spread(&self) -> f64 {
        let mean = self.y.iter().sum::<f64>() / self.y.len() as f64;
        self.y.iter().map(|y| (y - mean).powi(2)).sum()
    }

    /// The grid over `ln T` and `L`, narrowed about its best point until it is fine.
    fn search(&self) -> Candidate {
        let (mut ln_t, mut l) = (
            (0.05_f64.ln(), (4.0 * self.length()).ln()),
            (0.0, self.length() / 2.0),
        );
        let mut best = self.candidate(self.length() / 5.0, 0.0);
        for _ in 0..ROUNDS {
            for i in 0..GRID {
                for j in 0..GRID {
                    let found = self.candidate(at_share(ln_t, i).exp(), at_share(l, j));
                    if found.cost < best.cost {
                        best = found;
                    }
                }
            }
            ln_t = narrowed(ln_t, best.t.ln(), f64::NEG_INFINITY);
            l = narrowed(l, best.l, 0.0);
        }
        best
    }

    /// Level and rise by least squares for one `T` and `L`.
    fn candidate(&self, t: f64, l: f64) -> Candidate {
        let first = self.at + l.floor() as usize + 1;
        let decay = (-1.0 / t).exp();
        let mut left = (-(first as f64 - self.at as f64 - l) / t).exp();
        // The sums of squares must not drown in a large level.
        let from = self.y[0];
        let [mut p, mut pp, mut y, mut py, mut yy] = [0.0; 5];
        for (k, &value) in self.y.iter().enumerate() {
            let phi = if k < first { 0.0 } else { 1.0 - left };
            if k >= first {
                left *= decay;
            }
            let value = value - from;
            p += phi;
            pp += phi * phi;
            y += value;
            py += phi * value;
            yy += value * value;
        }
        let n = self.y.len() as f64;
        let rise = (n * py - p * y) / (n * pp - p * p);
        let level = (y - rise * p) / n;
        let cost = (yy - level * y - rise * py).max(0.0);
        let cost = if cost.is_finite() {
            cost
        } else {
            f64::INFINITY
        };
        Candidate {
            t,
            l,
            level: from + level,
            rise,
            cost,
        }
    }

    fn check(&self, found: &Candidate) -> Result<()> {
        let noise = (found.cost / self.y.len() as f64).sqrt();
        // A constant output leaves rounding errors as its rise.
        let least = (2.0 * noise).max(1e-9 * found.level.abs());
        let stands_out = found.rise.abs() > least && found.cost < 0.5 * self.spread();
        if !stands_out {
            return Err(Error::data(format!(
                "expected a response that stands out of the noise, got a rise of {:.4} over a residual of {noise:.4} \
                 rms; use a larger step, or check that u and y belong together",
                found.rise
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
mod tests {
    use super::*;
    use crate::random::Random;
    use proptest::prelude::*;

    const TS: f64 = 1e-3;

    /// Inputs and outputs of a step from `u_low` to `u_high` at sample `at`.
    fn response(plant: Fopdt, at: usize, n: usize) -> (Vec<f64>, Vec<f64>) {
        let u: Vec<f64> = (0..n)
            .map(|k| if k < at { plant.u_low } else { plant.u_high })
            .collect();
        let y = (0..n).map(|k| {
            let since = (k as f64 - at as f64) * TS - plant.l;
            let share = if since > 0.0 {
                1.0 - (-since / plant.t).exp()
            } else {
                0.0
            };
            plant.offset + plant.k * (plant.u_low + share * (plant.u_high - plant.u_low))
        });
        (u.clone(), y.collect())
    }

    fn plant(k: f64, t: f64, l: f64, offset: f64) -> Fopdt {
        Fopdt {
            k,
            t,
            l,
            offset,
            u_low: 1.0,
            u_high: 3.0,
            fit_percent: 100.0,
        }
    }

    fn fit(u: &[f64], y: &[f64]) -> Result<Fopdt> {
        fit_fopdt(Record::new(u, 1, y).unwrap(), TS)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn recovers_an_exact_response(
            k in prop_oneof![1.0..1000.0, -1000.0..-1.0], t in 0.01..0.4, l in 0.0..0.2,
            offset in -500.0..500.0, at in 1_usize..800,
        ) {
            let (u, y) = response(plant(k, t, l, offset), at, 3000);
            let found = fit(&u, &y).unwrap();
            prop_assert!((found.k / k - 1.0).abs() < 1e-4, "{found:?}");
            prop_assert!((found.t - t).abs() < 1e-3 * t + 1e-6 && (found.l - l).abs() < 1e-5 + 1e-3 * t, "{found:?}");
            prop_assert!((found.offset - offset).abs() < 1e-3 * (k.abs() + offset.abs()));
            prop_assert!(found.fit_percent > 99.9);
        }
    }

    #[test]
    fn bears_noise_and_the_steps_of_raw_speed() {
        let truth = plant(490.0, 0.25, 0.0075, 20.0);
        let (u, y) = response(truth, 300, 2500);
        let (mut random, count) = (Random::new(3), 38.168);
        let raw: Vec<f64> = y
            .iter()
            .map(|y| ((y + 15.0 * random.normal()) / count).round() * count)
            .collect();
        let found = fit(&u, &raw).unwrap();
        assert!((found.k / truth.k - 1.0).abs() < 0.005, "{found:?}");
        assert!((found.t / truth.t - 1.0).abs() < 0.02 && (found.l - truth.l).abs() < 0.002);
        assert!(found.fit_percent > 90.0 && found.fit_percent < 99.0);
    }

    #[test]
    fn uses_the_first_step_of_several() {
        let truth = plant(490.0, 0.1, 0.01, 0.0);
        let (mut u, mut y) = response(truth, 100, 1000);
        u.extend([0.0; 500]);
        y.extend([0.0; 500]);
        let found = fit(&u, &y).unwrap();
        assert!(
            (found.k / truth.k - 1.0).abs() < 1e-3 && found.u_high == 3.0,
            "{found:?}"
        );
    }

    #[test]
    fn refuses_what_holds_no_settled_step() {
        let truth = plant(490.0, 0.25, 0.01, 0.0);
        let (u, y) = response(truth, 100, 400);
        assert!(fit(&u, &y).unwrap_err().message.contains("settles"));
        assert!(
            fit(&[1.0; 500], &[0.0; 500])
                .unwrap_err()
                .message
                .contains("a step")
        );
        assert!(fit(&[], &[]).is_err());
        let ramp: Vec<f64> = (0..15).map(f64::from).collect();
        assert!(fit(&ramp, &ramp).unwrap_err().message.contains("ramp"));
        let (u, _) = response(truth, 100, 2000);
        let mut random = Random::new(1);
        let noise: Vec<f64> = (0..2000).map(|_| random.normal()).collect();
        assert!(fit(&u, &noise).unwrap_err().message.contains("noise"));
        assert!(fit(&u, &[7.3; 2000]).unwrap_err().message.contains("noise"));
        assert!(fit_fopdt(Record::new(&[1.0, 2.0], 2, &[1.0]).unwrap(), TS).is_err());
        assert!(fit_fopdt(Record::new(&u, 1, &noise).unwrap(), 0.0).is_err());
    }
}
