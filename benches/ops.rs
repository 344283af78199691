//! Times the operations of `ops` on the CPU backend, forward and forward with gradients.
//!
//! `cargo bench -p rigscape -p ops --bench ops -- [NAME]`; `benches/peer/ops.py` runs it beside PyTorch and prints the ratios.

use burn::tensor::{Bool, Device, Distribution, Tensor};
use divan::Bencher;

fn main() {
    // As every program of this workspace that computes on a CPU.
    ops::keep_freed_memory();
    divan::main();
}

/// An operation at one size.
struct Case {
    name: String,
    /// Draws inputs on a device. The result runs the operation once, and its gradients where the device has a tape.
    prepare: Box<dyn Fn(Inputs) -> Box<dyn Fn()>>,
}

#[divan::bench(args = names(), min_time = 0.5, max_time = 1.5)]
fn forward(bencher: Bencher, name: &str) {
    bench(bencher, name, Device::flex());
}

#[divan::bench(args = names(), min_time = 0.5, max_time = 1.5)]
fn both(bencher: Bencher, name: &str) {
    bench(bencher, name, Device::flex().autodiff());
}

fn bench(bencher: Bencher, name: &str, device: Device) {
    device.seed(7);
    let case = cases().into_iter().find(|case| case.name == name).expect("a name of the list");
    let run = (case.prepare)(Inputs { device });
    bencher.bench_local(run);
}

fn names() -> Vec<String> {
    cases().into_iter().map(|case| case.name).collect()
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    elementwise(&mut cases);
    products(&mut cases);
    convolutions(&mut cases);
    sampling(&mut cases);
    cases
}

/// Draws inputs.
struct Inputs {
    device: Device,
}

impl Inputs {
    fn normal<const D: usize>(&self, shape: [usize; D]) -> Tensor<D> {
        Tensor::random(shape, Distribution::Normal(0.0, 1.0), &self.device)
    }

    fn uniform<const D: usize>(&self, shape: [usize; D]) -> Tensor<D> {
        Tensor::random(shape, Distribution::Uniform(0.0, 1.0), &self.device)
    }

    fn mask<const D: usize>(&self, shape: [usize; D], share: f32) -> Tensor<D, Bool> {
        self.uniform(shape).lower_elem(share)
    }
}

/// Adds a case: `op` draws its inputs and gives a function that applies the operation to them, as leaves where asked.
fn time<const D: usize>(
    cases: &mut Vec<Case>,
    name: &str,
    op: impl Fn(&Inputs) -> Box<dyn Fn(bool) -> Tensor<D>> + 'static,
) {
    let prepare = move |inputs: Inputs| {
        let taped = inputs.device.is_autodiff();
        let run = op(&inputs);
        Box::new(move || {
            let y = run(taped);
            if taped {
                // Starts from an upstream gradient of ones.
                drop(y.backward());
            }
        }) as Box<dyn Fn()>
    };
    cases.push(Case { name: name.to_owned(), prepare: Box::new(prepare) });
}

/// `x` as a leaf where gradients are wanted.
fn leaf<const D: usize>(x: &Tensor<D>, taped: bool) -> Tensor<D> {
    if taped { x.clone().detach().require_grad() } else { x.clone() }
}

fn unary<const D: usize>(c: &mut Vec<Case>, name: &str, shape: [usize; D], op: fn(Tensor<D>) -> Tensor<D>) {
    time(c, &format!("{name} {shape:?}"), move |inputs| {
        let x = inputs.normal(shape);
        Box::new(move |taped| op(leaf(&x, taped)))
    });
}

fn elementwise(c: &mut Vec<Case>) {
    unary(c, "gelu", [1536, 3072], ops::gelu);
    unary(c, "silu", [1536, 3072], ops::silu);
    unary(c, "softmax", [12288, 256], ops::softmax);
    time(c, "layer_norm [6144, 768]", move |inputs| {
        let (x, gain, bias) = (inputs.normal([6144, 768]), inputs.normal([768]), inputs.normal([768]));
        Box::new(move |t| ops::layer_norm(leaf(&x, t), Some(leaf(&gain, t)), Some(leaf(&bias, t)), 1e-6))
    });
    time(c, "rms_norm [6144, 768]", move |inputs| {
        let (x, gain) = (inputs.normal([6144, 768]), inputs.normal([768]));
        Box::new(move |t| ops::rms_norm(leaf(&x, t), leaf(&gain, t), 1e-6))
    });
    time(c, "group_norm_silu [6, 320, 28, 50]", move |inputs| {
        let (x, gain, bias) = (inputs.normal([6, 320, 28, 50]), inputs.normal([320]), inputs.normal([320]));
        Box::new(move |t| ops::group_norm_silu(leaf(&x, t), 32, leaf(&gain, t), leaf(&bias, t), 1e-5))
    });
}

fn products(c: &mut Vec<Case>) {
    for (rows, d_in, d_out) in [(416, 128, 512), (8192, 24, 96), (6144, 768, 3072)] {
        time(c, &format!("linear [{rows}, {d_in}] to {d_out}"), move |inputs| {
            let (x, weight) = (inputs.normal([rows, d_in]), inputs.normal([d_out, d_in]));
            let bias = inputs.normal([d_out]);
            Box::new(move |t| ops::linear(leaf(&x, t), leaf(&weight, t), Some(leaf(&bias, t))))
        });
    }
    for [b, h, n, d] in [[13, 4, 64, 32], [2, 12, 1024, 64], [1, 1, 4096, 64]] {
        time(c, &format!("attention [{b}, {h}, {n}, {d}]"), move |inputs| {
            let [q, k, v] = [0; 3].map(|_| inputs.normal([b, h, n, d]));
            Box::new(move |t| ops::attention(leaf(&q, t), leaf(&k, t), leaf(&v, t), None))
        });
    }
}

fn convolutions(c: &mut Vec<Case>) {
    for (b, c_in, c_out, size, stride) in
        [(13, 24, 24, 32, 1), (6, 96, 96, 64, 1), (2, 320, 320, 32, 1), (13, 16, 32, 64, 2)]
    {
        time(c, &format!("conv2d {b}x{c_in}x{size}x{size} to {c_out}, stride {stride}"), move |inputs| {
            let (x, weight) = (inputs.normal([b, c_in, size, size]), inputs.normal([c_out, c_in, 3, 3]));
            let bias = inputs.normal([c_out]);
            Box::new(move |t| ops::conv2d(leaf(&x, t), leaf(&weight, t), Some(leaf(&bias, t)), [stride; 2], [1; 2]))
        });
    }
    for (c_in, c_out, size) in [(24, 24, [4, 32, 32]), (96, 96, [8, 64, 64])] {
        let [d, h, w] = size;
        time(c, &format!("conv3d 1x{c_in}x{d}x{h}x{w} to {c_out}"), move |inputs| {
            let (x, weight) = (inputs.normal([1, c_in, d, h, w]), inputs.normal([c_out, c_in, 3, 3, 3]));
            let bias = inputs.normal([c_out]);
            Box::new(move |t| ops::conv3d(leaf(&x, t), leaf(&weight, t), Some(leaf(&bias, t)), [1; 3], [1; 3]))
        });
    }
}

fn sampling(c: &mut Vec<Case>) {
    time(c, "grid_sample_2d [6, 96, 64, 64] at 32768", move |inputs| {
        let (x, grid) = (inputs.normal([6, 96, 64, 64]), inputs.uniform([6, 128, 256, 2]) * 2.0 - 1.0);
        Box::new(move |t| ops::grid_sample_2d(leaf(&x, t), leaf(&grid, t), false, ops::Interpolation::Bilinear))
    });
    time(c, "grid_sample_3d [1, 96, 8, 64, 64] at 32768", move |inputs| {
        let (x, grid) = (inputs.normal([1, 96, 8, 64, 64]), inputs.uniform([1, 8, 64, 64, 3]) * 2.0 - 1.0);
        Box::new(move |t| ops::grid_sample_3d(leaf(&x, t), leaf(&grid, t)))
    });
    for share in [20, 100] {
        time(c, &format!("deformable_views_2d 7 views, 4096 queries, {share} % visible"), move |inputs| {
            let shapes = [[32, 32], [16, 16], [8, 8]];
            let values = inputs.normal([2, 7, 1344, 3, 8]);
            let (reference, visible) =
                (inputs.uniform([2, 7, 4096, 2]), inputs.mask([2, 7, 4096], share as f32 / 100.0));
            let (offsets, weights) = (inputs.normal([2, 4096, 3, 3, 3, 2]), inputs.uniform([2, 4096, 3, 3, 3]));
            Box::new(move |t| {
                let (reference, visible) = (reference.clone(), visible.clone());
                let (values, offsets, weights) = (leaf(&values, t), leaf(&offsets, t), leaf(&weights, t));
                ops::deformable_views_2d(values, &shapes, reference, visible, offsets, weights)
            })
        });
    }
    time(c, "deformable_rays_3d 7 views, 1024 points, 70 % valid", move |inputs| {
        let shapes = [[4, 32, 32], [2, 16, 16], [1, 8, 8]];
        let values = inputs.normal([2, 4672, 3, 8]);
        let (reference, valid) = (inputs.uniform([2, 7, 1024, 3]), inputs.mask([2, 7, 1024], 0.7));
        let (offsets, weights) = (inputs.normal([2, 7168, 3, 3, 4, 3]), inputs.uniform([2, 7168, 3, 3, 4]));
        Box::new(move |t| {
            let (reference, valid) = (reference.clone(), valid.clone());
            let (values, offsets, weights) = (leaf(&values, t), leaf(&offsets, t), leaf(&weights, t));
            ops::deformable_rays_3d(values, &shapes, reference, valid, offsets, weights)
        })
    });
}
