//! Multi-head attention with separate projections. Shapes: B items, N queries, K keys, D width, H heads, d = D/H.

use burn::module::Module;
use burn::tensor::{Bool, Tensor};
use nn::{Bias, Init, Linear};

/// Most scores that one product makes: 2²⁶ of them are 256 MiB. More queries are done in blocks, with the same result.
const MAX_SCORES: usize = 1 << 26;

/// Queries of one sequence look at keys and values of another, or of the same.
#[derive(Module, Debug)]
pub struct Attention {
    /// D→D
    pub to_q: Linear,
    /// D_context→D
    pub to_k: Linear,
    /// D_context→D
    pub to_v: Linear,
    /// D→D, with a bias
    pub to_out: Linear,
    heads: usize,
}

impl Attention {
    /// `bias` is that of queries, keys and values: none in the UNet, with in the autoencoder.
    ///
    /// # Panics
    /// When `heads` does not divide `width`; configs check it before they come here.
    pub fn new(width: usize, context_width: usize, heads: usize, bias: Bias, init: &mut Init) -> Self {
        assert_eq!(width % heads, 0, "{heads} heads must divide width {width}");
        Self {
            to_q: Linear::new(width, width, bias, init),
            to_k: Linear::new(context_width, width, bias, init),
            to_v: Linear::new(context_width, width, bias, init),
            to_out: Linear::new(width, width, Bias::With, init),
            heads,
        }
    }

    /// # Shapes
    /// - x: `[B, N, D]`
    /// - context: `[B, K, D_context]`
    /// - output: `[B, N, D]`
    pub fn forward(&self, x: Tensor<3>, context: Tensor<3>) -> Tensor<3> {
        let [q, k, v] = self.project(x, context);
        self.merge(attend(q, k, v, None))
    }

    /// Queries, keys and values, each `[B, H, N or K, d]`.
    pub(crate) fn project(&self, x: Tensor<3>, context: Tensor<3>) -> [Tensor<4>; 3] {
        [
            self.split(self.to_q.forward(x)),
            self.split(self.to_k.forward(context.clone())),
            self.split(self.to_v.forward(context)),
        ]
    }

    /// `[B, N, D]` to `[B, H, N, d]`.
    fn split(&self, x: Tensor<3>) -> Tensor<4> {
        let [b, n, width] = x.dims();
        x.reshape([b, n, self.heads, width / self.heads]).swap_dims(1, 2)
    }

    /// `[B, H, N, d]` to `[B, N, D]`, through the last projection.
    pub(crate) fn merge(&self, attended: Tensor<4>) -> Tensor<3> {
        let [b, heads, n, head] = attended.dims();
        self.to_out.forward(attended.swap_dims(1, 2).reshape([b, n, heads * head]))
    }
}

/// Scaled dot-product attention in blocks of queries, so that the scores of a large picture never stand in memory at once.
///
/// # Shapes
/// - q: `[B, H, N, d]`
/// - k, v: `[B, H, K, d]`
/// - mask: `[B, 1, 1, K]`, true where a key may be attended
/// - output: `[B, H, N, d]`
pub(crate) fn attend(q: Tensor<4>, k: Tensor<4>, v: Tensor<4>, mask: Option<Tensor<4, Bool>>) -> Tensor<4> {
    attend_in_blocks(q, k, v, mask, MAX_SCORES)
}

fn attend_in_blocks(
    q: Tensor<4>,
    k: Tensor<4>,
    v: Tensor<4>,
    mask: Option<Tensor<4, Bool>>,
    max_scores: usize,
) -> Tensor<4> {
    let [b, heads, n, _] = q.dims();
    let rows = (max_scores / (b * heads * k.dims()[2]).max(1)).max(1);
    if rows >= n {
        return ops::attention(q, k, v, mask);
    }
    let block = |start: usize| {
        let queries = q.clone().narrow(2, start, rows.min(n - start));
        ops::attention(queries, k.clone(), v.clone(), mask.clone())
    };
    Tensor::cat((0..n).step_by(rows).map(block).collect(), 2)
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};
    use nn::golden::golden_stream;

    use super::*;

    fn noise(name: &str, shape: [usize; 4]) -> Tensor<4> {
        let values: Vec<f32> = golden_stream(name, shape.iter().product()).into_iter().map(|v| v as f32).collect();
        Tensor::from_data(TensorData::new(values, shape), &Device::flex())
    }

    #[test]
    fn blocks_give_what_the_whole_gives() {
        let (q, k, v) = (noise("q", [2, 3, 11, 4]), noise("k", [2, 3, 7, 4]), noise("v", [2, 3, 7, 4]));
        let mask = noise("mask", [2, 1, 1, 7]).greater_elem(-0.3);
        for mask in [None, Some(mask)] {
            let whole = attend(q.clone(), k.clone(), v.clone(), mask.clone());
            for max_scores in [0, 2 * 3 * 7 * 4, 2 * 3 * 7 * 10] {
                let blocks = attend_in_blocks(q.clone(), k.clone(), v.clone(), mask.clone(), max_scores);
                assert!(blocks.all_close(whole.clone(), Some(1e-6), Some(1e-6)), "at most {max_scores} scores");
            }
        }
    }
}
