//! The gains of the least cost: without a limit of `max |S|`, and on its boundary.

use nalgebra::Complex;
use sewfast_control::Standard;

use super::super::simplex::minimised;
use super::locus::{Locus, Node};

impl Locus {
    /// `ln` of `Kp`, `Ti` and `Td` near the least cost, from which it is searched.
    fn start(&self) -> [f64; 3] {
        let l = self.l;
        [
            1.22 / l,
            2.6 * l / (1.0 + 0.92 * l),
            0.41 * l / (1.0 + 0.15 * l),
        ]
        .map(f64::ln)
    }

    /// The gains of the least cost.
    pub(super) fn free(&self) -> Standard<f64> {
        let gains = |x: &[f64; 3]| Standard {
            kp: x[0].exp(),
            ti: x[1].exp(),
            td: x[2].exp(),
        };
        let best = minimised(self.start(), 0.1, |x| self.disturbance(gains(x)).ln());
        gains(&best)
    }

    /// The gains of the least cost on the boundary `max |S| = ms`.
    pub(super) fn bounded(&self, ms: f64) -> Option<Standard<f64>> {
        let gains = |x: &[f64; 2]| self.largest(x[0].exp(), x[1].exp(), ms);
        let [_, ti, td] = self.start();
        let cost = |x: &[f64; 2]| gains(x).map_or(f64::INFINITY, |g| self.integral(g).ln());
        gains(&minimised([ti, td + 0.8_f64.ln()], 0.2, cost))
    }

    /// The largest `Kp` with these times of a stable loop with `max |S|` of `ms`; none where only `Kp = 0` has it.
    ///
    /// With `L = Kp x` a frequency forbids what lies between the roots of `1 + 2 Kp Re x + Kp^2 |x|^2 = 1/ms^2`, neighbours
    /// together forbid one range, and high frequencies all above `Kp Td = 1 - 1/ms`. Between the ranges nothing meets -1, so that
    /// all gains there are stable or none is.
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

    /// What runs of neighbouring frequencies forbid together.
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

/// Gains that some frequencies forbid.
struct Range {
    low: f64,
    high: f64,
    /// The node that forbids the lowest of them; none where it is the limit of high frequencies.
    lowest: Option<usize>,
}

impl Node {
    /// `F_1 G` with `Kp = 1`.
    fn unit_loop(&self, ti: f64, td: f64) -> Complex<f64> {
        let s = Complex::new(0.0, self.omega);
        (s + s * s * td + 1.0 / ti) / self.p[0]
    }

    /// Between which gains this frequency's `|S|` is too large.
    fn forbids(&self, ti: f64, td: f64, beyond: f64) -> Option<(f64, f64)> {
        let x = self.unit_loop(ti, td);
        let discriminant = x.re * x.re - x.norm_sqr() * beyond;
        (x.re < 0.0 && discriminant >= 0.0).then(|| {
            let root = discriminant.sqrt();
            (beyond / (root - x.re), (root - x.re) / x.norm_sqr())
        })
    }
}
