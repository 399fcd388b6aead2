//! Bindings of what is seen in a record without a model.

use pyo3::prelude::*;
use sewfast_core::changes::{self, Experiment};

use crate::seam::{Experiments, rows, slice, watched};

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(changed, module)?)
}

/// Experiment, sample, gain, shift, and the share of the error that is left.
type Change = (usize, usize, f64, isize, f64);

#[pyfunction]
fn changed(py: Python<'_>, experiments: Experiments<'_>) -> PyResult<Option<Change>> {
    let mut channels = 1;
    let borrowed = experiments.iter().map(|e| {
        let (u, width) = rows(&e.u, "u")?;
        channels = width;
        Ok(Experiment {
            u,
            y: slice(&e.y, "y")?,
        })
    });
    let borrowed = borrowed.collect::<PyResult<Vec<_>>>()?;
    let found = watched(py, None, |monitor| {
        changes::changed(&borrowed, channels, monitor)
    })?;
    Ok(found.map(|c| (c.experiment, c.start, c.gain, c.shift, c.left)))
}
