//! Road axes: chains of straight lines and circular arcs.

use glam::DVec2;

use crate::math::{atan2, sin_cos};

/// One line or arc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Piece {
    /// Arc length at its start.
    pub start_s: f64,
    /// Length, metres.
    pub length: f64,
    /// Start point.
    pub start: DVec2,
    /// Heading at the start, radians.
    pub heading: f64,
    /// Signed curvature, 1/m, positive to the left.
    pub curvature: f64,
}

/// Point and direction at an arc length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    /// Point on the axis.
    pub point: DVec2,
    /// Unit tangent.
    pub tangent: DVec2,
    /// Heading, radians (not wrapped).
    pub heading: f64,
    /// Curvature, 1/m.
    pub curvature: f64,
}

impl Station {
    /// Unit vector to the left.
    pub fn normal(&self) -> DVec2 {
        self.tangent.perp()
    }

    /// The point `offset_m` to the left.
    pub fn offset(&self, offset_m: f64) -> DVec2 {
        self.point + self.normal() * offset_m
    }
}

impl Piece {
    fn at(&self, s: f64) -> Station {
        let along = s - self.start_s;
        let heading = self.heading + self.curvature * along;
        let (sin, cos) = sin_cos(heading);
        let tangent = DVec2::new(cos, sin);
        let (sin0, cos0) = sin_cos(self.heading);
        let point = if self.curvature == 0.0 {
            self.start + DVec2::new(cos0, sin0) * along
        } else {
            // The centre lies 1/curvature to the left of both points.
            self.start + (DVec2::new(-sin0, cos0) - tangent.perp()) / self.curvature
        };
        Station { point, tangent, heading, curvature: self.curvature }
    }

    /// Arc length and left offset of a point relative to this piece (extended beyond its ends).
    pub fn project(&self, point: DVec2) -> DVec2 {
        let (sin, cos) = sin_cos(self.heading);
        let normal = DVec2::new(-sin, cos);
        let rel = point - self.start;
        if self.curvature == 0.0 {
            return DVec2::new(self.start_s + rel.dot(DVec2::new(cos, sin)), rel.dot(normal));
        }
        let radius = 1.0 / self.curvature;
        let spoke = rel - normal * radius;
        let first = -normal * radius;
        let turned = atan2(first.perp_dot(spoke), first.dot(spoke));
        DVec2::new(self.start_s + turned * radius, radius - radius.signum() * spoke.length())
    }
}

/// A chain of pieces with continuous heading.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// At least one piece.
    pub pieces: Vec<Piece>,
}

impl Curve {
    /// From a start and (length, curvature) pairs.
    pub fn new(start: DVec2, heading: f64, parts: &[(f64, f64)]) -> Self {
        let mut pieces: Vec<Piece> = Vec::with_capacity(parts.len());
        let (mut start, mut heading, mut start_s) = (start, heading, 0.0);
        for &(length, curvature) in parts {
            let piece = Piece { start_s, length, start, heading, curvature };
            let end = piece.at(start_s + length);
            pieces.push(piece);
            (start, heading, start_s) = (end.point, end.heading, start_s + length);
        }
        Self { pieces }
    }

    /// Total length, metres.
    pub fn length(&self) -> f64 {
        self.pieces.last().map_or(0.0, |p| p.start_s + p.length)
    }

    /// The station at `s`; the end pieces go on beyond the ends.
    pub fn at(&self, s: f64) -> Station {
        let index = self.pieces.partition_point(|p| p.start_s <= s).max(1) - 1;
        self.pieces[index].at(s)
    }

    /// Arc lengths from `from` to `to` dense enough for a polyline: every 2 m in arcs, 10 m on straights, joints included.
    pub fn stations(&self, from: f64, to: f64) -> Vec<f64> {
        let mut out = vec![from];
        for piece in &self.pieces {
            let (low, high) = (piece.start_s.max(from), (piece.start_s + piece.length).min(to));
            if high - low < 1e-9 {
                continue;
            }
            let step = if piece.curvature == 0.0 { 10.0 } else { 2.0 };
            let count = ((high - low) / step).ceil() as usize;
            out.extend((1..=count).map(|i| low + (high - low) * i as f64 / count as f64));
        }
        if to - out[out.len() - 1] > 1e-9 {
            out.push(to);
        }
        out
    }

    /// Polyline at a constant left offset.
    pub fn polyline(&self, from: f64, to: f64, offset_m: f64) -> Vec<DVec2> {
        self.stations(from, to).into_iter().map(|s| self.at(s).offset(offset_m)).collect()
    }

    /// Arc length and left offset of the nearest point on the chain, if the point is abreast of it.
    pub fn project(&self, point: DVec2) -> Option<DVec2> {
        let abreast = |p: &Piece| {
            let sd = p.project(point);
            let along = sd.x - p.start_s;
            (along >= -1e-6 && along <= p.length + 1e-6).then_some(sd)
        };
        self.pieces.iter().filter_map(abreast).min_by(|a, b| a.y.abs().total_cmp(&b.y.abs()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn projection_inverts_the_offset_point() {
        let curve = Curve::new(DVec2::new(3.0, -2.0), 0.4, &[(50.0, 0.0), (60.0, 0.02), (30.0, 0.0), (40.0, -0.025)]);
        for i in 0..180 {
            for d in [-9.0, -1.0, 0.0, 4.0, 12.0] {
                let s = f64::from(i) + 0.25;
                let back = curve.project(curve.at(s).offset(d)).expect("abreast");
                assert!((back - DVec2::new(s, d)).length() < 1e-8, "{s} {d} {back}");
            }
        }
    }

    #[test]
    fn pieces_join_without_a_kink() {
        let curve = Curve::new(DVec2::ZERO, 0.0, &[(50.0, 0.0), (60.0, 0.02), (30.0, 0.0)]);
        for joint in [50.0, 110.0] {
            let (a, b) = (curve.at(joint - 1e-7), curve.at(joint + 1e-7));
            assert!((a.point - b.point).length() < 1e-6 && (a.tangent - b.tangent).length() < 1e-6);
        }
    }
}
