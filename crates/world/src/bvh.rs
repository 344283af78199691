//! A flat four-wide bounding-volume hierarchy over shapes, split by the surface area heuristic.

use glam::Vec3;

use crate::shape::{Shape, Surface};

const BINS: usize = 12;
const LEAF: usize = 3;
/// Deep enough for any tree the builder makes: it halves by count when the heuristic finds no split.
const STACK: usize = 96;

/// Bounds of four children side by side, so that one pass of vector instructions tests them all.
#[derive(Debug, Clone, Copy)]
struct Node {
    /// Lower bounds: x, y, z of each child; empty children are inside out.
    low: [[f32; 4]; 3],
    high: [[f32; 4]; 3],
    /// Index of the child node, or of the first shape of a leaf.
    first: [u32; 4],
    /// Shapes of a leaf, 0 for a node.
    count: [u32; 4],
}

/// Shapes with their hierarchy.
#[derive(Debug, Clone, Default)]
pub struct Bvh {
    nodes: Vec<Node>,
    shapes: Vec<Shape>,
    surfaces: Vec<Surface>,
}

/// A ray prepared for box tests.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// Start.
    pub origin: Vec3,
    /// Unit direction.
    pub direction: Vec3,
    inverse: [f32; 3],
    offset: [f32; 3],
}

impl Ray {
    /// Prepares a ray.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        let inverse = direction.to_array().map(|v| 1.0 / if v.abs() < 1e-9 { 1e-9 } else { v });
        let o = origin.to_array();
        let offset = [-o[0] * inverse[0], -o[1] * inverse[1], -o[2] * inverse[2]];
        Self { origin, direction, inverse, offset }
    }

    /// Point at a distance.
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }

    /// Entry distances into the four children, infinite where the ray misses or enters beyond `far`.
    #[inline(always)]
    fn enter(&self, node: &Node, far: f32) -> [f32; 4] {
        let mut near = [0.0f32; 4];
        let mut exit = [far; 4];
        for axis in 0..3 {
            let (inverse, offset) = (self.inverse[axis], self.offset[axis]);
            let (a, b) =
                if inverse < 0.0 { (&node.high[axis], &node.low[axis]) } else { (&node.low[axis], &node.high[axis]) };
            for i in 0..4 {
                near[i] = larger(a[i] * inverse + offset, near[i]);
                exit[i] = smaller(b[i] * inverse + offset, exit[i]);
            }
        }
        // The tolerance covers the rounding of offset + bound * inverse.
        std::array::from_fn(|i| if near[i] <= exit[i] * 1.000_001 { near[i] } else { f32::INFINITY })
    }
}

#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

fn pick_min(a: Vec3, b: Vec3) -> Vec3 {
    Vec3::new(smaller(a.x, b.x), smaller(a.y, b.y), smaller(a.z, b.z))
}

fn pick_max(a: Vec3, b: Vec3) -> Vec3 {
    Vec3::new(larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z))
}

impl Bvh {
    /// Builds the hierarchy.
    pub fn new(parts: Vec<(Shape, Surface)>) -> Self {
        let mut items: Vec<Item> = parts
            .iter()
            .enumerate()
            .map(|(index, (shape, _))| {
                let (low, high) = shape.bounds();
                Item { low, high, index: index as u32 }
            })
            .collect();
        let mut nodes = Vec::with_capacity(items.len() / 2 + 1);
        if !items.is_empty() {
            add_node(&mut nodes, &mut items, 0);
        }
        let pick = |item: &Item| parts[item.index as usize];
        let (shapes, surfaces) = items.iter().map(pick).unzip();
        Self { nodes, shapes, surfaces }
    }

    /// All shapes with their surfaces.
    pub fn parts(&self) -> impl Iterator<Item = (&Shape, &Surface)> {
        self.shapes.iter().zip(&self.surfaces)
    }

    /// The shape and surface of a hit.
    pub fn part(&self, index: u32) -> (&Shape, &Surface) {
        (&self.shapes[index as usize], &self.surfaces[index as usize])
    }

    /// Nearest shape within (near, far): distance and index.
    pub fn nearest(&self, ray: &Ray, near: f32, far: f32) -> Option<(f32, u32)> {
        let mut best = None;
        let mut reach = far;
        // Entry distance, index, count (0 for a node).
        let mut stack = [(0.0f32, 0u32, 0u32); STACK];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let (entry, first, count) = stack[depth];
            if entry >= reach {
                continue;
            }
            if count > 0 {
                for index in first..first + count {
                    if let Some(t) = self.shapes[index as usize].enter(ray.origin, ray.direction, near, reach) {
                        reach = t;
                        best = Some((t, index));
                    }
                }
                continue;
            }
            let node = &self.nodes[first as usize];
            let entries = ray.enter(node, reach);
            let base = depth;
            for (i, entry) in entries.into_iter().enumerate() {
                if entry < f32::INFINITY && depth < STACK {
                    // Keeps the new part of the stack sorted, nearest on top.
                    let mut at = depth;
                    while at > base && stack[at - 1].0 < entry {
                        stack[at] = stack[at - 1];
                        at -= 1;
                    }
                    stack[at] = (entry, node.first[i], node.count[i]);
                    depth += 1;
                }
            }
        }
        best
    }

    /// Whether anything lies within (near, far).
    pub fn blocked(&self, ray: &Ray, near: f32, far: f32) -> bool {
        let mut stack = [0u32; STACK];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let node = &self.nodes[stack[depth] as usize];
            let entries = ray.enter(node, far);
            for (i, entry) in entries.into_iter().enumerate() {
                if entry == f32::INFINITY {
                    continue;
                }
                if node.count[i] > 0 {
                    let range = node.first[i] as usize..(node.first[i] + node.count[i]) as usize;
                    if self.shapes[range].iter().any(|s| s.enter(ray.origin, ray.direction, near, far).is_some()) {
                        return true;
                    }
                } else if depth < STACK {
                    stack[depth] = node.first[i];
                    depth += 1;
                }
            }
        }
        false
    }
}

struct Item {
    low: Vec3,
    high: Vec3,
    index: u32,
}

fn around(items: &[Item]) -> (Vec3, Vec3) {
    let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    items.iter().fold(empty, |(low, high), i| (pick_min(low, i.low), pick_max(high, i.high)))
}

fn half_area(low: Vec3, high: Vec3) -> f32 {
    let e = high - low;
    if e.x < 0.0 { 0.0 } else { e.x * e.y + e.y * e.z + e.z * e.x }
}

/// Adds the node over `items`, whose first shape gets the index `offset`, and all nodes below it; returns its index.
fn add_node(nodes: &mut Vec<Node>, items: &mut [Item], offset: usize) -> u32 {
    let at = nodes.len();
    let outside_in =
        Node { low: [[f32::INFINITY; 4]; 3], high: [[f32::NEG_INFINITY; 4]; 3], first: [0; 4], count: [0; 4] };
    nodes.push(outside_in);
    // Splits the largest group until there are four.
    let mut groups = vec![(0usize, items.len())];
    while groups.len() < 4 {
        let area = |g: &(usize, usize)| {
            let (low, high) = around(&items[g.0..g.1]);
            half_area(low, high)
        };
        let splittable = (0..groups.len()).filter(|i| groups[*i].1 - groups[*i].0 > LEAF);
        let Some(widest) = splittable.max_by(|a, b| area(&groups[*a]).total_cmp(&area(&groups[*b]))) else { break };
        let (from, to) = groups[widest];
        let middle = from + partition(&mut items[from..to]);
        groups[widest] = (from, middle);
        groups.push((middle, to));
    }
    for (child, (from, to)) in groups.into_iter().enumerate() {
        let (low, high) = around(&items[from..to]);
        let leaf = to - from <= LEAF;
        let first = if leaf { (offset + from) as u32 } else { add_node(nodes, &mut items[from..to], offset + from) };
        let node = &mut nodes[at];
        for axis in 0..3 {
            (node.low[axis][child], node.high[axis][child]) = (low[axis], high[axis]);
        }
        node.first[child] = first;
        node.count[child] = if leaf { (to - from) as u32 } else { 0 };
    }
    at as u32
}

/// Orders items along the best binned split and returns its position (never 0 or the length).
fn partition(items: &mut [Item]) -> usize {
    let centers = |i: &Item| i.low + i.high;
    let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    let (low, high) =
        items.iter().fold(empty, |(low, high), i| (pick_min(low, centers(i)), pick_max(high, centers(i))));
    let mut best = (f32::INFINITY, 0, 0);
    let bin_of = |item: &Item, axis: usize| {
        let scaled = (centers(item)[axis] - low[axis]) / (high[axis] - low[axis]) * BINS as f32;
        (scaled as usize).min(BINS - 1)
    };
    for axis in 0..3 {
        if high[axis] - low[axis] < 1e-4 {
            continue;
        }
        let mut bins = [(0usize, Vec3::INFINITY, Vec3::NEG_INFINITY); BINS];
        for item in items.iter() {
            let bin = &mut bins[bin_of(item, axis)];
            *bin = (bin.0 + 1, pick_min(bin.1, item.low), pick_max(bin.2, item.high));
        }
        let mut right = [0.0f32; BINS];
        let mut sum = (0usize, Vec3::INFINITY, Vec3::NEG_INFINITY);
        for i in (1..BINS).rev() {
            sum = (sum.0 + bins[i].0, pick_min(sum.1, bins[i].1), pick_max(sum.2, bins[i].2));
            right[i] = sum.0 as f32 * half_area(sum.1, sum.2);
        }
        sum = (0, Vec3::INFINITY, Vec3::NEG_INFINITY);
        for i in 0..BINS - 1 {
            sum = (sum.0 + bins[i].0, pick_min(sum.1, bins[i].1), pick_max(sum.2, bins[i].2));
            let cost = sum.0 as f32 * half_area(sum.1, sum.2) + right[i + 1];
            if sum.0 > 0 && sum.0 < items.len() && cost < best.0 {
                best = (cost, axis, i + 1);
            }
        }
    }
    if best.0 == f32::INFINITY {
        return items.len() / 2;
    }
    // A stable partition keeps the order, and so the bytes, independent of the sort's internals.
    items.sort_by_key(|item| bin_of(item, best.1) >= best.2);
    items.partition_point(|item| bin_of(item, best.1) < best.2)
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::*;
    use crate::math::{hash2, unit};
    use crate::shape::{Form, Look};

    #[test]
    fn the_hierarchy_finds_what_a_plain_search_finds() {
        let number = |i: i32, k: i32| unit(hash2(i, k, 3));
        let surface = Surface {
            look: Look::Plain,
            color: Vec3::ONE,
            accent: Vec3::ONE,
            label: 15,
            instance: 0,
            salt: 0,
            lit: false,
        };
        let parts: Vec<_> = (0..300)
            .map(|i| {
                let center = Vec3::new(number(i, 0) * 40.0, number(i, 1) * 40.0, number(i, 2) * 10.0);
                let half = Vec3::new(0.2 + number(i, 3), 0.2 + number(i, 4), 0.2 + number(i, 5));
                let form = if i % 2 == 0 { Form::Block } else { Form::Ball };
                (Shape { center, turn: Vec2::new(0.6, 0.8), half, form }, surface)
            })
            .collect();
        let bvh = Bvh::new(parts.clone());
        let mut hits = 0;
        for i in 0..2000 {
            let origin = Vec3::new(number(i, 10) * 40.0, number(i, 11) * 40.0, number(i, 12) * 10.0);
            let direction = Vec3::new(number(i, 13) - 0.5, number(i, 14) - 0.5, number(i, 15) - 0.5).normalize();
            let plain =
                parts.iter().filter_map(|(shape, _)| shape.enter(origin, direction, 0.0, 30.0)).min_by(f32::total_cmp);
            let ray = Ray::new(origin, direction);
            assert_eq!(bvh.nearest(&ray, 0.0, 30.0).map(|hit| hit.0), plain);
            assert_eq!(bvh.blocked(&ray, 0.0, 30.0), plain.is_some());
            hits += usize::from(plain.is_some());
        }
        assert!(hits > 300, "{hits}");
    }
}
