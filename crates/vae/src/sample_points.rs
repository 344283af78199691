//! Where voxels fall in pictures and where rays fall in the voxel grid.
//!
//! Shapes: B batch, V views, Q voxels, R frustum points (depth, row, column).

use burn::tensor::{Bool, Device, Tensor, TensorData};
use geometry::BevGrid;
use glam::DVec3;

use crate::BevVaeConfig;

/// Calibration of the cameras that look (encoder) or are asked to see (decoder), one matrix per view.
#[derive(Debug, Clone)]
pub struct ViewMatrices {
    /// Encoder: ego to network pixels times depth. Decoder: network pixels times depth to ego.
    ///
    /// `[B, V, 3, 4]`, zeros where a padded rig has no camera.
    pub matrices: Tensor<4>,
    /// True where the rig has a camera, `[B, V]`.
    pub view_mask: Tensor<2, Bool>,
}

/// Points in unit coordinates with their validity.
#[derive(Debug, Clone)]
pub struct SamplePoints {
    /// `[B, V, N, 2 or 3]` in (x, y[, z]) order, 0 and 1 at the outer borders; 0 where invalid.
    pub reference: Tensor<4>,
    /// `[B, V, N]`
    pub valid: Tensor<3, Bool>,
}

/// Voxel centres in every view (section 2.1 of the specification): visible where depth > 1e-6 m and the pixel lies strictly
/// inside the picture.
pub fn voxels_in_views(config: &BevVaeConfig, img_from_ego: &ViewMatrices) -> SamplePoints {
    let device = img_from_ego.matrices.device();
    let projected = transform(&img_from_ego.matrices, homogeneous(&config.grid.centers(), &device));
    let depth = axis(&projected, 2);
    let divisor = depth.clone().clamp_min(1e-6);
    let u = axis(&projected, 0) / divisor.clone() / config.image.width as f64;
    let v = axis(&projected, 1) / divisor / config.image.height as f64;
    let valid = depth.greater_elem(1e-6).bool_and(inside(&u)).bool_and(inside(&v));
    points(vec![u, v], valid, &img_from_ego.view_mask)
}

/// Frustum points of every view in the voxel grid: valid strictly inside it (section 2.3 of the specification).
pub fn rays_in_grid(config: &BevVaeConfig, ego_from_img: &ViewMatrices) -> SamplePoints {
    let device = ego_from_img.matrices.device();
    let pixels = config.frustum.scaled_pixels(config.image.width as u32, config.image.height as u32);
    let in_ego = transform(&ego_from_img.matrices, homogeneous(&pixels, &device));
    let BevGrid { x_range, y_range, z_range, .. } = config.grid;
    let unit: Vec<Tensor<3>> = [x_range, y_range, z_range]
        .iter()
        .enumerate()
        .map(|(i, [low, high])| (axis(&in_ego, i) - *low) / (high - low))
        .collect();
    let valid = unit.iter().map(inside).reduce(Tensor::bool_and).expect("three axes");
    points(unit, valid, &ego_from_img.view_mask)
}

/// Points as columns `[4, N]`.
fn homogeneous(points: &[DVec3], device: &Device) -> Tensor<2> {
    let mut rows = vec![1.0_f32; 4 * points.len()];
    for (i, point) in points.iter().enumerate() {
        for (row, value) in point.to_array().into_iter().enumerate() {
            rows[row * points.len() + i] = value as f32;
        }
    }
    Tensor::from_data(TensorData::new(rows, [4, points.len()]), device)
}

/// `[B, V, 3, 4]` times `[4, N]` to `[B, V, 3, N]`.
fn transform(matrices: &Tensor<4>, points: Tensor<2>) -> Tensor<4> {
    let [b, v, _, _] = matrices.dims();
    let [_, n] = points.dims();
    matrices.clone().reshape([b * v * 3, 4]).matmul(points).reshape([b, v, 3, n])
}

/// Coordinate `i` of `[B, V, 3, N]` as `[B, V, N]`.
fn axis(points: &Tensor<4>, i: usize) -> Tensor<3> {
    let [b, v, _, n] = points.dims();
    points.clone().slice([0..b, 0..v, i..i + 1, 0..n]).reshape([b, v, n])
}

fn inside(coordinate: &Tensor<3>) -> Tensor<3, Bool> {
    coordinate.clone().greater_elem(0.0).bool_and(coordinate.clone().lower_elem(1.0))
}

fn points(coordinates: Vec<Tensor<3>>, valid: Tensor<3, Bool>, view_mask: &Tensor<2, Bool>) -> SamplePoints {
    let [b, v, n] = valid.dims();
    let valid = valid.bool_and(view_mask.clone().reshape([b, v, 1]).expand([b, v, n]));
    let reference: Tensor<4> = Tensor::stack(coordinates, 3);
    let outside = valid.clone().bool_not().reshape([b, v, n, 1]).expand(reference.dims());
    SamplePoints { reference: reference.mask_fill(outside, 0.0), valid }
}
