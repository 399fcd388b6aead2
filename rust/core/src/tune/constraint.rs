//! What a controller must keep to, whatever it costs.

use std::fmt;

use sewfast_control::AnyDesign;

use super::LoadLimit;
use super::cost::Terms;
use crate::{Error, Result};

/// The largest sensitivity `Ms` of a design's linear loops; infinite for an unstable one.
pub type Sensitivity<'a> = dyn Fn(&AnyDesign<f64>) -> f64 + Sync + 'a;

/// Limits that are kept before anything is weighed (Deb 2000): infeasible candidates are compared by the sum of their
/// relative violations.
#[derive(Clone, Copy, Default)]
pub struct Constraints<'a> {
    /// Largest sensitivity, and where it comes from.
    pub ms: Option<(f64, &'a Sensitivity<'a>)>,
    /// Largest overshoot on steps and trapezoids \[%\].
    pub overshoot: Option<f64>,
    /// Largest `|u|` \[u\].
    pub u: Option<f64>,
    /// What each plant may do under the load steps; empty for anything.
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
        // An infinite limit of a plant's load step is none.
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

    /// Relative violation by the linear loops; infinite for an unstable one.
    pub(super) fn of_loops(&self, design: &AnyDesign<f64>) -> f64 {
        self.ms.map_or(0.0, |(limit, sensitivity)| {
            excess(sensitivity(design), limit)
        })
    }

    /// Sum of a plant's relative violations by a run under a load step.
    pub(super) fn of_load(&self, plant: usize, terms: &Terms) -> f64 {
        self.loads.get(plant).map_or(0.0, |limit| {
            excess(terms.recovery, limit.recovery) + excess(terms.load, limit.load)
        })
    }

    /// Sum of the relative violations by what was the largest of all runs.
    pub(super) fn of_runs(&self, largest: &Terms) -> f64 {
        let over = |limit: Option<f64>, value| limit.map_or(0.0, |limit| excess(value, limit));
        over(self.overshoot, largest.overshoot) + over(self.u, largest.u_max)
    }
}

fn excess(value: f64, limit: f64) -> f64 {
    if value.is_nan() {
        f64::INFINITY
    } else if limit == f64::INFINITY {
        0.0
    } else {
        ((value - limit) / limit).max(0.0)
    }
}
