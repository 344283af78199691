//! The layout of the published latents: `<root>/bev-lidar/<split>/<log>/<timestamp_ns>.npy` for annotated frames, `<root>/bev/...` for
//! all frames (source: the dataset flags of the public code Czm369/bev-vae). How a file's array is laid out is nowhere documented, so it is
//! declared, or told by its shape where only one reading fits. Files hold no boxes: they are joined to a dataset on the exact instant.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use half::f16;
use serde::{Deserialize, Serialize};

use super::{Latent, LatentDataset, LatentType, write_whole};
use crate::npz::{Dtype, Want, npy_bytes, parse_npy};
use crate::{Capabilities, DataError, FrameOutline, SceneDataset, SceneFrame};

/// Longest file; the largest latents have 256 KiB.
const MOST_BYTES: u64 = 1 << 26;

/// How the array of a file is laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NpyLayout {
    /// `[h·w, C]`, row-major cells
    Tokens,
    /// `[C, h, w]`, or `[2C, h, w]`: means, then log variances
    Chw,
    /// `[h, w, C]`, or `[h, w, 2C]`
    Hwc,
    /// `[h·w, 2C]`: means, then log variances
    MomentsTokens,
}

/// Which frames a tree holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TreeKind {
    /// `bev-lidar`: annotated frames, at the instants of the lidar.
    #[default]
    BevLidar,
    /// `bev`: every frame.
    Bev,
}

impl TreeKind {
    /// The folder's name.
    pub const fn folder(self) -> &'static str {
        match self {
            Self::BevLidar => "bev-lidar",
            Self::Bev => "bev",
        }
    }
}

/// Where a tree lies.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NpyTreeConfig {
    /// The folder that holds `bev-lidar` or `bev`.
    pub root: PathBuf,
    /// The folder below it: `train`, `val`.
    pub split: String,
    /// Which frames.
    #[serde(default)]
    pub kind: TreeKind,
    /// Layout of the arrays; needed only where their shape leaves a choice.
    #[serde(default)]
    pub layout: Option<NpyLayout>,
}

impl NpyTreeConfig {
    fn file(&self, scene: &str, timestamp_ns: i64) -> PathBuf {
        self.scene(scene).join(format!("{timestamp_ns}.npy"))
    }

    fn scene(&self, scene: &str) -> PathBuf {
        self.root.join(self.kind.folder()).join(&self.split).join(scene)
    }
}

impl NpyLayout {
    const ALL: [Self; 4] = [Self::Tokens, Self::Chw, Self::Hwc, Self::MomentsTokens];

    const fn name(self) -> &'static str {
        match self {
            Self::Tokens => "tokens",
            Self::Chw => "chw",
            Self::Hwc => "hwc",
            Self::MomentsTokens => "moments_tokens",
        }
    }

    /// Shapes of latents `[C, h, w]` in this layout, with the number of channels in the file.
    fn shapes(self, [c, h, w]: [usize; 3]) -> Vec<(Vec<usize>, usize)> {
        match self {
            Self::Tokens => vec![(vec![h * w, c], c)],
            Self::MomentsTokens => vec![(vec![h * w, 2 * c], 2 * c)],
            Self::Chw => vec![(vec![c, h, w], c), (vec![2 * c, h, w], 2 * c)],
            Self::Hwc => vec![(vec![h, w, c], c), (vec![h, w, 2 * c], 2 * c)],
        }
    }

    /// Whether channels run fastest.
    fn channels_last(self) -> bool {
        self != Self::Chw
    }
}

/// A tree with the dataset that its files belong to.
pub struct NpyTree {
    config: NpyTreeConfig,
    shape: [usize; 3],
    dataset: Arc<dyn SceneDataset>,
    /// Frames of the dataset that have a latent.
    frames: Vec<(usize, String, i64)>,
}

impl std::fmt::Debug for NpyTree {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("NpyTree").field("config", &self.config).field("frames", &self.frames.len()).finish()
    }
}

impl NpyTree {
    /// Joins the tree to a dataset: every annotated frame needs its file, and in `bev-lidar` every file of its logs needs its frame.
    ///
    /// # Errors
    /// [`DataError::Missing`] naming the partner that is not there; whatever is wrong with the first file.
    pub fn open(config: NpyTreeConfig, shape: [usize; 3], dataset: Arc<dyn SceneDataset>) -> Result<Self, DataError> {
        let mut frames = Vec::new();
        for scene in dataset.scene_ranges().into_iter().filter(|scene| !scene.is_empty()) {
            let name = dataset.frame(scene.start)?.id.scene;
            let mut files = listed(&config.scene(&name))?;
            for index in scene {
                let FrameOutline { timestamp_ns, annotated, .. } = dataset.outline(index)?;
                let found = files.remove(&timestamp_ns);
                if annotated && !found {
                    let what = format!("latent of the frame at {timestamp_ns} of {name} in {}", dataset.name());
                    return Err(DataError::Missing { what, path: config.file(&name, timestamp_ns) });
                }
                if annotated {
                    frames.push((index, name.clone(), timestamp_ns));
                }
            }
            if let (Some(extra), TreeKind::BevLidar) = (files.first(), config.kind) {
                let what =
                    format!("frame at exactly {extra} of {name} in {}, to which a latent belongs", dataset.name());
                return Err(DataError::Missing { what, path: config.file(&name, *extra) });
            }
        }
        if frames.is_empty() {
            let path = config.root.join(config.kind.folder()).join(&config.split);
            return Err(DataError::Empty { what: format!("the set of annotated frames of {}", dataset.name()), path });
        }
        let tree = Self { config, shape, dataset, frames };
        tree.latent(0)?;
        Ok(tree)
    }

    /// The tree.
    pub fn config(&self) -> &NpyTreeConfig {
        &self.config
    }

    /// The frame of the dataset that a sample comes from, pictures included.
    ///
    /// # Errors
    /// As the dataset's.
    pub fn source_frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        self.dataset.frame(self.entry(index)?.0)
    }

    fn entry(&self, index: usize) -> Result<&(usize, String, i64), DataError> {
        self.frames.get(index).ok_or_else(|| {
            DataError::Config(format!("{} has no frame {index}, only {}", self.dataset.name(), self.frames.len()))
        })
    }
}

/// Instants of the files of a log.
fn listed(folder: &Path) -> Result<BTreeSet<i64>, DataError> {
    let entries = std::fs::read_dir(folder).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => {
            DataError::Missing { what: "folder of a log's latents".into(), path: folder.into() }
        }
        _ => DataError::Io { action: "list", source, path: folder.into() },
    })?;
    let mut found = BTreeSet::new();
    for entry in entries {
        let name = entry.map_err(crate::staging::io("list", folder))?.file_name();
        let name = name.to_string_lossy();
        let Some(stem) = name.strip_suffix(".npy") else { continue };
        let instant = stem.parse().map_err(|_| DataError::Format {
            format: "latent",
            why: "its name is no instant in nanoseconds".to_owned(),
            path: folder.join(&*name),
        })?;
        found.insert(instant);
    }
    Ok(found)
}

impl LatentDataset for NpyTree {
    fn shape(&self) -> [usize; 3] {
        self.shape
    }

    fn latent(&self, index: usize) -> Result<Latent, DataError> {
        let (_, scene, timestamp_ns) = self.entry(index)?;
        let path = self.config.file(scene, *timestamp_ns);
        let size = std::fs::metadata(&path).map_err(crate::staging::io("look at", &path))?.len();
        if size > MOST_BYTES {
            let why = format!("{size} bytes are more than any latent has");
            return Err(DataError::Format { format: "latent", why, path });
        }
        let bytes = std::fs::read(&path).map_err(crate::staging::io("read", &path))?;
        parse(&bytes, &path, self.shape, self.config.layout)
    }
}

/// The latent of a file's bytes.
fn parse(bytes: &[u8], path: &Path, shape: [usize; 3], declared: Option<NpyLayout>) -> Result<Latent, DataError> {
    let layouts = declared.map_or(NpyLayout::ALL.to_vec(), |layout| vec![layout]);
    let (mut fitting, mut refusal) = (Vec::new(), None);
    for layout in layouts {
        for (want, channels) in layout.shapes(shape) {
            let want: Vec<Option<usize>> = want.into_iter().map(Some).collect();
            match parse_npy(bytes, path, &Want { dtypes: &[Dtype::F16, Dtype::F32], shape: &want }) {
                Ok(array) => fitting.push((layout, channels, array)),
                Err(error @ DataError::Array { .. }) => refusal = Some(error),
                Err(error) => return Err(error),
            }
        }
    }
    let names = fitting.iter().map(|(layout, ..)| layout.name()).collect::<Vec<_>>();
    match (fitting.pop(), fitting.is_empty(), refusal) {
        (Some((layout, channels, array)), true, _) => {
            let values: Vec<f32> = array.to_f64().into_iter().map(|value| value as f32).collect();
            ordered(&values, layout, channels, shape).checked(shape, path)
        }
        (Some(_), false, _) => Err(DataError::Format {
            format: "latent",
            why: format!("its shape may be {}; declare `layout`", names.join(" or ")),
            path: path.to_owned(),
        }),
        (None, _, Some(error)) => Err(error),
        (None, _, None) => {
            Err(DataError::Format { format: "latent", why: "it has no array".to_owned(), path: path.to_owned() })
        }
    }
}

/// Means, and log variances where there are twice as many channels, as `[C, h, w]`.
fn ordered(values: &[f32], layout: NpyLayout, channels: usize, [c, h, w]: [usize; 3]) -> Latent {
    let cells = h * w;
    let plane = |channel: usize| -> Vec<f32> {
        if layout.channels_last() {
            values.iter().skip(channel).step_by(channels).copied().collect()
        } else {
            values.iter().skip(channel * cells).take(cells).copied().collect()
        }
    };
    let part = |from: usize| (from..from + c).flat_map(plane).collect::<Vec<f32>>();
    Latent { mean: part(0), log_var: (channels == 2 * c).then(|| part(c)) }
}

impl SceneDataset for NpyTree {
    fn len(&self) -> usize {
        self.frames.len()
    }

    /// Without views: the latent stands for the pictures.
    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        Ok(SceneFrame { views: Vec::new(), ..self.source_frame(index)? })
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        let mut ranges: Vec<Range<usize>> = Vec::new();
        for (at, (_, scene, _)) in self.frames.iter().enumerate() {
            match ranges.last_mut() {
                Some(last) if self.frames.get(last.start).is_some_and(|(_, first, _)| first == scene) => {
                    last.end = at + 1
                }
                _ => ranges.push(at..at + 1),
            }
        }
        ranges
    }

    fn name(&self) -> &str {
        self.dataset.name()
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { boxes: true, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        0
    }
}

/// Writes a tree; files that are there already are left out, each appears whole or not at all.
#[derive(Debug, Clone)]
pub struct NpyTreeWriter {
    config: NpyTreeConfig,
    layout: NpyLayout,
    shape: [usize; 3],
    dtype: LatentType,
}

impl NpyTreeWriter {
    /// Without a declared layout means alone are written, as tokens.
    ///
    /// # Errors
    /// A split that is no plain name.
    pub fn new(config: NpyTreeConfig, shape: [usize; 3], dtype: LatentType) -> Result<Self, DataError> {
        crate::staging::check_names("split", std::slice::from_ref(&config.split))?;
        let layout = config.layout.unwrap_or(NpyLayout::Tokens);
        Ok(Self { config, layout, shape, dtype })
    }

    /// Whether the frame's file is there already.
    pub fn has(&self, frame: &SceneFrame) -> bool {
        self.config.file(&frame.id.scene, frame.timestamp_ns).is_file()
    }

    /// Writes one file. Only [`NpyLayout::MomentsTokens`] keeps the variance.
    ///
    /// # Errors
    /// A scene whose name is no plain file name, a number that half precision cannot hold, a file that cannot be written.
    pub fn add(&self, frame: &SceneFrame, latent: &Latent) -> Result<(), DataError> {
        crate::staging::check_names("scene", std::slice::from_ref(&frame.id.scene))?;
        crate::staging::create_dir(&self.config.scene(&frame.id.scene))?;
        let path = self.config.file(&frame.id.scene, frame.timestamp_ns);
        let latent = latent.clone().checked(self.shape, &path)?;
        let [_, h, w] = self.shape;
        let planes: Vec<&[f32]> = match (&latent.log_var, self.layout) {
            (Some(log_var), NpyLayout::MomentsTokens) => {
                latent.mean.chunks(h * w).chain(log_var.chunks(h * w)).collect()
            }
            (None, NpyLayout::MomentsTokens) => {
                return Err(DataError::Config("this latent has no variance to write as moments".to_owned()));
            }
            _ => latent.mean.chunks(h * w).collect(),
        };
        let values: Vec<f32> = if self.layout.channels_last() {
            (0..h * w).flat_map(|cell| planes.iter().filter_map(move |plane| plane.get(cell)).copied()).collect()
        } else {
            planes.concat()
        };
        let shapes = self.layout.shapes(self.shape);
        let shape = shapes.first().map_or(&[][..], |(shape, _)| shape);
        let bytes = match self.dtype {
            LatentType::F32 => {
                npy_bytes(Dtype::F32, shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())?
            }
            LatentType::F16 => {
                if let Some(value) = values.iter().find(|value| !f16::from_f32(**value).is_finite()) {
                    let why = format!("{value} does not fit half precision; write f32 instead");
                    return Err(DataError::Format { format: "latent", why, path });
                }
                let halves = values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect::<Vec<_>>();
                npy_bytes(Dtype::F16, shape, &halves)?
            }
        };
        write_whole(&path, &bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[C, h, w]` = `[2, 3, 4]`: every number names its place.
    const SHAPE: [usize; 3] = [2, 3, 4];

    fn wanted(extra: f32) -> Vec<f32> {
        (0..24).map(|at| extra + at as f32).collect()
    }

    fn file(shape: &[usize], values: &[f32]) -> Vec<u8> {
        npy_bytes(Dtype::F32, shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>()).unwrap()
    }

    fn channels_last(planes: &[f32]) -> Vec<f32> {
        (0..12).flat_map(|cell| planes.iter().skip(cell).step_by(12).copied().collect::<Vec<_>>()).collect()
    }

    #[test]
    fn every_layout_gives_the_same_latent() {
        let (mean, log_var) = (wanted(0.0), wanted(100.0));
        let both = [mean.clone(), log_var.clone()].concat();
        let path = Path::new("some.npy");
        for (shape, values, has_variance) in [
            (vec![12, 2], channels_last(&mean), false),
            (vec![2, 3, 4], mean.clone(), false),
            (vec![3, 4, 2], channels_last(&mean), false),
            (vec![12, 4], channels_last(&both), true),
            (vec![4, 3, 4], both.clone(), true),
            (vec![3, 4, 4], channels_last(&both), true),
        ] {
            let got = parse(&file(&shape, &values), path, SHAPE, None).unwrap();
            assert_eq!(got.mean, mean, "{shape:?}");
            assert_eq!(got.log_var, has_variance.then(|| log_var.clone()), "{shape:?}");
        }
    }

    #[test]
    fn ambiguous_shapes_must_be_declared_and_bad_numbers_are_named() {
        let path = Path::new("some.npy");
        let bytes = file(&[4, 4, 4], &(0..64).map(|at| at as f32).collect::<Vec<_>>());
        // Two channels over 4 x 4 cells: twice as many channels first or last.
        let error = parse(&bytes, path, [2, 4, 4], None).unwrap_err().to_string();
        assert!(error.contains("chw or hwc") && error.contains("some.npy"), "{error}");
        let first = parse(&bytes, path, [2, 4, 4], Some(NpyLayout::Chw)).unwrap();
        let last = parse(&bytes, path, [2, 4, 4], Some(NpyLayout::Hwc)).unwrap();
        assert_eq!((first.mean[1], last.mean[1]), (1.0, 4.0));
        let wrong = parse(&bytes, path, [3, 4, 4], None).unwrap_err().to_string();
        assert!(wrong.contains("some.npy") && wrong.contains("4, 4, 4"), "{wrong}");
        let nan =
            parse(&file(&[2, 1, 1], &[0.0, f32::NAN]), path, [2, 1, 1], Some(NpyLayout::Chw)).unwrap_err().to_string();
        assert!(nan.contains("number 1 is not finite"), "{nan}");
        let whole = npy_bytes(Dtype::I32, &[12, 2], &[0; 96]).unwrap();
        assert!(parse(&whole, path, SHAPE, None).is_err());
    }
}
