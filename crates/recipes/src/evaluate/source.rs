//! Where the pictures of one side come from: a folder, a dataset, a model that paints a dataset again.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use data::{SceneDataset, View};
use image::RgbImage;
use metrics::Raster;

/// All pictures of one instant.
#[derive(Debug, Clone)]
pub struct Instant {
    /// Unique within its side.
    pub name: String,
    /// Whether the instant is annotated; pictures of folders always count.
    pub key_frame: bool,
    /// Cameras that have a picture.
    pub views: Vec<Shot>,
    /// Clockwise neighbour of each view, by place in `views`.
    pub right_of: Vec<Option<usize>>,
    /// The view closest to straight ahead.
    pub front: usize,
}

/// One picture.
#[derive(Debug, Clone)]
pub struct Shot {
    /// Camera, or the picture's name.
    pub channel: String,
    /// As it is stored.
    pub picture: Raster<u8>,
}

/// An ordered list of instants in scenes.
pub trait PictureSource: Sync {
    /// For reports.
    fn describe(&self) -> String;

    /// Number of instants.
    fn len(&self) -> usize;

    /// True without instants.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Ranges of instants that follow each other in time.
    fn scenes(&self) -> Vec<Range<usize>>;

    /// The name of an instant, without decoding its pictures.
    ///
    /// # Errors
    /// Whatever is wrong with its rows.
    fn name(&self, index: usize) -> anyhow::Result<String>;

    /// One instant with its pictures.
    ///
    /// # Errors
    /// Whatever is wrong with its pictures, naming the file.
    fn instant(&self, index: usize) -> anyhow::Result<Instant>;
}

/// PNG and JPEG files below a folder, sorted by name. Every folder of pictures is a scene, its pictures follow each other in time.
#[derive(Debug, Clone)]
pub struct Folder {
    root: PathBuf,
    /// Relative to the root.
    files: Vec<PathBuf>,
}

/// Folders inside folders beyond this depth are not looked at, so that a link to a parent ends.
const MOST_DEPTH: usize = 8;

impl Folder {
    /// Lists a folder.
    ///
    /// # Errors
    /// A folder that cannot be listed or holds no picture.
    pub fn open(root: &Path) -> anyhow::Result<Self> {
        let mut files = Vec::new();
        list(root, Path::new(""), 0, &mut files)?;
        if files.is_empty() {
            bail!("there is no .png or .jpg in {}", root.display());
        }
        files.sort();
        Ok(Self { root: root.to_owned(), files })
    }
}

fn list(root: &Path, below: &Path, depth: usize, files: &mut Vec<PathBuf>) -> anyhow::Result<()> {
    let folder = root.join(below);
    for entry in std::fs::read_dir(&folder).with_context(|| format!("cannot list {}", folder.display()))? {
        let entry = entry.with_context(|| format!("cannot list {}", folder.display()))?;
        let (path, name) = (entry.path(), below.join(entry.file_name()));
        if path.is_dir() {
            if depth < MOST_DEPTH {
                list(root, &name, depth + 1, files)?;
            }
        } else if name.extension().and_then(|end| end.to_str()).is_some_and(is_picture) {
            files.push(name);
        }
    }
    Ok(())
}

fn is_picture(ending: &str) -> bool {
    ["png", "jpg", "jpeg"].contains(&ending.to_ascii_lowercase().as_str())
}

impl PictureSource for Folder {
    fn describe(&self) -> String {
        self.root.display().to_string()
    }

    fn len(&self) -> usize {
        self.files.len()
    }

    fn scenes(&self) -> Vec<Range<usize>> {
        let mut scenes: Vec<Range<usize>> = Vec::new();
        for (at, file) in self.files.iter().enumerate() {
            match scenes.last_mut() {
                Some(last) if self.files.get(last.start).and_then(|first| first.parent()) == file.parent() => {
                    last.end = at + 1;
                }
                _ => scenes.push(at..at + 1),
            }
        }
        scenes
    }

    fn name(&self, index: usize) -> anyhow::Result<String> {
        let file = self.files.get(index).context("an index beyond the last picture")?;
        Ok(file.with_extension("").to_string_lossy().replace('\\', "/"))
    }

    fn instant(&self, index: usize) -> anyhow::Result<Instant> {
        let path = self.root.join(self.files.get(index).context("an index beyond the last picture")?);
        let reader = image::ImageReader::open(&path).and_then(image::ImageReader::with_guessed_format);
        let reader = reader.with_context(|| format!("cannot read {}", path.display()))?;
        let picture = reader.decode().with_context(|| format!("{} is no whole picture", path.display()))?.to_rgb8();
        let name = self.name(index)?;
        let views = vec![Shot { channel: String::new(), picture: raster(picture) }];
        Ok(Instant { name, key_frame: true, views, right_of: vec![None], front: 0 })
    }
}

/// The stored pictures of a dataset.
pub struct DatasetPictures {
    dataset: Arc<dyn SceneDataset>,
    /// Frames that are looked at.
    frames: Vec<usize>,
}

impl DatasetPictures {
    /// The first `most` frames of each scene (0 for all).
    pub fn new(dataset: Arc<dyn SceneDataset>, most: usize) -> Self {
        let ranges = dataset.scene_ranges();
        let frames = ranges.into_iter().flat_map(|range| range.take(if most == 0 { usize::MAX } else { most }));
        let frames = frames.collect();
        Self { dataset, frames }
    }

    fn frame(&self, index: usize) -> anyhow::Result<data::SceneFrame> {
        let frame = self.frames.get(index).context("an index beyond the last frame")?;
        Ok(self.dataset.frame(*frame)?)
    }
}

impl PictureSource for DatasetPictures {
    fn describe(&self) -> String {
        self.dataset.name().to_owned()
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn scenes(&self) -> Vec<Range<usize>> {
        let place = |frame: usize| self.frames.partition_point(|at| *at < frame);
        let ranges = self.dataset.scene_ranges();
        ranges.into_iter().map(|range| place(range.start)..place(range.end)).filter(|range| !range.is_empty()).collect()
    }

    fn name(&self, index: usize) -> anyhow::Result<String> {
        let id = self.frame(index)?.id;
        Ok(format!("{}/{}", id.scene, id.frame))
    }

    fn instant(&self, index: usize) -> anyhow::Result<Instant> {
        let frame = self.frame(index)?;
        let name = format!("{}/{}", frame.id.scene, frame.id.frame);
        instant(&frame, name, |_, view| {
            let Some(source) = &view.image else { return Ok(None) };
            Ok(Some(raster(source.decode()?)))
        })
    }
}

/// The instant of a frame whose pictures come from `picture(view's place, view)`.
pub(super) fn instant(
    frame: &data::SceneFrame,
    name: String,
    picture: impl Fn(usize, &View) -> anyhow::Result<Option<Raster<u8>>>,
) -> anyhow::Result<Instant> {
    let rig = frame.rig();
    let (adjacency, ahead) = (rig.adjacency()?, rig.clockwise_order().first().copied());
    let mut places = vec![None; frame.views.len()];
    let mut views = Vec::new();
    for (at, view) in frame.views.iter().enumerate() {
        let found = picture(at, view).with_context(|| format!("{name}, camera {}", view.channel))?;
        if let Some(picture) = found {
            places[at] = Some(views.len());
            views.push(Shot { channel: view.channel.clone(), picture });
        }
    }
    let there = |view: usize| places.get(view).copied().flatten();
    let right_of = (0..places.len()).filter(|view| there(*view).is_some());
    let right_of = right_of.map(|view| adjacency.right.get(view).copied().flatten().and_then(there)).collect();
    let front = ahead.and_then(there).unwrap_or(0);
    Ok(Instant { name, key_frame: frame.boxes.is_some(), views, right_of, front })
}

pub(super) fn raster(picture: RgbImage) -> Raster<u8> {
    let (height, width) = (picture.height() as usize, picture.width() as usize);
    Raster { height, width, pixels: picture.into_raw() }
}
