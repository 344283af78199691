//! Lamps at night: street lamps in a lookup grid, and the ego's head lamps.

use glam::{Vec2, Vec3};

use crate::math::smoothstep;

const CELL_M: f32 = 12.0;
/// Lamps further away than this (on the ground) give nothing.
const REACH_M: f32 = 26.0;

/// Street lamps by place.
#[derive(Debug, Clone, Default)]
pub struct Lamps {
    heads: Vec<Vec3>,
    low: Vec2,
    size: [usize; 2],
    cells: Vec<(u32, u32)>,
    list: Vec<u16>,
    /// Light of one lamp, times square metres.
    pub color: Vec3,
}

impl Lamps {
    /// Sorts lamp heads (relative to the scene's origin) into cells.
    pub fn new(heads: Vec<Vec3>, color: Vec3) -> Self {
        let empty = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        let (low, high) = heads.iter().fold(empty, |(l, h), p| (l.min(p.truncate()), h.max(p.truncate())));
        if heads.is_empty() {
            return Self::default();
        }
        let low = low - REACH_M;
        let size = ((high + REACH_M - low) / CELL_M).ceil();
        let size = [size.x as usize, size.y as usize];
        let mut lamps = Self { heads, low, size, cells: Vec::new(), list: Vec::new(), color };
        for y in 0..size[1] {
            for x in 0..size[0] {
                let center = low + Vec2::new(x as f32 + 0.5, y as f32 + 0.5) * CELL_M;
                let reach = REACH_M + CELL_M * 0.71;
                let near = |p: &Vec3| (p.truncate() - center).length_squared() < reach * reach;
                let first = lamps.list.len() as u32;
                let found = lamps.heads.iter().enumerate().filter(|(_, p)| near(p)).map(|(i, _)| i as u16);
                lamps.list.extend(found.collect::<Vec<_>>());
                lamps.cells.push((first, lamps.list.len() as u32));
            }
        }
        lamps
    }

    /// Light of all near lamps on a surface, and the head of the strongest with its share.
    pub fn on(&self, point: Vec3, normal: Vec3) -> (f32, Option<(Vec3, f32)>) {
        let cell = (point.truncate() - self.low) * (1.0 / CELL_M);
        if cell.x < 0.0 || cell.y < 0.0 || cell.x >= self.size[0] as f32 || cell.y >= self.size[1] as f32 {
            return (0.0, None);
        }
        let (first, last) = self.cells[cell.y as usize * self.size[0] + cell.x as usize];
        let (mut sum, mut strongest) = (0.0, None);
        for index in &self.list[first as usize..last as usize] {
            let head = self.heads[usize::from(*index)];
            let to = head - point;
            let d2 = to.length_squared();
            let away = to.truncate().length_squared();
            if away > REACH_M * REACH_M || to.z < 0.1 {
                continue;
            }
            let inverse = 1.0 / d2.sqrt();
            let facing = (to.dot(normal) * inverse + 0.08).max(0.0);
            let down = to.z * inverse;
            let edge = 1.0 - away / (REACH_M * REACH_M);
            let light = facing * down * edge / (d2 + 2.0);
            sum += light;
            if strongest.is_none_or(|(_, old)| light > old) {
                strongest = Some((head, light));
            }
        }
        (sum, strongest)
    }
}

/// The ego's head lamps as one cone.
#[derive(Debug, Clone, Copy)]
pub struct HeadLamps {
    /// Between the two lamps.
    pub from: Vec3,
    /// Unit vector ahead.
    pub ahead: Vec3,
}

impl HeadLamps {
    /// Light on a surface.
    pub fn on(&self, point: Vec3, normal: Vec3) -> f32 {
        let to = point - self.from;
        let distance = to.length().max(0.5);
        let direction = to / distance;
        let beam = smoothstep(0.80, 0.985, direction.dot(self.ahead)) * smoothstep(0.10, -0.01, direction.z);
        if beam <= 0.0 {
            return 0.0;
        }
        let facing = (0.25 - 0.75 * direction.dot(normal)).max(0.0);
        90.0 * beam * facing / (distance * distance + 60.0)
    }
}
