//! The foreground-aware mask (FGM): objects weigh more in the loss, small ones most.
//!
//! DualDiff+, equations 7 and 8: `m = 1 + λ − λ·a / (U·V)` on an object whose region covers a of the U·V latent cells, 1 elsewhere; the
//! loss is the mean over elements of `(ε − ε̂)² · m`.

use geometry::glam::DVec2;
use serde::{Deserialize, Serialize};

use super::ConvexHull;

/// Which cells an object covers: those whose centres lie in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskRegion {
    /// The rectangle around its projected corners.
    Rect,
    /// The convex hull of its projected corners.
    #[default]
    Hull,
}

/// How the mask is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MaskConfig {
    /// Shape of an object.
    pub region: MaskRegion,
    /// λ
    pub lambda: f64,
    /// An object that covers no cell's centre marks the cell that holds the mean of its points, so that far ones keep their weight.
    pub at_least_one: bool,
}

impl Default for MaskConfig {
    fn default() -> Self {
        Self { region: MaskRegion::Hull, lambda: 1.0, at_least_one: true }
    }
}

/// Weights of one latent picture.
#[derive(Debug, Clone, PartialEq)]
pub struct ForegroundMask {
    /// `[rows, columns]`, in [1, 1 + λ].
    pub weights: Vec<f32>,
    /// Cells of each object, 0 for one outside the picture.
    pub areas: Vec<usize>,
}

impl ForegroundMask {
    /// Draws objects, each given by points in latent cells (x to the right, y down, centres at +0.5). Where objects overlap, the larger
    /// weight counts: the smaller object.
    #[must_use]
    pub fn draw(objects: &[Vec<DVec2>], [rows, columns]: [usize; 2], config: &MaskConfig) -> Self {
        let mut weights = vec![1.0_f32; rows * columns];
        let mut areas = Vec::with_capacity(objects.len());
        for points in objects {
            let spans = covered(points, [rows, columns], config);
            let area: usize = spans.iter().map(|(_, [first, end])| end - first).sum();
            let weight = (1.0 + config.lambda - config.lambda * area as f64 / (rows * columns) as f64) as f32;
            for (row, [first, end]) in spans {
                for cell in &mut weights[row * columns + first..row * columns + end] {
                    *cell = cell.max(weight);
                }
            }
            areas.push(area);
        }
        Self { weights, areas }
    }
}

/// Rows with the columns `[first, end)` that an object covers.
fn covered(points: &[DVec2], size: [usize; 2], config: &MaskConfig) -> Vec<(usize, [usize; 2])> {
    if points.is_empty() {
        return Vec::new();
    }
    let [rows, columns] = size;
    let hull = match config.region {
        MaskRegion::Hull => ConvexHull::new(points),
        MaskRegion::Rect => {
            let low = points.iter().copied().reduce(DVec2::min).unwrap_or_default();
            let high = points.iter().copied().reduce(DVec2::max).unwrap_or_default();
            ConvexHull::new(&[low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)])
        }
    };
    let within = |[low, high]: [f64; 2], count: usize| {
        let bound = |at: f64| at.clamp(0.0, count as f64) as usize;
        [bound((low - 0.5).ceil()), bound((high - 0.5).floor() + 1.0)]
    };
    let [top, bottom] = hull.rows().map_or([0, 0], |range| within(range, rows));
    let spans = (top..bottom).filter_map(|row| Some((row, within(hull.span(row as f64 + 0.5)?, columns))));
    let spans: Vec<_> = spans.filter(|(_, [first, end])| first < end).collect();
    if !spans.is_empty() || !config.at_least_one {
        return spans;
    }
    let mean = points.iter().sum::<DVec2>() / points.len() as f64;
    let inside = mean.cmpge(DVec2::ZERO).all() && mean.x < columns as f64 && mean.y < rows as f64;
    let cell = || (mean.y as usize, [mean.x as usize, mean.x as usize + 1]);
    if inside { vec![cell()] } else { Vec::new() }
}
