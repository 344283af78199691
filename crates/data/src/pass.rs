//! Every frame of a dataset once, in order: what evaluation needs, where shuffling and endless repetition are wrong.

use rayon::prelude::*;

use crate::loader::load_sample;
use crate::{DataError, PadViews, SampleOptions, SceneBatch, SceneDataset, assemble};

/// Batches over all frames of a dataset in order, clean; the last one may be smaller. Samples of a batch load in parallel.
///
/// Each batch is an error of its own: after one, the next call goes on with the next batch, so that a check can list all of them.
#[derive(Clone, Copy)]
pub struct InOrder<'a> {
    dataset: &'a dyn SceneDataset,
    batch_size: usize,
    pad_views: PadViews,
    options: SampleOptions,
    next: usize,
}

impl<'a> InOrder<'a> {
    /// Starts at the first frame. A batch size of 0 counts as 1.
    pub fn new(dataset: &'a dyn SceneDataset, batch_size: usize, pad_views: PadViews, options: SampleOptions) -> Self {
        Self { dataset, batch_size: batch_size.max(1), pad_views, options, next: 0 }
    }
}

impl Iterator for InOrder<'_> {
    type Item = Result<SceneBatch, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        let end = (self.next + self.batch_size).min(self.dataset.len());
        if self.next == end {
            return None;
        }
        let frames = self.next..end;
        self.next = end;
        let samples: Result<Vec<_>, _> =
            frames.into_par_iter().map(|index| load_sample(self.dataset, 0, index, &self.options)).collect();
        Some(samples.and_then(|samples| assemble(samples, self.pad_views)))
    }
}
