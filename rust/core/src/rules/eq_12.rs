//! The paper's Eq. 12 for any `L/T`: the gains minimise it after a step of the disturbance, alpha and beta after a step
//! of the reference.
//!
//! With `K = T = 1`, `P = s + s^2` and `Q = P e^(sL) + Kp (s + 1/Ti + Td s^2)` the errors after unit steps are
//!
//! ```text
//! E_d = 1/Q,    E_r = (1 + s) e^(sL)/Q + Kp (alpha + beta Td s)/Q,    J = int_0^inf w |d^2 E/ds^2|^2 dw   at s = jw
//! ```
//!
//! `E_r` is linear in alpha and beta, so their best values solve two linear equations. A derivative of the reference
//! makes the output jump, and the integral of `E_r` then grows with the logarithm of its upper limit. It is taken up to
//! `1000/L`, at which alpha and beta agree best with Table 1. The integral of `E_d` converges.

mod locus;

use nalgebra::Complex;
use sewfast_control::Standard;

use super::Rule;
use crate::error::shown;
use crate::simplex::{Corner, descended};
use crate::{Error, Result};
use locus::{Locus, Node};

/// The range of `L/T` for which the rule is made.
const RATIOS: (f64, f64) = (0.01, 2.0);
/// Upper limits of the integrals times `L`.
const TOP: (f64, f64) = (100.0, 1000.0);
/// The same during the search: the gains change by less than 1e-4.
const SEARCHED: f64 = 25.0;
/// Without a limit, no loop of least cost has a smaller `max |S|`, at any ratio.
const FREE: f64 = 1.9;

/// The cost of a set of gains, for `K = T = 1`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Costs {
    /// Eq. 12 after a step of the disturbance; infinite if the loop is unstable.
    pub disturbance: f64,
    /// Eq. 12 after a step of the reference, up to `1000/L`.
    pub reference: f64,
    /// `max |S|` of the loop in continuous time.
    pub ms: f64,
}

/// Gains of `K e^(-sL)/(1 + sT)` that minimise Eq. 12, subject to `max |S|` of at most `ms`.
///
/// # Errors
/// `ErrorKind::Setting` for invalid numbers of the plant, `L/T` outside .01 to 2, or an `ms` that is not above 1.1.
pub fn eq_12(k: f64, t: f64, l: f64, ms: f64) -> Result<(Rule, Costs)> {
    super::require_plant(k, t, l)?;
    let ratio = l / t;
    check(ratio, ms)?;
    let (locus, reference) = (Locus::up_to(ratio, TOP.0), Locus::up_to(ratio, TOP.1));
    let best = least(&Locus::up_to(ratio, SEARCHED), ms)?;
    let (alpha, beta) = reference.weights(best);
    let costs = locus.costs(&reference, best, alpha, beta);
    let gains = Standard {
        kp: best.kp / k,
        ti: best.ti * t,
        td: best.td * t,
    };
    Ok((Rule { gains, alpha, beta }, costs))
}

fn check(ratio: f64, ms: f64) -> Result<()> {
    if !(RATIOS.0 * (1.0 - 1e-12)..=RATIOS.1 * (1.0 + 1e-12)).contains(&ratio) {
        return Err(Error::setting(format!(
            "expected L/T from .01 to 2 for Eq. 12, got {}; add the feedback filter's delay to L, or take simc or amigo",
            shown(ratio)
        )));
    }
    // NaN is refused as well
    if !matches!(ms.partial_cmp(&1.1), Some(std::cmp::Ordering::Greater)) {
        return Err(Error::setting(format!(
            "expected a limit of Ms above 1.1, or inf, got {ms}; 1.4 to 2 is usual"
        )));
    }
    Ok(())
}

fn least(locus: &Locus, ms: f64) -> Result<Standard<f64>> {
    if ms > FREE {
        let free = locus.free();
        if locus.peak(free) <= ms {
            return Ok(free);
        }
    }
    locus.bounded(ms).ok_or_else(|| {
        Error::fit(format!(
            "expected gains with Ms of at most {ms}, found none; allow a larger Ms"
        ))
    })
}

/// The cost of gains for `L/T` with `K = T = 1`: `kp` is `Kp K`, `ti` and `td` are in units of `T`.
///
/// # Errors
/// `ErrorKind::Setting` for `L/T` that is not above 0, or gains that are not positive (`td` may be 0).
pub fn costs(ratio: f64, gains: Standard<f64>, alpha: f64, beta: f64) -> Result<Costs> {
    let known =
        ratio > 0.0 && ratio.is_finite() && gains.kp > 0.0 && gains.ti > 0.0 && gains.td >= 0.0;
    if !known {
        return Err(Error::setting(format!(
            "expected L/T, Kp K and Ti above 0 and Td of 0 or more, got {ratio} and {gains:?}"
        )));
    }
    let (locus, reference) = (Locus::up_to(ratio, TOP.0), Locus::up_to(ratio, TOP.1));
    Ok(locus.costs(&reference, gains, alpha, beta))
}

// The gains of least cost: without a limit of `max |S|`, and on its boundary.

impl Locus {
    /// `ln` of `Kp`, `Ti` and `Td` near the least cost, from which the search starts.
    fn start(&self) -> [f64; 3] {
        let l = self.l;
        [
            1.22 / l,
            2.6 * l / (1.0 + 0.92 * l),
            0.41 * l / (1.0 + 0.15 * l),
        ]
        .map(f64::ln)
    }

    /// The gains of least cost.
    pub(super) fn free(&self) -> Standard<f64> {
        let gains = |x: &[f64; 3]| Standard {
            kp: x[0].exp(),
            ti: x[1].exp(),
            td: x[2].exp(),
        };
        let best = minimised(self.start(), 0.1, |x| self.disturbance(gains(x)).ln());
        gains(&best)
    }

    /// The gains of least cost on the boundary `max |S| = ms`.
    pub(super) fn bounded(&self, ms: f64) -> Option<Standard<f64>> {
        let gains = |x: &[f64; 2]| self.largest(x[0].exp(), x[1].exp(), ms);
        let [_, ti, td] = self.start();
        let cost = |x: &[f64; 2]| gains(x).map_or(f64::INFINITY, |g| self.integral(g).ln());
        gains(&minimised([ti, td + 0.8_f64.ln()], 0.2, cost))
    }

    /// The largest `Kp` with these times for which the loop is stable and `max |S|` is `ms`; `None` if only `Kp = 0` has it.
    ///
    /// With `L = Kp x` a frequency forbids the gains between the roots of `1 + 2 Kp Re x + Kp^2 |x|^2 = 1/ms^2`.
    /// Neighbouring frequencies together forbid one range, and high frequencies forbid all gains above
    /// `Kp Td = 1 - 1/ms`. Between the ranges nothing meets -1, so either all gains there are stable or none is.
    pub(super) fn largest(&self, ti: f64, td: f64, ms: f64) -> Option<Standard<f64>> {
        let beyond = 1.0 - 1.0 / (ms * ms);
        let mut ranges = self.forbidden(|n| n.forbids(ti, td, beyond));
        ranges.push(Range {
            low: (1.0 - 1.0 / ms) / td,
            high: f64::INFINITY,
            lowest: None,
        });
        ranges.sort_by(|a, b| a.low.total_cmp(&b.low));
        let with = |kp: f64| Standard { kp, ti, td };
        let (mut below, mut best) = (0.0_f64, None);
        for range in &ranges {
            if range.low > below && self.is_stable(with(0.5 * (below + range.low))) {
                best = Some(range);
            }
            below = below.max(range.high);
        }
        let lower_root = |n: &Node| n.forbids(ti, td, beyond).map_or(f64::INFINITY, |r| r.0);
        best.map(|range| {
            with(
                range
                    .lowest
                    .map_or(range.low, |i| self.lowest_near(i, lower_root)),
            )
        })
    }

    /// The ranges that runs of neighbouring frequencies forbid together.
    fn forbidden(&self, of: impl Fn(&Node) -> Option<(f64, f64)>) -> Vec<Range> {
        let mut ranges: Vec<Range> = Vec::new();
        let mut running = false;
        for (i, node) in self.nodes.iter().enumerate() {
            let own = of(node);
            match (own, ranges.last_mut()) {
                (Some((low, high)), Some(range)) if running => {
                    if low < range.low {
                        (range.low, range.lowest) = (low, Some(i));
                    }
                    range.high = range.high.max(high);
                }
                (Some((low, high)), _) => ranges.push(Range {
                    low,
                    high,
                    lowest: Some(i),
                }),
                (None, _) => {}
            }
            running = own.is_some();
        }
        ranges
    }
}

/// A range of gains forbidden by some frequencies.
struct Range {
    low: f64,
    high: f64,
    /// The node that forbids the lowest of them; `None` for the limit of high frequencies.
    lowest: Option<usize>,
}

impl Node {
    /// `F_1 G` with `Kp = 1`.
    fn unit_loop(&self, ti: f64, td: f64) -> Complex<f64> {
        let s = Complex::new(0.0, self.omega);
        (s + s * s * td + 1.0 / ti) / self.p[0]
    }

    /// The gains between which this frequency's `|S|` is too large.
    fn forbids(&self, ti: f64, td: f64, beyond: f64) -> Option<(f64, f64)> {
        let x = self.unit_loop(ti, td);
        let discriminant = x.re * x.re - x.norm_sqr() * beyond;
        (x.re < 0.0 && discriminant >= 0.0).then(|| {
            let root = discriminant.sqrt();
            (beyond / (root - x.re), (root - x.re) / x.norm_sqr())
        })
    }
}

/// Steps of the search before it restarts from its best point, and the number of restarts.
const STEPS: usize = 400;
const ROUNDS: usize = 2;
/// A simplex of this size counts as a point.
const SMALL: f64 = 1e-6;

/// The minimum of `cost` near `start`; the first simplex has edges of `step`.
fn minimised<const N: usize>(
    start: [f64; N],
    step: f64,
    cost: impl Fn(&[f64; N]) -> f64,
) -> [f64; N] {
    let array = |x: &[f64]| -> [f64; N] { std::array::from_fn(|i| x[i]) };
    let small = |corners: &[Corner]| {
        let (first, others) = (&corners[0].1, &corners[1..]);
        let far = |c: &Corner| (0..N).any(|i| (c.1[i] - first[i]).abs() >= SMALL);
        !others.iter().any(far)
    };
    let mut best = start;
    for round in 0..ROUNDS {
        let edge = step / if round == 0 { 1.0 } else { 20.0 };
        best = array(&descended(&best, edge, STEPS, small, &|x: &[f64]| cost(&array(x))).1);
    }
    best
}

#[cfg(test)]
mod tests {
    use super::super::{Outside, TABLE_1, table_1};
    use super::*;

    fn solved(ratio: f64, ms: f64) -> (Rule, Costs) {
        eq_12(1.0, 1.0, ratio, ms).unwrap()
    }

    #[test]
    fn finds_the_minima_that_another_program_found() {
        for (ratio, exact) in [
            (0.1, [12.035, 0.244, 0.040]),
            (0.5, [2.448, 0.894, 0.191]),
            (1.0, [1.285, 1.354, 0.355]),
        ] {
            let Standard { kp, ti, td } = solved(ratio, f64::INFINITY).0.gains;
            for (found, exact) in [kp, ti, td].iter().zip(exact) {
                assert!(
                    (found - exact).abs() < 6e-4 + 1e-3 * exact,
                    "{kp} {ti} {td}"
                );
            }
        }
    }

    #[test]
    fn table_1_costs_within_a_tenth_of_the_minimum() {
        for row in TABLE_1 {
            let rule = table_1(1.0, 1.0, row[0], Outside::Error).unwrap();
            let of_table = costs(row[0], rule.gains, rule.alpha, rule.beta).unwrap();
            let (_, least) = solved(row[0], f64::INFINITY);
            let share = of_table.disturbance / least.disturbance;
            assert!((1.0..1.1).contains(&share), "{row:?} {share}");
            assert!(
                of_table.reference < 1.2 * least.reference,
                "{row:?} {of_table:?} {least:?}"
            );
        }
    }

    #[test]
    fn keeps_the_limit_of_ms_at_a_price() {
        let (free, bounded) = (solved(0.1, f64::INFINITY), solved(0.1, 2.0));
        assert!(
            free.1.ms > 3.0 && free.1.ms < 3.6 && (bounded.1.ms - 2.0).abs() < 1e-3,
            "{bounded:?}"
        );
        let price = bounded.1.disturbance / free.1.disturbance;
        assert!(price > 2.0 && price < 3.0, "{price} {bounded:?}");
        let Standard { kp, ti, td } = bounded.0.gains;
        for (found, exact) in [(kp, 8.8), (ti, 0.30), (td, 0.035)] {
            assert!((found / exact - 1.0).abs() < 0.05, "{bounded:?}");
        }
        assert_eq!(solved(0.1, 5.0), free);
    }

    #[test]
    fn covers_its_range_smoothly_and_scales_with_the_plant() {
        let mut last: Option<[f64; 3]> = None;
        for i in 0..24 {
            let ratio = 0.01 * 200.0_f64.powf(f64::from(i) / 23.0);
            let (rule, costs) = solved(ratio, f64::INFINITY);
            let now = [
                rule.gains.kp * ratio,
                rule.gains.ti / ratio,
                rule.gains.td / ratio,
            ];
            assert!(
                costs.disturbance.is_finite() && costs.ms < 4.0,
                "{ratio} {costs:?}"
            );
            if let Some(before) = last {
                for (a, b) in now.iter().zip(before) {
                    assert!((a / b - 1.0).abs() < 0.2, "{ratio} {now:?} {before:?}");
                }
            }
            last = Some(now);
        }
        let (small, large) = (
            eq_12(1.0, 1.0, 0.1, 2.0).unwrap().0,
            eq_12(-4.0, 0.5, 0.05, 2.0).unwrap().0,
        );
        assert!((large.gains.kp / (small.gains.kp / -4.0) - 1.0).abs() < 1e-6);
        assert!((large.gains.ti / (small.gains.ti * 0.5) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn no_loop_without_a_limit_is_calmer_than_where_one_is_searched_for() {
        for i in 0..12 {
            let ratio = 0.01 * 200.0_f64.powf(f64::from(i) / 11.0);
            assert!(solved(ratio, f64::INFINITY).1.ms > FREE, "{ratio}");
        }
    }

    /// The largest gain must hold at every frequency, not only at the nodes.
    #[test]
    fn the_largest_gain_is_where_the_peak_reaches_the_limit() {
        for (ratio, ti, td) in [
            (0.05, 0.2, 0.0),
            (0.1, 0.25, 0.04),
            (0.1, 0.25, 0.2),
            (0.7, 1.0, 0.2),
            (2.0, 2.0, 0.6),
        ] {
            let locus = Locus::up_to(ratio, SEARCHED);
            for ms in [1.2, 1.7, 2.5] {
                let g = locus.largest(ti, td, ms).unwrap();
                assert!(
                    (locus.peak(g) / ms - 1.0).abs() < 1e-6,
                    "{ratio} {ms} {g:?}"
                );
            }
        }
    }

    #[test]
    fn an_unstable_loop_costs_infinitely_much() {
        let at = |kp: f64, td: f64| costs(0.1, Standard { kp, ti: 0.2, td }, 0.0, 0.0).unwrap();
        assert!(at(30.0, 0.0).disturbance.is_infinite() && at(30.0, 0.05).ms.is_infinite());
        assert!(at(5.0, 0.0).reference.is_finite());
    }

    #[test]
    fn refuses_what_it_is_not_made_for() {
        for ratio in [0.009, 2.1] {
            assert!(
                eq_12(1.0, 1.0, ratio, 2.0)
                    .unwrap_err()
                    .message
                    .contains("L/T")
            );
        }
        for ms in [1.0, f64::NAN, -2.0] {
            assert!(eq_12(1.0, 1.0, 0.1, ms).unwrap_err().message.contains("Ms"));
        }
        assert!(
            eq_12(0.0, 1.0, 0.1, 2.0).is_err()
                && costs(
                    0.0,
                    Standard {
                        kp: 1.0,
                        ti: 1.0,
                        td: 0.0
                    },
                    0.0,
                    0.0
                )
                .is_err()
        );
    }

    #[test]
    fn finds_the_minimum_of_a_bent_valley() {
        let cost = |x: &[f64; 2]| (1.0 - x[0]).powi(2) + 100.0 * (x[1] - x[0] * x[0]).powi(2);
        let found = minimised([-1.0, 1.0], 0.3, cost);
        assert!(
            (found[0] - 1.0).abs() < 1e-4 && (found[1] - 1.0).abs() < 1e-4,
            "{found:?}"
        );
    }
}
