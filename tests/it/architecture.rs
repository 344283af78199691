//! The house's own rules: which crate may use which, and texts that must not occur.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The only arrows allowed, as in crates/README.md. `recipes` is the root package.
const ARROWS: [(&str, &[&str]); 14] = [
    ("pickle", &[]),
    ("geometry", &[]),
    ("world", &["geometry"]),
    ("data", &["pickle", "geometry", "world"]),
    ("ops", &[]),
    ("nn", &["pickle", "ops"]),
    ("diffusion", &[]),
    ("features", &["ops", "nn"]),
    ("vae", &["geometry", "nn", "features", "ops"]),
    ("stable-diffusion", &["nn", "ops"]),
    ("dit", &["nn", "ops"]),
    ("metrics", &["features"]),
    ("train", &[]),
    (
        "rigscape",
        &[
            "geometry",
            "world",
            "data",
            "ops",
            "nn",
            "diffusion",
            "features",
            "vae",
            "stable-diffusion",
            "dit",
            "metrics",
            "train",
        ],
    ),
];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn metadata() -> serde_json::Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--no-deps", "--offline"])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn crates_depend_only_along_the_arrows() {
    let metadata = metadata();
    let allowed: BTreeMap<&str, &[&str]> = ARROWS.into_iter().collect();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        let arrows = allowed.get(name).unwrap_or_else(|| panic!("crate {name} has no row in the table of arrows"));
        for dependency in package["dependencies"].as_array().unwrap() {
            let target = dependency["name"].as_str().unwrap();
            // Tests of a crate may look further than the crate.
            if dependency["kind"].as_str() == Some("dev") || !allowed.contains_key(target) {
                continue;
            }
            assert!(arrows.contains(&target), "{name} must not depend on {target}");
        }
    }
}

#[test]
fn crate_table_lists_every_crate() {
    let table = std::fs::read_to_string(root().join("crates/README.md")).unwrap();
    for (name, _) in ARROWS {
        let row = if name == "rigscape" { "recipes" } else { name };
        assert!(table.contains(&format!("| `{row}`")), "crates/README.md has no row for {row}");
    }
}

fn rust_files(folder: &Path, found: &mut BTreeSet<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.insert(path);
        }
    }
}

fn sources() -> Vec<(PathBuf, String)> {
    let mut found = BTreeSet::new();
    rust_files(&root().join("crates"), &mut found);
    found.into_iter().map(|path| (path.clone(), std::fs::read_to_string(path).unwrap())).collect()
}

/// Source text without comments and without its unit tests.
fn code(text: &str) -> String {
    let body = text.split("#[cfg(test)]").next().unwrap_or(text);
    body.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

#[test]
fn no_default_device_and_no_channel_names_behind_the_readers() {
    let (default, channel) = (["Device::", "default()"].concat(), ["\"CAM", "_"].concat());
    for (path, text) in sources() {
        let code = code(&text);
        assert!(!code.contains(&default), "{}: {default} is never called", path.display());
        let relative = path.strip_prefix(root()).unwrap().to_string_lossy().replace('\\', "/");
        let may_name_channels =
            relative.contains("/nuscenes") || relative.contains("rig_presets") || relative.contains("/tests/");
        assert!(may_name_channels || !code.contains(&channel), "{}: names a dataset's channel", path.display());
    }
}

#[test]
fn unsafe_stays_in_ops() {
    let word = ["un", "safe "].concat();
    for (path, text) in sources() {
        let in_ops = path.starts_with(root().join("crates/ops"));
        let uses =
            code(&text).lines().any(|line| line.trim_start().starts_with(&word) || line.contains(&format!("= {word}")));
        assert!(in_ops || !uses, "{}: {word}code outside ops", path.display());
    }
}
