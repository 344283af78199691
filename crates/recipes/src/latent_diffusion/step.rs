//! One training step of latent diffusion: Ho et al., "Denoising Diffusion Probabilistic Models", algorithm 1, on the latents of all
//! views of a rig at once (Gao et al., MagicDrive: one timestep per sample, noise per view).

use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use data::SceneBatch;
use diffusion::NoiseSchedule;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use stable_diffusion::{Adjacency, UNetInputs};
use train::{StepContext, StepOutput};

use super::{Captioner, Denoiser, DiffusionConfig, LatentCoder, Neighbours, UNetExperiment};
use crate::tensors::normal;

/// What a step needs beside the weights that learn.
pub struct Frozen {
    pub coder: LatentCoder,
    pub captioner: Captioner,
    pub schedule: NoiseSchedule,
    pub config: DiffusionConfig,
    /// Whether gradients are taken block by block.
    pub checkpointing: bool,
}

/// A batch as the network meets it; N = B·V.
pub struct Problem {
    /// Noisy latents, `[N, C, h, w]`, without a tape.
    pub noisy: Tensor<4>,
    /// What the network should say, `[N, C, h, w]`, without a tape.
    pub wanted: Tensor<4>,
    /// Weight of each item in the loss, adding up to 1 over N.
    pub weights: Vec<f32>,
    /// N timesteps, equal within a sample.
    pub timesteps: Vec<f64>,
    /// B captions.
    pub captions: Vec<String>,
    /// V.
    pub views: usize,
    /// Which views meet.
    pub neighbours: Neighbours,
}

impl Frozen {
    /// Everything that an experiment names.
    ///
    /// # Errors
    /// A missing or unfitting autoencoder or text encoder.
    pub fn open(experiment: &UNetExperiment, device: &Device) -> anyhow::Result<Self> {
        let unet = &experiment.model.config;
        let channels = unet.encoder.in_channels;
        anyhow::ensure!(
            channels == unet.out_channels,
            "model.encoder.in_channels is {channels}, model.out_channels {}: what comes out must be what went in",
            unet.out_channels
        );
        Ok(Self {
            captioner: Captioner::open(&experiment.text, unet, device)?,
            coder: LatentCoder::open(&experiment.autoencoder, (experiment.image, channels), device)?,
            schedule: NoiseSchedule::new(&experiment.diffusion.schedule)?,
            config: experiment.diffusion.clone(),
            checkpointing: experiment.checkpointing,
        })
    }

    /// Noises a batch at these timesteps, one per sample.
    ///
    /// # Errors
    /// Unusable camera matrices.
    pub fn problem(&self, batch: &SceneBatch, timesteps: &[usize], rng: &mut ChaCha8Rng) -> anyhow::Result<Problem> {
        let clean = self.coder.encode(batch, rng);
        let (device, dims) = (clean.device(), clean.dims());
        let views = batch.target.views;
        let noise = normal(dims, rng, &device);
        let levels: Vec<_> = timesteps.iter().map(|t| self.schedule.level(*t)).collect();
        let factors = |of: &dyn Fn(&diffusion::Level) -> f64| {
            let values: Vec<f32> = levels.iter().flat_map(|level| vec![of(level) as f32; views]).collect();
            Tensor::<4>::from_data(TensorData::new(values, [dims[0], 1, 1, 1]), &device)
        };
        let (alpha, sigma) = (factors(&|level| level.alpha), factors(&|level| level.sigma));
        let noisy = clean.clone() * alpha.clone() + noise.clone() * sigma.clone();
        let target = self.config.target;
        let weight = |item: usize| {
            let level = levels[item / views];
            if batch.target.mask[item] { self.config.weight.factor(target, level) as f32 } else { 0.0 }
        };
        let present = batch.target.mask.iter().filter(|present| **present).count().max(1) as f32;
        Ok(Problem {
            noisy,
            wanted: target.of(clean, noise, alpha, sigma),
            weights: (0..dims[0]).map(|item| weight(item) / present).collect(),
            timesteps: timesteps.iter().flat_map(|t| vec![*t as f64; views]).collect(),
            captions: batch.texts.iter().map(|text| text.clone().unwrap_or_default()).collect(),
            views,
            neighbours: Neighbours::of(batch)?,
        })
    }

    /// The network's answer, `[N, C, h, w]`, on the tape where `denoiser` is.
    ///
    /// # Errors
    /// Never for neighbours of the same batch.
    pub fn answer(&self, denoiser: &Denoiser, problem: &Problem) -> anyhow::Result<Tensor<4>> {
        let states = per_view(self.captioner.states(denoiser, &problem.captions), problem.views);
        let adjacency = self.adjacency(denoiser, problem)?;
        let noisy = problem.noisy.clone();
        let noisy = if denoiser.on_tape() { Tensor::from_inner(noisy) } else { noisy };
        Ok(denoiser.unet.forward_with(noisy, &inputs(problem, states, adjacency.as_ref())))
    }

    fn adjacency(&self, denoiser: &Denoiser, problem: &Problem) -> anyhow::Result<Option<Adjacency>> {
        denoiser.unet.config().encoder.needs_views().then(|| problem.neighbours.adjacency(1)).transpose()
    }

    /// Loss and gradients of a problem, with all inner values on the tape at once.
    fn gradients(&self, denoiser: &Denoiser, problem: &Problem) -> anyhow::Result<(Tensor<1>, GradientsParams)> {
        if self.checkpointing {
            return self.gradients_in_segments(denoiser, problem);
        }
        let loss = self.loss(self.answer(denoiser, problem)?, problem);
        Ok((loss.clone(), GradientsParams::from_grads(loss.backward(), denoiser)))
    }

    /// The same with the inner values of one block of the UNet at a time.
    fn gradients_in_segments(
        &self,
        denoiser: &Denoiser,
        problem: &Problem,
    ) -> anyhow::Result<(Tensor<1>, GradientsParams)> {
        let states = per_view(self.captioner.states(denoiser, &problem.captions), problem.views);
        let adjacency = self.adjacency(denoiser, problem)?;
        let inputs = inputs(problem, states.clone().inner(), adjacency.as_ref());
        let pass = denoiser.unet.forward_segments(problem.noisy.clone(), &inputs);
        let answer = Tensor::from_inner(pass.output()).require_grad();
        let loss = self.loss(answer.clone(), problem);
        let upstream = answer.grad(&loss.backward()).expect("the loss is of the answer");
        let found = pass.backward(denoiser, upstream);
        let mut all = GradientsAccumulator::new();
        all.accumulate(denoiser, found.params);
        let text = (states * Tensor::from_inner(found.context)).sum();
        if text.is_tracked() {
            all.accumulate(denoiser, GradientsParams::from_grads(text.backward(), denoiser));
        }
        Ok((loss, all.grads()))
    }

    /// Weighted mean squared error of an answer, `[1]`.
    pub fn loss(&self, answer: Tensor<4>, problem: &Problem) -> Tensor<1> {
        let [n, c, h, w] = answer.dims();
        let on_tape = answer.is_autodiff();
        let lift = |values: Tensor<4>| if on_tape { Tensor::from_inner(values) } else { values };
        let device = problem.noisy.device();
        let weights = Tensor::<4>::from_data(TensorData::new(problem.weights.clone(), [n, 1, 1, 1]), &device);
        let squares = (answer - lift(problem.wanted.clone())).square() * lift(weights);
        squares.sum() / (c * h * w) as f64
    }

    /// Forward and backward of one micro batch; the caller applies the gradients.
    ///
    /// # Errors
    /// Unusable camera matrices.
    pub fn step(
        &self,
        denoiser: &Denoiser,
        (batch, micro): (&SceneBatch, u64),
        ctx: &StepContext,
    ) -> anyhow::Result<(GradientsParams, StepOutput)> {
        let stream = |purpose: &str| train::stream(ctx.seed, &format!("{purpose}/{micro}"), ctx.step);
        let mut times = stream("timesteps");
        let timesteps: Vec<usize> = batch.ids.iter().map(|_| times.random_range(0..self.schedule.len())).collect();
        let mut problem = self.problem(batch, &timesteps, &mut stream("noise"))?;
        let mut dropped = stream("captions");
        for caption in &mut problem.captions {
            if dropped.random_bool(self.config.caption_dropout) {
                caption.clear();
            }
        }
        let (loss, gradients) = self.gradients(denoiser, &problem)?;
        let mut output = StepOutput::new(batch.target.mask.iter().filter(|present| **present).count());
        output.push("loss", loss);
        Ok((gradients, output))
    }
}

/// What the UNet is told.
fn inputs<'a>(problem: &'a Problem, context: Tensor<3>, views: Option<&'a Adjacency>) -> UNetInputs<'a> {
    UNetInputs { timesteps: &problem.timesteps, context, views, control: None }
}

/// The states of each sample for each of its views.
///
/// # Shapes
/// - states: `[B, L, D]`
/// - output: `[B·V, L, D]`
pub fn per_view(states: Tensor<3>, views: usize) -> Tensor<3> {
    let [b, l, d] = states.dims();
    states.reshape([b, 1, l, d]).repeat_dim(1, views).reshape([b * views, l, d])
}
