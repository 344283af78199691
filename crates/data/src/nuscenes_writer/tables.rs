//! Rows of the thirteen tables, fields in the release's order, and how they are written: one value per line, no indentation.
//!
//! List ends are `""`, never null; tokens are unique per table; rows lie in the order in which they happened.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;
use sha2::{Digest, Sha256};

use super::tokens::TokenSpace;
use crate::manifest::hex;
use crate::{DataError, staging};

#[derive(Debug, Clone, Serialize)]
pub(super) struct NamedRow {
    pub(super) token: String,
    pub(super) name: String,
    pub(super) description: String,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct CalibratedSensorRow {
    pub(super) token: String,
    pub(super) sensor_token: String,
    pub(super) translation: [f64; 3],
    pub(super) rotation: [f64; 4],
    /// Three rows for a camera, none for a lidar.
    pub(super) camera_intrinsic: Vec<[f64; 3]>,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct EgoPoseRow {
    pub(super) token: String,
    pub(super) timestamp: i64,
    pub(super) rotation: [f64; 4],
    pub(super) translation: [f64; 3],
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct InstanceRow {
    pub(super) token: String,
    pub(super) category_token: String,
    pub(super) nbr_annotations: usize,
    pub(super) first_annotation_token: String,
    pub(super) last_annotation_token: String,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct LogRow {
    pub(super) token: String,
    pub(super) logfile: String,
    pub(super) vehicle: String,
    pub(super) date_captured: String,
    pub(super) location: String,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct MapRow {
    pub(super) category: &'static str,
    pub(super) token: String,
    pub(super) filename: String,
    pub(super) log_tokens: Vec<String>,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct SampleRow {
    pub(super) token: String,
    pub(super) timestamp: i64,
    pub(super) prev: String,
    pub(super) next: String,
    pub(super) scene_token: String,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct AnnotationRow {
    pub(super) token: String,
    pub(super) sample_token: String,
    pub(super) instance_token: String,
    pub(super) visibility_token: String,
    pub(super) attribute_tokens: Vec<String>,
    pub(super) translation: [f64; 3],
    /// Width, length, height.
    pub(super) size: [f64; 3],
    pub(super) rotation: [f64; 4],
    pub(super) prev: String,
    pub(super) next: String,
    pub(super) num_lidar_pts: u32,
    pub(super) num_radar_pts: u32,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct SampleDataRow {
    pub(super) token: String,
    pub(super) sample_token: String,
    pub(super) ego_pose_token: String,
    pub(super) calibrated_sensor_token: String,
    pub(super) timestamp: i64,
    pub(super) fileformat: &'static str,
    pub(super) is_key_frame: bool,
    pub(super) height: u32,
    pub(super) width: u32,
    pub(super) filename: String,
    pub(super) prev: String,
    pub(super) next: String,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct SceneRow {
    pub(super) token: String,
    pub(super) log_token: String,
    pub(super) nbr_samples: usize,
    pub(super) first_sample_token: String,
    pub(super) last_sample_token: String,
    pub(super) name: String,
    pub(super) description: String,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct SensorRow {
    pub(super) token: String,
    pub(super) channel: String,
    pub(super) modality: &'static str,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct VisibilityRow {
    pub(super) description: &'static str,
    pub(super) token: &'static str,
    pub(super) level: &'static str,
}

/// All thirteen tables.
#[derive(Debug, Default)]
pub(super) struct Tables {
    pub(super) attribute: Vec<NamedRow>,
    pub(super) calibrated_sensor: Vec<CalibratedSensorRow>,
    pub(super) category: Vec<NamedRow>,
    pub(super) ego_pose: Vec<EgoPoseRow>,
    pub(super) instance: Vec<InstanceRow>,
    pub(super) log: Vec<LogRow>,
    pub(super) map: Vec<MapRow>,
    pub(super) sample: Vec<SampleRow>,
    pub(super) sample_annotation: Vec<AnnotationRow>,
    pub(super) sample_data: Vec<SampleDataRow>,
    pub(super) scene: Vec<SceneRow>,
    pub(super) sensor: Vec<SensorRow>,
    pub(super) visibility: Vec<VisibilityRow>,
}

/// The release's category names in its order.
const CATEGORIES: [&str; 23] = [
    "human.pedestrian.adult",
    "human.pedestrian.child",
    "human.pedestrian.wheelchair",
    "human.pedestrian.stroller",
    "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer",
    "human.pedestrian.construction_worker",
    "animal",
    "vehicle.car",
    "vehicle.motorcycle",
    "vehicle.bicycle",
    "vehicle.bus.bendy",
    "vehicle.bus.rigid",
    "vehicle.truck",
    "vehicle.construction",
    "vehicle.emergency.ambulance",
    "vehicle.emergency.police",
    "vehicle.trailer",
    "movable_object.barrier",
    "movable_object.trafficcone",
    "movable_object.pushable_pullable",
    "movable_object.debris",
    "static_object.bicycle_rack",
];

/// The release's attribute names in its order.
const ATTRIBUTES: [&str; 8] = [
    "vehicle.moving",
    "vehicle.stopped",
    "vehicle.parked",
    "cycle.with_rider",
    "cycle.without_rider",
    "pedestrian.sitting_lying_down",
    "pedestrian.standing",
    "pedestrian.moving",
];

/// The four levels; their tokens are "1" to "4" in the release too.
const VISIBILITIES: [[&str; 3]; 4] = [
    ["visibility of whole object is between 0 and 40%", "1", "v0-40"],
    ["visibility of whole object is between 40 and 60%", "2", "v40-60"],
    ["visibility of whole object is between 60 and 80%", "3", "v60-80"],
    ["visibility of whole object is between 80 and 100%", "4", "v80-100"],
];

impl Tables {
    /// The tables that do not depend on scenes are filled, the others empty.
    pub(super) fn with_vocabulary(tokens: &TokenSpace) -> Self {
        let named = |table: &str, names: &[&str]| {
            let row = |name: &&str| NamedRow {
                token: tokens.token(table, name),
                name: (*name).to_owned(),
                description: String::new(),
            };
            names.iter().map(row).collect()
        };
        Self {
            attribute: named("attribute", &ATTRIBUTES),
            category: named("category", &CATEGORIES),
            visibility: VISIBILITIES
                .map(|[description, token, level]| VisibilityRow { description, token, level })
                .to_vec(),
            ..Self::default()
        }
    }

    /// Writes every table into `folder` and returns their SHA-256 by file name.
    pub(super) fn write(&self, folder: &Path) -> Result<BTreeMap<String, String>, DataError> {
        let mut digests = BTreeMap::new();
        let mut put = |name: &str, text: Result<Vec<u8>, serde_json::Error>| {
            let path = folder.join(format!("{name}.json"));
            let bytes = text.map_err(|e| DataError::Json { why: e.to_string(), path: path.clone() })?;
            digests.insert(format!("{name}.json"), hex(&Sha256::digest(&bytes)));
            staging::write(&path, &bytes)
        };
        put("attribute", lines(&self.attribute))?;
        put("calibrated_sensor", lines(&self.calibrated_sensor))?;
        put("category", lines(&self.category))?;
        put("ego_pose", lines(&self.ego_pose))?;
        put("instance", lines(&self.instance))?;
        put("log", lines(&self.log))?;
        put("map", lines(&self.map))?;
        put("sample", lines(&self.sample))?;
        put("sample_annotation", lines(&self.sample_annotation))?;
        put("sample_data", lines(&self.sample_data))?;
        put("scene", lines(&self.scene))?;
        put("sensor", lines(&self.sensor))?;
        put("visibility", lines(&self.visibility))?;
        Ok(digests)
    }
}

/// One value per line without indentation, as the release is written.
fn lines<T: Serialize>(rows: &[T]) -> Result<Vec<u8>, serde_json::Error> {
    let mut bytes = Vec::new();
    let formatter = serde_json::ser::PrettyFormatter::with_indent(b"");
    rows.serialize(&mut serde_json::Serializer::with_formatter(&mut bytes, formatter))?;
    Ok(bytes)
}

/// The neighbours of every element of a chain; `""` at its ends.
pub(super) fn neighbours(chain: &[String], position: usize) -> (String, String) {
    let before = position.checked_sub(1).map_or_else(String::new, |i| chain[i].clone());
    let after = chain.get(position + 1).cloned().unwrap_or_default();
    (before, after)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_written_one_value_per_line() {
        let rows = [SampleRow {
            token: "a".into(),
            timestamp: 7,
            prev: String::new(),
            next: "b".into(),
            scene_token: "s".into(),
        }];
        let text = String::from_utf8(lines(&rows).unwrap()).unwrap();
        assert_eq!(
            text,
            "[\n{\n\"token\": \"a\",\n\"timestamp\": 7,\n\"prev\": \"\",\n\"next\": \"b\",\n\"scene_token\": \"s\"\n}\n]"
        );
    }

    #[test]
    fn every_category_has_a_rule_in_the_taxonomy() {
        for name in CATEGORIES {
            assert!(crate::taxonomy::from_nuscenes(name).is_some(), "{name}");
        }
    }

    #[test]
    fn chains_end_in_empty_tokens() {
        let chain = ["a", "b", "c"].map(str::to_owned);
        assert_eq!(neighbours(&chain, 0), (String::new(), "b".to_owned()));
        assert_eq!(neighbours(&chain, 1), ("a".to_owned(), "c".to_owned()));
        assert_eq!(neighbours(&chain, 2), ("b".to_owned(), String::new()));
    }
}
