//! The network run in segments against the whole network on one tape.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use geometry::RigPreset;
use vae::losses::{lecam, squared_slope};
use vae::{OnBoth, Preset, SegmentedPass};

use crate::behaviour::{matrices, model, noise, rig};
use crate::golden::HostValues;
use crate::official::named_gradients;

#[test]
fn segments_give_the_gradients_of_one_tape() {
    let (taped, plain) = (Device::flex().autodiff(), Device::flex());
    let mut config = Preset::Debug.config();
    // More than one block of each kind, so that their order counts.
    config.image.encoder_blocks = 2;
    config.image.decoder_blocks = 2;
    config.scene.encoder_blocks = 2;
    config.scene.decoder_blocks = 2;
    config.state.blocks = 2;
    let model = model(&config, &taped);
    let (six, four) = (rig(RigPreset::NuScenes, 6), rig(RigPreset::WayveScenes101, 4));
    let views = 6;
    let cameras = |device: &Device, lift| matrices(&[&six, &four], &config, views, lift, device);
    let images = noise("images", [2, views, 3, config.image.height, config.image.width], &plain);
    let upstream = noise("upstream", images.dims(), &plain);
    let kl_weight = 1e-3;

    let posterior = model.encode(Tensor::from_inner(images.clone()), &cameras(&taped, false));
    let draw = |shape: [usize; 3]| noise("posterior", shape, &plain);
    let latent = posterior.sample(Tensor::from_inner(draw(posterior.mean.dims())));
    let decoded = model.decode(latent, &cameras(&taped, true));
    let painted = decoded.images.clone().inner();
    let loss = (decoded.images * Tensor::from_inner(upstream.clone())).sum() + posterior.kl().mean() * kl_weight;
    let want = named_gradients(&model, &GradientsParams::from_grads(loss.backward(), &model));

    let both = |lift| OnBoth { plain: cameras(&plain, lift), taped: cameras(&taped, lift) };
    let pass = SegmentedPass::forward(&model, images, [&both(false), &both(true)], draw);
    for (name, got, wanted) in [
        ("pictures", pass.images().inner_values(), painted.inner_values()),
        ("last tokens", pass.last_tokens().inner_values(), decoded.last_tokens.inner_values()),
        ("KL", pass.posterior().kl().inner_values(), posterior.kl().inner_values()),
    ] {
        // Kernels with and without a tape order their sums differently.
        let off = got.iter().zip(&wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let size = wanted.iter().map(|v| v.abs()).fold(0.0, f64::max);
        assert!(got.len() == wanted.len() && off <= 1e-5 * size, "{name}: off by {off:e} of {size:e}");
    }
    let got = named_gradients(&model, &pass.backward(&model, upstream, kl_weight));
    assert_eq!(got.len(), want.len());
    let mut worst: f64 = 0.0;
    for (name, want) in &want {
        let size = want.iter().map(|v| v * v).sum::<f64>().sqrt();
        let off = want.iter().zip(&got[name]).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        worst = worst.max(off / (size + 1e-6));
        assert!(off <= 1e-4 * size + 1e-6, "{name}: off by {off:e} of {size:e}");
    }
    eprintln!("{} parameters, largest relative difference of a gradient {worst:.1e}", got.len());
    assert_eq!(got.len(), nn::weights::param_shapes(&model.valid()).len());
}

#[test]
fn slopes_and_running_means_are_what_they_say() {
    let device = Device::flex();
    let (images, weights) = (noise("x", [2, 3, 4, 4], &device), noise("w", [2, 3, 4, 4], &device));
    // A linear score has the slope w·v everywhere.
    let directions = noise("v", [2, 3, 4, 4], &device);
    let score = |x: Tensor<4>| {
        let n = x.dims()[0];
        let products = (x * weights.clone().repeat_dim(0, n / 2)).reshape([n, 48]);
        ops::sum_dim(products, 1).reshape([n])
    };
    let along = (weights.clone() * directions.clone()).inner_values();
    let (a, b): (f64, f64) = (along[..48].iter().sum(), along[48..].iter().sum());
    let got = squared_slope(score, images, directions, 0.01).inner_values()[0];
    assert!((got - 0.5 * (a * a + b * b)).abs() < 1e-3 * got, "{got} against {}", 0.5 * (a * a + b * b));
    let (real, fake) = (Tensor::from_floats([1.0, 2.0], &device), Tensor::from_floats([-1.0, 0.0], &device));
    let got = lecam(real, fake, [0.5, -0.5]).inner_values()[0];
    assert!((got - (0.5 * (2.25 + 6.25) + 0.5 * (2.25 + 0.25))).abs() < 1e-6, "{got}");
}
