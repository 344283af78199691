//! Detection score, segmentation and combined score against the official devkit's numbers.

use std::collections::BTreeMap;
use std::path::Path;

use metrics::detection::{
    DISTANCE_THRESHOLDS_M, DetectionBox, DetectionClass, DetectionResults, DetectionScore, DetectionTally, Rack,
    TrueBox, TruePositiveError,
};
use metrics::{SegmentationIou, mean_iou, wcoda_score};
use safetensors::SafeTensors;
use serde_json::Value;

use crate::golden::{assert_close, doubles, folder, json};

/// Of the golden's README: deterministic f64 arithmetic.
const TOLERANCE: f64 = 1e-9;

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    let list: Vec<f64> = value.as_array().unwrap().iter().map(number).collect();
    list.try_into().unwrap()
}

/// Racks by sample token, from the tables.
fn racks(tables: &Path) -> BTreeMap<String, Vec<Rack>> {
    let table = |name: &str| json(&tables.join(name)).as_array().unwrap().clone();
    let text = |row: &Value, key: &str| row[key].as_str().unwrap().to_owned();
    let categories: BTreeMap<String, String> =
        table("category.json").iter().map(|row| (text(row, "token"), text(row, "name"))).collect();
    let instances: BTreeMap<String, String> = table("instance.json")
        .iter()
        .map(|row| (text(row, "token"), categories[&text(row, "category_token")].clone()))
        .collect();
    let mut racks: BTreeMap<String, Vec<Rack>> = BTreeMap::new();
    for row in table("sample_annotation.json") {
        if instances[&text(&row, "instance_token")] == "static_object.bicycle_rack" {
            let rack = Rack {
                center: numbers(&row["translation"]),
                size: numbers(&row["size"]),
                rotation: numbers(&row["rotation"]),
            };
            racks.entry(text(&row, "sample_token")).or_default().push(rack);
        }
    }
    racks
}

fn true_box(row: &Value) -> TrueBox {
    let found = DetectionBox {
        class: serde_json::from_value::<DetectionClass>(row["detection_name"].clone()).unwrap(),
        center: numbers(&row["translation"]),
        size: numbers(&row["size"]),
        rotation: numbers(&row["rotation"]),
        velocity: numbers(&row["velocity"]),
        attribute: row["attribute_name"].as_str().unwrap().to_owned(),
        score: -1.0,
    };
    TrueBox { found, points: row["num_pts"].as_u64().unwrap() }
}

/// The car's position of each sample, from where the devkit puts a box relative to it; the pose table for samples without boxes.
fn ego_positions(folder: &Path) -> BTreeMap<String, [f64; 3]> {
    let tables = folder.join("database/v1.0-mini");
    let table = |name: &str| json(&tables.join(name)).as_array().unwrap().clone();
    let poses: BTreeMap<String, [f64; 3]> = table("ego_pose.json")
        .iter()
        .map(|row| (row["token"].as_str().unwrap().to_owned(), numbers(&row["translation"])))
        .collect();
    let key_frames = table("sample_data.json").into_iter().filter(|row| row["is_key_frame"] == true);
    key_frames
        .map(|row| (row["sample_token"].as_str().unwrap().to_owned(), poses[row["ego_pose_token"].as_str().unwrap()]))
        .collect()
}

fn tally(folder: &Path, shards: usize) -> DetectionTally {
    let results = DetectionResults::read(&folder.join("results_nusc.json")).unwrap();
    let (egos, racks) = (ego_positions(folder), racks(&folder.join("database/v1.0-mini")));
    let mut truth: BTreeMap<String, Vec<TrueBox>> = BTreeMap::new();
    for row in json(&folder.join("gt_eval_boxes.json")).as_array().unwrap() {
        truth.entry(row["sample_token"].as_str().unwrap().to_owned()).or_default().push(true_box(row));
    }
    let mut parts: Vec<DetectionTally> = (0..shards).map(|_| DetectionTally::default()).collect();
    for (place, (token, found)) in results.samples.iter().enumerate() {
        let none = (Vec::new(), Vec::new());
        let (truth, racks) = (truth.get(token).unwrap_or(&none.0), racks.get(token).unwrap_or(&none.1));
        parts[place % shards].update(token, truth, found, egos[token], racks).unwrap();
    }
    let mut whole = parts.pop().unwrap();
    parts.into_iter().for_each(|part| whole.merge(part).unwrap());
    whole
}

fn assert_number(what: &str, actual: Option<f64>, expected: &Value) {
    match (actual, expected.as_f64()) {
        (Some(actual), Some(expected)) => assert_close(what, actual, expected, TOLERANCE),
        (None, None) => {}
        (actual, expected) => panic!("{what}: {actual:?} against {expected:?}"),
    }
}

fn assert_curves(score: &DetectionScore, folder: &Path) {
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let names = file.names();
    let mut compared = 0;
    for class in &score.classes {
        for (threshold, curve) in DISTANCE_THRESHOLDS_M.iter().zip(&class.curves) {
            let errors = TruePositiveError::ALL.iter().map(|error| {
                let name = serde_json::to_value(error).unwrap().as_str().unwrap().to_owned();
                (name, &curve.errors[*error as usize])
            });
            let fields = [("precision".to_owned(), &curve.precision), ("confidence".to_owned(), &curve.confidence)];
            for (field, values) in fields.into_iter().chain(errors) {
                let name = format!("curve/{}/{threshold:?}/{field}", class.class.name());
                if !names.contains(&name.as_str()) {
                    continue;
                }
                compared += 1;
                for (at, (actual, expected)) in values.iter().zip(doubles(&file, &name)).enumerate() {
                    assert_close(&format!("{name} {at}"), *actual, expected, TOLERANCE);
                }
            }
        }
    }
    assert!(compared > 0);
}

#[test]
fn detection_score_as_the_devkit() {
    let Some(folder) = folder("nuscenes_eval") else { return };
    let golden = json(&folder.join("metrics.json"));
    let whole = tally(&folder, 1).score().unwrap();
    assert_eq!(tally(&folder, 3).score().unwrap(), whole, "shards");
    let want = &golden["metrics"];
    assert_number("mAP", Some(whole.mean_average_precision), &want["mean_ap"]);
    assert_number("NDS", Some(whole.nds), &want["nd_score"]);
    for error in TruePositiveError::ALL {
        let name = serde_json::to_value(error).unwrap().as_str().unwrap().to_owned();
        assert_number(&name, Some(whole.errors[error as usize]), &want["tp_errors"][&name]);
        for class in &whole.classes {
            let what = format!("{} {name}", class.class.name());
            let expected = &want["label_tp_errors"][class.class.name()][&name];
            assert_number(&what, class.errors[error as usize], expected);
        }
    }
    for class in &whole.classes {
        let name = class.class.name();
        for (threshold, precision) in DISTANCE_THRESHOLDS_M.iter().zip(class.average_precision) {
            let expected = &want["label_aps"][name][format!("{threshold:?}")];
            assert_number(&format!("AP of {name} at {threshold} m"), Some(precision), expected);
        }
        let counts = [("gt", class.true_boxes), ("pred", class.predictions)];
        for (side, count) in counts {
            assert_eq!(golden["counts"][side][name]["evaluated"].as_u64(), Some(count as u64), "{side} {name}");
        }
    }
    let loaded = ["gt", "pred"].map(|side| golden["counts"][side]["loaded"].as_u64().unwrap());
    assert_eq!(whole.boxes_given, loaded);
    assert_curves(&whole, &folder);
}

#[test]
fn segmentation_over_the_whole_set() {
    let Some(folder) = folder("nuscenes_eval") else { return };
    let golden = json(&folder.join("metrics.json"))["bev_iou"].clone();
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let (truth, probability) = (file.tensor("bev/gt").unwrap(), file.tensor("bev/prob_u8").unwrap());
    let &[samples, classes, height, width] = truth.shape() else { panic!("{:?}", truth.shape()) };
    let plane = height * width;
    let mut best = Vec::new();
    for (class, name) in ["vehicle", "road"].into_iter().enumerate() {
        let want = golden[name]["dataset_level"].as_array().unwrap();
        // In units of bytes, as the golden compares.
        let thresholds: Vec<f64> = want.iter().map(|row| 255.0 * number(&row["threshold"])).collect();
        let mut parts = [SegmentationIou::new(&thresholds), SegmentationIou::new(&thresholds)];
        for sample in 0..samples {
            let cells = (sample * classes + class) * plane..(sample * classes + class + 1) * plane;
            let probability: Vec<f64> = probability.data()[cells.clone()].iter().map(|byte| f64::from(*byte)).collect();
            let truth: Vec<bool> = truth.data()[cells].iter().map(|byte| *byte > 0).collect();
            parts[sample % 2].update(&probability, &truth, None);
        }
        let [mut whole, other] = parts;
        whole.merge(&other);
        for ((_, overlap), row) in whole.overlaps().zip(want) {
            let counts = [overlap.both, overlap.only_predicted, overlap.only_true];
            assert_eq!(counts.map(Some), ["tp", "fp", "fn"].map(|key| row[key].as_u64()), "{name}");
            assert_number(name, overlap.iou(), &row["iou"]);
        }
        assert_number(name, whole.best(), &golden[name]["max_over_thresholds"]);
        best.push(whole.best());
    }
    assert_number("mIoU", mean_iou(&best).0, &golden["mIoU_max"]);
}

#[test]
fn combined_score_of_every_row() {
    let Some(folder) = folder("nuscenes_eval") else { return };
    let golden = json(&folder.join("metrics.json"));
    let rows = golden["combined_score_eq15"].as_array().unwrap().clone();
    assert!(!rows.is_empty());
    for row in rows {
        let score = wcoda_score(number(&row["fvd"]), number(&row["map_percent"]), number(&row["miou_percent"]));
        assert_number("combined score", Some(score), &row["score"]);
    }
}
