//! Host memory that a loader will take.

use serde::Serialize;

use crate::{ImageSize, LoaderConfig, PadViews};

/// Numbers of one view beside its pixels: K, pose, edit and the two projections, and the mask.
const MATRIX_BYTES: usize = (9 + 16 + 9 + 12 + 12) * 4 + 1;

/// Estimated host memory, bytes. Maps, tables and the model are not part of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct BatchMemory {
    /// Samples of a batch.
    pub batch_size: usize,
    /// Views of a batch, padding included.
    pub views: usize,
    /// Network picture size.
    pub size: ImageSize,
    /// One batch: input and target pictures as f32, matrices, masks.
    pub batch_bytes: usize,
    /// All that the loader holds at a time: the batch in use, those prepared ahead, and each worker's decoded raw picture.
    pub loader_bytes: usize,
}

/// What batches of these settings take when frames have `max_views` views of at most `raw` (width, height) px.
pub fn batch_memory(loader: &LoaderConfig, max_views: usize, raw: (u32, u32)) -> BatchMemory {
    let views = match loader.pad_views {
        PadViews::Largest => max_views,
        PadViews::To(views) => views,
    };
    let pixels = loader.size.height as usize * loader.size.width as usize;
    let batch_bytes = 2 * loader.batch_size * views * (3 * 4 * pixels + MATRIX_BYTES);
    let raw_bytes = 3 * raw.0 as usize * raw.1 as usize;
    let loader_bytes = (loader.prefetch + 1) * batch_bytes + loader.workers * raw_bytes;
    BatchMemory { batch_size: loader.batch_size, views, size: loader.size, batch_bytes, loader_bytes }
}
