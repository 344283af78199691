//! Adapters on a small model: arithmetic, freezing, merging.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use nn::golden::{golden_stream, golden_values};
use nn::lora::{self, LoraConfig, LoraError, LoraSites};
use nn::weights::{HostTensor, fill_params, named_params};
use nn::{Bias, Conv3x3, Init, Linear, PatchConv2d, lora_sites};

#[derive(Module, Debug)]
pub struct Block {
    pub conv: Conv3x3,
    pub patches: PatchConv2d,
    pub to_q: Linear,
    pub to_out: Linear,
}

#[derive(Module, Debug)]
pub struct Model {
    pub blocks: Vec<Block>,
}

lora_sites!(Block { conv, patches, to_q, to_out as "to_out.0" });
lora_sites!(Model { blocks });

impl Model {
    pub fn new(device: &Device) -> Self {
        let mut init = Init::new(5, device);
        let block = |init: &mut Init| Block {
            conv: Conv3x3::new(3, 3, init),
            patches: PatchConv2d::new(3, 6, 2, init),
            to_q: Linear::new(6, 5, Bias::With, init),
            to_out: Linear::new(5, 12, Bias::Without, init),
        };
        Self { blocks: vec![block(&mut init), block(&mut init)] }
    }

    pub fn forward(&self, image: Tensor<4>) -> Tensor<4> {
        self.blocks.iter().fold(image, |image, block| {
            let tokens = block.to_q.forward(block.patches.forward(block.conv.forward(image))).tanh();
            nn::layout::image_from_patches(block.to_out.forward(tokens), 2)
        })
    }
}

pub fn image(device: &Device) -> Tensor<4> {
    let values: Vec<f32> = golden_stream("image", 2 * 3 * 4 * 6).into_iter().map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, [2, 3, 4, 6]), device)
}

pub fn everywhere(rank: usize, alpha: f64) -> LoraConfig {
    LoraConfig { rank, alpha, targets: vec!["*".to_owned()] }
}

/// Attaches an adapter whose B is not zero.
pub fn attach_trained(model: Model, name: &str, config: &LoraConfig) -> Model {
    let fresh = lora::attach(model, name, config, 7).unwrap();
    let adapters: BTreeMap<String, HostTensor> = named_params(&fresh).unwrap().into_iter().collect();
    fill_params(fresh, |path, shape| {
        let values = &adapters[path].data;
        let untrained = path.ends_with(".up") && values.iter().all(|v| *v == 0.0);
        Ok(if untrained { golden_values(&format!("{name} {path}"), shape) } else { values.clone() })
    })
    .unwrap()
}

pub fn bits(tensor: Tensor<4>) -> Vec<u32> {
    tensor.into_data().iter::<f32>().map(f32::to_bits).collect()
}

pub fn largest_difference(a: Tensor<4>, b: Tensor<4>) -> f32 {
    (a - b).abs().max().into_scalar()
}

/// Values of all parameters that are no adapters.
fn base_bits(model: &Model) -> Vec<(String, Vec<u32>)> {
    let named = named_params(model).unwrap().into_iter().filter(|(path, _)| !path.contains("lora"));
    named.map(|(path, tensor)| (path, tensor.data.into_iter().map(f32::to_bits).collect())).collect()
}

#[test]
fn a_new_adapter_changes_nothing_and_is_all_that_is_trained() {
    let device = Device::flex().autodiff();
    let base = Model::new(&device);
    let before = bits(base.forward(image(&device)));
    let mut model = lora::attach(base, "style", &everywhere(2, 4.0), 1).unwrap();
    let output = model.forward(image(&device));
    assert_eq!(bits(output.clone()), before);

    let gradients = GradientsParams::from_grads(output.square().sum().backward(), &model);
    let mut sites = 0;
    model.visit_sites("", &mut |site| {
        let adapter = &site.lora.stack[0];
        // B is zero, so A has a gradient, and it is zero.
        let down = gradients.get::<2>(adapter.down.id).unwrap();
        assert_eq!(down.abs().sum().into_scalar::<f32>(), 0.0, "{}", site.path);
        assert!(gradients.get::<2>(adapter.up.id).unwrap().abs().sum().into_scalar::<f32>() > 0.0, "{}", site.path);
        sites += 1;
    });
    assert_eq!((sites, gradients.len()), (8, 16));
    let trained = model.valid().train();
    assert!(!trained.blocks[0].to_q.weight.is_require_grad());
    assert!(trained.blocks[0].to_q.lora.stack[0].up.is_require_grad());
}

#[test]
fn gradients_are_those_of_the_dense_product() {
    let device = Device::flex().autodiff();
    let model = attach_trained(Model::new(&device), "style", &everywhere(2, 3.0));
    let thin = GradientsParams::from_grads(model.forward(image(&device)).square().sum().backward(), &model);
    // The same function with W + scale · B A composed beforehand.
    let mut dense = model.clone();
    for block in &mut dense.blocks {
        block.to_q.weight = compose(&block.to_q.weight, &block.to_q.lora);
        block.to_out.weight = compose(&block.to_out.weight, &block.to_out.lora);
        block.conv.weight = compose(&block.conv.weight, &block.conv.lora);
        block.patches.weight = compose(&block.patches.weight, &block.patches.lora);
    }
    let composed = dense.clone();
    lora::set_weight(&mut dense, "style", 0.0).unwrap();
    let output = dense.forward(image(&device));
    let scale: f32 = output.clone().abs().max().into_scalar();
    let difference = largest_difference(model.forward(image(&device)), output) / scale;
    assert!(difference < 1e-5, "{difference}");
    let thick = GradientsParams::from_grads(dense.forward(image(&device)).square().sum().backward(), &composed);
    let mut worst = 0.0_f32;
    let mut model = model;
    model.visit_sites("", &mut |site| {
        for id in [site.lora.stack[0].down.id, site.lora.stack[0].up.id] {
            let (a, b) = (thin.get::<2>(id).unwrap(), thick.get::<2>(id).unwrap());
            let scale: f32 = b.clone().abs().max().into_scalar();
            assert!(scale > 1e-3, "{}: a gradient of zero tests nothing", site.path);
            worst = worst.max((a - b).abs().max().into_scalar::<f32>() / scale);
        }
    });
    eprintln!("thin against dense: output off by {difference:.1e}, gradients by {worst:.1e}, of their maxima");
    // f32 through two blocks in another order of sums; a wrong factor shows as 1.
    assert!(worst < 1e-3, "{worst}");
}

/// A parameter whose value depends on the factors, on the tape.
fn compose<const D: usize>(
    weight: &burn::module::Param<Tensor<D>>,
    lora: &lora::Adapters,
) -> burn::module::Param<Tensor<D>> {
    let adapter = &lora.stack[0];
    let product = adapter.up.val().matmul(adapter.down.val()) * adapter.scale();
    burn::module::Param::initialized(weight.id, weight.val() + product.reshape(weight.dims()))
}

#[test]
fn merging_equals_and_unmerging_restores() {
    let device = Device::flex();
    let mut model = attach_trained(Model::new(&device), "style", &everywhere(3, 6.0));
    let (base, unmerged) = (base_bits(&model), model.forward(image(&device)));
    lora::merge(&mut model);
    assert!(model.blocks[1].conv.lora.is_merged());
    let merged = model.forward(image(&device));
    let difference = largest_difference(merged.clone(), unmerged.clone());
    assert!(difference > 0.0 && difference < 1e-5, "{difference}");
    // Modules are moved and copied while merged, too.
    let copy = model.clone().train().valid().to_device(&device);
    assert_eq!(bits(copy.forward(image(&device))), bits(merged));
    assert_eq!(base_bits(&model), base);
    lora::unmerge(&mut model);
    assert_eq!(bits(model.forward(image(&device))), bits(unmerged));
    assert_eq!(base_bits(&model), base);
}

#[test]
fn weight_zero_and_detaching_give_the_base_to_the_bit() {
    let device = Device::flex();
    let base = bits(Model::new(&device).forward(image(&device)));
    let mut model = attach_trained(Model::new(&device), "style", &everywhere(2, 4.0));
    let full = bits(model.forward(image(&device)));
    assert_ne!(full, base);
    for merged in [false, true] {
        if merged {
            lora::merge(&mut model);
        }
        lora::set_weight(&mut model, "style", 0.0).unwrap();
        assert_eq!(bits(model.forward(image(&device))), base);
        lora::set_weight(&mut model, "style", 1.0).unwrap();
        assert_ne!(bits(model.forward(image(&device))), base);
    }
    lora::unmerge(&mut model);
    assert_eq!(bits(model.forward(image(&device))), full);
    lora::merge(&mut model);
    lora::detach(&mut model, "style").unwrap();
    assert_eq!(bits(model.forward(image(&device))), base);
    assert!(lora::names(&mut model).is_empty() && named_params(&model).unwrap().len() == 14);
}

#[test]
fn several_adapters_add_up() {
    let device = Device::flex();
    // One layer, where the sum is linear.
    let layer = || Model::new(&device).blocks.remove(0).conv;
    #[derive(Module, Debug)]
    struct One {
        conv: Conv3x3,
    }
    lora_sites!(One { conv });
    let start = One { conv: layer() };
    let filled = |model: One| {
        fill_params(model, |path, shape| {
            let seed = if path.contains("lora") { path.to_owned() } else { format!("base {path}") };
            Ok(golden_values(&seed, shape))
        })
        .unwrap()
    };
    let model = lora::attach(start, "a", &everywhere(2, 2.0), 1).unwrap();
    let mut model = filled(lora::attach(model, "b", &everywhere(1, 0.5), 2).unwrap());
    assert_eq!(lora::names(&mut model), ["a", "b"]);
    let mut with = |a: f64, b: f64| {
        lora::set_weight(&mut model, "a", a).unwrap();
        lora::set_weight(&mut model, "b", b).unwrap();
        model.conv.forward(image(&device))
    };
    let (base, a, b, both, half) = (with(0.0, 0.0), with(1.0, 0.0), with(0.0, 1.0), with(1.0, 1.0), with(1.0, -0.5));
    assert!(largest_difference(a.clone(), base.clone()) > 0.1 && largest_difference(b.clone(), base.clone()) > 0.1);
    assert!(largest_difference(both, a.clone() + b.clone() - base.clone()) < 1e-5);
    assert!(largest_difference(half, a - (b - base) * 0.5) < 1e-5);

    let device = Device::flex().autodiff();
    let model = lora::attach(Model::new(&device), "a", &everywhere(2, 2.0), 1).unwrap();
    let model = lora::attach(model, "b", &everywhere(2, 2.0), 2).unwrap();
    let trained = |model: &Model| {
        model.blocks[0].to_q.lora.stack.iter().map(|adapter| adapter.up.is_require_grad()).collect::<Vec<_>>()
    };
    assert_eq!(trained(&model), [false, true]);
    let model = lora::train_only(model, &["a", "b"]).unwrap();
    assert_eq!(trained(&model), [true, true]);
    assert!(!model.blocks[0].to_q.weight.is_require_grad());
}

#[test]
fn wrong_settings_are_refused() {
    let device = Device::flex();
    let attach = |config: &LoraConfig| lora::attach(Model::new(&device), "style", config, 0).unwrap_err();
    let config = |targets: &[&str]| LoraConfig {
        targets: targets.iter().map(|target| (*target).to_owned()).collect(),
        ..LoraConfig::default()
    };
    let error = attach(&config(&["to_q", "to_k"]));
    assert!(matches!(&error, LoraError::NoTarget { pattern, .. } if pattern == "to_k"), "{error}");
    assert!(error.to_string().contains("blocks.0.conv"), "{error}");
    for wrong in [config(&[]), everywhere(0, 1.0), everywhere(1, f64::NAN)] {
        assert!(matches!(attach(&wrong), LoraError::Config { .. }));
    }
    let mut model = lora::attach(Model::new(&device), "style", &config(&["to_q", "to_out.0"]), 0).unwrap();
    assert!(model.blocks[0].conv.lora.stack.is_empty());
    assert!(
        matches!(lora::set_weight(&mut model, "x", 1.0), Err(LoraError::Unknown { known, .. }) if known == ["style"])
    );
    assert!(matches!(lora::set_weight(&mut model, "style", f64::INFINITY), Err(LoraError::Config { .. })));
    assert!(matches!(lora::attach(model, "style", &config(&["to_q"]), 0), Err(LoraError::Taken { .. })));
}
