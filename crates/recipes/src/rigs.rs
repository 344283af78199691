//! Which cameras a command means: a built-in vehicle by name, or a rig from a file.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, bail};
use data::DatasetConfig;
use geometry::{CameraRig, RigPreset};
use serde::Deserialize;

use crate::config_file;

/// Help text of options that take a [`RigChoice`].
pub const RIG_HELP: &str = "Cameras of another car: nuscenes, argoverse2, nuplan, wayvescenes101, waymo, a rig as FILE.json (see `rigscape info \
                            --rig`), or FILE.toml with one [[data]] table, whose first frame lends its rig";

/// A rig as options name it.
///
/// The built-in rigs hold real vehicles' numbers; [`RigPreset`] says of each where they come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RigChoice {
    /// A known vehicle.
    BuiltIn(RigPreset),
    /// A JSON file that holds a [`CameraRig`].
    File(PathBuf),
    /// A TOML file with one `[[data]]` table; the rig of the dataset's first frame.
    Dataset(PathBuf),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DataFile {
    data: Vec<DatasetConfig>,
}

impl RigChoice {
    /// The cameras.
    ///
    /// # Errors
    /// Names the file that is missing, holds no rig, or names no dataset or several.
    pub fn open(&self) -> anyhow::Result<CameraRig> {
        match self {
            Self::BuiltIn(preset) => Ok(preset.rig()),
            Self::File(path) => Ok(data::read_rig(path)?),
            Self::Dataset(path) => of_dataset(path),
        }
    }

    /// A short name for pictures, tables and folders: the vehicle's, or the file's without its ending.
    pub fn name(&self) -> String {
        match self {
            Self::BuiltIn(preset) => preset.name().to_owned(),
            Self::File(path) | Self::Dataset(path) => {
                path.file_stem().map_or_else(|| "rig".to_owned(), |stem| stem.to_string_lossy().into_owned())
            }
        }
    }
}

fn of_dataset(path: &Path) -> anyhow::Result<CameraRig> {
    let datasets = config_file::load::<DataFile>(path, &[])?.data;
    let [dataset] = datasets.as_slice() else {
        bail!("{} [[data]] tables where one lends its rig: {}", datasets.len(), path.display());
    };
    let dataset = data::open(dataset).with_context(|| format!("in {}", path.display()))?;
    if dataset.is_empty() {
        bail!("the dataset has no frame that could lend its rig: {}", path.display());
    }
    Ok(dataset.frame(0)?.rig())
}

impl FromStr for RigChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let ends = |ending: &str| text.len() > ending.len() && text.to_ascii_lowercase().ends_with(ending);
        if ends(".json") {
            return Ok(Self::File(text.into()));
        }
        if ends(".toml") {
            return Ok(Self::Dataset(text.into()));
        }
        let plain = text.to_ascii_lowercase().replace(['_', '-'], "");
        let known = RigPreset::ALL.into_iter().find(|preset| {
            let short = match preset {
                RigPreset::Argoverse2 => Some("av2"),
                RigPreset::WayveScenes101 => Some("ws101"),
                _ => None,
            };
            plain == preset.name().replace('_', "") || Some(plain.as_str()) == short
        });
        let names: Vec<String> = RigPreset::ALL.iter().map(|preset| preset.name().replace('_', "")).collect();
        known.map(Self::BuiltIn).ok_or_else(|| {
            format!(
                "there is no rig {text:?}, only {}, a rig as FILE.json or a dataset's as FILE.toml",
                names.join(", ")
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_files_and_typos_are_told_apart() {
        for preset in RigPreset::ALL {
            assert_eq!(preset.name().parse::<RigChoice>().unwrap(), RigChoice::BuiltIn(preset));
            let plain = preset.name().replace('_', "").to_uppercase();
            assert_eq!(plain.parse::<RigChoice>().unwrap(), RigChoice::BuiltIn(preset));
        }
        let short = ["av2", "ws101"].map(|name| name.parse::<RigChoice>().unwrap().open().unwrap().len());
        assert_eq!(short, [7, 5]);
        let file: RigChoice = "cars/mine.JSON".parse().unwrap();
        assert_eq!((file.clone(), file.name().as_str()), (RigChoice::File("cars/mine.JSON".into()), "mine"));
        let typo = "nuscense".parse::<RigChoice>().unwrap_err();
        assert!(typo.contains("nuscense") && typo.contains("wayvescenes101") && typo.contains(".json"), "{typo}");
        assert!("".parse::<RigChoice>().is_err() && ".json".parse::<RigChoice>().is_err());
    }

    #[test]
    fn a_dataset_lends_the_rig_of_its_first_frame() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cars.toml");
        let open = |text: &str| {
            std::fs::write(&path, text).unwrap();
            RigChoice::Dataset(path.clone()).open().map_err(|error| format!("{error:#}"))
        };
        let one = "[[data]]\nkind = \"procedural\"\nscenes = 1\nrig = { preset = \"argoverse2\" }\n";
        assert_eq!(open(one).unwrap().len(), 7);
        for text in [format!("{one}{one}"), "data = []".to_owned(), one.replace("scenes", "scnes")] {
            let error = open(&text).unwrap_err();
            assert!(error.contains("cars.toml"), "{error}");
        }
    }
}
