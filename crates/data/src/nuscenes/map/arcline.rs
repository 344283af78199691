//! Lane centre lines: pieces of three parts each, arcs or straights, as `arcline_path_3` holds them.

use serde::Deserialize;

/// One piece as it stands in the file.
#[derive(Debug, Deserialize)]
pub(super) struct ArclineRow {
    start_pose: [f64; 3],
    end_pose: [f64; 3],
    shape: String,
    radius: f64,
    segment_length: [f64; 3],
}

/// No lane is longer; a broken length must not become a million points.
const LONGEST_M: f64 = 20_000.0;
/// Pieces that meet this closely share a point.
const JOINT_M: f64 = 1e-3;

/// One piece of a lane's path: x and y in metres and the heading in radians, all in the map's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arcline {
    /// Where it begins.
    pub start: [f64; 3],
    /// Where it ends according to the file.
    pub end: [f64; 3],
    /// Curvatures of the parts, 1/m, positive to the left.
    pub curvatures: [f64; 3],
    /// Lengths of the parts, metres.
    pub lengths: [f64; 3],
}

impl Arcline {
    /// # Errors
    /// What is wrong with the row.
    pub(super) fn of_row(row: &ArclineRow) -> Result<Self, String> {
        let numbers = [row.start_pose, row.end_pose, row.segment_length].concat();
        if numbers.iter().any(|value| value.abs() > super::FARTHEST_M) {
            return Err("it has a number that is no metre of a map".to_owned());
        }
        let length: f64 = row.segment_length.iter().sum();
        if row.segment_length.iter().any(|part| *part < 0.0) || length > LONGEST_M {
            return Err(format!("its parts are {:?} m long", row.segment_length));
        }
        let mut curvatures = [0.0; 3];
        if row.shape.len() != 3 {
            return Err(format!("its shape is {:?}", row.shape));
        }
        for ((curvature, letter), length) in curvatures.iter_mut().zip(row.shape.chars()).zip(row.segment_length) {
            let turn = match letter {
                'L' => 1.0,
                'R' => -1.0,
                'S' => continue,
                _ => return Err(format!("its shape is {:?}", row.shape)),
            };
            if length > 0.0 && row.radius <= 1e-3 {
                return Err(format!("its radius is {} m", row.radius));
            }
            *curvature = if length > 0.0 { turn / row.radius } else { 0.0 };
        }
        Ok(Self { start: row.start_pose, end: row.end_pose, curvatures, lengths: row.segment_length })
    }

    /// Metres along it.
    pub fn length(&self) -> f64 {
        self.lengths.iter().sum()
    }

    /// x, y and heading this many metres behind its start; beyond its ends those of the ends.
    pub fn at(&self, distance_m: f64) -> [f64; 3] {
        let mut rest = distance_m.max(0.0);
        let mut pose = self.start;
        for (length, curvature) in self.lengths.into_iter().zip(self.curvatures) {
            let way = rest.min(length);
            pose = drive(pose, way, curvature);
            rest -= way;
        }
        pose
    }

    /// Poses from start to end, evenly spaced by at most `step_m` metres: the rule of the official map API.
    pub fn poses(&self, step_m: f64) -> Vec<[f64; 3]> {
        let length = self.length();
        let steps = (length / step_m.max(1e-2)).ceil().max(1.0) as usize;
        (0..=steps).map(|at| self.at(length * at as f64 / steps as f64)).collect()
    }
}

fn drive([x, y, heading]: [f64; 3], way: f64, curvature: f64) -> [f64; 3] {
    let turned = heading + curvature * way;
    if curvature == 0.0 {
        return [x + way * heading.cos(), y + way * heading.sin(), heading];
    }
    [x + (turned.sin() - heading.sin()) / curvature, y - (turned.cos() - heading.cos()) / curvature, turned]
}

/// Poses of a path of several pieces; points where pieces meet stand once.
pub(super) fn poses(path: &[Arcline], step_m: f64) -> Vec<[f64; 3]> {
    let mut out: Vec<[f64; 3]> = Vec::new();
    for piece in path {
        let poses = piece.poses(step_m);
        let meets = |[x, y, _]: &[f64; 3]| {
            out.last().is_some_and(|[u, v, _]| (x - u).abs() < JOINT_M && (y - v).abs() < JOINT_M)
        };
        let shared = usize::from(poses.first().is_some_and(meets));
        out.extend(poses.into_iter().skip(shared));
    }
    out
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    fn row(shape: &str, radius: f64, segment_length: [f64; 3]) -> ArclineRow {
        ArclineRow {
            start_pose: [1.0, 2.0, FRAC_PI_2],
            end_pose: [0.0; 3],
            shape: shape.to_owned(),
            radius,
            segment_length,
        }
    }

    #[test]
    fn every_shape_is_driven() {
        let quarter = 10.0 * FRAC_PI_2;
        let ends = [
            ("LSL", [quarter, 5.0, quarter], [-14.0 - 10.0, 12.0 - 10.0, 1.5 * PI]),
            ("LSR", [quarter, 5.0, quarter], [-14.0 - 10.0, 12.0 + 10.0, FRAC_PI_2]),
            ("RSR", [quarter, 5.0, quarter], [16.0 + 10.0, 12.0 - 10.0, -FRAC_PI_2]),
            ("RSL", [quarter, 5.0, quarter], [16.0 + 10.0, 12.0 + 10.0, FRAC_PI_2]),
            ("LRL", [quarter, quarter, 0.0], [-19.0, 22.0, FRAC_PI_2]),
            ("RLR", [quarter, quarter, quarter], [31.0, 32.0, 0.0]),
        ];
        for (shape, lengths, want) in ends {
            let piece = Arcline::of_row(&row(shape, 10.0, lengths)).unwrap();
            let poses = piece.poses(1.0);
            let end = poses[poses.len() - 1];
            assert!(end.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-9), "{shape}: {end:?} instead of {want:?}");
            let spaces = poses.windows(2).map(|p| (p[1][0] - p[0][0]).hypot(p[1][1] - p[0][1]));
            assert!(spaces.into_iter().all(|space| space > 0.5 && space <= 1.0));
        }
    }

    #[test]
    fn impossible_pieces_are_refused() {
        for (shape, radius, lengths) in [
            ("LSX", 10.0, [1.0; 3]),
            ("LS", 10.0, [1.0; 3]),
            ("LSL", 0.0, [1.0; 3]),
            ("LSL", -5.0, [1.0; 3]),
            ("LSL", 10.0, [-1.0, 3.0, 0.0]),
            ("LSL", 10.0, [1e12, 0.0, 0.0]),
        ] {
            assert!(Arcline::of_row(&row(shape, radius, lengths)).is_err(), "{shape} {radius} {lengths:?}");
        }
        assert!(Arcline::of_row(&row("LSL", 0.0, [0.0, 3.0, 0.0])).is_ok());
    }

    #[test]
    fn joints_stand_once() {
        let first = Arcline::of_row(&row("LSL", 1.0, [0.0, 4.0, 0.0])).unwrap();
        let second = Arcline { start: first.at(4.0), ..first };
        let poses = poses(&[first, second], 2.0);
        assert_eq!(poses.len(), 5);
        assert!((poses[4][1] - 10.0).abs() < 1e-12);
    }
}
