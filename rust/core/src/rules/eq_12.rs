//! The paper's Eq. 12 itself, for any `L/T`: gains that minimise it after a step of the disturbance, alpha and beta after
//! one of the reference.
//!
//! With `K = T = 1`, `P = s + s^2` and `Q = P e^(sL) + Kp (s + 1/Ti + Td s^2)` the errors after unit steps are
//!
//! ```text
//! E_d = 1/Q,    E_r = (1 + s) e^(sL)/Q + Kp (alpha + beta Td s)/Q,    J = int_0^inf w |d^2 E/ds^2|^2 dw   at s = jw
//! ```
//!
//! `E_r` is linear in alpha and beta, so that their best values solve two linear equations. A derivative of the reference
//! makes the output jump, and the integral of `E_r` then grows with the logarithm of its upper limit: it is taken up to
//! `1000/L`, where alpha and beta agree best with Table 1. The integral of `E_d` converges.

mod locus;
mod search;

use super::Rule;
use crate::error::shown;
use crate::{Error, Result};
use locus::Locus;
use sewfast_control::Standard;

/// The range of `L/T` that the rule is made for.
const RATIOS: (f64, f64) = (0.01, 2.0);
/// Upper limits of the integrals times `L`.
const TOP: (f64, f64) = (100.0, 1000.0);
/// The same while searching: gains change by less than 1e-4.
const SEARCHED: f64 = 25.0;
/// No loop of the least cost without a limit has a smaller `max |S|`, at any ratio.
const FREE: f64 = 1.9;

/// What a set of gains costs, with `K = T = 1`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Costs {
    /// Eq. 12 after a step of the disturbance; infinite where the loop is unstable.
    pub disturbance: f64,
    /// Eq. 12 after a step of the reference, up to `1000/L`.
    pub reference: f64,
    /// `max |S|` of the loop in continuous time.
    pub ms: f64,
}

/// Gains of `K e^(-sL)/(1 + sT)` that minimise Eq. 12, among those with `max |S|` of at most `ms`.
///
/// # Errors
/// `ErrorKind::Setting` for numbers that are no such plant, `L/T` outside .01 to 2, or an `ms` that is not above 1.1.
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

/// What gains for `L/T` cost with `K = T = 1`: `kp` is `Kp K`, `ti` and `td` are in units of `T`.
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

    /// The largest gain is that of the quadratic of every frequency, not only of those at the nodes.
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
}
