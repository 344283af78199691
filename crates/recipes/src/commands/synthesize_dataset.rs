//! `rigscape synthesize --export`: every frame of a dataset painted from its boxes.

use std::sync::Arc;

use data::export::{Conditioned, ExportConfig, ExportFormat, Exported, export};
use data::nuscenes::NuScenes;
use data::{DatasetConfig, SceneDataset};

use super::common::{UsageError, say};
use super::synthesize::{ExportName, SynthesizeArgs};
use crate::synthesis::{LayoutPainter, Synthesiser};

/// Paints this run's part and makes the dataset once no frame is missing.
pub(super) fn export_dataset(args: &SynthesizeArgs, name: ExportName, synthesiser: &Synthesiser) -> anyhow::Result<()> {
    let chosen = args.layout.frame.source.choose()?;
    let Some(named) = chosen.datasets.get(args.layout.frame.dataset) else {
        return Err(UsageError::of(format!("there is no dataset {}", args.layout.frame.dataset)));
    };
    let rig = match args.rig.as_slice() {
        [] => None,
        [one] => Some(one.open()?),
        _ => return Err(UsageError::of("an export has one rig; run the command once for each --rig")),
    };
    // Tables can be kept only where nothing but the pictures is new.
    let tables = match (&named.config, name) {
        (DatasetConfig::NuScenes(config), ExportName::NuScenes) if rig.is_none() && args.layout.edits.is_empty() => {
            Some(Arc::new(NuScenes::open(config)?))
        }
        _ => None,
    };
    let dataset: Arc<dyn SceneDataset> = match &tables {
        Some(tables) => tables.clone(),
        None => data::open(&named.config)?,
    };
    let edits = args.layout.edits.clone();
    let classes = synthesiser.dit.conditioner.classes.clone();
    let source = Conditioned { dataset, classes, edits, rig };
    let format = match (&tables, name) {
        (Some(tables), _) => ExportFormat::NuScenesTables(tables),
        (None, ExportName::NuScenes) => ExportFormat::NuScenes,
        (None, ExportName::Argoverse2) => ExportFormat::Argoverse2,
    };
    let words = args.layout.edits.iter().map(ToString::to_string).collect();
    let generator = synthesiser.generator(args.seed, source.name().to_owned(), words)?;
    let config = ExportConfig {
        force: args.force,
        shard: args.shard,
        jpeg_quality: args.quality,
        ..ExportConfig::new(&args.out, format, generator)
    };
    let painter = LayoutPainter { synthesiser, source: &source, seed: args.seed };
    let mut last = 0;
    let mut progress = |done: usize, total: usize| {
        let percent = done * 100 / total.max(1);
        if percent >= last + 5 {
            last = percent;
            tracing::info!("{done} of {total} frames");
        }
    };
    match export(&source, &config, &mut |index, frame| painter.paint(index, frame), &mut progress)? {
        Exported::Whole(manifest) => {
            say(format_args!("{} frames written to {}", manifest.frames.len(), args.out.display()))
        }
        Exported::Part { finished, frames } => say(format_args!(
            "part {} is done, {finished} of {frames} frames are finished; run the other parts, the last one makes {}",
            args.shard,
            args.out.display()
        )),
    }
}
