//! Tuning rules from a first-order-plus-dead-time model: Table 1 of the paper, Eq. 12 itself, SIMC and AMIGO.

mod eq_12;

use sewfast_control::Standard;

use crate::error::shown;
use crate::{Error, Result};

pub use eq_12::{Costs, costs, eq_12};

/// `L/T`, `Kp K`, `TI/T`, `TD/T`, alpha, beta; the print heads the third and fourth column K_I/T and K_D/T.
const TABLE_1: [[f64; 6]; 10] = [
    [0.1, 12.5, 0.22, 0.04, 0.68, 0.75],
    [0.2, 6.1, 0.41, 0.08, 0.63, 0.70],
    [0.3, 4.1, 0.57, 0.11, 0.62, 0.70],
    [0.4, 3.1, 0.71, 0.15, 0.59, 0.69],
    [0.5, 2.5, 0.83, 0.18, 0.58, 0.69],
    [0.6, 2.11, 0.94, 0.21, 0.56, 0.69],
    [0.7, 1.82, 1.05, 0.24, 0.54, 0.69],
    [0.8, 1.61, 1.13, 0.28, 0.51, 0.68],
    [0.9, 1.44, 1.22, 0.31, 0.48, 0.69],
    [1.0, 1.33, 1.26, 0.34, 0.49, 0.66],
];

/// The result of a rule: gains in standard form and the two reference parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rule {
    /// Gains in standard form.
    pub gains: Standard<f64>,
    /// Share of the reference taken out of the proportional term.
    pub alpha: f64,
    /// Share of the reference taken out of the derivative term.
    pub beta: f64,
}

/// What to do if `L/T` lies outside the table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outside {
    /// Refuse.
    #[default]
    Error,
    /// Take the end row. Below .1 it is made for a dead time of `.1 T`, longer than the plant's: conservative. Above 1
    /// it is made for a shorter dead time than the plant's: not conservative.
    Nearest,
}

/// Table 1 for the plant `K e^(-sL) / (1 + sT)`, interpolated in `L/T`.
///
/// `Kp K` is interpolated as `Kp K L/T`, which is nearly constant; at the rows the result is exact.
///
/// # Errors
/// `ErrorKind::Setting` for a `K` of 0, a `T` that is not above 0, a negative `L`, or `L/T` outside .1 to 1 without
/// `Nearest`.
pub fn table_1(k: f64, t: f64, l: f64, outside: Outside) -> Result<Rule> {
    require_plant(k, t, l)?;
    let ratio = l / t;
    if outside == Outside::Error && !(0.1..=1.0).contains(&ratio) {
        return Err(Error::setting(format!(
            "expected L/T from .1 to 1 for Table 1, got {}; take the nearest row (outside = \"nearest\", which below .1 \
             means L = .1 T and is conservative), or eq_12",
            shown(ratio)
        )));
    }
    let [kp_k, ti, td, alpha, beta] = interpolate(ratio.clamp(0.1, 1.0));
    let gains = Standard {
        kp: kp_k / k,
        ti: ti * t,
        td: td * t,
    };
    Ok(Rule { gains, alpha, beta })
}

fn require_plant(k: f64, t: f64, l: f64) -> Result<()> {
    if !(k != 0.0 && k.is_finite() && t > 0.0 && t.is_finite() && l >= 0.0 && l.is_finite()) {
        return Err(Error::setting(format!(
            "expected a gain K other than 0, T above 0 s and L of 0 s or more, got K = {k}, T = {t}, L = {l}"
        )));
    }
    Ok(())
}

fn interpolate(ratio: f64) -> [f64; 5] {
    let above = TABLE_1
        .iter()
        .position(|row| row[0] >= ratio)
        .unwrap_or(TABLE_1.len() - 1)
        .max(1);
    let (low, high) = (&TABLE_1[above - 1], &TABLE_1[above]);
    let share = (ratio - low[0]) / (high[0] - low[0]);
    let between = |low: f64, high: f64| low + share * (high - low);
    let column = |i: usize| between(low[i], high[i]);
    let kp_k = between(low[1] * low[0], high[1] * high[0]) / ratio;
    [kp_k, column(2), column(3), column(4), column(5)]
}

/// SIMC: `Kc = T/(K (tau_c + L))`, `tau_I = min(T, 4 (tau_c + L))`, and with `derivative` `tau_D = L/3`.
///
/// The PID is in series form with the derivative on the output only, `Kc (1 + 1/(tau_I s)) (r - (1 + tau_D s) y)`. In
/// standard form, `f = 1 + tau_D/tau_I` gives `Kp = Kc f`, `Ti = tau_I f`, `Td = tau_D/f`, `alpha = 1 - 1/f`, `beta = 1`. (S.
/// Skogestad, *J. Process Control* 13, 2003; `L/3`: C. Grimholt, S. Skogestad, *J. Process Control* 70, 2018.)
///
/// # Errors
/// `ErrorKind::Setting` for invalid numbers of the plant, or a `tau_c + L` that is not above 0.
pub fn simc(k: f64, t: f64, l: f64, tau_c: f64, derivative: bool) -> Result<Rule> {
    require_plant(k, t, l)?;
    if !(tau_c >= 0.0 && tau_c.is_finite() && tau_c + l > 0.0) {
        return Err(Error::setting(format!(
            "expected a closed-loop time constant tau_c of 0 s or more, above 0 where L is 0, got {tau_c}; tau_c = L is usual"
        )));
    }
    let (kc, tau_i) = (t / (k * (tau_c + l)), t.min(4.0 * (tau_c + l)));
    let tau_d = if derivative { l / 3.0 } else { 0.0 };
    let f = 1.0 + tau_d / tau_i;
    let gains = Standard {
        kp: kc * f,
        ti: tau_i * f,
        td: tau_d / f,
    };
    Ok(Rule {
        gains,
        alpha: 1.0 - 1.0 / f,
        beta: if derivative { 1.0 } else { 0.0 },
    })
}

/// AMIGO: `Kp = (.2 + .45 T/L)/K`, `Ti = L (.4 L + .8 T)/(L + .1 T)`, `Td = .5 L T/(.3 L + T)`, `beta = 1`, and
/// `alpha = 1` if `L/(L + T)` is at most .5, else 0.
///
/// (K. J. Astrom, T. Hagglund, "Revisiting the Ziegler-Nichols step response method for PID control", *J. Process
/// Control* 14, 2004.)
///
/// # Errors
/// `ErrorKind::Setting` for invalid numbers of the plant, or an `L` of 0.
pub fn amigo(k: f64, t: f64, l: f64) -> Result<Rule> {
    require_plant(k, t, l)?;
    if l == 0.0 {
        return Err(Error::setting(
            "expected a dead time above 0 s for AMIGO, got 0; add the feedback filter's delay to L",
        ));
    }
    let gains = Standard {
        kp: (0.2 + 0.45 * t / l) / k,
        ti: l * (0.4 * l + 0.8 * t) / (l + 0.1 * t),
        td: 0.5 * l * t / (0.3 * l + t),
    };
    let alpha = if l / (l + t) <= 0.5 { 1.0 } else { 0.0 };
    Ok(Rule {
        gains,
        alpha,
        beta: 1.0,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::loop_transfer::{Loop, Path, Plant, peak_sensitivity};

    #[test]
    fn gives_the_rows_of_the_table() {
        for row in TABLE_1 {
            let (k, t) = (490.0, 0.25);
            let rule = table_1(k, t, row[0] * t, Outside::Error).unwrap();
            let received = [
                rule.gains.kp * k,
                rule.gains.ti / t,
                rule.gains.td / t,
                rule.alpha,
                rule.beta,
            ];
            for (a, b) in received.iter().zip(&row[1..]) {
                assert!((a - b).abs() < 1e-9, "{received:?} {row:?}");
            }
        }
    }

    proptest! {
        #[test]
        fn lies_between_its_neighbours(ratio in 0.1..1.0_f64, t in 0.01..10.0) {
            let rule = table_1(2.0, t, ratio * t * (1.0 - 1e-12) + 1e-12 * t, Outside::Nearest).unwrap();
            let i = ((ratio * 10.0).floor() as usize).clamp(1, 9);
            let (low, high) = (TABLE_1[i - 1], TABLE_1[i]);
            let kp_k = rule.gains.kp * 2.0;
            prop_assert!(kp_k <= low[1] + 1e-9 && kp_k >= high[1] - 1e-9);
            prop_assert!(rule.gains.ti / t >= low[2] - 1e-9 && rule.gains.ti / t <= high[2] + 1e-9);
        }
    }

    #[test]
    fn refuses_what_lies_outside_unless_the_nearest_row_is_asked_for() {
        let refused = table_1(490.0, 0.25, 0.0075, Outside::Error).unwrap_err();
        assert!(refused.message.contains("0.0300") && refused.message.contains("nearest"));
        assert!(table_1(490.0, 0.25, 0.3, Outside::Error).is_err());
        let nearest = table_1(490.0, 0.25, 0.0075, Outside::Nearest).unwrap();
        assert_eq!(
            nearest,
            table_1(490.0, 0.25, 0.025, Outside::Error).unwrap()
        );
        for (k, t, l) in [
            (0.0, 1.0, 0.1),
            (1.0, 0.0, 0.1),
            (1.0, 1.0, -0.1),
            (f64::NAN, 1.0, 0.1),
        ] {
            assert!(table_1(k, t, l, Outside::Nearest).is_err());
        }
    }

    #[test]
    fn keeps_the_sign_of_a_plant_that_acts_in_reverse() {
        let rule = table_1(-2.0, 1.0, 0.5, Outside::Error).unwrap();
        assert_eq!(rule.gains.kp, -1.25);
    }

    fn ms(rule: Rule, l: f64) -> f64 {
        let ts = l / 200.0;
        let (path, plant) = (
            Path::new(rule.gains, ts),
            Plant::fopdt(1.0, 1.0, l, ts).unwrap(),
        );
        peak_sensitivity(&Loop::new(&path, &plant).unwrap())
    }

    #[test]
    fn simc_is_as_robust_as_published() {
        // tau_c = L: Ms is 1.59 if the integral time is T (Skogestad 2003, Table 1)
        for l in [0.2, 0.5, 2.0] {
            assert!((ms(simc(1.0, 1.0, l, l, false).unwrap(), l) - 1.59).abs() < 0.01);
        }
        // 1.70 for a plant that is nearly an integrator
        assert!((ms(simc(1.0, 1.0, 0.005, 0.005, false).unwrap(), 0.005) - 1.70).abs() < 0.02);
        let pid = simc(2.0, 1.0, 0.3, 0.15, true).unwrap();
        let f = 1.1;
        assert!(
            (pid.gains.kp - f / (2.0 * 0.45)).abs() < 1e-12 && (pid.gains.ti - f).abs() < 1e-12
        );
        assert!((pid.gains.td - 0.1 / f).abs() < 1e-12 && pid.beta == 1.0);
        // the proportional gain on the reference is Kc
        assert!((pid.gains.kp * (1.0 - pid.alpha) - 1.0 / (2.0 * 0.45)).abs() < 1e-12);
    }

    #[test]
    fn amigo_is_as_robust_as_it_promises() {
        for l in [0.05, 0.2, 1.0, 3.0] {
            // designed for M = 1.4; the formulas keep it within 15 %
            let found = ms(amigo(1.0, 1.0, l).unwrap(), l);
            assert!((1.2..1.61).contains(&found), "{l} {found}");
        }
        let rule = amigo(1.0, 1.0, 1.0).unwrap();
        assert!((rule.gains.kp - 0.65).abs() < 1e-12 && (rule.gains.ti - 1.2 / 1.1).abs() < 1e-12);
        assert!((rule.gains.td - 0.5 / 1.3).abs() < 1e-12 && rule.alpha == 1.0);
        assert_eq!(amigo(1.0, 1.0, 1.1).unwrap().alpha, 0.0);
    }

    #[test]
    fn refuse_what_is_no_plant() {
        assert!(
            simc(0.0, 1.0, 0.1, 0.1, false).is_err() && simc(1.0, 1.0, 0.0, 0.0, true).is_err()
        );
        assert!(simc(1.0, 1.0, 0.1, f64::NAN, true).is_err() && amigo(1.0, 1.0, 0.0).is_err());
    }
}
