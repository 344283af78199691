//! Released checkpoints as a user meets them: import, use, fine-tuning, and what is refused.

use std::path::PathBuf;

use burn::tensor::Device;
use nn::Init;
use nn::weights::param_shapes;
use vae::BevVae;
use vae::official::{official_name, official_shape};

use crate::lightning::{Averaged, Named, checkpoint, compressed};
use crate::programs::{refusal, rigscape};
use crate::runs::{must, train};

/// A network of the release's make that takes seconds.
const MODEL: &str = r#"[model]
preset = "paper"
latent_channels = 3
image = { height = 16, width = 16, channels = 128, heads = 4, encoder_blocks = 1, decoder_blocks = 1 }
scene = { channels = 32, heads = 2, encoder_blocks = 1, decoder_blocks = 1, encoder_points = 1, decoder_points = 1 }
grid = { cells = [4, 8, 8] }
state = { channels_per_height = 6, squeeze_channels = 2, blocks = 1 }
frustum = { depths = 4, bin_m = 8.0, rows = 2, columns = 2 }
"#;

const DATA: &str = "[[data]]\nkind = \"procedural\"\nseed = 4\nscenes = 1\nframes_per_scene = 2\n";

struct Workplace {
    folder: tempfile::TempDir,
}

impl Workplace {
    fn new() -> Self {
        let place = Self { folder: tempfile::tempdir().unwrap() };
        std::fs::write(place.path("model.toml"), MODEL).unwrap();
        std::fs::write(place.path("data.toml"), DATA).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).to_string_lossy().into_owned()
    }

    fn import(&self, bytes: &[u8], extra: &[&str]) -> std::process::Output {
        std::fs::write(self.path("official.ckpt"), bytes).unwrap();
        let (file, out, model) = (self.text("official.ckpt"), self.text("imported"), self.text("model.toml"));
        rigscape(&[&["import", "bev-vae", &file, "--out", &out, "--config", &model], extra].concat())
    }

    /// Values of an imported part by our names.
    fn part(&self, name: &str) -> Vec<(String, Vec<f32>)> {
        let path = self.path("imported/checkpoints/step_00000000").join(format!("{name}.safetensors"));
        let file = nn::weights::WeightFile::open(path).unwrap();
        file.read_all().unwrap().into_iter().map(|(name, tensor)| (name, tensor.data)).collect()
    }
}

fn model() -> BevVae {
    #[derive(serde::Deserialize)]
    struct File {
        model: rigscape::ModelChoice,
    }
    let file: File = toml::from_str(MODEL).unwrap();
    BevVae::new(&file.model.config, &mut Init::new(0, &Device::flex()))
}

/// Official names, shapes and values, the bottleneck first, beside what the file holds for other reasons.
fn state(scale: f32) -> Vec<Named> {
    let mut all: Vec<Named> = param_shapes(&model())
        .into_iter()
        .map(|(path, shape)| (official_name(&path), official_shape(&path, &shape)))
        .map(|(name, shape)| values_of(name, shape, scale))
        .collect();
    all.sort_by_key(|(name, ..)| (name.contains("coder."), name.clone()));
    all.insert(0, values_of("img_color".to_owned(), vec![3, 2, 1, 1], scale));
    all.push(values_of("evaluation.fid.weight".to_owned(), vec![4], scale));
    all
}

fn values_of(name: String, shape: Vec<usize>, scale: f32) -> Named {
    let start = name.bytes().fold(7_usize, |sum, byte| (sum * 31 + usize::from(byte)) % 1009);
    let gain = if name.ends_with("scale") || name.contains("norm") || name.contains(".ln_") { 1.0 } else { 0.0 };
    let value = |i: usize| gain + scale * (((start + i * 13) % 101) as f32 / 101.0 - 0.5);
    let values = (0..shape.iter().product()).map(value).collect();
    (name, shape, values)
}

/// The averages of the parameters in the order of the optimizer's list.
fn listed(average: &[Named]) -> Vec<Named> {
    let of = |module: &str| average.iter().filter(|(name, ..)| name.starts_with(module)).cloned().collect::<Vec<_>>();
    ["encoder.", "decoder.", "pre_quant.", "post_quant."].into_iter().flat_map(of).collect()
}

fn assert_equal(part: &[(String, Vec<f32>)], official: &[Named]) {
    assert_eq!(part.len(), param_shapes(&model()).len());
    for (path, values) in part {
        let wanted = official.iter().find(|(name, ..)| *name == official_name(path)).expect("a parameter of the file");
        assert!(*values == wanted.2, "{path} differs");
    }
}

#[test]
fn averaged_weights_are_found_wherever_they_lie() {
    let (current, average) = (state(0.1), state(0.2));
    let mut list = listed(&average);
    list.push(values_of("of a discriminator".to_owned(), vec![5], 1.0));
    for (averaged, said) in [
        (
            Averaged::List(&list),
            "averaged weights from optimizer_states/0/ema, which holds 1 tensors of other networks",
        ),
        (Averaged::Callback(&average), "averaged weights from callbacks/Ema/shadow"),
        (Averaged::StateDict(&average), "averaged weights from state_dict"),
        (Averaged::Absent, "non-EMA weights: the file holds no averaged ones"),
    ] {
        let place = Workplace::new();
        let text = must(place.import(&checkpoint(&current, &averaged), &[]));
        assert!(text.contains(said) && text.contains("2 ignored by design"), "{said}: {text}");
        assert_equal(&place.part("model"), &current);
        assert_equal(&place.part("ema"), if matches!(averaged, Averaged::Absent) { &current } else { &average });
        let page = std::fs::read_to_string(place.path("imported/import.md")).unwrap();
        assert!(page.contains("| pre_quant.bias | pre_quant.bias | [6] | taken |"), "{page}");
        assert!(page.contains("| img_color | - | [3, 2, 1, 1] | ignored |"), "{page}");
    }
    let place = Workplace::new();
    let text = must(place.import(&checkpoint(&current, &Averaged::List(&list)), &["--weights", "current"]));
    assert!(text.contains("non-EMA weights, as asked for"), "{text}");
    assert_equal(&place.part("ema"), &current);
    let again = refusal(place.import(&checkpoint(&current, &Averaged::Absent), &[]));
    assert!(again.contains("imported holds checkpoints already"), "{again}");
}

/// Name, file, options, and what the error says.
type Case = (&'static str, Vec<u8>, Vec<&'static str>, Vec<&'static str>);

#[test]
fn files_that_do_not_fit_are_refused_and_nothing_is_written() {
    let sound = state(0.1);
    let change = |edit: &dyn Fn(&mut Vec<Named>)| {
        let mut state = sound.clone();
        edit(&mut state);
        checkpoint(&state, &Averaged::Absent)
    };
    let whole = checkpoint(&sound, &Averaged::Absent);
    let mut wrong_average = listed(&sound);
    wrong_average.swap(0, 1);
    let short_average = &listed(&sound)[1..];
    let position = |name: &str| sound.iter().position(|named| named.0 == name).unwrap();
    let bias = position("pre_quant.bias");
    let cases: Vec<Case> = vec![
        ("missing", change(&|s| drop(s.remove(bias))), vec![], vec!["pre_quant.bias: missing, the network needs [6]"]),
        (
            "renamed",
            change(&|s| s[bias].0 = "pre_quant.b".into()),
            vec![],
            vec!["pre_quant.b [6]: unexpected", "missing"],
        ),
        (
            "extra",
            change(&|s| s.push(values_of("head.weight".into(), vec![2], 0.1))),
            vec![],
            vec!["head.weight [2]: unexpected"],
        ),
        (
            "shape",
            change(&|s| s[bias].1 = vec![2, 3]),
            vec![],
            vec!["pre_quant.bias [2, 3]: wrong shape, the network needs [6]"],
        ),
        (
            "other sizes",
            whole.clone(),
            vec!["--set", "model.latent_channels=4"],
            vec!["pre_quant.bias [6]: wrong shape, the network needs [8]"],
        ),
        (
            "preset",
            whole.clone(),
            vec!["--set", "model.preset=tiny"],
            vec!["preset paper only", "frustum.pixels = \"patch_centre\" instead of \"end_to_end\""],
        ),
        (
            "setting",
            whole.clone(),
            vec!["--set", "model.scene.norm_groups=16"],
            vec!["scene.norm_groups = 32 only, the model has 16"],
        ),
        (
            "average's shape",
            checkpoint(&sound, &Averaged::List(&wrong_average)),
            vec![],
            vec!["its average has the shape"],
        ),
        (
            "short list",
            checkpoint(&sound, &Averaged::List(short_average)),
            vec![],
            vec!["optimizer_states/0/ema holds"],
        ),
        ("no average", whole.clone(), vec!["--weights", "ema"], vec!["no averaged weights", "state_dict"]),
        ("truncated", whole[..whole.len() / 2].to_vec(), vec![], vec!["zip archive"]),
        ("bomb", compressed(&sound), vec![], vec!["is compressed, which torch.save never does"]),
        ("text", b"no checkpoint at all".to_vec(), vec![], vec!["not a file of torch.save"]),
        ("empty", Vec::new(), vec![], vec!["not a file of torch.save"]),
    ];
    for (name, bytes, extra, wanted) in cases {
        let place = Workplace::new();
        let text = refusal(place.import(&bytes, &extra));
        for part in wanted {
            assert!(text.contains(part), "{name}: {text}");
        }
        if !["preset", "setting"].contains(&name) {
            assert!(text.contains("official.ckpt"), "{name}: {text}");
        }
        assert!(!place.path("imported").exists(), "{name}: something was written");
    }
    let place = Workplace::new();
    let report = place.text("report.md");
    refusal(place.import(&change(&|s| drop(s.remove(bias))), &["--report", &report]));
    let page = std::fs::read_to_string(report).unwrap();
    assert!(page.contains("| pre_quant.bias | pre_quant.bias | - | missing"), "{page}");
    let absent = refusal(rigscape(&["import", "bev-vae", "nowhere.ckpt", "--out", &place.text("x")]));
    assert!(absent.contains("nowhere.ckpt"), "{absent}");
}

#[test]
fn an_imported_network_serves_every_command_and_is_fine_tuned() {
    let place = Workplace::new();
    must(place.import(&checkpoint(&state(0.05), &Averaged::Absent), &[]));
    let (imported, data, sheet) = (place.text("imported"), place.text("data.toml"), place.text("sheet.png"));
    let common = ["--checkpoint", &imported, "--data", &data, "--frames", "1"];
    must(rigscape(&[&["reconstruct", "--out", &sheet][..], &common].concat()));
    must(rigscape(&[&["novel-view", "--yaw=-30", "--out", &sheet][..], &common].concat()));
    must(rigscape(&[&["change-rig", "--rig", "waymo", "--out", &sheet][..], &common].concat()));
    must(rigscape(&[&["evaluate", "--protocol", "psnr/bev-vae"][..], &common].concat()));
    let without = refusal(rigscape(&["reconstruct", "--checkpoint", &imported, "--out", &sheet]));
    assert!(without.contains("names no held-out data"), "{without}");
    let info = must(rigscape(&["info", "--checkpoint", &imported]));
    assert!(info.contains("pictures 16x16"), "{info}");

    let experiment = format!(
        "seed = 1\n[run]\nname = \"tuned\"\nroot = {:?}\n{MODEL}[loss]\nadversarial = \"off\"\n[train]\nsteps = 1\npreview_every = 0\n\
         [evaluation]\nframes = 1\nfinal_frames = 1\nbaseline_frames = 1\n[data]\ntrain = [{{ kind = \"procedural\", scenes = 1, frames_per_scene = 1 }}]\n\
         validation = [{{ kind = \"procedural\", scenes = 1, frames_per_scene = 1 }}]\n",
        place.text("runs")
    );
    let config = place.path("tune.toml");
    std::fs::write(&config, experiment).unwrap();
    // No learning rate: what comes out is what went in.
    let still = ["--init-from", &imported, "--set", "optimizer.generator.learning_rate=0.0"];
    must(train(&config, &[&still[..], &["--set", "optimizer.generator.weight_decay=0.0"]].concat()));
    let tuned = place.path("runs/tuned/checkpoints/step_00000001/model.safetensors");
    let tuned = nn::weights::WeightFile::open(tuned).unwrap().read_all().unwrap();
    for (name, values) in place.part("ema") {
        assert!(tuned[&name].data == values, "{name} changed");
    }
    let other = refusal(train(&config, &["--init-from", &imported, "--set", "model.latent_channels=4"]));
    assert!(other.contains("latent_channels = 4 instead of 3"), "{other}");
    let absent = refusal(train(&config, &["--init-from", "nowhere"]));
    assert!(absent.contains("init_from") && absent.contains("nowhere"), "{absent}");
}
