//! Rules in closed form: SIMC and AMIGO.

use sewfast_control::Standard;

use super::{Rule, require_plant};
use crate::{Error, Result};

/// SIMC: `Kc = T/(K (tau_c + L))`, `tau_I = min(T, 4 (tau_c + L))`, and with `derivative` `tau_D = L/3`.
///
/// The PID is of series form with the derivative on the output alone, `Kc (1 + 1/(tau_I s)) (r - (1 + tau_D s) y)`; in the
/// standard form `f = 1 + tau_D/tau_I` gives `Kp = Kc f`, `Ti = tau_I f`, `Td = tau_D/f`, `alpha = 1 - 1/f`, `beta = 1`.
/// (S. Skogestad, *J. Process Control* 13, 2003; `L/3`: C. Grimholt, S. Skogestad, *J. Process Control* 70, 2018.)
///
/// # Errors
/// `ErrorKind::Setting` for numbers that are no such plant, or a `tau_c + L` that is not above 0.
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

/// AMIGO: `Kp = (.2 + .45 T/L)/K`, `Ti = L (.4 L + .8 T)/(L + .1 T)`, `Td = .5 L T/(.3 L + T)`, `beta = 1`, and `alpha = 1` where
/// `L/(L + T)` is at most .5, else 0.
///
/// (K. J. Astrom, T. Hagglund, "Revisiting the Ziegler-Nichols step response method for PID control", *J. Process
/// Control* 14, 2004.)
///
/// # Errors
/// `ErrorKind::Setting` for numbers that are no such plant, or an `L` of 0.
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
    use super::*;
    use crate::loop_transfer::{Loop, Path, Plant, peak_sensitivity};

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
        // tau_c = L: Ms 1.59 where the integral time is T (Skogestad 2003, Table 1)
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
        // what the reference meets is Kc
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
