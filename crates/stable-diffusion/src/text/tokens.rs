//! Token ids of several texts, padded to one length.

use burn::tensor::{Bool, Device, Int, Tensor, TensorData};

/// Ids of N texts, L each: begin, tokens, end, padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenBatch {
    ids: Vec<u32>,
    width: usize,
    lengths: Vec<usize>,
}

impl TokenBatch {
    /// From rows of `width` ids. A text's length is the place of its first `end`, that included; a row without one is
    /// full.
    ///
    /// # Panics
    /// When `ids` are no whole rows.
    #[must_use]
    pub fn new(ids: Vec<u32>, width: usize, end: u32) -> Self {
        assert!(width > 0 && ids.len().is_multiple_of(width), "{} ids are no rows of {width}", ids.len());
        let length = |row: &[u32]| row.iter().position(|id| *id == end).map_or(width, |at| at + 1);
        let lengths = ids.chunks_exact(width).map(length).collect();
        Self { ids, width, lengths }
    }

    /// Number of texts N.
    #[must_use]
    pub fn texts(&self) -> usize {
        self.lengths.len()
    }

    /// Tokens per text L, padding included.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// All ids, text after text.
    #[must_use]
    pub fn ids(&self) -> &[u32] {
        &self.ids
    }

    /// Tokens of each text, begin and end included, padding not.
    #[must_use]
    pub fn lengths(&self) -> &[usize] {
        &self.lengths
    }

    /// The largest id, 0 without texts.
    #[must_use]
    pub fn largest_id(&self) -> u32 {
        self.ids.iter().copied().max().unwrap_or(0)
    }

    /// Ids as indices, `[N, L]`.
    #[must_use]
    pub fn to_tensor(&self, device: &Device) -> Tensor<2, Int> {
        let ids: Vec<i64> = self.ids.iter().map(|id| i64::from(*id)).collect();
        Tensor::from_data(TensorData::new(ids, [self.texts(), self.width]), device)
    }

    /// True at begin, tokens and end, false at padding; `[N, L]`. CLIP's encoders and the UNet are trained without it.
    #[must_use]
    pub fn attention_mask(&self, device: &Device) -> Tensor<2, Bool> {
        let row = |length: &usize| (0..self.width).map(|i| i < *length).collect::<Vec<_>>();
        let values: Vec<bool> = self.lengths.iter().flat_map(row).collect();
        Tensor::from_data(TensorData::new(values, [self.texts(), self.width]), device)
    }

    /// The state at each text's end token.
    ///
    /// # Shapes
    /// - states: `[N, L, D]`
    /// - output: `[N, D]`
    #[must_use]
    pub fn at_end(&self, states: Tensor<3>) -> Tensor<2> {
        let [n, l, width] = states.dims();
        assert_eq!([n, l], [self.texts(), self.width], "states of other tokens");
        let rows: Vec<i64> = self.lengths.iter().enumerate().map(|(i, length)| (i * l + length - 1) as i64).collect();
        let device = states.device();
        states.reshape([n * l, width]).select(0, Tensor::from_data(TensorData::new(rows, [n]), &device))
    }
}
