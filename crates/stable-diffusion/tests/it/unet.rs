//! UNet2DCondition against golden numbers, sizes that do not divide, frozen weights.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use nn::Init;
use stable_diffusion::layout::Network;
use stable_diffusion::unet::{Condition, time_code};
use stable_diffusion::{AttentionHeads, ConfigError, Preset, UNet2DCondition, UNetConfig};

use crate::golden::{
    GRADIENT_TOLERANCE, Golden, TOLERANCE, check_derivative, check_gradients, folder, golden_weights, json,
    named_gradients, noise, values_of,
};

const CASES: [&str; 3] = ["unet_sd15", "unet_sd21", "unet_sd21_in8"];

pub fn golden_unet(folder: &std::path::Path, device: &Device) -> UNet2DCondition {
    let config = UNet2DCondition::config_from_json(json(&folder.join("config.json")).as_object().unwrap()).unwrap();
    golden_weights(UNet2DCondition::new(&config, &mut Init::lazy(0, device)))
}

fn debug(device: &Device) -> UNet2DCondition {
    golden_weights(UNet2DCondition::new(&Preset::Debug.unet().checked().unwrap(), &mut Init::lazy(0, device)))
}

#[test]
fn predictions_and_gradients_equal_the_reference() {
    for case in CASES {
        let Some(folder) = folder(case) else { return };
        let golden = Golden::open(&folder.join("io.safetensors"));
        let device = Device::flex().autodiff();
        let unet = golden_unet(&folder, &device);
        let sample = golden.tensor::<4>("sample", &device).require_grad();
        let context = golden.tensor::<3>("encoder_hidden_states", &device).require_grad();
        let output = unet.forward(sample.clone(), &golden.timesteps(), context.clone());
        let forward = golden.check("output", output.clone(), TOLERANCE);
        let mut grads = (output * golden.tensor("upstream", &device)).sum().backward();
        let dx = golden.check("grad/sample", sample.grad_remove(&mut grads).unwrap(), GRADIENT_TOLERANCE);
        let text = context.grad_remove(&mut grads).unwrap();
        let dc = golden.check("grad/encoder_hidden_states", text, GRADIENT_TOLERANCE);
        let ours = named_gradients(&unet, &GradientsParams::from_grads(grads, &unet));
        let dp = check_gradients(&golden, "grad/param/", &ours);
        eprintln!(
            "{case}: output off by {forward:.1e}, gradients by {dx:.1e} (sample), {dc:.1e} (text), {dp:.1e} (parameters)"
        );
    }
}

#[test]
fn every_stage_equals_the_reference() {
    let Some(folder) = folder("unet_sd15") else { return };
    let (golden, device) = (Golden::open(&folder.join("io.safetensors")), Device::flex());
    let unet = golden_unet(&folder, &device);
    let one = |name: &str| golden.tensor::<4>(name, &device).narrow(0, 0, 1);
    let (t, context) = (&golden.timesteps()[..1], golden.tensor::<3>("encoder_hidden_states", &device).narrow(0, 0, 1));
    golden.check("trace/time_proj", time_code(t, 32, &device), TOLERANCE);
    let embedding = unet.time_embedding.forward(t, &device);
    golden.check("trace/time_embedding", embedding.clone(), TOLERANCE);
    let condition = Condition { time: ops::silu(embedding), context: context.clone(), views: None, joined: 1 };
    let every_8th = |x: Tensor<4>| {
        let [n, c, h, w] = x.dims();
        x.reshape([n, c / 8, 8, h * w]).narrow(2, 0, 1).reshape([n, c / 8, h, w])
    };
    let x = unet.conv_in.forward(one("sample"));
    golden.check("trace/conv_in", every_8th(x.clone()), TOLERANCE);
    let mut x = x;
    let mut skips = vec![x.clone()];
    for (i, block) in unet.down_blocks.iter().enumerate() {
        x = block.forward(x, &condition, &mut skips);
        golden.check(&format!("trace/down_blocks.{i}"), every_8th(x.clone()), TOLERANCE);
    }
    x = unet.mid_block.forward(x, &condition);
    golden.check("trace/mid_block", every_8th(x.clone()), TOLERANCE);
    for (i, block) in unet.up_blocks.iter().enumerate() {
        x = block.forward(x, &condition, &mut skips);
        golden.check(&format!("trace/up_blocks.{i}"), every_8th(x.clone()), TOLERANCE);
    }
    assert!(skips.is_empty());
    golden.check("trace/conv_norm_out", every_8th(unet.conv_norm_out.forward(x)), TOLERANCE);
    let odd = unet.forward(golden.tensor("odd/sample", &device), t, context);
    let worst = golden.check("odd/output", odd, TOLERANCE);
    eprintln!("odd size: off by {worst:.1e}");
}

#[test]
fn the_time_code_has_cosines_before_sines() {
    let device = Device::flex();
    let code = values_of(time_code(&[0.0, 1.0, 999.0], 4, &device));
    let expected = [
        [1.0, 1.0, 0.0, 0.0],
        [1.0f64.cos(), 0.01f64.cos(), 1.0f64.sin(), 0.01f64.sin()],
        [999.0f64.cos(), 9.99f64.cos(), 999.0f64.sin(), 9.99f64.sin()],
    ];
    for (got, want) in code.iter().zip(expected.as_flattened()) {
        assert!((f64::from(*got) - want).abs() < 1e-6, "{got} against {want}");
    }
}

#[test]
fn odd_sizes_come_back_as_they_went_in() {
    let device = Device::flex();
    let config = Preset::Tiny.unet().checked().unwrap();
    let unet = UNet2DCondition::new(&config, &mut Init::new(1, &device));
    // 28×50 and 27×48 are the latents of 224×400 and 216×384 pictures.
    for [h, w] in [[28, 50], [27, 48], [7, 13], [1, 3]] {
        let sample = noise("sample", [1, 4, h, w], &device);
        let output = unet.forward(sample, &[10.0], noise("text", [1, 5, 64], &device));
        assert_eq!(output.dims(), [1, 4, h, w]);
        assert!(values_of(output).iter().all(|v| v.is_finite()));
    }
}

#[test]
fn items_of_a_batch_do_not_mix() {
    let device = Device::flex();
    let unet = debug(&device);
    let (sample, context) = (noise("sample", [2, 4, 8, 8], &device), noise("text", [2, 3, 16], &device));
    let both = unet.forward(sample.clone(), &[3.0, 900.0], context.clone());
    let swapped = unet.forward(sample.flip([0]), &[900.0, 3.0], context.flip([0])).flip([0]);
    assert!(both.all_close(swapped, Some(1e-5), Some(1e-5)));
}

#[test]
fn the_derivative_equals_differences() {
    let device = Device::flex().autodiff();
    let (sample, text) = (noise("sample", [1, 4, 5, 6], &device), noise("text", [1, 3, 16], &device));
    let weights = noise("weights", [1, 4, 5, 6], &device);
    check_derivative(&debug(&device), |unet| {
        (unet.forward(sample.clone(), &[321.0], text.clone()) * weights.clone()).sum()
    });
}

#[test]
fn a_frozen_network_still_passes_gradients_on() {
    let device = Device::flex().autodiff();
    let unet = debug(&device).no_grad();
    let sample = noise("sample", [1, 4, 8, 8], &device).require_grad();
    let mut grads = unet.forward(sample.clone(), &[5.0], noise("text", [1, 3, 16], &device)).sum().backward();
    let dx = values_of(sample.grad_remove(&mut grads).unwrap());
    assert!(dx.iter().any(|v| v.abs() > 1e-3));
    assert!(named_gradients(&unet, &GradientsParams::from_grads(grads, &unet)).is_empty());
}

#[test]
fn sizes_that_build_no_network_are_refused() {
    let with = |change: fn(&mut UNetConfig)| {
        let mut config = Preset::Debug.unet();
        change(&mut config);
        config.checked().unwrap_err()
    };
    assert!(matches!(with(|c| c.encoder.norm_groups = 3), ConfigError::Divides { .. }));
    assert!(matches!(with(|c| c.encoder.norm_groups = 0), ConfigError::Zero { .. }));
    assert!(matches!(with(|c| c.encoder.heads = AttentionHeads::Width(5)), ConfigError::Divides { .. }));
    assert!(matches!(with(|c| c.encoder.heads = AttentionHeads::Count(vec![2])), ConfigError::Levels { .. }));
    assert!(matches!(with(|c| c.encoder.attention_levels = vec![true; 3]), ConfigError::Levels { .. }));
    assert!(matches!(with(|c| c.encoder.block_channels.clear()), ConfigError::Zero { .. }));
    assert!(matches!(with(|c| c.out_channels = 0), ConfigError::Zero { .. }));
    // Both spellings of heads are the same network.
    let mut width = Preset::Sd21.unet().encoder;
    assert_eq!((0..4).map(|level| width.heads_of(level)).collect::<Vec<_>>(), [5, 10, 20, 20]);
    width.heads = AttentionHeads::Count(vec![8; 4]);
    assert_eq!(width.heads_of(3), 8);
    let text = serde_json::to_string(&Preset::Sd21.unet()).unwrap();
    assert_eq!(serde_json::from_str::<UNetConfig>(&text).unwrap(), Preset::Sd21.unet());
    assert!(serde_json::from_str::<UNetConfig>(&text.replace("out_channels", "channels_out")).is_err());
}
