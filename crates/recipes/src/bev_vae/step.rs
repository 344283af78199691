//! One training step of BEV-VAE as the paper's algorithm (sections 5 and 5.1 of the specification).

use burn::tensor::{Device, Tensor};
use data::{SceneBatch, ViewArrays};
use rand_chacha::ChaCha8Rng;
use train::{StepContext, StepOutput};
use vae::losses::last_layer_gradient_norm;
use vae::pixels::normalise;
use vae::{BevVae, OnBoth, SegmentedPass, ViewMatrices};

use crate::reconstruction::{Losses, Painted, StepGradients, Target};
use crate::tensors::{counted_pixels, decode_cameras, encode_cameras, normal, pictures, view_mask};

/// Everything one micro batch needs.
pub struct Step<'a> {
    pub model: &'a BevVae,
    pub losses: &'a Losses<'a>,
    pub device: &'a Device,
    /// Whether blocks are computed again on the way back instead of being kept.
    pub checkpointing: bool,
}

impl Step<'_> {
    /// Forward and backward; the caller applies the gradients.
    pub fn run(&self, batch: &SceneBatch, micro: u64, ctx: &StepContext) -> (StepGradients, StepOutput) {
        let mut output = StepOutput::new(batch.target.mask.iter().filter(|present| **present).count());
        let stream = |purpose: &str| train::stream(ctx.seed, &format!("{purpose}/{micro}"), ctx.step);
        let target = Target {
            images: normalise(pictures(&batch.target, self.device)),
            mask: view_mask(&batch.target, self.device),
            counted: counted_pixels(&batch.target, self.device),
            present: batch.target.mask.clone(),
        };
        let mut views = stream("views");
        let mut learn = |painted: Painted| self.losses.gradients(painted, &target, &mut views, &mut output);
        let noise = &mut stream("posterior");
        let gradients = if self.checkpointing {
            self.in_segments(batch, noise, &mut learn)
        } else {
            self.on_tape(batch, noise, &mut learn)
        };
        (gradients, output)
    }

    fn on_tape(
        &self,
        batch: &SceneBatch,
        noise: &mut ChaCha8Rng,
        learn: &mut dyn FnMut(Painted) -> StepGradients,
    ) -> StepGradients {
        let images = normalise(pictures(&batch.input, self.device));
        let posterior = self.model.encode(images, &encode_cameras(&batch.input, self.device));
        let latent = posterior.sample(normal(posterior.mean.dims(), noise, self.device));
        let decoded = self.model.decode(latent, &decode_cameras(&batch.target, self.device));
        let tokens = decoded.last_tokens.inner();
        let norm = |gradient: &Tensor<5>| norm_at(&tokens, gradient);
        learn(Painted::on_tape(self.model, (decoded.images, posterior.kl().mean()), &norm))
    }

    fn in_segments(
        &self,
        batch: &SceneBatch,
        noise: &mut ChaCha8Rng,
        learn: &mut dyn FnMut(Painted) -> StepGradients,
    ) -> StepGradients {
        let plain = self.device.clone().inner();
        let on_both = |arrays: &ViewArrays, matrices: fn(&ViewArrays, &Device) -> ViewMatrices| OnBoth {
            plain: matrices(arrays, &plain),
            taped: matrices(arrays, self.device),
        };
        let (encode, decode) = (on_both(&batch.input, encode_cameras), on_both(&batch.target, decode_cameras));
        let images = normalise(pictures(&batch.input, &plain));
        let pass = SegmentedPass::forward(self.model, images, [&encode, &decode], |shape| normal(shape, noise, &plain));
        let tokens = pass.last_tokens();
        let norm = |gradient: &Tensor<5>| norm_at(&tokens, gradient);
        learn(Painted {
            images: pass.images(),
            kl: pass.posterior().kl().mean(),
            last_layer_norm: &norm,
            way_back: Box::new(|upstream, kl_weight| pass.backward(self.model, upstream, kl_weight)),
        })
    }
}

/// Norm of a loss's gradient over the last layer's weight, from the tokens before it and the gradient `[B, V, 3, H, W]` behind it.
fn norm_at(tokens: &Tensor<4>, gradient: &Tensor<5>) -> Tensor<1> {
    let [b, v, c, h, w] = gradient.dims();
    last_layer_gradient_norm(tokens.clone(), gradient.clone().reshape([b * v, c, h, w]))
}
