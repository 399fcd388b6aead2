//! Every kernel of the core by itself, on the level named by `SEWFAST_CPU`.

#[path = "../../core/examples/kernels/work.rs"]
mod work;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};

fn kernels(criterion: &mut Criterion) {
    let level = sewfast_core::simd::level().map_or("unknown", |level| level.name());
    let mut group = criterion.benchmark_group(level);
    group.sample_size(20);
    for kernel in work::KERNELS {
        let mut call = (kernel.prepare)();
        group.throughput(Throughput::Elements(kernel.samples as u64));
        group.bench_function(kernel.name, |bencher| bencher.iter(&mut call));
    }
    group.finish();
}

criterion_group!(benches, kernels);
criterion_main!(benches);
