//! Text to token states: CLIP's tokenizer, the text encoders of Stable Diffusion 1.5 and 2.1, and a small one that is
//! trained with the rest where no published weights are.
//!
//! Papers: Radford et al., "Learning Transferable Visual Models From Natural Language Supervision", section 2.4;
//! Sennrich et al., "Neural Machine Translation of Rare Words with Subword Units", for the byte pairs. Parity:
//! `tests/it/text/tokenizer.rs`, `tests/it/text/clip.rs`. Shapes: N texts, L tokens, D width, H heads.

mod bpe;
mod cleaning;
mod clip;
mod config;
mod encoder;
mod error;
mod folder;
mod names;
mod single_file;
mod small;
mod tokenizer;
mod tokens;
mod transformer;

pub use bpe::BytePairs;
pub use cleaning::TextCleaning;
pub use clip::ClipTextModel;
pub use config::{Activation, ClipTextConfig, TextOutput};
pub use encoder::{TextEncoder, TextStates};
pub use error::TextError;
pub use folder::{load_clip, load_text_encoder, load_text_weights, load_tokenizer, save_clip};
pub use single_file::text_single_file_tensors;
pub use small::{SmallTextConfig, SmallTextEncoder};
pub use tokenizer::{ClipTokenizer, Padding, Tokenizer, WordTokenizer};
pub use tokens::TokenBatch;
pub use transformer::{EncoderLayer, FeedForward, SelfAttention};
