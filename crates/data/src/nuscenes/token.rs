//! Row tokens as 128-bit keys: millions of them do not fit into memory as text.
//!
//! A token is an opaque string. 32 lower-case hex digits, the form of the release, are their own key; every other form is hashed,
//! so upper-case digits are a different token, as they must be.

use std::collections::HashMap;
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::DataError;

/// The key of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Key(u128);

impl Key {
    pub fn of(token: &str) -> Self {
        plain_hex(token).unwrap_or_else(|| {
            let digest = Sha256::digest(token.as_bytes());
            Self(digest.iter().take(16).fold(0, |key, byte| key << 8 | u128::from(*byte)))
        })
    }
}

/// The value of each lower-case hex digit, [`NO_DIGIT`] for every other byte.
const DIGITS: [u8; 256] = {
    let mut digits = [NO_DIGIT; 256];
    let mut value = 0;
    while value < 16 {
        digits[b"0123456789abcdef"[value] as usize] = value as u8;
        value += 1;
    }
    digits
};

/// A bit that no digit has.
const NO_DIGIT: u8 = 0x80;

fn plain_hex(token: &str) -> Option<Key> {
    let (upper, rest) = token.as_bytes().split_first_chunk::<16>()?;
    let ([lower], []) = rest.as_chunks::<16>() else { return None };
    let [upper, lower] = [half(upper)?, half(lower)?];
    Some(Key(u128::from(upper) << 64 | u128::from(lower)))
}

/// Tens of millions of tokens are read from a release, so the digits are checked together at the end.
fn half(digits: &[u8; 16]) -> Option<u64> {
    let (mut value, mut seen) = (0u64, 0u8);
    for digit in digits {
        let digit = DIGITS[usize::from(*digit)];
        value = value << 4 | u64::from(digit & 15);
        seen |= digit;
    }
    (seen & NO_DIGIT == 0).then_some(value)
}

/// The text of a token whose key does not spell it.
pub(super) fn odd_text(token: &str) -> Option<Box<str>> {
    plain_hex(token).is_none().then(|| token.into())
}

/// Texts of the tokens that are not plain hex digits.
#[derive(Debug, Default)]
pub(super) struct Names(HashMap<Key, Box<str>>);

impl Names {
    pub fn insert(&mut self, key: Key, odd: Option<Box<str>>) {
        if let Some(text) = odd {
            self.0.insert(key, text);
        }
    }

    pub fn text(&self, key: Key) -> String {
        self.0.get(&key).map_or_else(|| format!("{:032x}", key.0), |text| text.to_string())
    }
}

/// Finds rows by key: a sorted list is smaller than a hash map and cannot be slowed down by chosen keys.
#[derive(Debug, Default)]
pub(super) struct Index(Vec<(Key, u32)>);

impl Index {
    /// From the keys of a table in row order.
    ///
    /// # Errors
    /// A key that occurs twice, with its position.
    pub fn new(keys: impl Iterator<Item = Key>) -> Result<Self, usize> {
        let mut rows: Vec<_> = keys.zip(0u32..).collect();
        rows.sort_unstable();
        match rows.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            Some(pair) => Err(pair[1].1 as usize),
            None => Ok(Self(rows)),
        }
    }

    pub fn get(&self, key: Key) -> Option<u32> {
        self.0.binary_search_by_key(&key, |row| row.0).ok().map(|at| self.0[at].1)
    }
}

/// An index over the rows of a small table that keeps its tokens as text.
pub(super) fn index_of<'a>(
    tokens: impl Iterator<Item = &'a str> + Clone,
    table: &'static str,
    path: &Path,
) -> Result<Index, DataError> {
    Index::new(tokens.clone().map(Key::of)).map_err(|row| DataError::DuplicateToken {
        table,
        token: tokens.clone().nth(row).unwrap_or_default().to_owned(),
        path: path.to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_of_any_form_are_told_apart() {
        let hex = "0123456789abcdef0123456789abcdef";
        assert_eq!(Key::of(hex), Key(0x0123_4567_89ab_cdef_0123_4567_89ab_cdef));
        let forms =
            [hex, &hex.to_uppercase(), &format!("{hex}1"), &hex.repeat(2), "9f1c0e4e-53aa-4a3b-a2a4-7f7c1f3f5a11", ""];
        let keys: std::collections::BTreeSet<Key> = forms.iter().map(|text| Key::of(text)).collect();
        assert_eq!(keys.len(), forms.len());
        let mut names = Names::default();
        for form in forms {
            names.insert(Key::of(form), odd_text(form));
            assert_eq!(names.text(Key::of(form)), form);
        }
    }

    #[test]
    fn an_index_finds_rows_and_repeats() {
        let keys = ["c", "a", "b"].map(Key::of);
        let index = Index::new(keys.into_iter()).unwrap();
        assert_eq!(keys.map(|key| index.get(key)), [Some(0), Some(1), Some(2)]);
        assert_eq!(index.get(Key::of("d")), None);
        assert_eq!(Index::new(["a", "b", "a"].map(Key::of).into_iter()).unwrap_err(), 2);
    }
}
