//! One training step of BEV-VAE as the paper's algorithm (sections 5 and 5.1 of the specification).

use burn::tensor::{Device, Tensor, TensorData};
use data::SceneBatch;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use train::{StepContext, StepOutput};
use vae::losses::last_layer_gradient_norm;
use vae::pixels::normalise;
use vae::{BevVae, Decoded, DiagonalGaussian};

use crate::reconstruction::{Losses, Painted, StepGradients, Target};
use crate::tensors::{counted_pixels, decode_cameras, encode_cameras, pictures, view_mask};

/// Everything one micro batch needs.
pub struct Step<'a> {
    pub model: &'a BevVae,
    pub losses: &'a Losses<'a>,
    pub device: &'a Device,
}

impl Step<'_> {
    /// Forward and backward; the caller applies the gradients.
    pub fn run(&self, batch: &SceneBatch, micro: u64, ctx: &StepContext) -> (StepGradients, StepOutput) {
        let mut output = StepOutput::new(batch.target.mask.iter().filter(|present| **present).count());
        let stream = |purpose: &str| train::stream(ctx.seed, &format!("{purpose}/{micro}"), ctx.step);
        let (posterior, decoded) = self.forward(batch, &mut stream("posterior"));
        let target = Target {
            images: normalise(pictures(&batch.target, self.device)),
            mask: view_mask(&batch.target, self.device),
            counted: counted_pixels(&batch.target, self.device),
            present: batch.target.mask.clone(),
        };
        let tokens = decoded.last_tokens.inner();
        let last_layer_norm = |gradient: &Tensor<5>| {
            let [b, v, c, h, w] = gradient.dims();
            last_layer_gradient_norm(tokens.clone(), gradient.clone().reshape([b * v, c, h, w]))
        };
        let painted = Painted { images: decoded.images, kl: posterior.kl().mean(), last_layer_norm: &last_layer_norm };
        let gradients = self.losses.gradients(self.model, painted, &target, &mut stream("views"), &mut output);
        (gradients, output)
    }

    fn forward(&self, batch: &SceneBatch, noise: &mut ChaCha8Rng) -> (DiagonalGaussian, Decoded) {
        let images = normalise(pictures(&batch.input, self.device));
        let posterior = self.model.encode(images, &encode_cameras(&batch.input, self.device));
        let shape = posterior.mean.dims();
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| StandardNormal.sample(noise)).collect();
        let latent = posterior.sample(Tensor::from_data(TensorData::new(values, shape), self.device));
        let decoded = self.model.decode(latent, &decode_cameras(&batch.target, self.device));
        (posterior, decoded)
    }
}
