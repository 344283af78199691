//! Scene encoder: every voxel gathers features from the views that see it (section 4.2).
//!
//! Shapes: B batch, V views, Q voxels, C channels, M heads, L levels, P points, S pyramid pixels.

use burn::module::{Module, Param};
use burn::tensor::Tensor;
use nn::{Bias, Init, LayerNorm, Linear, Mlp, NORM_EPSILON, sincos_3d};

use crate::BevVaeConfig;
use crate::config::LEVELS;
use crate::pyramid::ImagePyramid;
use crate::sample_points::SamplePoints;

/// Deformable attention from voxels into the image pyramids of the views that see them; no value projection.
#[derive(Module, Debug)]
pub struct ViewAttention {
    /// C → M·L·P·2, pixels of the level in (x, y) order.
    pub offset: Linear,
    /// C → M·L·P logits.
    pub weight: Linear,
    /// C → C after the mean over views.
    pub out: Linear,
    heads: usize,
    points: usize,
}

impl ViewAttention {
    fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let (c, heads, points) = (config.scene.channels, config.scene.heads, config.scene.encoder_points);
        let samples = heads * LEVELS * points;
        Self {
            offset: Linear::new(c, samples * 2, Bias::Without, init),
            weight: Linear::new(c, samples, Bias::Without, init),
            out: Linear::new(c, c, Bias::Without, init),
            heads,
            points,
        }
    }

    /// # Shapes
    /// - query: `[B, Q, C]`
    /// - values: `[B, V, S, C]`
    /// - output: `[B, Q, C]`, 0 for voxels that no view sees
    fn forward(
        &self,
        query: Tensor<3>,
        values: Tensor<4>,
        voxels: &SamplePoints,
        levels: &[[usize; 2]; LEVELS],
    ) -> Tensor<3> {
        let [b, q, c] = query.dims();
        let [_, v, s, _] = values.dims();
        let (m, p) = (self.heads, self.points);
        let offsets = self.offset.forward(query.clone()).reshape([b, q, m, LEVELS, p, 2]);
        let weights = ops::softmax(self.weight.forward(query).reshape([b, q, m, LEVELS * p]));
        let gathered = ops::deformable_views_2d(
            values.reshape([b, v, s, m, c / m]),
            levels,
            voxels.reference.clone(),
            voxels.valid.clone(),
            offsets,
            weights.reshape([b, q, m, LEVELS, p]),
        );
        self.out.forward(gathered)
    }
}

/// voxel += attention(norm(voxel), norm(values)); voxel += mlp(norm(voxel)).
#[derive(Module, Debug)]
pub struct SceneEncoderBlock {
    /// Of the voxel queries.
    pub norm_query: LayerNorm,
    /// Of the pyramid, per block.
    pub norm_value: LayerNorm,
    /// Gathers from views.
    pub attention: ViewAttention,
    /// Before the MLP.
    pub norm_mlp: LayerNorm,
    /// Mixes channels.
    pub mlp: Mlp,
}

impl SceneEncoderBlock {
    fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let c = config.scene.channels;
        Self {
            norm_query: LayerNorm::new(c, NORM_EPSILON, init),
            norm_value: LayerNorm::new(c, NORM_EPSILON, init),
            attention: ViewAttention::new(config, init),
            norm_mlp: LayerNorm::new(c, NORM_EPSILON, init),
            mlp: Mlp::new(c, init),
        }
    }

    /// What attention adds to the voxels.
    pub fn attend(
        &self,
        voxels: Tensor<3>,
        values: Tensor<4>,
        points: &SamplePoints,
        levels: &[[usize; 2]; LEVELS],
    ) -> Tensor<3> {
        self.attention.forward(self.norm_query.forward(voxels), self.norm_value.forward(values), points, levels)
    }

    /// # Shapes
    /// - voxels: `[B, Q, C]`
    /// - values: `[B, V, S, C]`
    /// - output: `[B, Q, C]`
    pub fn forward(
        &self,
        voxels: Tensor<3>,
        values: Tensor<4>,
        points: &SamplePoints,
        levels: &[[usize; 2]; LEVELS],
    ) -> Tensor<3> {
        let voxels = voxels.clone() + self.attend(voxels, values, points, levels);
        voxels.clone() + self.mlp.forward(self.norm_mlp.forward(voxels))
    }
}

/// Image features of all views to one voxel grid.
#[derive(Module, Debug)]
pub struct SceneEncoder {
    /// Upsamples the image tokens.
    pub pyramid: ImagePyramid,
    /// One learned query per pillar, `[Y·X, C]`, row-major; its heights differ by the position code.
    pub pillar_query: Param<Tensor<2>>,
    /// In order.
    pub blocks: Vec<SceneEncoderBlock>,
    /// After the last block.
    pub norm: LayerNorm,
}

impl SceneEncoder {
    /// Sizes from the config; queries N(0, 0.5²).
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let [_, y, x] = config.grid.cells;
        let c = config.scene.channels;
        Self {
            pyramid: ImagePyramid::new(config, init),
            pillar_query: init.normal([y * x, c], 0.5),
            blocks: (0..config.scene.encoder_blocks).map(|_| SceneEncoderBlock::new(config, init)).collect(),
            norm: LayerNorm::new(c, NORM_EPSILON, init),
        }
    }

    /// # Shapes
    /// - features: `[B·V, E, h, w]`
    /// - points: of `[B, V, Q]` voxels
    /// - output: `[B, C, Z, Y, X]`
    pub fn forward(&self, features: Tensor<4>, points: &SamplePoints, config: &BevVaeConfig) -> Tensor<5> {
        let [b, v, _] = points.valid.dims();
        let values = flatten_levels(self.pyramid.forward(features), b, v);
        let levels = config.image_levels();
        let start = self.queries(b, config);
        let voxels = self.blocks.iter().fold(start, |x, block| block.forward(x, values.clone(), points, &levels));
        let [z, y, x] = config.grid.cells;
        let c = config.scene.channels;
        self.norm.forward(voxels).swap_dims(1, 2).reshape([b, c, z, y, x])
    }

    /// The voxels before the first block, `[B, Q, C]`.
    pub fn queries(&self, batch: usize, config: &BevVaeConfig) -> Tensor<3> {
        let table = self.pillar_query.val();
        let code = sincos_3d(config.grid.cells, config.scene.channels, &table.device());
        let queries = table.repeat_dim(0, config.grid.cells[0]) + code;
        queries.unsqueeze::<3>().repeat_dim(0, batch)
    }
}

/// Pyramid levels one after another, channels last: `[B·V, C, h_l, w_l]` to `[B, V, S, C]`.
pub fn flatten_levels(levels: [Tensor<4>; 3], batch: usize, views: usize) -> Tensor<4> {
    let flat = levels.map(|level| {
        let [_, c, h, w] = level.dims();
        level.reshape([batch, views, c, h * w]).swap_dims(2, 3)
    });
    Tensor::cat(flat.to_vec(), 2)
}
