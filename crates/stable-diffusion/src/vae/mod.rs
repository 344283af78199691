//! AutoencoderKL: pictures to latents an eighth of their size, and back.

mod coder;
mod config;
mod model;
mod posterior;
mod tiles;

pub use coder::{Decoder, DecoderBlock, Encoder, EncoderBlock, MidBlock, SelfAttention2d};
pub use config::VaeConfig;
pub use model::{AutoencoderKL, pixels_from_network};
pub use posterior::Posterior;
pub use tiles::Tiling;
