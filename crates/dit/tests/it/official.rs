//! The network, its loss and its samples against numbers of the public implementation (golden weights, no weight files).

use std::ops::ControlFlow;
use std::path::Path;

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use diffusion::{
    Ddim, Ddpm, FinalLevel, Level, NoiseSchedule, Oracle, SamplerConfig, ScheduleConfig, Spacing, Target, Variance,
    guide, variance_bound,
};
use dit::official::official_name;
use dit::{Condition, ConditionConfig, Dit, DitConfig, OutputConfig, position_code, timestep_code};
use nn::Init;
use nn::golden::golden_values;
use nn::weights::{fill_params, param_shapes};
use serde_json::Value;

use crate::golden::{Golden, folder, json, relative};

/// f32 against f32 with another order of sums.
const OUTPUTS: f64 = 1e-4;
const GRADIENTS: f64 = 5e-4;
/// Channels that the public code guides.
const GUIDED: usize = 3;

fn config(folder: &Path) -> DitConfig {
    let json = json(&folder.join("config.json"));
    let number = |key: &str| json[key].as_u64().unwrap() as usize;
    let output =
        if json["learn_sigma"] == Value::Bool(true) { OutputConfig::TargetAndVariance } else { OutputConfig::Target };
    DitConfig {
        latent_channels: number("in_channels"),
        latent_size: [number("input_size"); 2],
        patch: number("patch_size"),
        width: number("hidden_size"),
        depth: number("depth"),
        heads: number("num_heads"),
        output,
        condition: ConditionConfig::Labels { classes: number("num_classes") },
    }
    .checked()
    .unwrap()
}

fn open(device: &Device) -> Option<(Golden, Dit)> {
    let folder = folder()?;
    let model = Dit::new(&config(&folder), &mut Init::new(0, device));
    let model = fill_params(model, |path, shape| Ok(golden_values(&official_name(path), shape))).unwrap();
    Some((Golden::open(&folder), model))
}

/// The last row of the public table is the label for "none".
fn labels(values: &[f64], model: &Dit) -> Vec<Option<usize>> {
    let ConditionConfig::Labels { classes } = model.config().condition else { panic!("the golden network has labels") };
    values.iter().map(|&label| Some(label as usize).filter(|label| *label < classes)).collect()
}

fn schedule() -> NoiseSchedule {
    NoiseSchedule::new(&ScheduleConfig::DDPM).unwrap()
}

#[test]
fn names_and_shapes_are_the_public_ones() {
    let Some(folder) = folder() else { return };
    let model = Dit::new(&config(&folder), &mut Init::lazy(0, &Device::flex()));
    let mut ours: Vec<(String, Vec<usize>)> =
        param_shapes(&model).into_iter().map(|(path, shape)| (official_name(&path), shape)).collect();
    let manifest = json(&folder.join("manifest.json"));
    let mut theirs: Vec<(String, Vec<usize>)> = manifest["parameters"]
        .as_array()
        .unwrap()
        .iter()
        .map(|entry| {
            let shape = entry["shape"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
            (entry["name"].as_str().unwrap().to_owned(), shape)
        })
        // The position code is a constant and no parameter of ours.
        .filter(|(name, _)| name != "pos_embed")
        .collect();
    ours.sort();
    theirs.sort();
    assert_eq!(ours, theirs);
}

#[test]
fn tables() {
    let Some(folder) = folder() else { return };
    let golden = Golden::open(&folder);
    for name in golden.names("pos_table/") {
        let [tokens, width] = golden.shape(&name).try_into().unwrap();
        let side = tokens.isqrt();
        let got: Vec<f32> = position_code([side, side], width).into_iter().map(|v| v as f32).collect();
        assert!(relative(&got, golden.values(&name), 1.0) < 1e-6, "{name}");
    }
    let timesteps = golden.values("timestep_embedding/timesteps");
    for name in golden.names("timestep_embedding/dim") {
        let width = golden.shape(&name)[1];
        let got = timestep_code(timesteps, width, &Device::flex());
        assert!(golden.distance(&name, &got, 1.0) < 1e-4, "{name}");
    }
    for name in golden.names("respacing/") {
        let want = golden.values(&name);
        let spacing = if name.contains("ddim") { Spacing::Leading { offset: 0 } } else { Spacing::Rounded };
        let sampler = Ddpm { steps: want.len(), spacing, variance: Variance::FixedSmall, clip: false };
        let mut got = sampler.timesteps(&schedule());
        got.reverse();
        assert_eq!(got, want, "{name}");
    }
}

/// Gradients by public name.
struct Collect<'a> {
    path: Vec<String>,
    grads: &'a GradientsParams,
    found: Vec<(String, Vec<f32>)>,
}

impl ModuleVisitor for Collect<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(grad) = self.grads.get::<D>(param.id) {
            self.found.push((official_name(&self.path.join(".")), grad.into_data().try_to_vec::<f32>().unwrap()));
        }
    }
}

#[test]
fn output_and_gradients() {
    let device = Device::flex().autodiff();
    let Some((golden, model)) = open(&device) else { return };
    let x = golden.tensor::<4>("forward/x", &device).require_grad();
    let labels = labels(golden.values("forward/labels"), &model);
    let output = model.forward(x.clone(), golden.values("forward/timesteps"), &Condition::Labels(&labels));
    let distance = golden.distance("forward/output", &output.clone().inner(), 1.0);
    assert!(distance < OUTPUTS, "output: {distance:e}");
    let mut gradients = (output * golden.tensor::<4>("forward/upstream", &device)).sum().backward();
    let distance = golden.distance("forward/grad_x", &x.grad(&gradients).unwrap(), 0.0);
    assert!(distance < GRADIENTS, "gradient of x: {distance:e}");
    let grads = GradientsParams::from_module(&mut gradients, &model);
    let mut collect = Collect { path: Vec::new(), grads: &grads, found: Vec::new() };
    model.visit(&mut collect);
    let names = golden.names("forward/grad/");
    assert!(!names.is_empty());
    for name in names {
        let ours = name.trim_start_matches("forward/grad/");
        let (_, got) =
            collect.found.iter().find(|(path, _)| path == ours).unwrap_or_else(|| panic!("no gradient of {ours}"));
        let distance = relative(got, golden.values(&name), 0.0);
        assert!(distance < GRADIENTS, "{name}: {distance:e}");
    }
}

#[test]
fn guidance_as_in_the_public_code() {
    let device = Device::flex();
    let Some((golden, model)) = open(&device) else { return };
    let labels = labels(golden.values("cfg/labels"), &model);
    let x = golden.tensor::<4>("cfg/x", &device);
    let [b, c, h, w] = x.dims();
    let first = x.narrow(0, 0, b / 2);
    let x = Tensor::cat(vec![first.clone(), first], 0);
    let output = model.forward(x, golden.values("cfg/timesteps"), &Condition::Labels(&labels));
    assert!(golden.distance("cfg/output_plain", &output, 1.0) < OUTPUTS);
    let scale = golden.values("cfg/cfg_scale")[0];
    let half = |at: usize| output.clone().slice([at..at + b / 2, 0..GUIDED, 0..h, 0..w]);
    let guided = guide(half(b / 2), half(0), scale);
    let rest = output.clone().narrow(1, GUIDED, 2 * c - GUIDED);
    let guided = Tensor::cat(vec![Tensor::cat(vec![guided.clone(), guided], 0), rest], 1);
    let distance = golden.distance("cfg/output", &guided, 1.0);
    assert!(distance < OUTPUTS, "{distance:e}");
}

#[test]
fn losses() {
    let device = Device::flex();
    let Some(folder) = folder() else { return };
    let golden = Golden::open(&folder);
    let tensor = |name: &str| golden.tensor::<4>(name, &device);
    let (x0, noise, xt) = (tensor("loss/x0"), tensor("loss/noise"), tensor("loss/x_t"));
    let output = tensor("loss/model_output");
    let [b, c, h, w] = x0.dims();
    let schedule = schedule();
    let timesteps: Vec<usize> = golden.values("loss/timesteps").iter().map(|&t| t as usize).collect();
    let predicted = output.clone().narrow(1, 0, c);
    let per_sample = (predicted.clone() - noise).square().reshape([b, c * h * w]);
    let mse = ops::mean_dim(per_sample, 1).reshape([b]);
    assert!(golden.distance("loss/mse", &mse, 0.0) < OUTPUTS);
    let clean: Vec<Tensor<4>> = (0..b)
        .map(|i| {
            let level: Level = schedule.level(timesteps[i]);
            Target::Noise.clean(predicted.clone().narrow(0, i, 1), xt.clone().narrow(0, i, 1), level)
        })
        .collect();
    let clean = Tensor::cat(clean, 0);
    assert!(golden.distance("loss/p/pred_xstart", &clean, 1.0) < OUTPUTS);
    let fraction = (output.narrow(1, c, c) + 1.0) * 0.5;
    let bound = variance_bound(&schedule, fraction, clean, x0, xt, &timesteps);
    let (got, want) = (bound.into_data().try_to_vec::<f32>().unwrap(), golden.values("loss/vb.f64"));
    for ((got, want), t) in got.iter().zip(want).zip(&timesteps) {
        // At timestep 0 f32 cancels in the probabilities near their least value.
        let tolerance = if *t == 0 { 3e-2 } else { 1e-4 };
        assert!((f64::from(*got) / want - 1.0).abs() < tolerance, "bound at timestep {t}: {got} {want}");
    }
}

/// Samples along a stored run, one network pass with the label and one without.
fn follow(golden: &Golden, model: &Dit, name: &str, sampler: &SamplerConfig, keep_variance: bool) {
    let device = Device::flex();
    let runs = golden.tensor::<5>(&format!("{name}/x"), &device);
    let [states, b, c, h, w] = runs.dims();
    let start = runs.clone().narrow(0, 0, 1).reshape([b, c, h, w]);
    let both = labels(golden.values("sample_ddpm/labels"), model);
    let scale = golden.values("cfg/cfg_scale")[0];
    let noises = golden.tensor::<5>("sample_ddpm/noises", &device);
    let mut drawn = 0;
    let mut worst: f64 = 0.0;
    let mut states_seen = 1;
    let mut denoise = |x: Tensor<4>, t: f64| {
        let pass = |label| model.forward(x.clone(), &[t], &Condition::Labels(&[label]));
        let (cond, none) = (pass(both[0]), pass(both[1]));
        let guided = guide(none.narrow(1, 0, GUIDED), cond.clone().narrow(1, 0, GUIDED), scale);
        let channels = if keep_variance { 2 * c } else { c };
        Tensor::cat(vec![guided, cond.narrow(1, GUIDED, channels - GUIDED)], 1)
    };
    let mut noise = || {
        drawn += 1;
        noises.clone().narrow(0, drawn - 1, 1).reshape([b, c, h, w])
    };
    let mut watch = |report: diffusion::StepReport<'_, 4>| {
        let want = runs.clone().narrow(0, report.done, 1).into_data().try_to_vec::<f32>().unwrap();
        let want: Vec<f64> = want.into_iter().map(f64::from).collect();
        worst = worst.max(relative(&report.x.to_data().try_to_vec::<f32>().unwrap(), &want, 0.0));
        states_seen += 1;
        ControlFlow::Continue(())
    };
    let mut oracle = Oracle { denoise: &mut denoise, noise: &mut noise, watch: &mut watch };
    sampler.sample(&schedule(), Target::Noise, start, &mut oracle).unwrap();
    assert_eq!(states_seen, states);
    assert!(worst < OUTPUTS, "{name}: {worst:e}");
}

#[test]
fn samples_follow_the_stored_runs() {
    let Some((golden, model)) = open(&Device::flex()) else { return };
    let steps = golden.values("sample_ddpm/timesteps").len();
    let ddpm = Ddpm { steps, spacing: Spacing::Rounded, variance: Variance::LearnedRange, clip: false };
    assert_eq!(ddpm.timesteps(&schedule()), golden.values("sample_ddpm/timesteps"));
    follow(&golden, &model, "sample_ddpm", &SamplerConfig::Ddpm(ddpm), true);
    let steps = golden.values("sample_ddim/timesteps").len();
    let spacing = Spacing::Leading { offset: 0 };
    let ddim = Ddim { steps, eta: 0.0, spacing, last: FinalLevel::default(), clip: false };
    assert_eq!(ddim.timesteps(&schedule()), golden.values("sample_ddim/timesteps"));
    follow(&golden, &model, "sample_ddim", &SamplerConfig::Ddim(ddim), false);
}
