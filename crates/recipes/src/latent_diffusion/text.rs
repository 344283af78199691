//! What reads captions: CLIP as published, frozen, or a small encoder that learns with the UNet.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use nn::Init;
use serde::{Deserialize, Serialize};
use stable_diffusion::text::{SmallTextConfig, load_text_encoder, load_tokenizer};
use stable_diffusion::{ClipTextModel, SmallTextEncoder, Tokenizer, UNet2DCondition, UNetConfig};

/// Which text encoder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TextConfig {
    /// Learned from nothing, with the UNet; one token per word.
    Small(SmallTextConfig),
    /// Published weights, frozen: a folder that holds `tokenizer` and `text_encoder`.
    Clip(PathBuf),
}

impl Default for TextConfig {
    fn default() -> Self {
        Self::Small(SmallTextConfig::default())
    }
}

/// Everything that learns.
#[derive(Module, Debug)]
pub struct Denoiser {
    /// Predicts the noise.
    pub unet: UNet2DCondition,
    /// Reads captions, unless a published encoder does.
    pub text: Option<SmallTextEncoder>,
}

/// Tokenizer and, where it is a published one, the frozen encoder.
#[derive(Debug)]
pub struct Captioner {
    tokenizer: Tokenizer,
    frozen: Option<ClipTextModel>,
}

impl Captioner {
    /// Reads whatever the config names; a frozen encoder is put on `device` without a tape.
    ///
    /// # Errors
    /// Files that cannot be read, sizes that build nothing, states of another width than the UNet takes.
    pub fn open(config: &TextConfig, unet: &UNetConfig, device: &Device) -> anyhow::Result<Self> {
        let (captioner, width) = match config {
            TextConfig::Small(sizes) => {
                let tokenizer = sizes.checked().context("in text.small")?.tokenizer(None);
                (Self { tokenizer, frozen: None }, sizes.width)
            }
            TextConfig::Clip(folder) => Self::open_clip(folder, device).context("in text.clip")?,
        };
        let wanted = unet.encoder.context_width;
        ensure!(
            width == wanted,
            "the text encoder gives states of width {width}, model.encoder.context_width is {wanted}"
        );
        Ok(captioner)
    }

    fn open_clip(folder: &Path, device: &Device) -> anyhow::Result<(Self, usize)> {
        let device = device.clone().without_autodiff();
        let model = load_text_encoder(&folder.join("text_encoder"), &device)?;
        let tokenizer = Tokenizer::Clip(Box::new(load_tokenizer(&folder.join("tokenizer"))?));
        let width = model.config().hidden_size;
        Ok((Self { tokenizer, frozen: Some(model) }, width))
    }

    /// Fresh weights of everything that learns.
    pub fn denoiser(&self, config: &TextConfig, unet: &UNetConfig, init: &mut Init) -> Denoiser {
        let unet = UNet2DCondition::new(unet, init);
        let text = match config {
            TextConfig::Small(sizes) => Some(SmallTextEncoder::new(sizes, self.tokenizer.vocabulary_size(), init)),
            TextConfig::Clip(_) => None,
        };
        Denoiser { unet, text }
    }

    /// Token states of captions, on the device of `denoiser`.
    ///
    /// # Shapes
    /// - output: `[N, L, D]`
    pub fn states(&self, denoiser: &Denoiser, captions: &[String]) -> Tensor<3> {
        let tokens = self.tokenizer.tokenize(captions);
        match &self.frozen {
            Some(clip) => {
                let states = clip.forward(&tokens).states;
                if denoiser.on_tape() { Tensor::from_inner(states) } else { states }
            }
            None => {
                denoiser
                    .text
                    .as_ref()
                    .expect("what learns holds an encoder where none is frozen")
                    .forward(&tokens)
                    .states
            }
        }
    }
}

impl Denoiser {
    /// Where its weights lie, tape included.
    pub fn device(&self) -> Device {
        self.unet.conv_in.weight.device()
    }

    /// Whether it is being differentiated.
    pub fn on_tape(&self) -> bool {
        self.unet.conv_in.weight.val().is_autodiff()
    }
}
