//! The whole transformer.

use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use nn::{Bias, Init, Linear, PatchConv2d};

use crate::block::{DitBlock, modulated, split_modulation};
use crate::condition::{LabelEmbedding, LayoutEmbedding};
use crate::config::{ConditionConfig, DitConfig};
use crate::embedding::{TimestepEmbedding, position_code};

/// What a batch is steered by.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant)] // One per forward pass.
pub enum Condition<'a> {
    /// Boxes as occupancy, for a network with [`ConditionConfig::Layout`].
    Layout {
        /// `[B, K, Z, p·h, p·w]`, 0 or 1
        occupancy: Tensor<5>,
        /// s of each sample: its layout vectors times s are added to the tokens. 1 conditions, 0 leaves the layout out.
        strength: &'a [f64],
    },
    /// One class per sample, `None` for none, for a network with [`ConditionConfig::Labels`].
    Labels(&'a [Option<usize>]),
}

/// Shift and scale by the condition, then linear to the patch's numbers.
#[derive(Module, Debug)]
pub struct LastLayer {
    /// D→2D: shift, scale. Starts as 0.
    pub modulation: Linear,
    /// D→p²·C', numbers of a patch in (row, column, channel) order. Starts as 0.
    pub linear: Linear,
}

/// The transformer.
#[derive(Module, Debug)]
pub struct Dit {
    /// Cells to tokens.
    pub patch: PatchConv2d,
    /// The noise level.
    pub timestep: TimestepEmbedding,
    /// Boxes, where they steer.
    pub layout: Option<LayoutEmbedding>,
    /// Classes, where they steer.
    pub label: Option<LabelEmbedding>,
    /// In order.
    pub blocks: Vec<DitBlock>,
    /// Tokens to the output.
    pub last: LastLayer,
    #[module(skip)]
    config: DitConfig,
}

impl Dit {
    /// A network with fresh parameters, which gives 0 for any input; `config` must be checked.
    pub fn new(config: &DitConfig, init: &mut Init) -> Self {
        let (d, p) = (config.width, config.patch);
        let mut patch = PatchConv2d::new(config.latent_channels, d, p, init);
        let bound = (6.0 / (config.latent_channels * p * p + d) as f64).sqrt();
        patch.weight = init.uniform([d, config.latent_channels, p, p], bound);
        patch.bias = init.constant([d], 0.0);
        let (layout, label) = match config.condition {
            ConditionConfig::Layout { classes, slices, patch } => {
                (Some(LayoutEmbedding::new(classes, slices, patch, d, init)), None)
            }
            ConditionConfig::Labels { classes } => (None, Some(LabelEmbedding::new(classes, d, init))),
        };
        Self {
            patch,
            timestep: TimestepEmbedding::new(d, init),
            layout,
            label,
            blocks: (0..config.depth).map(|_| DitBlock::new(d, config.heads, init)).collect(),
            last: LastLayer {
                modulation: Linear::zeros(d, 2 * d, Bias::With, init),
                linear: Linear::zeros(d, p * p * config.output_channels(), Bias::With, init),
            },
            config: config.clone(),
        }
    }

    /// The sizes it was built with.
    pub fn config(&self) -> &DitConfig {
        &self.config
    }

    /// The network's prediction for noisy latents.
    ///
    /// # Shapes
    /// - x: `[B, C, H, W]`
    /// - timesteps: length B, in steps of the training schedule
    /// - output: `[B, C', H, W]`, C' twice C where the variance is learned
    ///
    /// # Panics
    /// If shapes or the kind of condition disagree with the config.
    pub fn forward(&self, x: Tensor<4>, timesteps: &[f64], condition: &Condition<'_>) -> Tensor<4> {
        let device = x.device();
        assert_eq!(timesteps.len(), x.dims()[0], "one timestep per sample");
        let tokens = self.tokens(x);
        let (tokens, c) = self.steer(tokens, self.timestep.forward(timesteps, &device), condition);
        let tokens = self.blocks.iter().fold(tokens, |tokens, block| block.forward(tokens, c.clone()));
        self.unpatched(tokens, c)
    }

    /// Norm of the layout's vectors over that of the tokens they are added to, `[1]`: whether the condition is alive. `None` for a network
    /// without layouts.
    ///
    /// # Shapes
    /// - x: `[B, C, H, W]`
    /// - occupancy: `[B, K, Z, p·h, p·w]`
    ///
    /// # Panics
    /// If shapes disagree with the config.
    pub fn layout_share(&self, x: Tensor<4>, occupancy: Tensor<5>) -> Option<Tensor<1>> {
        let norm = |vectors: Tensor<3>| vectors.square().sum().sqrt();
        let layout = self.layout.as_ref()?;
        Some(norm(layout.forward(occupancy)) / norm(self.tokens(x)))
    }

    /// Cells with their place, `[B, N, D]`.
    fn tokens(&self, x: Tensor<4>) -> Tensor<3> {
        let [b, c, rows, columns] = x.dims();
        let expected = (self.config.latent_channels, self.config.latent_size);
        assert_eq!((c, [rows, columns]), expected, "latent channels and cells");
        let [h, w] = self.config.token_grid();
        let d = self.config.width;
        let code: Vec<f32> = position_code([h, w], d).into_iter().map(|v| v as f32).collect();
        let code = Tensor::<3>::from_data(TensorData::new(code, [1, h * w, d]), &x.device());
        self.patch.forward(x).reshape([b, h * w, d]) + code
    }

    /// Adds the condition to the tokens or to the time vector.
    fn steer(&self, tokens: Tensor<3>, time: Tensor<2>, condition: &Condition<'_>) -> (Tensor<3>, Tensor<2>) {
        let b = tokens.dims()[0];
        match (condition, &self.layout, &self.label) {
            (Condition::Layout { occupancy, strength }, Some(layout), _) => {
                assert_eq!((occupancy.dims()[0], strength.len()), (b, b), "one layout and one strength per sample");
                let strength: Vec<f32> = strength.iter().map(|&s| s as f32).collect();
                let strength = Tensor::<3>::from_data(TensorData::new(strength, [b, 1, 1]), &tokens.device());
                (tokens + layout.forward(occupancy.clone()) * strength, time)
            }
            (Condition::Labels(labels), _, Some(label)) => {
                assert_eq!(labels.len(), b, "one label per sample");
                (tokens, time + label.forward(labels))
            }
            _ => panic!("the network is steered by {:?}", self.config.condition),
        }
    }

    /// Tokens `[B, N, D]` to `[B, C', H, W]`.
    fn unpatched(&self, tokens: Tensor<3>, c: Tensor<2>) -> Tensor<4> {
        let b = tokens.dims()[0];
        let ([h, w], p, channels) = (self.config.token_grid(), self.config.patch, self.config.output_channels());
        let [shift, scale] = split_modulation(&self.last.modulation, c);
        let patches = self.last.linear.forward(modulated(tokens, shift, scale));
        let patches = patches.reshape([b, h, w, p * p, channels]).swap_dims(3, 4);
        nn::layout::image_from_patches(patches.reshape([b, h, w, channels * p * p]), p)
    }
}
