//! Any text encoder.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::lora_sites;

use super::{ClipTextModel, SmallTextEncoder, TokenBatch};

/// What an encoder makes of texts.
#[derive(Debug, Clone)]
pub struct TextStates {
    /// Context of the UNet: every place, padding included; `[N, L, D]`.
    pub states: Tensor<3>,
    /// State of the end token, for texts that are names; `[N, D]`.
    pub pooled: Tensor<2>,
}

/// The kinds of text encoder.
#[derive(Module, Debug)]
pub enum TextEncoder {
    /// Published weights.
    Clip(ClipTextModel),
    /// Trained with the rest.
    Small(SmallTextEncoder),
}

lora_sites!(
    enum TextEncoder {
        Clip,
        Small,
    }
);

impl TextEncoder {
    /// As the encoder's own `forward`.
    #[must_use]
    pub fn forward(&self, tokens: &TokenBatch) -> TextStates {
        match self {
            Self::Clip(model) => model.forward(tokens),
            Self::Small(model) => model.forward(tokens),
        }
    }
}
