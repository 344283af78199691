//! Every shipped experiment file is read strictly, and the small ones say what they promise.

use std::path::{Path, PathBuf};
use std::process::Command;

use clap::Parser;
use rigscape::autoencoder::AutoencoderExperiment;
use rigscape::bev_vae::Experiment;
use rigscape::commands::{CheckDataArgs, Chosen};
use rigscape::config_file;
use rigscape::dit::DitExperiment;
use rigscape::latent_diffusion::UNetExperiment;
use serde::Serialize;
use serde::de::DeserializeOwned;

fn files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else {
            found.push(path);
        }
    }
}

#[test]
fn shipped_configs_are_read_strictly_and_stay_short() {
    let mut found = Vec::new();
    files(&Path::new(env!("CARGO_MANIFEST_DIR")).join("configs"), &mut found);
    assert!(found.len() >= 12, "{found:?}");
    let experiments = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/experiments");
    let mut of_benches = Vec::new();
    files(&experiments, &mut of_benches);
    found.extend(of_benches.into_iter().filter(|path| path.extension().is_some_and(|end| end == "toml")));
    for path in found {
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.starts_with('#'), "{}: open with what to expect", path.display());
        assert!(
            text.lines().filter(|line| !line.trim().is_empty()).count() <= 50,
            "{}: differences only",
            path.display()
        );
        if path.parent().is_some_and(|folder| folder.ends_with("configs/data")) {
            let chosen = read_as_data(&path).unwrap_or_else(|error| panic!("{error:#}"));
            assert!(!chosen.datasets.is_empty() && chosen.loader.is_none(), "{}: only datasets", path.display());
            continue;
        }
        if path.parent().is_some_and(|folder| folder.ends_with("configs/dit")) {
            read_back(&path, DitExperiment::checked);
            assert!(!read_as_data(&path).unwrap().datasets.is_empty());
            continue;
        }
        match path.file_stem().and_then(|stem| stem.to_str()) {
            Some("autoencoder") => read_back(&path, AutoencoderExperiment::checked),
            Some("dit") => read_back(&path, DitExperiment::checked),
            Some("unet") => read_back(&path, UNetExperiment::checked),
            _ => read_back::<Experiment>(&path, Ok),
        }
    }
}

#[test]
fn an_experiment_with_its_defaults_is_printed_as_a_config() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/toy/vae.toml");
    let told = Command::new(env!("CARGO_BIN_EXE_train-vae")).arg("--config").arg(&path).arg("--print-config").output();
    let told = String::from_utf8(told.unwrap().stdout).unwrap();
    let experiment: Experiment = config_file::parse(&told, &[]).unwrap_or_else(|error| panic!("{error:#}\n{told}"));
    assert_eq!(experiment, config_file::load(&path, &[]).unwrap());
    assert!(told.contains("betas") && !std::fs::read_to_string(&path).unwrap().contains("betas"), "{told}");
}

/// What a run writes into its folder must read back as the same experiment.
fn read_back<E>(path: &Path, checked: impl Fn(E) -> anyhow::Result<E>)
where
    E: Serialize + DeserializeOwned + PartialEq + std::fmt::Debug,
{
    let experiment = config_file::load(path, &[]).and_then(checked).unwrap_or_else(|error| panic!("{error:#}"));
    let again: E = config_file::parse(&toml::to_string(&experiment).unwrap(), &[]).unwrap();
    assert_eq!(experiment, again, "{}", path.display());
}

/// As `check-data --config` and `show-data --config` read a file.
fn read_as_data(path: &Path) -> anyhow::Result<Chosen> {
    CheckDataArgs::try_parse_from(["check-data".as_ref(), "--config".as_ref(), path.as_os_str()])?.source.choose()
}

#[test]
fn examples_on_the_data_pages_are_read_strictly() {
    // Datasets may lie in the folder too: only its own pages.
    let entries = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("data")).unwrap();
    let pages: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    let folder = tempfile::tempdir().unwrap();
    let mut read = 0;
    for page in pages.iter().filter(|path| path.extension().is_some_and(|e| e == "md")) {
        let text = std::fs::read_to_string(page).unwrap();
        for example in text.split("```toml\n").skip(1).filter_map(|rest| rest.split("```").next()) {
            let path = folder.path().join("example.toml");
            std::fs::write(&path, example).unwrap();
            let chosen = read_as_data(&path).unwrap_or_else(|error| panic!("{}: {error:#}", page.display()));
            assert_eq!(chosen.datasets.len(), 1, "{}", page.display());
            read += 1;
        }
    }
    assert_eq!(read, 8, "one example on each page, two on that of occupancy");
}
