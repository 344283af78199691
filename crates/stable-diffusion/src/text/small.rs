//! A small text encoder that is trained from scratch with the network it conditions.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Init, LayerNorm, lora_sites};
use serde::{Deserialize, Serialize};

use super::transformer::{Embeddings, Encoder, LayerSizes};
use super::{Activation, ClipTokenizer, TextError, TextStates, TokenBatch, Tokenizer, tokenizer::WordTokenizer};

/// Widening of the MLP.
const MLP_RATIO: usize = 4;

/// Sizes of a [`SmallTextEncoder`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SmallTextConfig {
    /// Width D of states; what the UNet takes as context.
    pub width: usize,
    /// Layers.
    pub layers: usize,
    /// Heads; must divide the width.
    pub heads: usize,
    /// Tokens per text, begin and end included; a caption takes about one per word.
    pub tokens: usize,
}

impl Default for SmallTextConfig {
    /// Fits the `tiny` networks.
    fn default() -> Self {
        Self { width: 64, layers: 2, heads: 4, tokens: 64 }
    }
}

impl SmallTextConfig {
    /// The config, if it builds an encoder.
    ///
    /// # Errors
    /// [`TextError::Sizes`]
    pub fn checked(self) -> Result<Self, TextError> {
        let refuse = |reason: String| Err(TextError::Sizes(reason));
        if self.width == 0 || self.layers == 0 || self.heads == 0 || self.tokens < 2 {
            return refuse(format!("{self:?}: at least one of each, and two tokens"));
        }
        if !self.width.is_multiple_of(self.heads) {
            return refuse(format!("{} heads must divide width {}", self.heads, self.width));
        }
        Ok(self)
    }

    /// CLIP's byte pairs if there are any, else hashed words.
    #[must_use]
    pub fn tokenizer(&self, clip: Option<ClipTokenizer>) -> Tokenizer {
        match clip {
            Some(clip) => Tokenizer::Clip(Box::new(clip.with_context(self.tokens))),
            None => Tokenizer::Words(WordTokenizer::new(self.tokens)),
        }
    }
}

/// Pre-norm transformer; each token sees all tokens of its text, and none sees padding.
#[derive(Module, Debug)]
pub struct SmallTextEncoder {
    /// Tokens and positions.
    pub embeddings: Embeddings,
    /// Layers.
    pub encoder: Encoder,
    /// Behind the last layer.
    pub final_layer_norm: LayerNorm,
}

lora_sites!(SmallTextEncoder { encoder });

impl SmallTextEncoder {
    /// Fresh weights for checked sizes and the vocabulary of [`SmallTextConfig::tokenizer`].
    pub fn new(config: &SmallTextConfig, vocabulary: usize, init: &mut Init) -> Self {
        let epsilon = 1e-5;
        let SmallTextConfig { width, layers, heads, tokens } = *config;
        let sizes = LayerSizes { width, inner: MLP_RATIO * width, heads, activation: Activation::Gelu, epsilon };
        Self {
            embeddings: Embeddings::new(vocabulary, tokens, width, init),
            encoder: Encoder::new(layers, sizes, init),
            final_layer_norm: LayerNorm::with_bias(width, epsilon, init),
        }
    }

    /// States of all places, padding included, and of the end token.
    ///
    /// # Shapes
    /// - tokens: `[N, L]`
    /// - states: `[N, L, D]`; pooled: `[N, D]`
    ///
    /// # Panics
    /// For longer texts or ids outside the vocabulary: a tokenizer that belongs to another encoder.
    #[must_use]
    pub fn forward(&self, tokens: &TokenBatch) -> TextStates {
        let [vocabulary, _] = self.embeddings.token_embedding.weight.dims();
        let [positions, _] = self.embeddings.position_embedding.weight.dims();
        let (length, id) = (tokens.width(), tokens.largest_id() as usize);
        assert!(length <= positions, "{length} tokens per text, the encoder has {positions}");
        assert!(id < vocabulary, "token {id} of a vocabulary of {vocabulary}");
        let device = self.final_layer_norm.weight.device();
        let keys = tokens.attention_mask(&device).reshape([tokens.texts(), 1, 1, length]);
        let x: Tensor<3> = self.embeddings.forward(tokens.to_tensor(&device));
        let states = self.final_layer_norm.forward(self.encoder.forward(x, &keys, self.encoder.layers.len()));
        TextStates { pooled: tokens.at_end(states.clone()), states }
    }
}
