//! Gradients of the UNet in segments against those of one tape.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use nn::Init;
use stable_diffusion::{
    Adjacency, ControlResiduals, NeighbourMerge, Panels, Preset, UNet2DCondition, UNetConfig, UNetInputs,
};

use crate::golden::{compare, golden_weights, named_gradients, noise, values_of};

/// Equal sums in another order.
const TOLERANCE: f64 = 5e-6;

const VIEWS: usize = 3;

/// A rig of views that meet, and one without.
fn configs() -> [(UNetConfig, Option<Adjacency>); 3] {
    let ring = || Some(Adjacency::ring(1, VIEWS));
    let with = |panels| {
        let mut config = Preset::Debug.unet();
        config.encoder.cross_view = Some(NeighbourMerge::Sum);
        config.encoder.panels = panels;
        config.checked().unwrap()
    };
    [(Preset::Debug.unet(), None), (with(Panels::PerView), ring()), (with(Panels::JointWidth), ring())]
}

/// As deep as the skips of a network: residuals that a ControlNet might give.
fn residuals(unet: &UNet2DCondition, sample: &Tensor<4>, joined: usize) -> ControlResiduals {
    let encoder = &unet.config().encoder;
    let [n, _, h, w] = sample.dims();
    let (mut down, mut side) = (vec![], 1);
    let device = Device::flex();
    let one = |at: usize, channels: usize, side: usize| {
        noise(&format!("residual {at}"), [n / joined, channels, h.div_ceil(side), (w * joined).div_ceil(side)], &device)
    };
    for (level, channels) in encoder.block_channels.iter().enumerate() {
        let count = encoder.resnets_per_level + usize::from(level == 0);
        (0..count).for_each(|_| down.push(one(down.len(), *channels, side)));
        if level + 1 < encoder.levels() {
            side *= 2;
            down.push(one(down.len(), *channels, side));
        }
    }
    ControlResiduals { middle: one(99, encoder.last_channels(), side), down }
}

#[test]
fn gradients_equal_those_of_one_tape() {
    let (plain, tape) = (Device::flex(), Device::flex().autodiff());
    for (config, views) in configs() {
        let unet = golden_weights(UNet2DCondition::new(&config, &mut Init::lazy(0, &tape)));
        let sample = noise("sample", [VIEWS, 4, 6, 6], &plain);
        let context = noise("text", [VIEWS, 5, config.encoder.context_width], &plain);
        let joined = if config.encoder.panels == Panels::JointWidth { VIEWS } else { 1 };
        let control = residuals(&unet, &sample, joined);
        let timesteps = [400.0; VIEWS];

        let on_tape = |x: &Tensor<4>| Tensor::from_inner(x.clone()).require_grad();
        let (x, text) = (on_tape(&sample), Tensor::from_inner(context.clone()).require_grad());
        let lifted =
            ControlResiduals { down: control.down.iter().map(on_tape).collect(), middle: on_tape(&control.middle) };
        let inputs =
            UNetInputs { timesteps: &timesteps, context: text.clone(), views: views.as_ref(), control: Some(&lifted) };
        let output = unet.forward_with(x.clone(), &inputs);
        let mut whole = output.clone().square().sum().backward();
        let wanted = [("sample", values_of(x.grad_remove(&mut whole).unwrap()))].into_iter();
        let wanted = wanted.chain([("middle", values_of(lifted.middle.grad_remove(&mut whole).unwrap()))]);
        let wanted: Vec<_> =
            wanted.chain([("skip", values_of(lifted.down[1].grad_remove(&mut whole).unwrap()))]).collect();
        let wanted_text = values_of(text.grad_remove(&mut whole).unwrap());
        let wanted_params = named_gradients(&unet, &GradientsParams::from_grads(whole, &unet));

        let inputs = UNetInputs { timesteps: &timesteps, context, views: views.as_ref(), control: Some(&control) };
        let pass = unet.forward_segments(sample, &inputs);
        assert_eq!(pass.output().into_data(), output.inner().into_data());
        let upstream = pass.output() * 2.0;
        let found = pass.backward(&unet, upstream);
        let control = found.control.unwrap();
        let off = [found.sample, control.middle, control.down[1].clone()].into_iter().zip(&wanted);
        for (found, (name, wanted)) in off {
            compare(name, &values_of(found), wanted, TOLERANCE);
        }
        compare("text", &values_of(found.context), &wanted_text, TOLERANCE);
        let found = named_gradients(&unet, &found.params);
        assert_eq!(found.keys().collect::<Vec<_>>(), wanted_params.keys().collect::<Vec<_>>());
        assert_eq!(found.len(), nn::weights::param_shapes(&unet).len(), "parameters without a gradient");
        for (name, values) in &found {
            compare(name, values, &wanted_params[name], TOLERANCE);
        }
    }
}

#[test]
fn a_frozen_network_passes_gradients_on() {
    let (plain, tape) = (Device::flex(), Device::flex().autodiff());
    let unet = golden_weights(UNet2DCondition::new(&Preset::Debug.unet(), &mut Init::lazy(0, &tape))).no_grad();
    let context = noise("text", [1, 5, unet.config().encoder.context_width], &plain);
    let pass = unet.forward_segments(
        noise("sample", [1, 4, 4, 4], &plain),
        &UNetInputs { timesteps: &[10.0], context, views: None, control: None },
    );
    let found = pass.backward(&unet, Tensor::ones([1, 4, 4, 4], &plain));
    assert!(found.params.is_empty() && found.control.is_none());
    assert!(found.sample.abs().max().into_scalar::<f32>() > 1e-3);
    assert!(found.context.abs().max().into_scalar::<f32>() > 0.0);
}
