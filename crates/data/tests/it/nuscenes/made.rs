//! Tables made by a test: a car that drives along +x, cameras around it, boxes where the test wants them.

use std::collections::BTreeMap;
use std::path::Path;

use data::nuscenes::NuScenesConfig;
use serde_json::{Value, json};

/// Time of the first sample, us.
pub const START_US: i64 = 1_700_000_000_000_000;
/// Speed of the car along world +x, m/s.
pub const SPEED: f64 = 8.0;

/// The 13 tables.
#[derive(Clone)]
pub struct Tables(pub BTreeMap<&'static str, Vec<Value>>);

const TABLES: [&str; 13] = [
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_pose",
    "instance",
    "log",
    "map",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
];

/// Yaw of a camera and its usual exposure relative to the sample, us.
pub const CAMERAS: [(&str, f64, i64); 3] =
    [("CAM_BACK_LEFT", 110.0, -500), ("CAM_FRONT", 0.0, -35_500), ("CAM_FRONT_RIGHT", -56.0, -27_600)];

/// Where the car is, metres along world x.
pub fn car_x(time_us: i64) -> f64 {
    100.0 + SPEED * (time_us - START_US) as f64 * 1e-6
}

impl Tables {
    /// Everything but scenes.
    pub fn new() -> Self {
        let mut tables = Self(TABLES.iter().map(|name| (*name, Vec::new())).collect());
        tables.add("log", json!({"token": "log", "logfile": "n900", "location": "nowhere", "vehicle": "n900"}));
        tables.add("map", json!({"token": "map", "filename": "maps/m.png", "log_tokens": ["log"], "category": ""}));
        for name in ["vehicle.car", "human.pedestrian.adult", "animal"] {
            tables.add("category", json!({"token": format!("category {name}"), "name": name, "description": ""}));
        }
        tables.add("attribute", json!({"token": "attribute-moving", "name": "vehicle.moving", "description": ""}));
        for level in 1..=4 {
            tables.add("visibility", json!({"token": level.to_string(), "level": "", "description": ""}));
        }
        for (channel, ..) in CAMERAS {
            tables.add("sensor", json!({"token": format!("s-{channel}"), "channel": channel, "modality": "camera"}));
        }
        tables.add("sensor", json!({"token": "s-LIDAR_TOP", "channel": "LIDAR_TOP", "modality": "lidar"}));
        tables.add("sensor", json!({"token": "s-RADAR_FRONT", "channel": "RADAR_FRONT", "modality": "radar"}));
        tables
    }

    pub fn add(&mut self, table: &'static str, row: Value) {
        self.0.get_mut(table).unwrap().push(row);
    }

    pub fn row(&mut self, table: &str, token: &str) -> &mut Value {
        let rows = self.0.get_mut(table).unwrap();
        rows.iter_mut().find(|row| row["token"] == token).unwrap_or_else(|| panic!("no {token} in {table}"))
    }

    /// A scene with samples at the given times and a key picture of every camera and of the lidar.
    pub fn scene(&mut self, name: &str, samples_us: &[i64]) {
        let token = |at: usize| format!("{name}-sample-{at}");
        self.add(
            "scene",
            json!({"token": format!("scene {name}"), "name": name, "description": "made", "log_token": "log",
                "nbr_samples": samples_us.len(), "first_sample_token": token(0),
                "last_sample_token": token(samples_us.len() - 1)}),
        );
        for (channel, yaw_deg, _) in CAMERAS.into_iter().chain([("LIDAR_TOP", 0.0, 0), ("RADAR_FRONT", 0.0, 0)]) {
            let half = f64::to_radians(yaw_deg) * 0.5;
            let (c, s) = (half.cos() * 0.5, half.sin() * 0.5);
            let k = if channel.starts_with("CAM") {
                json!([[500.0, 0.0, 319.5], [0.0, 500.0, 199.5], [0.0, 0.0, 1.0]])
            } else {
                json!([])
            };
            // Yaw times (0.5, -0.5, 0.5, -0.5), the turn from camera axes to a camera that looks along +x.
            let rotation = [c + s, -c - s, c - s, s - c];
            self.add(
                "calibrated_sensor",
                json!({"token": format!("c-{name}-{channel}"), "sensor_token": format!("s-{channel}"),
                    "translation": [1.5, 0.0, 1.6], "rotation": rotation, "camera_intrinsic": k}),
            );
        }
        for (at, time_us) in samples_us.iter().enumerate() {
            self.add(
                "sample",
                json!({"token": token(at), "timestamp": time_us, "scene_token": format!("scene {name}"), "prev": "", "next": ""}),
            );
            for (channel, _, offset) in CAMERAS {
                self.picture(name, channel, at, time_us + offset, true);
            }
            self.picture(name, "LIDAR_TOP", at, *time_us, true);
            self.picture(name, "RADAR_FRONT", at, time_us + 3000, true);
        }
    }

    /// A `sample_data` row with its pose row; returns its token.
    pub fn picture(&mut self, scene: &str, channel: &str, sample: usize, time_us: i64, is_key: bool) -> String {
        let token = format!("{scene} {channel} {time_us}");
        let folder = if is_key { "samples" } else { "sweeps" };
        self.add(
            "sample_data",
            json!({"token": token, "sample_token": format!("{scene}-sample-{sample}"), "ego_pose_token": format!("pose of {token}"),
                "calibrated_sensor_token": format!("c-{scene}-{channel}"), "timestamp": time_us, "fileformat": "jpg",
                "is_key_frame": is_key, "height": 400, "width": 640, "prev": "", "next": "",
                "filename": format!("{folder}/{channel}/n900__{channel}__{time_us}.jpg")}),
        );
        self.add(
            "ego_pose",
            json!({"token": format!("pose of {token}"), "timestamp": time_us, "rotation": [1.0, 0.0, 0.0, 0.0],
                "translation": [car_x(time_us), 50.0, 0.0]}),
        );
        token
    }

    /// An annotation; the instance is made at its first use.
    pub fn annotate(&mut self, scene: &str, sample: usize, instance: &str, category: &str, center: [f64; 3], yaw: f64) {
        if !self.0["instance"].iter().any(|row| row["token"] == instance) {
            self.add("instance", json!({"token": instance, "category_token": format!("category {category}")}));
        }
        self.add(
            "sample_annotation",
            json!({"token": format!("{scene} {sample} {instance}"), "sample_token": format!("{scene}-sample-{sample}"),
                "instance_token": instance, "visibility_token": "3", "attribute_tokens": ["attribute-moving"],
                "translation": center, "size": [1.9, 4.5, 1.6], "rotation": [(yaw * 0.5).cos(), 0.0, 0.0, (yaw * 0.5).sin()],
                "prev": "", "next": "", "num_lidar_pts": 7, "num_radar_pts": 1}),
        );
    }

    pub fn write(&self, root: &Path) -> NuScenesConfig {
        let folder = root.join("v1.0-made");
        std::fs::create_dir_all(&folder).unwrap();
        for (name, rows) in &self.0 {
            std::fs::write(folder.join(format!("{name}.json")), serde_json::to_vec_pretty(rows).unwrap()).unwrap();
        }
        NuScenesConfig::new(root, "v1.0-made")
    }
}
