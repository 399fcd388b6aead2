//! A column of numbers: its mean, median, range and grid; runs of samples; and the stretches of a record in which every column is known.

use std::cmp::Reverse;

use nalgebra::DVectorView;

use crate::Record;

/// Magnitude and range between which sums of products neither overflow nor underflow.
pub(crate) const LARGEST: f64 = 1e60;
pub(crate) const SMALLEST: f64 = 1e-60;
/// The largest magnitude of a measured quantity.
pub(crate) const MEASURED: f64 = 1e150;
/// Standard deviation of a normal distribution over its median absolute deviation.
pub(crate) const MAD: f64 = 1.4826;
/// Part of a step by which a value may be beside a grid, and part of the range that is rounding.
const GRID: f64 = 1e-3;
const SAME: f64 = 1e-9;

/// Mean and standard deviation; 0 of nothing.
pub(crate) fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let mean = |of: &mut dyn Iterator<Item = f64>| {
        let (sum, n) = of.fold((0.0, 0.0), |(sum, n), v| (sum + v, n + 1.0));
        sum / f64::max(n, 1.0)
    };
    let middle = mean(&mut values.clone());
    let variance = mean(&mut values.map(|v| (v - middle).powi(2)));
    (middle, variance.sqrt())
}

/// Smallest and largest value; of nothing, infinity and minus infinity.
pub(crate) fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    })
}

/// The value below which a share of the values lies, linear between neighbours; NaN of nothing.
pub(crate) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    let Some(last) = values.len().checked_sub(1) else {
        return f64::NAN;
    };
    let place = share * last as f64;
    let (low, part) = (place.floor() as usize, place.fract());
    let (_, at, above) = values.select_nth_unstable_by(low, f64::total_cmp);
    let next = above.iter().copied().fold(f64::INFINITY, f64::min);
    if part == 0.0 {
        *at
    } else {
        *at + part * (next - *at)
    }
}

/// The median; NaN of nothing.
pub(crate) fn median(values: Vec<f64>) -> f64 {
    quantile(values, 0.5)
}

/// Sum of products, in eight sums side by side.
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().min(b.len());
    let [a, b] = [a, b].map(|v| DVectorView::from_slice(&v[..n], n));
    a.dot(&b)
}

/// The different values, in ascending order.
pub(crate) fn distinct(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values.dedup();
    values
}

/// The step of a grid on which all values that are finite lie; none if there is no such grid.
///
/// It requires at least three values that occur twice or more on average: a few values always lie on some grid.
pub fn quantum(column: &[f64]) -> Option<f64> {
    let known: Vec<f64> = column.iter().copied().filter(|v| v.is_finite()).collect();
    let n = known.len();
    let values = distinct(known);
    if values.len() < 3 || 2 * values.len() > n {
        return None;
    }
    let (first, last) = (values[0], values[values.len() - 1]);
    let rounding = SAME * (last - first);
    let steps = values.windows(2).map(|pair| pair[1] - pair[0]);
    let rough = steps
        .filter(|s| *s > rounding)
        .fold(f64::INFINITY, f64::min);
    if !rough.is_finite() {
        return None;
    }
    let places = (last - first) / rough;
    let step = rough * (places / places.round_ties_even());
    let off = |v: &f64| {
        let place = (v - first) / step;
        (place - place.round_ties_even()).abs()
    };
    let farthest = values.iter().map(off).fold(0.0, f64::max);
    (farthest < GRID.max(SAME * (last - first) / step)).then_some(step)
}

/// First index and length of each run of true.
pub(crate) fn runs(mask: impl IntoIterator<Item = bool>) -> Vec<(usize, usize)> {
    let mut found: Vec<(usize, usize)> = Vec::new();
    for (k, is_in) in mask.into_iter().enumerate() {
        match found.last_mut() {
            Some((first, count)) if is_in && *first + *count == k => *count += 1,
            _ if is_in => found.push((k, 1)),
            _ => {}
        }
    }
    found
}

/// Inputs and output of one experiment, row by row; NaN where a value is not known, or no measured quantity is as large.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    values: Vec<f64>,
    width: usize,
}

impl Rows {
    pub fn of(record: &Record, largest: f64) -> Self {
        let (m, sound) = (record.channels, |v: &f64| v.abs() < largest);
        let row = |k: usize| record.u[k * m..][..m].iter().chain([&record.y[k]]);
        let values = (0..record.len()).flat_map(row);
        Self {
            values: values
                .map(|v| if sound(v) { *v } else { f64::NAN })
                .collect(),
            width: m + 1,
        }
    }

    pub fn len(&self) -> usize {
        self.values.len() / self.width
    }

    pub fn width(&self) -> usize {
        self.width
    }

    pub fn column(&self, j: usize) -> impl Iterator<Item = f64> + Clone {
        self.values.iter().skip(j).step_by(self.width).copied()
    }

    pub fn at(&self, k: usize, j: usize) -> f64 {
        self.values[k * self.width + j]
    }

    /// Samples at which every column is known.
    pub fn known(&self) -> impl Iterator<Item = bool> {
        let rows = self.values.chunks_exact(self.width);
        rows.map(|row| row.iter().all(|v| v.is_finite()))
    }

    pub fn part(&self, first: usize, count: usize) -> Self {
        Self {
            values: self.values[first * self.width..][..count * self.width].to_vec(),
            width: self.width,
        }
    }

    /// Means of so many samples each; not known where fewer than half are.
    pub fn means(&self, size: usize) -> Self {
        let mean = |block: &[f64], j: usize| {
            let known = block.iter().skip(j).step_by(self.width);
            let known = known.filter(|v| v.is_finite());
            let (sum, n) = known.fold((0.0, 0), |(sum, n), v| (sum + v, n + 1));
            if 2 * n >= size {
                sum / f64::from(n.max(1) as u32)
            } else {
                f64::NAN
            }
        };
        let blocks = self.values.chunks_exact(size * self.width);
        Self {
            values: blocks
                .flat_map(|b| (0..self.width).map(move |j| mean(b, j)))
                .collect(),
            width: self.width,
        }
    }

    /// Some of the columns.
    pub fn some(&self, columns: &[usize]) -> Self {
        let rows = self.values.chunks_exact(self.width);
        Self {
            values: rows
                .flat_map(|row| columns.iter().map(|j| row[*j]))
                .collect(),
            width: columns.len(),
        }
    }

    /// Every `step`-th sample.
    pub fn thinned(&self, first: usize, step: usize) -> Self {
        let rows = self.values.chunks_exact(self.width);
        Self {
            values: rows.skip(first).step_by(step).flatten().copied().collect(),
            width: self.width,
        }
    }

    /// Values that are as large count as not known.
    pub fn forget_above(&mut self, largest: f64) {
        let large = |v: &&mut f64| v.abs() >= largest;
        self.values
            .iter_mut()
            .filter(large)
            .for_each(|v| *v = f64::NAN);
    }

    /// Every column as `(v - middle) / spread`.
    pub fn scale(&mut self, scale: &[(f64, f64)]) {
        for row in self.values.chunks_exact_mut(self.width) {
            for (v, (middle, spread)) in row.iter_mut().zip(scale) {
                *v = (*v - middle) / spread;
            }
        }
    }
}

/// Stretches in which every column is known, of the longest experiment first.
pub(crate) fn stretches(records: &[Record], largest: f64) -> Vec<Rows> {
    let mut experiments: Vec<&Record> = records.iter().collect();
    experiments.sort_by_key(|e| Reverse(e.len()));
    let of = |e: &Record| {
        let rows = Rows::of(e, largest);
        let parts: Vec<_> = runs(rows.known())
            .into_iter()
            .map(|(a, n)| rows.part(a, n))
            .collect();
        parts
    };
    experiments.into_iter().flat_map(of).collect()
}

/// Mean and deviation of each column over all parts; none if there is no part, or a column does not move.
pub(crate) fn scale_of(parts: &[Rows]) -> Option<Vec<(f64, f64)>> {
    let width = parts.first()?.width;
    let one = |j: usize| {
        let column = || parts.iter().flat_map(move |p| p.column(j));
        let (low, high) = range(column());
        (high - low >= SMALLEST).then(|| moments(column()))
    };
    (0..width).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grids_are_found_and_noise_has_none() {
        let noisy = |k: usize| (k as f64 * 12.9898).sin() * 43758.5453;
        let steps: Vec<f64> = (0..200).map(|k| 0.25 * (noisy(k) / 9e3).round()).collect();
        assert!((quantum(&steps).unwrap() - 0.25).abs() < 1e-12);
        assert_eq!(quantum(&(0..200).map(noisy).collect::<Vec<_>>()), None);
        assert_eq!(quantum(&[1.0, 2.0, 1.0, 2.0, f64::NAN]), None);
        assert_eq!(quantum(&[]), None);
    }

    #[test]
    fn medians_quantiles_and_runs() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(quantile(vec![0.0, 10.0, 20.0], 0.25), 5.0);
        assert!(median(Vec::new()).is_nan());
        let mask = [true, true, false, true, false];
        assert_eq!(runs(mask), [(0, 2), (3, 1)]);
        assert_eq!(runs([]), []);
        assert_eq!(dot(&[1.0, 2.0, 3.0], &[2.0, 1.0]), 4.0);
        assert_eq!(moments([1.0, 3.0].into_iter()), (2.0, 1.0));
    }

    #[test]
    fn stretches_end_where_a_column_is_not_known() {
        let u = [1.0, 2.0, 3.0, 4.0, 1e70, 6.0];
        let y = [1.0, f64::NAN, 3.0, 4.0, 5.0, 6.0];
        let record = Record {
            u: &u,
            channels: 1,
            y: &y,
            unmeasured: 1,
            weights: None,
            rests: false,
        };
        let found = stretches(&[record], LARGEST);
        assert_eq!(found.iter().map(Rows::len).collect::<Vec<_>>(), [1, 2, 1]);
        assert_eq!(scale_of(&found).unwrap().len(), 2);
        assert!(scale_of(&found[..1]).is_none());
    }
}
