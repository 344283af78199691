//! The `[model]` table of an experiment: a preset, and whatever differs from it.

use std::fmt::Debug;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use stable_diffusion::{UNetConfig, VaeConfig};
use toml::{Table, Value};
use vae::BevVaeConfig;

use crate::config_file::merge;

/// The presets of one kind of network.
pub trait Sizes: Copy + Debug + PartialEq + Serialize + DeserializeOwned {
    /// Every size of the network.
    type Config: Clone + Debug + PartialEq + Serialize + DeserializeOwned;

    /// The preset's sizes.
    fn config(self) -> Self::Config;

    /// The sizes, if they build a network.
    ///
    /// # Errors
    /// A text that names the size.
    fn checked(config: Self::Config) -> Result<Self::Config, String>;
}

/// A preset with overrides. Reads `preset = "tiny"` plus any field of the network's config; writes every field.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice<P: Sizes> {
    /// The sizes it starts from.
    pub preset: P,
    /// The sizes that result, checked.
    pub config: P::Config,
}

/// BEV-VAE.
pub type ModelChoice = Choice<vae::Preset>;

impl Sizes for vae::Preset {
    type Config = BevVaeConfig;

    fn config(self) -> BevVaeConfig {
        Self::config(self)
    }

    fn checked(config: BevVaeConfig) -> Result<BevVaeConfig, String> {
        config.checked().map_err(|error| error.to_string())
    }
}

/// The autoencoder of a latent diffusion preset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct AutoencoderSizes(pub stable_diffusion::Preset);

impl Sizes for AutoencoderSizes {
    type Config = VaeConfig;

    fn config(self) -> VaeConfig {
        self.0.vae()
    }

    fn checked(config: VaeConfig) -> Result<VaeConfig, String> {
        config.checked().map_err(|error| error.to_string())
    }
}

/// The UNet of a latent diffusion preset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct UNetSizes(pub stable_diffusion::Preset);

impl Sizes for UNetSizes {
    type Config = UNetConfig;

    fn config(self) -> UNetConfig {
        self.0.unet()
    }

    fn checked(config: UNetConfig) -> Result<UNetConfig, String> {
        config.checked().map_err(|error| error.to_string())
    }
}

impl<P: Sizes> From<P> for Choice<P> {
    fn from(preset: P) -> Self {
        Self { preset, config: preset.config() }
    }
}

impl<'de, P: Sizes> Deserialize<'de> for Choice<P> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        use serde::de::Error;
        let mut table = Table::deserialize(deserializer)?;
        let preset = table.remove("preset").ok_or_else(|| D::Error::missing_field("preset"))?;
        let preset: P = preset.try_into().map_err(D::Error::custom)?;
        let base = Value::try_from(preset.config()).map_err(D::Error::custom)?;
        let config: P::Config = merge(base, Value::Table(table)).try_into().map_err(D::Error::custom)?;
        Ok(Self { preset, config: P::checked(config).map_err(D::Error::custom)? })
    }
}

impl<P: Sizes> Serialize for Choice<P> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::Error;
        let mut table = Table::new();
        table.insert("preset".to_owned(), Value::try_from(self.preset).map_err(S::Error::custom)?);
        let config = Value::try_from(&self.config).map_err(S::Error::custom)?;
        merge(Value::Table(table), config).serialize(serializer)
    }
}

/// What differs between two configs, one line per key: `image.height = 64 instead of 256`.
///
/// # Errors
/// A config that has no TOML form.
pub fn differences<C: Serialize>(usual: &C, other: &C) -> Result<Vec<String>, toml::ser::Error> {
    let mut lines = Vec::new();
    collect_differences("", &Value::try_from(usual)?, &Value::try_from(other)?, &mut lines);
    Ok(lines)
}

fn collect_differences(path: &str, usual: &Value, other: &Value, lines: &mut Vec<String>) {
    match (usual, other) {
        (Value::Table(usual), Value::Table(other)) => {
            let absent = Value::String("none".to_owned());
            let keys: std::collections::BTreeSet<&String> = usual.keys().chain(other.keys()).collect();
            for key in keys {
                let inner = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                let value = |table: &'_ Table| table.get(key).cloned().unwrap_or_else(|| absent.clone());
                collect_differences(&inner, &value(usual), &value(other), lines);
            }
        }
        (usual, other) if usual != other => lines.push(format!("{path} = {other} instead of {usual}")),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use vae::Preset;

    use super::*;

    #[test]
    fn a_preset_with_overrides_survives_a_round_trip() {
        let text = "preset = \"tiny\"\nlatent_channels = 12\n[image]\nencoder_blocks = 2\n";
        let choice: ModelChoice = toml::from_str(text).unwrap();
        assert_eq!((choice.config.latent_channels, choice.config.image.encoder_blocks), (12, 2));
        assert_eq!(choice.config.image.decoder_blocks, Preset::Tiny.config().image.decoder_blocks);
        let again: ModelChoice = toml::from_str(&toml::to_string(&choice).unwrap()).unwrap();
        assert_eq!(choice, again);
    }

    #[test]
    fn latent_diffusion_networks_are_chosen_alike() {
        let text = "preset = \"tiny\"\n[encoder]\ncross_view = \"sum\"\n";
        let choice: Choice<UNetSizes> = toml::from_str(text).unwrap();
        assert!(choice.config.encoder.needs_views());
        let again: Choice<UNetSizes> = toml::from_str(&toml::to_string(&choice).unwrap()).unwrap();
        assert_eq!(choice, again);
        let choice: Choice<AutoencoderSizes> = toml::from_str("preset = \"debug\"\nresnets_per_level = 2").unwrap();
        assert_eq!(choice.config.resnets_per_level, 2);
        let error = toml::from_str::<Choice<AutoencoderSizes>>("preset = \"debug\"\nnorm_groups = 3").unwrap_err();
        assert!(error.to_string().contains("norm_groups 3 must divide"), "{error}");
    }

    #[test]
    fn differences_name_every_key() {
        let paper = Preset::Paper.config();
        assert!(differences(&paper, &paper).unwrap().is_empty());
        let mut other = paper.clone();
        other.image.heads = 6;
        other.grid.cells[0] = 4;
        let lines = differences(&paper, &other).unwrap();
        assert_eq!(lines, ["grid.cells = [4, 128, 128] instead of [8, 128, 128]", "image.heads = 6 instead of 12"]);
    }

    #[test]
    fn mistakes_are_named() {
        for (text, want) in [
            ("preset = \"huge\"", "huge"),
            ("latent_channels = 4", "preset"),
            ("preset = \"tiny\"\nlatnt_channels = 4", "latnt_channels"),
            ("preset = \"tiny\"\n[image]\npatch = 7", "image.patch (7) must divide"),
        ] {
            let error = toml::from_str::<ModelChoice>(text).unwrap_err().to_string();
            assert!(error.contains(want), "{text}: {error}");
        }
    }
}
