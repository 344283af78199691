//! Times one training step of BEV-VAE's preset `small` on the CPU backend: forward, squared error and KL, gradients, AdamW.
//!
//! `cargo bench -p rigscape -p vae --bench bev_vae`; `benches/peer/bev_vae.py` runs it beside the same network in PyTorch.

use burn::optim::{AdamWConfig, GradientsParams};
use burn::tensor::{Device, Distribution, Tensor, TensorData};
use divan::Bencher;
use nn::Init;
use vae::{BevVae, Preset, ViewMatrices, losses::masked_l2};

fn main() {
    // As every program of this workspace that computes on a CPU.
    ops::keep_freed_memory();
    divan::main();
}

const VIEWS: usize = 6;
/// Height of the cameras over the ego frame's origin, in metres.
const HEIGHT_M: f64 = 1.5;

/// Six cameras around the car, each 90 degrees wide: camera i looks along yaw 60°·i. Matrices ego to pixels, or back.
fn cameras(size: f64, lift: bool, device: &Device) -> ViewMatrices {
    let (focal, centre) = (size / 2.0, size / 2.0);
    let rows = (0..VIEWS).flat_map(|view| {
        let (sin, cos) = (view as f64 * std::f64::consts::TAU / VIEWS as f64).sin_cos();
        // Camera x to the right, y down, z forward, as rows over ego axes.
        let [right, down, forward] = [[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]];
        if lift {
            let row = |i: usize| {
                let centred = forward[i] - centre / focal * (right[i] + down[i]);
                [right[i] / focal, down[i] / focal, centred, if i == 2 { HEIGHT_M } else { 0.0 }]
            };
            [row(0), row(1), row(2)]
        } else {
            let place = |axis: [f64; 3]| [axis[0], axis[1], axis[2], -axis[2] * HEIGHT_M];
            let mix = |a: [f64; 3]| std::array::from_fn(|i| focal * a[i] + centre * forward[i]);
            [place(mix(right)), place(mix(down)), place(forward)]
        }
    });
    let values: Vec<f32> = rows.flatten().map(|value| value as f32).collect();
    ViewMatrices {
        matrices: Tensor::from_data(TensorData::new(values, [1, VIEWS, 3, 4]), device),
        view_mask: Tensor::<2>::zeros([1, VIEWS], device).equal_elem(0.0),
    }
}

#[divan::bench(sample_count = 4, sample_size = 1)]
fn small(bencher: Bencher) {
    let device = Device::flex().autodiff();
    let config = Preset::Small.config();
    let size = config.image.width;
    let [encode, decode] = [false, true].map(|lift| cameras(size as f64, lift, &device));
    let images = Tensor::<5>::random([1, VIEWS, 3, size, size], Distribution::Normal(0.0, 1.0), &device);
    let mut optimizer = AdamWConfig::new().with_weight_decay(0.01).init();
    let mut model = Some(BevVae::new(&config, &mut Init::new(7, &device)));
    bencher.bench_local(|| {
        let current = model.take().expect("the model of the last step");
        let posterior = current.encode(images.clone(), &encode);
        let noise = Tensor::random(posterior.mean.dims(), Distribution::Normal(0.0, 1.0), &device);
        let decoded = current.decode(posterior.sample(noise), &decode);
        let loss = masked_l2(decoded.images, images.clone(), decode.view_mask.clone(), None) + posterior.kl() * 1e-6;
        let gradients = GradientsParams::from_grads(loss.backward(), &current);
        model = Some(optimizer.step(1e-4, current, gradients));
    });
}
