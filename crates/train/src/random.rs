//! Random numbers as a function of (seed, purpose, index), so that there is no generator state to save.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sha2::{Digest, Sha256};

/// A fresh generator for one purpose in one step. Two calls with equal arguments give the same numbers on every
/// machine and backend; different purposes or indices are independent.
pub fn stream(seed: u64, purpose: &str, index: u64) -> ChaCha8Rng {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    hash.update(purpose.as_bytes());
    ChaCha8Rng::from_seed(hash.finalize().into())
}

#[cfg(test)]
mod tests {
    use rand_chacha::rand_core::Rng;

    use super::stream;

    #[test]
    fn equal_arguments_repeat_and_each_argument_matters() {
        let first = |seed, purpose, index| stream(seed, purpose, index).next_u64();
        assert_eq!(first(1, "noise", 2), first(1, "noise", 2));
        let others = [first(2, "noise", 2), first(1, "views", 2), first(1, "noise", 3)];
        assert!(others.iter().all(|&other| other != first(1, "noise", 2)));
    }
}
