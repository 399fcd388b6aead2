//! Two parts of the rows, as products of their columns about their means, and fits with a gain between them.

use nalgebra::{DMatrix, DVector};

use crate::gram::Gram;

/// Share of a column's mean square that is added to it: what a part does not show is 0.
const RIDGE: f64 = 1e-4;
/// Octaves of the gains that are tried, with two gains each, and gains around the best one.
const OCTAVES: i32 = 7;
const FINE: usize = 41;

/// Products of one part.
#[derive(Clone)]
struct Part {
    gram: DMatrix<f64>,
    right: DVector<f64>,
    of_y: f64,
    mean: DVector<f64>,
    level: f64,
}

pub(super) struct Pair {
    parts: [Part; 2],
    ridge: f64,
}

impl Pair {
    /// From rows of `width` columns, the output, and which rows belong to each part.
    pub fn new(x: &[f64], width: usize, y: &[f64], before: &[bool], after: &[bool]) -> Self {
        let rows = before.iter().chain(after).filter(|r| **r).count();
        Self {
            parts: [before, after].map(|rows| Part::new(x, width, y, rows)),
            ridge: RIDGE * rows as f64,
        }
    }

    pub fn swapped(&self) -> Self {
        let [first, second] = self.parts.clone();
        Self {
            parts: [second, first],
            ridge: self.ridge,
        }
    }

    /// Power of the output about its means.
    pub fn power(&self) -> f64 {
        self.parts[0].of_y + self.parts[1].of_y
    }

    /// Sum of squares if the second part has another gain, and the coefficients.
    fn fitted(&self, gain: f64) -> (f64, DVector<f64>) {
        let [first, second] = &self.parts;
        let mut gram = &first.gram + &second.gram * (gain * gain);
        for i in 0..gram.nrows() {
            gram[(i, i)] += self.ridge;
        }
        let right = &first.right + &second.right * gain;
        match gram.cholesky() {
            Some(factor) => {
                let theta = factor.solve(&right);
                ((self.power() - right.dot(&theta)).max(0.0), theta)
            }
            None => (f64::INFINITY, right),
        }
    }

    /// What one fit leaves of both parts.
    pub fn one(&self) -> f64 {
        self.fitted(1.0).0
    }

    /// What is left of the first part.
    pub fn alone(&self) -> f64 {
        (self.fitted(0.0).0 - self.parts[1].of_y).max(0.0)
    }

    /// The fit to the first part, at all rows.
    pub fn fit(&self, x: &[f64]) -> Vec<f64> {
        self.parts[0].answer(x, &self.fitted(0.0).1, 1.0)
    }

    /// The gain of the second part that explains most, what it leaves, and both fits.
    pub fn scaled(&self, x: &[f64]) -> (f64, f64, [Vec<f64>; 2]) {
        let sizes = (-2 * OCTAVES..=2 * OCTAVES).map(|k| 2.0_f64.powf(0.5 * f64::from(k)));
        let both = [-1.0, 1.0].map(|sign| sizes.clone().map(move |size| sign * size));
        let coarse = std::iter::once(0.0).chain(both.into_iter().flatten());
        let (rough, _, _) = self.best(coarse);
        let step = |i: usize| 2.0_f64.powf(i as f64 / (FINE - 1) as f64 - 0.5);
        let (gain, error, theta) = self.best((0..FINE).map(|i| rough * step(i)));
        let [first, second] = &self.parts;
        let fits = [first.answer(x, &theta, 1.0), second.answer(x, &theta, gain)];
        (gain, error, fits)
    }

    fn best(&self, gains: impl Iterator<Item = f64>) -> (f64, f64, DVector<f64>) {
        gains
            .map(|gain| {
                let (error, theta) = self.fitted(gain);
                (gain, error, theta)
            })
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .expect("there are gains")
    }
}

impl Part {
    fn new(x: &[f64], width: usize, y: &[f64], rows: &[bool]) -> Self {
        let mut gram = Gram::new(width + 2, 0);
        for (k, _) in rows.iter().enumerate().filter(|(_, is_own)| **is_own) {
            gram.add(|row| {
                row[..width].copy_from_slice(&x[k * width..][..width]);
                row[width] = 1.0;
                row[width + 1] = y[k];
            });
        }
        let sums = gram.matrix();
        let n = sums[(width, width)].max(1.0);
        let mean = |i: usize| sums[(i, width)] / n;
        let about = |i: usize, j: usize| sums[(i, j)] - sums[(i, width)] * mean(j);
        Self {
            gram: DMatrix::from_fn(width, width, about),
            right: DVector::from_fn(width, |i, _| about(i, width + 1)),
            of_y: about(width + 1, width + 1),
            mean: DVector::from_fn(width, |i, _| mean(i)),
            level: mean(width + 1),
        }
    }

    /// `gain (x - mean) theta + level` at all rows.
    fn answer(&self, x: &[f64], theta: &DVector<f64>, gain: f64) -> Vec<f64> {
        let at_mean = self.mean.dot(theta);
        let row = |row: &[f64]| {
            let product: f64 = row.iter().zip(theta.iter()).map(|(x, t)| x * t).sum();
            gain * (product - at_mean) + self.level
        };
        x.chunks_exact(self.mean.len()).map(row).collect()
    }
}
