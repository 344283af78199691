//! Where the pictures of the two sides come from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::bail;
use data::{DatasetConfig, SceneDataset};
use metrics::{ImageSize, NovelViewSummary, NovelViews};
use serde::Deserialize;

use super::super::common::{LoadedModel, UsageError};
use super::EvaluateArgs;
use crate::bev_vae::{Viewer, pictures_of, renders};
use crate::config_file;
use crate::evaluate::{DatasetPictures, Folder, Painted, PictureSource};

/// The real side, if there is one, and the generated side.
pub(super) type Sides<'a> = (Option<Box<dyn PictureSource + 'a>>, Box<dyn PictureSource + 'a>);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DataFile {
    data: Vec<DatasetConfig>,
}

fn one_dataset(path: &Path) -> anyhow::Result<Arc<dyn SceneDataset>> {
    match config_file::load::<DataFile>(path, &[])?.data.as_slice() {
        [one] => Ok(data::open(one)?),
        several => {
            bail!(UsageError::of(format!("{} datasets where one is compared: {}", several.len(), path.display())))
        }
    }
}

pub(super) fn stored(args: &EvaluateArgs) -> anyhow::Result<Sides<'static>> {
    let side = |folder: &Option<PathBuf>, data: &Option<PathBuf>| -> anyhow::Result<Option<Box<dyn PictureSource>>> {
        Ok(match (folder, data) {
            (Some(folder), _) => Some(Box::new(Folder::open(folder)?)),
            (None, Some(file)) => Some(Box::new(DatasetPictures::new(one_dataset(file)?, args.frames))),
            (None, None) => None,
        })
    };
    let real = side(&args.real, &args.real_data)?;
    let Some(generated) = side(&args.generated, &args.generated_data)? else {
        return Err(UsageError::of("say what is measured: --generated DIR, --generated-data FILE or --checkpoint DIR"));
    };
    if real.is_none() && args.real_stats.is_none() && args.save_stats.is_none() {
        return Err(UsageError::of("say what it is compared with: --real DIR, --real-data FILE or --real-stats FILE"));
    }
    Ok((real, generated))
}

pub(super) fn painted<'a>(loaded: &'a LoadedModel, dataset: &Arc<dyn SceneDataset>, frames: usize) -> Sides<'a> {
    let viewer = || Viewer::new(&loaded.experiment, &loaded.model, &loaded.device);
    let most = if frames == 0 { usize::MAX } else { frames };
    let frames: Vec<usize> = dataset.scene_ranges().into_iter().flat_map(|range| range.take(most)).collect();
    let size = loaded.experiment.image_size();
    let side = |decoded| Box::new(Painted::new(viewer(), Arc::clone(dataset), frames.clone(), size, decoded));
    (Some(side(false)), side(true))
}

/// Decodes the rig turned and compares with its rendering; nothing where the data cannot render it.
pub(super) fn novel_views(
    loaded: &LoadedModel,
    dataset: &Arc<dyn SceneDataset>,
    yaw_deg: &[f64],
    frames: usize,
) -> anyhow::Result<Vec<NovelViewSummary>> {
    let viewer = Viewer::new(&loaded.experiment, &loaded.model, &loaded.device);
    let size = loaded.experiment.image_size();
    let size = ImageSize { channels: 3, height: size.height as usize, width: size.width as usize };
    let usual = &loaded.experiment.evaluation.yaw_deg;
    let turns = if yaw_deg.is_empty() { usual.as_slice() } else { yaw_deg };
    let most = if frames == 0 { usize::MAX } else { frames };
    let mut scores = NovelViews::default();
    for index in dataset.scene_ranges().into_iter().flat_map(|range| range.take(most)) {
        let frame = dataset.frame(index)?;
        if !renders(&frame) {
            break;
        }
        let coded = viewer.encode(&frame)?;
        for yaw in turns {
            let Some(truth) = viewer.truth(&frame, &frame.rig().rotated(yaw.to_radians()))? else { continue };
            for (picture, truth) in viewer.decode(&coded, &truth).iter().zip(pictures_of(&truth)) {
                scores.update(&format!("yaw {yaw:+} deg"), picture, truth, size);
            }
        }
    }
    Ok(scores.summaries())
}

pub(super) fn model(path: &Path) -> BTreeMap<String, String> {
    let entries = [
        ("checkpoint", path.display().to_string()),
        ("weights", "averaged (EMA)".to_owned()),
        ("painted by", "posterior mean of the same cameras".to_owned()),
    ];
    entries.map(|(key, value)| (key.to_owned(), value)).into()
}
