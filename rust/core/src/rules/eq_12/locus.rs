//! The loop for given gains, frequency by frequency: stability, `max |S|`, the integrals of Eq. 12.

use std::f64::consts::PI;

use nalgebra::Complex;
use sewfast_control::Standard;

use super::Costs;

/// How often the interval around a lowest node is cut to two thirds: the value is then exact to 1e-9.
const THIRDS: usize = 24;
/// Gauss-Legendre nodes and weights from -1 to 1.
const GAUSS: [(f64, f64); 6] = [
    (-0.932_469_514_203_152, 0.171_324_492_379_170_35),
    (-0.661_209_386_466_264_5, 0.360_761_573_048_138_6),
    (-0.238_619_186_083_196_93, 0.467_913_934_572_691_05),
    (0.238_619_186_083_196_93, 0.467_913_934_572_691_05),
    (0.661_209_386_466_264_5, 0.360_761_573_048_138_6),
    (0.932_469_514_203_152, 0.171_324_492_379_170_35),
];

/// A frequency with the quantities that do not depend on the gains.
pub(super) struct Node {
    pub(super) omega: f64,
    /// Weight of the quadrature, times the frequency.
    weight: f64,
    /// `e^(sL)`, and `P e^(sL)` with its two derivatives.
    turn: Complex<f64>,
    pub(super) p: [Complex<f64>; 3],
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

/// The frequencies of an integral, for one `L`.
pub(super) struct Locus {
    pub(super) l: f64,
    pub(super) nodes: Vec<Node>,
}

impl Locus {
    pub(super) fn up_to(l: f64, top: f64) -> Self {
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
    pub(super) fn disturbance(&self, g: Standard<f64>) -> f64 {
        if self.is_stable(g) {
            self.integral(g)
        } else {
            f64::INFINITY
        }
    }

    /// The same for a loop that is known to be stable.
    pub(super) fn integral(&self, g: Standard<f64>) -> f64 {
        let part = |n: &Node| n.weight * n.error(g)[2].norm_sqr();
        self.nodes.iter().map(part).sum()
    }

    /// By the argument principle: from the integrator's phase `1 + F_1 G` turns by a quarter, and at high frequencies
    /// it circles 1 with radius `Kp Td`.
    pub(super) fn is_stable(&self, g: Standard<f64>) -> bool {
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

    /// `max |S|`; infinite if the loop is unstable.
    pub(super) fn peak(&self, g: Standard<f64>) -> f64 {
        if !self.is_stable(g) {
            return f64::INFINITY;
        }
        let distance = self.lowest(|n| n.return_difference(g).norm_sqr());
        let limit = 1.0 / (1.0 - g.kp * g.td);
        (1.0 / distance.sqrt()).max(limit)
    }

    /// The least value over all frequencies.
    fn lowest(&self, of: impl Fn(&Node) -> f64) -> f64 {
        let values = self.nodes.iter().map(&of).enumerate();
        let (i, _) = values.fold((0, f64::INFINITY), |a, b| if b.1 < a.1 { b } else { a });
        self.lowest_near(i, of)
    }

    /// The least value between the neighbours of a node, or at it.
    pub(super) fn lowest_near(&self, i: usize, of: impl Fn(&Node) -> f64) -> f64 {
        let end = self.nodes.len() - 1;
        let (mut low, mut high) = (
            self.nodes[i.saturating_sub(1)].omega,
            self.nodes[(i + 1).min(end)].omega,
        );
        let at = |omega: f64| of(&Node::at(omega, 0.0, self.l));
        for _ in 0..THIRDS {
            let third = (high - low) / 3.0;
            if at(low + third) < at(high - third) {
                high -= third
            } else {
                low += third
            }
        }
        at(0.5 * (low + high)).min(of(&self.nodes[i]))
    }

    /// Second derivatives of the error after a step of the reference: without alpha and beta, by alpha and by beta.
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

    /// Alpha and beta of least cost after a step of the reference.
    pub(super) fn weights(&self, g: Standard<f64>) -> (f64, f64) {
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

    pub(super) fn costs(&self, wide: &Self, g: Standard<f64>, alpha: f64, beta: f64) -> Costs {
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
