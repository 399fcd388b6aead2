//! Sensitivity rows in blocks, and the sum of their outer products.
//!
//! Rows are collected 64 at a time and then folded into the lower tiles of `X'X`: a rank-1 update per sample would
//! stream the whole matrix through the caches for every row.
//!
//! With the Jacobian's rows `j_k` and the errors `e_k` as one more column, `X = [J e]` and
//!
//! ```text
//!   X'X = sum_k [j_k e_k]' [j_k e_k] = | J'J  J'e |      only the lower triangle is summed:
//!                                      | e'J  e'e |      J'J, and J'e as its last row
//! ```
//!
//! Rows are recursions of previous rows (`memory` of these), so a ring in front of each block keeps the last ones:
//!
//! ```text
//!   rows:  | memory old rows | block of 64 (128) new rows |      width = columns, up to an odd number of cache lines
//!            ^ copied here when the block is folded
//! ```
//!
//! A fold runs over tiles of the triangle. In a tile of r rows and c groups of eight columns every sum stays in a
//! register while the block's rows pass by; each row costs r broadcasts and c loads for r c multiply-adds:
//!
//! ```text
//!               group 0   group 1   group 2
//!    row i    |  sums   |  sums   |  sums   |      AVX-512: 8 x 3, 11 loads for 24 products
//!    row i+1  |  sums   |  sums   |  sums   |      AVX2:    6 x 1,  baseline: 2 x 1
//! ```
//!
//! Gains of the variants, end to end (processor time of a training; each variant removed, least and median of 7): the special corner on
//! the diagonal saves half a tile in each panel, 7 to 10 % of a training of 49 parameters (Zen 4, `training_8` of the kernels' example),
//! 1 % with 155. Panels and blocks of 128 rows save loads: `J'J` of 155 parameters 330 -> 290 ns a sample on an Intel Xeon
//! (docs/PERFORMANCE.md). A Zen 4 processes its wide registers in halves, has loads to spare and shows no gain (-0.4 to 0 %).

use nalgebra::DMatrix;

use crate::simd::{self, F64x8, Kernel, LANES};

/// Rows per block: with 64 parameters a block is 32 kB and stays in the first-level cache.
pub(crate) const BLOCK: usize = 64;
/// Rows per block of wide rows, of which only a panel stays in the cache: the sums are fetched half as often.
const WIDE_BLOCK: usize = 128;
/// A row is wide from this many numbers on.
const WIDE: usize = 96;

/// `X'X` over rows that may depend linearly on previous rows.
#[derive(Debug)]
pub(crate) struct Gram {
    /// Columns that are summed.
    columns: usize,
    /// Numbers from one row to the next.
    width: usize,
    /// Rows per block.
    block: usize,
    memory: usize,
    filled: usize,
    /// Start of the first row: on a cache line.
    // A `Vec` of numbers may begin anywhere. Rows of whole cache lines that begin on one have no load that touches two
    // lines.
    base: usize,
    rows: Vec<f64>,
    sums: Vec<f64>,
    /// Rows of the block that do not count in full, and their factor before they are summed: the root of their weight,
    /// or 0 if they take part in the recursion only.
    // A list, as it is almost always empty: a weight for every row would be a product for every number.
    reduced: Vec<(usize, f64)>,
}

impl Gram {
    /// Allocates for rows of at least `columns` values, each of which sees `memory` previous rows.
    pub fn new(columns: usize, memory: usize) -> Self {
        Self::with_room(columns, columns, memory)
    }

    /// As [`Gram::new`], for rows that are written up to `room` values, of which only `columns` count.
    pub fn with_room(columns: usize, room: usize, memory: usize) -> Self {
        // An odd number of cache lines: rows a power of two apart would compete for the same few places of a cache.
        let width = (room.div_ceil(LANES) | 1) * LANES;
        // 64 rows of 64 numbers are 32 kB and stay in the first-level cache. Of wide rows only a panel fits, for any
        // number of rows, so longer blocks cost nothing and halve the traffic of the sums (155 parameters: 330 ns a
        // sample with 64 rows, 290 with 128).
        let block = if width < WIDE { BLOCK } else { WIDE_BLOCK };
        // One cache line more than the rows need, to align the base.
        let rows = vec![0.0; (memory + block) * width + LANES];
        Self {
            columns,
            width,
            block,
            memory,
            filled: 0,
            base: rows
                .as_ptr()
                .align_offset(LANES * size_of::<f64>())
                .min(LANES),
            rows,
            sums: vec![0.0; width * width],
            reduced: Vec::with_capacity(block),
        }
    }

    /// Clears all sums and rows; the rows before the first are zero.
    pub fn clear(&mut self) {
        self.filled = 0;
        self.rows.fill(0.0);
        self.sums.fill(0.0);
        self.reduced.clear();
    }

    /// Distance from one row to the next: the columns and some padding.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The row `back` rows before the next one; 1 is the last.
    pub fn past_mut(&mut self, back: usize) -> &mut [f64] {
        // The ring and the block are contiguous: rows before the block's first are in front of it.
        let start = self.base + (self.memory + self.filled - back) * self.width;
        &mut self.rows[start..start + self.width]
    }

    /// Appends a row. `write` fills it (it has old values), then `sum_m gains[m] row(-1-m)` is added and its column
    /// `last` is set to `value`, outside the recursion. A row whose `value` is NaN, an unmeasured sample, takes part in
    /// the recursion but not in the sum. In the sum a row counts by its `weight`.
    pub fn push(
        &mut self,
        gains: &[f64],
        last: usize,
        (value, weight): (f64, f64),
        write: impl FnOnce(&mut [f64]),
    ) {
        let (past, row) = self.place();
        write(row);
        for (gain, old) in gains.iter().zip(past.rchunks_exact(row.len())) {
            for (value, old) in row.iter_mut().zip(old) {
                *value += gain * old;
            }
        }
        // Last, so that errors do not enter the recursion: an error is no derivative of anything after it.
        row[last] = value;
        self.keep_weighed(value, weight);
    }

    /// The previous rows, the oldest first, and the place of the next one, which has old values.
    #[inline(always)]
    pub fn place(&mut self) -> (&[f64], &mut [f64]) {
        let next = self.base + (self.memory + self.filled) * self.width;
        let (past, rest) = self.rows.split_at_mut(next);
        (
            &past[self.base + self.filled * self.width..],
            &mut rest[..self.width],
        )
    }

    /// Appends the row written into [`Gram::place`]. If `value` is NaN, for an unmeasured sample, it takes part in the
    /// recursion only.
    #[inline(always)]
    pub fn keep_weighed(&mut self, value: f64, weight: f64) {
        // sum w j j' = sum (sqrt(w) j)(sqrt(w) j)', so a row is multiplied by the root of its weight.
        if value.is_nan() {
            self.reduced.push((self.filled, 0.0));
        } else if weight != 1.0 {
            self.reduced.push((self.filled, weight.sqrt()));
        }
        self.filled += 1;
        if self.filled == self.block {
            self.fold();
        }
    }

    /// Adds a row that `write` fills (it has old values) and that counts in full.
    #[inline(always)]
    pub fn add(&mut self, write: impl FnOnce(&mut [f64])) {
        write(self.place().1);
        self.keep_weighed(0.0, 1.0);
    }

    /// The previous rows, the oldest first, followed by room for `count` rows, at most 64, with old values;
    /// [`Gram::keep_all`] appends them.
    pub fn ahead(&mut self, count: usize) -> &mut [f64] {
        // The next rows are contiguous. The block is a multiple of 64, so no block is folded half full.
        if self.filled + count > self.block {
            self.fold();
        }
        let start = self.base + self.filled * self.width;
        &mut self.rows[start..start + (self.memory + count) * self.width]
    }

    /// Appends the rows written into [`Gram::ahead`]. Rows whose value is NaN take part in the recursion only; the
    /// others count by their weights, or in full without weights.
    pub fn keep_all(&mut self, values: &[f64], weights: &[f64]) {
        let measured = values.iter().zip(weights).enumerate();
        let measured = measured.filter(|(_, (v, _))| !v.is_nan());
        self.reduced
            .extend(measured.map(|(i, (_, w))| (self.filled + i, w.sqrt())));
        // Without weights `zip` ends at once, and only gaps are listed.
        let unmeasured = values.iter().enumerate().filter(|(_, v)| v.is_nan());
        self.reduced
            .extend(unmeasured.map(|(i, _)| (self.filled + i, 0.0)));
        self.filled += values.len();
    }

    /// Room for `count` rows, at most 64, with old values; [`Gram::keep`] appends them.
    #[inline(always)]
    pub fn room(&mut self, count: usize) -> &mut [f64] {
        if self.filled + count > self.block {
            self.fold();
        }
        let start = self.base + (self.memory + self.filled) * self.width;
        &mut self.rows[start..start + count * self.width]
    }

    /// Appends the rows written into [`Gram::room`].
    #[inline(always)]
    pub fn keep(&mut self, count: usize) {
        self.filled += count;
    }

    /// `X'X` row by row, `width` values each; only its lower triangle is valid. The width comes second.
    pub fn finish(&mut self) -> (&[f64], usize) {
        // Includes the block in progress, however few rows it has.
        self.fold();
        (&self.sums, self.width)
    }

    /// `X'X`, both triangles.
    pub fn matrix(&mut self) -> DMatrix<f64> {
        let n = self.columns;
        let (sums, width) = self.finish();
        DMatrix::from_fn(n, n, |i, j| sums[i.max(j) * width + i.min(j)])
    }

    #[inline(never)]
    fn fold(&mut self) {
        let width = self.width;
        let start = self.base + self.memory * width;
        let end = start + self.filled * width;
        // The rows that the next block needs are saved before weights are applied: sensitivities themselves are not weighted.
        let kept = end - self.memory * width;
        self.rows.copy_within(kept..end, self.base);
        self.rows[self.base..start].iter_mut().for_each(forget);
        for (i, root) in self.reduced.drain(..) {
            let row = &mut self.rows[start + i * width..][..width];
            match root {
                // the error of an unmeasured sample is NaN
                0.0 => row.fill(0.0),
                _ => row.iter_mut().for_each(|value| *value *= root),
            }
        }
        simd::run(Fold {
            block: &self.rows[start..end],
            width,
            columns: self.columns,
            sums: &mut self.sums,
        });
        self.filled = 0;
    }
}

/// Sensitivities below this are set to zero: their squares would be denormal, with which many processors are slow.
const FORGOTTEN: f64 = 1e-140;

/// Ends the decay of a sensitivity to the initial state.
#[inline]
pub(crate) fn forget(value: &mut f64) {
    if value.abs() < FORGOTTEN {
        *value = 0.0;
    }
}

/// Adds a block's outer products to the sums.
struct Fold<'a> {
    block: &'a [f64],
    width: usize,
    columns: usize,
    sums: &'a mut [f64],
}

impl Kernel for Fold<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(mut self) {
        match V::TILE_ROWS {
            8 => self.wide::<V>(),
            6 => self.narrow::<V, 6>(),
            _ => self.narrow::<V, 2>(),
        }
    }
}

impl Fold<'_> {
    /// Panels of three groups of columns, which stay in the first-level cache while the rows of `X'` pass by; then the
    /// rows that fill no group.
    #[inline(always)]
    fn wide<V: F64x8>(&mut self) {
        //   panel of three groups of columns     rows from the diagonal down
        //    | corner: 2 groups by 16 rows, upper right left out |
        //    | 8 rows by 3 groups                                |   next tile
        //    | 8 rows by 3 groups                                |   ..
        // Tiles on the diagonal contain entries of the upper triangle, which are summed but not read. In the first two
        // rows of tiles that would be most entries: the corner has 24 groups of sums instead of 48.
        let whole = self.columns / LANES;
        for first in (0..whole).step_by(3) {
            let below = match whole - first {
                // A last panel of one group: no corner to leave out.
                1 => {
                    self.tile::<V, 8, 1>(first * LANES, first * LANES);
                    first + 1
                }
                _ => {
                    self.corner::<V>(first * LANES);
                    first + 2
                }
            };
            for group in below..whole {
                self.tile::<V, 8, 3>(group * LANES, first * LANES);
            }
        }
        // The rows that fill no group, in strips of 4, 2 and 1 by the binary digits of their number: with few rows more
        // groups fit into the registers, 4 x 6, 2 x 7, 1 x 7 sums.
        let mut row = whole * LANES;
        row = self.strip::<V, 4, 6>(row);
        row = self.strip::<V, 2, 7>(row);
        self.strip::<V, 1, 7>(row);
    }

    /// A strip of rows, with as many groups at once as registers hold; returns the row after it.
    #[inline(always)]
    fn strip<V: F64x8, const ROWS: usize, const MOST: usize>(&mut self, row: usize) -> usize {
        // Strips are done in the order 4, 2, 1, so this bit tells whether there is one of this size.
        if (self.columns - row) & ROWS == 0 {
            return row;
        }
        let groups = self.columns.div_ceil(LANES);
        for first in (0..groups).step_by(MOST) {
            let column = first * LANES;
            // A tile of each width, so that no group beyond the last is read.
            match (groups - first).min(MOST) {
                1 => self.tile::<V, ROWS, 1>(row, column),
                2 => self.tile::<V, ROWS, 2>(row, column),
                3 => self.tile::<V, ROWS, 3>(row, column),
                4 => self.tile::<V, ROWS, 4>(row, column),
                5 => self.tile::<V, ROWS, 5>(row, column),
                6 => self.tile::<V, ROWS, 6>(row, column),
                _ => self.tile::<V, ROWS, 7>(row, column),
            }
        }
        row + ROWS
    }

    /// One group of columns after the other.
    #[inline(always)]
    fn narrow<V: F64x8, const ROWS: usize>(&mut self) {
        // AVX2: of 16 registers, 6 x 1 sums take 12, a group two, a broadcast number one. One group of columns at a
        // time stays in the cache for all rows below it.
        for column in (0..self.columns).step_by(LANES) {
            let mut row = column;
            while row + ROWS <= self.columns {
                self.tile::<V, ROWS, 1>(row, column);
                row += ROWS;
            }
            if row + 4 <= self.columns {
                self.tile::<V, 4, 1>(row, column);
                row += 4;
            }
            if row + 2 <= self.columns {
                self.tile::<V, 2, 1>(row, column);
                row += 2;
            }
            if row < self.columns {
                self.tile::<V, 1, 1>(row, column);
            }
        }
    }

    /// Sixteen rows from the diagonal on: one group for the upper eight, two for the lower.
    #[inline(always)]
    fn corner<V: F64x8>(&mut self, at: usize) {
        //   group      at     at + 8
        //   rows 0-7   upper  -          8 + 16 sums, of 32 registers; both share the loads of the row
        //   rows 8-15  lower  lower
        let mut upper = [[V::splat(0.0)]; LANES];
        let mut lower = [[V::splat(0.0); 2]; LANES];
        for row in self.block.chunks_exact(self.width) {
            let Some(own) = row[at..].first_chunk::<{ 2 * LANES }>() else {
                // Impossible: `wide` asks for a corner only if there are two groups. A kernel must not panic.
                return;
            };
            let right = [V::first(own), V::first(&own[LANES..])];
            for r in 0..LANES {
                upper[r][0] = upper[r][0].add_product(V::splat(own[r]), right[0]);
                let left = V::splat(own[LANES + r]);
                for g in 0..2 {
                    lower[r][g] = lower[r][g].add_product(left, right[g]);
                }
            }
        }
        self.add(at, at, upper);
        self.add(at + LANES, at, lower);
    }

    /// `ROWS` times `GROUPS` groups of sums, which stay in registers.
    #[inline(always)]
    fn tile<V: F64x8, const ROWS: usize, const GROUPS: usize>(&mut self, i: usize, j: usize) {
        // sums[r][g] += x[i + r] x[j + 8 g ..], row after row of X: an outer product of two short pieces. ROWS GROUPS
        // independent sums; 8 or more hide the latency of a fused operation (4 cycles on two units).
        let mut sums = [[V::splat(0.0); GROUPS]; ROWS];
        for row in self.block.chunks_exact(self.width) {
            let right = &row[j..j + GROUPS * LANES];
            let mut groups = [V::splat(0.0); GROUPS];
            for (group, right) in groups.iter_mut().zip(right.as_chunks().0) {
                *group = V::load(right);
            }
            let left = &row[i..i + ROWS];
            // ROWS + GROUPS loads for ROWS GROUPS products: 11 for 24 with AVX-512, which can do two loads and two
            // products a cycle.
            for (sums, left) in sums.iter_mut().zip(left) {
                let left = V::splat(*left);
                for (sum, right) in sums.iter_mut().zip(groups) {
                    *sum = sum.add_product(left, right);
                }
            }
        }
        self.add(i, j, sums);
    }

    /// Adds a tile to the sums whose first row is `i` and whose first column `j`.
    #[inline(always)]
    fn add<V: F64x8, const ROWS: usize, const GROUPS: usize>(
        &mut self,
        i: usize,
        j: usize,
        tile: [[V; GROUPS]; ROWS],
    ) {
        // Once a block: with 64 rows a sum is fetched and stored once for 64 products.
        for (r, sums) in tile.iter().enumerate() {
            let totals = &mut self.sums[(i + r) * self.width + j..][..GROUPS * LANES];
            for (g, sum) in sums.iter().enumerate() {
                let total = &mut totals[g * LANES..];
                V::first(total).add(*sum).write(total);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_outer_products_of_recursive_rows_across_blocks() {
        check_sums(|_| true, |_| 1.0);
    }

    #[test]
    fn leaves_rows_that_were_not_measured_out_of_the_sum_alone() {
        check_sums(
            |k| k % 3 != 1 && !(60..70).contains(&k) && k != 149,
            |_| 1.0,
        );
    }

    #[test]
    fn puts_weights_on_the_rows_of_the_sum_alone() {
        check_sums(|k| k % 3 != 1, |k| (k % 5) as f64);
        check_sums(|_| true, |k| if (60..70).contains(&k) { 0.0 } else { 0.5 });
    }

    fn check_sums(measured: impl Fn(usize) -> bool, weight: impl Fn(usize) -> f64) {
        let (columns, gains) = (5, [0.5, -0.3]);
        let value = |k: usize, c: usize| ((k * 7 + c * 3) as f64).sin();
        let mut gram = Gram::new(columns + 1, 2);
        gram.clear();
        gram.past_mut(1)[0] = 2.0;
        let (mut past, mut dense) = ([vec![0.0; 6], vec![0.0; 6]], vec![vec![0.0; 6]; 6]);
        past[0][0] = 2.0;
        for k in 0..150 {
            let error = if measured(k) { k as f64 } else { f64::NAN };
            gram.push(&gains, columns, (error, weight(k)), |row| {
                (0..columns).for_each(|c| row[c] = value(k, c));
            });
            let mut row: Vec<f64> = (0..columns)
                .map(|c| value(k, c) + gains[0] * past[0][c] + gains[1] * past[1][c])
                .collect();
            row.push(k as f64);
            for (i, sums) in dense.iter_mut().enumerate().filter(|_| measured(k)) {
                sums.iter_mut()
                    .zip(&row)
                    .for_each(|(s, r)| *s += weight(k) * row[i] * r);
            }
            past.swap(0, 1);
            past[0] = row;
        }
        let (sums, width) = gram.finish();
        for i in 0..6 {
            for j in 0..=i {
                let expected: f64 = dense[i][j];
                assert!((sums[i * width + j] - expected).abs() <= 1e-9 * (1.0 + expected.abs()));
            }
        }
    }
}
