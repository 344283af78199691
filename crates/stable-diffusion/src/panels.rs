//! Whether the views of a rig are convolved one by one or as one panorama.
//!
//! Source: Panacea (Wen et al.), whose public code lays latents side by side. Shapes: B samples, V views, N = B·V.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// What convolutions and group norms of a UNet or ControlNet see. Attention within a picture sees one view either way.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Panels {
    /// Each view alone: any rig, no mixing across the seams between pictures.
    #[default]
    PerView,
    /// The views of a sample side by side, in their order. The view's width must be divisible at every level.
    JointWidth,
}

/// Views side by side.
///
/// # Shapes
/// - x: `[B·V, C, h, w]`
/// - output: `[B, C, h, V·w]`
pub fn join_width(x: Tensor<4>, views: usize) -> Tensor<4> {
    if views == 1 {
        return x;
    }
    let [n, c, h, w] = x.dims();
    let panels = x.reshape([n / views, views, c, h, w]).permute([0, 2, 3, 1, 4]);
    panels.reshape([n / views, c, h, views * w])
}

/// The inverse of [`join_width`].
///
/// # Shapes
/// - x: `[B, C, h, V·w]`
/// - output: `[B·V, C, h, w]`
pub fn split_width(x: Tensor<4>, views: usize) -> Tensor<4> {
    if views == 1 {
        return x;
    }
    let [b, c, h, width] = x.dims();
    assert_eq!(width % views, 0, "{views} views share a panorama of width {width}");
    let panels = x.reshape([b, c, h, views, width / views]).permute([0, 3, 1, 2, 4]);
    panels.reshape([b * views, c, h, width / views])
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    #[test]
    fn views_stand_side_by_side_in_their_order() {
        let x = Tensor::<1>::from_floats([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], &Device::flex());
        // One sample, two views, one channel, 2x2.
        let x = x.reshape([2, 1, 2, 2]);
        let joined = join_width(x.clone(), 2);
        assert_eq!(joined.dims(), [1, 1, 2, 4]);
        let values: Vec<f32> = joined.clone().into_data().iter().collect();
        assert_eq!(values, [0.0, 1.0, 4.0, 5.0, 2.0, 3.0, 6.0, 7.0]);
        assert_eq!(split_width(joined, 2).into_data(), x.into_data());
    }
}
