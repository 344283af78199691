//! One seed, split by purpose: every random choice of the data path is a pure function of a few numbers.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What a generator is for; two purposes never share a stream.
#[derive(Debug, Clone, Copy)]
#[repr(u64)]
pub(crate) enum Purpose {
    /// Order of datasets within an epoch; `a` = epoch.
    EpochOrder = 1,
    /// Order of one dataset's frames; `a` = dataset, `b` = pass.
    FrameOrder = 2,
    /// Augmentation of one sample; `a` = item.
    Augment = 3,
    /// Settings of one procedural scene; `a` = scene.
    Scene = 4,
    /// Settings of one procedural frame; `a` = frame.
    Frame = 5,
    /// Order of datasets among the frames with one number of views; `a` = epoch, `b` = number of views.
    BucketOrder = 6,
    /// Where the draws of a class-balanced pass begin; `a` = dataset.
    DrawOffset = 7,
    /// Pictures of one scene that a check decodes; `a` = scene.
    Check = 20,
}

/// The generator for one purpose.
pub(crate) fn rng(seed: u64, purpose: Purpose, a: u64, b: u64) -> ChaCha8Rng {
    let mut key = [0u8; 32];
    for (chunk, word) in key.chunks_exact_mut(8).zip([seed, purpose as u64, a, b]) {
        chunk.copy_from_slice(&word.to_le_bytes());
    }
    ChaCha8Rng::from_seed(key)
}
