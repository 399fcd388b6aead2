//! Exact derivatives of the free run by the forward recursion, a block of samples at a time.
//!
//! `d yhat(k)/d theta = d f/d theta + sum_m (d f/d phi_m) d yhat(k-m)/d theta`, zero where the output is clipped.
//!
//! The free run is known, so slopes and gains of a block are computed first, independently for each sample. Then a few
//! groups of columns pass through the block with their last rows in registers.
//!
//! For `y = w2'h + b2 + l'phi`, `h = tanh(W1 phi + b1)` and `r = w2 (1 - h^2)`, unit by unit,
//!
//! ```text
//!   df/dW1_c = r phi_c     df/db1 = r     df/dw2 = h     df/db2 = 1     df/dl = phi
//!   df/dphi_m = sum r W1_m + l_m    =: gain m, for the past outputs m = 1..na
//!   S(k) = df/dtheta(k) + sum_m gain_m(k) S(k-m)
//! ```
//!
//! In a row S(k) eight adjacent columns are eight hidden units of one kind, so no gain or regressor is looked up per column:
//!
//! ```text
//!   | W1 by phi_1, all units | W1 by phi_2 .. | b1 | w2 | b2, l | past outputs | error |
//!     source r, scale phi_1    r, phi_2         r,1  h,1  tail,1
//! ```
//!
//! A `Column` is a group of eight with its source (r, h or tail) and its scale (an entry of phi, or ones). Within a block sources and
//! gains are known, so a group passes over all 64 samples with its last `na` values in registers: rows are written once and never read
//! back. If the number of past outputs is a compile-time constant, these values stay in registers instead of an array: `na` = 2 saves 9 %
//! of a training, `na` = 3 as much (12 hidden units 6 %); `na` = 1 saved 3 % and was left out.

use super::network::{self, Network, Shape};
use crate::Monitor;
use crate::gram::{BLOCK, Gram};
use crate::simd::{self, F64x8, Kernel, LANES, Lanes};

/// Receives the rows and keeps the previous ones.
pub(super) trait Rows {
    /// The last `na` rows, the oldest first, followed by room for the next `count`.
    fn ahead(&mut self, count: usize) -> &mut [f64];
    /// Called when the next rows are written; the error of an unmeasured output is NaN. Without weights all count
    /// alike.
    fn keep(&mut self, errors: &[f64], weights: &[f64]);
}

impl Rows for Gram {
    fn ahead(&mut self, count: usize) -> &mut [f64] {
        Gram::ahead(self, count)
    }

    fn keep(&mut self, errors: &[f64], weights: &[f64]) {
        Gram::keep_all(self, errors, weights);
    }
}

/// The recursion over one free run. A stop request ends it early.
pub(super) struct Recursion<'a, R> {
    pub network: &'a Network,
    /// Scaled inputs of the whole experiment, and the first sample simulated.
    pub u: &'a [f64],
    pub first: usize,
    /// Past outputs before it.
    pub state: &'a [f64],
    /// The results of the free run; without hidden outputs the slopes are computed to their last digits.
    pub run: &'a [f64],
    pub hidden: Option<&'a [Lanes]>,
    /// Measured outputs of the simulated samples, and their weights; empty if all count alike.
    pub y: &'a [f64],
    pub weights: &'a [f64],
    pub rows: &'a mut R,
    pub monitor: Option<&'a Monitor>,
}

/// Blocks between two checks of the monitor.
const LOOK: usize = 64;

impl<R: Rows> Recursion<'_, R> {
    /// Runs the recursion.
    pub fn go(self) {
        let mut block = Block::new(self.network.shape);
        // Blocks of y, as only measured outputs have rows: a caller without measurements passes the run itself as y.
        for (i, measured) in self.y.chunks(BLOCK).enumerate() {
            if i % LOOK == 0 && self.monitor.is_some_and(Monitor::stopped) {
                return;
            }
            let (start, count) = (i * BLOCK, measured.len());
            // Regressors and errors are copies and differences and need no kernel; all products are in `Advance`.
            block.fill(&self, start, count);
            for (k, measured) in measured.iter().enumerate() {
                block.errors[k] = measured - self.run[start + k];
            }
            simd::run(Advance {
                recursion: Step {
                    network: self.network,
                    run: &self.run[start..start + count],
                    hidden: self.hidden.map(|all| &all[start * block.groups..]),
                },
                block: &mut block,
                rows: self.rows.ahead(count),
            });
            let weights = self.weights.get(start..start + count);
            self.rows
                .keep(&block.errors[..count], weights.unwrap_or_default());
        }
    }
}

/// Eight columns of a row before the past rows are added: a source times a scale.
#[derive(Clone, Copy)]
struct Column {
    at: usize,
    source: usize,
    scale: usize,
}

/// The ingredients of a block's rows, each over the samples of the block.
struct Block {
    shape: Shape,
    groups: usize,
    columns: Vec<Column>,
    /// Entries of the regressor, then ones.
    // Contiguous over the samples, as a group of columns passes over them; scalars, broadcast when used.
    scales: Vec<[f64; BLOCK]>,
    /// Slopes of the output with respect to each hidden unit's argument; hidden outputs; and
    /// `[1, linear's regressor, 0 ..]`, the source of the columns after the hidden units.
    //   sources   | r: a group of units each | h: a group each | tail: b2, linear |      `BLOCK` samples each
    // The kinds of columns of W1 and b1 share the source r; only their scale differs.
    sources: Vec<[Lanes; BLOCK]>,
    /// Slopes of the output with respect to each past output.
    gains: Vec<[f64; BLOCK]>,
    errors: [f64; BLOCK],
}

impl Block {
    fn new(shape: Shape) -> Self {
        let (groups, n_phi, units) = (shape.groups(), shape.lags.regressors(), shape.hidden);
        // (first column, source, scale): W1 by entry of phi with source r, then b1 as an entry with scale 1, then w2
        // with source h and scale 1; groups of units within each. Columns must be written in this order: the lanes of
        // missing units fall on the first columns of the next kind, which is written later and overwrites them. No lane
        // reads another.
        let parts = (0..=n_phi).map(|c| (c * units, 0, c));
        let parts = parts.chain([((n_phi + 1) * units, groups, n_phi)]);
        let units = parts.flat_map(|(at, source, scale)| {
            (0..groups).map(move |g| (at + g * LANES, source + g, scale))
        });
        let tail =
            (0..shape.tail_groups()).map(|g| (shape.tail() + g * LANES, 2 * groups + g, n_phi));
        let column = |(at, source, scale)| Column { at, source, scale };
        Self {
            shape,
            groups,
            columns: units.chain(tail).map(column).collect(),
            scales: vec![[1.0; BLOCK]; n_phi + 1],
            sources: vec![[Lanes::ZERO; BLOCK]; 2 * groups + shape.tail_groups()],
            gains: vec![[0.0; BLOCK]; shape.lags.na],
            errors: [0.0; BLOCK],
        }
    }

    /// Fills the regressors of a block, and their part in the bypass.
    fn fill<R>(&mut self, recursion: &Recursion<'_, R>, start: usize, count: usize) {
        let (lags, n_phi) = (self.shape.lags, self.shape.lags.regressors());
        // The last scale stays 1.
        for (c, entry) in self.scales[..n_phi].iter_mut().enumerate() {
            let entry = &mut entry[..count];
            if c < lags.na {
                network::output_entry(recursion.run, recursion.state, start, c + 1, entry);
            } else {
                let start = recursion.first + start;
                network::input_entry(lags, recursion.u, start, c - lags.na, entry);
            }
        }
        // Columns b2 and linear have derivatives 1 and phi. The columns after them, of past outputs and error, are zero
        // in this source: past outputs enter by the recursion only.
        let direct = if self.shape.bypass { n_phi } else { 0 };
        for tail in 0..=direct {
            let source = &mut self.sources[2 * self.groups + tail / LANES];
            let entry = if tail == 0 { n_phi } else { tail - 1 };
            for (own, value) in source[..count].iter_mut().zip(&self.scales[entry]) {
                own.0[tail % LANES] = *value;
            }
        }
    }
}

/// The data of a block from its free run.
struct Step<'a> {
    network: &'a Network,
    run: &'a [f64],
    hidden: Option<&'a [Lanes]>,
}

/// One block of the recursion.
struct Advance<'a> {
    recursion: Step<'a>,
    block: &'a mut Block,
    /// The past rows, then those of the block.
    rows: &'a mut [f64],
}

impl Kernel for Advance<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: F64x8>(mut self) {
        match self.block.shape.lags.na {
            2 => self.advance::<V, 2>(),
            3 => self.advance::<V, 3>(),
            _ => self.advance::<V, 0>(),
        }
        // The error is no derivative and not part of the recursion: it is written over what the last group left there.
        let width = self.rows.len() / (self.block.shape.lags.na + self.recursion.run.len());
        let (na, error) = (self.block.shape.lags.na, self.block.shape.error_column());
        let rows = self.rows.chunks_exact_mut(width).skip(na);
        for (row, value) in rows.zip(&self.block.errors) {
            row[error] = *value;
        }
    }
}

impl Advance<'_> {
    /// `NA` past outputs; 0 for any number.
    #[inline(always)]
    fn advance<V: F64x8, const NA: usize>(&mut self) {
        for group in 0..self.block.groups {
            self.slopes::<V>(group);
        }
        self.gains::<V>();
        // After slopes and gains, as a clipped sample has neither.
        self.clip();
        let mut next = 0;
        while next < self.block.columns.len() {
            // Several groups at once: each has a value and NA past ones in registers, all share the gains, and each fills the waiting
            // times of the others. Six are split into three and three, not four and two. With 16 registers it is two groups, on the
            // baseline one; two groups with 32 registers make a training 3 % longer (Zen 4, `training_8`, least and median of 150).
            next += match (V::TILE_ROWS, self.block.columns.len() - next) {
                (2, _) | (_, 1) => self.columns::<V, NA, 1>(next),
                (6, _) | (_, 2) => self.columns::<V, NA, 2>(next),
                (_, 3 | 6) => self.columns::<V, NA, 3>(next),
                _ => self.columns::<V, NA, 4>(next),
            };
        }
    }

    /// Slopes and hidden outputs of a group, from stored hidden outputs or else computed to their last digits.
    ///
    /// The digits that `1 - h^2` loses in saturation are far below the resolution of a sum of squares.
    #[inline(always)]
    fn slopes<V: F64x8>(&mut self, group: usize) {
        let network = self.recursion.network;
        let (groups, block) = (self.block.groups, &mut *self.block);
        let second = V::load(&network.second[group].0);
        let (slopes, outputs) = block.sources.split_at_mut(groups);
        let (slopes, outputs) = (&mut slopes[group], &mut outputs[group]);
        let count = self.recursion.run.len().min(BLOCK);
        // With a trial's stored hidden outputs this pass needs no tanh.
        let Some(hidden) = self.recursion.hidden else {
            let mut phi = vec![0.0; block.shape.lags.regressors()];
            for k in 0..count {
                for (phi, entry) in phi.iter_mut().zip(&block.scales) {
                    *phi = entry[k];
                }
                let (h, rise) = network.unit::<V>(group, &phi);
                h.store(&mut outputs[k].0);
                second.mul(rise).store(&mut slopes[k].0);
            }
            return;
        };
        for (k, stored) in hidden.chunks_exact(groups).enumerate().take(count) {
            let h = V::load(&stored[group].0);
            h.store(&mut outputs[k].0);
            steep(second, h).store(&mut slopes[k].0);
        }
    }

    /// The slopes of the output with respect to each past output.
    #[inline(always)]
    fn gains<V: F64x8>(&mut self) {
        let (network, groups) = (self.recursion.network, self.block.groups);
        let n_phi = self.block.shape.lags.regressors();
        let count = self.recursion.run.len().min(BLOCK);
        for (m, gains) in self.block.gains.iter_mut().enumerate() {
            gains.fill(network.linear[m]);
            for (group, slopes) in self.block.sources[..groups].iter().enumerate() {
                let weights = V::load(&network.first[group * n_phi + m].0);
                for k in 0..count {
                    // gain_m(k) = linear_m + sum over units of r W1_m: one sum over lanes per sample and past output.
                    gains[k] += V::load(&slopes[k].0).mul(weights).sum();
                }
            }
        }
    }

    /// Clears the slopes of samples whose output is clipped.
    #[inline(always)]
    fn clip(&mut self) {
        let Step { network, run, .. } = self.recursion;
        if !network.saturates() {
            return;
        }
        let block = &mut *self.block;
        // There dy = 0: no slope of its own, and the past does not reach the future through this output.
        for (k, _) in run
            .iter()
            .enumerate()
            .filter(|(_, y)| network.is_clipped(**y))
        {
            block.gains.iter_mut().for_each(|gains| gains[k] = 0.0);
            let sources = block.sources.iter_mut();
            sources.for_each(|source| source[k] = Lanes::ZERO);
        }
    }

    /// Passes `COUNT` groups of columns, from the plan's `next` on, through the block; returns `COUNT`.
    #[inline(always)]
    fn columns<V: F64x8, const NA: usize, const COUNT: usize>(&mut self, next: usize) -> usize {
        let (block, count) = (&*self.block, self.recursion.run.len());
        let na = block.shape.lags.na;
        let width = self.rows.len() / (na + count);
        // Fixed-length arrays by value and no iterators within the loop: indices are constants, and the compiler keeps
        // the values in registers.
        let plan: [Column; COUNT] = std::array::from_fn(|c| block.columns[next + c]);
        let sources = plan.map(|column| &block.sources[column.source]);
        let scales = plan.map(|column| &block.scales[column.scale]);
        let gains: [&[f64; BLOCK]; NA] = std::array::from_fn(|m| &block.gains[m]);
        // old[m] is S(k-1-m): read once per block from the previous rows, then passed on in registers.
        let mut old = [[V::splat(0.0); COUNT]; NA];
        for (m, old) in old.iter_mut().enumerate() {
            let row = &self.rows[(NA - 1 - m) * width..];
            for (old, column) in old.iter_mut().zip(&plan) {
                *old = V::first(&row[column.at..]);
            }
        }
        for k in 0..count.min(BLOCK) {
            let (past, row) = self.rows.split_at_mut((na + k) * width);
            for (c, column) in plan.iter().enumerate() {
                // S(k) = source scale + sum_m gain_m S(k-m), the oldest first: gain_1 S(k-1), for which the next sample
                // waits, is the last product of the chain.
                let mut value = V::load(&sources[c][k].0).mul(V::splat(scales[c][k]));
                // Any number of past outputs: their rows are read back from memory.
                if NA == 0 {
                    for (gains, old) in block.gains.iter().zip(past.rchunks_exact(width)) {
                        value = value.add_product(V::splat(gains[k]), V::first(&old[column.at..]));
                    }
                }
                for m in (0..NA).rev() {
                    value = value.add_product(V::splat(gains[m][k]), old[m][c]);
                }
                for m in (1..NA).rev() {
                    old[m][c] = old[m - 1][c];
                }
                if NA > 0 {
                    old[0][c] = value;
                }
                // Unaligned, as kinds of units follow each other without gaps: the row stays short, and the cost of J'J
                // grows with its square.
                value.write(&mut row[column.at..]);
            }
        }
        COUNT
    }
}

/// `w2 (1 - h^2)`.
#[inline(always)]
fn steep<V: F64x8>(second: V, h: V) -> V {
    second.mul(V::splat(1.0).sub(h.mul(h)))
}
