//! Scene decoder: the rays of any camera gather features from the voxel grid (section 4.6).
//!
//! The queries are the same for every camera; a camera enters only through the points where its rays fall in the grid.
//! Shapes: B batch, V target views, D depths, R rays (h·w), C channels, M heads, L levels, P points, S pyramid voxels.

use burn::module::{Module, Param};
use burn::tensor::activation::softmax;
use burn::tensor::{Bool, Tensor};
use nn::{Bias, Init, LayerNorm, Linear, Mlp, NORM_EPSILON, sincos_3d};

use crate::BevVaeConfig;
use crate::config::LEVELS;
use crate::pyramid::ScenePyramid;
use crate::sample_points::SamplePoints;

/// Logit of a depth outside the grid; finite, so that a ray without any valid depth does not become NaN.
const MASKED_LOGIT: f64 = -1e30;

/// Deformable attention from ray points into the scene pyramid, then a weighted sum over the ray's depths.
#[derive(Module, Debug)]
pub struct RayAttention {
    /// C → M·L·P·3, cells of the level in (x, y, z) order.
    pub offset: Linear,
    /// C → M·L·P logits.
    pub weight: Linear,
    /// C → 1: logit of a depth on its ray.
    pub depth: Linear,
    /// C → C after the sum over depths.
    pub out: Linear,
    heads: usize,
    points: usize,
}

impl RayAttention {
    fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let (c, heads, points) = (config.scene.channels, config.scene.heads, config.scene.decoder_points);
        let samples = heads * LEVELS * points;
        Self {
            offset: Linear::new(c, samples * 3, Bias::Without, init),
            weight: Linear::new(c, samples, Bias::Without, init),
            depth: Linear::new(c, 1, Bias::Without, init),
            out: Linear::new(c, c, Bias::Without, init),
            heads,
            points,
        }
    }

    /// # Shapes
    /// - query: `[B, V, D·R, C]`
    /// - values: `[B, S, C]`
    /// - output: `[B, V, R, C]`, one vector per ray; 0 for a ray with no depth inside the grid
    fn forward(
        &self,
        query: Tensor<4>,
        values: Tensor<3>,
        rays: &SamplePoints,
        levels: &[[usize; 3]; LEVELS],
        depths: usize,
    ) -> Tensor<4> {
        let [b, v, n, c] = query.dims();
        let [_, s, _] = values.dims();
        let (m, p) = (self.heads, self.points);
        let offsets = self.offset.forward(query.clone()).reshape([b, v * n, m, LEVELS, p, 3]);
        let weights = ops::softmax(self.weight.forward(query.clone()).reshape([b, v, n, m, LEVELS * p]));
        let gathered = ops::deformable_rays_3d(
            values.reshape([b, s, m, c / m]),
            levels,
            rays.reference.clone(),
            rays.valid.clone(),
            offsets,
            weights.reshape([b, v * n, m, LEVELS, p]),
        );
        let rays_per_view = n / depths;
        let logits = self.depth.forward(query).reshape([b * v, depths, rays_per_view]);
        let share = depth_weights(logits, rays.valid.clone().reshape([b * v, depths, rays_per_view]));
        let gathered = gathered.reshape([b * v, depths, rays_per_view, c]);
        let summed = ops::sum_dim(gathered * share.unsqueeze_dim::<4>(3), 1);
        self.out.forward(summed.reshape([b, v, rays_per_view, c]))
    }
}

/// Softmax over the valid depths of each ray; all zeros where a ray has none.
///
/// # Shapes
/// - logits, valid, output: `[N, D, R]`
pub fn depth_weights(logits: Tensor<3>, valid: Tensor<3, Bool>) -> Tensor<3> {
    let outside = valid.bool_not();
    let shares = softmax(logits.mask_fill(outside.clone(), MASKED_LOGIT), 1);
    shares.mask_fill(outside, 0.0)
}

/// ray points += attention(norm(points), norm(values)) of their ray; points += mlp(norm(points)).
#[derive(Module, Debug)]
pub struct SceneDecoderBlock {
    /// Of the ray points.
    pub norm_query: LayerNorm,
    /// Of the pyramid, per block.
    pub norm_value: LayerNorm,
    /// Gathers from the grid.
    pub attention: RayAttention,
    /// Before the MLP.
    pub norm_mlp: LayerNorm,
    /// Mixes channels.
    pub mlp: Mlp,
}

impl SceneDecoderBlock {
    fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let c = config.scene.channels;
        Self {
            norm_query: LayerNorm::new(c, NORM_EPSILON, init),
            norm_value: LayerNorm::new(c, NORM_EPSILON, init),
            attention: RayAttention::new(config, init),
            norm_mlp: LayerNorm::new(c, NORM_EPSILON, init),
            mlp: Mlp::new(c, init),
        }
    }

    /// What attention adds to every depth of a ray, `[B, V, R, C]`.
    pub fn attend(
        &self,
        points: Tensor<4>,
        values: Tensor<3>,
        rays: &SamplePoints,
        levels: &[[usize; 3]; LEVELS],
        depths: usize,
    ) -> Tensor<4> {
        self.attention.forward(self.norm_query.forward(points), self.norm_value.forward(values), rays, levels, depths)
    }

    /// # Shapes
    /// - points: `[B, V, D·R, C]`
    /// - values: `[B, S, C]`
    /// - output: `[B, V, D·R, C]`
    pub fn forward(
        &self,
        points: Tensor<4>,
        values: Tensor<3>,
        rays: &SamplePoints,
        levels: &[[usize; 3]; LEVELS],
        depths: usize,
    ) -> Tensor<4> {
        let [b, v, n, c] = points.dims();
        let ray = self.attend(points.clone(), values, rays, levels, depths);
        let per_depth = points.reshape([b, v, depths, n / depths, c]) + ray.unsqueeze_dim::<5>(2);
        let points = per_depth.reshape([b, v, n, c]);
        points.clone() + self.mlp.forward(self.norm_mlp.forward(points))
    }
}

/// A voxel grid to image features of any number of cameras.
#[derive(Module, Debug)]
pub struct SceneDecoder {
    /// Downsamples the grid.
    pub pyramid: ScenePyramid,
    /// One learned query per ray, `[h·w, C]`, row-major; its depths differ by the position code.
    pub ray_query: Param<Tensor<2>>,
    /// In order.
    pub blocks: Vec<SceneDecoderBlock>,
    /// After the mean over depths.
    pub norm: LayerNorm,
    /// C → E
    pub out: Linear,
}

impl SceneDecoder {
    /// Sizes from the config; queries N(0, 0.5²).
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let c = config.scene.channels;
        Self {
            pyramid: ScenePyramid::new(config, init),
            ray_query: init.normal([config.frustum.rows * config.frustum.columns, c], 0.5),
            blocks: (0..config.scene.decoder_blocks).map(|_| SceneDecoderBlock::new(config, init)).collect(),
            norm: LayerNorm::new(c, NORM_EPSILON, init),
            out: Linear::new(c, config.image.channels, Bias::With, init),
        }
    }

    /// # Shapes
    /// - scene: `[B, C, Z, Y, X]`
    /// - rays: of `[B, V, D·R]` frustum points
    /// - output: `[B·V, R, E]`
    pub fn forward(&self, scene: Tensor<5>, rays: &SamplePoints, config: &BevVaeConfig) -> Tensor<3> {
        let values = flatten_volumes(self.pyramid.forward(scene));
        let levels = config.scene_levels();
        let [b, v, _] = rays.valid.dims();
        let depths = config.frustum.depths;
        let points = self.blocks.iter().fold(self.queries(b, v, config), |points, block| {
            block.forward(points, values.clone(), rays, &levels, depths)
        });
        self.out.forward(self.collapse(points, depths))
    }

    /// The ray points before the first block, `[B, V, D·R, C]`.
    pub fn queries(&self, batch: usize, views: usize, config: &BevVaeConfig) -> Tensor<4> {
        let frustum = config.frustum;
        let table = self.ray_query.val();
        let cells = [frustum.depths, frustum.rows, frustum.columns];
        let code = sincos_3d(cells, config.scene.channels, &table.device());
        let queries = table.repeat_dim(0, frustum.depths) + code;
        queries.unsqueeze::<4>().repeat_dim(0, batch).repeat_dim(1, views)
    }

    /// Mean over depths and norm: `[B, V, D·R, C]` to `[B·V, R, C]`.
    pub fn collapse(&self, points: Tensor<4>, depths: usize) -> Tensor<3> {
        let [b, v, n, c] = points.dims();
        let rays = n / depths;
        let mean = ops::mean_dim(points.reshape([b * v, depths, rays, c]), 1).reshape([b * v, rays, c]);
        self.norm.forward(mean)
    }
}

/// Pyramid levels one after another, channels last: `[B, C, z_l, y_l, x_l]` to `[B, S, C]`.
pub fn flatten_volumes(levels: [Tensor<5>; 3]) -> Tensor<3> {
    let flat = levels.map(|level| {
        let [b, c, z, y, x] = level.dims();
        level.reshape([b, c, z * y * x]).swap_dims(1, 2)
    });
    Tensor::cat(flat.to_vec(), 1)
}
