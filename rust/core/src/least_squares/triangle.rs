//! QR by rows: the triangle `R` and `Q'r` of any number of rows, with only one block of rows in memory at a time.
//!
//! Householder reflections (Golub and Van Loan, Matrix Computations, 5.2) fold each block of rows into the triangle.
//! The condition is that of `J`; normal equations would square it.

/// Rows folded at a time; a block stays in the caches.
const BLOCK: usize = 64;

/// Squares below this have lost digits, and their inverse is infinite. Columns that are equal in one block after the other come to it.
const NEGLIGIBLE: f64 = f64::MIN_POSITIVE / f64::EPSILON;

/// `R` of `[J, r]`, row by row, `n + 1` values a row.
#[derive(Clone, Debug)]
pub(crate) struct Triangle {
    n: usize,
    rows: Vec<f64>,
    block: Vec<f64>,
    filled: usize,
    sums: Vec<f64>,
}

impl Triangle {
    /// Allocates for up to `most` columns.
    pub fn new(most: usize) -> Self {
        Self {
            n: most,
            rows: vec![0.0; most * (most + 1)],
            block: vec![0.0; BLOCK * (most + 1)],
            filled: 0,
            sums: vec![0.0; most + 1],
        }
    }

    /// Drops all rows; new rows have `n` columns.
    pub fn clear(&mut self, n: usize) {
        self.n = n;
        self.rows[..n * (n + 1)].fill(0.0);
        self.filled = 0;
    }

    /// Becomes a copy of `other`, whose columns must fit into the allocation.
    pub fn copy_from(&mut self, other: &Self) {
        self.clear(other.n);
        let used = other.n * (other.n + 1);
        self.rows[..used].copy_from_slice(&other.rows[..used]);
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.n
    }

    /// Appends a row filled by `write`: `n` values of `J`, then the right-hand side. Its old values are not cleared.
    pub fn push(&mut self, write: impl FnOnce(&mut [f64])) {
        let width = self.n + 1;
        write(&mut self.block[self.filled * width..][..width]);
        self.filled += 1;
        if self.filled == BLOCK {
            self.fold();
        }
    }

    /// Folds the pending rows; to be called before anything is read.
    pub fn fold(&mut self) {
        let width = self.n + 1;
        let block = &mut self.block[..self.filled * width];
        for k in 0..self.n {
            let below: f64 = block.chunks_exact(width).map(|row| row[k] * row[k]).sum();
            if below < NEGLIGIBLE {
                continue;
            }
            let top = &mut self.rows[k * width + k..(k + 1) * width];
            let pivot = -top[0].signum() * (top[0] * top[0] + below).sqrt();
            let first = top[0] - pivot;
            let sums = &mut self.sums[k..width];
            for (sum, value) in sums.iter_mut().zip(&*top) {
                *sum = first * value;
            }
            for row in block.chunks_exact(width) {
                let head = row[k];
                for (sum, value) in sums.iter_mut().zip(&row[k..]) {
                    *sum += head * value;
                }
            }
            let scale = -1.0 / (pivot * first);
            sums.iter_mut().for_each(|sum| *sum *= scale);
            for (value, sum) in top.iter_mut().zip(&*sums) {
                *value -= first * sum;
            }
            top[0] = pivot;
            for row in block.chunks_exact_mut(width) {
                let head = row[k];
                for (value, sum) in row[k..].iter_mut().zip(&*sums) {
                    *value -= head * sum;
                }
            }
        }
        self.filled = 0;
    }

    /// Entry of `R`, zero below the diagonal.
    pub fn at(&self, i: usize, j: usize) -> f64 {
        if i <= j {
            self.rows[i * (self.n + 1) + j]
        } else {
            0.0
        }
    }

    /// The right-hand side `Q'r`; only its part in the range of `J` is stored.
    pub fn rhs(&self) -> impl Iterator<Item = f64> + '_ {
        let width = self.n + 1;
        (0..self.n).map(move |i| self.rows[i * width + self.n])
    }

    fn row(&self, i: usize) -> &[f64] {
        &self.rows[i * (self.n + 1) + i..i * (self.n + 1) + self.n]
    }

    /// True if no pivot is negligible relative to its column. Detects singular matrices, but not every nearly singular one.
    pub fn seems_regular(&self) -> bool {
        let column = |j: usize| (0..=j).map(|i| self.at(i, j).powi(2)).sum::<f64>().sqrt();
        let least = f64::EPSILON * self.n as f64;
        (0..self.n).all(|j| self.at(j, j).abs() > least * column(j))
    }

    /// True if no pivot is zero, so that systems can be solved.
    pub fn is_solvable(&self) -> bool {
        (0..self.n).all(|j| self.at(j, j).abs() >= f64::MIN_POSITIVE)
    }

    /// `x = -R^-1 Q'r`: the step that minimises `|r + J x|`.
    pub fn minimiser(&self, x: &mut [f64]) {
        for (x, b) in x.iter_mut().zip(self.rhs()) {
            *x = -b;
        }
        self.solve(x);
    }

    /// `R x = b` in place.
    pub fn solve(&self, x: &mut [f64]) {
        for i in (0..self.n).rev() {
            let row = self.row(i);
            let dot: f64 = row[1..].iter().zip(&x[i + 1..]).map(|(r, x)| r * x).sum();
            x[i] = (x[i] - dot) / row[0];
        }
    }

    /// `R' x = b` in place.
    pub fn solve_transposed(&self, x: &mut [f64]) {
        for i in 0..self.n {
            let row = self.row(i);
            x[i] /= row[0];
            let value = x[i];
            for (x, r) in x[i + 1..].iter_mut().zip(&row[1..]) {
                *x -= r * value;
            }
        }
    }

    /// `y = R x`.
    pub fn times(&self, x: &[f64], y: &mut [f64]) {
        for (i, y) in y.iter_mut().enumerate().take(self.n) {
            *y = self.row(i).iter().zip(&x[i..]).map(|(r, x)| r * x).sum();
        }
    }

    /// `y = R'b` with `b` the right-hand side: the gradient.
    pub fn gradient(&self, y: &mut [f64]) {
        y.fill(0.0);
        for (i, b) in self.rhs().enumerate() {
            for (y, r) in y[i..].iter_mut().zip(self.row(i)) {
                *y += r * b;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn triangle_of(rows: &[Vec<f64>], n: usize) -> Triangle {
        let mut triangle = Triangle::new(n + 2);
        triangle.clear(n);
        for row in rows {
            triangle.push(|out| out.copy_from_slice(row));
        }
        triangle.fold();
        triangle
    }

    proptest! {
        #[test]
        fn keeps_the_gram_matrix_and_the_gradient(
            rows in prop::collection::vec(prop::collection::vec(-5.0..5.0f64, 5), 1..200),
        ) {
            let triangle = triangle_of(&rows, 4);
            for i in 0..4 {
                for j in 0..4 {
                    let gram: f64 = rows.iter().map(|r| r[i] * r[j]).sum();
                    let ours: f64 = (0..4).map(|k| triangle.at(k, i) * triangle.at(k, j)).sum();
                    prop_assert!((gram - ours).abs() <= 1e-11 * (1.0 + rows.len() as f64));
                }
            }
            let mut gradient = [0.0; 4];
            triangle.gradient(&mut gradient);
            for (j, ours) in gradient.iter().enumerate() {
                let direct: f64 = rows.iter().map(|r| r[j] * r[4]).sum();
                prop_assert!((direct - ours).abs() <= 1e-11 * (1.0 + rows.len() as f64));
            }
        }

        #[test]
        fn solves_both_ways(rows in prop::collection::vec(prop::collection::vec(-5.0..5.0f64, 4), 12)) {
            let triangle = triangle_of(&rows, 3);
            prop_assume!((0..3).all(|i| triangle.at(i, i).abs() > 1e-3));
            let x = [1.0, -2.0, 0.5];
            let (mut y, mut z) = ([0.0; 3], [0.0; 3]);
            triangle.times(&x, &mut y);
            triangle.solve(&mut y);
            for (j, z) in z.iter_mut().enumerate() {
                *z = (0..=j).map(|i| triangle.at(i, j) * x[i]).sum();
            }
            triangle.solve_transposed(&mut z);
            for j in 0..3 {
                prop_assert!((x[j] - y[j]).abs() < 1e-8 && (x[j] - z[j]).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn keeps_digits_that_normal_equations_lose() {
        // Laeuchli's matrix: with e = 1e-9 the Gram matrix is singular in double precision.
        let e = 1e-9;
        let rows = [vec![1.0, 1.0, -2.0], vec![e, 0.0, -e], vec![0.0, e, -e]];
        let triangle = triangle_of(&rows, 2);
        assert!(triangle.seems_regular());
        let mut x = [0.0; 2];
        triangle.minimiser(&mut x);
        assert!(
            (x[0] - 1.0).abs() < 1e-6 && (x[1] - 1.0).abs() < 1e-6,
            "{x:?}"
        );
    }

    #[test]
    fn sees_a_singular_matrix_and_fewer_rows_than_columns() {
        let same = [
            vec![1.0, 2.0, 0.0],
            vec![2.0, 4.0, 1.0],
            vec![3.0, 6.0, 2.0],
        ];
        let regular = |rows: &[Vec<f64>]| triangle_of(rows, 2).seems_regular();
        assert!(!regular(&same) && !regular(&same[..1]));
        assert!(!regular(&[vec![0.0, 1.0, 1.0], vec![0.0, 2.0, 1.0]]));
        assert!(regular(&[vec![1.0, 1.0, 1.0], vec![0.0, 2.0, 1.0]]));
    }
}
