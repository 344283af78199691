//! The frozen autoencoder: averaged weights of a run of `train-vae`, without a tape.

use std::path::Path;

use anyhow::Context;
use burn::tensor::{Device, Tensor};
use data::latents::Latent;
use data::{ImageSize, PadViews, SampleOptions, SceneBatch, ViewArrays};
use geometry::{BevGrid, CameraRig};
use nn::Init;
use train::{find_checkpoint, fingerprint};
use vae::BevVae;
use vae::pixels::normalise;

use crate::bev_vae::Experiment;
use crate::config_file;
use crate::tensors::{decode_cameras, displayed, encode_cameras, pictures};

/// BEV-VAE as the second stage sees it. Latents are pictures `[B, C, h, w]` here: rows along y, columns along x.
#[derive(Debug)]
pub struct FrozenVae {
    experiment: Experiment,
    model: BevVae,
    hash: String,
    device: Device,
}

/// A posterior as pictures.
#[derive(Debug, Clone)]
pub struct Moments {
    /// `[B, C, h, w]`
    pub mean: Tensor<4>,
    /// `[B, C, h, w]`
    pub log_var: Tensor<4>,
}

impl FrozenVae {
    /// Opens a checkpoint folder, or the newest checkpoint of a run folder.
    ///
    /// # Errors
    /// Names the folder or file that is missing or damaged.
    pub fn open(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let reader = find_checkpoint(path)
            .context("autoencoder: the run folder of a trained BEV-VAE is needed; `train-vae` makes it")?;
        let experiment: Experiment = config_file::parse(&reader.config_text("model")?, &[])
            .with_context(|| format!("in the config that the checkpoint carries: {}", reader.folder().display()))?;
        let device = device.clone().without_autodiff();
        let model = BevVae::new(&experiment.model.config, &mut Init::new(0, &device));
        let model = reader.module("ema", model)?;
        let (_, hash) = fingerprint(&reader.file("ema"))?;
        tracing::info!(step = reader.state().step, checkpoint = %reader.folder().display(), "autoencoder loaded");
        Ok(Self { experiment, model, hash, device })
    }

    /// SHA-256 of the file of averaged weights.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// The voxel grid in the ego frame.
    pub fn grid(&self) -> &BevGrid {
        &self.experiment.model.config.grid
    }

    /// C, h, w of a latent.
    pub fn latent_shape(&self) -> [usize; 3] {
        let [h, w] = self.experiment.model.config.state_tokens();
        [self.experiment.model.config.latent_channels, h, w]
    }

    /// Picture size and poses it was trained with.
    pub fn sample_options(&self) -> SampleOptions {
        SampleOptions { size: self.image_size(), pose_mode: self.experiment.data.loader.pose_mode }
    }

    /// Network picture size.
    pub fn image_size(&self) -> ImageSize {
        self.experiment.image_size()
    }

    /// Where it computes, without a tape.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The posterior of every sample's pictures.
    pub fn encode(&self, batch: &SceneBatch) -> Moments {
        let images = normalise(pictures(&batch.input, &self.device));
        let posterior = self.model.encode(images, &encode_cameras(&batch.input, &self.device));
        let picture = |tokens| vae::latent_picture(tokens, &self.experiment.model.config);
        Moments { mean: picture(posterior.mean), log_var: picture(posterior.log_var) }
    }

    /// RGB in [0, 1] of any cameras, one `[3, H, W]` per view, in (sample, view) order.
    ///
    /// # Shapes
    /// - latents: `[B, C, h, w]`, as the encoder gives them: not scaled
    /// - cameras: B samples
    pub fn decode(&self, latents: Tensor<4>, cameras: &ViewArrays) -> Vec<Vec<f32>> {
        displayed(self.model.decode_picture(latents, &decode_cameras(cameras, &self.device)).images)
    }

    /// Cameras of one rig, without pictures.
    ///
    /// # Errors
    /// Unusable calibration.
    pub fn cameras(&self, rig: &CameraRig) -> anyhow::Result<ViewArrays> {
        Ok(ViewArrays::cameras(std::slice::from_ref(rig), self.image_size(), PadViews::Largest)?)
    }
}

impl Moments {
    /// On the host, sample by sample.
    pub fn latents(&self) -> Vec<Latent> {
        let [b, c, h, w] = self.mean.dims();
        let read = |values: &Tensor<4>| values.clone().into_data().iter::<f32>().collect::<Vec<f32>>();
        let (mean, log_var) = (read(&self.mean), read(&self.log_var));
        let count = c * h * w;
        let part =
            |values: &[f32], at: usize| values.iter().skip(at * count).take(count).copied().collect::<Vec<f32>>();
        (0..b).map(|at| Latent { mean: part(&mean, at), log_var: Some(part(&log_var, at)) }).collect()
    }
}
