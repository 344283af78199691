//! The low-rank matrices beside one weight, and what they add to its output.

use burn::module::{Module, Param};
use burn::tensor::Tensor;

/// One adapter of one weight: `y += weight · alpha / rank · B (A x)`.
#[derive(Module, Debug)]
pub struct LowRank {
    /// A: `[rank, in]`, or `[rank, in·kh·kw]` for a convolution.
    pub down: Param<Tensor<2>>,
    /// B: `[out, rank]`.
    pub up: Param<Tensor<2>>,
    name: String,
    alpha: f64,
    weight: f64,
}

impl LowRank {
    pub(super) fn new(name: &str, down: Param<Tensor<2>>, up: Param<Tensor<2>>, alpha: f64) -> Self {
        Self { down, up, name: name.to_owned(), alpha, weight: 1.0 }
    }

    /// The adapter's name, the same at all its sites.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Inner width.
    #[must_use]
    pub fn rank(&self) -> usize {
        self.down.lazy_shape()[0]
    }

    /// The constant that belongs to the trained matrices.
    #[must_use]
    pub fn alpha(&self) -> f64 {
        self.alpha
    }

    /// What multiplies `B (A x)`.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.weight * self.alpha / self.rank() as f64
    }

    pub(super) fn set_weight(&mut self, weight: f64) {
        self.weight = weight;
    }

    /// `scale · B A`, `[out, in·kh·kw]`.
    fn dense(&self) -> Tensor<2> {
        self.up.val().matmul(self.down.val()) * self.scale()
    }
}

/// All adapters of one weight, in the order of their attachment; usually none.
///
/// A layer that owns a weight keeps this beside it and computes through [`Adapters::add_to_rows`] or
/// [`Adapters::add_to_conv2d`].
#[derive(Module, Debug)]
pub struct Adapters {
    /// In the order of attachment.
    pub stack: Vec<LowRank>,
    /// Base plus all adapters, `[out, in·kh·kw]`, while merged. The base itself stays untouched beside it.
    merged: Option<Tensor<2>>,
}

impl Adapters {
    /// A weight as it is.
    #[must_use]
    pub fn none() -> Self {
        Self { stack: Vec::new(), merged: None }
    }

    /// Whether the layer computes with base and adapters in one matrix.
    #[must_use]
    pub fn is_merged(&self) -> bool {
        self.merged.is_some()
    }

    /// The matrix to compute with, `[out, in·kh·kw]`: the base, or the merged one.
    #[must_use]
    pub fn matrix<const D: usize>(&self, base: &Param<Tensor<D>>) -> Tensor<2> {
        match &self.merged {
            Some(merged) => merged.clone(),
            None => base.val().flatten_rows(),
        }
    }

    /// As [`Adapters::matrix`], `[out, in, kh, kw]`.
    #[must_use]
    pub fn kernel(&self, base: &Param<Tensor<4>>) -> Tensor<4> {
        match &self.merged {
            Some(merged) => merged.clone().reshape(base.dims()),
            None => base.val(),
        }
    }

    /// Adapters that add something: those with a scale, unless they are in the merged matrix already.
    fn acting(&self) -> impl Iterator<Item = &LowRank> {
        let stack = if self.is_merged() { &[][..] } else { &self.stack };
        stack.iter().filter(|adapter| adapter.scale() != 0.0)
    }

    /// `base(x)` plus what the adapters add, over the last axis. Without acting adapters it is `base(x)` to the bit.
    ///
    /// # Shapes
    /// - x: `[.., in]`
    /// - output: `[.., out]`
    pub fn add_to_rows<const D: usize>(&self, x: Tensor<D>, base: impl FnOnce(Tensor<D>) -> Tensor<D>) -> Tensor<D> {
        // A second handle to x would keep the base layer from working in place.
        if self.acting().next().is_none() {
            return base(x);
        }
        let y = base(x.clone());
        let (mut dims, rows) = (y.dims(), x.flatten_to_rows());
        let sum = self.acting().map(|adapter| {
            let low = ops::linear(rows.clone(), adapter.down.val(), None) * adapter.scale();
            ops::linear(low, adapter.up.val(), None)
        });
        let Some(added) = sum.reduce(|a, b| a + b) else { return y };
        dims[D - 1] = added.dims()[1];
        y + added.reshape(dims)
    }

    /// As [`Adapters::add_to_rows`] for a convolution with this kernel size, stride and padding: A is a convolution of the same kind
    /// to `rank` channels, B a 1×1 convolution.
    ///
    /// # Shapes
    /// - x: `[B, in, H, W]`
    /// - output: `[B, out, H', W']`
    pub fn add_to_conv2d(
        &self,
        x: Tensor<4>,
        (kernel, stride, padding): ([usize; 2], [usize; 2], [usize; 2]),
        base: impl FnOnce(Tensor<4>) -> Tensor<4>,
    ) -> Tensor<4> {
        if self.acting().next().is_none() {
            return base(x);
        }
        let y = base(x.clone());
        let channels = x.dims()[1];
        self.acting().fold(y, |y, adapter| {
            let (rank, out) = (adapter.rank(), adapter.up.lazy_shape()[0]);
            let down = adapter.down.val().reshape([rank, channels, kernel[0], kernel[1]]);
            let low = ops::conv2d(x.clone(), down, None, stride, padding) * adapter.scale();
            let up = adapter.up.val().reshape([out, rank, 1, 1]);
            y + ops::conv2d(low, up, None, [1; 2], [0; 2])
        })
    }

    /// Computes the merged matrix anew from the base; without adapters there is none.
    pub(super) fn merge(&mut self, base: Tensor<2>) {
        self.merged = None;
        if !self.stack.is_empty() {
            let merged = self.stack.iter().filter(|adapter| adapter.scale() != 0.0).fold(base, |m, a| m + a.dense());
            self.merged = Some(merged.detach());
        }
    }

    pub(super) fn unmerge(&mut self) {
        self.merged = None;
    }
}

/// Tensors seen as matrices.
trait Rows {
    /// First axis against all others.
    fn flatten_rows(self) -> Tensor<2>;
    /// All axes but the last against the last.
    fn flatten_to_rows(self) -> Tensor<2>;
}

impl<const D: usize> Rows for Tensor<D> {
    fn flatten_rows(self) -> Tensor<2> {
        let dims = self.dims();
        self.reshape([dims[0], dims[1..].iter().product()])
    }

    fn flatten_to_rows(self) -> Tensor<2> {
        let dims = self.dims();
        self.reshape([dims[..D - 1].iter().product(), dims[D - 1]])
    }
}
