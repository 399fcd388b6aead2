//! The free run of a network in scaled units.

use super::network::Network;
use crate::Monitor;
use crate::simd::{self, Eight, Group, Kernel};

/// Samples between two looks at the monitor.
pub(super) const LOOK: usize = 4096;

/// A free run over scaled inputs; what it leaves behind goes where its caller says.
pub(super) struct FreeRun<'a> {
    pub network: &'a Network,
    /// Inputs of the whole experiment.
    pub u: &'a [f64],
    /// The first sample that is simulated.
    pub first: usize,
    /// Past outputs before it, newest first.
    pub state: &'a [f64],
    /// Outputs, one for each sample simulated.
    pub run: &'a mut [f64],
    /// Room for the hidden outputs of all samples, or of none.
    pub hidden: &'a mut [Group],
    /// An output of this size has diverged.
    pub bound: f64,
    /// Asked whether to stop.
    pub monitor: Option<&'a Monitor>,
}

impl FreeRun<'_> {
    /// Runs it; `None` where it diverges or is stopped.
    pub fn go(self) -> Option<()> {
        simd::run(self)
    }
}

impl Kernel for FreeRun<'_> {
    type Output = Option<()>;

    #[inline(always)]
    fn run<V: Eight>(self) -> Option<()> {
        let Self {
            network,
            u,
            first,
            state,
            run,
            hidden,
            bound,
            monitor,
        } = self;
        let lags = network.shape.lags;
        let groups = network.shape.groups();
        let mut phi = vec![0.0; lags.regressors()];
        phi[..lags.na].copy_from_slice(state);
        let mut newest = state[0];
        let mut kept = hidden.chunks_exact_mut(groups);
        for (i, out) in run.iter_mut().enumerate() {
            lags.write_inputs(u, first + i, &mut phi[lags.na..]);
            let y = match kept.next() {
                Some(kept) => network.step::<V>(newest, &phi, |g, h| h.store(&mut kept[g].0)),
                None => network.step::<V>(newest, &phi, |_, _| ()),
            };
            // NaN is no number below the bound either.
            let sound = y.abs() < bound;
            if !sound || (i % LOOK == 0 && monitor.is_some_and(Monitor::stopped)) {
                return None;
            }
            // The newest output stays in its register.
            for m in (2..lags.na).rev() {
                phi[m] = phi[m - 1];
            }
            if lags.na > 1 {
                phi[1] = newest;
            }
            (newest, *out) = (y, y);
        }
        Some(())
    }
}

/// The outputs of `samples` from `first` on; NaN from where on the run leaves the finite numbers.
pub(super) fn outputs(
    network: &Network,
    u: &[f64],
    first: usize,
    state: &[f64],
    samples: usize,
) -> Vec<f64> {
    let mut run = vec![f64::NAN; samples];
    let free = FreeRun {
        network,
        u,
        first,
        state,
        run: &mut run,
        hidden: &mut [],
        bound: f64::INFINITY,
        monitor: None,
    };
    // where it ends early, NaN says so
    let _ = free.go();
    run
}
