//! The neural state-space model: linear state equations beside one hidden layer (M. Schoukens, arXiv 2103.14516).

mod draw;
mod free_run;
mod friction;
mod integrated;
mod kalman;
mod network;
mod output;
mod problem;
mod records;
mod referee;
mod sensitivities;
mod shape;
mod single;
mod state;
mod train;

pub use free_run::Stepper;
pub use output::OutputFunction;
pub use shape::{Scaling, Shape};
pub use state::Statistics;
pub use train::{NeuralSSFit, Settings, fit};

use free_run::Trajectory;
use kalman::Filter;
use network::{Network, Scratch};
use sensitivities::{Columns, Recursion, Rows, Sensitivities};

use crate::closed_loop::StatePlant;
use crate::embedded::Embedded;
use crate::guard::Guarded;
use crate::lagged::{check_measured, check_predicted, finite};
use crate::linearised::Linearised;
use crate::model::{ClonePlant, Model, RunAndRows};
use crate::{Error, Monitor, Result, simd};

/// `x+ = A x + B v + E h`, `y = f(C x + D v + c + G h)` with `h = tanh(Wx x + Wu v + bh)`, in scaled units
/// (docs/CONVENTIONS.md).
#[derive(Clone, Debug)]
pub struct NeuralSS {
    theta: Vec<f64>,
    scaling: Scaling,
    statistics: Statistics,
    network: Network,
}

impl NeuralSS {
    /// A model from its parameters.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a wrong number of parameters or scales, values that are not finite, or an integrator
    /// whose held parameters have other values.
    pub fn new(
        shape: Shape,
        output: OutputFunction,
        theta: Vec<f64>,
        scaling: Scaling,
        statistics: Statistics,
    ) -> Result<Self> {
        let shape = shape.checked()?;
        if theta.len() != shape.parameters() {
            return Err(Error::setting(format!(
                "expected {} parameters for this shape, got {}; theta is A, B, E, Wx, Wu, bh, C, D, c, G, each row by row",
                shape.parameters(),
                theta.len()
            )));
        }
        if theta.iter().any(|v| !v.is_finite()) {
            return Err(Error::setting(
                "expected finite parameters, got NaN or infinity; train the model again",
            ));
        }
        if let Some((i, value)) = shape
            .held()
            .into_iter()
            .find(|&(i, value)| theta[i] != value)
        {
            return Err(Error::setting(format!(
                "expected {value} for theta[{i}], which the integrator holds, got {}; set it so or leave the integrator out",
                theta[i]
            )));
        }
        scaling.check(shape.inputs)?;
        statistics.check(shape)?;
        let network = Network::new(shape, output, &theta);
        Ok(Self {
            theta,
            scaling,
            statistics,
            network,
        })
    }

    /// Parameters, in the order of docs/CONVENTIONS.md.
    pub fn theta(&self) -> &[f64] {
        &self.theta
    }

    /// Sizes.
    pub fn shape(&self) -> Shape {
        self.network.shape
    }

    /// The output function.
    pub fn output(&self) -> OutputFunction {
        self.network.output
    }

    /// Scaling of inputs and outputs.
    pub fn scaling(&self) -> &Scaling {
        &self.scaling
    }

    /// Statistics of states and residuals from training.
    pub fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// The same model with each step shortened to `1/factor` of itself: the steady states stay, and transients take
    /// `factor` times as long.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a factor that is not above 0 and finite.
    pub fn slowed(&self, factor: f64) -> Result<Self> {
        if !(factor > 0.0 && factor.is_finite()) {
            return Err(Error::setting(format!(
                "expected a finite factor above 0 for the time constants, got {factor}; 2 is half as fast"
            )));
        }
        let (nx, parts) = (self.shape().nx, self.shape().parts());
        let mut theta = self.theta.clone();
        for (i, a) in theta[parts.a].iter_mut().enumerate() {
            let stay = f64::from(u8::from(i % (nx + 1) == 0));
            *a = stay + (*a - stay) / factor;
        }
        theta[parts.b.start..parts.e.end]
            .iter_mut()
            .for_each(|t| *t /= factor);
        let (scaling, statistics) = (self.scaling.clone(), self.statistics.clone());
        Self::new(self.shape(), self.output(), theta, scaling, statistics)
    }

    /// The states of the free run, time first, in scaled units.
    ///
    /// # Errors
    /// As [`Model::simulate`].
    pub fn states(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<Vec<f64>> {
        let run = self.run(u, channels, state, &Monitor::default())?;
        finite(run.states)
    }

    fn run(
        &self,
        u: &[f64],
        channels: usize,
        state: &[f64],
        monitor: &Monitor,
    ) -> Result<Trajectory> {
        let samples = self.check(u, channels, state)?;
        let mut run = Trajectory::new(&self.network, samples);
        let v = self.scaling.delayed_inputs(u, self.shape().nk);
        let mut scratch = Scratch::new(self.shape());
        self.free(&v, state, &mut run, &mut scratch, monitor)?;
        Ok(run)
    }

    fn free(
        &self,
        v: &[f64],
        state: &[f64],
        run: &mut Trajectory,
        scratch: &mut Scratch,
        monitor: &Monitor,
    ) -> Result<()> {
        let found = free_run::alone(&self.network, v, state, run, scratch, monitor);
        found.then_some(()).ok_or_else(|| {
            Error::fit("expected a finite simulation, got states beyond all bounds; the model is unstable on this input: identify it again with other orders or more data")
        })
    }

    fn restored(&self, sums: &[f64]) -> Vec<f64> {
        let restored = |s: &f64| self.scaling.restored(self.network.output.value(*s));
        sums.iter().map(restored).collect()
    }

    /// Number of samples in `u`, after all shapes have been checked.
    fn check(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<usize> {
        let shape = self.shape();
        if channels != shape.inputs {
            return Err(Error::data(format!(
                "expected u of shape (N, {}), got (N, {channels}); give the inputs the model was made with, time first",
                shape.inputs
            )));
        }
        if state.len() != shape.nx {
            return Err(Error::data(format!(
                "expected {} states, got {}; use rest_state or estimate_initial_state",
                shape.nx,
                state.len()
            )));
        }
        if u.iter().chain(state).any(|v| !v.is_finite()) {
            return Err(Error::data(
                "expected finite inputs and states, got NaN or infinity; cut or repair that part of the recording",
            ));
        }
        Ok(u.len() / channels)
    }
}

impl Model for NeuralSS {
    fn theta(&self) -> Vec<f64> {
        self.theta.clone()
    }

    /// The state at which the model rests at input zero, in scaled units: least `|x+ - x|^2 + |y|^2`.
    fn rest_state(&self) -> Vec<f64> {
        let inputs = 0..self.shape().inputs;
        let v: Vec<f64> = inputs.map(|j| self.scaling.input(j, 0.0)).collect();
        state::rest(
            &self.network,
            &self.statistics,
            &v,
            self.scaling.output(0.0),
        )
    }

    /// Free run in the data's units, time first.
    fn simulate(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<Vec<f64>> {
        let run = self.run(u, channels, state, &Monitor::default())?;
        finite(self.restored(&run.sums))
    }

    /// The output `horizon` steps ahead: an extended Kalman filter follows the measured outputs up to sample
    /// `k - horizon`, then the model runs free. Outputs that are NaN are not used.
    fn predict(
        &self,
        u: &[f64],
        channels: usize,
        y: &[f64],
        state: &[f64],
        horizon: usize,
    ) -> Result<Vec<f64>> {
        let shape = self.shape();
        let samples = self.check(u, channels, state)?;
        check_predicted(y, samples, horizon)?;
        // the first samples have too few known outputs before them and run free from the state
        let first = horizon.min(samples);
        let mut run = self.simulate(&u[..first * channels], channels, state)?;
        let v = self.scaling.delayed_inputs(u, shape.nk);
        let mut filtered = Vec::with_capacity(samples * shape.nx);
        simd::run(Filter {
            network: &self.network,
            prior: &self.statistics,
            process: self.statistics.process_noise,
            state,
            v: &v,
            y: &self.scaling.outputs(y),
            each: |_: usize, _: f64, x: &[f64]| filtered.extend_from_slice(x),
        });
        // no longer than the record, even for a longer horizon
        let mut trajectory = Trajectory::new(&self.network, first + 1);
        let mut scratch = Scratch::new(shape);
        for k in first..samples {
            let state = &filtered[(k - horizon) * shape.nx..][..shape.nx];
            self.free(
                &v[(k - horizon) * channels..(k + 1) * channels],
                state,
                &mut trajectory,
                &mut scratch,
                &Monitor::default(),
            )?;
            run.extend(self.restored(&trajectory.sums[horizon..]));
        }
        finite(run)
    }

    /// The most likely state at the first sample, given these samples (docs/CONVENTIONS.md), in scaled units. Outputs
    /// that are NaN do not count.
    fn estimate_state(&self, u: &[f64], channels: usize, y: &[f64]) -> Result<Vec<f64>> {
        let samples = self.check(u, channels, &vec![0.0; self.shape().nx])?;
        check_measured(y, samples)?;
        if samples == 0 {
            return Err(Error::data(
                "expected samples to estimate the initial state from, got none; give 20 or so",
            ));
        }
        let v = self.scaling.delayed_inputs(u, self.shape().nk);
        let y = self.scaling.outputs(y);
        let rest = [self.rest_state()];
        state::estimate(&self.network, &self.statistics, &v, &y, &rest).ok_or_else(|| {
            Error::fit("expected an initial state with a finite free run, found none; the model is unstable on this record")
        })
    }

    /// Free run in the data's units, and its derivatives row by row: with respect to theta, then to the state.
    fn jacobian(&self, u: &[f64], channels: usize, state: &[f64]) -> Result<RunAndRows> {
        let shape = self.shape();
        let monitor = Monitor::default();
        let trajectory = self.run(u, channels, state, &monitor)?;
        let run = finite(self.restored(&trajectory.sums))?;
        let columns = Columns::new(shape);
        let states = (0..shape.nx).map(|j| columns.state + j);
        let mut dense = Dense {
            columns: columns.of_theta().into_iter().chain(states).collect(),
            block: vec![0.0; columns.room * single::BLOCK],
            room: columns.room,
            rows: Vec::with_capacity(run.len() * (self.theta.len() + shape.nx)),
            scale: self.scaling.y_scale,
        };
        let known = vec![0.0; run.len()];
        simd::run(Recursion {
            network: &self.network,
            run: &trajectory,
            v: &self.scaling.delayed_inputs(u, shape.nk),
            y: &known,
            weights: &[],
            buffers: &mut Sensitivities::new(shape),
            rows: &mut dense,
            exact: true,
            monitor: &monitor,
        });
        Ok((run, dense.rows))
    }

    fn linearise(&self, u: &[f64], state: &[f64]) -> Result<Linearised> {
        NeuralSS::linearise(self, u, state)
    }

    fn plant(&self, ts: f64) -> Result<Box<dyn ClonePlant + '_>> {
        Ok(Box::new(StatePlant::new(self, ts)?))
    }

    fn embedded(&self, _scaled: bool) -> Result<Embedded> {
        Ok(NeuralSS::embedded(self))
    }
}

/// How far test states lie from the mean of the training states, in standard deviations.
const BESIDE: f64 = 3.0;

impl Guarded for NeuralSS {
    fn inputs(&self) -> usize {
        self.shape().inputs
    }

    fn first_state(&self, u: &[f64], y: &[f64]) -> Result<Vec<f64>> {
        self.estimate_state(u, self.shape().inputs, y)
    }

    fn free_run(&self, u: &[f64], state: &[f64], monitor: &Monitor) -> Result<Vec<f64>> {
        let run = self.run(u, self.shape().inputs, state, monitor)?;
        finite(self.restored(&run.sums))
    }

    fn states_beside(&self, _: f64, _: f64) -> [Vec<f64>; 2] {
        let Statistics {
            state_mean,
            state_covariance,
            ..
        } = &self.statistics;
        let variances = state_covariance.iter().step_by(state_mean.len() + 1);
        [BESIDE, -BESIDE].map(|far| {
            let pairs = state_mean.iter().zip(variances.clone());
            pairs.map(|(mean, var)| mean + far * var.sqrt()).collect()
        })
    }

    fn integrates(&self) -> bool {
        self.shape().integrator
    }

    fn is_rectified(&self) -> bool {
        matches!(self.output(), OutputFunction::Abs { .. })
    }
}

/// Rows in the data's units, in the order of theta.
struct Dense {
    columns: Vec<usize>,
    /// Rows that have not been kept yet.
    block: Vec<f64>,
    room: usize,
    rows: Vec<f64>,
    scale: f64,
}

impl Rows for Dense {
    fn width(&self) -> usize {
        self.room
    }

    fn room(&mut self, count: usize) -> &mut [f64] {
        &mut self.block[..count * self.room]
    }

    fn keep(&mut self, count: usize) {
        let rows = self.block.chunks_exact(self.room).take(count);
        for row in rows {
            let scaled = self.columns.iter().map(|&c| row[c] * self.scale);
            self.rows.extend(scaled);
        }
    }
}

#[cfg(test)]
mod tests;
