//! Row tokens: eight bytes in the databases, sixteen lower-case hex digits in file names.

use std::fmt;

/// The key of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Token(pub [u8; 8]);

impl Token {
    /// From sixteen lower-case hex digits.
    pub fn parse(text: &str) -> Option<Self> {
        let plain = text.len() == 16 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        plain.then(|| u64::from_str_radix(text, 16).ok()).flatten().map(|number| Self(number.to_be_bytes()))
    }
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", u64::from_be_bytes(self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_sixteen_lower_case_digits() {
        let token = Token([0x0f, 0x1e, 0, 0, 0, 0, 0xab, 0xcd]);
        assert_eq!(token.to_string(), "0f1e00000000abcd");
        assert_eq!(Token::parse("0f1e00000000abcd"), Some(token));
        for text in ["", "0F1E00000000ABCD", "0f1e00000000abc", "0f1e00000000abcde", "+f1e00000000abcd"] {
            assert_eq!(Token::parse(text), None, "{text}");
        }
    }
}
