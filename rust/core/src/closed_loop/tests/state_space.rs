//! Everything at once, where nothing limits, against the loop's equations solved as one linear system.

use nalgebra::{DMatrix, DVector};
use proptest::prelude::*;

use super::*;

/// Output, average, lag; position, its estimate, its rate; feedback and reference after the biquad; the three terms; the
/// command.
const NAMES: [&str; 12] = ["y", "m", "l", "p", "x", "v", "f", "g", "P", "I", "D", "u"];
/// Samples that the equations look back.
const DEPTH: usize = 3;

fn index(name: &str) -> usize {
    NAMES.iter().position(|n| *n == name).unwrap()
}

/// `sum over d of M[d] z(k-d) = B w(k)` with `w = [r(k), r(k-1), feedforward(k), disturbance(k-1), disturbance(k-2), r(k-2)]`.
struct Equations {
    m: Vec<DMatrix<f64>>,
    b: DMatrix<f64>,
    row: usize,
}

impl Equations {
    fn new() -> Self {
        let n = NAMES.len();
        Self {
            m: vec![DMatrix::zeros(n, n); DEPTH + 1],
            b: DMatrix::zeros(n, 6),
            row: 0,
        }
    }

    /// `name(k) = sum of coefficient signal(k - delay) + sum of coefficient input`.
    fn add(&mut self, name: &str, terms: &[(f64, &str, usize)], inputs: &[(f64, usize)]) {
        self.m[0][(self.row, index(name))] += 1.0;
        for &(coefficient, signal, delay) in terms {
            self.m[delay][(self.row, index(signal))] -= coefficient;
        }
        for &(coefficient, input) in inputs {
            self.b[(self.row, input)] += coefficient;
        }
        self.row += 1;
    }

    fn solve(&self, w: &[[f64; 6]]) -> Vec<DVector<f64>> {
        let lu = self.m[0].clone().lu();
        let mut past = vec![DVector::zeros(NAMES.len()); DEPTH];
        for w in w {
            let mut right = &self.b * DVector::from_row_slice(w);
            for d in 1..=DEPTH {
                right -= &self.m[d] * &past[past.len() - d];
            }
            past.push(lu.solve(&right).unwrap());
        }
        past.split_off(DEPTH)
    }
}

proptest! {
    #![proptest_config(crate::laws::cases(128))]
    #[test]
    fn the_whole_loop_equals_its_linear_equations(
        kp in 1e-4..2e-3, ti in 0.05..1.0, td in 0.0..0.01, alpha in -0.5..1.0, beta in -0.5..1.0, n in 1.0..20.0,
        filter_time in 0.0..0.005, observer_time in 1e-3..0.01, rate in 1e3..2e4, level in 100.0..2000.0,
        (hertz, depth, width) in (20.0..300.0, 0.0..1.0, 0.1..2.0),
    ) {
        let notch = Biquad::notch(hertz, depth, width, TS).unwrap();
        let (a, b) = ([-1.87, 0.8705], [0.1228, 0.1224]);
        let model = LinearModel::new(a.to_vec(), b.to_vec(), 1, 1, 0.0).unwrap();
        let gains = Standard { kp, ti, td };
        let design = Design {
            filter_samples: 4,
            filter_time,
            observer_time,
            r_rate: rate,
            biquads: Cascade::new(&[notch]).unwrap(),
            ..Design::new(Settings { alpha, beta, n, ..Settings::new(gains, TS) })
        };
        let samples = 200;
        let reference: Vec<f64> = (0..samples).map(|k| if k < 5 { 0.0 } else { level }).collect();
        let added = |scale: f64, period: f64| -> Vec<f64> {
            (0..samples).map(|k| scale * (k as f64 / period).sin()).collect()
        };
        let (feedforward, disturbance) = (added(0.5, 30.0), added(0.3, 17.0));
        let signals = Signals {
            setpoint: None,
            reference: &reference,
            feedforward: Some(&feedforward),
            disturbance: Some(&disturbance),
            noise: None,
        };
        let run = closed_loop_with(
            &mut LaggedPlant::new(&model, TS).unwrap(),
            &mut PidController::new(design).unwrap().into(),
            signals,
            None,
            &Monitor::default(),
        ).unwrap();

        let weight = TS / (TS + filter_time);
        let theta = (-TS / observer_time).exp();
        let (ga, gb) = (1.0 - theta * theta, (1.0 - theta).powi(2) / TS);
        let filter = td / n;
        let (ki, kd) = (kp * TS / ti, kp * td / (filter + TS));
        let mut loop_ = Equations::new();
        let e = &mut loop_;
        e.add("y", &[(-a[0], "y", 1), (-a[1], "y", 2), (b[0], "u", 1), (b[1], "u", 2)], &[(b[0], 3), (b[1], 4)]);
        e.add("m", &[(0.25, "y", 0), (0.25, "y", 1), (0.25, "y", 2), (0.25, "y", 3)], &[]);
        e.add("l", &[(weight, "m", 0), (1.0 - weight, "l", 1)], &[]);
        e.add("p", &[(1.0, "p", 1), (TS, "l", 0)], &[]);
        e.add("x", &[(1.0 - ga, "x", 1), (TS * (1.0 - ga), "v", 1), (ga, "p", 0)], &[]);
        e.add("v", &[(1.0 - gb * TS, "v", 1), (gb, "p", 0), (-gb, "x", 1)], &[]);
        let Biquad { c0, c1, a1, a2 } = notch;
        let [b0, b1, b2] = [1.0 + c0, a1 + c1 - c0, a2 - c1];
        e.add("f", &[(b0, "v", 0), (b1, "v", 1), (b2, "v", 2), (-a1, "f", 1), (-a2, "f", 2)], &[]);
        e.add("g", &[(-a1, "g", 1), (-a2, "g", 2)], &[(b0, 0), (b1, 1), (b2, 5)]);
        e.add("P", &[(-kp, "f", 0), (kp * (1.0 - alpha), "g", 0)], &[]);
        e.add("I", &[(1.0, "I", 1), (-ki, "f", 0), (ki, "g", 0)], &[]);
        let weighted = kd * (1.0 - beta);
        e.add("D", &[(filter / (filter + TS), "D", 1), (-kd, "f", 0), (kd, "f", 1), (weighted, "g", 0), (-weighted, "g", 1)], &[]);
        e.add("u", &[(1.0, "P", 0), (1.0, "I", 0), (1.0, "D", 0)], &[(1.0, 2)]);

        // a ramp towards the level, written out
        let ramped: Vec<f64> = (0..samples).map(|k| (rate * TS * (k as f64 - 4.0).max(0.0)).min(level)).collect();
        let before = |signal: &[f64], k: usize, d: usize| k.checked_sub(d).map_or(0.0, |k| signal[k]);
        let w: Vec<[f64; 6]> = (0..samples)
            .map(|k| [ramped[k], before(&ramped, k, 1), feedforward[k], before(&disturbance, k, 1), before(&disturbance, k, 2), before(&ramped, k, 2)])
            .collect();
        let largest = run.y.iter().fold(1.0, |most: f64, y| most.max(y.abs()));
        for (k, z) in loop_.solve(&w).iter().enumerate() {
            prop_assert!((run.y[k] - z[index("y")]).abs() < 1e-8 * largest, "y {k}: {} {}", run.y[k], z[index("y")]);
            prop_assert!((run.feedback[k] - z[index("f")]).abs() < 1e-8 * largest);
            prop_assert!((run.u[k] - z[index("u")]).abs() < 1e-8 * largest);
        }
    }
}
