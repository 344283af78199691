//! How the time of deformable sampling grows with queries and views, forward and with gradients, on the CPU backend.
//!
//! `cargo bench -p rigscape -p ops --bench scaling`; `benches/peer/scaling.py` runs it and draws `benches/pictures/sampling_scale.png`.

use burn::tensor::{Device, Distribution, Tensor};
use divan::Bencher;

fn main() {
    // As every program of this workspace that computes on a CPU.
    ops::keep_freed_memory();
    divan::main();
}

/// Queries of the curve over views, and views of that over queries.
const QUERIES: usize = 4096;
const VIEWS: usize = 6;

#[divan::bench(args = [1024, 2048, 4096, 8192, 16384, 32768], min_time = 0.3, max_time = 2)]
fn queries_forward(bencher: Bencher, queries: usize) {
    sample(bencher, VIEWS, queries, Device::flex());
}

#[divan::bench(args = [1024, 2048, 4096, 8192, 16384, 32768], min_time = 0.3, max_time = 2)]
fn queries_both(bencher: Bencher, queries: usize) {
    sample(bencher, VIEWS, queries, Device::flex().autodiff());
}

#[divan::bench(args = [1, 2, 4, 6, 8, 12], min_time = 0.3, max_time = 2)]
fn views_forward(bencher: Bencher, views: usize) {
    sample(bencher, views, QUERIES, Device::flex());
}

#[divan::bench(args = [1, 2, 4, 6, 8, 12], min_time = 0.3, max_time = 2)]
fn views_both(bencher: Bencher, views: usize) {
    sample(bencher, views, QUERIES, Device::flex().autodiff());
}

/// Three levels, three heads of eight channels, three points; every view sees every query.
fn sample(bencher: Bencher, views: usize, queries: usize, device: Device) {
    device.seed(7);
    let uniform = Distribution::Uniform(0.0, 1.0);
    let shapes = [[32, 32], [16, 16], [8, 8]];
    let values = Tensor::<5>::random([1, views, 1344, 3, 8], uniform, &device);
    let reference = Tensor::<4>::random([1, views, queries, 2], uniform, &device);
    let visible = Tensor::<3>::zeros([1, views, queries], &device).equal_elem(0.0);
    let offsets = Tensor::<6>::random([1, queries, 3, 3, 3, 2], uniform, &device);
    let weights = Tensor::<5>::random([1, queries, 3, 3, 3], uniform, &device);
    bencher.bench_local(|| {
        let (values, reference, visible) = (values.clone(), reference.clone(), visible.clone());
        let (offsets, weights) = (offsets.clone(), weights.clone());
        if device.is_autodiff() {
            let leaves = (values.require_grad(), offsets.require_grad(), weights.require_grad());
            drop(ops::deformable_views_2d(leaves.0, &shapes, reference, visible, leaves.1, leaves.2).backward());
        } else {
            drop(ops::deformable_views_2d(values, &shapes, reference, visible, offsets, weights));
        }
    });
}
