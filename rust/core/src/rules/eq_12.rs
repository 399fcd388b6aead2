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

use nalgebra::Complex;
use std::f64::consts::PI;

use super::Rule;
use super::simplex::minimised;
use crate::error::shown;
use crate::{Error, Result};
use sewfast_control::Standard;

/// The range of `L/T` that the rule is made for.
const RATIOS: (f64, f64) = (0.01, 2.0);
/// Upper limits of the integrals times `L`.
const TOP: (f64, f64) = (100.0, 1000.0);
/// The same while searching: gains change by less than 1e-4.
const SEARCHED: f64 = 25.0;
/// Nodes and weights of Gauss and Legendre from -1 to 1.
const GAUSS: [(f64, f64); 6] = [
    (-0.932_469_514_203_152, 0.171_324_492_379_170_35),
    (-0.661_209_386_466_264_5, 0.360_761_573_048_138_6),
    (-0.238_619_186_083_196_93, 0.467_913_934_572_691_05),
    (0.238_619_186_083_196_93, 0.467_913_934_572_691_05),
    (0.661_209_386_466_264_5, 0.360_761_573_048_138_6),
    (0.932_469_514_203_152, 0.171_324_492_379_170_35),
];

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
    let (locus, searched) = (Locus::up_to(ratio, TOP.0), Locus::up_to(ratio, SEARCHED));
    let mut best = searched.free();
    if searched.peak(best) > ms {
        best = searched.bounded(best, ms)?;
    }
    let reference = Locus::up_to(ratio, TOP.1);
    let (alpha, beta) = reference.weights(best);
    let costs = locus.costs(&reference, best, alpha, beta);
    let gains = Standard {
        kp: best.kp / k,
        ti: best.ti * t,
        td: best.td * t,
    };
    Ok((Rule { gains, alpha, beta }, costs))
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

/// A frequency with what does not depend on the gains.
struct Node {
    omega: f64,
    /// Of the quadrature, times the frequency.
    weight: f64,
    /// `e^(sL)`, and `P e^(sL)` with its two derivatives.
    turn: Complex<f64>,
    p: [Complex<f64>; 3],
}

impl Node {
    fn at(omega: f64, weight: f64, l: f64) -> Self {
        let s = Complex::new(0.0, omega);
        let turn = (s * l).exp();
        let (p, first) = (s + s * s, s * 2.0 + 1.0);
        let p = [
            p,
            first + p * l,
            Complex::new(2.0, 0.0) + first * (2.0 * l) + p * (l * l),
        ]
        .map(|x| x * turn);
        Self {
            omega,
            weight: weight * omega,
            turn,
            p,
        }
    }

    /// `Q` and its two derivatives.
    fn q(&self, g: Standard<f64>) -> [Complex<f64>; 3] {
        let (s, kp) = (Complex::new(0.0, self.omega), g.kp);
        let terms = [
            s + s * s * g.td + 1.0 / g.ti,
            s * (2.0 * g.td) + 1.0,
            Complex::new(2.0 * g.td, 0.0),
        ];
        std::array::from_fn(|i| self.p[i] + terms[i] * kp)
    }

    /// `E_d` and its two derivatives.
    fn error(&self, g: Standard<f64>) -> [Complex<f64>; 3] {
        let [q, first, second] = self.q(g);
        let e = q.inv();
        let e2 = e * e;
        [e, -first * e2, first * first * e2 * e * 2.0 - second * e2]
    }

    /// `1 + F_1 G`, the inverse of `S`.
    fn return_difference(&self, g: Standard<f64>) -> Complex<f64> {
        self.q(g)[0] / self.p[0]
    }
}

struct Locus {
    l: f64,
    nodes: Vec<Node>,
}

impl Locus {
    fn up_to(l: f64, top: f64) -> Self {
        let mut edges = vec![0.0];
        let (low, high): (f64, f64) = (1e-3, 1.0 / l);
        edges.extend((0..=40).map(|i| low * (high / low).powf(f64::from(i) / 40.0)));
        let steps = (2.0 * (top - 1.0)) as usize;
        edges.extend((1..=steps).map(|i| (1.0 + 0.5 * i as f64) / l));
        let mut nodes = Vec::with_capacity(6 * edges.len());
        for pair in edges.windows(2) {
            let (middle, half) = (0.5 * (pair[0] + pair[1]), 0.5 * (pair[1] - pair[0]));
            nodes.extend(
                GAUSS
                    .iter()
                    .map(|(x, w)| Node::at(middle + half * x, half * w, l)),
            );
        }
        Self { l, nodes }
    }

    /// Eq. 12 after a step of the disturbance.
    fn disturbance(&self, g: Standard<f64>) -> f64 {
        if !self.is_stable(g) {
            return f64::INFINITY;
        }
        self.nodes
            .iter()
            .map(|n| n.weight * n.error(g)[2].norm_sqr())
            .sum()
    }

    /// By the argument principle: `1 + F_1 G` turns by a quarter from the integrator's phase, and at high frequencies
    /// circles 1 with radius `Kp Td`.
    fn is_stable(&self, g: Standard<f64>) -> bool {
        if g.kp * g.td >= 1.0 {
            return false;
        }
        let mut last = self.nodes[0].return_difference(g);
        let mut turned = 0.0;
        for node in &self.nodes[1..] {
            let next = node.return_difference(g);
            turned += (next * last.conj()).arg();
            last = next;
        }
        turned > 0.0 && turned < PI
    }

    /// `max |S|`; infinite where the loop is unstable.
    fn peak(&self, g: Standard<f64>) -> f64 {
        if !self.is_stable(g) {
            return f64::INFINITY;
        }
        let distance = |n: &Node| n.return_difference(g).norm_sqr();
        let nearest = self.nodes.iter().enumerate().map(|(i, n)| (i, distance(n)));
        let (i, _) = nearest.fold((0, f64::INFINITY), |a, b| if b.1 < a.1 { b } else { a });
        let end = self.nodes.len() - 1;
        let (mut low, mut high) = (
            self.nodes[i.saturating_sub(1)].omega,
            self.nodes[(i + 1).min(end)].omega,
        );
        let at = |omega: f64| distance(&Node::at(omega, 0.0, self.l));
        for _ in 0..40 {
            let third = (high - low) / 3.0;
            if at(low + third) < at(high - third) {
                high -= third
            } else {
                low += third
            }
        }
        let limit = 1.0 / (1.0 - g.kp * g.td);
        (1.0 / at(0.5 * (low + high)).sqrt()).max(limit)
    }

    /// The gains of the least cost.
    fn free(&self) -> Standard<f64> {
        let l = self.l;
        let start = [
            1.22 / l,
            2.6 * l / (1.0 + 0.92 * l),
            0.41 * l / (1.0 + 0.15 * l),
        ]
        .map(f64::ln);
        let gains = |x: &[f64; 3]| Standard {
            kp: x[0].exp(),
            ti: x[1].exp(),
            td: x[2].exp(),
        };
        gains(&minimised(start, 0.1, |x| self.disturbance(gains(x)).ln()))
    }

    /// The gains of the least cost on the boundary `max |S| = ms`, from gains beyond it.
    fn bounded(&self, from: Standard<f64>, ms: f64) -> Result<Standard<f64>> {
        let gains = |x: &[f64; 2]| {
            let times = Standard {
                kp: 0.0,
                ti: x[0].exp(),
                td: x[1].exp(),
            };
            self.largest(times, ms)
        };
        let start = [from.ti.ln(), (0.8 * from.td).ln()];
        let best = minimised(start, 0.2, |x| {
            gains(x).map_or(f64::INFINITY, |g| self.disturbance(g).ln())
        });
        gains(&best).ok_or_else(|| {
            Error::fit(format!(
                "expected gains with Ms of at most {ms}, found none; allow a larger Ms"
            ))
        })
    }

    /// The largest `Kp` up to which `max |S|` keeps below `ms`; none where only nothing does.
    fn largest(&self, times: Standard<f64>, ms: f64) -> Option<Standard<f64>> {
        let with = |kp: f64| Standard { kp, ..times };
        let allowed = |kp: f64| self.peak(with(kp)) <= ms;
        let (mut low, mut high) = (0.0, 0.99 / times.td.max(0.4 * self.l));
        for _ in 0..20 {
            let middle = 0.5 * (low + high);
            if allowed(middle) {
                low = middle
            } else {
                high = middle
            }
        }
        (low > 0.0).then(|| with(low))
    }

    /// Second derivatives of the error after a step of the reference: without weights, by alpha and by beta.
    fn by_weights(&self, n: &Node, g: Standard<f64>) -> [Complex<f64>; 3] {
        let (s, l) = (Complex::new(0.0, n.omega), self.l);
        let [e, first, second] = n.error(g);
        let a = s + 1.0;
        let a = [a, a * l + 1.0, a * (l * l) + 2.0 * l].map(|x| x * n.turn);
        let plain = a[2] * e + a[1] * first * 2.0 + a[0] * second;
        [
            plain,
            second * g.kp,
            (first * 2.0 + s * second) * (g.kp * g.td),
        ]
    }

    /// Alpha and beta of the least cost after a step of the reference.
    fn weights(&self, g: Standard<f64>) -> (f64, f64) {
        let mut m = [0.0; 5];
        for n in &self.nodes {
            let [plain, a, b] = self.by_weights(n, g);
            let dot = |x: Complex<f64>, y: Complex<f64>| n.weight * (x.conj() * y).re;
            for (sum, more) in m.iter_mut().zip([
                dot(a, a),
                dot(a, b),
                dot(b, b),
                dot(a, plain),
                dot(b, plain),
            ]) {
                *sum += more;
            }
        }
        let [aa, ab, bb, ap, bp] = m;
        let determinant = aa * bb - ab * ab;
        if g.td == 0.0 || determinant == 0.0 {
            return (-ap / aa, 0.0);
        }
        (
            (ab * bp - bb * ap) / determinant,
            (ab * ap - aa * bp) / determinant,
        )
    }

    fn reference(&self, g: Standard<f64>, alpha: f64, beta: f64) -> f64 {
        let cost = |n: &Node| {
            let [plain, a, b] = self.by_weights(n, g);
            n.weight * (plain + a * alpha + b * beta).norm_sqr()
        };
        self.nodes.iter().map(cost).sum()
    }

    fn costs(&self, wide: &Self, g: Standard<f64>, alpha: f64, beta: f64) -> Costs {
        let disturbance = self.disturbance(g);
        let reference = if disturbance.is_finite() {
            wide.reference(g, alpha, beta)
        } else {
            f64::INFINITY
        };
        Costs {
            disturbance,
            reference,
            ms: self.peak(g),
        }
    }
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
