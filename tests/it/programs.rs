//! The programs as a user meets them: typos, missing files, broken pictures, real data.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::runs::{must, train, write_config};

pub fn rigscape(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rigscape")).args(args).output().unwrap()
}

/// The message of a command that must fail, without a panic.
pub fn refusal(output: Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success(), "should have been refused: {text}");
    assert!(!text.contains("panicked"), "{text}");
    text
}

/// Real fixtures, when there are any.
pub fn data(part: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else {
        eprintln!("did not run: set RIGSCAPE_DATA for the checks on real data");
        return None;
    };
    let path = PathBuf::from(root).join(part);
    assert!(path.exists(), "{} is missing", path.display());
    Some(path)
}

#[test]
fn mistakes_are_refused_with_the_place_and_the_cure() {
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    let missing = refusal(train(&folder.path().join("absent.toml"), &[]));
    assert!(missing.contains("absent.toml"), "{missing}");
    let typo = refusal(train(&config, &["--set", "optimizer.generator.lerning_rate=1"]));
    assert!(typo.contains("lerning_rate") && typo.contains("run.toml"), "{typo}");
    let preset = refusal(train(&config, &["--set", "model.preset=huge"]));
    assert!(preset.contains("huge"), "{preset}");
    let weights = refusal(train(&config, &["--set", "loss.perceptual.weights=nowhere.safetensors"]));
    assert!(weights.contains("nowhere.safetensors"), "{weights}");
    let checkpoint = refusal(rigscape(&["reconstruct", "--checkpoint", "nowhere", "--out", "x.png"]));
    assert!(checkpoint.contains("nowhere"), "{checkpoint}");
    let nothing = refusal(rigscape(&["novel-view", "--checkpoint", "nowhere", "--out", "x.png"]));
    assert!(nothing.contains("--yaw"), "{nothing}");
    if !cfg!(feature = "cuda") {
        let device = refusal(train(&config, &["--device", "cuda"]));
        assert!(device.contains("--features cuda"), "{device}");
    }
}

#[test]
fn made_data_is_checked_trained_on_and_looked_at() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("made");
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let make = ["make-data", "--format", "nuscenes", "--scenes", "2", "--key-frames", "2", "--size", "64x36", "--out"];
    must(rigscape(&[&make[..], &[&text(&out)]].concat()));
    let again = refusal(rigscape(&[&make[..], &[&text(&out)]].concat()));
    assert!(again.contains("made"), "{again}");
    must(rigscape(&["check-data", "--nuscenes", &text(&out)]));

    let config = write_config(folder.path());
    let dataset =
        format!("{{ kind = \"nuscenes\", root = {:?}, version = \"v1.0-mini\", split = \"all\" }}", text(&out));
    let (training, validation) = (format!("data.train=[{dataset}]"), format!("data.validation=[{dataset}]"));
    let set = ["--set", "train.steps=2", "--set", &training, "--set", &validation];
    let table = must(train(&config, &set));
    assert!(table.contains("reconstruction") && !table.contains("novel view"), "{table}");
    let run = text(&folder.path().join("runs/run"));
    let sheet = folder.path().join("sheet.png");
    must(rigscape(&["reconstruct", "--checkpoint", &run, "--out", &text(&sheet), "--frames", "1"]));
    let picture = image::open(&sheet).unwrap();
    assert!(picture.width() > 6 * 32 && picture.height() > 2 * 32);
    let views =
        ["novel-view", "--checkpoint", &run, "--yaw=-30", "--shift=0,1,0", "--rig", "waymo", "--frames", "1", "--out"];
    must(rigscape(&[&views[..], &[&text(&sheet)]].concat()));
    let info = must(rigscape(&["info", "--checkpoint", &run]));
    assert!(info.contains("step 2"), "{info}");
    let weights = must(rigscape(&["info", "--weights"]));
    assert!(weights.contains("pt_inception-2015-12-05-6726825d.pth"), "{weights}");

    // A picture cut in half stops the check and the run, by name.
    let victim = files_below(&out.join("samples"), "jpg").swap_remove(0);
    let bytes = std::fs::read(&victim).unwrap();
    std::fs::write(&victim, &bytes[..bytes.len() / 2]).unwrap();
    let name = victim.file_name().unwrap().to_string_lossy().into_owned();
    let listed = rigscape(&["check-data", "--nuscenes", &text(&out), "--images", "100"]);
    assert!(String::from_utf8_lossy(&listed.stdout).contains(&name));
    refusal(listed);
    let stopped = refusal(train(&config, &set));
    assert!(stopped.contains(&name), "{stopped}");
}

/// All files of this kind below a folder, by path.
pub fn files_below(folder: &Path, extension: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files_below(&path, extension));
        } else if path.extension().is_some_and(|e| e == extension) {
            found.push(path);
        }
    }
    found.sort();
    found
}

#[test]
fn a_run_learns_from_real_keyframes() {
    let Some(root) = data("nuscenes_keyframe") else { return };
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    let version = std::fs::read_dir(&root)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .find(|name| name.starts_with("v1.0-"))
        .expect("tables");
    let dataset = format!(
        "{{ kind = \"nuscenes\", root = {:?}, version = {version:?}, split = \"all\" }}",
        root.to_string_lossy()
    );
    let (training, validation) = (format!("data.train=[{dataset}]"), format!("data.validation=[{dataset}]"));
    let set = ["--set", "train.steps=3", "--set", &training, "--set", &validation, "--set", "data.loader.batch_size=1"];
    let table = must(train(&config, &set));
    assert!(table.contains("reconstruction"), "{table}");
}
