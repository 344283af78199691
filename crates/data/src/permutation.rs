//! Keyed permutations of `0..n` that need no memory, so that a shuffled position can be looked up without walking to it.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Rounds of the Feistel network. Four make a pseudo-random permutation (Luby and Rackoff); tiny domains need more to mix well.
const ROUNDS: usize = 8;

/// A bijection of `0..len`.
#[derive(Debug, Clone)]
pub(crate) struct Permutation {
    len: u64,
    half_bits: u32,
    keys: [u64; ROUNDS],
}

impl Permutation {
    /// The permutation of `0..len` that this generator's next numbers select.
    pub(crate) fn new(len: u64, rng: &mut ChaCha8Rng) -> Self {
        let bits = u64::BITS - len.saturating_sub(1).leading_zeros();
        Self { len, half_bits: bits.div_ceil(2).max(1), keys: std::array::from_fn(|_| rng.next_u64()) }
    }

    /// Where `index` goes. The network permutes a power of four, less than four times as large; walking on until the value falls
    /// inside `0..len` keeps it a bijection.
    ///
    /// # Panics
    /// `index` outside `0..len`.
    pub(crate) fn apply(&self, index: u64) -> u64 {
        assert!(index < self.len, "index {index} is outside a permutation of {}", self.len);
        let mut value = index;
        loop {
            value = self.feistel(value);
            if value < self.len {
                return value;
            }
        }
    }

    fn feistel(&self, value: u64) -> u64 {
        let mask = (1u64 << self.half_bits) - 1;
        let (mut left, mut right) = (value >> self.half_bits, value & mask);
        for key in self.keys {
            (left, right) = (right, left ^ (mix(right ^ key) & mask));
        }
        left << self.half_bits | right
    }
}

/// The finaliser of splitmix64: every output bit depends on every input bit.
fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seeding::{Purpose, rng};

    #[test]
    fn every_value_occurs_once() {
        for len in [1, 2, 3, 4, 5, 16, 17, 63, 64, 65, 1000] {
            let permutation = Permutation::new(len, &mut rng(7, Purpose::FrameOrder, 0, 0));
            let mut seen: Vec<u64> = (0..len).map(|i| permutation.apply(i)).collect();
            seen.sort_unstable();
            assert!(seen.iter().copied().eq(0..len), "{len}");
        }
    }

    #[test]
    fn tiny_domains_mix() {
        // Position of item 0 over 5000 keys: each of 5 places expects 1000 with a standard deviation of 28.
        let mut counts = [0u32; 5];
        for key in 0..5000 {
            counts[Permutation::new(5, &mut rng(1, Purpose::FrameOrder, 0, key)).apply(0) as usize] += 1;
        }
        assert!(counts.iter().all(|c| (850..1150).contains(c)), "{counts:?}");
    }
}
