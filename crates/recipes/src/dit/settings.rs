//! Parts of the experiment file of `train-dit`.

use std::path::PathBuf;

use data::RigSource;
use data::latents::{LatentScale, LatentType, NpyLayout, Posterior, TreeKind};
use data::layout::{LayoutClasses, Rasterise};
use diffusion::{LossWeight, SamplerConfig, ScheduleConfig, Target};
use geometry::RigPreset;
use serde::{Deserialize, Serialize};

use super::Guidance;
use crate::Sizes;

/// A preset of the transformer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct DitSizes(pub dit::Preset);

/// The sizes that do not follow from the autoencoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DitWidths {
    /// Blocks.
    pub depth: usize,
    /// Token width; the height slices of the grid, the heads and 4 must divide it.
    pub width: usize,
    /// Attention heads.
    pub heads: usize,
    /// Rows and columns of the latent that become one token.
    pub patch: usize,
}

impl Sizes for DitSizes {
    type Config = DitWidths;

    fn config(self) -> DitWidths {
        let [depth, width, heads] = self.0.sizes();
        DitWidths { depth, width, heads, patch: 1 }
    }

    fn checked(config: DitWidths) -> Result<DitWidths, String> {
        let DitWidths { depth, width, heads, patch } = config;
        if [depth, width, heads, patch].contains(&0) {
            return Err("every size starts at 1".to_owned());
        }
        if !width.is_multiple_of(heads) {
            return Err(format!("{heads} heads must divide the width {width}"));
        }
        Ok(config)
    }
}

/// Latents and how they become numbers of unit variance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LatentSettings {
    /// Where they come from.
    pub source: LatentSource,
    /// One deviation for all channels, or one each.
    pub scale: LatentScale,
    /// Draw from the posterior at each visit, or take its mean.
    pub posterior: Posterior,
    /// Samples that the encoder takes at once.
    pub encode_batch: usize,
}

impl Default for LatentSettings {
    fn default() -> Self {
        Self {
            source: LatentSource::default(),
            scale: LatentScale::Global,
            posterior: Posterior::Sample,
            encode_batch: 8,
        }
    }
}

/// Section 2.2 of the specification.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentSource {
    /// The encoder runs at every step. `statistics_samples` frames are measured first.
    Online {
        /// Frames measured; all where there are fewer.
        #[serde(default = "ten_thousand")]
        statistics_samples: usize,
    },
    /// Shards of `rigscape encode`, made from `data` where they are absent.
    Moments(StoredLatents),
    /// One file per instant, as published.
    NpyTree(TreeLatents),
}

const fn ten_thousand() -> usize {
    10_000
}

impl Default for LatentSource {
    fn default() -> Self {
        Self::Online { statistics_samples: ten_thousand() }
    }
}

/// Latents in shards.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StoredLatents {
    /// Holds the folders `train` and `validation`.
    pub folder: PathBuf,
    /// How they are stored where they are made now.
    #[serde(default)]
    pub dtype: LatentType,
    /// Samples of a shard where they are made now.
    #[serde(default = "shard")]
    pub shard_samples: usize,
}

const fn shard() -> usize {
    1024
}

/// Latents in the published layout; boxes come from `data`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TreeLatents {
    /// The folder that holds `bev-lidar` or `bev`.
    pub root: PathBuf,
    /// Split of `data.train`.
    #[serde(default = "train_split")]
    pub train_split: String,
    /// Split of `data.validation`.
    #[serde(default = "val_split")]
    pub validation_split: String,
    /// Which frames.
    #[serde(default)]
    pub kind: TreeKind,
    /// Layout of the arrays; needed where their shape leaves a choice.
    #[serde(default)]
    pub layout: Option<NpyLayout>,
    /// What the first latent must reach when it is decoded and compared with its own pictures, dB; a wrongly read array does not.
    #[serde(default = "least_psnr")]
    pub least_psnr_db: f64,
}

fn train_split() -> String {
    "train".to_owned()
}

fn val_split() -> String {
    "val".to_owned()
}

const fn least_psnr() -> f64 {
    15.0
}

/// Classes and occupancy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConditionSettings {
    /// Which boxes, and in which channel.
    pub classes: ClassTable,
    /// Which cells a box marks.
    pub rasterise: Rasterise,
    /// Share of samples whose layout is left out in training, for guidance.
    pub dropout: f64,
}

impl Default for ConditionSettings {
    fn default() -> Self {
        Self { classes: ClassTable::Nuscenes, rasterise: Rasterise::CentresOrNearest, dropout: 0.1 }
    }
}

/// A table of classes by name, or the names themselves.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClassTable {
    /// The ten detection classes of nuScenes.
    Nuscenes,
    /// The thirty categories of Argoverse 2.
    Argoverse2,
    /// The classes that all datasets share, for mixed training.
    Shared,
    /// These, in this order.
    Names(Vec<String>),
}

impl ClassTable {
    /// The table.
    pub fn classes(&self) -> LayoutClasses {
        match self {
            Self::Nuscenes => LayoutClasses::nuscenes(),
            Self::Argoverse2 => LayoutClasses::argoverse2(),
            Self::Shared => LayoutClasses::shared(),
            Self::Names(names) => LayoutClasses { names: names.clone() },
        }
    }
}

/// How samples are noised.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseProcess {
    /// A schedule of noise levels.
    Schedule(ScheduledNoise),
    /// Straight lines from sample to noise; the network predicts noise − x0.
    RectifiedFlow(FlowNoise),
}

impl Default for NoiseProcess {
    fn default() -> Self {
        Self::Schedule(ScheduledNoise::default())
    }
}

/// Ho et al., "Denoising Diffusion Probabilistic Models"; the defaults are the paper's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScheduledNoise {
    /// How much noise each timestep holds.
    pub schedule: ScheduleConfig,
    /// What the network predicts.
    pub target: Target,
    /// Weight of timesteps.
    pub weight: LossWeight,
}

impl Default for ScheduledNoise {
    fn default() -> Self {
        Self { schedule: ScheduleConfig::DDPM, target: Target::Noise, weight: LossWeight::Uniform }
    }
}

/// Rectified flow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FlowNoise {
    /// The network is told σ times this.
    pub timesteps: usize,
}

impl Default for FlowNoise {
    fn default() -> Self {
        Self { timesteps: 1000 }
    }
}

/// How scenes are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DitSampling {
    /// From noise to latents; without it DDIM in 50 steps, on a rectified flow Euler in 50.
    pub sampler: Option<SamplerConfig>,
    /// How strongly the layout steers, at its best.
    pub guidance: Guidance,
}

impl Default for DitSampling {
    fn default() -> Self {
        Self { sampler: None, guidance: Guidance::TwoPass(4.0) }
    }
}

/// What is shown during training: layouts of held-out frames, decoded for a rig without guidance, with 1 and with the sampling's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PreviewSettings {
    /// Layouts.
    pub frames: usize,
    /// Cameras that look.
    pub rig: RigSource,
    /// Network evaluations of a sample.
    pub steps: usize,
    /// Width of a page, px.
    pub width: u32,
}

impl Default for PreviewSettings {
    fn default() -> Self {
        Self { frames: 2, rig: RigSource::Preset(RigPreset::NuScenes), steps: 20, width: 1200 }
    }
}

/// What is measured, always with averaged weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DitEvaluation {
    /// Held-out samples, spread evenly, whose error is measured during training, always with the same noise and timesteps.
    pub samples: usize,
    /// The same at the end of the run; 0 for all.
    pub final_samples: usize,
    /// Held-out layouts that are sampled at the end, for the distance between generated and true latents.
    pub generated: usize,
    /// Held-out layouts from which a box is removed at the end.
    pub edits: usize,
}

impl Default for DitEvaluation {
    fn default() -> Self {
        Self { samples: 64, final_samples: 256, generated: 64, edits: 16 }
    }
}
