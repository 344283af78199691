//! Runs of `train-autoencoder` and `train-unet` at debug size, one on the other's result, as a user starts them.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

use crate::programs::rigscape;
use crate::runs::{assert_equal_parts, checkpoint, find_number, must, tensors};

const COMMON: &str = r#"
seed = 3
[image]
height = 32
width = 32
[[data.train]]
kind = "procedural"
name = "six"
seed = 1
scenes = 3
frames_per_scene = 4
rig = { preset = "nuscenes" }
[[data.train]]
kind = "procedural"
name = "chain"
seed = 2
scenes = 3
frames_per_scene = 4
rig = { preset = "waymo" }
[[data.validation]]
kind = "procedural"
name = "six"
seed = 9
scenes = 2
frames_per_scene = 1
rig = { preset = "nuscenes" }
[data.loader]
batch_size = 2
[ema]
decay = 0.9
[model]
preset = "debug"
[train]
steps = 8
log_every = 1
validate_every = 4
preview_every = 8
checkpoint_every = 4
"#;

const AUTOENCODER: &str = r#"
views = 5
[run]
name = "autoencoder"
root = "@ROOT@"
[loss.adversarial.hinge]
discriminator_start = 0.0
generator_start = 0.25
views = 2
[evaluation]
frames = 1
final_frames = 1
baseline_frames = 2
"#;

const UNET: &str = r#"
autoencoder = "@ROOT@/autoencoder/vae"
[run]
name = "unet"
root = "@ROOT@"
[model.encoder]
cross_view = "sum"
[text.small]
width = 16
layers = 1
heads = 2
tokens = 48
[sampling]
sampler = { ddim = { steps = 3 } }
frames = 1
[evaluation]
frames = 1
final_frames = 2
"#;

/// The common part and one of its own as `<name>.toml`; single keys must stand before tables.
fn write_config(folder: &Path, name: &str, own: &str) -> PathBuf {
    let own = own.replace("@ROOT@", &folder.join("runs").to_string_lossy());
    let (keys, tables) = own.split_at(own.find("[run]").unwrap());
    let path = folder.join(format!("{name}.toml"));
    std::fs::write(&path, format!("{keys}{COMMON}{tables}")).unwrap();
    path
}

fn run(program: &str, config: &Path, extra: &[&str]) -> Output {
    Command::new(program).arg("--config").arg(config).args(extra).output().unwrap()
}

fn autoencoder(config: &Path, extra: &[&str]) -> Output {
    run(env!("CARGO_BIN_EXE_train-autoencoder"), config, extra)
}

fn unet(config: &Path, extra: &[&str]) -> Output {
    run(env!("CARGO_BIN_EXE_train-unet"), config, extra)
}

fn summary(run: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(run.join("summary.json")).unwrap()).unwrap()
}

/// Adapters on a finished run: only their factors are kept, they continue bit for bit, and they paint.
fn check_adapters(config: &Path, base: &Path) {
    let start = format!("init_from={:?}", base.to_string_lossy());
    let adapted = |name: &str, extra: &[&str]| {
        let name = format!("run.name={name}");
        let settings = ["--set", &start, "--set", "adapter.rank=2", "--set", "checkpointing=true", "--set", &name];
        must(unet(config, &[&settings[..], extra].concat()))
    };
    let told = adapted("lora", &[]);
    adapted("lora-broken", &["--stop-after", "5"]);
    adapted("lora-broken", &["--resume"]);
    let folder = |name: &str| base.with_file_name(name);
    assert_equal_parts(&folder("lora"), &folder("lora-broken"), &["model", "ema", "optimizer"]);
    for (file, bytes) in checkpoint(&folder("lora")).iter().filter(|(file, _)| file.ends_with(".safetensors")) {
        let kept = tensors(bytes);
        assert!(!kept.is_empty() && kept.iter().all(|(name, _)| name.contains(".lora.stack.")), "{file}");
    }
    let written = folder("lora").join("lora/pytorch_lora_weights.safetensors");
    assert!(written.is_file() && told.contains("lora") && !folder("lora").join("pipeline").exists());
    let (run, out) = (folder("lora"), folder("lora").join("sample.png"));
    let text = |path: &Path| path.to_string_lossy().into_owned();
    must(rigscape(&["sample", "--checkpoint", &text(&run), "--out", &text(&out), "--caption", "a rainy night"]));
    let refused = |extra: &[&str]| String::from_utf8(unet(config, extra).stderr).unwrap();
    assert!(refused(&["--set", "adapter.rank=2", "--set", "run.name=x"]).contains("init_from"));
    let on_adapters = format!("init_from={:?}", text(&run));
    assert!(refused(&["--set", &on_adapters, "--set", "run.name=x"]).contains("adapters only"));
}

#[test]
fn an_autoencoder_and_a_unet_on_it_are_trained_stopped_and_resumed() {
    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let text = must(autoencoder(&write_config(whole.path(), "autoencoder", AUTOENCODER), &[]));
    assert!(text.contains("held-out reconstruction"), "{text}");
    let config = write_config(broken.path(), "autoencoder", AUTOENCODER);
    must(autoencoder(&config, &["--stop-after", "5"]));
    must(autoencoder(&config, &["--resume"]));
    let folder = |root: &tempfile::TempDir, name: &str| root.path().join("runs").join(name);
    let parts = ["model", "ema", "optimizer_generator", "discriminator", "optimizer_discriminator"];
    assert_equal_parts(&folder(&whole, "autoencoder"), &folder(&broken, "autoencoder"), &parts);
    let told = summary(&folder(&whole, "autoencoder"));
    let vae = folder(&whole, "autoencoder").join("vae/config.json");
    let saved: Value = serde_json::from_str(&std::fs::read_to_string(vae).unwrap()).unwrap();
    assert_eq!(saved["scaling_factor"], told["scaling_factor"]);
    let product = told["scaling_factor"].as_f64().unwrap() * told["latent_deviation"].as_f64().unwrap();
    assert!((product - 1.0).abs() < 1e-9, "{told}");
    assert!(folder(&whole, "autoencoder").join("pictures/validation_0.png").exists());

    let text = must(unet(&write_config(whole.path(), "unet", UNET), &[]));
    assert!(text.contains("held-out error"), "{text}");
    let config = write_config(broken.path(), "unet", UNET);
    must(unet(&config, &["--stop-after", "5"]));
    must(unet(&config, &["--resume"]));
    assert_equal_parts(&folder(&whole, "unet"), &folder(&broken, "unet"), &["model", "ema", "optimizer"]);
    let run = folder(&whole, "unet");
    let told = summary(&run);
    assert!((told["held_out"]["loss_of_zero"].as_f64().unwrap() - 1.0).abs() < 0.2, "{told}");
    assert_eq!(told["captions"].as_array().unwrap().len(), 1);
    let sheet = image::open(run.join("pictures/samples.png")).unwrap();
    assert!(sheet.width() > 6 * 32 && sheet.height() > 2 * 32);
    for file in ["unet/config.json", "vae/config.json", "scheduler/scheduler_config.json"] {
        assert!(run.join("pipeline").join(file).exists(), "{file}");
    }
    // Block by block the same network comes out, but for the order of sums.
    must(unet(&whole.path().join("unet.toml"), &["--set", "run.name=blocks", "--set", "checkpointing=true"]));
    let loss = |run: &Path| summary(run)["held_out"]["loss"].as_f64().unwrap();
    let (one, other) = (loss(&run), loss(&folder(&whole, "blocks")));
    assert!((one - other).abs() < 1e-3 * one, "{one} {other}");
    check_adapters(&whole.path().join("unet.toml"), &run);
    let out = whole.path().join("sample.png");
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let two = ["--caption", "a rainy night", "--caption", "a sunny day", "--guidance", "2"];
    must(rigscape(&[&["sample", "--checkpoint", &text(&run), "--out", &text(&out)], &two[..]].concat()));
    let sheet = image::open(&out).unwrap();
    assert_eq!((sheet.width(), sheet.height()), (6 * 34 + 2, 2 * 34 + 2));
}

#[test]
fn views_may_be_painted_alone_and_threads_do_not_matter() {
    let roots = ["1", "3"].map(|threads| (threads, tempfile::tempdir().unwrap()));
    for (threads, root) in &roots {
        let config = write_config(root.path(), "autoencoder", AUTOENCODER);
        must(autoencoder(&config, &["--set", "train.steps=1", "--set", "loss.adversarial=off"]));
        let alone = UNET.replace("[model.encoder]\ncross_view = \"sum\"\n", "");
        assert_ne!(alone, UNET);
        let config = write_config(root.path(), "unet", &alone);
        let mut command = Command::new(env!("CARGO_BIN_EXE_train-unet"));
        command.arg("--config").arg(config).args(["--set", "train.accumulate=3", "--set", "sampling.guidance=1.0"]);
        must(command.env("RAYON_NUM_THREADS", threads).output().unwrap());
    }
    let [(_, one), (_, three)] = &roots;
    let of = |root: &tempfile::TempDir| root.path().join("runs/unet");
    assert_equal_parts(&of(one), &of(three), &["model", "ema", "optimizer"]);
}

#[test]
fn a_unet_learns_one_scene() {
    let folder = tempfile::tempdir().unwrap();
    must(autoencoder(&write_config(folder.path(), "autoencoder", AUTOENCODER), &["--set", "train.steps=1"]));
    let set = ["train.steps=150", "train.validate_every=0", "train.preview_every=0", "train.checkpoint_every=150"];
    let more = ["optimizer.learning_rate=3e-3", "data.train.0.scenes=1", "data.train.0.frames_per_scene=1"];
    let only = ["data.mixture.weights={ explicit = [1.0, 0.0] }", "diffusion.caption_dropout=0.0"];
    let set: Vec<&str> = set.iter().chain(&more).chain(&only).flat_map(|entry| ["--set", entry]).collect();
    must(unet(&write_config(folder.path(), "unet", UNET), &set));
    let rows = std::fs::read_to_string(folder.path().join("runs/unet/metrics.jsonl")).unwrap();
    let losses: Vec<f64> = rows
        .lines()
        .map(|row| serde_json::from_str::<Value>(row).unwrap())
        .filter_map(|row| find_number(&row, "loss"))
        .collect();
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (first, last) = (mean(&losses[..10]), mean(&losses[losses.len() - 30..]));
    assert!(last < 0.7 * first, "loss went from {first} to {last}");
}

#[test]
fn mistakes_are_refused_with_the_cure() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |output: Output| {
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && !text.contains("panicked"), "{text}");
        text
    };
    let config = write_config(folder.path(), "unet", UNET);
    let missing = refused(unet(&config, &[]));
    assert!(missing.contains("train-autoencoder") && missing.contains("autoencoder/vae"), "{missing}");
    let width = refused(unet(&config, &["--set", "text.small.width=32"]));
    assert!(width.contains("context_width"), "{width}");
    let steps = refused(unet(&config, &["--set", "sampling.sampler={ ddim = { steps = 0 } }"]));
    assert!(steps.contains("unet.toml") && steps.contains("steps"), "{steps}");
    let clip = refused(unet(&config, &["--set", "text={ clip = \"nowhere\" }"]));
    assert!(clip.contains("nowhere"), "{clip}");
    let size =
        refused(autoencoder(&write_config(folder.path(), "autoencoder", AUTOENCODER), &["--set", "image.width=30"]));
    assert!(size.contains("multiples of 4"), "{size}");
}
