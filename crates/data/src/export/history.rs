//! Historical frame replacement: a nuScenes folder again, in which a share of the past frames shows generated pictures.
//!
//! Paper: "Scalable and Generalizable Autonomous Driving Scene Synthesis", section 4.8: detectors that look at a queue of frames learn that
//! places do not depend on looks. Nothing is copied and the originals are not touched: every file is a link.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::Generator;
use super::publish::{ExportManifest, GENERATED};
use crate::nuscenes::NuScenes;
use crate::staging::{self, MANIFEST, Staging, io};
use crate::{DataError, ImageSource, SceneDataset, SceneFrame};

/// How files of the new folder refer to the old ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkKind {
    /// By name, over file systems; whole folders where nothing changes.
    #[default]
    Symbolic,
    /// The same file under a second name; needs one file system.
    Hard,
}

/// Settings of [`replace_history`].
#[derive(Debug, Clone, PartialEq)]
pub struct HistoryConfig {
    /// Folder to make.
    pub out: PathBuf,
    /// Replace a folder that this crate has written.
    pub force: bool,
    /// Probability that a past frame is replaced, in 0 to 1.
    pub share: f64,
    /// Which ones.
    pub seed: u64,
    /// Kind of the links.
    pub link: LinkKind,
}

/// `manifest.json` in the new folder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HistoryManifest {
    /// Name and version of the tool.
    pub tool: String,
    /// What the folder is.
    pub format: String,
    /// Probability of replacement.
    pub share: f64,
    /// Which frames.
    pub seed: u64,
    /// Frames that lie in another frame's past.
    pub past_frames: usize,
    /// Who painted the generated pictures, where their folder says.
    pub generator: Option<Generator>,
    /// The replaced frames: those whose pictures are generated and which a detector should see as history only.
    pub replaced: Vec<ReplacedFrame>,
}

/// A frame with generated pictures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReplacedFrame {
    /// Its scene.
    pub scene: String,
    /// Token of its sample.
    pub sample: String,
}

/// Links the folder of `real` anew, with the pictures of `generated` in place of those of some past frames.
///
/// A past frame is one that a later frame of its scene follows, among the frames that `real` was opened with; frames outside them stay. Each is
/// replaced with probability `share`, by a draw that depends on the seed and the sample's token alone, in all its views or in none. So a larger
/// share replaces the same frames and more.
///
/// # Errors
/// [`DataError::Config`] for a share that is none, for an output that exists, for a dataset that is no plain folder and for generated frames
/// that lack a picture; [`DataError::Io`], naming the file.
pub fn replace_history(
    real: &NuScenes,
    generated: &NuScenes,
    config: &HistoryConfig,
) -> Result<HistoryManifest, DataError> {
    if !(0.0..=1.0).contains(&config.share) {
        return Err(DataError::Config(format!("the share must lie in 0..=1, but is {}", config.share)));
    }
    let (real_root, generated_root) = (folder(real)?, folder(generated)?);
    let staging = Staging::new(&config.out, config.force)?;
    let (mut past_frames, mut replaced, mut pictures) = (0, Vec::new(), BTreeMap::new());
    let by_token = frames_by_token(generated)?;
    for range in real.scene_ranges() {
        // The last frame is nobody's past.
        for index in range.start..range.end.saturating_sub(1) {
            past_frames += 1;
            let frame = real.frame(index)?;
            if draw(config.seed, &frame.id.frame) >= config.share {
                continue;
            }
            let made = by_token.get(&frame.id.frame).map(|at| generated.frame(*at)).transpose()?;
            let found = matching(&frame, made.as_ref(), &real_root);
            pictures.extend(found.map_err(|why| {
                let root = generated_root.display();
                DataError::Config(format!("frame {} of {}: {why}: {root}", frame.id.frame, frame.id.scene))
            })?);
            replaced.push(ReplacedFrame { scene: frame.id.scene, sample: frame.id.frame });
        }
    }
    let linker = Linker { kind: config.link, pictures };
    linker.link_folder(&real_root, &staging.folder(), Path::new(""))?;
    let manifest = HistoryManifest {
        tool: concat!("rigscape ", env!("CARGO_PKG_VERSION")).to_owned(),
        format: "nuscenes with replaced history".to_owned(),
        share: config.share,
        seed: config.seed,
        past_frames,
        generator: generator_of(&generated_root)?,
        replaced,
    };
    let path = staging.folder().join(MANIFEST);
    let bytes = serde_json::to_vec_pretty(&manifest)
        .map_err(|error| DataError::Json { why: error.to_string(), path: path.clone() })?;
    staging::write(&path, &bytes)?;
    staging.publish()?;
    Ok(manifest)
}

/// The one folder a dataset lies in.
fn folder(dataset: &NuScenes) -> Result<PathBuf, DataError> {
    let refuse = |path: &Path| {
        Err(DataError::Config(format!("only a single folder can be linked anew, not archives: {}", path.display())))
    };
    match dataset.roots().as_slice() {
        [one] if one.path.is_dir() && one.inside.is_empty() => {
            std::path::absolute(&one.path).map_err(io("resolve", &one.path))
        }
        [one, ..] => refuse(&one.path),
        [] => refuse(Path::new("")),
    }
}

fn frames_by_token(dataset: &NuScenes) -> Result<BTreeMap<String, usize>, DataError> {
    (0..dataset.len()).map(|index| Ok((dataset.frame(index)?.id.frame, index))).collect()
}

/// Uniform in [0, 1), a function of seed and token.
fn draw(seed: u64, token: &str) -> f64 {
    let digest = Sha256::digest(format!("rigscape/history/{seed}\u{1f}{token}"));
    let bits = digest.iter().take(8).fold(0u64, |sum, byte| (sum << 8) | u64::from(*byte));
    // 53 bits fill an f64's mantissa exactly.
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// For each picture of a frame, by its name below the root, the file of the generated one.
fn matching(real: &SceneFrame, made: Option<&SceneFrame>, real_root: &Path) -> Result<Vec<(PathBuf, PathBuf)>, String> {
    let made = made.ok_or("the generated dataset has no such frame; generate the whole split")?;
    let mut pairs = Vec::new();
    for view in &real.views {
        let Some(old) = view.image.as_ref().and_then(on_disk) else { continue };
        let new = made.views.iter().find(|other| other.channel == view.channel);
        let new = new.and_then(|view| view.image.as_ref()).and_then(on_disk).filter(|path| path.is_file());
        let new =
            new.ok_or_else(|| format!("there is no generated picture of {}; generate the whole split", view.channel))?;
        let name = old.strip_prefix(real_root).map_err(|_| format!("{} lies outside the dataset", old.display()))?;
        pairs.push((name.to_owned(), new.to_owned()));
    }
    Ok(pairs)
}

fn on_disk(source: &ImageSource) -> Option<&Path> {
    match source {
        ImageSource::File { file, .. } => file.on_disk(),
        _ => None,
    }
}

fn generator_of(root: &Path) -> Result<Option<Generator>, DataError> {
    let path = root.join(GENERATED);
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = std::fs::read(&path).map_err(io("read", &path))?;
    let manifest: ExportManifest =
        serde_json::from_slice(&bytes).map_err(|error| DataError::Json { why: error.to_string(), path })?;
    Ok(Some(manifest.generator))
}

struct Linker {
    kind: LinkKind,
    /// New files by name below the root.
    pictures: BTreeMap<PathBuf, PathBuf>,
}

impl Linker {
    fn changes(&self, below: &Path) -> bool {
        self.pictures.range(below.to_owned()..).next().is_some_and(|(name, _)| name.starts_with(below))
    }

    fn link_folder(&self, from: &Path, to: &Path, below: &Path) -> Result<(), DataError> {
        staging::create_dir(to)?;
        for entry in std::fs::read_dir(from).map_err(io("list", from))? {
            let name = entry.map_err(io("list", from))?.file_name();
            let (old, new, inside) = (from.join(&name), to.join(&name), below.join(&name));
            if below == Path::new("") && (name == MANIFEST || name == GENERATED) {
                continue;
            }
            match self.pictures.get(&inside) {
                Some(picture) => self.link(picture, &new)?,
                None if old.is_dir() && (self.kind == LinkKind::Hard || self.changes(&inside)) => {
                    self.link_folder(&old, &new, &inside)?;
                }
                None => self.link(&old, &new)?,
            }
        }
        Ok(())
    }

    fn link(&self, from: &Path, to: &Path) -> Result<(), DataError> {
        match self.kind {
            LinkKind::Symbolic => symbolic(from, to).map_err(io("make the symbolic link", to)),
            LinkKind::Hard => std::fs::hard_link(from, to).map_err(io("make the hard link (try symbolic links)", to)),
        }
    }
}

#[cfg(unix)]
fn symbolic(from: &Path, to: &Path) -> std::io::Result<()> {
    std::os::unix::fs::symlink(from, to)
}

#[cfg(windows)]
fn symbolic(from: &Path, to: &Path) -> std::io::Result<()> {
    if from.is_dir() {
        std::os::windows::fs::symlink_dir(from, to)
    } else {
        std::os::windows::fs::symlink_file(from, to)
    }
}
