//! One training step of BEV-VAE as the paper's algorithm (sections 5 and 5.1 of the specification).
//!
//! burn consumes its tape, so the adaptive weight is found without a second pass through the generator: the decoded pictures
//! become leaves, each loss gives its gradient there, the last layer's gradients follow by one matrix product, and a single
//! backward pass then carries the weighted sum through the generator.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Bool, Device, Tensor, TensorData};
use data::{SceneBatch, ViewArrays};
use rand::RngExt;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use train::{StepContext, StepOutput};
use vae::losses::{
    adaptive_weight, adversarial, hinge_discriminator, last_layer_gradient_norm, masked_l2, select_views,
    with_ignored_pixels_of,
};
use vae::pixels::normalise;
use vae::{BevVae, Decoded, DiagonalGaussian, Discriminator};

use super::Perceptual;
use crate::tensors::{counted_pixels, decode_cameras, encode_cameras, pictures, view_mask};

/// Share of the adversarial term: off, or factor on λ·L_A and the views it looks at.
pub struct Adversary<'a> {
    pub discriminator: &'a Discriminator,
    /// 0.1·γ of the paper; 0 while the discriminator learns alone.
    pub weight: f64,
    /// Random views per step; 0 for all.
    pub views: usize,
}

/// Gradients of one micro batch.
pub struct StepGradients {
    pub generator: GradientsParams,
    pub discriminator: Option<GradientsParams>,
}

/// Everything one micro batch needs.
pub struct Step<'a> {
    pub model: &'a BevVae,
    pub perceptual: Option<&'a Perceptual>,
    pub adversary: Option<Adversary<'a>>,
    pub kl_weight: f64,
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
        };

        let images = decoded.images.clone().inner();
        let mut views = stream("views");
        let (reconstruction, mut upstream) = self.reconstruction_gradient(&images, &target, batch, &mut views);
        let kl = posterior.kl().mean();
        output.push("loss", reconstruction + kl.clone() * self.kl_weight);
        output.push("kl", kl.clone());

        let mut discriminator = None;
        if let Some(adversary) = &self.adversary {
            let positions = choose_views(&batch.target, adversary.views, &mut views);
            if adversary.weight > 0.0 {
                let tokens = decoded.last_tokens.clone().inner();
                let (gradient, lambda, score) =
                    adversarial_gradient(adversary, &images, &target, &upstream, tokens, &positions);
                upstream = upstream + gradient * (lambda.clone() * adversary.weight).reshape([1, 1, 1, 1, 1]);
                output.push("lambda", lambda);
                output.push("adversarial", score);
            }
            let (loss, gradients) = discriminator_gradients(adversary, images, &target, &positions);
            output.push("discriminator", loss);
            discriminator = Some(gradients);
        }
        let total = (decoded.images * Tensor::from_inner(upstream)).sum() + kl * self.kl_weight;
        let generator = GradientsParams::from_grads(total.backward(), self.model);
        (StepGradients { generator, discriminator }, output)
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

    /// L_R and its gradient at the decoded pictures.
    fn reconstruction_gradient(
        &self,
        images: &Tensor<5>,
        target: &Target,
        batch: &SceneBatch,
        views: &mut ChaCha8Rng,
    ) -> (Tensor<1>, Tensor<5>) {
        let leaf = Tensor::from_inner(images.clone()).require_grad();
        let mut loss = masked_l2(leaf.clone(), target.images.clone(), target.mask.clone(), target.counted.clone());
        if let Some(perceptual) = self.perceptual {
            let positions = choose_views(&batch.target, perceptual.views(), views);
            let decoded = select_views(target.fill_ignored(leaf.clone()), &positions);
            loss = loss + perceptual.loss(decoded, select_views(target.images.clone(), &positions));
        }
        let value = loss.clone().inner();
        let gradients = loss.backward();
        let gradient = leaf.grad(&gradients).expect("the loss depends on the decoded pictures");
        (value, gradient)
    }
}

/// What should have been decoded, and which of it counts.
struct Target {
    images: Tensor<5>,
    mask: Tensor<2, Bool>,
    counted: Option<Tensor<5>>,
}

impl Target {
    fn fill_ignored(&self, decoded: Tensor<5>) -> Tensor<5> {
        with_ignored_pixels_of(decoded, &self.images, self.counted.as_ref())
    }
}

/// Gradient of L_A at the decoded pictures, λ, and L_A.
fn adversarial_gradient(
    adversary: &Adversary,
    images: &Tensor<5>,
    target: &Target,
    reconstruction: &Tensor<5>,
    tokens: Tensor<4>,
    positions: &[usize],
) -> (Tensor<5>, Tensor<1>, Tensor<1>) {
    let [b, v, c, h, w] = images.dims();
    let leaf = Tensor::from_inner(images.clone()).require_grad();
    let frozen = adversary.discriminator.clone().no_grad();
    let loss = adversarial(frozen.forward(select_views(target.fill_ignored(leaf.clone()), positions)));
    let value = loss.clone().inner();
    let gradients = loss.backward();
    let gradient = leaf.grad(&gradients).expect("the score depends on the decoded pictures");
    let flat = |gradient: &Tensor<5>| gradient.clone().reshape([b * v, c, h, w]);
    let lambda = adaptive_weight(
        last_layer_gradient_norm(tokens.clone(), flat(reconstruction)),
        last_layer_gradient_norm(tokens, flat(&gradient)),
    );
    (gradient, lambda, value)
}

/// L_D on real and decoded pictures and its gradients.
fn discriminator_gradients(
    adversary: &Adversary,
    images: Tensor<5>,
    target: &Target,
    positions: &[usize],
) -> (Tensor<1>, GradientsParams) {
    let n = positions.len();
    let fake = select_views(target.fill_ignored(Tensor::from_inner(images)), positions);
    let real = select_views(target.images.clone(), positions);
    let scores = adversary.discriminator.forward(Tensor::cat(vec![real, fake], 0));
    let loss = hinge_discriminator(scores.clone().narrow(0, 0, n), scores.narrow(0, n, n));
    let value = loss.clone().inner();
    (value, GradientsParams::from_grads(loss.backward(), adversary.discriminator))
}

/// Flat positions of `count` random cameras that exist (all of them for 0), ascending.
fn choose_views(arrays: &ViewArrays, count: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let present: Vec<usize> = (0..arrays.mask.len()).filter(|i| arrays.mask[*i]).collect();
    if count == 0 || count >= present.len() {
        // One draw all the same, so that the choice of `count` does not shift other choices of the step.
        let _: u64 = rng.random();
        return present;
    }
    let mut chosen: Vec<usize> = sample(rng, present.len(), count).iter().map(|i| present[i]).collect();
    chosen.sort_unstable();
    chosen
}
