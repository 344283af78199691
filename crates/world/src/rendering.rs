//! What the renderer takes and gives.

use serde::{Deserialize, Serialize};

/// The label of pixels that see the sky.
pub const SKY_LABEL: u8 = 255;
/// The label of free cells in an occupancy grid.
pub const FREE_LABEL: u8 = 17;

/// How to render.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderOptions {
    /// Colour rays per pixel where a pixel's neighbours see another surface; smooth pixels always take one ray (textures are
    /// filtered by footprint). 1 switches the smoothing of edges off. Depth and labels always come from the pixel's centre.
    pub samples_per_pixel: u32,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { samples_per_pixel: 3 }
    }
}

/// One rendered view. All buffers are row-major, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[H, W, 3]`, sRGB-like 8 bit; black where the lens has no ray.
    pub rgb: Vec<u8>,
    /// `[H, W]`, metres along the camera's z axis; infinite for sky.
    pub depth: Vec<f32>,
    /// `[H, W]`, Occ3D-nuScenes classes; 255 for sky.
    pub semantic: Vec<u8>,
    /// `[H, W]`, 0 for none, else actor id + 1.
    pub instance: Vec<u32>,
}

/// What a single ray meets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Along the ray, in units of its direction's length (metres for a unit direction).
    pub distance: f64,
    /// Occ3D-nuScenes class.
    pub semantic: u8,
    /// 0 for none, else actor id + 1.
    pub instance: u32,
}
