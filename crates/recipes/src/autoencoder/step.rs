//! One training step of the autoencoder: Rombach et al., appendix G, with the losses of [`crate::reconstruction`].

use burn::tensor::{Device, Int, Tensor, TensorData};
use data::{SceneBatch, ViewArrays};
use stable_diffusion::{AutoencoderKL, Conv2d};
use train::{StepContext, StepOutput};

use crate::reconstruction::{Losses, Painted, StepGradients, Target, choose_views};
use crate::tensors::{counted_pixels, normal, pictures, signed};

/// Everything one micro batch needs.
pub struct Step<'a> {
    pub model: &'a AutoencoderKL,
    pub losses: &'a Losses<'a>,
    /// Random views that the step looks at; 0 for all.
    pub views: usize,
    pub device: &'a Device,
}

impl Step<'_> {
    /// Forward and backward; the caller applies the gradients.
    pub fn run(&self, batch: &SceneBatch, micro: u64, ctx: &StepContext) -> (StepGradients, StepOutput) {
        let stream = |purpose: &str| train::stream(ctx.seed, &format!("{purpose}/{micro}"), ctx.step);
        let mut views = stream("views");
        let chosen = choose_views(&batch.target.mask, self.views, &mut views);
        let n = chosen.len();
        let mut output = StepOutput::new(n);
        let (seen, target) = self.chosen_pictures(batch, &chosen);
        let posterior = self.model.encode(seen);
        let noise = normal(posterior.mean.dims(), &mut stream("posterior"), self.device);
        let features = self.model.decode_features(posterior.sample(noise));
        let last = &self.model.decoder.conv_out;
        let painted = last.forward(features.clone());
        let [_, c, h, w] = painted.dims();
        let features = features.inner();
        let last_layer_norm =
            |gradient: &Tensor<5>| weight_gradient_norm(last, &features, gradient.clone().reshape([n, c, h, w]));
        let found = (painted.reshape([1, n, c, h, w]), posterior.kl().mean());
        let painted = Painted::on_tape(self.model, found, &last_layer_norm);
        (self.losses.gradients(painted, &target, &mut views, &mut output), output)
    }

    /// The pictures as they are shown, `[N, 3, H, W]`, and what shall be painted, as one rig of N views.
    fn chosen_pictures(&self, batch: &SceneBatch, chosen: &[usize]) -> (Tensor<4>, Target) {
        let n = chosen.len();
        let indices: Vec<i64> = chosen.iter().map(|at| *at as i64).collect();
        let indices = Tensor::<1, Int>::from_data(TensorData::new(indices, [n]), self.device);
        let pick = |values: Tensor<5>| {
            let [b, v, c, h, w] = values.dims();
            values.reshape([b * v, c, h, w]).select(0, indices.clone())
        };
        let images = |arrays: &ViewArrays| signed(pick(pictures(arrays, self.device)));
        let wanted = images(&batch.target);
        let [_, c, h, w] = wanted.dims();
        let target = Target {
            images: wanted.reshape([1, n, c, h, w]),
            mask: Tensor::from_data(TensorData::new(vec![true; n], [1, n]), self.device),
            counted: counted_pixels(&batch.target, self.device).map(|counted| pick(counted).reshape([1, n, 1, h, w])),
            present: vec![true; n],
        };
        (images(&batch.input), target)
    }
}

/// Norm of a loss's gradient over the weight of a 3×3 convolution, `[1]`.
///
/// # Shapes
/// - features: `[N, in, H, W]`, entering it, without a tape
/// - gradient: `[N, out, H, W]`, of the loss over its output
fn weight_gradient_norm(conv: &Conv2d, features: &Tensor<4>, gradient: Tensor<4>) -> Tensor<1> {
    let weight = Tensor::from_inner(conv.weight.val().inner()).require_grad();
    let y = ops::conv2d(Tensor::from_inner(features.clone()), weight.clone(), None, [1; 2], [1; 2]);
    let gradients = (y * Tensor::from_inner(gradient)).sum().backward();
    let gradient = weight.grad(&gradients).expect("the output depends on the weight");
    gradient.square().sum().sqrt()
}
