//! One frame as either release stores it, and its way into the neutral record.

use std::path::{Path, PathBuf};

use geometry::glam::DVec3;
use geometry::{Box3d, RigCamera, Rigid, wrap_angle};

use super::cameras;
use super::config::WaymoConfig;
use crate::taxonomy::{self, ClassRule};
use crate::{DataError, EmbeddedPicture, FrameId, ImageSource, ObjectBox, ObjectClass, SceneFrame, View};

/// From a frame's native stamp, the start of the lidar turn, to the instant its pose and boxes belong to: half a turn.
pub(crate) const HALF_TURN_US: i64 = 50_000;
/// Stamps beyond this, in either direction, are no times of this format: f64 seconds of the year 2128 still tell microseconds apart.
const LAST_MICROS: i64 = 5_000_000_000_000_000;

/// A frame before classes, camera order and conventions.
#[derive(Debug)]
pub(super) struct RawFrame {
    /// Native stamp, µs.
    pub micros: i64,
    pub world_from_ego: Rigid,
    /// The wanted cameras in rig order.
    pub cameras: Vec<RigCamera>,
    pub pictures: Vec<RawPicture>,
    pub boxes: Option<Vec<RawBox>>,
    pub text: Option<String>,
    /// The file of the boxes, which errors name.
    pub path: PathBuf,
}

/// A picture with the car's pose when it was taken.
#[derive(Debug, Clone)]
pub(super) struct RawPicture {
    /// Camera number.
    pub camera: i64,
    pub timestamp_ns: i64,
    pub world_from_ego: Rigid,
    pub picture: EmbeddedPicture,
}

/// A labelled object in the ego frame.
#[derive(Debug, Clone)]
pub(super) struct RawBox {
    pub center: [f64; 3],
    /// Length, width, height.
    pub size: [f64; 3],
    pub heading: f64,
    /// Number of the label type.
    pub kind: i64,
    pub id: String,
    pub points: Option<i64>,
    /// m/s in world axes.
    pub world_velocity: Option<[f64; 3]>,
}

/// Label types by number (`Label.Type` of `label.proto`).
pub(crate) const LABEL_TYPES: [&str; 5] = ["UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST"];

/// Reference instant of a native stamp.
pub(super) fn reference_ns(micros: i64) -> i64 {
    (micros + HALF_TURN_US) * 1000
}

/// A native stamp that is a time.
pub(super) fn checked_micros(micros: i64, path: &Path) -> Result<i64, DataError> {
    if (-LAST_MICROS..LAST_MICROS).contains(&micros) {
        return Ok(micros);
    }
    Err(no_time(micros, path))
}

/// Seconds as files hold them for pictures.
pub(super) fn picture_ns(secs: f64, path: &Path) -> Result<i64, DataError> {
    if secs.is_nan() || secs.abs() > LAST_MICROS as f64 * 1e-6 {
        return Err(no_time(secs, path));
    }
    // Whole seconds apart: 1.6e18 ns would lose another 256 ns as one f64.
    let whole = secs.floor();
    Ok(whole as i64 * 1_000_000_000 + ((secs - whole) * 1e9).round() as i64)
}

fn no_time(value: impl std::fmt::Display, path: &Path) -> DataError {
    DataError::Column { column: "time stamp".to_owned(), why: format!("{value} is no time"), path: path.to_owned() }
}

/// Words about the scene; `None` where there are none.
pub(super) fn joined_text(words: [Option<&str>; 3]) -> Option<String> {
    let words: Vec<&str> = words.into_iter().flatten().filter(|word| !word.is_empty()).collect();
    (!words.is_empty()).then(|| words.join(", "))
}

impl RawFrame {
    /// The neutral record.
    ///
    /// # Errors
    /// Two pictures of one camera, impossible boxes, classes without a rule.
    pub fn into_frame(self, config: &WaymoConfig, scene: &str) -> Result<SceneFrame, DataError> {
        let views = self.cameras.iter().map(|camera| self.view(camera)).collect::<Result<_, _>>()?;
        let boxes = self.boxes.as_ref().map(|boxes| self.objects(boxes, config)).transpose()?;
        Ok(SceneFrame {
            id: FrameId { dataset: config.name.clone(), scene: scene.to_owned(), frame: self.micros.to_string() },
            timestamp_ns: reference_ns(self.micros),
            world_from_ego: self.world_from_ego,
            views,
            boxes,
            scene_text: self.text,
        })
    }

    fn view(&self, camera: &RigCamera) -> Result<View, DataError> {
        let mut pictures = self.pictures.iter().filter(|p| cameras::channel(p.camera) == Some(&camera.channel));
        let picture = pictures.next();
        if let Some(twice) = pictures.next() {
            let token = format!("{} {}", self.micros, camera.channel);
            let path = twice.picture.path().to_owned();
            return Err(DataError::DuplicateToken { table: "camera_image", token, path });
        }
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        // A camera without a picture stands where the frame is.
        let (timestamp_ns, world_from_ego) =
            picture.map_or((reference_ns(self.micros), self.world_from_ego), |p| (p.timestamp_ns, p.world_from_ego));
        Ok(View {
            channel: camera.channel.clone(),
            timestamp_ns,
            image: picture.map(|p| ImageSource::Embedded { picture: p.picture.clone(), size }),
            mask: None,
            intrinsics: camera.intrinsics,
            lens: camera.lens,
            ego_from_cam: camera.ego_from_cam,
            world_from_ego,
        })
    }

    fn objects(&self, boxes: &[RawBox], config: &WaymoConfig) -> Result<Vec<ObjectBox>, DataError> {
        let mut objects = Vec::with_capacity(boxes.len());
        for found in boxes {
            let source_class = usize::try_from(found.kind).ok().and_then(|kind| LABEL_TYPES.get(kind));
            let source_class = source_class.map_or_else(|| found.kind.to_string(), |name| (*name).to_owned());
            if let Some(class) = class_of(&source_class, config)? {
                objects.push(self.object(found, class, source_class)?);
            }
        }
        Ok(objects)
    }

    fn object(&self, found: &RawBox, class: ObjectClass, source_class: String) -> Result<ObjectBox, DataError> {
        let bad = |why: &str| DataError::Annotation {
            token: format!("{} {}", self.micros, found.id),
            why: why.to_owned(),
            path: self.path.clone(),
        };
        let numbers = found.center.iter().chain(&found.size).chain([&found.heading]);
        if numbers.chain(found.world_velocity.iter().flatten()).any(|number| !number.is_finite()) {
            return Err(bad("a number is not finite"));
        }
        if found.size.iter().any(|side| *side <= 0.0) {
            return Err(bad(&format!("its size is {:?}", found.size)));
        }
        let points = found.points.map(u32::try_from).transpose().map_err(|_| bad("its point count is impossible"))?;
        let ego_velocity = |v: [f64; 3]| self.world_from_ego.inverse().transform_vector(DVec3::from_array(v));
        Ok(ObjectBox {
            box3d: Box3d {
                center: DVec3::from_array(found.center),
                size: DVec3::from_array(found.size),
                yaw: wrap_angle(found.heading),
            },
            class,
            track: found.id.clone(),
            source_class,
            velocity: found.world_velocity.map(|v| ego_velocity(v).truncate().to_array()),
            attributes: Vec::new(),
            points,
            visibility: None,
            interpolated: false,
        })
    }
}

/// The shared class of a native one; `None` where the config drops it.
fn class_of(name: &str, config: &WaymoConfig) -> Result<Option<ObjectClass>, DataError> {
    match config.classes.get(name) {
        Some(ClassRule::Drop) => Ok(None),
        Some(ClassRule::As(class)) => Ok(Some(*class)),
        None => match taxonomy::from_waymo(name) {
            Some(class) => Ok(Some(class)),
            None => Err(DataError::UnknownClass { dataset: config.name.clone(), name: name.to_owned() }),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_stay_exact() {
        let path = Path::new("f");
        assert_eq!(reference_ns(1_553_735_853_462_203), 1_553_735_853_512_203_000);
        // f64 seconds of this size are 238 ns apart.
        let ns = picture_ns(1_553_735_853.514_620_8, path).unwrap();
        assert!((ns - 1_553_735_853_514_620_800).abs() < 120, "{ns}");
        for odd in [f64::NAN, f64::INFINITY, -1e10, 1e15] {
            assert!(picture_ns(odd, path).is_err());
        }
        assert!(checked_micros(i64::MAX, path).is_err() && checked_micros(i64::MIN, path).is_err());
    }
}
