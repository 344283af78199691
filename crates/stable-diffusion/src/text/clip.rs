//! CLIP's text encoder: a causal pre-norm transformer.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Init, LayerNorm, lora_sites};

use super::transformer::{Embeddings, Encoder, LayerSizes};
use super::{ClipTextConfig, TextOutput, TextStates, TokenBatch};

/// The encoder under the name that stands first in its state dict.
#[derive(Module, Debug)]
pub struct ClipTextModel {
    /// All parameters.
    pub text_model: TextTransformer,
    #[module(skip)]
    config: ClipTextConfig,
}

/// Tables, layers, norm.
#[derive(Module, Debug)]
pub struct TextTransformer {
    /// Tokens and positions.
    pub embeddings: Embeddings,
    /// Layers.
    pub encoder: Encoder,
    /// Behind the last layer used.
    pub final_layer_norm: LayerNorm,
}

lora_sites!(TextTransformer { encoder });
lora_sites!(ClipTextModel { text_model });

impl ClipTextModel {
    /// Fresh weights for checked sizes.
    pub fn new(config: &ClipTextConfig, init: &mut Init) -> Self {
        let epsilon = config.layer_norm_eps as f32;
        let sizes = LayerSizes {
            width: config.hidden_size,
            inner: config.intermediate_size,
            heads: config.num_attention_heads,
            activation: config.hidden_act,
            epsilon,
        };
        let positions = config.max_position_embeddings;
        let text_model = TextTransformer {
            embeddings: Embeddings::new(config.vocab_size, positions, config.hidden_size, init),
            encoder: Encoder::new(config.num_hidden_layers, sizes, init),
            final_layer_norm: LayerNorm::with_bias(config.hidden_size, epsilon, init),
        };
        Self { text_model, config: *config }
    }

    /// What it was built from.
    #[must_use]
    pub fn config(&self) -> &ClipTextConfig {
        &self.config
    }

    /// States of all tokens, and of the end token. Each token sees itself and those before it; padding is no exception.
    ///
    /// # Shapes
    /// - tokens: `[N, L]`, L at most the positions
    /// - states: `[N, L, D]`; pooled: `[N, D]`
    ///
    /// # Panics
    /// For longer texts or ids outside the vocabulary: a tokenizer that belongs to another encoder.
    #[must_use]
    pub fn forward(&self, tokens: &TokenBatch) -> TextStates {
        let (length, id) = (tokens.width(), tokens.largest_id() as usize);
        assert!(length <= self.config.max_position_embeddings, "{length} tokens per text are too many");
        assert!(id < self.config.vocab_size, "token {id} of a vocabulary of {}", self.config.vocab_size);
        let parts = &self.text_model;
        let device = parts.final_layer_norm.weight.device();
        let mask = Tensor::<2>::ones([length, length], &device).triu(1).lower_elem(0.5).unsqueeze::<4>();
        let layers = match self.config.output {
            TextOutput::Last => self.config.num_hidden_layers,
            TextOutput::Penultimate => self.config.num_hidden_layers - 1,
        };
        let x = parts.embeddings.forward(tokens.to_tensor(&device));
        let states = parts.final_layer_norm.forward(parts.encoder.forward(x, &mask, layers));
        TextStates { pooled: tokens.at_end(states.clone()), states }
    }
}
