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

/// One token per word, number or run of punctuation of the cleaned text, in lower case, by its hash: needs no vocabulary file, and a
/// word is told from another by one row of the encoder's table.
///
/// Two words share a token with a chance of 1 in 8192.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WordTokenizer {
    context: usize,
}

impl WordTokenizer {
    /// Words, begin, end, padding.
    pub const VOCABULARY: usize = Self::WORDS as usize + 3;
    const WORDS: u32 = 8192;
    const BEGIN: u32 = Self::WORDS;
    const END: u32 = Self::WORDS + 1;
    const PAD: u32 = Self::WORDS + 2;

    /// `context` tokens per text, begin and end included.
    ///
    /// # Panics
    /// Below 2: begin and end need their places.
    #[must_use]
    pub fn new(context: usize) -> Self {
        assert!(context >= 2, "context {context} has no place for begin and end");
        Self { context }
    }

    /// Begin, as many words as fit, end, padding.
    #[must_use]
    pub fn tokenize<S: AsRef<str>>(&self, texts: &[S]) -> TokenBatch {
        let words = |text: &S| {
            let cleaned = TextCleaning::Transformers.clean(text.as_ref());
            pieces(&cleaned).map(Self::word).collect::<Vec<_>>()
        };
        batch(texts.iter().map(words), [Self::BEGIN, Self::END], Self::PAD, self.context)
    }

    /// FNV-1a of 64 bits. Trained tables depend on it.
    fn word(word: &str) -> u32 {
        let hash = word
            .bytes()
            .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
        (hash % u64::from(Self::WORDS)) as u32
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
    /// Hashed words.
    Words(WordTokenizer),
}

impl Tokenizer {
    /// Number of tokens, which the encoder's table must hold.
    #[must_use]
    pub fn vocabulary_size(&self) -> usize {
        match self {
            Self::Clip(tokenizer) => tokenizer.pairs.vocabulary_size(),
            Self::Words(_) => WordTokenizer::VOCABULARY,
        }
    }

    /// Tokens per text, padding included.
    #[must_use]
    pub fn context(&self) -> usize {
        match self {
            Self::Clip(tokenizer) => tokenizer.context,
            Self::Words(tokenizer) => tokenizer.context,
        }
    }

    /// Begin, as many tokens as fit, end, padding.
    #[must_use]
    pub fn tokenize<S: AsRef<str>>(&self, texts: &[S]) -> TokenBatch {
        match self {
            Self::Clip(tokenizer) => tokenizer.tokenize(texts),
            Self::Words(tokenizer) => tokenizer.tokenize(texts),
        }
    }
}
