//! Columns of numbers over the samples of an experiment, row by row, and the sums of their products over all experiments.

use nalgebra::DMatrix;

use crate::gram::Gram;

/// A matrix of one row a sample.
#[derive(Clone, Debug)]
pub(super) struct Columns {
    values: Vec<f64>,
    rows: usize,
}

impl Columns {
    /// From values row by row, `rows` of them and at least one.
    pub fn new(values: Vec<f64>, rows: usize) -> Self {
        Self { values, rows }
    }

    /// One column of a function of every sample.
    pub fn of<T>(samples: &[T], value: impl Fn(&T) -> f64) -> Self {
        Self::new(samples.iter().map(value).collect(), samples.len())
    }

    fn from_rows(rows: usize, width: usize, write: impl FnMut((usize, &mut [f64]))) -> Self {
        let mut found = Self::new(vec![0.0; rows * width], rows);
        if width > 0 {
            found
                .values
                .chunks_exact_mut(width)
                .enumerate()
                .for_each(write);
        }
        found
    }

    pub fn len(&self) -> usize {
        self.rows
    }

    pub fn width(&self) -> usize {
        self.values.len() / self.rows
    }

    pub fn row(&self, k: usize) -> &[f64] {
        let width = self.width();
        &self.values[k * width..][..width]
    }

    /// A row, and the rows behind it one after the other.
    pub fn row_and_next(&mut self, k: usize) -> (&mut [f64], &[f64]) {
        let width = self.width();
        let (before, behind) = self.values.split_at_mut((k + 1) * width);
        (&mut before[k * width..], behind)
    }

    pub fn column(&self, j: usize) -> impl Iterator<Item = f64> {
        self.values.iter().skip(j).step_by(self.width()).copied()
    }

    pub fn into_values(self) -> Vec<f64> {
        self.values
    }

    fn change(&mut self, j: usize, change: impl Fn(f64) -> f64) {
        let width = self.width();
        let column = self.values.iter_mut().skip(j).step_by(width);
        column.for_each(|v| *v = change(*v));
    }

    /// Column `j` times `2^-exponent`.
    pub fn scale(&mut self, j: usize, exponent: i32) {
        if exponent != 0 {
            self.change(j, |v| super::scaled(v, exponent));
        }
    }

    /// Column `j` plus a number.
    pub fn shift(&mut self, j: usize, by: f64) {
        self.change(j, |v| v + by);
    }

    /// Column `j` becomes 0.
    pub fn clear(&mut self, j: usize) {
        self.change(j, |_| 0.0);
    }

    pub fn divide(&mut self, by: f64) {
        self.values.iter_mut().for_each(|v| *v /= by);
    }

    /// Every row times a number.
    pub fn times(mut self, factors: &[f64]) -> Self {
        let width = self.width();
        for (row, factor) in self.values.chunks_exact_mut(width).zip(factors) {
            row.iter_mut().for_each(|v| *v *= factor);
        }
        self
    }

    /// The rows that are kept, the others zero.
    pub fn only(mut self, kept: &[bool]) -> Self {
        for (k, _) in kept.iter().enumerate().filter(|(_, kept)| !**kept) {
            let width = self.width();
            self.values[k * width..][..width].fill(0.0);
        }
        self
    }

    /// These columns and others to their right.
    pub fn beside(self, others: &Self) -> Self {
        let width = self.width();
        Self::from_rows(self.rows, width + others.width(), |(k, row)| {
            row[..width].copy_from_slice(self.row(k));
            row[width..].copy_from_slice(others.row(k));
        })
    }

    /// One column for each product of columns.
    pub fn products(runs: &[Self], of: &[Vec<usize>]) -> Vec<Self> {
        let product = |row: &[f64], of: &Vec<usize>| of.iter().map(|j| row[*j]).product::<f64>();
        let each = |run: &Self| {
            Self::from_rows(run.rows, of.len(), |(k, row)| {
                for (value, of) in row.iter_mut().zip(of) {
                    *value = product(run.row(k), of);
                }
            })
        };
        runs.iter().map(each).collect()
    }

    /// `self - basis x`, where `x` has a row for each column of the basis.
    pub fn subtract(&mut self, basis: &Self, x: &DMatrix<f64>) {
        let width = self.width();
        if width == 0 {
            return;
        }
        // row by row in memory
        let x = x.transpose();
        let x = x.as_slice();
        for (k, row) in self.values.chunks_exact_mut(width).enumerate() {
            for (d, x) in basis.row(k).iter().zip(x.chunks_exact(width)) {
                if *d != 0.0 {
                    row.iter_mut().zip(x).for_each(|(v, x)| *v -= d * x);
                }
            }
        }
    }

    /// Some of the columns.
    fn some(&self, columns: &[usize]) -> Self {
        Self::from_rows(self.rows, columns.len(), |(k, row)| {
            let from = self.row(k);
            row.iter_mut().zip(columns).for_each(|(v, j)| *v = from[*j]);
        })
    }

    /// The columns times a matrix.
    fn turned(&self, by: &DMatrix<f64>) -> Self {
        let mut found = Self::from_rows(self.rows, by.ncols(), |_| ());
        found.subtract(self, &-by);
        found
    }
}

/// `[A B]'[A B]` over all experiments.
pub(super) fn joint(a: &[Columns], b: &[Columns]) -> DMatrix<f64> {
    let (p, q) = (a[0].width(), b[0].width());
    let mut gram = Gram::new(p + q, 0);
    for (a, b) in a.iter().zip(b) {
        for k in 0..a.len() {
            gram.add(|row| {
                row[..p].copy_from_slice(a.row(k));
                row[p..p + q].copy_from_slice(b.row(k));
            });
        }
    }
    gram.matrix()
}

/// `A'A` over all experiments.
pub(super) fn squared(a: &[Columns]) -> DMatrix<f64> {
    let nothing: Vec<_> = a
        .iter()
        .map(|a| Columns::new(Vec::new(), a.len()))
        .collect();
    joint(a, &nothing)
}

/// `A'B` over all experiments.
pub(super) fn cross(a: &[Columns], b: &[Columns]) -> DMatrix<f64> {
    let (p, q) = (a[0].width(), b[0].width());
    joint(a, b).view((0, p), (p, q)).into_owned()
}

/// Eigenvalues and the eigenvectors of those above `least` times the largest; none where they are not finite.
pub(super) fn determined(matrix: DMatrix<f64>, least: f64, floor: f64) -> (Vec<f64>, DMatrix<f64>) {
    let n = matrix.nrows();
    let finite = n > 0 && matrix.iter().all(|v| v.is_finite());
    let found = finite
        .then(|| matrix.try_symmetric_eigen(f64::EPSILON, 100 * n + 1000))
        .flatten();
    let Some(found) = found else {
        return (Vec::new(), DMatrix::zeros(n, 0));
    };
    let most = found.eigenvalues.max().max(floor);
    let kept: Vec<usize> = (0..n)
        .filter(|&i| found.eigenvalues[i] > least * most)
        .collect();
    let sizes = kept.iter().map(|&i| found.eigenvalues[i]).collect();
    (sizes, found.eigenvectors.select_columns(&kept))
}

/// An orthonormal basis, over all experiments together, of the span of the columns. Directions with information below `least` times
/// the largest are left out.
pub(super) fn independent(columns: &[Columns], least: f64) -> Vec<Columns> {
    let gram = squared(columns);
    let length = |i: usize| gram[(i, i)].sqrt();
    let used: Vec<usize> = (0..gram.nrows())
        .filter(|&i| length(i) > 0.0 && length(i).is_finite())
        .collect();
    let unit = DMatrix::from_fn(used.len(), used.len(), |i, j| {
        gram[(used[i], used[j])] / length(used[i]) / length(used[j])
    });
    let (sizes, vectors) = determined(unit, least, 0.0);
    let turn = DMatrix::from_fn(used.len(), sizes.len(), |i, j| {
        vectors[(i, j)] / sizes[j].sqrt() / length(used[i])
    });
    // one that is not finite must not be multiplied, not even by 0
    let turned = |c: &Columns| c.some(&used).turned(&turn);
    columns.iter().map(turned).collect()
}

/// The direction of a mean.
pub(super) fn constant(known: &[Vec<bool>]) -> Vec<Columns> {
    let n: usize = known.iter().map(|k| super::number(k)).sum();
    let each = 1.0 / (n.max(1) as f64).sqrt();
    let column = |k: &Vec<bool>| Columns::of(k, |k| if *k { each } else { 0.0 });
    known.iter().map(column).collect()
}

/// Columns delayed by every lag, series by series; zero where a sample is not known.
pub(super) fn lagged(columns: &Columns, lags: &[usize], known: &[bool]) -> Columns {
    moved(columns, lags, known, |k, lag| k.checked_sub(lag))
}

/// Columns advanced by every lag, otherwise as [`lagged`].
pub(super) fn leading(columns: &Columns, lags: &[usize], known: &[bool]) -> Columns {
    let n = columns.len();
    moved(columns, lags, known, |k, lag| {
        Some(k + lag).filter(|&from| from < n)
    })
}

fn moved(
    columns: &Columns,
    lags: &[usize],
    known: &[bool],
    from: impl Fn(usize, usize) -> Option<usize>,
) -> Columns {
    let (width, m) = (columns.width(), lags.len());
    Columns::from_rows(columns.len(), width * m, |(k, row)| {
        let lags = lags.iter().enumerate().filter(|_| known[k]);
        for (i, from) in lags.filter_map(|(i, lag)| Some((i, from(k, *lag)?))) {
            for (j, value) in columns.row(from).iter().enumerate() {
                row[j * m + i] = *value;
            }
        }
    })
}
