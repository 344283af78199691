//! Layouts as JSON files.

use std::path::Path;

use geometry::glam::DVec3;
use geometry::{Box3d, OrientedBox, Rigid};
use serde::{Deserialize, Serialize};

use super::{Layout, LayoutBox, LayoutClasses, LayoutEdit, LayoutError, shared_class};
use crate::{DataError, FrameId, ObjectBox, staging};

/// Longest file that is read. The largest legal layout takes about 3 MB.
const MOST_BYTES: u64 = 16 << 20;

/// A layout file. Everything is in the ego frame (x forward, y left, z up, metres, radians):
///
/// ```json
/// {
///   "source": {"dataset": "nuscenes", "scene": "scene-0061", "frame": "ca9a282c9e77460f8360f564131a8af5"},
///   "boxes": [
///     {"id": "car-1", "class": "car", "center": [14.2, -3.1, 0.8], "size": [4.6, 1.9, 1.7], "yaw": 0.05, "track": "c1958768d48640948f6053d04cffd35b"},
///     {"id": "sign", "class": "barrier", "center": [9, 4, 0.5], "size": [0.5, 2, 1], "rotation": [0.999, 0.02, 0.0, 0.04]}
///   ],
///   "edits": ["remove:car-1", "add:truck:x=20,y=3"]
/// }
/// ```
///
/// `size` is length (along the box's own x axis), width, height. A box has either `yaw`, its heading about +z from +x, or `rotation`, a
/// unit quaternion (w, x, y, z). `edits` are applied in order, see [`LayoutEdit`]. `source`, `edits` and `track` may be absent, any other
/// name is an error.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LayoutFile {
    /// The frame that the boxes were taken from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<LayoutSource>,
    /// The boxes before the edits.
    pub boxes: Vec<FileBox>,
    /// Changes to make.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub edits: Vec<LayoutEdit>,
}

/// The frame behind a layout.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LayoutSource {
    /// Name the dataset was opened under.
    pub dataset: String,
    /// Log, scene or segment.
    pub scene: String,
    /// Native token or stamp.
    pub frame: String,
}

impl From<&FrameId> for LayoutSource {
    fn from(id: &FrameId) -> Self {
        Self { dataset: id.dataset.clone(), scene: id.scene.clone(), frame: id.frame.clone() }
    }
}

/// A box as the file has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileBox {
    /// What edits call it.
    pub id: String,
    /// Name of its class.
    pub class: String,
    /// Metres.
    pub center: [f64; 3],
    /// Length, width, height, metres.
    pub size: [f64; 3],
    /// Heading, radians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub yaw: Option<f64>,
    /// Unit quaternion (w, x, y, z).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<[f64; 4]>,
    /// Identity over time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub track: Option<String>,
}

impl FileBox {
    fn of(found: &LayoutBox) -> Self {
        let OrientedBox { center, size, rotation } = found.shape;
        let is_upright = rotation.x == 0.0 && rotation.y == 0.0;
        let rigid = found.shape.dst_from_box();
        Self {
            id: found.id.clone(),
            class: found.class.clone(),
            center: center.to_array(),
            size: size.to_array(),
            yaw: is_upright.then(|| rigid.yaw()),
            rotation: (!is_upright).then(|| rigid.wxyz()),
            track: found.track.clone(),
        }
    }

    fn into_box(self) -> Result<LayoutBox, LayoutError> {
        let (center, size) = (DVec3::from_array(self.center), DVec3::from_array(self.size));
        let shape = match (self.yaw, self.rotation) {
            (Some(yaw), None) => Box3d { center, size, yaw }.into(),
            (None, Some(wxyz)) => {
                let rigid = Rigid::from_wxyz(wxyz, self.center)
                    .map_err(|error| LayoutError::Heading { id: self.id.clone(), why: error.to_string() })?;
                OrientedBox { center, size, rotation: rigid.rotation }
            }
            _ => {
                let why = "it needs either yaw (radians) or rotation (w, x, y, z)".to_owned();
                return Err(LayoutError::Heading { id: self.id, why });
            }
        };
        let found = LayoutBox { id: self.id, class: self.class, shape, track: self.track };
        found.check()?;
        Ok(found)
    }
}

impl LayoutFile {
    /// A file of a layout, without edits.
    pub fn of(layout: &Layout, source: Option<LayoutSource>) -> Self {
        Self { source, boxes: layout.boxes.iter().map(FileBox::of).collect(), edits: Vec::new() }
    }

    /// # Errors
    /// [`DataError::Missing`] and [`DataError::Io`]; [`DataError::Json`] for a file that does not follow the schema or is far too long.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let json = |why: String| DataError::Json { why, path: path.to_owned() };
        if !path.is_file() {
            return Err(DataError::Missing { what: "layout file".to_owned(), path: path.to_owned() });
        }
        let length = std::fs::metadata(path).map_err(staging::io("read", path))?.len();
        if length > MOST_BYTES {
            return Err(json(format!("{length} bytes are no layout; it holds at most {} boxes", super::MOST_BOXES)));
        }
        let bytes = std::fs::read(path).map_err(staging::io("read", path))?;
        serde_json::from_slice(&bytes).map_err(|error| json(error.to_string()))
    }

    /// Writes the file beside its name, then renames it.
    ///
    /// # Errors
    /// [`DataError::Io`], naming the file.
    pub fn write(&self, path: &Path) -> Result<(), DataError> {
        let text = self.text().map_err(|error| DataError::Json { why: error.to_string(), path: path.to_owned() })?;
        staging::write_renamed(path, text.as_bytes())
    }

    /// One box per line, for people who edit files.
    fn text(&self) -> Result<String, serde_json::Error> {
        let mut parts = Vec::new();
        if let Some(source) = &self.source {
            parts.push(format!("  \"source\": {}", serde_json::to_string(source)?));
        }
        parts.push(format!("  \"boxes\": {}", lines(&self.boxes)?));
        if !self.edits.is_empty() {
            parts.push(format!("  \"edits\": {}", lines(&self.edits)?));
        }
        Ok(format!("{{\n{}\n}}\n", parts.join(",\n")))
    }

    /// The layout with its edits made.
    ///
    /// # Errors
    /// As [`Layout::edited`]; [`LayoutError::Heading`] and [`LayoutError::UnknownClass`].
    pub fn layout(self, classes: &LayoutClasses) -> Result<Layout, LayoutError> {
        if self.boxes.len() > super::MOST_BOXES {
            return Err(LayoutError::TooMany { count: self.boxes.len() });
        }
        let boxes = self.boxes.into_iter().map(FileBox::into_box).collect::<Result<_, _>>()?;
        // Edits may give boxes of an unknown class another one, or take them away.
        let layout = Layout { boxes }.edited(&self.edits, classes)?;
        layout.check_classes(classes)?;
        Ok(layout)
    }
}

fn lines<T: Serialize>(items: &[T]) -> Result<String, serde_json::Error> {
    let items: Vec<String> = items.iter().map(serde_json::to_string).collect::<Result<_, _>>()?;
    Ok(if items.is_empty() { "[]".to_owned() } else { format!("[\n    {}\n  ]", items.join(",\n    ")) })
}

impl Layout {
    /// Reads a file and makes its edits.
    ///
    /// # Errors
    /// As [`LayoutFile::read`]; [`DataError::Layout`] for what [`LayoutFile::layout`] refuses.
    pub fn read(path: &Path, classes: &LayoutClasses) -> Result<Self, DataError> {
        let wrap = |why| DataError::Layout { why, path: path.to_owned() };
        LayoutFile::read(path)?.layout(classes).map_err(wrap)
    }

    /// The boxes as annotations: upright, of the nearest shared class, called by their track or, without one, their id.
    pub fn annotations(&self) -> Vec<ObjectBox> {
        let annotation = |found: &LayoutBox| ObjectBox {
            box3d: found.shape.upright(),
            class: shared_class(&found.class),
            track: found.track.clone().unwrap_or_else(|| found.id.clone()),
            source_class: found.class.clone(),
            velocity: None,
            attributes: Vec::new(),
            points: None,
            visibility: None,
            interpolated: false,
        };
        self.boxes.iter().map(annotation).collect()
    }
}

#[cfg(test)]
mod tests {
    use geometry::glam::DQuat;

    use super::*;

    fn read(text: &str) -> Result<Layout, DataError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("layout.json");
        std::fs::write(&path, text).unwrap();
        Layout::read(&path, &LayoutClasses::nuscenes())
    }

    const CAR: &str =
        r#"{"id": "car-1", "class": "car", "center": [14.2, -3.1, 0.8], "size": [4.6, 1.9, 1.7], "yaw": 0.05}"#;

    #[test]
    fn what_is_written_comes_back() {
        let tilted = OrientedBox {
            center: DVec3::new(1.0, 2.0, 3.0),
            size: DVec3::new(4.0, 2.0, 1.5),
            rotation: DQuat::from_euler(geometry::glam::EulerRot::ZYX, 0.3, 0.02, -0.01),
        };
        let upright = Box3d { yaw: 3.0, ..tilted.upright() };
        let boxes = vec![
            LayoutBox { track: Some("t".into()), ..LayoutBox::new("a", "car", tilted) },
            LayoutBox::new("b", "bus", upright),
        ];
        let layout = Layout { boxes };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/layout.json");
        LayoutFile::of(&layout, None).write(&path).unwrap();
        let back = Layout::read(&path, &LayoutClasses::nuscenes()).unwrap();
        for (was, is) in layout.boxes.iter().zip(&back.boxes) {
            assert_eq!((&was.id, &was.class, &was.track), (&is.id, &is.class, &is.track));
            assert_eq!((was.shape.center, was.shape.size), (is.shape.center, is.shape.size));
            assert!(was.shape.dst_from_box().angle_to(&is.shape.dst_from_box()) < 1e-12);
        }
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1, "no half file stays");
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains("\"rotation\"") && text.contains("\"yaw\"") && !text.contains("source"), "{text}");
        assert_eq!(text.lines().count(), 6, "a line per box: {text}");
        let source = LayoutSource { dataset: "d".into(), scene: "s".into(), frame: "f".into() };
        let edits = vec!["remove:a".parse().unwrap(), "remove:b".parse().unwrap()];
        let whole = LayoutFile { edits, ..LayoutFile::of(&Layout::default(), Some(source)) };
        whole.write(&path).unwrap();
        assert_eq!(LayoutFile::read(&path).unwrap(), whole);
    }

    #[test]
    fn edits_of_the_file_are_made() {
        let layout =
            read(&format!(r#"{{"boxes": [{CAR}], "edits": ["remove:car-1", "add:truck:x=20,y=3"]}}"#)).unwrap();
        assert_eq!(layout.boxes.iter().map(|found| found.id.as_str()).collect::<Vec<_>>(), ["truck-1"]);
        assert_eq!(read(r#"{"boxes": []}"#).unwrap(), Layout::default());
        let tank = CAR.replace("\"car\"", "\"tank\"");
        let cured = read(&format!(r#"{{"boxes": [{tank}], "edits": ["reclass:car-1:truck"]}}"#)).unwrap();
        assert_eq!(cured.boxes[0].class, "truck");
    }

    #[test]
    fn files_that_do_not_follow_the_schema_say_where() {
        let with = |from: &str, to: &str| {
            assert!(CAR.contains(from));
            let error = read(&format!(r#"{{"boxes": [{}]}}"#, CAR.replace(from, to))).unwrap_err().to_string();
            assert!(error.ends_with("layout.json"), "{error}");
            error
        };
        assert!(with("\"yaw\"", "\"yow\"").contains("yow"));
        assert!(with(", \"yaw\": 0.05", "").contains("either yaw"));
        assert!(with("0.05", "0.05, \"rotation\": [1, 0, 0, 0]").contains("either yaw"));
        assert!(with("\"yaw\": 0.05", "\"rotation\": [2, 0, 0, 0]").contains("norm"));
        assert!(with("\"car\"", "\"cra\"").contains("cra"));
        assert!(with("4.6", "0").contains("above 0 m"));
        assert!(with("14.2", "NaN").contains("line 1"));
        assert!(with("14.2", "1e999").contains("line 1"));
        assert!(with("14.2, ", "").contains("line 1"));
        assert!(read("{\"boxes\": [").unwrap_err().to_string().contains("bad JSON"));
        assert!(read("{\"boxs\": []}").unwrap_err().to_string().contains("boxs"));
        let missing = Layout::read(Path::new("absent/layout.json"), &LayoutClasses::nuscenes()).unwrap_err();
        assert!(missing.to_string().contains("missing layout file: absent/layout.json"), "{missing}");
        let typo = read(r#"{"boxes": [], "edits": ["mvoe:car-1:dx=2"]}"#).unwrap_err().to_string();
        assert!(typo.contains("mvoe") && typo.contains("move:ID"), "{typo}");
    }

    #[test]
    fn far_too_many_boxes_are_refused_at_once() {
        let many = |count: usize| {
            let boxes = (0..count).map(|at| CAR.replace("car-1", &at.to_string())).collect::<Vec<_>>().join(",");
            format!(r#"{{"boxes": [{boxes}]}}"#)
        };
        assert!(read(&many(1_000_000)).unwrap_err().to_string().contains("are no layout"));
        assert!(read(&many(super::super::MOST_BOXES + 1)).unwrap_err().to_string().contains("at most 10000"));
    }

    #[test]
    fn annotations_carry_the_shared_class() {
        let shape = Box3d { center: DVec3::ZERO, size: DVec3::ONE, yaw: 0.5 };
        let boxes = ["car", "SCHOOL_BUS", "kite"].map(|class| LayoutBox::new(class, class, shape)).to_vec();
        let found = Layout { boxes }.annotations();
        let classes: Vec<&str> = found.iter().map(|found| found.class.name()).collect();
        assert_eq!(classes, ["car", "bus", "other"]);
        assert_eq!((found[0].track.as_str(), found[1].source_class.as_str()), ("car", "SCHOOL_BUS"));
        assert!((found[0].box3d.yaw - 0.5).abs() < 1e-12);
    }
}
