//! One kernel, prepared and then called in [`measured`], whose instructions `benches/counts.py` counts.
//!
//! `cargo run --release -p sewfast-core --example kernels` lists the kernels with their samples by call.

mod work;

use std::process::ExitCode;

/// The counted call; not inlined, so that a profiler finds it by name.
#[inline(never)]
fn measured(call: &mut dyn FnMut()) {
    call();
}

fn main() -> ExitCode {
    let Some(name) = std::env::args().nth(1) else {
        for kernel in work::KERNELS {
            println!("{} {}", kernel.name, kernel.samples);
        }
        return ExitCode::SUCCESS;
    };
    let Some(kernel) = work::KERNELS.iter().find(|kernel| kernel.name == name) else {
        eprintln!("expected the name of a kernel, got {name}; without a name they are listed");
        return ExitCode::FAILURE;
    };
    let mut call = (kernel.prepare)();
    // warm-up: tables, the processor's level and memory pages exist before anything is counted
    call();
    measured(&mut call);
    ExitCode::SUCCESS
}
