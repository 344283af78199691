//! The components without pictures: calibration, poses, boxes, words.

use arrow_array::Int32Array;
use arrow_schema::DataType;
use geometry::glam::DVec3;
use geometry::{Lens, RigCamera, Rigid};

use super::plan::Scene;
use super::table::Table;
use crate::waymo::cameras::{pose_numbers, waymo_from_cam};
use crate::waymo::components::{CAMERA, CONTEXT, INTRINSIC, OBJECT, STAMP, column};
use crate::waymo::raw::LABEL_TYPES;
use crate::{DataError, ObjectBox, ObjectClass};

/// `GLOBAL_SHUTTER` of `dataset.proto`.
const GLOBAL_SHUTTER: i8 = 5;

/// Component and table of everything but pictures.
pub(super) fn small_tables(scene: &Scene<'_>) -> Result<Vec<(&'static str, Table)>, DataError> {
    let mut tables = vec![("camera_calibration", calibration(scene)?), ("vehicle_pose", vehicle_pose(scene)?)];
    if scene.annotated {
        tables.push(("lidar_box", lidar_box(scene)));
    }
    if scene.frames.iter().any(|frame| frame.scene_text.is_some()) {
        tables.push(("stats", stats(scene)));
    }
    Ok(tables)
}

/// The key columns of rows with these stamps.
pub(super) fn keyed(scene: &Scene<'_>, micros: impl IntoIterator<Item = i64>) -> Table {
    let micros: Vec<i64> = micros.into_iter().collect();
    let mut table = Table::default();
    table.text(CONTEXT, micros.iter().map(|_| Some(scene.name)));
    table.int64(STAMP, micros.into_iter().map(Some));
    table
}

fn calibration(scene: &Scene<'_>) -> Result<Table, DataError> {
    let field = |name: &str| column("CameraCalibration", name);
    let cameras: Vec<&RigCamera> = scene.cameras.values().collect();
    let mut table = Table::default();
    table.text(CONTEXT, cameras.iter().map(|_| Some(scene.name)));
    table.int8(CAMERA, scene.cameras.keys().copied());
    for (at, name) in INTRINSIC.into_iter().enumerate() {
        let value = |camera: &&RigCamera| intrinsic(camera).get(at).copied();
        table.float64(field(&format!("intrinsic.{name}")), cameras.iter().map(value));
    }
    let vehicle_from_camera = |camera: &&RigCamera| pose_numbers(&(camera.ego_from_cam * waymo_from_cam().inverse()));
    table.poses(&field("extrinsic.transform"), cameras.iter().map(vehicle_from_camera))?;
    let side = |value: u32| i32::try_from(value).ok();
    table.array(field("width"), cameras.iter().map(|c| side(c.intrinsics.width)).collect::<Int32Array>());
    table.array(field("height"), cameras.iter().map(|c| side(c.intrinsics.height)).collect::<Int32Array>());
    table.int8(field("rolling_shutter_direction"), cameras.iter().map(|_| GLOBAL_SHUTTER));
    Ok(table)
}

/// In the order of [`INTRINSIC`], integer coordinates at pixel centres.
fn intrinsic(camera: &RigCamera) -> [f64; 9] {
    let i = &camera.intrinsics;
    let ([k1, k2, k3], [p1, p2]) = match camera.lens {
        Lens::BrownConrady { k, p } => (k, p),
        // The plan has refused any other lens.
        Lens::Pinhole | Lens::KannalaBrandt { .. } => ([0.0; 3], [0.0; 2]),
    };
    [i.fx, i.fy, i.cx - 0.5, i.cy - 0.5, k1, k2, p1, p2, k3]
}

fn vehicle_pose(scene: &Scene<'_>) -> Result<Table, DataError> {
    let mut table = keyed(scene, scene.micros.iter().copied());
    let name = column("VehiclePose", "world_from_vehicle.transform");
    table.poses(&name, scene.frames.iter().map(|frame| pose_numbers(&frame.world_from_ego)))?;
    Ok(table)
}

fn lidar_box(scene: &Scene<'_>) -> Table {
    let field = |name: &str| column("LiDARBox", name);
    let of_frame = |(micros, frame)| rows_of(micros, frame);
    let rows: Vec<(i64, &Rigid, &ObjectBox)> = scene.micros.iter().zip(scene.frames).flat_map(of_frame).collect();
    let mut table = keyed(scene, rows.iter().map(|row| row.0));
    table.text(OBJECT, rows.iter().map(|row| Some(&row.2.track)));
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        table.float64(field(&format!("box.center.{name}")), rows.iter().map(|row| Some(row.2.box3d.center[axis])));
    }
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        table.float64(field(&format!("box.size.{name}")), rows.iter().map(|row| Some(row.2.box3d.size[axis])));
    }
    table.float64(field("box.heading"), rows.iter().map(|row| Some(row.2.box3d.yaw)));
    table.int8(field("type"), rows.iter().map(|row| label_type(row.2)));
    table.int64(field("num_lidar_points_in_box"), rows.iter().map(|row| row.2.points.map(i64::from)));
    table.unknown(field("num_top_lidar_points_in_box"), DataType::Int64);
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        let speed = |row: &(i64, &Rigid, &ObjectBox)| Some(world_velocity(row.1, row.2)?.to_array()[axis]);
        table.float64(field(&format!("speed.{name}")), rows.iter().map(speed));
    }
    for axis in ["x", "y", "z"] {
        table.unknown(field(&format!("acceleration.{axis}")), DataType::Float64);
    }
    for task in ["detection", "tracking"] {
        table.unknown(field(&format!("difficulty_level.{task}")), DataType::Int8);
    }
    table
}

/// Stamp, the car and box of every object of a frame.
fn rows_of<'a>(
    micros: &i64,
    frame: &'a crate::SceneFrame,
) -> impl Iterator<Item = (i64, &'a Rigid, &'a ObjectBox)> + use<'a> {
    let micros = *micros;
    frame.boxes.iter().flatten().map(move |object| (micros, &frame.world_from_ego, object))
}

/// m/s in world axes.
fn world_velocity(world_from_ego: &Rigid, object: &ObjectBox) -> Option<DVec3> {
    let [x, y] = object.velocity?;
    Some(world_from_ego.transform_vector(DVec3::new(x, y, 0.0)))
}

/// The native type if the object has one, else that of its class: the format has no finer ones.
fn label_type(object: &ObjectBox) -> i8 {
    use ObjectClass::*;
    let name = match object.class {
        _ if LABEL_TYPES.contains(&object.source_class.as_str()) => &object.source_class,
        Car | Truck | Bus | Trailer | ConstructionVehicle | Motorcycle => "VEHICLE",
        Pedestrian => "PEDESTRIAN",
        Sign => "SIGN",
        Bicycle => "CYCLIST",
        TrafficCone | Barrier | Animal | Other => "UNKNOWN",
    };
    LABEL_TYPES.iter().position(|known| *known == name).and_then(|at| i8::try_from(at).ok()).unwrap_or(0)
}

fn stats(scene: &Scene<'_>) -> Table {
    let mut table = keyed(scene, scene.micros.iter().copied());
    let words: Vec<[Option<&str>; 3]> =
        scene.frames.iter().map(|frame| frame.scene_text.as_deref().map_or([None; 3], words)).collect();
    for (at, name) in ["time_of_day", "location", "weather"].into_iter().enumerate() {
        table.text(column("Stats", name), words.iter().map(|words| words[at]));
    }
    table
}

/// Time of day, location and weather.
fn words(text: &str) -> [Option<&str>; 3] {
    let parts: Vec<&str> = text.split(", ").collect();
    match parts[..] {
        [day, place, weather] => [Some(day), Some(place), Some(weather)],
        _ => [None, None, Some(text)],
    }
}
