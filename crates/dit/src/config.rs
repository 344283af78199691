//! Sizes of the transformer and its presets.

use serde::{Deserialize, Serialize};

/// Every size of the network. Two equal configs build networks that exchange weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DitConfig {
    /// Channels of the latent.
    pub latent_channels: usize,
    /// Rows (y) and columns (x) of the latent.
    pub latent_size: [usize; 2],
    /// Rows and columns of the latent that become one token.
    pub patch: usize,
    /// Token width D.
    pub width: usize,
    /// Blocks.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// What the last layer gives.
    #[serde(default)]
    pub output: OutputConfig,
    /// What steers the samples.
    pub condition: ConditionConfig,
}

/// What the last layer gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputConfig {
    /// The target (noise, velocity or clean latent), C channels.
    #[default]
    Target,
    /// The target and, in C further channels, where between its bounds the variance lies.
    TargetAndVariance,
}

/// What steers the samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ConditionConfig {
    /// Binary occupancy `[K, Z, p·h, p·w]` of boxes, added to the tokens.
    Layout {
        /// K
        classes: usize,
        /// Z, height slices of the occupancy; must divide the width.
        slices: usize,
        /// p, rows and columns of the occupancy that one token covers.
        patch: usize,
    },
    /// One of some classes, added to the time; one more stands for "none".
    Labels {
        /// Classes without the one for "none".
        classes: usize,
    },
}

/// Named depths and widths, the table of the paper plus three small ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// 2 blocks of width 48: tests.
    Debug,
    /// 4 blocks of width 96: minutes on a CPU.
    Tiny,
    /// 8 blocks of width 384.
    Small,
    /// 12 blocks of width 384.
    S,
    /// 12 blocks of width 768, the width of the BEV-VAE paper.
    #[serde(alias = "paper")]
    B,
    /// 24 blocks of width 1024.
    L,
    /// 28 blocks of width 1152.
    Xl,
}

impl Preset {
    /// Depth, width and heads.
    pub const fn sizes(self) -> [usize; 3] {
        match self {
            Self::Debug => [2, 48, 4],
            Self::Tiny => [4, 96, 4],
            Self::Small => [8, 384, 6],
            Self::S => [12, 384, 6],
            Self::B => [12, 768, 12],
            Self::L => [24, 1024, 16],
            Self::Xl => [28, 1152, 16],
        }
    }

    /// The preset over a latent of `[channels, rows, columns]`, one token per cell, the target alone as output.
    pub fn config(self, [channels, rows, columns]: [usize; 3], condition: ConditionConfig) -> DitConfig {
        let [depth, width, heads] = self.sizes();
        let (latent_size, output) = ([rows, columns], OutputConfig::Target);
        DitConfig { latent_channels: channels, latent_size, patch: 1, width, depth, heads, output, condition }
    }
}

/// A size that cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("model config: {0}")]
pub struct ConfigError(pub String);

impl DitConfig {
    /// Token rows and columns.
    pub fn token_grid(&self) -> [usize; 2] {
        self.latent_size.map(|size| size / self.patch.max(1))
    }

    /// Channels of the network's output.
    pub fn output_channels(&self) -> usize {
        match self.output {
            OutputConfig::Target => self.latent_channels,
            OutputConfig::TargetAndVariance => 2 * self.latent_channels,
        }
    }

    /// # Errors
    /// [`ConfigError`] naming the first size that does not fit.
    pub fn checked(self) -> Result<Self, ConfigError> {
        let refuse = |why: String| Err(ConfigError(why));
        let sizes =
            [self.latent_channels, self.latent_size[0], self.latent_size[1], self.patch, self.width, self.heads];
        if sizes.contains(&0) || self.depth == 0 {
            return refuse("every size starts at 1".to_owned());
        }
        if self.latent_size.iter().any(|size| size % self.patch != 0) {
            return refuse(format!("patch {} must divide the latent's {:?} cells", self.patch, self.latent_size));
        }
        if !self.width.is_multiple_of(self.heads) {
            return refuse(format!("{} heads must divide the width {}", self.heads, self.width));
        }
        if !self.width.is_multiple_of(4) {
            return refuse(format!("the position code needs a width divisible by 4, not {}", self.width));
        }
        match self.condition {
            ConditionConfig::Layout { classes, slices, patch } if classes == 0 || slices == 0 || patch == 0 => {
                refuse("a layout needs classes, slices and a patch from 1".to_owned())
            }
            ConditionConfig::Layout { slices, .. } if !self.width.is_multiple_of(slices) => {
                refuse(format!("{slices} height slices of the layout must divide the width {}", self.width))
            }
            ConditionConfig::Labels { classes: 0 } => refuse("labels need at least one class".to_owned()),
            _ => Ok(self),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_hold_together_and_faults_are_named() {
        let layout = ConditionConfig::Layout { classes: 10, slices: 4, patch: 4 };
        for preset in [Preset::Debug, Preset::Tiny, Preset::Small, Preset::S, Preset::B, Preset::L, Preset::Xl] {
            let config = preset.config([16, 32, 32], layout).checked().unwrap();
            assert_eq!(config.token_grid(), [32, 32]);
        }
        let base = Preset::Tiny.config([8, 8, 8], layout);
        let refused = |config: DitConfig, text: &str| {
            let error = config.checked().unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        };
        refused(DitConfig { heads: 5, ..base.clone() }, "heads");
        refused(DitConfig { patch: 3, ..base.clone() }, "patch 3");
        refused(DitConfig { depth: 0, ..base.clone() }, "starts at 1");
        refused(DitConfig { width: 98, heads: 2, ..base.clone() }, "divisible by 4");
        let condition = ConditionConfig::Layout { classes: 1, slices: 5, patch: 1 };
        refused(DitConfig { condition, ..base }, "5 height slices");
    }
}
