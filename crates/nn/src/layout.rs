//! Named reshapes: pictures and volumes to patches and back, channel order.
//!
//! Shapes: B batch, C channels, H W pixels, Z Y X cells, k patch size.

use burn::tensor::Tensor;

/// Cuts pictures into k×k patches.
///
/// # Shapes
/// - image: `[B, C, h·k, w·k]`
/// - output: `[B, h, w, C·k·k]`, the patch's numbers in (channel, row, column) order
pub fn patches_from_image(image: Tensor<4>, patch: usize) -> Tensor<4> {
    let [b, c, height, width] = image.dims();
    let (h, w) = (height / patch, width / patch);
    image.reshape([b, c, h, patch, w, patch]).permute([0, 2, 4, 1, 3, 5]).reshape([b, h, w, c * patch * patch])
}

/// Puts k×k patches back together.
///
/// # Shapes
/// - patches: `[B, h, w, C·k·k]`, numbers in (channel, row, column) order
/// - output: `[B, C, h·k, w·k]`
pub fn image_from_patches(patches: Tensor<4>, patch: usize) -> Tensor<4> {
    let [b, h, w, numbers] = patches.dims();
    let c = numbers / (patch * patch);
    patches.reshape([b, h, w, c, patch, patch]).permute([0, 3, 1, 4, 2, 5]).reshape([b, c, h * patch, w * patch])
}

/// Cuts volumes into k×k×k blocks.
///
/// # Shapes
/// - volume: `[B, C, z·k, y·k, x·k]`
/// - output: `[B, z, y, x, C·k³]`, the block's numbers in (channel, z, y, x) order
pub fn blocks_from_volume(volume: Tensor<5>, k: usize) -> Tensor<5> {
    let [b, c, depth, height, width] = volume.dims();
    let (z, y, x) = (depth / k, height / k, width / k);
    // One axis at a time: eight axes at once are more than some backends have.
    let slices = volume.reshape([b, c, z, k, height * width]).permute([0, 2, 1, 3, 4]);
    let rows = slices.reshape([b * z, c * k, y, k, width]).permute([0, 2, 1, 3, 4]);
    let blocks = rows.reshape([b * z * y, c * k * k, x, k]).permute([0, 2, 1, 3]);
    blocks.reshape([b, z, y, x, c * k * k * k])
}

/// `[B, C, H, W]` to `[B, H, W, C]`.
pub fn channels_last(image: Tensor<4>) -> Tensor<4> {
    image.permute([0, 2, 3, 1])
}

/// `[B, H, W, C]` to `[B, C, H, W]`.
pub fn channels_first(image: Tensor<4>) -> Tensor<4> {
    image.permute([0, 3, 1, 2])
}

/// `[B, C, Z, Y, X]` to `[B, Z, Y, X, C]`.
pub fn volume_channels_last(volume: Tensor<5>) -> Tensor<5> {
    volume.permute([0, 2, 3, 4, 1])
}

/// `[B, Z, Y, X, C]` to `[B, C, Z, Y, X]`.
pub fn volume_channels_first(volume: Tensor<5>) -> Tensor<5> {
    volume.permute([0, 4, 1, 2, 3])
}
