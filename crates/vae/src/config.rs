//! Sizes of BEV-VAE and its presets.

use geometry::{BevGrid, Frustum, FrustumPixels};
use serde::{Deserialize, Serialize};

/// Levels of both feature pyramids.
pub const LEVELS: usize = 3;

/// Every size of the network. Two equal configs build networks that exchange weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BevVaeConfig {
    /// Pictures and their transformers.
    pub image: ImageConfig,
    /// Voxel features and the two deformable stacks.
    pub scene: SceneConfig,
    /// Voxel grid in the ego frame.
    pub grid: BevGrid,
    /// BEV tokens.
    pub state: StateConfig,
    /// Channels of the latent.
    pub latent_channels: usize,
    /// Points at which a target camera looks into the scene.
    pub frustum: Frustum,
}

/// Sizes of the image encoder and decoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageConfig {
    /// Network picture height, px.
    pub height: usize,
    /// Network picture width, px.
    pub width: usize,
    /// Patch size, px.
    pub patch: usize,
    /// Token width; divided by 4 in the finest pyramid level.
    pub channels: usize,
    /// Attention heads.
    pub heads: usize,
    /// Blocks of the encoder.
    pub encoder_blocks: usize,
    /// Blocks of the decoder.
    pub decoder_blocks: usize,
}

/// Sizes of the scene encoder and decoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// Channels of a voxel feature.
    pub channels: usize,
    /// Heads of the deformable attention.
    pub heads: usize,
    /// Groups of every group norm in the pyramids.
    pub norm_groups: usize,
    /// Blocks of the scene encoder.
    pub encoder_blocks: usize,
    /// Blocks of the scene decoder.
    pub decoder_blocks: usize,
    /// Sample points per head and level in the encoder.
    pub encoder_points: usize,
    /// Sample points per head and level in the decoder.
    pub decoder_points: usize,
}

/// Sizes of the state encoder and decoder. Their heads are the height slices of the grid, one head each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateConfig {
    /// Cells along y and x that become one BEV token.
    pub patch: usize,
    /// Token channels per height slice, which is also the head width.
    pub channels_per_height: usize,
    /// Channels a voxel is squeezed to before patching.
    pub squeeze_channels: usize,
    /// Blocks of each state stack.
    pub blocks: usize,
}

/// Named sizes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Seconds on a CPU: tests.
    Debug,
    /// Minutes on a CPU: 64×64 pictures.
    Tiny,
    /// A workstation GPU: 128×128 pictures.
    Small,
    /// The paper's network, 262.8 M parameters, 256×256 pictures.
    Paper,
}

/// A size that cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("model config: {0}")]
pub struct ConfigError(pub String);

impl Preset {
    /// The preset's sizes.
    pub fn config(self) -> BevVaeConfig {
        match self {
            Self::Debug => debug(),
            Self::Tiny => tiny(),
            Self::Small => small(),
            Self::Paper => paper(),
        }
    }

    /// Channels of the discriminator at full resolution.
    pub const fn discriminator_channels(self) -> usize {
        match self {
            Self::Debug => 8,
            Self::Tiny => 16,
            Self::Small => 32,
            Self::Paper => 64,
        }
    }
}

fn debug() -> BevVaeConfig {
    BevVaeConfig {
        image: image(32, 32, 2, 1),
        scene: scene(12, 2, 4, 1, [2, 2]),
        grid: grid(25.6, [4, 8, 8]),
        state: StateConfig { patch: 2, channels_per_height: 12, squeeze_channels: 3, blocks: 1 },
        latent_channels: 4,
        frustum: frustum(4, 6.0, 4),
    }
}

fn tiny() -> BevVaeConfig {
    BevVaeConfig {
        image: image(64, 128, 4, 4),
        scene: scene(24, 3, 8, 2, [3, 4]),
        grid: grid(25.6, [4, 32, 32]),
        state: StateConfig { patch: 4, channels_per_height: 24, squeeze_channels: 3, blocks: 2 },
        latent_channels: 8,
        frustum: frustum(16, 2.0, 8),
    }
}

fn small() -> BevVaeConfig {
    BevVaeConfig {
        image: image(128, 384, 6, 6),
        scene: scene(48, 3, 16, 4, [3, 4]),
        grid: grid(51.2, [8, 64, 64]),
        state: StateConfig { patch: 4, channels_per_height: 48, squeeze_channels: 6, blocks: 4 },
        latent_channels: 16,
        frustum: frustum(30, 2.0, 16),
    }
}

fn paper() -> BevVaeConfig {
    BevVaeConfig {
        image: image(256, 768, 12, 12),
        scene: scene(96, 3, 32, 6, [3, 4]),
        grid: grid(51.2, [8, 128, 128]),
        state: StateConfig { patch: 4, channels_per_height: 96, squeeze_channels: 6, blocks: 6 },
        latent_channels: 16,
        frustum: Frustum { pixels: FrustumPixels::EndToEnd, ..frustum(60, 1.0, 32) },
    }
}

fn image(size: usize, channels: usize, heads: usize, blocks: usize) -> ImageConfig {
    ImageConfig { height: size, width: size, patch: 8, channels, heads, encoder_blocks: blocks, decoder_blocks: blocks }
}

fn scene(channels: usize, heads: usize, norm_groups: usize, blocks: usize, points: [usize; 2]) -> SceneConfig {
    SceneConfig {
        channels,
        heads,
        norm_groups,
        encoder_blocks: blocks,
        decoder_blocks: blocks,
        encoder_points: points[0],
        decoder_points: points[1],
    }
}

/// Square grid of ±`half` metres, −5 to 3 m high.
fn grid(half: f64, cells: [usize; 3]) -> BevGrid {
    BevGrid { x_range: [-half, half], y_range: [-half, half], z_range: [-5.0, 3.0], cells }
}

fn frustum(depths: usize, bin_m: f64, rays: usize) -> Frustum {
    Frustum { depths, bin_m, rows: rays, columns: rays, pixels: FrustumPixels::PatchCentre }
}

impl BevVaeConfig {
    /// Patch rows and columns of a picture.
    pub fn image_tokens(&self) -> [usize; 2] {
        [self.image.height / self.image.patch, self.image.width / self.image.patch]
    }

    /// Rows (y) and columns (x) of BEV tokens, which is the latent's size.
    pub fn state_tokens(&self) -> [usize; 2] {
        [self.grid.cells[1] / self.state.patch, self.grid.cells[2] / self.state.patch]
    }

    /// Width of a BEV token.
    pub fn state_channels(&self) -> usize {
        self.grid.cells[0] * self.state.channels_per_height
    }

    /// (rows, columns) of the image pyramid, finest first.
    pub fn image_levels(&self) -> [[usize; 2]; LEVELS] {
        let [h, w] = self.image_tokens();
        [[4 * h, 4 * w], [2 * h, 2 * w], [h, w]]
    }

    /// (z, y, x) of the scene pyramid, coarsest first, the order that the released weights' offset layers use.
    pub fn scene_levels(&self) -> [[usize; 3]; LEVELS] {
        [4, 2, 1].map(|step| self.grid.cells.map(|cells| cells / step))
    }

    /// Checks every relation between sizes before anything is built.
    ///
    /// # Errors
    /// The first relation that does not hold, with the numbers.
    pub fn checked(self) -> Result<Self, ConfigError> {
        self.check_image()?;
        self.check_scene()?;
        self.check_state()?;
        self.grid.checked().map_err(|error| ConfigError(error.to_string()))?;
        Ok(self)
    }

    fn check_image(&self) -> Result<(), ConfigError> {
        let i = &self.image;
        divides("image.patch", i.patch, "image.height", i.height)?;
        divides("image.patch", i.patch, "image.width", i.width)?;
        divides("image.heads", i.heads, "image.channels", i.channels)?;
        divides("the rotary axis split 4", 4, "the image head width", i.channels / i.heads)?;
        let [rows, columns] = self.image_tokens();
        if [rows, columns] != [self.frustum.rows, self.frustum.columns] {
            let got = [self.frustum.rows, self.frustum.columns];
            return fail(format!("frustum rays {got:?} must equal the picture's patches {:?}", [rows, columns]));
        }
        if self.frustum.depths == 0 || self.frustum.bin_m.is_nan() || self.frustum.bin_m <= 0.0 {
            return fail("the frustum needs at least one depth bin of positive length".to_owned());
        }
        Ok(())
    }

    fn check_scene(&self) -> Result<(), ConfigError> {
        let s = &self.scene;
        divides("scene.heads", s.heads, "scene.channels", s.channels)?;
        for (what, channels) in [
            ("scene.channels", s.channels),
            ("image.channels", self.image.channels),
            ("image.channels / 4", self.image.channels / 4),
        ] {
            divides("scene.norm_groups", s.norm_groups, what, channels)?;
        }
        for (axis, cells) in
            ["grid cells along z", "grid cells along y", "grid cells along x"].iter().zip(self.grid.cells)
        {
            divides("the coarsest pyramid step 4", 4, axis, cells)?;
        }
        Ok(())
    }

    fn check_state(&self) -> Result<(), ConfigError> {
        divides("state.patch", self.state.patch, "grid cells along y", self.grid.cells[1])?;
        divides("state.patch", self.state.patch, "grid cells along x", self.grid.cells[2])?;
        divides("the rotary axis split 6", 6, "state.channels_per_height", self.state.channels_per_height)?;
        if self.latent_channels == 0 || self.state.squeeze_channels == 0 {
            return fail("latent_channels and state.squeeze_channels must be positive".to_owned());
        }
        Ok(())
    }
}

fn divides(what: &str, divisor: usize, whole_name: &str, whole: usize) -> Result<(), ConfigError> {
    if divisor == 0 || whole == 0 || !whole.is_multiple_of(divisor) {
        return fail(format!("{what} ({divisor}) must divide {whole_name} ({whole})"));
    }
    Ok(())
}

fn fail(why: String) -> Result<(), ConfigError> {
    Err(ConfigError(why))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_sound_and_mistakes_are_named() {
        for preset in [Preset::Debug, Preset::Tiny, Preset::Small, Preset::Paper] {
            preset.config().checked().unwrap();
        }
        let mut config = Preset::Tiny.config();
        config.grid.cells[0] = 6;
        assert!(config.checked().unwrap_err().0.contains("grid cells along z (6)"));
    }
}
