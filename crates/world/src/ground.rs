//! What the ground plane z = 0 is at a point: a coarse grid tells which stretches of road are near, then the answer is analytic.

use glam::{DVec2, Vec2};

use crate::curve::Piece;
use crate::math::{atan2_f32, hash2, sin_cos, unit};
use crate::network::{Carpark, Network};

/// Edge of a lookup cell, metres.
const CELL_M: f64 = 8.0;

/// What covers the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cover {
    /// Road, with its markings.
    Road,
    /// Car park and driveway.
    Carpark,
    /// Sidewalk.
    Sidewalk,
    /// Paved ground that is neither.
    Paved,
    /// Lawn.
    Grass,
    /// Bare soil and gravel.
    Soil,
}

impl Cover {
    /// The Occ3D-nuScenes class.
    pub fn label(self) -> u8 {
        match self {
            Self::Road | Self::Carpark => 11,
            Self::Sidewalk => 13,
            Self::Paved => 12,
            Self::Grass | Self::Soil => 14,
        }
    }
}

/// Position relative to one road.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Abreast {
    /// Index of the road.
    pub road: usize,
    /// Along its axis.
    pub s: f32,
    /// To the left of its axis.
    pub d: f32,
    /// Unit tangent of the road here.
    pub tangent: Vec2,
}

/// A point of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// What covers it.
    pub cover: Cover,
    /// Nearest point on the main road's axis, and the nearest side street.
    pub main: Option<Abreast>,
    /// Nearest side street.
    pub side: Option<Abreast>,
    /// Metres outside the roads' drivable area, negative inside.
    pub outside: f32,
}

#[derive(Debug, Clone)]
struct FlatPiece {
    road: u8,
    start: Vec2,
    forward: Vec2,
    /// Centre of the arc, signed radius; 0 for a straight.
    center: Vec2,
    radius: f32,
    first_spoke: Vec2,
    start_s: f32,
    length: f32,
}

#[derive(Debug, Clone, Copy)]
struct FlatRoad {
    half: f32,
    fillet: f32,
}

/// Lookup structure; coordinates relative to the scene's origin.
#[derive(Debug, Clone)]
pub struct Ground {
    low: Vec2,
    size: [usize; 2],
    cells: Vec<(u32, u32)>,
    list: Vec<u8>,
    pieces: Vec<FlatPiece>,
    roads: Vec<FlatRoad>,
    sidewalk: f32,
    carpark: Option<Carpark>,
    /// Share of blocks beside the road that are paved and that are soil.
    blocks: [f32; 2],
    salt: u32,
}

impl FlatPiece {
    fn new(road: usize, piece: &Piece, origin: DVec2) -> Self {
        let (sin, cos) = sin_cos(piece.heading);
        let normal = DVec2::new(-sin, cos);
        let radius = if piece.curvature == 0.0 { 0.0 } else { 1.0 / piece.curvature };
        Self {
            road: road as u8,
            start: (piece.start - origin).as_vec2(),
            forward: DVec2::new(cos, sin).as_vec2(),
            center: (piece.start + normal * radius - origin).as_vec2(),
            radius: radius as f32,
            first_spoke: (-normal * radius.signum()).as_vec2(),
            start_s: piece.start_s as f32,
            length: piece.length as f32,
        }
    }

    fn abreast(&self, point: Vec2) -> Option<Abreast> {
        const SLACK_M: f32 = 2e-3;
        let (along, d, tangent);
        if self.radius == 0.0 {
            let rel = point - self.start;
            along = rel.dot(self.forward);
            if along < -SLACK_M || along > self.length + SLACK_M {
                return None;
            }
            d = self.forward.perp_dot(rel);
            tangent = self.forward;
        } else {
            let spoke = point - self.center;
            let turned = atan2_f32(self.first_spoke.perp_dot(spoke), self.first_spoke.dot(spoke));
            along = turned * self.radius;
            if along < -SLACK_M || along > self.length + SLACK_M {
                return None;
            }
            let reach = spoke.length();
            d = self.radius - self.radius.signum() * reach;
            tangent = spoke.perp() * (self.radius.signum() / reach.max(1e-3));
        }
        Some(Abreast { road: usize::from(self.road), s: self.start_s + along, d, tangent })
    }
}

impl Ground {
    /// Prepares the lookup; `origin` is the scene's origin, `blocks` the shares of paved and bare blocks.
    pub fn new(network: &Network, origin: DVec2, blocks: [f32; 2], salt: u32) -> Self {
        let (low, high) = network.bounds();
        let size = ((high - low) / CELL_M).ceil();
        let size = [size.x as usize, size.y as usize];
        let pieces: Vec<FlatPiece> = network
            .roads
            .iter()
            .enumerate()
            .flat_map(|(index, road)| road.curve.pieces.iter().map(move |p| FlatPiece::new(index, p, origin)))
            .collect();
        let roads = network.roads.iter().enumerate().map(|(index, road)| FlatRoad {
            half: road.half() as f32,
            fillet: network.junctions.iter().find(|j| j.side_road == index).map_or(0.0, |j| j.fillet as f32),
        });
        let mut ground = Self {
            low: (low - origin).as_vec2(),
            size,
            cells: Vec::with_capacity(size[0] * size[1]),
            list: Vec::new(),
            pieces,
            roads: roads.collect(),
            sidewalk: network.main().sidewalk_width as f32,
            carpark: network.carpark,
            blocks,
            salt,
        };
        ground.fill_cells();
        ground
    }

    fn fill_cells(&mut self) {
        let cell = CELL_M as f32;
        // Half a diagonal twice: once for the point in the cell, once for its nearest piece.
        let slack = cell * 1.5;
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                let center = self.low + Vec2::new(x as f32 + 0.5, y as f32 + 0.5) * cell;
                let distances: Vec<f32> = self.pieces.iter().map(|p| distance(p, center)).collect();
                let main = |i: &usize| self.pieces[*i].road == 0;
                let best = |is_main: bool| {
                    (0..distances.len())
                        .filter(|i| main(i) == is_main)
                        .map(|i| distances[i])
                        .fold(f32::INFINITY, f32::min)
                };
                let limits = [best(false), best(true)];
                let first = self.list.len() as u32;
                let keep = (0..distances.len())
                    .filter(|i| distances[*i] <= limits[usize::from(main(i))] + slack)
                    // Side streets matter only near their pavements.
                    .filter(|i| main(i) || distances[*i] < 40.0);
                self.list.extend(keep.map(|i| i as u8));
                self.cells.push((first, self.list.len() as u32));
            }
        }
    }

    /// What lies at a point (relative to the origin).
    pub fn at(&self, point: Vec2) -> Spot {
        let (mut main, mut side): (Option<Abreast>, Option<Abreast>) = (None, None);
        let cell = (point - self.low) * (1.0 / CELL_M as f32);
        if cell.x >= 0.0 && cell.y >= 0.0 && cell.x < self.size[0] as f32 && cell.y < self.size[1] as f32 {
            let (first, last) = self.cells[cell.y as usize * self.size[0] + cell.x as usize];
            for index in &self.list[first as usize..last as usize] {
                let Some(found) = self.pieces[usize::from(*index)].abreast(point) else { continue };
                let slot = if found.road == 0 { &mut main } else { &mut side };
                if slot.is_none_or(|old| found.d.abs() < old.d.abs()) {
                    *slot = Some(found);
                }
            }
        }
        let outside = self.outside(main, side);
        let cover = self.cover(point, main, side, outside);
        Spot { cover, main, side, outside }
    }

    fn outside(&self, main: Option<Abreast>, side: Option<Abreast>) -> f32 {
        let across = |a: Abreast| a.d.abs() - self.roads[a.road].half;
        match (main, side) {
            (Some(a), Some(b)) => {
                let (x, y, fillet) = (across(a), across(b), self.roads[b.road].fillet);
                if x > 0.0 && y > 0.0 && x < fillet && y < fillet {
                    let corner = Vec2::new(fillet - x, fillet - y);
                    return fillet - corner.length();
                }
                x.min(y)
            }
            (Some(a), None) => across(a),
            (None, Some(b)) => across(b),
            (None, None) => f32::INFINITY,
        }
    }

    fn cover(&self, point: Vec2, main: Option<Abreast>, side: Option<Abreast>, outside: f32) -> Cover {
        if outside <= 0.0 {
            return Cover::Road;
        }
        if let (Some(park), Some(a)) = (&self.carpark, main) {
            let (s, d) = (a.s, a.d * park.side as f32);
            let within = |v: f32, range: [f64; 2]| v >= range[0] as f32 && v <= range[1] as f32;
            if within(s, park.s) && within(d, park.d) {
                let island = within(s, park.island_s) && within(d, park.island_d);
                return if island { Cover::Grass } else { Cover::Carpark };
            }
            if within(s, park.driveway) && d > 0.0 && d <= park.d[0] as f32 {
                return Cover::Carpark;
            }
        }
        if outside < self.sidewalk {
            return Cover::Sidewalk;
        }
        // Ground beside the sidewalks changes in blocks along the street.
        let nearest = match (main, side) {
            (Some(a), Some(b)) => Some(if a.d.abs() < b.d.abs() { a } else { b }),
            (a, b) => a.or(b),
        };
        let share = match nearest {
            Some(a) if outside < self.sidewalk + 14.0 => {
                unit(hash2((a.s / 26.0) as i32, a.road as i32 * 2 + i32::from(a.d > 0.0), self.salt))
            }
            _ => unit(hash2((point.x / 60.0).floor() as i32, (point.y / 60.0).floor() as i32, self.salt ^ 9)) * 1.3,
        };
        if share < self.blocks[0] {
            Cover::Paved
        } else if share < self.blocks[0] + self.blocks[1] {
            Cover::Soil
        } else {
            Cover::Grass
        }
    }
}

/// Distance of a point from a piece's axis; generous beyond its ends.
fn distance(piece: &FlatPiece, point: Vec2) -> f32 {
    if let Some(a) = piece.abreast(point) {
        return a.d.abs();
    }
    let end = if piece.radius == 0.0 {
        piece.start + piece.forward * piece.length
    } else {
        let (sin, cos) = sin_cos(f64::from(piece.length / piece.radius));
        let spoke = Vec2::new(cos as f32, sin as f32).rotate(piece.first_spoke);
        piece.center + spoke * piece.radius.abs()
    };
    (point - piece.start).length().min((point - end).length())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::WorldConfig;
    use crate::dice::{Dice, Purpose};

    #[test]
    fn the_lookup_agrees_with_the_network() {
        for seed in 0..6 {
            let network = Network::generate(&mut Dice::new(seed, Purpose::Network), &WorldConfig::default(), -1.0);
            let (low, high) = network.bounds();
            let origin = ((low + high) * 0.5).round();
            let ground = Ground::new(&network, origin, [0.3, 0.2], 1);
            let mut dice = Dice::new(seed, Purpose::People);
            let mut drivable = 0;
            for _ in 0..4000 {
                let s = dice.range(0.0, network.main().curve.length());
                let point = network.main().curve.at(s).offset(dice.range(-45.0, 45.0));
                let exact = network.outside_roads(point);
                let spot = ground.at((point - origin).as_vec2());
                if exact.abs() > 0.01 && exact < 25.0 {
                    assert_eq!(exact < 0.0, spot.outside < 0.0, "seed {seed} {point} {exact} {spot:?}");
                    assert!((exact as f32 - spot.outside).abs() < 0.02, "seed {seed} {point} {exact} {spot:?}");
                }
                drivable += usize::from(exact < 0.0);
            }
            assert!(drivable > 300);
        }
    }
}
