//! The simplex search of Nelder and Mead, for a few parameters and a function that is cheap.

/// Evaluations before the search starts again from its best point, and how often it does.
const EVALUATIONS: usize = 400;
const ROUNDS: usize = 2;
/// A simplex of this extent is a point.
const SMALL: f64 = 1e-6;

/// Where `cost` is least near `start`; the first simplex has edges of `step`.
///
/// (J. A. Nelder, R. Mead, *Computer Journal* 7, 1965.)
pub(super) fn minimised<const N: usize>(
    start: [f64; N],
    step: f64,
    cost: impl Fn(&[f64; N]) -> f64,
) -> [f64; N] {
    let mut best = start;
    for round in 0..ROUNDS {
        best = descended(best, step / if round == 0 { 1.0 } else { 20.0 }, &cost);
    }
    best
}

fn descended<const N: usize>(
    start: [f64; N],
    step: f64,
    cost: &impl Fn(&[f64; N]) -> f64,
) -> [f64; N] {
    let mut corners: Vec<(f64, [f64; N])> = (0..=N)
        .map(|i| {
            let mut x = start;
            if i > 0 {
                x[i - 1] += step;
            }
            (cost(&x), x)
        })
        .collect();
    for _ in 0..EVALUATIONS {
        corners.sort_by(|a, b| a.0.total_cmp(&b.0));
        let extent = |x: &[f64; N]| {
            (0..N)
                .map(|i| (x[i] - corners[0].1[i]).abs())
                .fold(0.0, f64::max)
        };
        if corners.iter().map(|c| extent(&c.1)).fold(0.0, f64::max) < SMALL {
            break;
        }
        replace_worst(&mut corners, cost);
    }
    corners.sort_by(|a, b| a.0.total_cmp(&b.0));
    corners[0].1
}

fn replace_worst<const N: usize>(
    corners: &mut [(f64, [f64; N])],
    cost: &impl Fn(&[f64; N]) -> f64,
) {
    let (best, second, worst) = (corners[0], corners[N - 1], corners[N]);
    let centre: [f64; N] =
        std::array::from_fn(|i| corners[..N].iter().map(|c| c.1[i]).sum::<f64>() / N as f64);
    let along = |factor: f64| {
        let x = std::array::from_fn(|i| centre[i] + factor * (centre[i] - worst.1[i]));
        (cost(&x), x)
    };
    let reflected = along(1.0);
    let candidate = if reflected.0 < best.0 {
        let expanded = along(2.0);
        if expanded.0 < reflected.0 {
            expanded
        } else {
            reflected
        }
    } else if reflected.0 < second.0 {
        reflected
    } else {
        let contracted = along(if reflected.0 < worst.0 { 0.5 } else { -0.5 });
        if contracted.0 < reflected.0.min(worst.0) {
            contracted
        } else {
            for corner in &mut corners[1..] {
                corner.1 = std::array::from_fn(|i| 0.5 * (corner.1[i] + best.1[i]));
                corner.0 = cost(&corner.1);
            }
            return;
        }
    };
    corners[N] = candidate;
}

#[cfg(test)]
mod tests {
    use super::*;

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
