//! Functions with known minima and fronts, on the unit box.

use std::f64::consts::PI;

use super::nsga2::{Objectives, Values};
use super::{Candidate, Judgement, Problem};
use crate::Monitor;

/// A function of `n` variables between `low` and `high`.
pub(super) struct Function {
    pub(super) n: usize,
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) value: fn(&[f64]) -> f64,
    /// Sum of violations.
    pub(super) violation: fn(&[f64]) -> f64,
}

impl Function {
    pub(super) fn new(n: usize, (low, high): (f64, f64), value: fn(&[f64]) -> f64) -> Self {
        Self {
            n,
            low,
            high,
            value,
            violation: |_| 0.0,
        }
    }

    pub(super) fn at(&self, point: &[f64]) -> Vec<f64> {
        let value = |x: &f64| self.low + x * (self.high - self.low);
        point.iter().map(value).collect()
    }
}

impl Problem for Function {
    type Memory = ();

    fn dimensions(&self) -> usize {
        self.n
    }

    fn memory(&self) {}

    fn judge(&self, (): &mut (), candidates: &[Candidate], _: &Monitor) -> Vec<Judgement> {
        candidates
            .iter()
            .map(|c| self.judge_one(&c.point))
            .collect()
    }
}

impl Function {
    fn judge_one(&self, point: &[f64]) -> Judgement {
        assert!(point.iter().all(|x| (0.0..=1.0).contains(x)), "{point:?}");
        let x = self.at(point);
        Judgement {
            violation: (self.violation)(&x),
            cost: (self.value)(&x),
        }
    }
}

pub(super) fn sphere(x: &[f64]) -> f64 {
    x.iter().map(|x| (x - 1.0).powi(2)).sum()
}

pub(super) fn rosenbrock(x: &[f64]) -> f64 {
    x.windows(2)
        .map(|p| 100.0 * (p[1] - p[0] * p[0]).powi(2) + (1.0 - p[0]).powi(2))
        .sum()
}

pub(super) fn rastrigin(x: &[f64]) -> f64 {
    x.iter()
        .map(|x| x * x - 10.0 * (2.0 * PI * x).cos() + 10.0)
        .sum()
}

/// The problems of Zitzler, Deb and Thiele (2000), with 30 variables (ZDT6: 10).
#[derive(Clone, Copy, Debug)]
pub(super) enum Zdt {
    One,
    Two,
    Three,
    Six,
}

impl Zdt {
    /// Area between the true front and the point (1.1, 1.1), by integration.
    pub(super) fn best_volume(self) -> f64 {
        match self {
            Self::One => 1.1 * 1.1 - 1.0 / 3.0,
            Self::Two => 1.1 * 1.1 - 2.0 / 3.0,
            // Points of the front by a fine grid: dominated ones drop out in the volume.
            Self::Three | Self::Six => {
                let points: Vec<[f64; 2]> = (0..=200_000)
                    .map(|k| self.on_front(f64::from(k) / 200_000.0))
                    .collect();
                volume(points)
            }
        }
    }

    fn on_front(self, x: f64) -> [f64; 2] {
        match self {
            Self::One => [x, 1.0 - x.sqrt()],
            Self::Two => [x, 1.0 - x * x],
            Self::Three => [x, 1.0 - x.sqrt() - x * (10.0 * PI * x).sin()],
            Self::Six => {
                let f = 1.0 - (-4.0 * x).exp() * (6.0 * PI * x).sin().powi(6);
                [f, 1.0 - f * f]
            }
        }
    }
}

impl Objectives for Zdt {
    type Memory = ();

    fn dimensions(&self) -> usize {
        if matches!(self, Self::Six) { 10 } else { 30 }
    }

    fn memory(&self) {}

    fn judge(&self, (): &mut (), points: &[Vec<f64>], _: &Monitor) -> Vec<Values> {
        points.iter().map(|x| self.values(x)).collect()
    }
}

impl Zdt {
    fn values(self, x: &[f64]) -> Values {
        assert!(x.iter().all(|x| (0.0..=1.0).contains(x)), "{x:?}");
        let rest = x[1..].iter().sum::<f64>() / (x.len() - 1) as f64;
        let g = match self {
            Self::Six => 1.0 + 9.0 * rest.powf(0.25),
            _ => 1.0 + 9.0 * rest,
        };
        let f = self.on_front(x[0])[0];
        let share = f / g;
        let h = match self {
            Self::One => 1.0 - share.sqrt(),
            Self::Two | Self::Six => 1.0 - share * share,
            Self::Three => 1.0 - share.sqrt() - share * (10.0 * PI * f).sin(),
        };
        Values {
            violation: 0.0,
            objectives: vec![f, g * h],
        }
    }
}

/// Area that points dominate below (1.1, 1.1).
pub(super) fn volume(mut points: Vec<[f64; 2]>) -> f64 {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let (mut area, mut lowest) = (0.0, 1.1);
    for [x, y] in points {
        if x < 1.1 && y < lowest {
            area += (1.1 - x) * (lowest - y);
            lowest = y;
        }
    }
    area
}
