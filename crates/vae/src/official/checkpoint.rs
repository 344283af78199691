//! A Lightning checkpoint of the public code as a source of our parameters.
//!
//! Averaged weights lie in one of three places: as a list without names in the optimizer's state, in the order of the parameters of
//! encoder, decoder, `pre_quant`, `post_quant` (what the released files have); by name in a callback's state; or, with Lightning's
//! own averaging callback, in `state_dict` itself, with the current weights beside it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use geometry::FrustumPixels;
use nn::weights::{TensorGroup, WeightError, WeightFile, fill_params, param_shapes, torch_groups};

use super::names::{is_ignored, official_name, official_shape};
use super::report::{KeyReport, KeyStatus, Report};
use crate::{BevVae, BevVaeConfig};

/// Order of the modules in the list of averages.
const LISTED_MODULES: [&str; 4] = ["encoder.", "decoder.", "pre_quant.", "post_quant."];
/// Groups of every norm, fixed in the public code.
const OFFICIAL_NORM_GROUPS: usize = 32;
/// Where Lightning's averaging callback puts what it replaced.
const REPLACED: &str = "current_model_state";

/// Why a checkpoint cannot be taken.
#[derive(Debug, thiserror::Error)]
pub enum OfficialError {
    /// The file itself.
    #[error(transparent)]
    Weights(#[from] WeightError),
    /// A setting that shapes do not show and the public code has fixed.
    #[error("the public code knows {setting} = {official} only, the model has {ours}")]
    Setting {
        /// Key of the model's config.
        setting: &'static str,
        /// Its official value.
        official: String,
        /// Ours.
        ours: String,
    },
    /// Keys that do not fit.
    #[error("{} of {} keys do not fit:{report}\n  in: {}", report.faults().count(), report.keys.len(), path.display())]
    Keys {
        /// Every key.
        report: Box<Report>,
        /// The file.
        path: PathBuf,
    },
    /// Averaged weights were asked for and there are none.
    #[error(
        "no averaged weights: neither a list `ema` in an optimizer's state nor named ones in a callback's, only {}: {}",
        places.join(", "),
        path.display()
    )]
    NoAverage {
        /// Where tensors lie.
        places: Vec<String>,
        /// The file.
        path: PathBuf,
    },
    /// The list of averages is too short.
    #[error("{place} holds {found} tensors, the network has {wanted} parameters: {}", path.display())]
    ShortList {
        /// Keys of the list.
        place: String,
        /// Its length.
        found: usize,
        /// Parameters.
        wanted: usize,
        /// The file.
        path: PathBuf,
    },
}

/// Where averaged weights were found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Average {
    /// Keys from the outermost dictionary, joined by `/`.
    pub place: String,
    /// Tensors there that belong to no parameter: the discriminator's.
    pub surplus: usize,
}

/// The averages and how a parameter's is called among them.
#[derive(Debug)]
struct Averages {
    file: WeightFile,
    /// Official name to the name in `file`.
    names: BTreeMap<String, String>,
    found: Average,
}

/// An official checkpoint whose keys all fit a network.
#[derive(Debug)]
pub struct OfficialCheckpoint {
    current: WeightFile,
    averages: Option<Averages>,
    report: Report,
}

impl OfficialCheckpoint {
    /// Opens a file and compares every key with this network's. Reads no values.
    ///
    /// # Errors
    /// See [`OfficialError`]. A list of averages that does not fit is an error, too.
    pub fn open(path: &Path, model: &BevVae) -> Result<Self, OfficialError> {
        check_settings(model.config())?;
        let parameters = param_shapes(model).into_iter();
        let wanted: Wanted = parameters
            .map(|(ours, shape)| (official_name(&ours), (ours.clone(), official_shape(&ours, &shape))))
            .collect();
        let groups = torch_groups(path)?;
        let replaced = groups.iter().any(|group| group.keys == [REPLACED]);
        let state_dict = WeightFile::open_nested(path, &["state_dict"])?;
        let (current, averages) = if replaced {
            let names = state_dict.names().map(|name| (name.to_owned(), name.to_owned())).collect();
            let found = Average { place: "state_dict".to_owned(), surplus: 0 };
            (WeightFile::open_nested(path, &[REPLACED])?, Some(Averages { file: state_dict, names, found }))
        } else {
            let averages = find_averages(path, &groups, &state_dict, &wanted)?;
            (state_dict, averages)
        };
        let report = compare(&current, averages.as_ref(), &wanted);
        if report.faults().next().is_some() {
            return Err(OfficialError::Keys { report: Box::new(report), path: path.to_path_buf() });
        }
        Ok(Self { current, averages, report })
    }

    /// Every key and what becomes of it.
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// Where averaged weights were found.
    pub fn average(&self) -> Option<&Average> {
        self.averages.as_ref().map(|averages| &averages.found)
    }

    /// Where averaged weights were found, or that there are none.
    ///
    /// # Errors
    /// [`OfficialError::NoAverage`].
    pub fn need_average(&self) -> Result<&Average, OfficialError> {
        self.averages().map(|averages| &averages.found)
    }

    fn averages(&self) -> Result<&Averages, OfficialError> {
        if let Some(averages) = &self.averages {
            return Ok(averages);
        }
        let path = self.current.path();
        let places = torch_groups(path)?.iter().map(|group| group.keys.join("/")).collect();
        Err(OfficialError::NoAverage { places, path: path.to_path_buf() })
    }

    /// The network with the weights of the last step.
    ///
    /// # Errors
    /// [`OfficialError::Weights`] when the file changed or shrank meanwhile.
    pub fn current(&self, model: BevVae) -> Result<BevVae, OfficialError> {
        Ok(fill_params(model, |path, _| Ok(self.current.tensor(&official_name(path))?.data))?)
    }

    /// The network with averaged weights.
    ///
    /// # Errors
    /// [`OfficialError::NoAverage`] where the file has none; as [`OfficialCheckpoint::current`].
    pub fn averaged(&self, model: BevVae) -> Result<BevVae, OfficialError> {
        let averages = self.averages()?;
        let name = |path: &str| averages.names.get(&official_name(path)).cloned().unwrap_or_default();
        Ok(fill_params(model, |path, _| Ok(averages.file.tensor(&name(path))?.data))?)
    }
}

/// What the public code has fixed and no shape shows.
fn check_settings(config: &BevVaeConfig) -> Result<(), OfficialError> {
    let pixels = config.frustum.pixels;
    if pixels != FrustumPixels::EndToEnd {
        let (official, ours) = ("end_to_end".to_owned(), format!("{pixels:?}"));
        return Err(OfficialError::Setting { setting: "frustum.pixels", official, ours });
    }
    let groups = config.scene.norm_groups;
    if groups != OFFICIAL_NORM_GROUPS {
        let (official, ours) = (OFFICIAL_NORM_GROUPS.to_string(), groups.to_string());
        return Err(OfficialError::Setting { setting: "scene.norm_groups", official, ours });
    }
    Ok(())
}

/// Official name to our path and the official shape.
type Wanted = BTreeMap<String, (String, Vec<usize>)>;

fn find_averages(
    path: &Path,
    groups: &[TensorGroup],
    state_dict: &WeightFile,
    wanted: &Wanted,
) -> Result<Option<Averages>, OfficialError> {
    let open = |group: &TensorGroup| {
        let keys: Vec<&str> = group.keys.iter().map(String::as_str).collect();
        WeightFile::open_nested(path, &keys)
    };
    let is_named = |group: &&TensorGroup, name: &str| group.keys.last().is_some_and(|key| key == name);
    let in_optimizer = |group: &&TensorGroup| group.keys.first().is_some_and(|key| key == "optimizer_states");
    if let Some(list) = groups.iter().filter(in_optimizer).find(|group| group.is_list && is_named(group, "ema")) {
        let parameters = listed_parameters(state_dict, wanted);
        let (place, found) = (list.keys.join("/"), list.names.len());
        if found < parameters.len() {
            let wanted = parameters.len();
            return Err(OfficialError::ShortList { place, found, wanted, path: path.to_path_buf() });
        }
        let surplus = found - parameters.len();
        let names = parameters.into_iter().zip(list.names.iter().cloned()).collect();
        return Ok(Some(Averages { file: open(list)?, names, found: Average { place, surplus } }));
    }
    for group in groups.iter().filter(|group| group.keys != ["state_dict"]) {
        if let Some(names) = named_like(group, wanted) {
            let surplus = group.names.len() - names.len();
            let found = Average { place: group.keys.join("/"), surplus };
            return Ok(Some(Averages { file: open(group)?, names, found }));
        }
    }
    Ok(None)
}

/// Parameters in the order of the list: module by module, inside a module as the file has them.
fn listed_parameters(state_dict: &WeightFile, wanted: &Wanted) -> Vec<String> {
    let of = |module: &'static str| {
        let inside = move |name: &&str| name.starts_with(module) && wanted.contains_key(*name);
        state_dict.names_in_order().filter(inside).map(str::to_owned)
    };
    LISTED_MODULES.into_iter().flat_map(of).collect()
}

/// The name of every parameter in a group that has all of them, perhaps behind the prefix of a wrapper.
fn named_like(group: &TensorGroup, wanted: &Wanted) -> Option<BTreeMap<String, String>> {
    if group.is_list || wanted.is_empty() {
        return None;
    }
    ["", "module.", "model."].into_iter().find_map(|prefix| {
        let names: BTreeMap<String, String> = group
            .names
            .iter()
            .filter_map(|name| Some((name.strip_prefix(prefix)?.to_owned(), name.clone())))
            .filter(|(official, _)| wanted.contains_key(official))
            .collect();
        (names.len() == wanted.len()).then_some(names)
    })
}

fn compare(current: &WeightFile, averages: Option<&Averages>, wanted: &Wanted) -> Report {
    let mut keys: Vec<KeyReport> = current
        .names_in_order()
        .map(|name| {
            let shape = current.shape(name).unwrap_or_default().to_vec();
            let ours = wanted.get(name);
            let status = match ours {
                None if is_ignored(name) => KeyStatus::Ignored,
                None => KeyStatus::Unexpected,
                Some((_, expected)) if *expected != shape => KeyStatus::WrongShape(expected.clone()),
                Some(_) if current.is_integer(name) => KeyStatus::NoFloats,
                Some(_) => averages.map_or(KeyStatus::Taken, |averages| averages.status_of(name, &shape)),
            };
            KeyReport {
                official: name.to_owned(),
                ours: ours.map(|(path, _)| path.clone()),
                shape: Some(shape),
                status,
            }
        })
        .collect();
    let missing = wanted.iter().filter(|(name, _)| current.shape(name).is_none());
    keys.extend(missing.map(|(name, (path, shape))| KeyReport {
        official: name.clone(),
        ours: Some(path.clone()),
        shape: None,
        status: KeyStatus::Missing(shape.clone()),
    }));
    Report { keys }
}

impl Averages {
    fn status_of(&self, official: &str, shape: &[usize]) -> KeyStatus {
        let name = self.names.get(official).map_or("", String::as_str);
        match self.file.shape(name) {
            Some(found) if found == shape && !self.file.is_integer(name) => KeyStatus::Taken,
            found => KeyStatus::WrongAverage(found.unwrap_or_default().to_vec()),
        }
    }
}
