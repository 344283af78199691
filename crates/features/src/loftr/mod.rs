//! LoFTR's coarse path: dense features of two grey images that have looked at each other, and how surely their cells match.
//!
//! Paper: Sun et al., "LoFTR: Detector-Free Local Feature Matching with Transformers", sections 3.1 to 3.3, dual softmax.
//! Parity: `tests/it/loftr.rs`. Shapes: N pairs, L and S cells of the first and second image (an eighth of the size, row by row).
//! The refinement to sub-pixel places (section 3.4) is not here: confidences do not need it.

mod backbone;
mod matching;
mod transformer;

use std::path::Path;

use burn::tensor::{Device, Tensor};
use nn::weights::{WeightError, WeightFile};

use crate::frozen::{NORM_COUNTER, Values, load_strict};
use backbone::Backbone;
use transformer::{CoarseTransformer, position_code};

pub use matching::{LoftrMatch, MatchRules, mutual_matches};

/// Pixels per cell.
pub const LOFTR_CELL: usize = 8;

/// Channels of a coarse feature.
const WIDTH: usize = 256;

/// Similarities are divided by this before the softmax.
const TEMPERATURE: f64 = 0.1;

/// Parameters of the refinement.
const REFINEMENT: [&str; 6] = [
    "fine_preprocess.",
    "loftr_fine.",
    "backbone.layer1_outconv.",
    "backbone.layer1_outconv2.",
    "backbone.layer2_outconv.",
    "backbone.layer2_outconv2.",
];

/// Frozen LoFTR in the outdoor configuration.
///
/// The order of the two images matters: in a cross layer the second one attends to the first one's new features.
#[derive(Debug, Clone)]
pub struct Loftr {
    backbone: Backbone,
    transformer: CoarseTransformer,
}

impl Loftr {
    /// Loads `loftr_outdoor.ckpt`, or the same names as safetensors. A leading `matcher.` is taken off.
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, and [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name;
    /// those of the refinement may be there.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(path)?.without_prefix("matcher.");
        let unused =
            |name: &str| name.ends_with(NORM_COUNTER) || REFINEMENT.iter().any(|prefix| name.starts_with(prefix));
        load_strict(&file, device, unused, Self::read)
    }

    /// Builds the network from `values(name, shape)`.
    ///
    /// # Errors
    /// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
    pub fn from_values(
        device: &Device,
        mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
    ) -> Result<Self, WeightError> {
        Self::read(&mut Values::new(device, &mut values))
    }

    fn read(values: &mut Values<'_>) -> Result<Self, WeightError> {
        Ok(Self { backbone: Backbone::read(values)?, transformer: CoarseTransformer::read(values)? })
    }

    /// Features at an eighth of the size, before the position code.
    ///
    /// # Shapes
    /// - images: `[N, 1, H, W]`, grey in [0, 1], H and W divisible by 8
    /// - output: `[N, 256, H / 8, W / 8]`
    #[must_use]
    pub fn backbone(&self, images: Tensor<4>) -> Tensor<4> {
        let [_, colours, height, width] = images.dims();
        assert_eq!(colours, 1, "LoFTR looks at grey images");
        assert!(
            height % LOFTR_CELL == 0 && width % LOFTR_CELL == 0,
            "{height}×{width} is not divisible by {LOFTR_CELL}"
        );
        self.backbone.forward(images)
    }

    /// Backbone features with the position code added.
    #[must_use]
    pub fn positioned(&self, features: Tensor<4>) -> Tensor<4> {
        let [_, _, rows, columns] = features.dims();
        let code = position_code(rows, columns, &features.device());
        features + code
    }

    /// Coarse features of both images after the transformer.
    ///
    /// # Shapes
    /// - first, second: `[N, 1, H, W]`, grey in [0, 1], sides divisible by 8
    /// - output: `[N, L, 256]`, `[N, S, 256]`
    #[must_use]
    pub fn coarse_features(&self, first: Tensor<4>, second: Tensor<4>) -> (Tensor<3>, Tensor<3>) {
        let [first, second] = [first, second].map(|images| cells(self.positioned(self.backbone(images))));
        self.transformer.forward(first, second)
    }

    /// ⟨a, b⟩ / (0.1 · 256) of all pairs of cells.
    ///
    /// # Shapes
    /// - output: `[N, L, S]`
    #[must_use]
    pub fn similarity(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<3> {
        let (a, b) = self.coarse_features(first, second);
        a.matmul(b.swap_dims(1, 2)) / (TEMPERATURE * WIDTH as f64)
    }

    /// Softmax over the second image's cells times softmax over the first one's.
    ///
    /// # Shapes
    /// - output: `[N, L, S]`, in [0, 1]
    #[must_use]
    pub fn confidence(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<3> {
        let similarity = self.similarity(first, second);
        let over_first = ops::softmax(similarity.clone().swap_dims(1, 2)).swap_dims(1, 2);
        ops::softmax(similarity) * over_first
    }
}

/// `[N, C, h, w]` as `[N, h·w, C]`.
fn cells(map: Tensor<4>) -> Tensor<3> {
    let [images, channels, rows, columns] = map.dims();
    map.reshape([images, channels, rows * columns]).swap_dims(1, 2)
}
