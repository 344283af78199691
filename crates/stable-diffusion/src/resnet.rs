//! The residual block of autoencoder and UNet.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Bias, GroupNorm, Init, Linear};

use crate::layers::Conv2d;

/// Sizes of one [`ResnetBlock`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResnetSizes {
    /// Channels of the input.
    pub c_in: usize,
    /// Channels of the output; a 1×1 shortcut joins the two when they differ.
    pub c_out: usize,
    /// Groups of both norms.
    pub groups: usize,
    /// Of both norms: 1e-5 in the UNet, 1e-6 in the autoencoder.
    pub epsilon: f32,
    /// Width of the time code, in networks that know a time.
    pub time_width: Option<usize>,
}

/// Norm, SiLU, 3×3, plus time, norm, SiLU, 3×3, plus input.
#[derive(Module, Debug)]
pub struct ResnetBlock {
    /// Before the first convolution.
    pub norm1: GroupNorm,
    /// Changes the channels.
    pub conv1: Conv2d,
    /// Time code to one offset per channel.
    pub time_emb_proj: Option<Linear>,
    /// Before the second convolution.
    pub norm2: GroupNorm,
    /// Keeps the channels.
    pub conv2: Conv2d,
    /// 1×1, when the channels change.
    pub conv_shortcut: Option<Conv2d>,
}

impl ResnetBlock {
    /// Fresh weights.
    pub fn new(sizes: ResnetSizes, init: &mut Init) -> Self {
        let ResnetSizes { c_in, c_out, groups, epsilon, time_width } = sizes;
        Self {
            norm1: GroupNorm::new(c_in, groups, epsilon, init),
            conv1: Conv2d::new(c_in, c_out, 3, init),
            time_emb_proj: time_width.map(|width| Linear::new(width, c_out, Bias::With, init)),
            norm2: GroupNorm::new(c_out, groups, epsilon, init),
            conv2: Conv2d::new(c_out, c_out, 3, init),
            conv_shortcut: (c_in != c_out).then(|| Conv2d::new(c_in, c_out, 1, init)),
        }
    }

    /// # Shapes
    /// - x: `[N, in, H, W]`
    /// - time: `[N, time width]`, after SiLU, exactly in networks that know a time
    /// - output: `[N, out, H, W]`
    ///
    /// # Panics
    /// When a time is given to a block that knows none, or the reverse.
    pub fn forward(&self, x: Tensor<4>, time: Option<&Tensor<2>>) -> Tensor<4> {
        assert_eq!(self.time_emb_proj.is_some(), time.is_some(), "a time for a block that knows one, and only then");
        let h = self.conv1.forward(self.norm1.forward_silu(x.clone()));
        let h = match (&self.time_emb_proj, time) {
            (Some(layer), Some(time)) => {
                let offset = layer.forward(time.clone());
                let [n, c] = offset.dims();
                h + offset.reshape([n, c, 1, 1])
            }
            _ => h,
        };
        let h = self.conv2.forward(self.norm2.forward_silu(h));
        let x = match &self.conv_shortcut {
            Some(shortcut) => shortcut.forward(x),
            None => x,
        };
        x + h
    }
}
