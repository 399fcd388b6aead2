//! References that a drive can follow: the nearest to a wanted one within the commands that its model allows.
//!
//! With the levels `held` and the sum `m` of the taps of a feedforward, a change of the reference by `d` in a sample needs
//! the command `held(r) + m d`. Within limits of the command the reference can so change by `(u_min - held(r))/m` to
//! `(u_max - held(r))/m` from here: less the faster a motor turns already, and more while it brakes. The wanted reference is followed
//! within these; then a centred moving average bounds the change of the change, the jerk. For a step this is the time-optimal ramp of the
//! model within the limits, with rounded corners.

use sewfast_control::Feedforward;

use crate::closed_loop::check_reference;
use crate::{Error, Result};

/// The nearest reference within commands from `low` to `high`, its corners rounded over `smooth` samples.
///
/// # Errors
/// `ErrorKind::Data` for a reference that is empty or not finite, `ErrorKind::Setting` without taps, and for a level that
/// no command within the limits holds.
pub fn planned(
    reference: &[f64],
    feedforward: &Feedforward<f64>,
    (low, high): (f64, f64),
    smooth: usize,
) -> Result<Vec<f64>> {
    check_reference(reference)?;
    let moving: f64 = feedforward.taps().iter().sum();
    if !(moving != 0.0 && low < high) {
        return Err(Error::setting(format!(
            "expected a feedforward with taps and a command's limits in order to plan a reference, got taps that sum up to \
             {moving} and {low} to {high}; tune the controller on a model"
        )));
    }
    let held = |y: f64| {
        if feedforward.levels().is_empty() {
            0.0
        } else {
            feedforward.held(y)
        }
    };
    for (k, &r) in reference.iter().enumerate() {
        let needed = held(r);
        if !(low..=high).contains(&needed) {
            return Err(Error::setting(format!(
                "expected a reference that commands from {low:.4} to {high:.4} can hold, got {r} at sample {k}, which needs \
                 {needed:.4}; ask for less, or leave less room"
            )));
        }
    }
    let mut now = reference[0];
    let mut followed = Vec::with_capacity(reference.len());
    for &wanted in reference {
        let bounds = [low, high].map(|u| (u - held(now)) / moving);
        let (down, up) = (bounds[0].min(bounds[1]), bounds[0].max(bounds[1]));
        now += (wanted - now).clamp(down.min(0.0), up.max(0.0));
        followed.push(now);
    }
    Ok(smoothed(&followed, smooth))
}

/// The mean of `2 half + 1` samples about each, the ends continued; `half` is half of `samples`.
fn smoothed(x: &[f64], samples: usize) -> Vec<f64> {
    let (half, last) = (samples / 2, x.len() - 1);
    let at = |k: usize| x[k.saturating_sub(half).min(last)];
    let whole = 2 * half + 1;
    // each mean from its own samples: a running sum would leave a rest of rounding where a reference stands
    (0..x.len())
        .map(|k| {
            let sum: f64 = (0..whole).map(|j| at(k + j)).sum();
            let stands = at(k) == at(k + whole - 1) && x[k] == at(k);
            if stands { x[k] } else { sum / whole as f64 }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sewfast_control::Level;

    fn drive() -> Feedforward<f64> {
        let levels = [-3000.0, 3000.0].map(|y| Level { y, u: y / 500.0 });
        Feedforward::new(8, 0.5, &levels, &[0.1, 0.3, 0.1]).unwrap()
    }

    #[test]
    fn a_step_becomes_the_ramp_that_the_command_allows() {
        let mut r = vec![0.0; 50];
        r.resize(1500, 2000.0);
        let made = planned(&r, &drive(), (-18.0, 18.0), 0).unwrap();
        // 18 V: 36 RPM in the first sample, then less the faster it turns; 2,000 RPM are held by 4 V
        assert!((made[50] - 36.0).abs() < 1e-9);
        let reached = made.iter().position(|v| *v == 2000.0).unwrap();
        assert!((105..120).contains(&reached), "{reached}");
        assert!(made.windows(2).all(|pair| pair[1] >= pair[0]));
    }

    #[test]
    fn what_can_be_followed_stays_but_for_its_corners() {
        let r: Vec<f64> = (0..900)
            .map(|k| f64::from(k.clamp(100, 300) - 100) * 5.0)
            .collect();
        assert_eq!(planned(&r, &drive(), (-18.0, 18.0), 0).unwrap(), r);
        let round = planned(&r, &drive(), (-18.0, 18.0), 20).unwrap();
        let off = r
            .iter()
            .zip(&round)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max);
        assert!(off < 5.0 * 20.0 / 8.0 + 2.0, "{off}");
        assert_eq!((round[0], round[899]), (0.0, 1000.0));
    }

    #[test]
    fn a_level_out_of_reach_is_refused_with_the_command_that_it_needs() {
        let refused = planned(&[0.0, 9500.0], &drive(), (-18.0, 18.0), 0).unwrap_err();
        assert!(refused.message.contains("sample 1") && refused.message.contains("19.0"));
        assert!(planned(&[], &drive(), (-1.0, 1.0), 0).is_err());
        assert!(planned(&[f64::NAN], &drive(), (-1.0, 1.0), 0).is_err());
        let still = Feedforward::new(0, 0.0, drive().levels(), &[]).unwrap();
        assert!(planned(&[0.0], &still, (-1.0, 1.0), 0).is_err());
    }

    proptest! {
        #[test]
        fn it_never_asks_for_more_than_the_limits(
            levels in prop::collection::vec((-2500.0..2500.0_f64, 1..200_usize), 1..8), high in 6.0..20.0_f64,
        ) {
            let r: Vec<f64> = levels.iter().flat_map(|(y, n)| vec![*y; *n]).collect();
            let of = drive();
            let made = planned(&r, &of, (-high, high), 0).unwrap();
            for pair in made.windows(2) {
                let needed = of.held(pair[0]) + 0.5 * (pair[1] - pair[0]);
                prop_assert!(needed.abs() <= high + 1e-9, "{needed}");
            }
        }
    }
}
