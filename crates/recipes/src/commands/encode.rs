//! `rigscape encode`: a frozen BEV-VAE encoder over datasets, to latents on disk.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::{Parser, ValueEnum};
use data::DatasetConfig;
use data::latents::{LatentType, NpyLayout, NpyTreeConfig, Posterior, STATISTICS, TreeKind};
use train::DeviceConfig;

use super::common::{open_all, say};
use super::data_source::DataSource;
use crate::latents::{EncodeOptions, Encoded, FrozenVae, encode_folder, encode_tree};

/// Encode the pictures of datasets with a trained BEV-VAE: latents with their boxes and statistics, for train-dit
///
/// An experiment's training and held-out datasets go into the folders `train` and `validation`. An interrupted run goes on where it stopped.
#[derive(Debug, Parser)]
pub struct EncodeArgs {
    /// Run folder of train-vae (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Datasets to encode
    #[command(flatten)]
    pub source: DataSource,
    /// Folder to write
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Shards of moments, or one .npy file per instant as in the published latents
    #[arg(long, value_enum, value_name = "FORMAT", default_value = "shards")]
    pub format: EncodeFormat,
    /// How numbers are stored
    #[arg(long, value_enum, value_name = "TYPE", default_value = "f16")]
    pub dtype: NumberType,
    /// Samples of a shard
    #[arg(long, value_name = "N", default_value_t = 1024)]
    pub shard_samples: usize,
    /// Samples encoded at once
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub batch_size: usize,
    /// Encode frames without annotation too (of a tree: into `bev` instead of `bev-lidar`)
    #[arg(long)]
    pub all_frames: bool,
    /// Layout of the arrays of a tree; moments_tokens alone keeps the variance
    #[arg(long, value_enum, value_name = "LAYOUT", default_value = "tokens")]
    pub layout: ArrayLayout,
    /// Folder of a tree's files below `bev-lidar` [default: train, and val for held-out datasets]
    #[arg(long, value_name = "NAME")]
    pub split_name: Option<String>,
    /// Where to compute
    #[arg(long, value_name = "NAME", default_value = "flex")]
    pub device: DeviceConfig,
}

/// How latents lie on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum EncodeFormat {
    /// Safetensors shards of moments
    Shards,
    /// One .npy file per instant
    NpyTree,
}

/// Precision on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum NumberType {
    /// Half
    F16,
    /// Single
    F32,
}

/// Arrays of a tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum ArrayLayout {
    /// [h·w, C]
    Tokens,
    /// [C, h, w]
    Chw,
    /// [h, w, C]
    Hwc,
    /// [h·w, 2C], means before log variances
    MomentsTokens,
}

impl From<ArrayLayout> for NpyLayout {
    fn from(layout: ArrayLayout) -> Self {
        match layout {
            ArrayLayout::Tokens => Self::Tokens,
            ArrayLayout::Chw => Self::Chw,
            ArrayLayout::Hwc => Self::Hwc,
            ArrayLayout::MomentsTokens => Self::MomentsTokens,
        }
    }
}

/// Datasets of one folder.
struct Part {
    /// Below the output; none where only one part is written.
    name: Option<&'static str>,
    split: &'static str,
    configs: Vec<DatasetConfig>,
}

/// Runs the command.
///
/// # Errors
/// Missing or damaged checkpoint, unreadable data, a folder that holds something else.
pub fn encode(args: &EncodeArgs) -> anyhow::Result<()> {
    ensure!(args.shard_samples > 0 && args.batch_size > 0, "--shard-samples and --batch-size need at least 1");
    let chosen = args.source.choose()?;
    let of = |held_out: bool| -> Vec<DatasetConfig> {
        let named = chosen.datasets.iter().filter(|named| named.place.starts_with("data.validation") == held_out);
        named.map(|named| named.config.clone()).collect()
    };
    let (train, validation) = (of(false), of(true));
    let parts = if validation.is_empty() {
        vec![Part { name: None, split: "train", configs: train }]
    } else {
        vec![
            Part { name: Some("train"), split: "train", configs: train },
            Part { name: Some("validation"), split: "val", configs: validation },
        ]
    };
    let vae = FrozenVae::open(&args.checkpoint, &args.device.open()?)?;
    for part in parts.iter().filter(|part| !part.configs.is_empty()) {
        let (place, encoded) = write(args, &vae, part)?;
        report(&place, &encoded)?;
    }
    Ok(())
}

fn write(args: &EncodeArgs, vae: &FrozenVae, part: &Part) -> anyhow::Result<(PathBuf, Encoded)> {
    let datasets = open_all(&part.configs)?;
    let options = EncodeOptions {
        dtype: match args.dtype {
            NumberType::F16 => LatentType::F16,
            NumberType::F32 => LatentType::F32,
        },
        shard_samples: args.shard_samples,
        batch_size: args.batch_size,
        annotated_only: !args.all_frames,
        posterior: Posterior::Sample,
    };
    let folder = part.name.map_or(args.out.clone(), |name| args.out.join(name));
    match args.format {
        EncodeFormat::Shards => {
            let encoded = encode_folder(vae, (&datasets, &part.configs), &folder, &options)
                .with_context(|| format!("encoding into {}", folder.display()))?;
            Ok((folder, encoded))
        }
        EncodeFormat::NpyTree => {
            let tree = NpyTreeConfig {
                root: args.out.clone(),
                split: args.split_name.clone().unwrap_or_else(|| part.split.to_owned()),
                kind: if args.all_frames { TreeKind::Bev } else { TreeKind::BevLidar },
                layout: Some(args.layout.into()),
            };
            let encoded = encode_tree(vae, &datasets, &tree, &options)?;
            Ok((tree.folder(), encoded))
        }
    }
}

fn report(place: &Path, encoded: &Encoded) -> anyhow::Result<()> {
    let figures = &encoded.statistics;
    say(format_args!(
        "{} latents ({} of an earlier run, {} frames without annotation left out): mean {:.4}, deviation {:.4}; {} and {STATISTICS} \
         of the autoencoder {}",
        encoded.samples,
        encoded.earlier,
        encoded.unannotated,
        figures.global_mean,
        figures.global_std,
        place.display(),
        &figures.vae_hash.get(..12).unwrap_or_default()
    ))
}
