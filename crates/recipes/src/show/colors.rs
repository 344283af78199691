//! One colour per meaning, the same in pictures and from above.

use data::{MapKind, ObjectClass, OccupancyLabels};

use super::canvas::Color;

pub(super) const PAPER: Color = [24, 24, 28];
pub(super) const INK: Color = [235, 235, 235];
pub(super) const FAINT: Color = [110, 110, 118];
pub(super) const EGO: Color = [60, 230, 120];
pub(super) const IGNORED: Color = [255, 0, 60];

pub(super) fn of_class(class: ObjectClass) -> Color {
    match class {
        ObjectClass::Car => [255, 158, 0],
        ObjectClass::Truck => [255, 99, 71],
        ObjectClass::Bus => [255, 225, 60],
        ObjectClass::Trailer => [205, 133, 80],
        ObjectClass::ConstructionVehicle => [190, 215, 40],
        ObjectClass::Motorcycle => [255, 60, 140],
        ObjectClass::Bicycle => [220, 120, 255],
        ObjectClass::Pedestrian => [70, 140, 255],
        ObjectClass::TrafficCone => [90, 235, 255],
        ObjectClass::Barrier => [175, 185, 205],
        ObjectClass::Sign => [0, 225, 160],
        ObjectClass::Animal => [160, 255, 90],
        ObjectClass::Other => [235, 235, 235],
    }
}

pub(super) fn of_map(kind: MapKind) -> Color {
    match kind {
        MapKind::Divider => [250, 235, 90],
        MapKind::Crossing => [80, 205, 255],
        MapKind::Boundary => [255, 75, 75],
        MapKind::Centerline => [95, 225, 120],
        MapKind::StopLine => [255, 60, 220],
        MapKind::Walkway => [185, 150, 255],
        MapKind::Carpark => [120, 160, 255],
    }
}

pub(super) fn map_name(kind: MapKind) -> &'static str {
    match kind {
        MapKind::Divider => "divider",
        MapKind::Crossing => "crossing",
        MapKind::Boundary => "boundary",
        MapKind::Centerline => "centerline",
        MapKind::StopLine => "stop line",
        MapKind::Walkway => "walkway",
        MapKind::Carpark => "carpark",
    }
}

/// The label's name in its set.
pub(super) fn label_name(set: OccupancyLabels, label: u8) -> &'static str {
    set.class_names().get(usize::from(label)).copied().unwrap_or("unknown")
}

pub(super) fn of_label(set: OccupancyLabels, label: u8) -> Color {
    match label_name(set, label) {
        "barrier" => of_class(ObjectClass::Barrier),
        "bicycle" | "cyclist" => of_class(ObjectClass::Bicycle),
        "bus" => of_class(ObjectClass::Bus),
        "car" | "vehicle" => of_class(ObjectClass::Car),
        "construction_vehicle" => of_class(ObjectClass::ConstructionVehicle),
        "motorcycle" => of_class(ObjectClass::Motorcycle),
        "pedestrian" => of_class(ObjectClass::Pedestrian),
        "traffic_cone" | "construction_cone" => of_class(ObjectClass::TrafficCone),
        "trailer" => of_class(ObjectClass::Trailer),
        "truck" => of_class(ObjectClass::Truck),
        "sign" => of_class(ObjectClass::Sign),
        "traffic_light" => [255, 80, 80],
        "pole" => [150, 150, 170],
        "driveable_surface" | "road" => [92, 92, 104],
        "other_flat" => [130, 95, 105],
        "sidewalk" | "walkable" => [125, 105, 150],
        "terrain" => [105, 125, 70],
        "manmade" | "building" => [190, 180, 160],
        "vegetation" => [45, 135, 60],
        "tree_trunk" => [120, 85, 50],
        _ => [140, 140, 140],
    }
}
