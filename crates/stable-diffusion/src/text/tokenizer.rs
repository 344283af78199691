//! Tokenizers: texts to padded token ids.

use serde::{Deserialize, Serialize};

use super::cleaning::pieces;
use super::{BytePairs, TextCleaning, TokenBatch};

/// What stands behind the end token of a short text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Padding {
    /// More end tokens: Stable Diffusion 1.5.
    #[default]
    EndToken,
    /// Token 0: Stable Diffusion 2.1.
    Zero,
}

/// CLIP's tokenizer.
#[derive(Debug, Clone)]
pub struct ClipTokenizer {
    /// Vocabulary and merges.
    pub pairs: BytePairs,
    /// Before a text is cut.
    pub cleaning: TextCleaning,
    /// Behind the end token.
    pub padding: Padding,
    context: usize,
}

impl ClipTokenizer {
    /// Tokens per text of all published encoders.
    pub const CONTEXT: usize = 77;

    /// With CLIP's context.
    #[must_use]
    pub fn new(pairs: BytePairs, cleaning: TextCleaning, padding: Padding) -> Self {
        Self { pairs, cleaning, padding, context: Self::CONTEXT }
    }

    /// With another number of tokens per text, begin and end included.
    ///
    /// # Panics
    /// Below 2: begin and end need their places.
    #[must_use]
    pub fn with_context(self, context: usize) -> Self {
        assert!(context >= 2, "context {context} has no place for begin and end");
        Self { context, ..self }
    }

    /// Tokens of a text of any length, without begin, end and padding.
    #[must_use]
    pub fn encode(&self, text: &str) -> Vec<u32> {
        let cleaned = self.cleaning.clean(text);
        pieces(&cleaned).flat_map(|piece| self.pairs.encode_piece(piece)).collect()
    }

    /// Cleaned text of ids, pieces parted by spaces.
    #[must_use]
    pub fn decode(&self, ids: &[u32]) -> String {
        self.pairs.decode(ids)
    }

    /// Begin, as many tokens as fit, end, padding.
    #[must_use]
    pub fn tokenize<S: AsRef<str>>(&self, texts: &[S]) -> TokenBatch {
        let marks = self.pairs.marks();
        let pad = match self.padding {
            Padding::EndToken => marks[1],
            Padding::Zero => 0,
        };
        batch(texts.iter().map(|text| self.encode(text.as_ref())), marks, pad, self.context)
    }
}

/// One token per UTF-8 byte of the cleaned text, white space as single spaces: needs no vocabulary file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ByteTokenizer {
    context: usize,
}

impl ByteTokenizer {
    /// Bytes, begin, end, padding.
    pub const VOCABULARY: usize = 259;
    const BEGIN: u32 = 256;
    const END: u32 = 257;
    const PAD: u32 = 258;

    /// `context` tokens per text, begin and end included.
    ///
    /// # Panics
    /// Below 2: begin and end need their places.
    #[must_use]
    pub fn new(context: usize) -> Self {
        assert!(context >= 2, "context {context} has no place for begin and end");
        Self { context }
    }

    /// Begin, as many bytes as fit, end, padding.
    #[must_use]
    pub fn tokenize<S: AsRef<str>>(&self, texts: &[S]) -> TokenBatch {
        let bytes = |text: &S| {
            let cleaned = TextCleaning::Transformers.clean(text.as_ref());
            let words: Vec<&str> = cleaned.split_whitespace().collect();
            words.join(" ").bytes().map(u32::from).collect::<Vec<_>>()
        };
        batch(texts.iter().map(bytes), [Self::BEGIN, Self::END], Self::PAD, self.context)
    }
}

fn batch(texts: impl Iterator<Item = Vec<u32>>, [begin, end]: [u32; 2], pad: u32, context: usize) -> TokenBatch {
    let mut ids = Vec::new();
    for (row, tokens) in (1..).zip(texts) {
        ids.push(begin);
        ids.extend(tokens.into_iter().take(context - 2));
        ids.push(end);
        ids.resize(row * context, pad);
    }
    TokenBatch::new(ids, context, end)
}

/// Any tokenizer.
#[derive(Debug, Clone)]
pub enum Tokenizer {
    /// CLIP's byte pairs.
    Clip(Box<ClipTokenizer>),
    /// Bytes.
    Bytes(ByteTokenizer),
}

impl Tokenizer {
    /// Number of tokens, which the encoder's table must hold.
    #[must_use]
    pub fn vocabulary_size(&self) -> usize {
        match self {
            Self::Clip(tokenizer) => tokenizer.pairs.vocabulary_size(),
            Self::Bytes(_) => ByteTokenizer::VOCABULARY,
        }
    }

    /// Tokens per text, padding included.
    #[must_use]
    pub fn context(&self) -> usize {
        match self {
            Self::Clip(tokenizer) => tokenizer.context,
            Self::Bytes(tokenizer) => tokenizer.context,
        }
    }

    /// Begin, as many tokens as fit, end, padding.
    #[must_use]
    pub fn tokenize<S: AsRef<str>>(&self, texts: &[S]) -> TokenBatch {
        match self {
            Self::Clip(tokenizer) => tokenizer.tokenize(texts),
            Self::Bytes(tokenizer) => tokenizer.tokenize(texts),
        }
    }
}
