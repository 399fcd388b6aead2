//! The Python module `sewfast._core`: convert, release the interpreter, call, convert back.

mod causes;
mod control;
mod device;
mod estimation;
mod evidence;
mod frequency;
mod greybox;
mod guard;
mod host_loop;
mod link;
mod loop_transfer;
mod models;
mod seam;
mod search;
mod signals;

use pyo3::prelude::*;
use sewfast_core::simd;

#[pymodule(gil_used = false)]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let level = simd::level().map_err(|error| seam::raise(module.py(), error))?;
    module.add("cpu", level.name())?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    search::register(module)?;
    signals::register(module)?;
    host_loop::register(module)?;
    models::register(module)?;
    greybox::register(module)?;
    estimation::register(module)?;
    control::register(module)?;
    loop_transfer::register(module)?;
    frequency::register(module)?;
    link::register(module)?;
    evidence::register(module)?;
    causes::register(module)?;
    guard::register(module)?;
    device::register(module)
}
