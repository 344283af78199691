//! Losses between painted and true pictures and their gradients, for every autoencoder (sections 5 and 5.1 of the BEV-VAE
//! specification; Esser et al., "Taming Transformers", for the adaptive weight).
//!
//! burn consumes its tape, so the adaptive weight is found without a second pass through the generator: the painted pictures
//! become leaves, each loss gives its gradient there, the last layer's gradients follow from those, and a single backward pass
//! then carries the weighted sum through the generator.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Bool, Tensor};
use rand::RngExt;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use train::StepOutput;
use vae::losses::{
    adaptive_weight, adversarial, hinge_discriminator, lecam, masked_l2, select_views, squared_slope,
    with_ignored_pixels_of,
};

use crate::adversary::{Adversary, Smoothing};
use crate::bev_vae::Perceptual;
use crate::tensors::normal;

/// What should have been painted, and which of it counts.
pub(crate) struct Target {
    /// `[B, V, 3, H, W]`, network values.
    pub images: Tensor<5>,
    /// `[B, V]`, true where the rig has a camera.
    pub mask: Tensor<2, Bool>,
    /// `[B, V, 1, H, W]`, 1 where a pixel counts; `None` when all do.
    pub counted: Option<Tensor<5>>,
    /// The mask on the host.
    pub present: Vec<bool>,
}

/// What was painted, and the way back through the generator.
pub(crate) struct Painted<'a> {
    /// `[B, V, 3, H, W]`, network values, without a tape.
    pub images: Tensor<5>,
    /// Mean over samples, `[1]`, without a tape.
    pub kl: Tensor<1>,
    /// Norm of a loss's gradient over the last layer's weight, from its gradient over the pictures.
    pub last_layer_norm: &'a dyn Fn(&Tensor<5>) -> Tensor<1>,
    /// Gradients of the generator from a loss's gradient over the pictures and the weight of the KL term.
    pub way_back: Box<dyn FnOnce(Tensor<5>, f64) -> GradientsParams + 'a>,
}

impl<'a> Painted<'a> {
    /// Pictures and KL term that `model` computed on one tape.
    pub fn on_tape<M: Module>(
        model: &'a M,
        (images, kl): (Tensor<5>, Tensor<1>),
        last_layer_norm: &'a dyn Fn(&Tensor<5>) -> Tensor<1>,
    ) -> Self {
        let (seen, value) = (images.clone().inner(), kl.clone().inner());
        let way_back = Box::new(move |upstream: Tensor<5>, kl_weight: f64| {
            let total = (images * Tensor::from_inner(upstream)).sum() + kl * kl_weight;
            GradientsParams::from_grads(total.backward(), model)
        });
        Self { images: seen, kl: value, last_layer_norm, way_back }
    }
}

/// Gradients of one micro batch.
pub(crate) struct StepGradients {
    pub generator: GradientsParams,
    pub discriminator: Option<GradientsParams>,
    /// Mean scores of real and painted pictures, where there is a discriminator.
    pub scores: Option<[Tensor<1>; 2]>,
}

/// The losses of one step.
pub(crate) struct Losses<'a> {
    pub perceptual: Option<&'a Perceptual>,
    pub adversary: Option<Adversary<'a>>,
    pub kl_weight: f64,
}

impl Losses<'_> {
    /// Gradients of everything that learns; `views` draws the views that parts of the loss look at.
    pub fn gradients(
        &self,
        painted: Painted,
        target: &Target,
        views: &mut ChaCha8Rng,
        output: &mut StepOutput,
    ) -> StepGradients {
        let images = painted.images;
        let (reconstruction, mut upstream) = self.reconstruction_gradient(&images, target, views);
        output.push("loss", reconstruction + painted.kl.clone() * self.kl_weight);
        output.push("kl", painted.kl.clone());
        let (mut discriminator, mut scores) = (None, None);
        if let Some(adversary) = &self.adversary {
            let positions = choose_views(&target.present, adversary.views, views);
            if adversary.weight > 0.0 {
                let (gradient, score) = adversarial_gradient(adversary, &images, target, &positions);
                let norm = painted.last_layer_norm;
                let lambda = adaptive_weight(norm(&upstream), norm(&gradient));
                upstream = upstream + gradient * (lambda.clone() * adversary.weight).reshape([1, 1, 1, 1, 1]);
                output.push("lambda", lambda);
                output.push("adversarial", score);
            }
            let judged = discriminator_gradients(adversary, images, target, &positions, views);
            output.push("discriminator", judged.loss);
            if let Some(smoothing) = judged.smoothing {
                output.push("discriminator_smoothing", smoothing);
            }
            (discriminator, scores) = (Some(judged.gradients), Some(judged.scores));
        }
        StepGradients { generator: (painted.way_back)(upstream, self.kl_weight), discriminator, scores }
    }

    /// L_R and its gradient at the painted pictures.
    fn reconstruction_gradient(
        &self,
        images: &Tensor<5>,
        target: &Target,
        views: &mut ChaCha8Rng,
    ) -> (Tensor<1>, Tensor<5>) {
        let leaf = Tensor::from_inner(images.clone()).require_grad();
        let mut loss = masked_l2(leaf.clone(), target.images.clone(), target.mask.clone(), target.counted.clone());
        if let Some(perceptual) = self.perceptual {
            let positions = choose_views(&target.present, perceptual.views(), views);
            let painted = select_views(target.fill_ignored(leaf.clone()), &positions);
            loss = loss + perceptual.loss(painted, select_views(target.images.clone(), &positions));
        }
        let value = loss.clone().inner();
        let gradients = loss.backward();
        let gradient = leaf.grad(&gradients).expect("the loss depends on the painted pictures");
        (value, gradient)
    }
}

impl Target {
    fn fill_ignored(&self, painted: Tensor<5>) -> Tensor<5> {
        with_ignored_pixels_of(painted, &self.images, self.counted.as_ref())
    }
}

/// Gradient of L_A at the painted pictures, and L_A.
fn adversarial_gradient(
    adversary: &Adversary,
    images: &Tensor<5>,
    target: &Target,
    positions: &[usize],
) -> (Tensor<5>, Tensor<1>) {
    let leaf = Tensor::from_inner(images.clone()).require_grad();
    let frozen = adversary.discriminator.clone().no_grad();
    let loss = adversarial(frozen.forward(select_views(target.fill_ignored(leaf.clone()), positions)));
    let value = loss.clone().inner();
    let gradients = loss.backward();
    (leaf.grad(&gradients).expect("the score depends on the painted pictures"), value)
}

/// What a discriminator's step comes to.
struct Judged {
    /// L_D alone.
    loss: Tensor<1>,
    /// What keeps it smooth, where that is part of the step.
    smoothing: Option<Tensor<1>>,
    /// Mean scores of real and painted pictures.
    scores: [Tensor<1>; 2],
    gradients: GradientsParams,
}

/// L_D on real and painted pictures and its gradients; `directions` draws where slopes are measured.
fn discriminator_gradients(
    adversary: &Adversary,
    images: Tensor<5>,
    target: &Target,
    positions: &[usize],
    directions: &mut ChaCha8Rng,
) -> Judged {
    let n = positions.len();
    let fake = select_views(target.fill_ignored(Tensor::from_inner(images)), positions);
    let real = select_views(target.images.clone(), positions);
    let scores = adversary.discriminator.forward(Tensor::cat(vec![real.clone(), fake], 0));
    let [on_real, on_fake] = [0, n].map(|start| scores.clone().narrow(0, start, n));
    let loss = hinge_discriminator(on_real.clone(), on_fake.clone());
    let smoothing = match adversary.smoothing {
        Smoothing::Nothing => None,
        Smoothing::Slope { factor, epsilon } => {
            let along = normal(real.dims(), directions, &real.device());
            Some(squared_slope(|x| adversary.discriminator.forward(x), real, along, epsilon) * factor)
        }
        Smoothing::Lecam { weight, means } => Some(lecam(on_real.clone(), on_fake.clone(), means) * weight),
    };
    let total = match &smoothing {
        Some(smoothing) => loss.clone() + smoothing.clone(),
        None => loss.clone(),
    };
    Judged {
        loss: loss.inner(),
        smoothing: smoothing.map(Tensor::inner),
        scores: [on_real, on_fake].map(|scores| scores.mean().inner()),
        gradients: GradientsParams::from_grads(total.backward(), adversary.discriminator),
    }
}

/// Positions of `count` random cameras that exist (all of them for 0), ascending.
pub(crate) fn choose_views(mask: &[bool], count: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let present: Vec<usize> = (0..mask.len()).filter(|i| mask[*i]).collect();
    if count == 0 || count >= present.len() {
        // One draw all the same, so that the choice of `count` does not shift other choices of the step.
        let _: u64 = rng.random();
        return present;
    }
    let mut chosen: Vec<usize> = sample(rng, present.len(), count).iter().map(|i| present[i]).collect();
    chosen.sort_unstable();
    chosen
}
