//! Tokenizers and text encoders.

mod clip;
mod files;
mod reference;
mod small;
mod tokenizer;
