//! AdamW, clipping, warm-up and moving average against PyTorch, step by step (golden `ema_adamw`).

use std::collections::BTreeMap;
use std::path::PathBuf;

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData, activation};
use safetensors::SafeTensors;
use serde::Deserialize;
use train::{
    AdamW, DecayScope, Ema, EmaConfig, NamedTensors, OptimizerConfig, ParamInfo, Schedule, ScheduleShape,
    clip_global_norm, map_parameters, named_parameters,
};

#[derive(Deserialize)]
struct Manifest {
    config: Net,
    strong: Hyper,
}

#[derive(Deserialize)]
struct Net {
    layers: Vec<usize>,
    activation: String,
    steps: u64,
    #[serde(flatten)]
    hyper: Hyper,
}

#[derive(Deserialize)]
struct Hyper {
    lr: f64,
    betas: [f64; 2],
    eps: f64,
    weight_decay: f64,
    warmup_steps: u64,
    max_grad_norm: f64,
    ema_decay: f64,
}

#[derive(Module, Debug)]
struct Mlp {
    layers: Vec<Linear>,
}

impl Mlp {
    fn forward(&self, x: Tensor<2>, activation: &str) -> Tensor<2> {
        let last = self.layers.len() - 1;
        self.layers.iter().enumerate().fold(x, |x, (i, layer)| match (i == last, activation) {
            (true, _) => layer.forward(x),
            (_, "silu") => activation::silu(layer.forward(x)),
            (_, "relu") => activation::relu(layer.forward(x)),
            (_, "tanh") => activation::tanh(layer.forward(x)),
            (_, "gelu") => activation::gelu(layer.forward(x)),
            (_, other) => panic!("the golden has an activation {other:?} that this test does not know"),
        })
    }
}

/// All f32 tensors and the f64 scalars of the golden.
struct Golden(BTreeMap<String, (Vec<usize>, Vec<f64>)>);

impl Golden {
    fn values(&self, name: &str) -> &[f64] {
        &self.0.get(name).unwrap_or_else(|| panic!("the golden has no {name}")).1
    }

    fn matrix(&self, name: &str, device: &Device) -> Tensor<2> {
        let (shape, values) = &self.0[name];
        let values: Vec<f32> = values.iter().map(|&value| value as f32).collect();
        Tensor::from_data(TensorData::new(values, [shape[0], shape[1]]), device)
    }

    /// Values of a parameter in our order: PyTorch stores a linear layer's weight as [out, in], burn as [in, out].
    fn param(&self, group: &str, path: &str) -> Vec<f64> {
        let mut parts = path.split('.').skip(1);
        let layer: usize = parts.next().unwrap().parse().unwrap();
        let (shape, values) = &self.0[&format!("{group}/{}.{}", 2 * layer, parts.next().unwrap())];
        match shape[..] {
            [rows, columns] => (0..columns).flat_map(|c| (0..rows).map(move |r| values[r * columns + c])).collect(),
            _ => values.clone(),
        }
    }
}

fn folder() -> Option<PathBuf> {
    let root = match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => PathBuf::from(root),
        None => PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"),
    };
    let folder = root.join("ema_adamw");
    if std::env::var_os("RIGSCAPE_GOLDEN").is_none() && !folder.exists() {
        eprintln!("did not run: no golden `ema_adamw` in tests/golden and RIGSCAPE_GOLDEN is not set");
        return None;
    }
    Some(folder)
}

fn read(folder: &std::path::Path) -> (Manifest, Golden) {
    let manifest = serde_json::from_slice(&std::fs::read(folder.join("manifest.json")).unwrap()).unwrap();
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let all = tensors.iter().map(|(name, view)| {
        let values: Vec<f64> = match view.dtype() {
            safetensors::Dtype::F32 => {
                view.data().chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()).into()).collect()
            }
            safetensors::Dtype::F64 => {
                view.data().chunks(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect()
            }
            other => panic!("{name} is {other:?}"),
        };
        (name.to_string(), (view.shape().to_vec(), values))
    });
    (manifest, Golden(all.collect()))
}

fn check_all(what: &str, ours: &NamedTensors, theirs: impl Fn(&str) -> Vec<f64>, absolute: f64, relative: f64) {
    for (path, tensor) in ours {
        let theirs = theirs(path);
        let ours: Vec<f32> = tensor.values.to_data().try_to_vec().unwrap();
        assert_eq!(ours.len(), theirs.len(), "{what} {path}");
        let scale = theirs.iter().fold(0.0, |max: f64, value| max.max(value.abs()));
        let worst = ours.iter().zip(&theirs).fold(0.0, |max: f64, (a, b)| max.max((f64::from(*a) - b).abs()));
        assert!(worst <= absolute + relative * scale, "{what} {path}: differs by {worst:e} at scale {scale:e}");
    }
}

fn run(prefix: &str, hyper: &Hyper, net: &Net, golden: &Golden, tolerance: f64) {
    let device = Device::flex().autodiff();
    let layers = net.layers.windows(2).map(|pair| LinearConfig::new(pair[0], pair[1]).init(&device)).collect();
    let init = |info: &ParamInfo| golden.param("init", &info.path).iter().map(|&v| v as f32).collect::<Vec<f32>>();
    let mut model =
        map_parameters(Mlp { layers }, |info, old| Tensor::from_floats(init(info).as_slice(), &old.device()));
    let config = OptimizerConfig {
        learning_rate: hyper.lr,
        betas: hyper.betas,
        eps: hyper.eps,
        weight_decay: hyper.weight_decay,
        decay_scope: DecayScope::All,
        ..OptimizerConfig::default()
    };
    let schedule = Schedule { warmup_steps: hyper.warmup_steps, shape: ScheduleShape::Constant };
    let mut adamw = AdamW::new(&config);
    let mut ema = Ema::new(EmaConfig { decay: hyper.ema_decay, warmup: false }, &model);
    for step in 0..net.steps {
        let group = |name: &str| format!("{prefix}step{step}/{name}");
        let close = |name: &str, ours: f64, tolerance: f64| {
            let theirs = golden.values(&group(name))[0];
            assert!((ours - theirs).abs() <= tolerance * theirs.abs(), "{}: {ours} instead of {theirs}", group(name));
        };
        let x = golden.matrix(&format!("batch{step}/x"), &device);
        let y = golden.matrix(&format!("batch{step}/y"), &device);
        let loss = (model.forward(x, &net.activation) - y).powi_scalar(2).mean();
        let mut grads = GradientsParams::from_grads(loss.backward(), &model);
        if step == 0 {
            for (path, tensor) in gradients_of(&model, &grads) {
                let one = NamedTensors::from([(path.clone(), tensor)]);
                check_all("gradient", &one, |path| golden.param(&group("grad"), path), 1e-6, 1e-5);
            }
        }
        close("loss", loss.into_scalar::<f32>().into(), 1e-5);
        close("grad_norm", clip_global_norm(&mut grads, &model, hyper.max_grad_norm).value, 1e-5);
        let lr = hyper.lr * schedule.factor(step, net.steps);
        close("lr", lr, 1e-12);
        model = adamw.step(model, &mut grads, lr);
        assert!(grads.is_empty());
        ema.update(&model);
        // Tolerances of the golden's README: the PyTorch f32 run itself lies 1.8e-7 from f64.
        check_all("param", &named_parameters(&model), |path| golden.param(&group("param"), path), tolerance, 0.0);
        check_all("ema", ema.average(), |path| golden.param(&group("ema"), path), tolerance, 0.0);
        let averaged = named_parameters(&ema.apply(model.valid()));
        check_all("applied ema", &averaged, |path| golden.param(&group("ema"), path), tolerance, 0.0);
    }
    for (ours, theirs) in [("first", "exp_avg"), ("second", "exp_avg_sq")] {
        let moments = adamw.moments();
        let of_kind =
            moments.into_iter().filter_map(|(name, t)| Some((name.strip_prefix(&format!("{ours}."))?.to_string(), t)));
        let of_kind: NamedTensors = of_kind.collect();
        assert_eq!(of_kind.len(), 2 * (net.layers.len() - 1));
        check_all(ours, &of_kind, |path| golden.param(&format!("{prefix}final/{theirs}"), path), 0.0, 1e-4);
    }
}

fn gradients_of(model: &Mlp, grads: &GradientsParams) -> NamedTensors {
    let mut all = NamedTensors::new();
    for (i, layer) in model.layers.iter().enumerate() {
        let weight = grads.get::<2>(layer.weight.id).unwrap();
        let shape = weight.dims();
        let values = weight.reshape([shape[0] * shape[1]]);
        all.insert(format!("layers.{i}.weight"), train::NamedTensor { shape: shape.to_vec(), values });
        let values = grads.get::<1>(layer.bias.as_ref().unwrap().id).unwrap();
        all.insert(format!("layers.{i}.bias"), train::NamedTensor { shape: values.dims().to_vec(), values });
    }
    all
}

#[test]
fn six_steps_equal_pytorch() {
    let Some(folder) = folder() else { return };
    let (manifest, golden) = read(&folder);
    run("", &manifest.config.hyper, &manifest.config, &golden, 1e-6);
    run("strong/", &manifest.strong, &manifest.config, &golden, 1e-5);
}
