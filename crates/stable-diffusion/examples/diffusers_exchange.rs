//! Both directions between us and diffusers: `write DIR` makes folders, single files and adapters with what our networks say to
//! fixed inputs; `check DIR` opens what `tests/peers/diffusers_exchange.py` made in turn and compares.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use nn::Init;
use nn::golden::{golden_stream, golden_values};
use nn::lora::{self, LoraLayout};
use nn::weights::{HostTensor, WeightFile, fill_some_params, write_safetensors};
use stable_diffusion::layout::single_file::{load_single_file, save_single_file, single_file_tensors};
use stable_diffusion::layout::{Network, fill_by_state_dict_name, load_folder, save_folder};
use stable_diffusion::text::{BytePairs, Padding, TextCleaning, load_text_encoder, load_tokenizer, save_clip};
use stable_diffusion::{
    AttentionHeads, AutoencoderKL, ClipTextConfig, ClipTextModel, ClipTokenizer, ControlInputs, ControlNet, Preset,
    ProjectionKind, UNet2DCondition, UNetConfig, UNetInputs,
};

type Outcome<T> = Result<T, Box<dyn Error>>;

/// Largest difference that is allowed, of the largest value: f32 in another order of sums.
const TOLERANCE: f64 = 1e-4;

const CAPTIONS: [&str; 3] = ["a rainy night, two-lane road", "", "Caf\u{e9} at dusk \u{1f697}, 4-lane road!"];

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["write", folder] => write(Path::new(folder)),
        ["check", folder] => check(Path::new(folder)),
        _ => Err("diffusers_exchange write DIR | check DIR".into()),
    }
}

fn noise<const D: usize>(name: &str, shape: [usize; D]) -> Tensor<D> {
    let values: Vec<f32> = golden_stream(name, shape.iter().product()).into_iter().map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), &Device::flex())
}

fn host<const D: usize>(tensor: Tensor<D>) -> HostTensor {
    HostTensor::new(&tensor.dims(), tensor.into_data().iter::<f32>().collect())
}

fn lazy() -> Init {
    Init::lazy(0, &Device::flex())
}

fn filled<N: Network>(config: &N::Config) -> Outcome<N> {
    let network = N::build(config, &mut lazy());
    Ok(fill_by_state_dict_name(network, |name, shape| Ok(Some(golden_values(name, shape))))?)
}

/// Both styles of published networks at a size that takes no time.
fn unets() -> [(&'static str, UNetConfig); 2] {
    let (mut sd15, mut sd21) = (Preset::Tiny.unet(), Preset::Tiny.unet());
    sd15.encoder.projection = ProjectionKind::Convolution;
    sd21.encoder.heads = AttentionHeads::Width(16);
    [("unet_sd15", sd15), ("unet_sd21", sd21)]
}

struct Inputs {
    sample: Tensor<4>,
    text: Tensor<3>,
    times: Vec<f64>,
    condition: Tensor<4>,
    image: Tensor<4>,
    latent: Tensor<4>,
}

fn inputs() -> Inputs {
    Inputs {
        sample: noise("sample", [2, 4, 9, 14]),
        text: noise("text", [2, 7, 64]),
        times: vec![981.0, 20.0],
        condition: noise("condition", [2, 5, 72, 112]),
        image: noise("image", [1, 3, 64, 112]),
        latent: noise("latent", [1, 4, 8, 14]),
    }
}

fn write(root: &Path) -> Outcome<()> {
    std::fs::create_dir_all(root)?;
    let given = inputs();
    let mut io = BTreeMap::from([
        ("sample".to_owned(), host(given.sample.clone())),
        ("text".to_owned(), host(given.text.clone())),
        ("condition".to_owned(), host(given.condition.clone())),
        ("image".to_owned(), host(given.image.clone())),
        ("latent".to_owned(), host(given.latent.clone())),
    ]);
    let mut put = |name: &str, tensor: HostTensor| io.insert(name.to_owned(), tensor);
    for (name, config) in unets() {
        let unet: UNet2DCondition = filled(&config)?;
        save_folder(&unet, root.join(name))?;
        put(name, host(unet.forward(given.sample.clone(), &given.times, given.text.clone())));
        adapters(root, name, unet, &given, &mut put)?;
    }
    let [(_, config), _] = unets();
    let unet: UNet2DCondition = filled(&config)?;
    let vae: AutoencoderKL = filled(&Preset::Tiny.vae())?;
    save_folder(&vae, root.join("vae"))?;
    put("moments", host(vae.moments(given.image.clone())));
    put("decoded", host(vae.decode(given.latent.clone())));
    let single = [single_file_tensors(&unet)?, single_file_tensors(&vae)?].concat();
    save_single_file(root.join("single.safetensors"), &single)?;

    let mut config = Preset::Tiny.controlnet(5);
    config.encoder = unet.config().encoder.clone();
    let control: ControlNet = filled(&config)?;
    save_folder(&control, root.join("controlnet"))?;
    let told = ControlInputs {
        timesteps: &given.times,
        context: given.text.clone(),
        condition: given.condition.clone(),
        views: None,
        scale: 0.7,
    };
    let residuals = control.forward(given.sample.clone(), &told);
    let told =
        UNetInputs { timesteps: &given.times, context: given.text.clone(), views: None, control: Some(&residuals) };
    put("controlled", host(unet.forward_with(given.sample.clone(), &told)));
    text(root, &mut put)?;
    let tensors: Vec<_> = io.into_iter().collect();
    Ok(write_safetensors(root.join("io.safetensors"), &tensors, &BTreeMap::new())?)
}

/// An adapter on every attention projection and on some convolutions, in both layouts of pipelines.
fn adapters(
    root: &Path,
    name: &str,
    unet: UNet2DCondition,
    given: &Inputs,
    put: &mut dyn FnMut(&str, HostTensor) -> Option<HostTensor>,
) -> Outcome<()> {
    let targets = ["to_q", "to_k", "to_v", "to_out.0", "conv1", "ff.net.0.proj", "proj_in"].map(str::to_owned);
    let config = lora::LoraConfig { rank: 3, alpha: 6.0, targets: targets.to_vec() };
    let unet = lora::attach(unet, "style", &config, 5)?;
    // Freshly attached adapters add nothing.
    let unet = fill_some_params(unet, |path, shape| {
        let values = || golden_values(path, shape).into_iter().map(|v| 0.3 * v).collect();
        Ok(path.split('.').any(|segment| segment == "lora").then(values))
    })?;
    put(&format!("{name}_lora"), host(unet.forward(given.sample.clone(), &given.times, given.text.clone())));
    for (layout, folder) in [(LoraLayout::Diffusers, "lora_diffusers"), (LoraLayout::Peft, "lora_peft")] {
        let folder = root.join(folder).join(name);
        std::fs::create_dir_all(&folder)?;
        let path = folder.join("pytorch_lora_weights.safetensors");
        lora::save(&unet, "style", &path, ("unet", layout), &BTreeMap::new())?;
    }
    Ok(())
}

/// A small text encoder with CLIP's own vocabulary, if the table is there.
fn text(root: &Path, put: &mut dyn FnMut(&str, HostTensor) -> Option<HostTensor>) -> Outcome<()> {
    let Some(weights) = std::env::var_os("RIGSCAPE_WEIGHTS") else {
        eprintln!("without RIGSCAPE_WEIGHTS there is no vocabulary, so no text encoder is written");
        return Ok(());
    };
    let pairs = BytePairs::from_table(&Path::new(&weights).join("bpe_simple_vocab_16e6.txt.gz"))?;
    let tokenizer = ClipTokenizer::new(pairs, TextCleaning::Transformers, Padding::EndToken);
    let sizes = ClipTextConfig {
        hidden_size: 32,
        intermediate_size: 64,
        num_hidden_layers: 3,
        num_attention_heads: 4,
        projection_dim: 32,
        ..ClipTextConfig::sd15()
    };
    let model = ClipTextModel::new(&sizes.checked()?, &mut lazy());
    let model = fill_some_params(model, |name, shape| Ok(Some(golden_values(name, shape))))?;
    save_clip(root, &tokenizer, &model)?;
    let tokens = tokenizer.tokenize(&CAPTIONS);
    let ids = tokens.ids().iter().map(|id| *id as f32).collect();
    put("token_ids", HostTensor::new(&[CAPTIONS.len(), tokens.width()], ids));
    put("text_states", host(model.forward(&tokens).states));
    Ok(())
}

fn check(root: &Path) -> Outcome<()> {
    let given = inputs();
    let wanted = WeightFile::open(root.join("io.safetensors"))?;
    let device = Device::flex();
    for (name, config) in unets() {
        let unet: UNet2DCondition = load_folder(root.join(name), &device)?;
        let say = |unet: &UNet2DCondition| unet.forward(given.sample.clone(), &given.times, given.text.clone());
        compare(&wanted, name, say(&unet))?;
        let adapter = root.join("lora").join(name).join("pytorch_lora_weights.safetensors");
        compare(&wanted, &format!("{name}_lora"), say(&lora::load(unet, "style", &adapter, "unet")?))?;
        let path = root.join(format!("{name}_single.safetensors"));
        if path.exists() {
            let single = load_single_file(UNet2DCondition::new(&config, &mut lazy()), &WeightFile::open(path)?)?;
            compare(&wanted, name, say(&single))?;
        }
    }
    let vae: AutoencoderKL = load_folder(root.join("vae"), &device)?;
    compare(&wanted, "moments", vae.moments(given.image.clone()))?;
    compare(&wanted, "decoded", vae.decode(given.latent.clone()))?;
    if root.join("text_encoder").exists() {
        let model = load_text_encoder(&root.join("text_encoder"), &device)?;
        let tokens = load_tokenizer(&root.join("tokenizer"))?.tokenize(&CAPTIONS);
        compare(&wanted, "text_states", model.forward(&tokens).states)?;
    }
    Ok(())
}

fn compare<const D: usize>(wanted: &WeightFile, name: &str, got: Tensor<D>) -> Outcome<()> {
    let wanted = wanted.tensor(name)?;
    let got = host(got);
    let scale = wanted.data.iter().fold(1.0_f64, |scale, v| scale.max(f64::from(v.abs())));
    let pairs = got.data.iter().zip(&wanted.data);
    let off = pairs.map(|(a, b)| f64::from(a - b).abs()).fold(0.0, f64::max) / scale;
    eprintln!("{name:<16} off by {off:.1e}");
    let close = off <= TOLERANCE;
    if got.shape != wanted.shape || !close {
        return Err(format!("{name}: shapes {:?} and {:?}, off by {off:e}", got.shape, wanted.shape).into());
    }
    Ok(())
}
