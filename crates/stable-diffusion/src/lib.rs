//! The networks of latent diffusion, as Stable Diffusion 1.5 and 2.1 publish them.

pub mod text;

pub use text::{ClipTextConfig, ClipTextModel, ClipTokenizer, SmallTextEncoder, TextEncoder, TokenBatch, Tokenizer};
