//! The Python module `sewfast._core`: convert, release the interpreter, call, convert back.

mod arrays;
mod control;
mod device;
mod greybox;
mod host_loop;
mod least_squares;
mod link;
mod loop_transfer;
mod machine;
mod models;
mod search;
mod signals;
mod watch;

use pyo3::prelude::*;
use sewfast_core::simd;

#[pymodule(gil_used = false)]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let level = simd::level().map_err(|error| arrays::raise(module.py(), error))?;
    module.add("cpu", level.name())?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    search::register(module)?;
    signals::register(module)?;
    machine::register(module)?;
    host_loop::register(module)?;
    models::register(module)?;
    greybox::register(module)?;
    least_squares::register(module)?;
    control::register(module)?;
    loop_transfer::register(module)?;
    link::register(module)?;
    device::register(module)
}
