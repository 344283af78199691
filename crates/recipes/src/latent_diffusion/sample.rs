//! From captions and cameras to pictures.

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor};
use data::{ImageSize, SceneBatch};
use diffusion::{Oracle, guide};
use rand_chacha::ChaCha8Rng;
use stable_diffusion::UNetInputs;

use super::step::{Frozen, per_view};
use super::{Denoiser, Neighbours, SamplingConfig};
use crate::tensors::normal;

/// Paints with one set of weights, without a tape.
pub struct Sampler<'a> {
    pub(super) frozen: &'a Frozen,
    pub(super) denoiser: &'a Denoiser,
    pub(super) config: &'a SamplingConfig,
    pub(super) device: &'a Device,
}

impl Sampler<'_> {
    /// RGB in [0, 1] for the cameras of a batch of one rig, one `[3, H, W]` per view.
    ///
    /// # Errors
    /// Unusable camera matrices.
    pub fn paint(&self, caption: &str, batch: &SceneBatch, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Vec<f32>>> {
        let views = &batch.target;
        let image = ImageSize { height: views.height as u32, width: views.width as u32 };
        let rigs = (&Neighbours::of(batch)?, views.views);
        let latents = self.latents(&[caption.to_owned()], rigs, self.frozen.coder.latent_size(image), rng)?;
        Ok(self.frozen.coder.decode(latents))
    }

    /// Scaled latents for rigs of `views` cameras each.
    ///
    /// # Shapes
    /// - captions: B
    /// - size: `[C, h, w]`
    /// - output: `[B·V, C, h, w]`
    ///
    /// # Errors
    /// Never for neighbours of as many samples.
    fn latents(
        &self,
        captions: &[String],
        (neighbours, views): (&Neighbours, usize),
        size: [usize; 3],
        rng: &mut ChaCha8Rng,
    ) -> anyhow::Result<Tensor<4>> {
        let [c, h, w] = size;
        let shape = [captions.len() * views, c, h, w];
        let guided = self.config.guidance != 1.0;
        let captioner = &self.frozen.captioner;
        let with = per_view(captioner.states(self.denoiser, captions), views);
        let context = if guided {
            let without = captioner.states(self.denoiser, &vec![String::new(); captions.len()]);
            Tensor::cat(vec![per_view(without, views), with], 0)
        } else {
            with
        };
        let needs_views = self.denoiser.unet.config().encoder.needs_views();
        let times = if guided { 2 } else { 1 };
        let adjacency = needs_views.then(|| neighbours.adjacency(times)).transpose()?;
        let mut denoise = |x: Tensor<4>, timestep: f64| {
            let x = x.repeat_dim(0, times);
            let timesteps = vec![timestep; x.dims()[0]];
            let inputs = UNetInputs {
                timesteps: &timesteps,
                context: context.clone(),
                views: adjacency.as_ref(),
                control: None,
            };
            let said = self.denoiser.unet.forward_with(x, &inputs);
            if guided {
                let items = shape[0];
                guide(said.clone().narrow(0, 0, items), said.narrow(0, items, items), self.config.guidance)
            } else {
                said
            }
        };
        let start = normal(shape, rng, self.device);
        let mut oracle = Oracle {
            denoise: &mut denoise,
            noise: &mut || normal(shape, rng, self.device),
            watch: &mut |_| ControlFlow::Continue(()),
        };
        let (schedule, target) = (&self.frozen.schedule, self.frozen.config.target);
        Ok(self.config.sampler.sample(schedule, target, start, &mut oracle)?)
    }
}
