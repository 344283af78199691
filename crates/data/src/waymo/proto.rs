//! The messages of `dataset.proto`, `label.proto` and `map.proto`, reduced to the fields that are used. Everything else is skipped
//! by its length: lasers, most of a record, are never copied.

use prost::Message;
use prost::bytes::Bytes;

#[derive(Clone, PartialEq, Message)]
pub(super) struct Frame {
    #[prost(message, optional, tag = "1")]
    pub context: Option<Context>,
    #[prost(int64, optional, tag = "2")]
    pub timestamp_micros: Option<i64>,
    #[prost(message, optional, tag = "3")]
    pub pose: Option<Transform>,
    #[prost(message, repeated, tag = "4")]
    pub images: Vec<CameraImage>,
    #[prost(message, repeated, tag = "6")]
    pub laser_labels: Vec<Label>,
    #[prost(message, repeated, tag = "9")]
    pub projected_lidar_labels: Vec<CameraLabels>,
    #[prost(message, optional, tag = "11")]
    pub map_pose_offset: Option<Point>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Context {
    #[prost(message, repeated, tag = "2")]
    pub camera_calibrations: Vec<CameraCalibration>,
    #[prost(message, optional, tag = "4")]
    pub stats: Option<Stats>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Stats {
    #[prost(message, repeated, tag = "1")]
    pub laser_object_counts: Vec<ObjectCount>,
    #[prost(string, optional, tag = "2")]
    pub time_of_day: Option<String>,
    #[prost(string, optional, tag = "3")]
    pub location: Option<String>,
    #[prost(string, optional, tag = "4")]
    pub weather: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct ObjectCount {}

#[derive(Clone, PartialEq, Message)]
pub(super) struct CameraCalibration {
    #[prost(int32, optional, tag = "1")]
    pub name: Option<i32>,
    /// Files write it unpacked; both forms are read.
    #[prost(double, repeated, packed = "false", tag = "2")]
    pub intrinsic: Vec<f64>,
    #[prost(message, optional, tag = "3")]
    pub vehicle_from_camera: Option<Transform>,
    #[prost(int32, optional, tag = "4")]
    pub width: Option<i32>,
    #[prost(int32, optional, tag = "5")]
    pub height: Option<i32>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Transform {
    #[prost(double, repeated, packed = "false", tag = "1")]
    pub transform: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct CameraImage {
    #[prost(int32, optional, tag = "1")]
    pub name: Option<i32>,
    /// A view into the record, not a copy.
    #[prost(bytes = "bytes", optional, tag = "2")]
    pub image: Option<Bytes>,
    #[prost(message, optional, tag = "3")]
    pub pose: Option<Transform>,
    #[prost(double, optional, tag = "5")]
    pub pose_timestamp: Option<f64>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct CameraLabels {
    #[prost(int32, optional, tag = "1")]
    pub name: Option<i32>,
    #[prost(message, repeated, tag = "2")]
    pub labels: Vec<Label>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Label {
    #[prost(message, optional, tag = "1")]
    pub r#box: Option<LabelBox>,
    #[prost(message, optional, tag = "2")]
    pub metadata: Option<Metadata>,
    #[prost(int32, optional, tag = "3")]
    pub r#type: Option<i32>,
    #[prost(string, optional, tag = "4")]
    pub id: Option<String>,
    #[prost(int32, optional, tag = "7")]
    pub num_lidar_points_in_box: Option<i32>,
}

/// Width comes before length in the numbering.
#[derive(Clone, PartialEq, Message)]
pub(super) struct LabelBox {
    #[prost(double, optional, tag = "1")]
    pub center_x: Option<f64>,
    #[prost(double, optional, tag = "2")]
    pub center_y: Option<f64>,
    #[prost(double, optional, tag = "3")]
    pub center_z: Option<f64>,
    #[prost(double, optional, tag = "4")]
    pub width: Option<f64>,
    #[prost(double, optional, tag = "5")]
    pub length: Option<f64>,
    #[prost(double, optional, tag = "6")]
    pub height: Option<f64>,
    #[prost(double, optional, tag = "7")]
    pub heading: Option<f64>,
}

/// Velocities in world axes: in the published frames they point along the headings turned by the car's pose.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Metadata {
    #[prost(double, optional, tag = "1")]
    pub speed_x: Option<f64>,
    #[prost(double, optional, tag = "2")]
    pub speed_y: Option<f64>,
    #[prost(double, optional, tag = "5")]
    pub speed_z: Option<f64>,
}

/// A record seen for its map alone.
#[derive(Clone, PartialEq, Message)]
pub(super) struct MapFrame {
    #[prost(message, repeated, tag = "10")]
    pub map_features: Vec<MapFeature>,
}

/// At most one of these is set; stop signs, speed bumps and driveways have no map kind and are skipped.
#[derive(Clone, PartialEq, Message)]
pub(super) struct MapFeature {
    #[prost(message, optional, tag = "3")]
    pub lane: Option<Lane>,
    #[prost(message, optional, tag = "4")]
    pub road_line: Option<Line>,
    #[prost(message, optional, tag = "5")]
    pub road_edge: Option<Line>,
    #[prost(message, optional, tag = "8")]
    pub crosswalk: Option<Polygon>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Lane {
    #[prost(message, repeated, tag = "8")]
    pub polyline: Vec<Point>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Line {
    #[prost(message, repeated, tag = "2")]
    pub polyline: Vec<Point>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Polygon {
    #[prost(message, repeated, tag = "1")]
    pub polygon: Vec<Point>,
}

#[derive(Clone, Copy, PartialEq, Message)]
pub(super) struct Point {
    #[prost(double, optional, tag = "1")]
    pub x: Option<f64>,
    #[prost(double, optional, tag = "2")]
    pub y: Option<f64>,
    #[prost(double, optional, tag = "3")]
    pub z: Option<f64>,
}
