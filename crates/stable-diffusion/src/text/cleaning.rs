//! What happens to a text before it is cut into tokens.

use std::sync::LazyLock;

use regex::Regex;
use serde::{Deserialize, Serialize};
use unicode_normalization::UnicodeNormalization;

/// The two customs of CLIP tokenizers. They differ in HTML entities and in a Greek sigma at the end of a capitalised
/// word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TextCleaning {
    /// As pipelines in diffusers' layout: canonical composition, lower case character by character.
    #[default]
    Transformers,
    /// As the encoders were trained: HTML entities resolved twice, lower case by words. The further repair of broken
    /// encodings and of typographic quotes that OpenCLIP's own code makes is left out; canonical composition stands
    /// for it.
    OpenClip,
}

impl TextCleaning {
    /// The cleaned text; white space stays as it is, since no piece contains any.
    #[must_use]
    pub fn clean(self, text: &str) -> String {
        let composed: String = text.nfc().collect();
        match self {
            Self::Transformers => composed.chars().flat_map(char::to_lowercase).collect(),
            Self::OpenClip => {
                let once = html_escape::decode_html_entities(&composed);
                html_escape::decode_html_entities(&once).to_lowercase()
            }
        }
    }
}

/// The marks of begin and end, which stand for their tokens also when a text contains them; English contractions; runs
/// of letters; single digits; runs of anything else but white space.
const PIECE: &str = r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+";

static PIECES: LazyLock<Regex> = LazyLock::new(|| Regex::new(PIECE).expect("a constant pattern"));

/// The pieces of a cleaned text within which bytes are merged.
pub(super) fn pieces(cleaned: &str) -> impl Iterator<Item = &str> {
    PIECES.find_iter(cleaned).map(|found| found.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_of_letters_digits_and_marks() {
        let cut = |text| pieces(text).collect::<Vec<_>>();
        assert_eq!(cut("don't  stop!!12 km/h"), ["don", "'t", "stop", "!!", "1", "2", "km", "/", "h"]);
        assert_eq!(cut("a<|endoftext|>b"), ["a", "<|endoftext|>", "b"]);
        assert_eq!(cut(" \n\t"), Vec::<&str>::new());
    }

    #[test]
    fn the_two_customs() {
        let text = "ΟΔΟΣ &amp;amp; cafe\u{301}";
        assert_eq!(TextCleaning::Transformers.clean(text), "οδοσ &amp;amp; caf\u{e9}");
        assert_eq!(TextCleaning::OpenClip.clean(text), "οδος & caf\u{e9}");
    }
}
