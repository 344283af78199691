//! ControlNet against golden numbers; a fresh one changes nothing; several add up.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use nn::Init;
use nn::weights::{WeightError, named_params};
use stable_diffusion::layout::Network;
use stable_diffusion::{
    ControlInputs, ControlNet, ControlNetConfig, ControlResiduals, Preset, UNet2DCondition, UNetInputs,
};

use crate::golden::{
    Golden, TOLERANCE, check_derivative, folder, golden_weights, json, named_gradients, noise, values_of,
};
use crate::unet::golden_unet;

fn debug_config(channels: usize) -> ControlNetConfig {
    Preset::Debug.controlnet(channels).checked().unwrap()
}

fn debug_unet(device: &Device) -> UNet2DCondition {
    golden_weights(UNet2DCondition::new(&Preset::Debug.unet(), &mut Init::lazy(0, device)))
}

/// Sample, text and condition of the debug size.
fn scene(device: &Device) -> (Tensor<4>, Tensor<3>, Tensor<4>) {
    let condition = noise("condition", [2, 5, 24, 32], device);
    (noise("sample", [2, 4, 6, 8], device), noise("text", [2, 3, 16], device), condition)
}

const TIMES: [f64; 2] = [7.0, 801.0];

fn residuals(control: &ControlNet, scale: f64, device: &Device) -> ControlResiduals {
    let (sample, context, condition) = scene(device);
    control.forward(sample, &ControlInputs { timesteps: &TIMES, context, condition, views: None, scale })
}

fn controlled(unet: &UNet2DCondition, control: Option<&ControlResiduals>, device: &Device) -> Tensor<4> {
    let (sample, context, _) = scene(device);
    unet.forward_with(sample, &UNetInputs { timesteps: &TIMES, context, views: None, control })
}

#[test]
fn residuals_and_the_controlled_prediction_equal_the_reference() {
    for (case, peak) in [("controlnet_3", 255.0), ("controlnet_19", 1.0)] {
        let (Some(own), Some(of_unet)) = (folder(case), folder("unet_sd15")) else { return };
        let (golden, device) = (Golden::open(&own.join("io.safetensors")), Device::flex());
        let config = ControlNet::config_from_json(json(&own.join("config.json")).as_object().unwrap()).unwrap();
        let control = golden_weights(ControlNet::new(&config, &mut Init::lazy(0, &device)));
        let condition = golden.tensor::<4>("controlnet_cond_u8", &device) / peak;
        let embedded = control.controlnet_cond_embedding.forward(condition.clone().narrow(0, 0, 1));
        let [n, c, h, w] = embedded.dims();
        let every_4th = embedded.reshape([n, c / 4, 4, h * w]).narrow(2, 0, 1).reshape([n, c / 4, h, w]);
        golden.check("cond_embedding", every_4th, TOLERANCE);

        let (sample, context) =
            (golden.tensor::<4>("sample", &device), golden.tensor::<3>("encoder_hidden_states", &device));
        let timesteps = golden.timesteps();
        let scale = f64::from(golden.host("conditioning_scale").data[0]);
        let inputs = ControlInputs { timesteps: &timesteps, context: context.clone(), condition, views: None, scale };
        let residuals = control.forward(sample.clone(), &inputs);
        assert_eq!(residuals.down.len(), golden.names("down_residual.").len());
        let mut worst = golden.check("mid_residual", residuals.middle.clone(), TOLERANCE);
        for (i, residual) in residuals.down.iter().enumerate() {
            worst = worst.max(golden.check(&format!("down_residual.{i}"), residual.clone(), TOLERANCE));
        }
        let unet = golden_unet(&of_unet, &device);
        let without = unet.forward(sample.clone(), &timesteps, context.clone());
        golden.check("unet_output_without_control", without, TOLERANCE);
        let inputs = UNetInputs { timesteps: &timesteps, context, views: None, control: Some(&residuals) };
        let output = golden.check("unet_output", unet.forward_with(sample, &inputs), TOLERANCE);
        eprintln!("{case}: residuals off by {worst:.1e}, controlled prediction by {output:.1e}");
    }
}

#[test]
fn a_fresh_controlnet_leaves_the_prediction_unchanged_to_the_bit() {
    let device = Device::flex();
    let unet = debug_unet(&device);
    let alone = controlled(&unet, None, &device).into_data();
    let fresh = ControlNet::new(&debug_config(5), &mut Init::new(1, &device));
    let copied = ControlNet::from_unet(&debug_config(5), &unet, &mut Init::lazy(1, &device)).unwrap();
    for control in [fresh, copied] {
        let residuals = residuals(&control, 1.0, &device);
        assert_eq!(controlled(&unet, Some(&residuals), &device).into_data(), alone);
    }
}

#[test]
fn a_copy_has_the_unets_values_and_its_own_identity() {
    let device = Device::flex();
    let unet = debug_unet(&device);
    let control = ControlNet::from_unet(&debug_config(5), &unet, &mut Init::lazy(1, &device)).unwrap();
    let values = named_params(&unet).unwrap();
    let mut shared = 0;
    for (name, tensor) in named_params(&control).unwrap() {
        if let Some((_, original)) = values.iter().find(|(other, _)| *other == name) {
            assert_eq!(tensor, *original, "{name}");
            shared += 1;
        } else {
            assert!(name.starts_with("controlnet_"), "{name} is in no UNet");
            let zero = name.contains("controlnet_down") || name.contains("controlnet_mid") || name.contains("conv_out");
            assert_eq!(tensor.data.iter().all(|v| *v == 0.0), zero, "{name}");
        }
    }
    let of_encoder = values.iter().filter(|(name, _)| {
        ["conv_in.", "time_embedding.", "down_blocks.", "mid_block."].iter().any(|prefix| name.starts_with(prefix))
    });
    assert_eq!(shared, of_encoder.count());
    // Trained beside the UNet by one optimizer, the two must be told apart.
    assert_ne!(control.conv_in.weight.id, unet.conv_in.weight.id);

    let mut other = debug_config(5);
    other.encoder.context_width = 12;
    let error = ControlNet::from_unet(&other, &unet, &mut Init::lazy(1, &device)).unwrap_err();
    assert!(matches!(error, WeightError::Mismatch(m) if m.missing.is_empty() && !m.wrong_shape.is_empty()));
}

#[test]
fn residuals_scale_and_add_up() {
    let device = Device::flex();
    let unet = debug_unet(&device);
    let [a, b] = [3, 4].map(|seed| {
        let control = ControlNet::new(&debug_config(5), &mut Init::new(seed, &device));
        residuals(&golden_weights_of(control, seed), 1.0, &device)
    });
    let both = a.clone().scaled(0.5).plus(b.clone());
    for (i, sum) in both.down.iter().enumerate() {
        let expected = a.down[i].clone() * 0.5 + b.down[i].clone();
        assert!(sum.clone().all_close(expected, Some(1e-6), Some(1e-6)));
    }
    // With one branch at scale 0 the other is alone.
    let only_b = controlled(&unet, Some(&a.clone().scaled(0.0).plus(b.clone())), &device);
    assert_eq!(only_b.into_data(), controlled(&unet, Some(&b), &device).into_data());
    let difference = controlled(&unet, Some(&b), &device) - controlled(&unet, None, &device);
    assert!(values_of(difference).iter().any(|v| v.abs() > 1e-3), "control must be felt");
}

/// No zero layers, and other values for every seed.
fn golden_weights_of(control: ControlNet, seed: u64) -> ControlNet {
    let rule = |path: &str, shape: &[usize]| Ok(nn::golden::golden_values(&format!("{seed}.{path}"), shape));
    nn::weights::fill_params(control, rule).unwrap()
}

#[test]
fn derivatives_equal_differences_and_pass_through_a_frozen_unet() {
    let device = Device::flex().autodiff();
    let unet = debug_unet(&device).no_grad();
    let control = golden_weights(ControlNet::new(&debug_config(5), &mut Init::lazy(0, &device)));
    let weights = noise("weights", [2, 4, 6, 8], &device);
    let loss = |control: &ControlNet| {
        (controlled(&unet, Some(&residuals(control, 0.7, &device)), &device) * weights.clone()).sum()
    };
    check_derivative(&control, loss);
    // Zero convolutions at the start still learn.
    let fresh = ControlNet::new(&debug_config(5), &mut Init::new(1, &device));
    let gradients = named_gradients(&fresh, &GradientsParams::from_grads(loss(&fresh).backward(), &fresh));
    let moves = |name: &str| gradients[name].iter().any(|g| g.abs() > 1e-4);
    assert!(moves("controlnet_mid_block.weight") && moves("controlnet_down_blocks.0.weight"));
}

#[test]
#[should_panic(expected = "condition picture")]
fn a_condition_of_another_size_is_refused() {
    let device = Device::flex();
    let control = ControlNet::new(&debug_config(3), &mut Init::lazy(1, &device));
    residuals(&control, 1.0, &device);
}
