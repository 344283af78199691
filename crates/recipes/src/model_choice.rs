//! The `[model]` table of an experiment: a preset, and whatever differs from it.

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use toml::{Table, Value};
use vae::{BevVaeConfig, Preset};

use crate::config_file::merge;

/// A preset with overrides. Reads `preset = "tiny"` plus any field of [`BevVaeConfig`]; writes every field.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelChoice {
    /// The sizes it starts from.
    pub preset: Preset,
    /// The sizes that result, checked.
    pub config: BevVaeConfig,
}

impl From<Preset> for ModelChoice {
    fn from(preset: Preset) -> Self {
        Self { preset, config: preset.config() }
    }
}

impl<'de> Deserialize<'de> for ModelChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        use serde::de::Error;
        let mut table = Table::deserialize(deserializer)?;
        let preset = table.remove("preset").ok_or_else(|| D::Error::missing_field("preset"))?;
        let preset: Preset = preset.try_into().map_err(D::Error::custom)?;
        let base = Value::try_from(preset.config()).map_err(D::Error::custom)?;
        let config: BevVaeConfig = merge(base, Value::Table(table)).try_into().map_err(D::Error::custom)?;
        Ok(Self { preset, config: config.checked().map_err(D::Error::custom)? })
    }
}

impl Serialize for ModelChoice {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::Error;
        let mut table = Table::new();
        table.insert("preset".to_owned(), Value::try_from(self.preset).map_err(S::Error::custom)?);
        let config = Value::try_from(&self.config).map_err(S::Error::custom)?;
        merge(Value::Table(table), config).serialize(serializer)
    }
}

#[cfg(test)]
mod tests {
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
