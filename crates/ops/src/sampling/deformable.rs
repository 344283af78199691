//! Multi-scale deformable sampling of maps and volumes.
//!
//! Paper: Zhu et al., "Deformable DETR", section 4.1; the per-view form follows Li et al., "BEVFormer", section 3.3.
//! Level `l` of `values` starts where level `l - 1` ends, each level row-major.

use burn::tensor::{Bool, Tensor};

use super::core::{Levels, Sampling, sample_views};

/// Samples the feature maps of all views around projected reference points and averages over the views that see them.
///
/// `out[b, q, head m] = 1 / max(seen, 1) · Σ_{v visible} Σ_{l, p} weights · bilinear(values_l, reference + offset / size_l)`
/// with zeros outside. Offsets and weights belong to the query alone, so they are given once and not per view. No
/// gradient flows to `reference`.
///
/// # Shapes
/// - values: `[B, V, S, M, C]`; `S` is the sum of `H·W` over `shapes`
/// - shapes: (H, W) per level
/// - reference: `[B, V, Q, 2]`, (x, y) in unit coordinates: 0 and 1 are the outer borders of the image
/// - visible: `[B, V, Q]`; true where the view sees the query
/// - offsets: `[B, Q, M, L, P, 2]`, (x, y) in pixels of level `L`
/// - weights: `[B, Q, M, L, P]`
/// - output: `[B, Q, M·C]`; 0 where no view sees the query
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn deformable_views_2d(
    values: Tensor<5>,
    shapes: &[[usize; 2]],
    reference: Tensor<4>,
    visible: Tensor<3, Bool>,
    offsets: Tensor<6>,
    weights: Tensor<5>,
) -> Tensor<3> {
    sample_views(&Levels::maps(shapes, 0.5), Sampling { values, reference, visible, offsets, weights })
}

/// Samples one feature volume around the points of every view's rays.
///
/// `out[b, v, r, head m] = Σ_{l, p} weights · trilinear(values_l, reference + offset / size_l)` with zeros outside, and 0
/// where `valid` is false. No gradient flows to `reference`.
///
/// # Shapes
/// - values: `[B, S, M, C]`; `S` is the sum of `Z·Y·X` over `shapes`
/// - shapes: (Z, Y, X) per level
/// - reference: `[B, V, R, 3]`, (x, y, z) in unit coordinates: 0 and 1 are the outer borders of the volume
/// - valid: `[B, V, R]`
/// - offsets: `[B, V·R, M, L, P, 3]`, (x, y, z) in cells of level `L`; six axes are all that the ndarray backend has
/// - weights: `[B, V·R, M, L, P]`
/// - output: `[B, V, R, M·C]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn deformable_rays_3d(
    values: Tensor<4>,
    shapes: &[[usize; 3]],
    reference: Tensor<4>,
    valid: Tensor<3, Bool>,
    offsets: Tensor<6>,
    weights: Tensor<5>,
) -> Tensor<4> {
    let [b, s, m, c] = values.dims();
    let [_, v, r, axes] = reference.dims();
    // Every ray point is a query of its own, seen by the only "view" there is: the volume.
    let output = sample_views(
        &Levels::volumes(shapes, 0.5),
        Sampling {
            values: values.reshape([b, 1, s, m, c]),
            reference: reference.reshape([b, 1, v * r, axes]),
            visible: valid.reshape([b, 1, v * r]),
            offsets,
            weights,
        },
    );
    if r == 0 {
        // To `reshape` a size of 0 means that of the same axis before.
        return output.reshape([b, 0, v, m * c]).swap_dims(1, 2);
    }
    output.reshape([b, v, r, m * c])
}

/// Multi-scale deformable sampling of maps at absolute locations.
///
/// `out[n, q, head m] = Σ_{l, p} weights · bilinear(values_l, location)`, zeros outside, `align_corners = false`.
///
/// # Shapes
/// - values: `[N, S, M, C]`; `S` is the sum of `H·W` over `shapes`
/// - shapes: (H, W) per level
/// - locations: `[N, Q, M, L, P, 2]`, (x, y) in unit coordinates: 0 and 1 are the outer borders
/// - weights: `[N, Q, M, L, P]`
/// - mask: `[N, Q]`; queries where it is false give 0 and get no gradient
/// - output: `[N, Q, M·C]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn deformable_sample_2d(
    values: Tensor<4>,
    shapes: &[[usize; 2]],
    locations: Tensor<6>,
    weights: Tensor<5>,
    mask: Option<Tensor<2, Bool>>,
) -> Tensor<3> {
    sample_locations(&Levels::maps(shapes, 0.5), values, locations, weights, mask)
}

/// Multi-scale deformable sampling of volumes at absolute locations.
///
/// `out[n, q, head m] = Σ_{l, p} weights · trilinear(values_l, location)`, zeros outside, `align_corners = false`.
///
/// # Shapes
/// - values: `[N, S, M, C]`; `S` is the sum of `D·H·W` over `shapes`
/// - shapes: (D, H, W) per level
/// - locations: `[N, Q, M, L, P, 3]`, (x, y, z) in unit coordinates: 0 and 1 are the outer borders
/// - weights: `[N, Q, M, L, P]`
/// - mask: `[N, Q]`; queries where it is false give 0 and get no gradient
/// - output: `[N, Q, M·C]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn deformable_sample_3d(
    values: Tensor<4>,
    shapes: &[[usize; 3]],
    locations: Tensor<6>,
    weights: Tensor<5>,
    mask: Option<Tensor<2, Bool>>,
) -> Tensor<3> {
    sample_locations(&Levels::volumes(shapes, 0.5), values, locations, weights, mask)
}

/// A location is an offset from the border at 0, counted in pixels of its level.
fn sample_locations(
    levels: &Levels,
    values: Tensor<4>,
    locations: Tensor<6>,
    weights: Tensor<5>,
    mask: Option<Tensor<2, Bool>>,
) -> Tensor<3> {
    let [n, s, m, c] = values.dims();
    let [_, q, _, l, _, axes] = locations.dims();
    assert_eq!((l, axes), (levels.extents.len(), levels.axes), "locations [N, Q, M, L, P, d]");
    let device = locations.device();
    let sizes: Vec<f32> = levels.extents.iter().flat_map(|size| size[..axes].iter().map(|&size| size as f32)).collect();
    let sizes = Tensor::<1>::from_floats(sizes.as_slice(), &device).reshape([1, 1, 1, l, 1, axes]);
    let sampling = Sampling {
        values: values.reshape([n, 1, s, m, c]),
        reference: Tensor::zeros([n, 1, q, axes], &device),
        visible: match mask {
            Some(mask) => mask.reshape([n, 1, q]),
            None => Tensor::<3>::zeros([n, 1, q], &device).equal_elem(0.0),
        },
        offsets: locations * sizes,
        weights,
    };
    sample_views(levels, sampling)
}
