//! A debug autoencoder and the config of a transformer on it, which tests of `train-dit` and `synthesize` start from.

use std::path::PathBuf;
use std::process::{Command, Output};

use crate::runs::{DEBUG_RUN, must};

const DIT: &str = r#"
seed = 3
autoencoder = "@ROOT@/runs/run"
[run]
name = "dit"
root = "@ROOT@/runs"
[model]
preset = "debug"
[latents]
source = { moments = { folder = "@ROOT@/latents", shard_samples = 5 } }
scale = "per_channel"
[condition]
classes = { names = ["car", "truck", "pedestrian"] }
[[data.train]]
kind = "procedural"
name = "six"
seed = 1
scenes = 3
frames_per_scene = 2
rig = { preset = "nuscenes" }
[[data.train]]
kind = "procedural"
name = "seven"
seed = 2
scenes = 3
frames_per_scene = 2
rig = { preset = "argoverse2" }
[[data.validation]]
kind = "procedural"
name = "six"
seed = 9
scenes = 3
frames_per_scene = 1
rig = { preset = "nuscenes" }
[data.loader]
batch_size = 2
[optimizer]
learning_rate = 1e-3
[ema]
decay = 0.9
[train]
steps = 8
log_every = 1
validate_every = 4
preview_every = 0
checkpoint_every = 4
[preview]
frames = 1
steps = 2
width = 400
[evaluation]
samples = 3
final_samples = 3
generated = 3
edits = 1
"#;

/// A folder with a debug autoencoder and the config of a debug transformer on it.
pub struct Place(tempfile::TempDir);

impl Place {
    /// Trains the autoencoder for `steps` steps.
    pub fn new(steps: &str) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let vae = place.path("vae.toml");
        std::fs::write(&vae, DEBUG_RUN.replace("@ROOT@", &place.text("runs"))).unwrap();
        let set = [
            "--set".to_owned(),
            format!("train.steps={steps}"),
            "--set".to_owned(),
            "train.validate_every=0".to_owned(),
        ];
        let mut command = Command::new(env!("CARGO_BIN_EXE_train-vae"));
        must(command.arg("--config").arg(&vae).args(set).output().unwrap());
        std::fs::write(place.path("dit.toml"), DIT.replace("@ROOT@", &place.0.path().to_string_lossy())).unwrap();
        place
    }

    pub fn path(&self, part: &str) -> PathBuf {
        self.0.path().join(part)
    }

    pub fn text(&self, part: &str) -> String {
        self.path(part).to_string_lossy().into_owned()
    }

    /// `train-dit` with `--set` entries and other options.
    pub fn train(&self, set: &[&str], options: &[&str]) -> Output {
        let set = set.iter().flat_map(|entry| ["--set", entry]);
        let mut command = Command::new(env!("CARGO_BIN_EXE_train-dit"));
        command.arg("--config").arg(self.path("dit.toml")).args(set).args(options).output().unwrap()
    }

    pub fn refused(&self, set: &[&str], options: &[&str]) -> String {
        refusal(self.train(set, options))
    }
}

pub fn refusal(output: Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && !text.contains("panicked"), "{text}");
    text
}
