//! Tokens and small deviations that follow from stable names, so that two runs with one seed give identical bytes on any machine.

use sha2::{Digest, Sha256};

use crate::manifest::hex;

/// Names rows of one dataset; datasets of different seeds share no token.
#[derive(Debug, Clone)]
pub(super) struct TokenSpace {
    prefix: String,
}

impl TokenSpace {
    pub(super) fn new(version: &str, seed: u64) -> Self {
        Self { prefix: format!("rigscape/nuscenes/{version}/{seed}") }
    }

    fn digest(&self, table: &str, name: &str) -> [u8; 32] {
        // The unit separator occurs in no name, so ("a", "bc") and ("ab", "c") differ.
        Sha256::digest(format!("{}\u{1f}{table}\u{1f}{name}", self.prefix)).into()
    }

    /// 32 lower-case hexadecimal digits, the form of the release.
    pub(super) fn token(&self, table: &str, name: &str) -> String {
        hex(&self.digest(table, name)[..16])
    }

    /// The dashed form of map expansion tokens.
    pub(super) fn uuid(&self, layer: &str, name: &str) -> String {
        let digits = self.token(layer, name);
        format!("{}-{}-{}-{}-{}", &digits[..8], &digits[8..12], &digits[12..16], &digits[16..20], &digits[20..])
    }

    /// A seed for a part of the dataset.
    pub(super) fn seed(&self, purpose: &str, name: &str) -> u64 {
        let digest = self.digest(purpose, name);
        digest[..8].iter().fold(0, |sum, byte| (sum << 8) | u64::from(*byte))
    }

    /// A number in [0, 1) fixed by its name.
    pub(super) fn fraction(&self, purpose: &str, name: &str) -> f64 {
        // 53 bits fill an f64's mantissa exactly.
        (self.seed(purpose, name) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_have_the_release_form_and_depend_on_every_part() {
        let space = TokenSpace::new("v1.0-mini", 1);
        let token = space.token("sample", "scene-0061/0");
        assert_eq!(token.len(), 32);
        assert!(token.chars().all(|c| c.is_ascii_digit() || ('a'..='f').contains(&c)));
        assert_eq!(token, space.token("sample", "scene-0061/0"));
        assert_ne!(token, space.token("sample_data", "scene-0061/0"));
        assert_ne!(token, space.token("sample", "scene-0061/1"));
        assert_ne!(token, TokenSpace::new("v1.0-mini", 2).token("sample", "scene-0061/0"));
        assert_eq!(space.uuid("node", "a").split('-').map(str::len).collect::<Vec<_>>(), [8, 4, 4, 4, 12]);
        assert!((0.0..1.0).contains(&space.fraction("jitter", "x")));
    }
}
