//! The benchmark's result file: `{"meta": {...}, "results": {sample token: [box, ...]}}`.

use std::fmt;
use std::path::Path;

use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::{DetectionBox, DetectionClass, MOST_BOXES};
use crate::MetricError;

/// Which inputs a detector used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub struct ResultMeta {
    /// Pictures.
    pub use_camera: bool,
    /// Lidar.
    pub use_lidar: bool,
    /// Radar.
    pub use_radar: bool,
    /// Maps.
    pub use_map: bool,
    /// Other data.
    pub use_external: bool,
}

/// Predictions per sample in the file's order, which settles equal scores.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectionResults {
    /// Inputs used.
    pub meta: ResultMeta,
    /// Sample token and its boxes with their places in the whole file.
    pub samples: Vec<(String, Vec<(u64, DetectionBox)>)>,
}

#[derive(Deserialize)]
struct ResultFile {
    meta: ResultMeta,
    results: Samples,
}

#[derive(Deserialize)]
struct Row {
    sample_token: String,
    translation: [f64; 3],
    size: [f64; 3],
    rotation: [f64; 4],
    velocity: [Option<f64>; 2],
    detection_name: DetectionClass,
    detection_score: f64,
    attribute_name: String,
}

/// A JSON object in the order of the file.
struct Samples(Vec<(String, Vec<Row>)>);

impl<'de> Deserialize<'de> for Samples {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct InOrder;
        impl<'de> Visitor<'de> for InOrder {
            type Value = Samples;

            fn expecting(&self, text: &mut fmt::Formatter<'_>) -> fmt::Result {
                text.write_str("an object of sample tokens and their boxes")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Samples, A::Error> {
                let mut samples = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    samples.push(entry);
                }
                Ok(Samples(samples))
            }
        }
        from.deserialize_map(InOrder)
    }
}

impl DetectionResults {
    /// Reads a result file.
    ///
    /// # Errors
    /// [`MetricError::Detection`] naming the file for one that cannot be read, for unknown classes, more than 500 boxes in a sample, a
    /// box under another sample's token, and sizes, positions or turns that are no numbers.
    pub fn read(path: &Path) -> Result<Self, MetricError> {
        let refused = |why: String| MetricError::Detection(format!("{why}: {}", path.display()));
        let file = std::fs::read(path).map_err(|error| refused(format!("cannot read the detections: {error}")))?;
        let file: ResultFile =
            serde_json::from_slice(&file).map_err(|error| refused(format!("no detection result: {error}")))?;
        let mut place = 0;
        let mut samples = Vec::with_capacity(file.results.0.len());
        for (token, rows) in file.results.0 {
            if rows.len() > MOST_BOXES {
                let count = rows.len();
                return Err(refused(format!("sample {token} has {count} boxes, {MOST_BOXES} are allowed")));
            }
            let mut boxes = Vec::with_capacity(rows.len());
            for row in rows {
                let found = row.checked(&token).map_err(&refused)?;
                boxes.push((place, found));
                place += 1;
            }
            samples.push((token, boxes));
        }
        Ok(Self { meta: file.meta, samples })
    }
}

impl Row {
    fn checked(self, token: &str) -> Result<DetectionBox, String> {
        if self.sample_token != token {
            return Err(format!("a box of sample {} stands under {token}", self.sample_token));
        }
        let numbers = self.translation.iter().chain(&self.size).chain(&self.rotation).chain([&self.detection_score]);
        let turn: f64 = self.rotation.iter().map(|value| value * value).sum();
        if numbers.into_iter().any(|value| !value.is_finite()) || turn < 1e-12 {
            return Err(format!("a box of sample {token} has no finite position, size, turn or score"));
        }
        Ok(DetectionBox {
            class: self.detection_name,
            center: self.translation,
            size: self.size,
            rotation: self.rotation,
            velocity: self.velocity.map(|value| value.unwrap_or(f64::NAN)),
            attribute: self.attribute_name,
            score: self.detection_score,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mistakes_are_named_with_the_file() {
        let path = std::env::temp_dir().join(format!("rigscape-detections-{}.json", std::process::id()));
        let row = |token: &str, class: &str, size: &str| {
            format!(
                "{{\"sample_token\":\"{token}\",\"translation\":[0,0,0],\"size\":{size},\"rotation\":[1,0,0,0],\
                 \"velocity\":[null,0.5],\"detection_name\":\"{class}\",\"detection_score\":0.5,\"attribute_name\":\"\"}}"
            )
        };
        let meta =
            "{\"use_camera\":true,\"use_lidar\":false,\"use_radar\":false,\"use_map\":false,\"use_external\":false}";
        let read = |rows: &str| {
            std::fs::write(&path, format!("{{\"meta\":{meta},\"results\":{{\"b\":[{rows}],\"a\":[]}}}}")).unwrap();
            DetectionResults::read(&path)
        };
        let good = read(&row("b", "traffic_cone", "[1,1,1]")).unwrap();
        assert_eq!(good.samples.iter().map(|(token, _)| token.as_str()).collect::<Vec<_>>(), ["b", "a"]);
        assert!(good.samples[0].1[0].1.velocity[0].is_nan() && good.meta.use_camera);
        for (rows, why) in [
            (row("b", "tank", "[1,1,1]"), "tank"),
            (row("c", "car", "[1,1,1]"), "stands under b"),
            (row("b", "car", "[1,1]"), "no detection result"),
            (vec![row("b", "car", "[1,1,1]"); 501].join(","), "501 boxes"),
        ] {
            let error = read(&rows).unwrap_err().to_string();
            assert!(error.contains(why) && error.contains("rigscape-detections"), "{error}");
        }
        std::fs::remove_file(&path).unwrap();
        assert!(DetectionResults::read(&path).is_err());
    }
}
