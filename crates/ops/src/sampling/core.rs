//! The one sampling operation behind every public function of this module, and its choice of implementation.

use burn::tensor::{Bool, Tensor};

use crate::fused::on_flex;

use super::{composed, native};

/// Sizes of the stacked maps that one value tensor holds, and where a pixel's centre lies.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Levels {
    /// Size of each level along (x, y, z); z is 1 for maps.
    pub extents: Vec<[usize; 3]>,
    /// Coordinates per point: 2 or 3.
    pub axes: usize,
    /// Position of pixel 0's centre, in pixels: 0.5 where 0 is the outer border, 0 where 0 is the first centre.
    pub centre: f32,
}

impl Levels {
    /// Levels of row-major maps with sizes (H, W).
    pub fn maps(shapes: &[[usize; 2]], centre: f32) -> Self {
        Self { extents: shapes.iter().map(|&[h, w]| [w, h, 1]).collect(), axes: 2, centre }
    }

    /// Levels of row-major volumes with sizes (D, H, W).
    pub fn volumes(shapes: &[[usize; 3]], centre: f32) -> Self {
        Self { extents: shapes.iter().map(|&[d, h, w]| [w, h, d]).collect(), axes: 3, centre }
    }

    /// Sites of one level.
    pub fn sites(&self, level: usize) -> usize {
        self.extents[level].iter().product()
    }

    /// First site of a level in the stacked order.
    pub fn start(&self, level: usize) -> usize {
        (0..level).map(|l| self.sites(l)).sum()
    }

    /// Sites of all levels, `S`.
    pub fn total(&self) -> usize {
        self.start(self.extents.len())
    }
}

/// Arguments of [`sample_views`].
#[derive(Debug, Clone)]
pub(crate) struct Sampling {
    /// Stacked maps `[N, V, S, M, C]`.
    pub values: Tensor<5>,
    /// Reference points `[N, V, Q, d]` in units of the map size; a constant.
    pub reference: Tensor<4>,
    /// `[N, V, Q]`, true where view V contributes to query Q.
    pub visible: Tensor<3, Bool>,
    /// Offsets `[N, Q, M, L, P, d]` in pixels of the level.
    pub offsets: Tensor<6>,
    /// Weights `[N, Q, M, L, P]`.
    pub weights: Tensor<5>,
}

impl Sampling {
    fn check(&self, levels: &Levels) {
        let [n, v, s, m, _] = self.values.dims();
        let [_, q, _, l, p, d] = self.offsets.dims();
        assert!(levels.extents.iter().flatten().all(|&size| size > 0), "a level of size 0: {:?}", levels.extents);
        assert_eq!(s, levels.total(), "values hold {s} sites, the level shapes {}", levels.total());
        assert_eq!(self.offsets.dims(), [n, q, m, levels.extents.len(), p, levels.axes], "offsets [N, Q, M, L, P, d]");
        assert_eq!(self.weights.dims(), [n, q, m, l, p], "weights [N, Q, M, L, P]");
        assert_eq!(self.reference.dims(), [n, v, q, d], "reference [N, V, Q, d]");
        assert_eq!(self.visible.dims(), [n, v, q], "visible [N, V, Q]");
    }
}

/// Mean over the visible views of the weighted sum of linear samples.
///
/// `output[n, q, m·C + c] = 1 / max(seen, 1) · Σ_{v visible, l, p} weights · value_l(reference · size_l + offset)`.
///
/// # Shapes
/// - output: `[N, Q, M·C]`
pub(crate) fn sample_views(levels: &Levels, sampling: Sampling) -> Tensor<3> {
    sampling.check(levels);
    let all = [on_flex(&sampling.values), on_flex(&sampling.offsets), on_flex(&sampling.weights)];
    if all == [true; 3] { native::sample_views(levels, sampling) } else { composed::sample_views(levels, sampling) }
}
