//! Exact derivatives of the free run by the forward recursion, eight columns at a time.
//!
//! `d yhat(k)/d theta = d f/d theta + sum_m (d f/d phi_m) d yhat(k-m)/d theta`, zero where the output is clipped.

use super::free_run::LOOK;
use super::network::Network;
use crate::Monitor;
use crate::gram::Gram;
use crate::lagged::push_past;
use crate::simd::{self, Eight, Group, Kernel, LANES};

/// What takes the rows and holds the ones before.
pub(super) trait Rows {
    /// The last `na` rows, the oldest first, and room for the next one.
    fn place(&mut self) -> (&[f64], &mut [f64]);
    /// The next row has been written; its error is NaN where the output was not measured.
    fn keep(&mut self, error: f64);
}

impl Rows for Gram {
    #[inline(always)]
    fn place(&mut self) -> (&[f64], &mut [f64]) {
        Gram::place(self)
    }

    #[inline(always)]
    fn keep(&mut self, error: f64) {
        Gram::keep_weighed(self, error);
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
    /// What the free run left behind; without hidden outputs the slopes are computed to their last digits.
    pub run: &'a [f64],
    pub hidden: Option<&'a [Group]>,
    /// Measured outputs of the simulated samples.
    pub y: &'a [f64],
    pub rows: &'a mut R,
    pub monitor: Option<&'a Monitor>,
}

impl<R: Rows> Recursion<'_, R> {
    /// Runs it.
    pub fn go(self) {
        simd::run(self);
    }
}

/// What all columns of a row have in common.
struct Sample {
    phi: Vec<f64>,
    hidden: Vec<Group>,
    /// Slopes of the output by each hidden unit's argument.
    slopes: Vec<Group>,
    /// Slopes of the output by each past output.
    gains: Vec<f64>,
    /// `[1, linear's regressor, 0 ..]`: the row's own part behind the hidden units.
    tail: Vec<f64>,
}

impl<R: Rows> Kernel for Recursion<'_, R> {
    type Output = ();

    #[inline(always)]
    fn run<V: Eight>(self) {
        match self.network.shape.lags.na {
            1 => self.samples::<V, 1>(),
            2 => self.samples::<V, 2>(),
            _ => self.samples::<V, 0>(),
        }
    }
}

impl<R: Rows> Recursion<'_, R> {
    /// `NA` past outputs; 0 stands for any number.
    #[inline(always)]
    fn samples<V: Eight, const NA: usize>(self) {
        let shape = self.network.shape;
        let (lags, groups) = (shape.lags, shape.groups());
        let mut sample = Sample {
            phi: vec![0.0; lags.regressors()],
            hidden: vec![Group::ZERO; groups],
            slopes: vec![Group::ZERO; groups],
            gains: vec![0.0; lags.na],
            tail: vec![0.0; (shape.error_column() + 1 - shape.tail()).next_multiple_of(LANES)],
        };
        sample.tail[0] = 1.0;
        sample.phi[..lags.na].copy_from_slice(self.state);
        for (i, (&y, &measured)) in self.run.iter().zip(self.y).enumerate() {
            if i % LOOK == 0 && self.monitor.is_some_and(Monitor::stopped) {
                return;
            }
            lags.write_inputs(self.u, self.first + i, &mut sample.phi[lags.na..]);
            let error = measured - y;
            let (past, row) = self.rows.place();
            if self.network.is_clipped(y) {
                row.fill(0.0);
            } else {
                let hidden = self.hidden.map(|all| &all[i * groups..][..groups]);
                sample.slope::<V>(self.network, hidden);
                sample.write::<V, NA>(self.network, hidden, past, row);
            }
            row[shape.error_column()] = error;
            self.rows.keep(error);
            push_past(&mut sample.phi[..lags.na], y);
        }
    }
}

impl Sample {
    /// The slopes, from stored hidden outputs or else to their last digits.
    ///
    /// What `1 - h^2` loses where a unit saturates is far below what a sum of squares shows.
    #[inline(always)]
    fn slope<V: Eight>(&mut self, network: &Network, hidden: Option<&[Group]>) {
        let n_phi = self.phi.len();
        let na = self.gains.len();
        self.gains.copy_from_slice(&network.linear[..na]);
        for (group, (slope, second)) in self.slopes.iter_mut().zip(&network.second).enumerate() {
            let rise = match hidden {
                Some(hidden) => {
                    let h = V::load(&hidden[group].0);
                    V::splat(1.0).sub(h.mul(h))
                }
                None => network.rise::<V>(group, &self.phi),
            };
            let steep = V::load(&second.0).mul(rise);
            steep.store(&mut slope.0);
            let weights = &network.first[group * n_phi..][..na];
            for (gain, w) in self.gains.iter_mut().zip(weights) {
                *gain += steep.mul(V::load(&w.0)).sum();
            }
        }
        if hidden.is_none() {
            let all = &mut self.hidden;
            network.step::<V>(self.phi[0], &self.phi, |group, h| {
                h.store(&mut all[group].0)
            });
        }
    }

    /// The row: the sample's own slopes, and what the past outputs pass on.
    #[inline(always)]
    fn write<V: Eight, const NA: usize>(
        &mut self,
        network: &Network,
        hidden: Option<&[Group]>,
        past: &[f64],
        row: &mut [f64],
    ) {
        let Self {
            phi,
            slopes,
            gains,
            tail,
            ..
        } = self;
        let (n_phi, units) = (phi.len(), network.shape.hidden);
        let onward = Onward::<V, NA> {
            gain: std::array::from_fn(|m| V::splat(gains[m])),
            gains,
            past,
        };
        for (c, value) in phi.iter().enumerate() {
            let value = V::splat(*value);
            for (group, slope) in slopes.iter().enumerate() {
                onward.write(row, c * units + group * LANES, V::load(&slope.0).mul(value));
            }
        }
        for (group, slope) in slopes.iter().enumerate() {
            onward.write(row, n_phi * units + group * LANES, V::load(&slope.0));
        }
        for (group, h) in hidden.unwrap_or(&self.hidden).iter().enumerate() {
            onward.write(row, (n_phi + 1) * units + group * LANES, V::load(&h.0));
        }
        if network.shape.bypass {
            tail[1..1 + n_phi].copy_from_slice(phi);
        }
        for (group, own) in tail.chunks_exact(LANES).enumerate() {
            onward.write(row, network.shape.tail() + group * LANES, V::first(own));
        }
    }
}

/// What the past outputs pass on, by their slopes; `NA` of them, where 0 stands for any number.
struct Onward<'a, V, const NA: usize> {
    gain: [V; NA],
    gains: &'a [f64],
    past: &'a [f64],
}

impl<V: Eight, const NA: usize> Onward<'_, V, NA> {
    /// Writes eight columns of the row from `at` on.
    #[inline(always)]
    fn write(&self, row: &mut [f64], at: usize, own: V) {
        let mut value = own;
        let width = row.len();
        if NA == 0 {
            for (gain, old) in self.gains.iter().zip(self.past.rchunks_exact(width)) {
                value = value.add_product(V::splat(*gain), V::first(&old[at..]));
            }
        } else {
            for (m, gain) in self.gain.iter().enumerate() {
                let old = &self.past[(NA - 1 - m) * width + at..];
                value = value.add_product(*gain, V::first(old));
            }
        }
        value.write(&mut row[at..]);
    }
}
