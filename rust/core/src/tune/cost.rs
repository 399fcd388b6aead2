//! What a run costs: terms in physical units and their weights; and constraints, which come before any cost.

use std::fmt;

use sewfast_control::AnyDesign;

use super::LoadLimit;
use crate::closed_loop::{Run, check_reference};
use crate::metrics::{Edge, Effort, rmse, smooth};
use crate::{Error, Result};

/// How much each term counts: a weight per unit; docs/CONVENTIONS.md, Tuning.
///
/// `None` is the default, a share of the references' span `R` (largest minus smallest value).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    /// Per unit of `rms(r - y)` \[y\].
    pub tracking: f64,
    /// Per unit of `rms(du)`, the command's change from sample to sample \[u\]; `.5 R/(u_max - u_min)`.
    pub chatter: Option<f64>,
    /// Per unit of `rms(u)` \[u\].
    pub effort: f64,
    /// Per percent of overshoot above its limit, on steps and trapezoids; `R/100`.
    pub overshoot: Option<f64>,
    /// Overshoot about which its cost begins \[%\].
    pub overshoot_limit: f64,
    /// Per millisecond of rise time beyond the reference's own, on steps and trapezoids.
    pub rise: f64,
    /// Per millisecond of the output's shift against the reference.
    pub lag: f64,
    /// Per unit share of samples at a limit (1: all); `.02 R`.
    pub saturation: Option<f64>,
    /// Per millisecond of recovery from a load step.
    pub recovery: f64,
    /// Per unit of the rms deviation under a load step \[y\].
    pub load: f64,
}

impl Default for Cost {
    fn default() -> Self {
        Self {
            tracking: 1.0,
            chatter: None,
            effort: 0.0,
            overshoot: None,
            overshoot_limit: 1.0,
            rise: 0.0,
            lag: 0.0,
            saturation: None,
            recovery: 0.0,
            load: 0.0,
        }
    }
}

impl Cost {
    /// The weights as numbers, for references of range `span` and commands of range `range`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for weights that are negative or not finite.
    pub fn weights(&self, span: f64, range: f64) -> Result<Weights> {
        let weights = Weights {
            tracking: self.tracking,
            chatter: self.chatter.unwrap_or(0.5 * span / range),
            effort: self.effort,
            overshoot: self.overshoot.unwrap_or(span / 100.0),
            overshoot_limit: self.overshoot_limit,
            rounding: ROUNDING,
            rise: self.rise,
            lag: self.lag,
            saturation: self.saturation.unwrap_or(0.02 * span),
            recovery: self.recovery,
            load: self.load,
        };
        match weights
            .named()
            .iter()
            .find(|(_, w)| !(*w >= 0.0 && w.is_finite()))
        {
            None => Ok(weights),
            Some((name, weight)) => Err(Error::setting(format!(
                "expected a finite weight of 0 or more for {name}, got {weight}"
            ))),
        }
    }
}

/// The rounding of a cost, as a share of the limit of overshoot. Made on eight plants of seeds 60 to 63 of `benches/assumptions.py shifts`; with
/// .3 the gains cost some .6 % more by the penalty with its kink, up to 7 %. Held back, 12 heaters, axes, tanks and positions of seeds 100 to 102, each at
/// three levels: gains more than 2 % apart on 3 (6 without); on seeds 80 to 82 costs by the penalty with its kink .45 % higher in the mean, 1.4 % at worst.
const ROUNDING: f64 = 0.1;

/// A [`Cost`] in numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(missing_docs, reason = "the fields are those of Cost")]
pub struct Weights {
    pub tracking: f64,
    pub chatter: f64,
    pub effort: f64,
    pub overshoot: f64,
    pub overshoot_limit: f64,
    /// The penalty of overshoot reaches its full slope within so much of the limit on both sides, as a share of the limit.
    pub rounding: f64,
    pub rise: f64,
    pub lag: f64,
    pub saturation: f64,
    pub recovery: f64,
    pub load: f64,
}

impl Weights {
    /// Every weight by its name.
    pub fn named(&self) -> [(&'static str, f64); 10] {
        [
            ("tracking", self.tracking),
            ("chatter", self.chatter),
            ("effort", self.effort),
            ("overshoot", self.overshoot),
            ("overshoot_limit", self.overshoot_limit),
            ("rise", self.rise),
            ("lag", self.lag),
            ("saturation", self.saturation),
            ("recovery", self.recovery),
            ("load", self.load),
        ]
    }

    /// The weighted sum, in the output's unit.
    pub fn of(&self, terms: &Terms) -> f64 {
        self.tracking * terms.tracking
            + self.chatter * terms.chatter
            + self.effort * terms.effort
            + self.overshoot * self.beyond_limit(terms.overshoot)
            + self.rise * terms.rise
            + self.lag * terms.lag
            + self.saturation * terms.saturation
            + self.recovery * terms.recovery
            + self.load * terms.load
    }

    /// The overshoot beyond its limit: `max(o - limit, 0)` with its kink rounded by a parabola.
    ///
    /// The least cost mostly lies where some runs reach the limit. A search is slow along a kink, and ends anywhere on it: two searches on
    /// models that agree to 1e-9 found gains several percent apart.
    fn beyond_limit(&self, overshoot: f64) -> f64 {
        let (excess, half) = (
            overshoot - self.overshoot_limit,
            self.rounding * self.overshoot_limit,
        );
        if excess >= half || half < f64::MIN_POSITIVE {
            return excess.max(0.0);
        }
        let above = (excess + half).max(0.0);
        above * above / (4.0 * half)
    }
}

/// What a run was like, each term in the unit stated; 0 if the reference says nothing about it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Terms {
    /// `rms(r - y)` \[y\].
    pub tracking: f64,
    /// `rms(du)` \[u\].
    pub chatter: f64,
    /// `rms(u)` \[u\].
    pub effort: f64,
    /// Overshoot on the first edge \[% of its step\].
    pub overshoot: f64,
    /// 10-to-90 % rise time beyond the reference's own \[ms\]; the whole remaining time if 90 % is not reached.
    pub rise: f64,
    /// Shift of the output against the reference at which their rms difference is least \[ms\].
    pub lag: f64,
    /// Share of samples at a limit.
    pub saturation: f64,
    /// Time after a load step until the deviation stays within its band \[ms\].
    pub recovery: f64,
    /// Rms deviation after a load step \[y\].
    pub load: f64,
    /// Largest `|u|` \[u\].
    pub u_max: f64,
}

impl Terms {
    /// The larger of each.
    pub(super) fn max(&self, other: &Self) -> Self {
        self.with(other, f64::max)
    }

    /// The sum of this and a share of another.
    pub(super) fn plus(&self, other: &Self, share: f64) -> Self {
        self.with(other, |a, b| a + share * b)
    }

    fn with(&self, other: &Self, of: impl Fn(f64, f64) -> f64) -> Self {
        Self {
            tracking: of(self.tracking, other.tracking),
            chatter: of(self.chatter, other.chatter),
            effort: of(self.effort, other.effort),
            overshoot: of(self.overshoot, other.overshoot),
            rise: of(self.rise, other.rise),
            lag: of(self.lag, other.lag),
            saturation: of(self.saturation, other.saturation),
            recovery: of(self.recovery, other.recovery),
            load: of(self.load, other.load),
            u_max: of(self.u_max, other.u_max),
        }
    }
}

/// Smoothing of the true output before its overshoot is computed [s]; docs/CONVENTIONS.md.
pub(super) const SMOOTHING: f64 = 5e-3;

/// Terms of the runs over one reference; terms that are not needed are not computed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Measure {
    edge: Option<Edge>,
    overshoot: bool,
    rise: bool,
    lag: bool,
}

impl Measure {
    /// Every term of runs over `reference`.
    pub fn all(reference: &[f64]) -> Self {
        Self {
            edge: Edge::first(reference),
            overshoot: true,
            rise: true,
            lag: true,
        }
    }

    /// The terms that have a weight.
    pub fn needed(reference: &[f64], weights: &Weights) -> Self {
        Self {
            edge: Edge::first(reference),
            overshoot: weights.overshoot > 0.0,
            rise: weights.rise > 0.0,
            lag: weights.lag > 0.0,
        }
    }

    /// The same, with the overshoot.
    #[must_use]
    pub fn with_overshoot(self) -> Self {
        Self {
            overshoot: true,
            ..self
        }
    }

    /// The terms of a run over the reference, under limits `low` and `high`.
    pub fn of(&self, reference: &[f64], run: &Run, (low, high): (f64, f64), ts: f64) -> Terms {
        let effort = Effort::of(&run.u, low, high);
        let terms = Terms {
            tracking: rmse(reference, &run.y),
            chatter: effort.du_rms,
            effort: effort.u_rms,
            saturation: effort.saturated,
            u_max: run.largest_command(),
            ..Terms::default()
        };
        self.shaped(terms, reference, &run.y, ts)
    }

    /// The terms, completed by those that depend on the course of the output.
    pub fn shaped(&self, mut terms: Terms, reference: &[f64], y: &[f64], ts: f64) -> Terms {
        if let (Some(edge), true) = (self.edge, self.overshoot || self.rise) {
            let y = smooth(y, ts, SMOOTHING);
            terms.overshoot = edge.overshoot_percent(&y);
            terms.rise = 1e3 * ts * rise(&edge, reference, &y);
        }
        if self.lag {
            terms.lag = 1e3 * ts * lag(reference, y, (LONGEST_LAG / ts) as usize);
        }
        terms
    }

    /// Which part of the output's course is needed.
    pub fn course(&self) -> Course {
        match self.edge {
            _ if self.lag => Course::All,
            Some(_) if self.rise => Course::All,
            Some(edge) if self.overshoot => Course::Overshoot(edge),
            _ => Course::Nothing,
        }
    }
}

/// Which part of an output's course is needed.
#[derive(Clone, Copy, Debug)]
pub(super) enum Course {
    /// Nothing.
    Nothing,
    /// Only the overshoot at this edge, after [`SMOOTHING`].
    Overshoot(Edge),
    /// More than that.
    All,
}

/// The terms of a run that was recorded elsewhere, under limits `low` and `high`.
///
/// # Errors
/// `ErrorKind::Data` for lengths that differ, no samples, or values that are not finite, `ErrorKind::Setting` for a
/// sample time that is not above 0.
pub fn terms(reference: &[f64], run: &Run, (low, high): (f64, f64), ts: f64) -> Result<Terms> {
    check_reference(reference)?;
    let all = [("u", &run.u), ("y", &run.y)];
    for (name, values) in all {
        if values.len() != reference.len() || values.iter().any(|v| !v.is_finite()) {
            return Err(Error::data(format!(
                "expected {} finite samples in {name}, as many as in the reference, got {}; cut to where all are known",
                reference.len(),
                values.iter().filter(|v| v.is_finite()).count()
            )));
        }
    }
    if !(ts > 0.0 && ts.is_finite()) {
        return Err(Error::setting(format!(
            "expected a sample time above 0, got {ts}"
        )));
    }
    Ok(Measure::all(reference).of(reference, run, (low, high), ts))
}

/// Rise time beyond the reference's own [samples].
fn rise(edge: &Edge, reference: &[f64], y: &[f64]) -> f64 {
    let own = edge.rise(reference);
    let found = edge.rise(y);
    if found.is_finite() {
        (found - own).max(0.0)
    } else {
        (edge.end - edge.start) as f64
    }
}

/// The longest lag that is searched [s].
const LONGEST_LAG: f64 = 0.25;
/// Samples between the shifts tried first.
const STRIDE: usize = 8;

/// The shift `s >= 0` with the least `mean((r(k - s) - y(k))^2)`, refined by a parabola through the best three [samples].
fn lag(reference: &[f64], y: &[f64], longest: usize) -> f64 {
    let longest = longest.min(y.len() / 4);
    let apart = |shift: usize| {
        let pairs = y[shift..].iter().zip(reference);
        pairs.map(|(y, r)| (y - r).powi(2)).sum::<f64>() / (y.len() - shift) as f64
    };
    let best = |shifts: &mut dyn Iterator<Item = usize>| {
        shifts
            .map(|s| (s, apart(s)))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map_or(0, |(shift, _)| shift)
    };
    let coarse = best(&mut (0..=longest).step_by(STRIDE));
    let near = coarse.saturating_sub(STRIDE)..=(coarse + STRIDE).min(longest);
    let fine = best(&mut near.clone());
    if fine == 0 || fine >= longest {
        return fine as f64;
    }
    let (before, at, after) = (apart(fine - 1), apart(fine), apart(fine + 1));
    let curvature = before - 2.0 * at + after;
    let aside = if curvature > 0.0 {
        0.5 * (before - after) / curvature
    } else {
        0.0
    };
    fine as f64 + aside.clamp(-0.5, 0.5)
}

/// The largest sensitivity `Ms` of a design's linear loops; infinite if one is unstable.
pub type Sensitivity<'a> = dyn Fn(&AnyDesign<f64>) -> f64 + Sync + 'a;

/// Constraints come before the cost (Deb 2000): infeasible candidates are compared by the sum of their relative
/// violations.
#[derive(Clone, Copy, Default)]
pub struct Constraints<'a> {
    /// Largest sensitivity, and the function that computes it.
    pub ms: Option<(f64, &'a Sensitivity<'a>)>,
    /// Largest overshoot on steps and trapezoids \[%\].
    pub overshoot: Option<f64>,
    /// Largest `|u|` \[u\].
    pub u: Option<f64>,
    /// Limits for each plant under the load steps; empty for no limits.
    pub loads: &'a [LoadLimit],
}

impl fmt::Debug for Constraints<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Constraints")
            .field("ms", &self.ms.map(|(limit, _)| limit))
            .field("overshoot", &self.overshoot)
            .field("u", &self.u)
            .field("loads", &self.loads)
            .finish()
    }
}

impl Constraints<'_> {
    pub(super) fn check(&self) -> Result<()> {
        let limits = [
            ("Ms", self.ms.map(|(limit, _)| limit), 1.0),
            ("overshoot", self.overshoot, 0.0),
            ("u", self.u, 0.0),
        ];
        let loads = self.loads.iter();
        let loads = loads.flat_map(|l| [("recovery", l.recovery), ("load", l.load)]);
        // An infinite limit on a plant's load step is no limit.
        let loads = loads.filter(|(_, limit)| *limit != f64::INFINITY);
        let loads = loads.map(|(name, limit)| (name, Some(limit), 0.0));
        for (name, limit, least) in limits.into_iter().chain(loads) {
            if limit.is_some_and(|limit| !(limit > least && limit.is_finite())) {
                return Err(Error::setting(format!(
                    "expected a finite limit above {least} for {name}, got {}",
                    limit.unwrap_or(f64::NAN)
                )));
            }
        }
        Ok(())
    }

    /// Excess by the linear loops; infinite if one is unstable.
    pub(super) fn of_loops(&self, design: &AnyDesign<f64>) -> Excess {
        self.ms.map_or(Excess::NONE, |(limit, sensitivity)| {
            Excess::of(sensitivity(design), limit)
        })
    }

    /// Excess of a plant by a run under a load step.
    pub(super) fn of_load(&self, plant: usize, terms: &Terms) -> Excess {
        self.loads.get(plant).map_or(Excess::NONE, |limit| {
            let recovery = Excess::of(terms.recovery, limit.recovery);
            recovery.and(Excess::of(terms.load, limit.load))
        })
    }

    /// Excess by the largest terms over all runs.
    pub(super) fn of_runs(&self, largest: &Terms) -> Excess {
        let over = |limit: Option<f64>, value| limit.map_or(Excess::NONE, |l| Excess::of(value, l));
        over(self.overshoot, largest.overshoot).and(over(self.u, largest.u_max))
    }
}

/// By what shares values exceed their limits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Excess {
    /// Sum of what is above 0.
    pub sum: f64,
    /// The largest, below 0 within all limits; minus infinity without limits.
    pub largest: f64,
}

impl Excess {
    pub const NONE: Self = Self {
        sum: 0.0,
        largest: f64::NEG_INFINITY,
    };

    fn of(value: f64, limit: f64) -> Self {
        let largest = if value.is_nan() {
            f64::INFINITY
        } else if limit == f64::INFINITY {
            f64::NEG_INFINITY
        } else {
            (value - limit) / limit
        };
        Self {
            sum: largest.max(0.0),
            largest,
        }
    }

    /// Of both.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            sum: self.sum + other.sum,
            largest: self.largest.max(other.largest),
        }
    }

    /// The worse of two plants or runs.
    #[must_use]
    pub fn worse(self, other: Self) -> Self {
        Self {
            sum: self.sum.max(other.sum),
            largest: self.largest.max(other.largest),
        }
    }
}

impl Default for Excess {
    fn default() -> Self {
        Self::NONE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chirp(shift: f64) -> Vec<f64> {
        (0..2000)
            .map(|k| {
                let t = (f64::from(k) - shift) * 1e-3;
                1000.0 * (1.0 - (6.0 * t + 4.0 * t * t).cos())
            })
            .collect()
    }

    #[test]
    fn finds_the_lag_between_samples_and_none_where_there_is_none() {
        let r = chirp(0.0);
        for shift in [0.0, 3.0, 17.0, 42.5] {
            let found = lag(&r, &chirp(shift), 250);
            assert!((found - shift).abs() < 0.05, "{shift}: {found}");
        }
        assert_eq!(lag(&r, &chirp(-5.0), 250), 0.0);
        assert_eq!(lag(&[1.0], &[2.0], 250), 0.0);
    }

    #[test]
    fn weights_are_absolute_or_shares_of_the_span() {
        let weights = Cost::default().weights(2000.0, 40.0).unwrap();
        assert_eq!((weights.chatter, weights.overshoot), (25.0, 20.0));
        assert_eq!((weights.saturation, weights.tracking), (40.0, 1.0));
        let cost = Cost {
            chatter: Some(5.0),
            ..Cost::default()
        };
        assert_eq!(cost.weights(2000.0, 40.0).unwrap().chatter, 5.0);
        for bad in [-1.0, f64::NAN, f64::INFINITY] {
            let cost = Cost {
                lag: bad,
                ..Cost::default()
            };
            assert!(
                cost.weights(1.0, 1.0)
                    .unwrap_err()
                    .message
                    .contains("for lag")
            );
        }
    }

    #[test]
    fn the_penalty_of_overshoot_begins_gradually_about_its_limit() {
        let weights = Cost {
            overshoot_limit: 2.0,
            ..Cost::default()
        };
        let weights = weights.weights(1.0, 1.0).unwrap();
        let (low, high) = (2.0 - 2.0 * ROUNDING, 2.0 + 2.0 * ROUNDING);
        for (overshoot, expected) in [(0.0, 0.0), (low, 0.0), (2.0, 0.05), (high, 0.2), (7.0, 5.0)]
        {
            let found = weights.beyond_limit(overshoot);
            assert!((found - expected).abs() < 1e-12, "{overshoot}: {found}");
        }
        let slope =
            |at: f64| (weights.beyond_limit(at + 1e-6) - weights.beyond_limit(at - 1e-6)) / 2e-6;
        for (at, expected) in [(low, 0.0), (2.0, 0.5), (high, 1.0)] {
            assert!((slope(at) - expected).abs() < 1e-5, "{at}: {}", slope(at));
        }
        // without an overshoot that costs nothing there is no kink to round
        let none = Weights {
            overshoot_limit: 0.0,
            ..weights
        };
        assert_eq!((none.beyond_limit(0.0), none.beyond_limit(3.0)), (0.0, 3.0));
    }

    #[test]
    fn a_run_costs_the_weighted_sum_of_its_terms() {
        let r: Vec<f64> = (0..200).map(|k| if k < 20 { 0.0 } else { 10.0 }).collect();
        let y: Vec<f64> = r.iter().map(|r| 1.1 * r).collect();
        let run = Run {
            u: (0..200).map(|k| f64::from(k % 2)).collect(),
            y,
            ..Run::default()
        };
        let terms = terms(&r, &run, (-1.0, 1.0), 1e-3).unwrap();
        assert!((terms.overshoot - 10.0).abs() < 1e-9 && (terms.chatter - 1.0).abs() < 1e-12);
        assert!((terms.tracking - 0.9_f64.sqrt()).abs() < 1e-12 && terms.saturation == 0.5);
        let cost = Cost {
            chatter: Some(2.0),
            overshoot: Some(3.0),
            saturation: Some(0.0),
            ..Cost::default()
        };
        let weights = cost.weights(10.0, 2.0).unwrap();
        let expected = terms.tracking + 2.0 * terms.chatter + 3.0 * 9.0;
        assert!((weights.of(&terms) - expected).abs() < 1e-9);
    }
}
