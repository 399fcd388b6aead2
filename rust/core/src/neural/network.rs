//! The network in scaled units: weights in blocks of four hidden units, its output and its slopes.

use super::tanh::{from_growth, growth, slope as bend_of};
use crate::gram::Gram;
use crate::lagged::{Lagged, Lags};
use crate::{Error, Result};

/// Hidden units are computed side by side in blocks of this many; missing ones have weights of zero.
pub(super) const LANES: usize = 4;
pub(super) type Block = [f64; LANES];

/// What fixes the length and the order of the parameter vector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Orders.
    pub lags: Lags,
    /// Number of hidden units.
    pub hidden: usize,
    /// Whether the regressor also reaches the output directly.
    pub bypass: bool,
}

/// More hidden units than this are a slip of the pen.
const MOST_HIDDEN: usize = 1_000;

impl Shape {
    /// A shape that makes a network.
    ///
    /// # Errors
    /// `ErrorKind::Setting` unless `hidden` is from 1 to 1,000.
    pub fn new(lags: Lags, hidden: usize, bypass: bool) -> Result<Self> {
        if hidden == 0 || hidden > MOST_HIDDEN {
            return Err(Error::setting(format!(
                "expected 1 to {MOST_HIDDEN} hidden units, got {hidden}; 8 is a good beginning"
            )));
        }
        Ok(Self {
            lags,
            hidden,
            bypass,
        })
    }

    /// Length of theta.
    pub fn parameters(&self) -> usize {
        let direct = if self.bypass {
            self.lags.regressors()
        } else {
            0
        };
        self.hidden * (self.lags.regressors() + 2) + 1 + direct
    }

    /// Where `b1`, `w2`, `b2` and `linear` begin in theta.
    pub(super) fn offsets(&self) -> [usize; 4] {
        let bias = self.hidden * self.lags.regressors();
        let (second, constant) = (bias + self.hidden, bias + 2 * self.hidden);
        [bias, second, constant, constant + 1]
    }

    pub(super) fn blocks(&self) -> usize {
        self.hidden.div_ceil(LANES)
    }

    /// For each entry of theta its column in a sensitivity row. A row holds, for each regressor, then for `b1`, then
    /// for `w2`, all hidden units (padded to whole blocks), then `b2`, `linear`, the past outputs and the error.
    pub(super) fn columns(&self) -> Vec<usize> {
        let (n_phi, padded) = (self.lags.regressors(), self.blocks() * LANES);
        let first = (0..self.hidden).flat_map(|i| (0..n_phi).map(move |c| c * padded + i));
        let bias = (0..self.hidden).map(|i| n_phi * padded + i);
        let second = (0..self.hidden).map(|i| (n_phi + 1) * padded + i);
        let tail = self.tail();
        let rest = self.parameters() - self.offsets()[2];
        first
            .chain(bias)
            .chain(second)
            .chain((0..rest).map(|i| tail + i))
            .collect()
    }

    /// Column of `b2`.
    pub(super) fn tail(&self) -> usize {
        (self.lags.regressors() + 2) * self.blocks() * LANES
    }

    /// Column of the first past output.
    pub(super) fn state_column(&self) -> usize {
        self.tail() + self.parameters() - self.offsets()[2]
    }

    /// A buffer for sensitivity rows of this shape.
    pub(super) fn gram(&self) -> Gram {
        Gram::new(self.state_column() + self.lags.na + 1, self.lags.na)
    }
}

/// The weights laid out for the kernels, and the limits of the output.
#[derive(Clone, Debug)]
pub struct Network {
    /// Shape.
    pub shape: Shape,
    /// Lowest and highest output, infinite where it does not saturate.
    pub limits: (f64, f64),
    first: Vec<Block>,
    bias: Vec<Block>,
    second: Vec<Block>,
    constant: f64,
    linear: Vec<f64>,
}

impl Network {
    /// A network with all weights zero.
    pub fn zero(shape: Shape, limits: (f64, f64)) -> Self {
        let (blocks, n_phi) = (shape.blocks(), shape.lags.regressors());
        Self {
            shape,
            limits,
            first: vec![[0.0; LANES]; blocks * n_phi],
            bias: vec![[0.0; LANES]; blocks],
            second: vec![[0.0; LANES]; blocks],
            constant: 0.0,
            linear: vec![0.0; n_phi],
        }
    }

    /// Takes the weights from `theta`, which has `shape.parameters()` values.
    pub fn load(&mut self, theta: &[f64]) {
        let n_phi = self.shape.lags.regressors();
        let [bias, second, constant, linear] = self.shape.offsets();
        for i in 0..self.shape.hidden {
            let (block, lane) = (i / LANES, i % LANES);
            for c in 0..n_phi {
                self.first[block * n_phi + c][lane] = theta[i * n_phi + c];
            }
            self.bias[block][lane] = theta[bias + i];
            self.second[block][lane] = theta[second + i];
        }
        self.constant = theta[constant];
        if self.shape.bypass {
            self.linear.copy_from_slice(&theta[linear..linear + n_phi]);
        }
    }

    /// The output for the regressor `phi(c)`; `hidden(block, h, m)` receives the hidden outputs and what their slopes
    /// follow from.
    #[inline(always)]
    pub(super) fn forward(
        &self,
        phi: impl Fn(usize) -> f64,
        mut hidden: impl FnMut(usize, &Block, &Block),
    ) -> f64 {
        let n_phi = self.linear.len();
        let mut sum = [0.0; LANES];
        for (block, first) in self.first.chunks_exact(n_phi).enumerate() {
            let mut z = self.bias[block];
            // The newest output comes last: everything else is ready before it is known.
            for c in (0..n_phi).rev() {
                let value = phi(c);
                for (z, w) in z.iter_mut().zip(&first[c]) {
                    *z += w * value;
                }
            }
            let m = z.map(growth);
            let h: Block = std::array::from_fn(|lane| from_growth(m[lane], z[lane]));
            for ((sum, w), h) in sum.iter_mut().zip(&self.second[block]).zip(&h) {
                *sum += w * h;
            }
            hidden(block, &h, &m);
        }
        let mut direct = self.constant;
        if self.shape.bypass {
            direct = self
                .linear
                .iter()
                .enumerate()
                .rev()
                .fold(direct, |d, (c, w)| d + w * phi(c));
        }
        let output = direct + ((sum[0] + sum[2]) + (sum[1] + sum[3]));
        output.clamp(self.limits.0, self.limits.1)
    }

    /// True where the output lies on a limit, and so has no slope.
    pub(super) fn is_clipped(&self, output: f64) -> bool {
        output <= self.limits.0 || output >= self.limits.1
    }

    /// Slopes of the output by each hidden unit's argument, and by each past output into `gains`.
    #[inline(always)]
    fn slopes(&self, bends: impl Fn(usize) -> Block, slopes: &mut [Block], gains: &mut [f64]) {
        let n_phi = self.linear.len();
        gains.copy_from_slice(&self.linear[..gains.len()]);
        for (block, (slope, (second, first))) in slopes
            .iter_mut()
            .zip(self.second.iter().zip(self.first.chunks_exact(n_phi)))
            .enumerate()
        {
            let bend = bends(block);
            for lane in 0..LANES {
                slope[lane] = second[lane] * bend[lane];
            }
            for (gain, w) in gains.iter_mut().zip(first) {
                let part: Block = std::array::from_fn(|lane| slope[lane] * w[lane]);
                *gain += (part[0] + part[2]) + (part[1] + part[3]);
            }
        }
    }

    /// Appends the sensitivity row of a sample to `gram`; its last column holds `error`. `h` are the hidden outputs,
    /// `bends(block)` the derivatives of tanh there.
    ///
    /// `d yhat(k)/d theta = d f/d theta + sum_m (d f/d phi_m) d yhat(k-m)/d theta`, zero where the output is clipped.
    #[inline(always)]
    pub(super) fn push_row(
        &self,
        gram: &mut Gram,
        scratch: &mut Scratch,
        (h, bends): (&[Block], impl Fn(usize) -> Block),
        output: f64,
        error: f64,
    ) {
        let last = self.shape.state_column() + self.shape.lags.na;
        let Scratch { phi, slopes, gains } = scratch;
        if self.is_clipped(output) {
            gains.fill(0.0);
            gram.push(gains, last, error, |row| row.fill(0.0));
            return;
        }
        self.slopes(bends, slopes, gains);
        let (n_phi, padded) = (phi.len(), slopes.len() * LANES);
        gram.push(gains, last, error, |row| {
            let (units, tail) = row.split_at_mut((n_phi + 2) * padded);
            let (regressors, rest) = units.split_at_mut(n_phi * padded);
            for (columns, &value) in regressors.chunks_exact_mut(padded).zip(&*phi) {
                for (column, slope) in columns.iter_mut().zip(slopes.as_flattened()) {
                    *column = slope * value;
                }
            }
            rest[..padded].copy_from_slice(slopes.as_flattened());
            rest[padded..].copy_from_slice(h.as_flattened());
            tail.fill(0.0);
            tail[0] = 1.0;
            if self.shape.bypass {
                tail[1..1 + n_phi].copy_from_slice(phi);
            }
        });
    }
}

/// Buffers of one sample.
#[derive(Clone, Debug)]
pub(super) struct Scratch {
    pub phi: Vec<f64>,
    slopes: Vec<Block>,
    gains: Vec<f64>,
}

impl Scratch {
    pub fn new(shape: Shape) -> Self {
        Self {
            phi: vec![0.0; shape.lags.regressors()],
            slopes: vec![[0.0; LANES]; shape.blocks()],
            gains: vec![0.0; shape.lags.na],
        }
    }
}

impl Lagged for Network {
    fn lags(&self) -> Lags {
        self.shape.lags
    }

    fn output(&self, phi: &[f64]) -> f64 {
        self.forward(|c| phi[c], |_, _, _| ())
    }

    fn output_and_slope(&self, phi: &[f64], slope: &mut [f64]) -> f64 {
        let n_phi = phi.len();
        slope.copy_from_slice(&self.linear[..slope.len()]);
        let output = self.forward(
            |c| phi[c],
            |block, _, m| {
                let bend = m.map(bend_of);
                for (c, slope) in slope.iter_mut().enumerate() {
                    let (w, v) = (&self.first[block * n_phi + c], &self.second[block]);
                    *slope += (0..LANES).map(|i| v[i] * bend[i] * w[i]).sum::<f64>();
                }
            },
        );
        if self.is_clipped(output) {
            slope.fill(0.0);
        }
        output
    }
}
