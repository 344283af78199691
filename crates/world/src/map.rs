//! The vector map of a world, world frame, metres; everything lies on z = 0.

use glam::DVec2;

/// What a map line stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MapLineKind {
    /// Between opposite directions.
    RoadDivider,
    /// Between lanes of one direction.
    LaneDivider,
    /// Edge of the drivable area.
    Boundary,
    /// Middle of a lane, in driving direction.
    Centerline,
    /// Where vehicles stop before a crossing.
    StopLine,
    /// Closed outline of a pedestrian crossing (first point repeated at the end).
    Crossing,
}

/// What a map area stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MapAreaKind {
    /// Where vehicles can drive; the union of these areas is the drivable surface.
    DrivableArea,
    /// A stretch of road between intersections.
    RoadSegment,
    /// The road segment of an intersection.
    Intersection,
    /// Zebra crossing.
    Crossing,
    /// Sidewalk.
    Walkway,
    /// The strip of a stop line.
    StopLine,
    /// Car park with its islands as holes.
    Carpark,
}

/// How a line is painted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Paint {
    /// Nothing on the ground.
    None,
    /// One continuous white line.
    SolidWhite,
    /// Single broken white line.
    DashedWhite,
    /// One continuous yellow line.
    SolidYellow,
    /// Two continuous yellow lines.
    DoubleSolidYellow,
    /// Two continuous white lines.
    DoubleSolidWhite,
}

/// A polyline of the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapLine {
    /// Meaning.
    pub kind: MapLineKind,
    /// At least two points; the paint, if any, is centred on them.
    pub points: Vec<DVec2>,
    /// Paint on the ground.
    pub paint: Paint,
}

/// A polygon of the map. Rings are open (first point not repeated); the outer ring runs counter-clockwise, holes clockwise.
#[derive(Debug, Clone, PartialEq)]
pub struct MapArea {
    /// Meaning.
    pub kind: MapAreaKind,
    /// Outer ring.
    pub outer: Vec<DVec2>,
    /// Inner rings.
    pub holes: Vec<Vec<DVec2>>,
}

/// One lane, or a connector through an intersection. All three lines run in driving direction.
#[derive(Debug, Clone, PartialEq)]
pub struct MapLane {
    /// Left boundary.
    pub left: Vec<DVec2>,
    /// Right boundary; as many points as `left`.
    pub right: Vec<DVec2>,
    /// Middle line.
    pub centerline: Vec<DVec2>,
    /// Paint of the left boundary.
    pub left_paint: Paint,
    /// Paint of the right boundary.
    pub right_paint: Paint,
    /// True for connectors through an intersection.
    pub connector: bool,
    /// Indices (into `VectorMap::lanes`) of the lanes that follow.
    pub successors: Vec<usize>,
    /// Indices of the lanes before.
    pub predecessors: Vec<usize>,
}

impl MapLane {
    /// Outline: left boundary forward, right boundary back, turned counter-clockwise.
    pub fn polygon(&self) -> Vec<DVec2> {
        self.right.iter().chain(self.left.iter().rev()).copied().collect()
    }
}

/// The whole map of a world.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VectorMap {
    /// Polylines.
    pub lines: Vec<MapLine>,
    /// Polygons.
    pub areas: Vec<MapArea>,
    /// Lanes and connectors.
    pub lanes: Vec<MapLane>,
}

impl VectorMap {
    /// Lower and upper corner around all points; coordinates are positive, so that the upper corner can be a canvas size.
    pub fn bounds(&self) -> (DVec2, DVec2) {
        let areas = self.areas.iter().flat_map(|a| &a.outer);
        let lines = self.lines.iter().flat_map(|l| &l.points);
        areas.chain(lines).fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)))
    }
}
