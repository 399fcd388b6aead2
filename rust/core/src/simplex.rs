//! The simplex search of Nelder and Mead, for few variables and a cheap cost.
//!
//! (J. A. Nelder, R. Mead, *Computer Journal* 7, 1965.)

/// A corner of the simplex: its cost and its point.
pub(crate) type Corner = (f64, Vec<f64>);

/// The best corner after at most `steps`, from a simplex at `start` with edges of `edge`. It ends earlier if the
/// corners, sorted by cost, are `close`. A cost may be infinite.
pub(crate) fn descended(
    start: &[f64],
    edge: f64,
    steps: usize,
    close: impl Fn(&[Corner]) -> bool,
    cost: &impl Fn(&[f64]) -> f64,
) -> Corner {
    let corner = |x: Vec<f64>| (cost(&x), x);
    let mut corners: Vec<Corner> = (0..=start.len())
        .map(|i| {
            let mut x = start.to_vec();
            if i > 0 {
                x[i - 1] += edge;
            }
            corner(x)
        })
        .collect();
    let by_cost = |a: &Corner, b: &Corner| a.0.total_cmp(&b.0);
    for _ in 0..steps {
        corners.sort_by(by_cost);
        if close(&corners) {
            break;
        }
        replace_worst(&mut corners, &corner);
    }
    corners.sort_by(by_cost);
    corners.swap_remove(0)
}

fn replace_worst(corners: &mut [Corner], corner: &impl Fn(Vec<f64>) -> Corner) {
    let n = corners.len() - 1;
    let (best, second, worst) = (corners[0].0, corners[n - 1].0, corners[n].0);
    let centre: Vec<f64> = (0..n)
        .map(|i| corners[..n].iter().map(|c| c.1[i]).sum::<f64>() / n as f64)
        .collect();
    let along = |factor: f64| {
        let beyond = |(c, w): (&f64, &f64)| c + factor * (c - w);
        corner(centre.iter().zip(&corners[n].1).map(beyond).collect())
    };
    let reflected = along(1.0);
    let candidate = if reflected.0 < best {
        let expanded = along(2.0);
        if expanded.0 < reflected.0 {
            expanded
        } else {
            reflected
        }
    } else if reflected.0 < second {
        reflected
    } else {
        let contracted = along(if reflected.0 < worst { 0.5 } else { -0.5 });
        if contracted.0 >= reflected.0.min(worst) {
            let (first, others) = corners.split_at_mut(1);
            for other in others {
                let halfway = other.1.iter().zip(&first[0].1).map(|(x, b)| 0.5 * (x + b));
                *other = corner(halfway.collect());
            }
            return;
        }
        contracted
    };
    corners[n] = candidate;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_bottom_of_a_curved_valley_beside_a_wall() {
        // Rosenbrock's valley, forbidden if x is above 1.5
        let cost = |x: &[f64]| match x[0] > 1.5 {
            true => f64::INFINITY,
            false => 100.0 * (x[1] - x[0] * x[0]).powi(2) + (1.0 - x[0]).powi(2),
        };
        let level = |corners: &[Corner]| corners[2].0 - corners[0].0 < 1e-14;
        let (least, x) = descended(&[-1.2, 1.0], 0.5, 1_000, level, &cost);
        assert!(least < 1e-12 && (x[0] - 1.0).abs() < 1e-5, "{least} {x:?}");
        // if every corner is forbidden, the start is as good as any
        let none = descended(&[2.0, 0.0], 0.1, 50, |_| false, &|_: &[f64]| f64::INFINITY);
        assert!(none.0.is_infinite());
    }
}
