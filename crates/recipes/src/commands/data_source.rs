//! Which datasets a command looks at, whatever file or option names them.

use std::path::{Path, PathBuf};

use clap::Args;
use data::{DatasetConfig, LoaderConfig};
use serde::Deserialize;
use toml::{Table, Value};

use super::common::{DataArgs, UsageError};
use crate::bev_vae::{DataConfig, Experiment};
use crate::config_file;
use crate::dit::DitExperiment;

/// Datasets of a file, or one dataset named by options.
#[derive(Debug, Clone, Args)]
pub struct DataSource {
    /// Experiment file, of which the training and held-out data are meant, or a file of datasets: one or more `[[data]]` tables,
    /// `[[data.train]]` and `[[data.validation]]`, or a single dataset's settings at the top
    #[arg(long, value_name = "FILE", conflicts_with_all = ["data", "nuscenes", "kind"])]
    pub config: Option<PathBuf>,
    /// One dataset of this kind (nuscenes, nuplan, procedural, ...); its settings with --root and --set
    #[arg(long, value_name = "NAME", conflicts_with_all = ["data", "nuscenes"])]
    pub kind: Option<String>,
    /// Root folder or archive of the dataset of --kind
    #[arg(long, value_name = "DIR", requires = "kind")]
    pub root: Option<PathBuf>,
    /// Change one setting of the file or of the dataset of --kind, for example `--set data.train.0.split=mini_val`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE", conflicts_with = "nuscenes")]
    pub overrides: Vec<String>,
    /// Other ways to name data
    #[command(flatten)]
    pub data: DataArgs,
}

/// A dataset and where its settings stand.
#[derive(Debug, Clone)]
pub struct Named {
    /// `data.train.0`, `data.1`, or `dataset` where there is only one.
    pub place: String,
    /// Its settings.
    pub config: DatasetConfig,
}

/// What a [`DataSource`] names.
#[derive(Debug, Clone)]
pub struct Chosen {
    /// The datasets in the file's order.
    pub datasets: Vec<Named>,
    /// How an experiment makes batches of them, network picture size included; `None` for files that hold datasets only.
    pub loader: Option<LoaderConfig>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ListFile {
    data: Vec<DatasetConfig>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SplitFile {
    data: DataConfig,
}

impl DataSource {
    /// Reads the settings; opens no dataset.
    ///
    /// # Errors
    /// [`UsageError`] for everything that is wrong with options and files, naming file and key.
    pub fn choose(&self) -> anyhow::Result<Chosen> {
        let chosen = self.read().map_err(UsageError::wrap)?;
        if chosen.datasets.is_empty() {
            return Err(UsageError::of(
                "say which data: --config FILE, --kind NAME --root DIR, --nuscenes DIR or --data FILE",
            ));
        }
        Ok(chosen)
    }

    fn read(&self) -> anyhow::Result<Chosen> {
        if let Some(path) = self.config.as_ref().or(self.data.data.as_ref()) {
            return read_file(path, &self.overrides);
        }
        if let Some(kind) = &self.kind {
            let mut table = Table::from_iter([("kind".to_owned(), Value::String(kind.clone()))]);
            if let Some(root) = &self.root {
                table.insert("root".to_owned(), Value::String(root.to_string_lossy().into_owned()));
            }
            let config = config_file::parse(&toml::to_string(&table)?, &self.overrides)?;
            return Ok(alone(config));
        }
        Ok(Chosen { datasets: list("dataset", self.data.configs()?), loader: None })
    }
}

fn read_file(path: &Path, overrides: &[String]) -> anyhow::Result<Chosen> {
    // Only its shape; whatever is wrong with it is said by the strict reading below.
    let shape: Table = config_file::load(path, &[])?;
    if shape.contains_key("kind") {
        return Ok(alone(config_file::load(path, overrides)?));
    }
    let is_experiment = shape.contains_key("model") || shape.contains_key("run");
    match shape.get("data") {
        Some(Value::Table(_)) if !is_experiment => {
            Ok(Chosen { datasets: splits(config_file::load::<SplitFile>(path, overrides)?.data), loader: None })
        }
        Some(Value::Array(_)) if !is_experiment => {
            Ok(Chosen { datasets: list("data", config_file::load::<ListFile>(path, overrides)?.data), loader: None })
        }
        _ if shape.contains_key("latents") => {
            let experiment: DitExperiment = config_file::load(path, overrides)?;
            Ok(Chosen { datasets: splits(experiment.data), loader: None })
        }
        _ => {
            let experiment: Experiment = config_file::load(path, overrides)?;
            let loader = Some(experiment.loader_config());
            Ok(Chosen { datasets: splits(experiment.data), loader })
        }
    }
}

fn alone(config: DatasetConfig) -> Chosen {
    Chosen { datasets: vec![Named { place: "dataset".to_owned(), config }], loader: None }
}

fn list(place: &str, configs: Vec<DatasetConfig>) -> Vec<Named> {
    let named = |(at, config)| Named { place: format!("{place}.{at}"), config };
    configs.into_iter().enumerate().map(named).collect()
}

fn splits(data: DataConfig) -> Vec<Named> {
    [list("data.train", data.train), list("data.validation", data.validation)].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(text: &str, overrides: &[&str]) -> anyhow::Result<(Vec<String>, bool)> {
        let folder = std::env::temp_dir().join(format!("rigscape-data-source-{}", std::process::id()));
        std::fs::create_dir_all(&folder)?;
        let path = folder.join("some.toml");
        std::fs::write(&path, text)?;
        let overrides: Vec<String> = overrides.iter().map(|set| (*set).to_owned()).collect();
        let chosen = read_file(&path, &overrides)?;
        Ok((chosen.datasets.into_iter().map(|named| named.place).collect(), chosen.loader.is_some()))
    }

    #[test]
    fn every_shape_of_file_is_read_and_typos_are_named() {
        let one = "kind = \"procedural\"\nscenes = 3\n";
        assert_eq!(places(one, &["seed=2"]).unwrap(), (vec!["dataset".into()], false));
        let two = "[[data]]\nkind = \"procedural\"\n[[data]]\nkind = \"nuplan\"\nroot = \"x\"\n";
        assert_eq!(places(two, &[]).unwrap().0, ["data.0", "data.1"]);
        let split = "[[data.train]]\nkind = \"procedural\"\n[[data.validation]]\nkind = \"procedural\"\n";
        assert_eq!(places(split, &[]).unwrap(), (vec!["data.train.0".into(), "data.validation.0".into()], false));
        let experiment = format!("seed = 1\n[run]\nname = \"r\"\n[model]\npreset = \"debug\"\n{split}");
        let (places_of_experiment, has_loader) = places(&experiment, &["train.steps=2"]).unwrap();
        assert_eq!((places_of_experiment.len(), has_loader), (2, true));
        for (text, set, typo) in [
            (one, "scense=3", "scense"),
            (two, "data.1.splitt=all", "splitt"),
            (split, "data.trian=[]", "trian"),
            (&experiment, "trian.steps=2", "trian"),
            ("scenes = 3\n", "seed=1", "scenes"),
        ] {
            let error = format!("{:#}", places(text, &[set]).unwrap_err());
            assert!(error.contains(typo) && error.contains("some.toml"), "{error}");
        }
    }
}
