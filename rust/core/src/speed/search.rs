//! Searches along one line.

/// The point of the grid `from, from + step, .. <= to` with the least cost.
pub(super) fn grid(from: f64, to: f64, step: f64, cost: impl Fn(f64) -> f64) -> f64 {
    let count = ((to - from) / step).round() as usize;
    let points = (0..=count).map(|i| from + i as f64 * step);
    let costs = points.map(|x| (x, cost(x)));
    costs
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map_or(from, |best| best.0)
}

/// The least cost between `a` and `b` by golden sections, to `tolerance`.
pub(super) fn golden(mut a: f64, mut b: f64, tolerance: f64, cost: impl Fn(f64) -> f64) -> f64 {
    let golden = 0.5 * (5f64.sqrt() - 1.0);
    let (mut x1, mut x2) = (b - golden * (b - a), a + golden * (b - a));
    let (mut f1, mut f2) = (cost(x1), cost(x2));
    while b - a > tolerance {
        if f1 < f2 {
            (b, x2, f2) = (x2, x1, f1);
            x1 = b - golden * (b - a);
            f1 = cost(x1);
        } else {
            (a, x1, f1) = (x1, x2, f2);
            x2 = a + golden * (b - a);
            f2 = cost(x2);
        }
    }
    0.5 * (a + b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn find_the_lowest_point() {
        let cost = |x: f64| (x - 1.3).powi(2);
        assert_eq!(grid(-4.0, 4.0, 2.0, cost), 2.0);
        assert!((golden(-2.0, 4.0, 1e-3, cost) - 1.3).abs() < 1e-3);
    }
}
