//! Finished frames become a dataset.

use serde::{Deserialize, Serialize};

use super::finished::FILTER;
use super::{ExportConfig, ExportFormat, Finished, Generator};
use crate::argoverse2::Split;
use crate::nuscenes::{NuScenesExportConfig, export_nuscenes};
use crate::nuscenes_writer::write_nuscenes_frames;
use crate::staging::{self, Staging};
use crate::{
    Argoverse2Log, Argoverse2WriterConfig, CategoryRule, DataError, ImageSource, ObjectClass, SceneDataset, SceneFrame,
    write_argoverse2,
};

/// Name of the manifest of the generation, beside the layout's own `manifest.json`.
pub(super) const GENERATED: &str = "generated.json";

/// `generated.json` in the exported folder: who painted what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExportManifest {
    /// Layout of the folder.
    pub format: String,
    /// Dataset that the frames are of.
    pub source: String,
    /// How pictures were brought from the painter's size to the cameras'.
    pub filter: String,
    /// Of the JPEG files.
    pub jpeg_quality: u8,
    /// Who painted.
    pub generator: Generator,
    /// The frames in order.
    pub frames: Vec<ExportedFrame>,
}

/// A frame of an export.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExportedFrame {
    /// The source's scene.
    pub scene: String,
    /// The source's name of the frame.
    pub frame: String,
    /// Cameras that were painted.
    pub channels: Vec<String>,
}

/// Makes the dataset and its manifest; the folder appears whole.
pub(super) fn publish(
    source: &dyn SceneDataset,
    config: &ExportConfig<'_>,
    finished: &Finished,
) -> Result<ExportManifest, DataError> {
    let staging = Staging::new(&config.out, config.force)?;
    let root = staging.folder();
    let words = format!("{}, seed {}", config.generator.model, config.generator.seed);
    let mut frames = Vec::new();
    let mut take = |index: usize, frame: &SceneFrame| {
        let sources = frame.views.iter().enumerate().map(|(at, view)| finished.source(index, at, view));
        let sources: Vec<Option<ImageSource>> = sources.collect::<Result<_, _>>()?;
        let there = frame.views.iter().zip(&sources).filter(|(_, source)| source.is_some());
        frames.push(ExportedFrame {
            scene: frame.id.scene.clone(),
            frame: frame.id.frame.clone(),
            channels: there.map(|(view, _)| view.channel.clone()).collect(),
        });
        Ok::<_, DataError>(sources)
    };
    match config.format {
        ExportFormat::NuScenesTables(tables) => {
            let jpeg_quality = config.jpeg_quality;
            let config = NuScenesExportConfig { jpeg_quality, ..NuScenesExportConfig::new(root.clone(), words) };
            export_nuscenes(tables, &config, &mut |index, frame| take(index, frame), &mut |_, _| {})?;
        }
        ExportFormat::NuScenes => {
            let frames = painted_frames(source, &mut take)?;
            write_nuscenes_frames(&root, &words, &frames)?;
        }
        ExportFormat::Argoverse2 => {
            let frames = painted_frames(source, &mut take)?;
            let mut writer = Argoverse2WriterConfig::new(root.clone(), words);
            writer.jpeg_quality = config.jpeg_quality;
            // The layout has no category for it.
            writer.categories.insert(ObjectClass::Other, CategoryRule::Drop);
            let log = |frames: &[SceneFrame]| Argoverse2Log {
                split: Split::Train,
                frames: frames.to_vec(),
                city: "XXX".to_owned(),
                map: None,
                ground: None,
            };
            let logs: Vec<_> = frames.chunk_by(|a, b| a.id.scene == b.id.scene).map(log).collect();
            write_argoverse2(&writer, &logs, &mut |_, _| {})?;
        }
    }
    let manifest = ExportManifest {
        format: config.format.name().to_owned(),
        source: source.name().to_owned(),
        filter: FILTER.to_owned(),
        jpeg_quality: config.jpeg_quality,
        generator: config.generator.clone(),
        frames,
    };
    let path = root.join(GENERATED);
    let bytes = serde_json::to_vec_pretty(&manifest)
        .map_err(|error| DataError::Json { why: error.to_string(), path: path.clone() })?;
    staging::write(&path, &bytes)?;
    staging.publish()?;
    Ok(manifest)
}

/// The finished pictures of a frame, one entry per view.
type TakePictures<'a> = &'a mut dyn FnMut(usize, &SceneFrame) -> Result<Vec<Option<ImageSource>>, DataError>;

/// The source's frames with their finished pictures.
fn painted_frames(source: &dyn SceneDataset, take: TakePictures<'_>) -> Result<Vec<SceneFrame>, DataError> {
    let painted = |index| {
        let mut frame = source.frame(index)?;
        let pictures = take(index, &frame)?;
        for (view, picture) in frame.views.iter_mut().zip(pictures) {
            view.image = picture;
            view.mask = None;
        }
        Ok(frame)
    };
    (0..source.len()).map(painted).collect()
}
