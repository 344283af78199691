//! `rigscape info`: sizes of presets, experiments and checkpoints, and the known weight files.

use std::path::PathBuf;

use burn::module::Module;
use clap::Parser;
use features::{KNOWN_WEIGHTS, KnownWeights};
use nn::Init;
use train::{DeviceConfig, find_checkpoint};
use vae::{BevVae, BevVaeConfig, Discriminator, Preset};

use super::common::say;
use crate::bev_vae::Experiment;
use crate::rigs::RigChoice;
use crate::{ModelChoice, config_file};

/// Print the sizes of a preset, of an experiment's model, what a checkpoint holds, a rig, or which weight files are known
#[derive(Debug, Parser)]
pub struct InfoArgs {
    /// Preset: debug, tiny, small or paper
    #[arg(long, value_name = "NAME", value_parser = parse_preset, conflicts_with_all = ["config", "checkpoint"])]
    pub preset: Option<Preset>,
    /// Experiment file
    #[arg(long, value_name = "FILE", conflicts_with = "checkpoint")]
    pub config: Option<PathBuf>,
    /// Run folder or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: Option<PathBuf>,
    /// Other cameras; the help text names the choices.
    #[arg(long, value_name = "RIG", help = "Print a rig as JSON, to start a rig file from: a built-in one's name, or what --rig of other commands takes", conflicts_with_all = ["preset", "config", "checkpoint", "weights"])]
    pub rig: Option<RigChoice>,
    /// List the weight files that metrics and losses know: where they come from, licence, stand-ins
    #[arg(long, conflicts_with_all = ["preset", "config", "checkpoint"])]
    pub weights: bool,
}

fn parse_preset(text: &str) -> Result<Preset, String> {
    let value = toml::Value::String(text.to_owned());
    value.try_into().map_err(|_| format!("there is no preset {text:?}, only debug, tiny, small, paper"))
}

/// Runs the command.
///
/// # Errors
/// Unreadable files.
pub fn info(args: &InfoArgs) -> anyhow::Result<()> {
    if let Some(choice) = &args.rig {
        return say(serde_json::to_string_pretty(&choice.open()?)?);
    }
    if args.weights {
        return KNOWN_WEIGHTS.iter().try_for_each(list_weights);
    }
    if let Some(path) = &args.checkpoint {
        let reader = find_checkpoint(path)?;
        let state = reader.state();
        say(format_args!(
            "{}: step {}, {} batches taken, seed {}",
            reader.folder().display(),
            state.step,
            state.position,
            state.seed
        ))?;
        for (name, value) in &state.scalars {
            say(format_args!("  {name} {}", value.map_or_else(|| "not finite".to_owned(), |v| format!("{v:.4}"))))?;
        }
        let experiment: Experiment = config_file::parse(&reader.config_text("model")?, &[])?;
        return describe(&experiment.model);
    }
    if let Some(path) = &args.config {
        return describe(&config_file::load::<Experiment>(path, &[])?.model);
    }
    match args.preset {
        Some(preset) => describe(&ModelChoice::from(preset)),
        None => [Preset::Debug, Preset::Tiny, Preset::Small, Preset::Paper]
            .into_iter()
            .try_for_each(|preset| describe(&ModelChoice::from(preset))),
    }
}

fn list_weights(known: &KnownWeights) -> anyhow::Result<()> {
    let bytes = known.bytes.map_or_else(|| "size not recorded".to_owned(), |bytes| format!("{bytes} bytes"));
    say(format_args!("{}: {bytes}, sha256 {}", known.file, known.sha256.unwrap_or("not recorded")))?;
    say(format_args!("  for      {}", known.metric))?;
    say(format_args!("  from     {}", known.source))?;
    say(format_args!("  licence  {}", known.licence))?;
    match known.stand_in {
        Some(other) => say(format_args!("  or use   {}, then the number is called {}", other.file, other.metric)),
        None => Ok(()),
    }
}

fn describe(choice: &ModelChoice) -> anyhow::Result<()> {
    let device = DeviceConfig::Flex.open()?;
    let config: &BevVaeConfig = &choice.config;
    let model = BevVae::new(config, &mut Init::new(0, &device));
    let channels = choice.preset.discriminator_channels();
    let discriminator =
        Discriminator::new(config.image.height, config.image.width, channels, &mut Init::new(0, &device))
            .map_or_else(|_| "none fits".to_owned(), |network| network.num_params().to_string());
    let [rows, columns] = config.state_tokens();
    let [z, y, x] = config.grid.cells;
    say(format_args!(
        "preset {:?}: {} parameters (encoder {}, decoder {}, bottleneck {} + {}), discriminator {discriminator}",
        choice.preset,
        model.num_params(),
        model.encoder.num_params(),
        model.decoder.num_params(),
        model.pre_quant.num_params(),
        model.post_quant.num_params()
    ))?;
    say(format_args!(
        "  pictures {}x{}, grid {z}x{y}x{x} (z, y, x), latent {}x{rows}x{columns}, frustum {}x{}x{} of {} m bins",
        config.image.width,
        config.image.height,
        config.latent_channels,
        config.frustum.depths,
        config.frustum.rows,
        config.frustum.columns,
        config.frustum.bin_m
    ))
}
