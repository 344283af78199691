//! What other networks found in generated pictures, against the labels of a dataset: detections, segmentations, and their W-CODA score.

use std::path::Path;

use anyhow::Context;
use data::DatasetConfig;
use data::nuscenes::NuScenes;
use metrics::detection::{DetectionResults, DetectionScore};
use metrics::wcoda_score;

use super::{EvaluateArgs, code_version};
use crate::commands::common::{UsageError, open_all, say};
use crate::evaluate::{SegmentationScore, detection_markdown, detection_score, segmentation_score, write_file};

/// Measures whatever `--detections` and `--segmentation` name.
///
/// # Errors
/// Data of another kind, missing frames, unreadable files.
pub(super) fn labels(args: &EvaluateArgs) -> anyhow::Result<()> {
    let out = args.out.as_deref();
    let detections = args.detections.as_deref().map(|path| detections(args, path)).transpose()?;
    let segmentation = args.segmentation.as_deref().map(|path| segmentation(args, path)).transpose()?;
    let (Some(fvd), Some(detections), Some(segmentation)) = (args.wcoda_fvd, detections, segmentation) else {
        return Ok(());
    };
    let road = segmentation.at_half("road").context("W-CODA: no frame has road on either side")?;
    let [map, miou] = [detections.mean_average_precision, road].map(|share| 100.0 * share);
    let score = wcoda_score(fvd, map, miou);
    say(format_args!("W-CODA score {score:.4} (FVD {fvd} as given, mAP {map:.2} %, road mIoU {miou:.2} %)"))?;
    let report = serde_json::json!({
        "code": code_version(), "protocol": "wcoda (DualDiff+, equation 15)", "score": score, "fvd_as_given": fvd,
        "map_percent": map, "road_miou_percent": miou,
    });
    write_report(out, "wcoda.json", &report)
}

fn detections(args: &EvaluateArgs, path: &Path) -> anyhow::Result<DetectionScore> {
    let results = DetectionResults::read(path)?;
    let configs = args.data.configs()?;
    let [DatasetConfig::NuScenes(config)] = configs.as_slice() else {
        return Err(UsageError::of("the detection score needs one nuScenes dataset: --nuscenes DIR --split NAME"));
    };
    let score = detection_score(&NuScenes::open(config)?, results)?;
    say(detection_markdown(&score))?;
    let protocol = "nds/detection_cvpr_2019";
    let report =
        serde_json::json!({ "code": code_version(), "protocol": protocol, "split": config.split, "score": score });
    write_report(args.out.as_deref(), "detections.json", &report)?;
    Ok(score)
}

fn segmentation(args: &EvaluateArgs, folder: &Path) -> anyhow::Result<SegmentationScore> {
    let datasets = open_all(&args.data.configs()?)?;
    let [dataset] = datasets.as_slice() else {
        return Err(UsageError::of(
            "--segmentation needs one dataset with map and boxes: --nuscenes DIR or --data FILE",
        ));
    };
    let score = segmentation_score(dataset.as_ref(), folder)?;
    say(score.markdown())?;
    let report = serde_json::json!({ "code": code_version(), "dataset": dataset.name(), "score": score });
    write_report(args.out.as_deref(), "segmentation.json", &report)?;
    Ok(score)
}

fn write_report(out: Option<&Path>, name: &str, report: &serde_json::Value) -> anyhow::Result<()> {
    let Some(out) = out else { return Ok(()) };
    write_file(&out.join(name), serde_json::to_string_pretty(report)?.as_bytes())
}
