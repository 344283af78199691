//! Latents of a frozen BEV-VAE: made once and stored, or made from pictures at every step.

mod autoencoder;
mod encode;

pub use autoencoder::{FrozenVae, Moments};
pub(crate) use encode::open_or_encode;
pub use encode::{EncodeOptions, Encoded, encode_folder, encode_tree};
