//! Sizes of CLIP's text encoders, under the names of their `config.json`.

use serde::{Deserialize, Serialize};

use super::TextError;

/// No text encoder is deeper; a depth read from a file is checked against it before anything is built.
const MAX_LAYERS: usize = 1024;

/// Between the two linear maps of a layer's MLP.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// `x · sigmoid(1.702 x)`: OpenAI's encoders.
    QuickGelu,
    /// Exact GELU: OpenCLIP's encoders.
    Gelu,
}

/// Which layer's output goes through the final norm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TextOutput {
    /// The last layer's.
    #[default]
    Last,
    /// That of the layer before the last. Published folders of Stable Diffusion 2.1 leave the last layer out and use
    /// [`TextOutput::Last`]; this is for files that still hold it.
    Penultimate,
}

/// Every size of a [`ClipTextModel`](super::ClipTextModel).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipTextConfig {
    /// Rows of the token table.
    pub vocab_size: usize,
    /// Width D.
    pub hidden_size: usize,
    /// Width inside the MLP.
    pub intermediate_size: usize,
    /// Layers.
    pub num_hidden_layers: usize,
    /// Heads; must divide the width.
    pub num_attention_heads: usize,
    /// Rows of the position table.
    pub max_position_embeddings: usize,
    /// Of the MLP.
    pub hidden_act: Activation,
    /// Of every norm.
    pub layer_norm_eps: f64,
    /// Width of CLIP's common space; not used here, but by other tools that open the folder.
    pub projection_dim: usize,
    /// What comes out.
    #[serde(default)]
    pub output: TextOutput,
}

impl ClipTextConfig {
    /// CLIP ViT-L/14, the text encoder of Stable Diffusion 1.5.
    #[must_use]
    pub fn sd15() -> Self {
        Self {
            vocab_size: 49_408,
            hidden_size: 768,
            intermediate_size: 3072,
            num_hidden_layers: 12,
            num_attention_heads: 12,
            max_position_embeddings: 77,
            hidden_act: Activation::QuickGelu,
            layer_norm_eps: 1e-5,
            projection_dim: 768,
            output: TextOutput::Last,
        }
    }

    /// The 23 layers of OpenCLIP ViT-H/14 that Stable Diffusion 2.1 uses.
    #[must_use]
    pub fn sd21() -> Self {
        Self {
            hidden_size: 1024,
            intermediate_size: 4096,
            num_hidden_layers: 23,
            num_attention_heads: 16,
            hidden_act: Activation::Gelu,
            projection_dim: 512,
            ..Self::sd15()
        }
    }

    /// The config, if it builds an encoder.
    ///
    /// # Errors
    /// [`TextError::Sizes`] for a size of 0, heads that do not divide the width, an absurd depth, an epsilon that is
    /// not positive.
    pub fn checked(self) -> Result<Self, TextError> {
        let sizes = [
            ("vocab_size", self.vocab_size),
            ("hidden_size", self.hidden_size),
            ("intermediate_size", self.intermediate_size),
            ("num_hidden_layers", self.num_hidden_layers),
            ("num_attention_heads", self.num_attention_heads),
            ("max_position_embeddings", self.max_position_embeddings),
        ];
        if let Some((name, _)) = sizes.iter().find(|(_, size)| *size == 0) {
            return Err(TextError::Sizes(format!("{name} must be at least 1")));
        }
        if !self.hidden_size.is_multiple_of(self.num_attention_heads) {
            let (heads, width) = (self.num_attention_heads, self.hidden_size);
            return Err(TextError::Sizes(format!("{heads} heads must divide width {width}")));
        }
        if self.num_hidden_layers > MAX_LAYERS {
            return Err(TextError::Sizes(format!("{} layers, at most {MAX_LAYERS}", self.num_hidden_layers)));
        }
        if !(self.layer_norm_eps.is_finite() && self.layer_norm_eps > 0.0) {
            return Err(TextError::Sizes(format!("layer_norm_eps {} must be positive", self.layer_norm_eps)));
        }
        Ok(self)
    }
}
