//! Milliseconds of the operations at the sizes of the BEV-VAE preset `tiny`, fused kernel against composition.
//!
//! `cargo run --release -p ops --example op_speed`

#![allow(clippy::print_stdout)]

use std::time::Instant;

use burn::tensor::{Bool, Device, Distribution, Tensor, module, ops::ConvOptions};

fn main() {
    let device = Device::flex();
    device.seed(7);
    println!("best of several runs, milliseconds: forward, forward + backward");
    println!("{:<44} {:>9} {:>9} {:>9} {:>9}", "", "fused", "", "composed", "");
    deformable_maps(&device);
    deformable_volumes(&device);
    elementwise(&device);
    norms(&device);
    attentions(&device);
    convolutions(&device);
}

/// Normal values.
fn normal<const D: usize>(shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::random(shape, Distribution::Normal(0.0, 1.0), device)
}

fn uniform<const D: usize>(shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::random(shape, Distribution::Uniform(0.0, 1.0), device)
}

/// The same values as a leaf on the tape.
fn leaf<const D: usize>(x: &Tensor<D>) -> Tensor<D> {
    Tensor::from_data(x.to_data(), &Device::flex().autodiff()).require_grad()
}

/// Least milliseconds of several runs: other load on the machine only ever adds.
fn best(mut body: impl FnMut()) -> f64 {
    body();
    let begin = Instant::now();
    let mut times = Vec::new();
    while times.len() < 3 || (begin.elapsed().as_secs_f64() < 1.0 && times.len() < 50) {
        let start = Instant::now();
        body();
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.into_iter().fold(f64::INFINITY, f64::min)
}

fn row(name: &str, mut forward: impl FnMut(), mut both: impl FnMut()) {
    let fused = [best(&mut forward), best(&mut both)];
    let composed = ops::composed_only(|| [best(&mut forward), best(&mut both)]);
    println!("{name:<44} {:>9.2} {:>9.2} {:>9.2} {:>9.2}", fused[0], fused[1], composed[0], composed[1]);
}

fn mask<const D: usize>(shape: [usize; D], share: f32, device: &Device) -> Tensor<D, Bool> {
    uniform(shape, device).lower_elem(share)
}

fn deformable_maps(device: &Device) {
    let (b, v, q, m, c, l, p) = (2, 7, 4096, 3, 8, 3, 3);
    let shapes = [[32, 32], [16, 16], [8, 8]];
    let sites: usize = shapes.iter().map(|[h, w]| h * w).sum();
    let values = normal([b, v, sites, m, c], device);
    let reference = uniform([b, v, q, 2], device);
    let offsets = normal([b, q, m, l, p, 2], device);
    let weights = uniform([b, q, m, l, p], device);
    for share in [0.2, 1.0] {
        let visible = mask([b, v, q], share, device);
        let sample = |values, offsets, weights| {
            ops::deformable_views_2d(values, &shapes, reference.clone(), visible.clone(), offsets, weights)
        };
        let upstream = normal([b, q, m * c], device);
        let taped_visible = Tensor::<3, Bool>::from_data(visible.to_data(), &Device::flex().autodiff());
        let taped_reference = Tensor::<4>::from_data(reference.to_data(), &Device::flex().autodiff());
        let taped_upstream = Tensor::<3>::from_data(upstream.to_data(), &Device::flex().autodiff());
        let (leaf_values, leaf_offsets, leaf_weights) = (leaf(&values), leaf(&offsets), leaf(&weights));
        row(
            &format!("deformable_views_2d, {:.0} % visible", share * 100.0),
            || drop(sample(values.clone(), offsets.clone(), weights.clone())),
            || {
                let y = ops::deformable_views_2d(
                    leaf_values.clone(),
                    &shapes,
                    taped_reference.clone(),
                    taped_visible.clone(),
                    leaf_offsets.clone(),
                    leaf_weights.clone(),
                );
                (y * taped_upstream.clone()).sum().backward();
            },
        );
    }
}

fn deformable_volumes(device: &Device) {
    let (b, v, r, m, c, l, p) = (2, 7, 1024, 3, 8, 3, 4);
    let shapes = [[4, 32, 32], [2, 16, 16], [1, 8, 8]];
    let sites: usize = shapes.iter().map(|[z, y, x]| z * y * x).sum();
    let taped = Device::flex().autodiff();
    let values = normal([b, sites, m, c], device);
    let reference = uniform([b, v, r, 3], device);
    let offsets = normal([b, v * r, m, l, p, 3], device);
    let weights = uniform([b, v * r, m, l, p], device);
    let valid = mask([b, v, r], 0.7, device);
    let upstream = normal([b, v, r, m * c], &taped);
    let taped_reference = Tensor::<4>::from_data(reference.to_data(), &taped);
    let taped_valid = Tensor::<3, Bool>::from_data(valid.to_data(), &taped);
    let (leaf_values, leaf_offsets, leaf_weights) = (leaf(&values), leaf(&offsets), leaf(&weights));
    row(
        "deformable_rays_3d, 70 % valid",
        || {
            let (reference, valid) = (reference.clone(), valid.clone());
            drop(ops::deformable_rays_3d(values.clone(), &shapes, reference, valid, offsets.clone(), weights.clone()));
        },
        || {
            let (reference, valid) = (taped_reference.clone(), taped_valid.clone());
            let (values, offsets, weights) = (leaf_values.clone(), leaf_offsets.clone(), leaf_weights.clone());
            let y = ops::deformable_rays_3d(values, &shapes, reference, valid, offsets, weights);
            (y * upstream.clone()).sum().backward();
        },
    );
}

/// Rows of an operation of one tensor.
fn unary<const D: usize>(name: &str, x: &Tensor<D>, function: impl Fn(Tensor<D>) -> Tensor<D>) {
    let taped = leaf(x);
    row(name, || drop(function(x.clone())), || drop(function(taped.clone()).sum().backward()));
}

fn elementwise(device: &Device) {
    let x = normal([14 * 64, 512], device);
    unary("gelu [896, 512]", &x, ops::gelu);
    let x = normal([2 * 4096, 96], device);
    unary("gelu [8192, 96]", &x, ops::gelu);
    unary("silu [8192, 96]", &x, ops::silu);
    let x = normal([1536, 3072], device);
    unary("gelu [1536, 3072]", &x, ops::gelu);
    let x = normal([14, 4, 64, 32], device);
    let angles = uniform([1, 64, 16], device);
    unary("rotary [14, 4, 64, 32]", &x, |x| ops::rotary(x, angles.clone().cos(), angles.clone().sin()));
}

fn norms(device: &Device) {
    let x = normal([2, 4096, 3, 9], device);
    unary("softmax [2, 4096, 3, 9]", &x, ops::softmax);
    for (rows, width) in [(8192, 24), (896, 128)] {
        let x = normal([rows, width], device);
        let gain = normal([width], device);
        let (taped_x, taped) = (leaf(&x), leaf(&gain));
        row(
            &format!("layer_norm [{rows}, {width}]"),
            || drop(ops::layer_norm(x.clone(), Some(gain.clone()), None, 1e-6)),
            || drop(ops::layer_norm(taped_x.clone(), Some(taped.clone()), None, 1e-6).sum().backward()),
        );
        row(
            &format!("rms_norm [{rows}, {width}]"),
            || drop(ops::rms_norm(x.clone(), gain.clone(), 1e-6)),
            || drop(ops::rms_norm(taped_x.clone(), taped.clone(), 1e-6).sum().backward()),
        );
    }
    for shape in [[14, 128, 16, 16], [14, 64, 32, 32]] {
        let x = normal(shape, device);
        let (gain, bias) = (normal([shape[1]], device), normal([shape[1]], device));
        let (taped_x, taped_gain, taped_bias) = (leaf(&x), leaf(&gain), leaf(&bias));
        row(
            &format!("group_norm_silu {shape:?}"),
            || drop(ops::group_norm_silu(x.clone(), 8, gain.clone(), bias.clone(), 1e-5)),
            || {
                drop(
                    ops::group_norm_silu(taped_x.clone(), 8, taped_gain.clone(), taped_bias.clone(), 1e-5)
                        .sum()
                        .backward(),
                )
            },
        );
    }
}

fn attentions(device: &Device) {
    for shape in [[13, 4, 64, 32], [2, 4, 64, 24]] {
        let [q, k, v] = [0; 3].map(|_| normal(shape, device));
        row(
            &format!("attention {shape:?}"),
            || drop(ops::attention(q.clone(), k.clone(), v.clone(), None)),
            || drop(ops::attention(leaf(&q), leaf(&k), leaf(&v), None).sum().backward()),
        );
    }
    // Where the composition spends its time.
    let shape = [13, 4, 64, 32];
    let [q, k] = [0; 2].map(|_| normal(shape, device));
    let scores = normal([13, 4, 64, 64], device);
    let product = || drop(q.clone().matmul(k.clone().swap_dims(2, 3)));
    row("  of which q·kᵀ", product, || drop(leaf(&q).matmul(leaf(&k).swap_dims(2, 3)).sum().backward()));
    unary("  of which softmax", &scores, ops::softmax);
}

/// burn's own convolutions: 3×3 at the discriminator's sizes.
fn convolutions(device: &Device) {
    for (inputs, outputs, size, stride) in [
        (16, 16, 64, 1),
        (16, 32, 64, 2),
        (32, 32, 32, 1),
        (32, 64, 32, 2),
        (64, 64, 16, 1),
        (64, 128, 16, 2),
        (64, 64, 64, 1),
    ] {
        let x = normal([13, inputs, size, size], device);
        let weight = normal([outputs, inputs, 3, 3], device);
        let options = || ConvOptions::new([stride, stride], [1, 1], [1, 1], 1);
        let name = format!("stock conv2d 3×3 {inputs}→{outputs} at {size}², stride {stride}");
        let forward = best(|| drop(module::conv2d(x.clone(), weight.clone(), None, options())));
        let both = best(|| drop(module::conv2d(leaf(&x), leaf(&weight), None, options()).sum().backward()));
        println!("{name:<44} {:>9} {:>9} {forward:>9.2} {both:>9.2}", "", "");
    }
}
