//! Runs of `train-vae` at debug size: what a resumed, killed or mixed run must give.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

/// Two cars with six and seven cameras, a third with four; debug network; adversarial part from the start.
pub const DEBUG_RUN: &str = r#"
seed = 3
[run]
name = "run"
root = "@ROOT@"
[model]
preset = "debug"
[[data.train]]
kind = "procedural"
name = "six"
seed = 1
scenes = 3
frames_per_scene = 4
rig = { preset = "nuscenes" }
[[data.train]]
kind = "procedural"
name = "seven"
seed = 2
scenes = 3
frames_per_scene = 4
rig = { preset = "argoverse2" }
[[data.train]]
kind = "procedural"
name = "four"
seed = 3
scenes = 3
frames_per_scene = 4
rig = { preset = "nuscenes" }
cameras = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_FRONT_LEFT"]
[[data.validation]]
kind = "procedural"
name = "six"
seed = 9
scenes = 2
frames_per_scene = 1
rig = { preset = "nuscenes" }
[data.loader]
batch_size = 2
augment.flip_probability = 0.5
augment.color_jitter.probability = 0.5
augment.rig_motion.probability = 0.5
[loss.adversarial.hinge]
discriminator_start = 0.0
generator_start = 0.25
[optimizer.generator.schedule]
warmup_steps = 2
[optimizer.discriminator.schedule]
warmup_steps = 2
[ema]
decay = 0.9
[train]
steps = 8
log_every = 1
validate_every = 4
preview_every = 0
checkpoint_every = 4
[evaluation]
frames = 1
final_frames = 1
baseline_frames = 2
yaw_deg = [-30.0, 30.0]
"#;

pub fn write_config(folder: &Path) -> PathBuf {
    let path = folder.join("run.toml");
    std::fs::write(&path, DEBUG_RUN.replace("@ROOT@", &folder.join("runs").to_string_lossy())).unwrap();
    path
}

pub fn train(config: &Path, extra: &[&str]) -> Output {
    command(config, extra).output().unwrap()
}

fn command(config: &Path, extra: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_train-vae"));
    command.arg("--config").arg(config).args(extra);
    command
}

pub fn must(output: Output) -> String {
    let text = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{text}");
    text
}

/// Every file of a run's last checkpoint by name.
pub fn checkpoint(run: &Path) -> Vec<(String, Vec<u8>)> {
    let folder = run.join("checkpoints/step_00000008");
    let mut files: Vec<(String, Vec<u8>)> = std::fs::read_dir(&folder)
        .unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        .map(|entry| entry.unwrap().path())
        .map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(&path).unwrap()))
        .collect();
    files.sort();
    files
}

/// Where a run lives goes into its config and so into its checkpoint; everything else must be equal.
fn assert_equal_checkpoints(a: &Path, b: &Path) {
    let parts = ["model", "ema", "optimizer_generator", "discriminator", "optimizer_discriminator"];
    assert_equal_parts(&a.join("runs/run"), &b.join("runs/run"), &parts);
}

/// The same for any two runs of 8 steps, given their folders and what a checkpoint holds.
pub fn assert_equal_parts(a: &Path, b: &Path, parts: &[&str]) {
    let (one, two) = (checkpoint(a), checkpoint(b));
    let names = |files: &[(String, Vec<u8>)]| files.iter().map(|f| f.0.clone()).collect::<Vec<_>>();
    assert_eq!(names(&one), names(&two));
    for part in parts {
        let name = format!("{part}.safetensors");
        let find = |files: &[(String, Vec<u8>)]| files.iter().find(|f| f.0 == name).unwrap().1.clone();
        assert_eq!(tensors(&find(&one)), tensors(&find(&two)), "{name} differs");
    }
}

pub fn tensors(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let file = safetensors::SafeTensors::deserialize(bytes).unwrap();
    let mut tensors: Vec<(String, Vec<u8>)> =
        file.iter().map(|(name, view)| (name.to_owned(), view.data().to_vec())).collect();
    tensors.sort();
    tensors
}

#[test]
fn a_stopped_and_resumed_run_equals_an_unbroken_one_bit_for_bit() {
    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let text = must(train(&write_config(whole.path()), &[]));
    assert!(text.contains("reconstruction") && text.contains("novel view"), "{text}");
    let config = write_config(broken.path());
    must(train(&config, &["--stop-after", "5"]));
    must(train(&config, &["--resume"]));
    assert_equal_checkpoints(whole.path(), broken.path());

    let summary = std::fs::read_to_string(broken.path().join("runs/run/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    for key in ["steps", "seconds", "peak_rss_bytes", "data_wait_fraction"] {
        assert!(summary[key].is_number(), "{key}: {summary}");
    }
    for part in ["reconstruction", "novel_view"] {
        assert!(summary[part]["psnr_db"].is_number() && summary[part]["baseline_db"].is_number(), "{summary}");
    }
    let rows = std::fs::read_to_string(broken.path().join("runs/run/metrics.jsonl")).unwrap();
    assert!(rows.lines().count() >= 8, "{rows}");
}

#[test]
fn micro_batches_side_by_side_give_the_same_bits_on_any_number_of_threads() {
    let (one, three) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for (folder, threads) in [(&one, "1"), (&three, "3")] {
        let mut command = command(&write_config(folder.path()), &["--set", "train.accumulate=3"]);
        must(command.env("RAYON_NUM_THREADS", threads).output().unwrap());
    }
    assert_equal_checkpoints(one.path(), three.path());
}

#[test]
fn a_killed_run_goes_on_from_its_last_whole_checkpoint() {
    let (whole, killed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    must(train(&write_config(whole.path()), &[]));
    let config = write_config(killed.path());
    let mut child = command(&config, &["--set", "train.checkpoint_every=1"])
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let checkpoints = killed.path().join("runs/run/checkpoints");
    let waited = std::time::Instant::now();
    while !checkpoints.join("step_00000002").is_dir() {
        assert!(waited.elapsed() < Duration::from_secs(240), "no checkpoint appeared");
        assert!(child.try_wait().unwrap().is_none(), "the run ended before it could be killed");
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    // What a kill in the middle of writing leaves behind.
    std::fs::create_dir_all(checkpoints.join("step_00000099")).unwrap();
    std::fs::write(checkpoints.join("step_00000099/model.safetensors"), b"half").unwrap();
    must(train(&config, &["--resume"]));
    assert_equal_checkpoints(whole.path(), killed.path());
}

#[test]
fn a_debug_network_learns_one_scene() {
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    let set = [
        "--set",
        "train.steps=200",
        "--set",
        "train.validate_every=0",
        "--set",
        "train.checkpoint_every=200",
        "--set",
        "data.train.0.scenes=1",
        "--set",
        "data.train.0.frames_per_scene=1",
        "--set",
        "data.mixture.weights={ explicit = [1.0, 0.0, 0.0] }",
        "--set",
        "loss.adversarial=off",
        "--set",
        "optimizer.generator.learning_rate=3e-3",
        "--set",
        "data.loader.batch_size=1",
        "--set",
        "data.loader.augment={}",
    ];
    must(train(&config, &set));
    let rows = std::fs::read_to_string(folder.path().join("runs/run/metrics.jsonl")).unwrap();
    let losses: Vec<f64> = rows
        .lines()
        .map(|row| serde_json::from_str::<serde_json::Value>(row).unwrap())
        .filter_map(|row| find_number(&row, "loss"))
        .collect();
    let (first, last) = (losses[0], losses[losses.len() - 1]);
    assert!(last < 0.3 * first, "loss went from {first} to {last}");
}

pub fn find_number(row: &serde_json::Value, key: &str) -> Option<f64> {
    match row {
        serde_json::Value::Object(map) => {
            map.get(key).and_then(serde_json::Value::as_f64).or_else(|| map.values().find_map(|v| find_number(v, key)))
        }
        _ => None,
    }
}
