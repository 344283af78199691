//! Sums along one axis whose gradients are right on every backend.

use burn::tensor::Tensor;

/// Sum along an axis, which stays with extent 1.
///
/// burn's own gradient sums what comes back once more along that axis of extent 1. Its GPU kernels (burn 0.22.1) give a wrong result there when
/// the incoming gradient is a permuted view of an even length. Here it arrives in plain order.
#[must_use]
pub fn sum_dim<const D: usize>(x: Tensor<D>, axis: usize) -> Tensor<D> {
    #[allow(clippy::disallowed_methods)] // This is what they are to be replaced by.
    in_plain_order(x.sum_dim(axis))
}

/// Mean along an axis, which stays with extent 1. See [`sum_dim`].
#[must_use]
pub fn mean_dim<const D: usize>(x: Tensor<D>, axis: usize) -> Tensor<D> {
    #[allow(clippy::disallowed_methods)] // This is what they are to be replaced by.
    in_plain_order(x.mean_dim(axis))
}

/// The same tensor. Going back, the flat form in between makes the gradient row-major.
fn in_plain_order<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let dims = x.dims();
    x.reshape([dims.iter().product::<usize>()]).reshape(dims)
}
