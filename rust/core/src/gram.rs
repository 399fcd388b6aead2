//! Sensitivity rows in blocks, and the sum of their outer products.
//!
//! Rows are collected 64 at a time and then folded into the lower tiles of `X'X`: a rank-1 update per sample would
//! stream the whole matrix through the caches for every row.

/// Rows per block: with 64 parameters a block is 32 kB and stays in the first-level cache.
const BLOCK: usize = 64;
/// Edge of a tile; its 16 sums stay in registers.
const TILE: usize = 4;

/// `X'X` over rows that may depend linearly on the rows before them.
#[derive(Debug)]
pub(crate) struct Gram {
    width: usize,
    memory: usize,
    filled: usize,
    rows: Vec<f64>,
    sums: Vec<f64>,
    /// Rows of the block that take part in the recursion alone.
    weightless: Vec<usize>,
}

impl Gram {
    /// Room for rows of at least `columns` values, each of which sees `memory` rows before it.
    pub fn new(columns: usize, memory: usize) -> Self {
        let width = columns.next_multiple_of(TILE);
        Self {
            width,
            memory,
            filled: 0,
            rows: vec![0.0; (memory + BLOCK) * width],
            sums: vec![0.0; width * width],
            weightless: Vec::with_capacity(BLOCK),
        }
    }

    /// Forgets all sums and rows; the rows before the first are zero.
    pub fn clear(&mut self) {
        self.filled = 0;
        self.rows.fill(0.0);
        self.sums.fill(0.0);
        self.weightless.clear();
    }

    /// The row `back` rows before the next one, 1 being the last.
    pub fn past_mut(&mut self, back: usize) -> &mut [f64] {
        let start = (self.memory + self.filled - back) * self.width;
        &mut self.rows[start..start + self.width]
    }

    /// Appends a row: `write` fills it (it comes with old values), then `sum_m gains[m] row(-1-m)` is added to it and
    /// its column `last` is set to `value`, outside the recursion. A row whose `value` is NaN is part of the recursion
    /// and not of the sum: a sample that was not measured.
    pub fn push(&mut self, gains: &[f64], last: usize, value: f64, write: impl FnOnce(&mut [f64])) {
        let width = self.width;
        let (past, rest) = self.rows.split_at_mut((self.memory + self.filled) * width);
        let row = &mut rest[..width];
        write(row);
        for (gain, old) in gains.iter().zip(past.rchunks_exact(width)) {
            for (value, old) in row.iter_mut().zip(old) {
                *value += gain * old;
            }
        }
        row[last] = value;
        if value.is_nan() {
            self.weightless.push(self.filled);
        }
        self.filled += 1;
        if self.filled == BLOCK {
            self.fold();
        }
    }

    /// `X'X` row by row, `width` values each; only its lower triangle is valid. The width comes second.
    pub fn finish(&mut self) -> (&[f64], usize) {
        self.fold();
        (&self.sums, self.width)
    }

    fn fold(&mut self) {
        let (width, start) = (self.width, self.memory * self.width);
        let end = start + self.filled * width;
        // The rows that the next block sees are saved before those without weight are emptied.
        self.rows.copy_within(end - start..end, 0);
        for i in self.weightless.drain(..) {
            self.rows[start + i * width..][..width].fill(0.0);
        }
        let block = &self.rows[start..end];
        for i in (0..width).step_by(TILE) {
            for j in (0..=i).step_by(TILE) {
                let tile = tile(block, width, i, j);
                for (a, sums) in tile.iter().enumerate() {
                    let at = (i + a) * width + j;
                    for (total, sum) in self.sums[at..at + TILE].iter_mut().zip(sums) {
                        *total += sum;
                    }
                }
            }
        }
        self.filled = 0;
    }
}

fn tile(block: &[f64], width: usize, i: usize, j: usize) -> [[f64; TILE]; TILE] {
    let mut sums = [[0.0; TILE]; TILE];
    for row in block.chunks_exact(width) {
        let left: &[f64; TILE] = row[i..i + TILE].try_into().unwrap_or(&[0.0; TILE]);
        let right: &[f64; TILE] = row[j..j + TILE].try_into().unwrap_or(&[0.0; TILE]);
        for (sums, left) in sums.iter_mut().zip(left) {
            for (sum, right) in sums.iter_mut().zip(right) {
                *sum += left * right;
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_outer_products_of_recursive_rows_across_blocks() {
        check_sums(|_| true);
    }

    #[test]
    fn leaves_rows_that_were_not_measured_out_of_the_sum_alone() {
        check_sums(|k| k % 3 != 1 && !(60..70).contains(&k) && k != 149);
    }

    fn check_sums(measured: impl Fn(usize) -> bool) {
        let (columns, gains) = (5, [0.5, -0.3]);
        let value = |k: usize, c: usize| ((k * 7 + c * 3) as f64).sin();
        let mut gram = Gram::new(columns + 1, 2);
        gram.clear();
        gram.past_mut(1)[0] = 2.0;
        let (mut past, mut dense) = ([vec![0.0; 6], vec![0.0; 6]], vec![vec![0.0; 6]; 6]);
        past[0][0] = 2.0;
        for k in 0..150 {
            let error = if measured(k) { k as f64 } else { f64::NAN };
            gram.push(&gains, columns, error, |row| {
                (0..columns).for_each(|c| row[c] = value(k, c));
            });
            let mut row: Vec<f64> = (0..columns)
                .map(|c| value(k, c) + gains[0] * past[0][c] + gains[1] * past[1][c])
                .collect();
            row.push(k as f64);
            for (i, sums) in dense.iter_mut().enumerate().filter(|_| measured(k)) {
                sums.iter_mut()
                    .zip(&row)
                    .for_each(|(s, r)| *s += row[i] * r);
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
