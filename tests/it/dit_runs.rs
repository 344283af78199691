//! `encode` and `train-dit` at debug size on a debug autoencoder, as a user starts them, and what a checkpoint gives.

use std::path::Path;

use burn::tensor::Tensor;
use data::latents::{LatentDataset, LatentFolder};
use data::layout::Layout;
use data::{DatasetConfig, SceneDataset};
use diffusion::SamplerConfig;
use rigscape::dit::{Guidance, LoadedDit, NoiseKey};
use serde_json::Value;

use crate::dit_place::{Place, refusal};
use crate::programs::{files_below, rigscape};
use crate::runs::{assert_equal_parts, find_number, must};

fn rows(run: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    text.lines().map(|row| serde_json::from_str(row).unwrap()).collect()
}

fn ddim(steps: usize) -> SamplerConfig {
    serde_json::from_value(serde_json::json!({ "ddim": { "steps": steps } })).unwrap()
}

fn key(token: &str, draw: u64) -> NoiseKey {
    NoiseKey { seed: 5, token: token.to_owned(), draw }
}

fn values(latents: &Tensor<4>) -> Vec<f32> {
    latents.clone().into_data().iter::<f32>().collect()
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// Layouts of held-out frames.
fn layouts(loaded: &LoadedDit) -> Vec<Layout> {
    let config: DatasetConfig = loaded.experiment.data.validation[0].clone();
    let dataset = data::open(&config).unwrap();
    let of = |index| Layout::of_frame(&dataset.frame(index).unwrap(), &loaded.conditioner.classes);
    (0..dataset.len()).map(of).collect()
}

#[test]
fn a_run_that_was_stopped_and_resumed_ends_with_the_same_bits() {
    let (whole, broken) = (Place::new("2"), Place::new("2"));
    let text = must(whole.train(&[], &[]));
    assert!(text.contains("held-out error") && text.contains("encoding the pictures once"), "{text}");
    must(broken.train(&[], &["--stop-after", "5"]));
    must(broken.train(&[], &["--resume"]));
    let (one, two) = (whole.path("runs/dit"), broken.path("runs/dit"));
    assert_equal_parts(&one, &two, &["model", "ema", "optimizer"]);

    let summary: Value = serde_json::from_str(&std::fs::read_to_string(one.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["generated"]["guidance_zero_difference"], 0.0, "{summary}");
    assert!(summary["generated"]["guided_difference"].as_f64().unwrap() > 0.0, "{summary}");
    assert!((summary["held_out"]["loss_of_zero"].as_f64().unwrap() - 1.0).abs() < 0.3, "{summary}");
    for name in ["layout_0_guidance_0.png", "layout_0_guidance_1.png", "layout_0_guidance_4.png"] {
        assert!(image::open(one.join("pictures").join(name)).unwrap().width() >= 400, "{name}");
    }
    // Each logged step tells the losses of the parts of the process that it saw, and whether the condition is alive.
    let logged: Vec<Value> = rows(&one).into_iter().filter(|row| find_number(row, "loss").is_some()).collect();
    assert_eq!(logged.len(), 8);
    for row in &logged {
        assert!(find_number(row, "layout_share").unwrap() > 0.0, "{row}");
        assert!((0..10).any(|part| find_number(row, &format!("loss_t{part}")).is_some()), "{row}");
    }

    // Latents are read again, not made again; other classes, latents and autoencoders are refused.
    let again = must(whole.train(&["train.steps=9"], &["--resume"]));
    assert!(!again.contains("encoding"), "{again}");
    let classes = r#"condition.classes={ names = ["truck", "car", "pedestrian"] }"#;
    let order = whole.refused(&["train.steps=10", classes], &["--resume"]);
    assert!(order.contains(r#"["car", "truck", "pedestrian"]"#), "{order}");
    let other = Place::new("3");
    let vae = format!("autoencoder={}", other.text("runs/run"));
    let refused = whole.refused(&[&vae], &[]);
    assert!(refused.contains("encode again") && refused.contains("latents"), "{refused}");
    let settings = whole.refused(&["data.train.0.scenes=2"], &[]);
    assert!(settings.contains("other settings") && settings.contains("leave [data] out"), "{settings}");
    must(whole.train(&["data={}", "train.steps=1", "run.name=latents-alone"], &[]));

    let loaded = LoadedDit::open(&one, None).unwrap();
    loaded.autoencoder(None).unwrap();
    let refused = format!("{:#}", loaded.autoencoder(Some(&other.path("runs/run"))).unwrap_err());
    assert!(refused.contains(&loaded.statistics.vae_hash), "{refused}");
    let mixed = format!("{:#}", LoadedDit::open(&whole.path("runs/run"), None).unwrap_err());
    assert!(mixed.contains("train-dit"), "{mixed}");
    samples_follow_their_own_key_and_layout(&loaded);
}

fn samples_follow_their_own_key_and_layout(loaded: &LoadedDit) {
    let layouts = layouts(loaded);
    let keys: Vec<NoiseKey> = (0..3).map(|at| key("frame", at)).collect();
    let (sampler, guidance) = (ddim(3), Guidance::TwoPass(3.0));
    let together = loaded.sample(&layouts[..3], &keys, &sampler, guidance).unwrap();
    assert_eq!(together.dims()[0], 3);
    let count = values(&together).len() / 3;
    let alone = values(&loaded.sample(&layouts[1..2], &keys[1..2], &sampler, guidance).unwrap());
    let among = values(&together)[count..2 * count].to_vec();
    assert!(largest_difference(&alone, &among) < 1e-4, "neighbours matter: {}", largest_difference(&alone, &among));
    let again = values(&loaded.sample(&layouts[1..2], &keys[1..2], &sampler, guidance).unwrap());
    assert_eq!(alone, again);
    for other in [key("frame", 7), key("other", 1), NoiseKey { seed: 6, ..keys[1].clone() }] {
        let other = values(&loaded.sample(&layouts[1..2], &[other], &sampler, guidance).unwrap());
        assert!(largest_difference(&alone, &other) > 0.1);
    }
    // Guidance 0 ignores the layout to the last bit; an empty layout is a condition, no layout is none (trap 2).
    let sample = |layout: &Layout, guidance| {
        values(&loaded.sample(std::slice::from_ref(layout), &keys[..1], &sampler, guidance).unwrap())
    };
    let empty = Layout::default();
    for zero in [Guidance::TwoPass(0.0), Guidance::ScaledCondition(0.0)] {
        assert_eq!(sample(&layouts[0], zero), sample(&empty, zero));
    }
    assert_ne!(sample(&empty, Guidance::TwoPass(1.0)), sample(&empty, Guidance::TwoPass(0.0)));
    assert_ne!(sample(&layouts[0], Guidance::TwoPass(1.0)), sample(&empty, Guidance::TwoPass(1.0)));
    assert_ne!(sample(&layouts[0], Guidance::TwoPass(2.0)), sample(&layouts[0], Guidance::ScaledCondition(2.0)));
    // A sampler with fresh noise at each step is no exception.
    let ddpm: SamplerConfig =
        serde_json::from_value(serde_json::json!({ "ddim": { "steps": 3, "eta": 1.0 } })).unwrap();
    let two = values(&loaded.sample(&layouts[..2], &keys[..2], &ddpm, guidance).unwrap());
    let one = values(&loaded.sample(&layouts[1..2], &keys[1..2], &ddpm, guidance).unwrap());
    assert!(largest_difference(&two[count..], &one) < 1e-4);
    let flow: SamplerConfig = serde_json::from_value(serde_json::json!({ "flow_euler": { "steps": 3 } })).unwrap();
    assert!(loaded.sample(&layouts[..1], &keys[..1], &flow, guidance).is_err());
    assert!(loaded.sample(&layouts[..2], &keys[..1], &sampler, guidance).is_err());
}

#[test]
fn accumulated_samples_are_those_of_one_batch() {
    let place = Place::new("1");
    let same = ["train.steps=2", "train.validate_every=0", "optimizer.gradient_clip=off"];
    let run = |name: &str, batch: &str, accumulate: &str| {
        let name = format!("run.name={name}");
        let (batch, accumulate) = (format!("data.loader.batch_size={batch}"), format!("train.accumulate={accumulate}"));
        must(place.train(
            &[&same[..], &[&name, &batch, &accumulate, "evaluation.generated=0", "evaluation.edits=0"]].concat(),
            &[],
        ));
    };
    run("joined", "4", "1");
    run("apart", "1", "4");
    // Later steps differ by more than rounding, because Adam makes whole steps of gradients that are nearly 0.
    let losses = |name: &str| -> Vec<f64> {
        rows(&place.path("runs").join(name)).iter().filter_map(|row| find_number(row, "loss")).collect()
    };
    for (joined, apart) in losses("joined").into_iter().zip(losses("apart")) {
        assert!((joined - apart).abs() < 1e-3, "{joined} {apart}");
    }
}

#[test]
fn two_scenes_are_learned_and_told_apart_by_their_layouts() {
    let place = Place::new("40");
    let only = "data.train=[{ kind = \"procedural\", seed = 1, scenes = 2, frames_per_scene = 1 }]";
    let set = [
        only,
        "train.steps=300",
        "train.validate_every=0",
        "data.loader.batch_size=8",
        "optimizer.learning_rate=4e-3",
        "ema.decay=0.97",
        "latents.posterior=mean",
        // So small a network never knows the noise well enough at the highest levels for a sample.
        "diffusion={ schedule = { target = \"velocity\" } }",
        "evaluation.generated=0",
        "evaluation.edits=0",
    ];
    must(place.train(&set, &[]));
    let run = place.path("runs/dit");
    let losses: Vec<f64> = rows(&run).iter().filter_map(|row| find_number(row, "loss")).collect();
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (first, last) = (mean(&losses[..5]), mean(&losses[losses.len() - 40..]));
    assert!(last < 0.2 * first, "loss went from {first} to {last}");

    let loaded = LoadedDit::open(&run, None).unwrap();
    let stored = LatentFolder::open(&place.path("latents/train")).unwrap();
    let truth: Vec<Vec<f32>> = (0..2).map(|index| stored.latent(index).unwrap().mean).collect();
    let layouts: Vec<Layout> =
        (0..2).map(|index| Layout::of_frame(&stored.frame(index).unwrap(), &loaded.conditioner.classes)).collect();
    // Scaled training latents have unit variance (trap 1).
    let scaling = loaded.statistics.scaling(loaded.experiment.latents.scale);
    let cells = truth[0].len() / scaling.len();
    let scaled = truth
        .iter()
        .flat_map(|latent| latent.chunks(cells).zip(&scaling))
        .flat_map(|(plane, (offset, factor))| plane.iter().map(move |value| (f64::from(*value) - offset) * factor));
    let scaled: Vec<f64> = scaled.collect();
    let variance = scaled.iter().map(|value| value * value).sum::<f64>() / scaled.len() as f64;
    assert!((0.95..1.05).contains(&variance.sqrt()), "{variance}");
    let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    for (own, layout) in layouts.iter().enumerate() {
        let made =
            loaded.sample(std::slice::from_ref(layout), &[key("frame", 0)], &ddim(20), Guidance::TwoPass(1.0)).unwrap();
        let made = values(&made);
        let (near, far) = (distance(&made, &truth[own]), distance(&made, &truth[1 - own]));
        assert!(near < 0.5 * far, "layout {own} gives a scene at {near} from its own and {far} from the other");
    }
}

#[test]
fn other_sources_processes_and_targets_run() {
    let place = Place::new("1");
    let short = ["train.steps=2", "train.checkpoint_every=1", "evaluation.generated=0", "evaluation.edits=0"];
    let run = |name: &str, set: &[&str], options: &[&str]| {
        let name = format!("run.name={name}");
        must(place.train(&[&short[..], &[&name], set].concat(), options))
    };
    run(
        "velocity",
        &[
            "diffusion={ schedule = { target = \"velocity\", weight = { min_snr = 5.0 }, schedule = { beta = \"cosine\" } } }",
        ],
        &[],
    );
    run("clean", &["diffusion={ schedule = { target = \"clean\" } }", "latents.scale=global"], &[]);
    run("flow", &["diffusion={ rectified_flow = {} }", "sampling.sampler={ flow_euler = { steps = 3 } }"], &[]);
    let loaded = LoadedDit::open(&place.path("runs/flow"), None).unwrap();
    let layouts = layouts(&loaded);
    let made =
        loaded.sample(&layouts[..1], &[key("f", 0)], &loaded.experiment.sampler(), Guidance::TwoPass(2.0)).unwrap();
    assert!(values(&made).iter().all(|value| value.is_finite()));

    // Pictures at every step, also across a resume.
    let online = "latents.source={ online = { statistics_samples = 4 } }";
    let set = ["train.steps=8", online, "train.checkpoint_every=4"];
    run("online", &set, &[]);
    run("online-broken", &[&set[..], &["run.name=online-broken"]].concat(), &["--stop-after", "3"]);
    run("online-broken", &[&set[..], &["run.name=online-broken"]].concat(), &["--resume"]);
    let folder = |name: &str| place.path("runs").join(name);
    assert_equal_parts(&folder("online"), &folder("online-broken"), &["model", "ema", "optimizer"]);

    // The published tree, written by `encode` and read back; latents that do not decode into their pictures are refused.
    let (vae, tree, config) = (place.text("runs/run"), place.text("tree"), place.text("dit.toml"));
    let tree_format = ["--format", "npy_tree", "--layout", "chw"];
    let encode = [&["encode", "--checkpoint", &vae, "--config", &config, "--out", &tree], &tree_format[..]].concat();
    let twice = refusal(rigscape(&encode));
    assert!(twice.contains("scene-0000") && twice.contains("both"), "two cars with logs of one name: {twice}");
    let one = "data.train=[{ kind = \"procedural\", name = \"six\", seed = 1, scenes = 3, frames_per_scene = 2 }]";
    let (vae, tree) = (place.text("runs/run"), place.text("one-tree"));
    let encode = ["encode", "--checkpoint", &vae, "--config", &config, "--out", &tree, "--set", one];
    let encode = [&encode[..], &tree_format[..]].concat();
    let text = must(rigscape(&encode));
    assert!(text.contains("6 latents (0 of an earlier run") && text.contains("3 latents"), "{text}");
    assert_eq!(files_below(&place.path("one-tree/bev-lidar/train"), "npy").len(), 6);
    assert!(must(rigscape(&encode)).contains("6 latents (6 of an earlier run"));
    let source = |layout: &str, least: &str| {
        format!("latents.source={{ npy_tree = {{ root = {tree:?}, layout = \"{layout}\", least_psnr_db = {least} }} }}")
    };
    run("tree", &[one, &source("chw", "0.0")], &[]);
    let refused = place.refused(&[one, &source("chw", "90.0")], &[]);
    assert!(refused.contains("do not decode into their pictures") && refused.contains("layout"), "{refused}");
    // 4 x 4 cells of 4 channels: rows of channels and channels of rows look alike.
    let ambiguous = format!("latents.source={{ npy_tree = {{ root = {tree:?}, least_psnr_db = 0.0 }} }}");
    let refused = place.refused(&[one, &ambiguous], &[]);
    assert!(refused.contains("chw or hwc") && refused.contains(".npy"), "{refused}");
}

#[test]
fn latents_are_encoded_by_command_and_mistakes_are_named() {
    let place = Place::new("1");
    let (vae, out, config) = (place.text("runs/run"), place.text("latents"), place.text("dit.toml"));
    let encode = ["encode", "--checkpoint", &vae, "--config", &config, "--out", &out, "--shard-samples", "5"];
    let text = must(rigscape(&encode));
    assert!(text.contains("12 latents (0 of an earlier run") && text.contains("3 latents"), "{text}");
    assert!(must(rigscape(&encode)).contains("12 latents (12 of an earlier run"));
    let statistics = std::fs::read_to_string(place.path("latents/train/latent_stats.json")).unwrap();
    let statistics: Value = serde_json::from_str(&statistics).unwrap();
    let mut fields: Vec<&str> = statistics.as_object().unwrap().keys().map(String::as_str).collect();
    fields.sort_unstable();
    let wanted = ["count", "dataset", "global_mean", "global_std", "grid", "mean", "posterior", "std", "vae_hash"];
    assert_eq!(fields, wanted);
    assert_eq!((statistics["count"].as_u64(), statistics["dataset"].as_str()), (Some(12), Some("six+seven")));
    // What the command wrote is what the training wants.
    let text = must(place.train(&["train.steps=1", "evaluation.generated=0", "evaluation.edits=0"], &[]));
    assert!(!text.contains("encoding the pictures once"), "{text}");

    let other = refusal(rigscape(&[&encode[..], &["--dtype", "f32"]].concat()));
    assert!(other.contains("another numbers (F16, not F32)") && other.contains("latents"), "{other}");
    let missing = refusal(rigscape(&["encode", "--checkpoint", "nowhere", "--config", &config, "--out", &out]));
    assert!(missing.contains("nowhere") && missing.contains("train-vae"), "{missing}");
    let nothing = refusal(rigscape(&["encode", "--checkpoint", &vae, "--out", &out]));
    assert!(nothing.contains("--config"), "{nothing}");
    for (set, want) in [
        ("autoencoder=nowhere", "nowhere"),
        ("data.loader.augment.flip_probability=0.5", "neither mirrored nor turned"),
        ("data.loader.augment.grayscale_probability=0.5", "online"),
        ("condition.dropout=1.5", "condition.dropout"),
        ("condition.classes={ names = [\"car\", \"car\"] }", "car occurs twice"),
        ("model.heads=5", "5 heads"),
        ("model.patch=3", "patch"),
        ("sampling.sampler={ flow_euler = { steps = 3 } }", "rectified flows"),
        ("sampling.sampler={ ddim = { steps = 0 } }", "sampling.sampler"),
        ("latents.source={ moments = { folder = \"elsewhere\" } }", "elsewhere"),
        ("modle.patch=1", "modle"),
    ] {
        let text = place.refused(&[set, "data={}"][..1 + usize::from(set.contains("elsewhere"))], &[]);
        assert!(text.contains(want), "{set}: {text}");
    }
    // A shard that lost its end is found before the first step.
    let shard = place.path("latents/train/shard_00001.safetensors");
    let bytes = std::fs::read(&shard).unwrap();
    std::fs::write(&shard, &bytes[..bytes.len() / 2]).unwrap();
    let cut = place.refused(&[], &[]);
    assert!(cut.contains("shard_00001"), "{cut}");
}
