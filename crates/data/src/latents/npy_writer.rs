//! Writing the layout of the published latents.

use half::f16;

use super::npy_tree::NpyTreeConfig;
use super::{Latent, LatentType, NpyLayout, write_whole};
use crate::npz::{Dtype, npy_bytes};
use crate::{DataError, SceneFrame};

/// Writes a tree; files that are there already are left out, each appears whole or not at all.
#[derive(Debug, Clone)]
pub struct NpyTreeWriter {
    config: NpyTreeConfig,
    layout: NpyLayout,
    shape: [usize; 3],
    dtype: LatentType,
}

impl NpyTreeWriter {
    /// Without a declared layout means alone are written, as tokens.
    ///
    /// # Errors
    /// A split that is no plain name.
    pub fn new(config: NpyTreeConfig, shape: [usize; 3], dtype: LatentType) -> Result<Self, DataError> {
        crate::staging::check_names("split", std::slice::from_ref(&config.split))?;
        let layout = config.layout.unwrap_or(NpyLayout::Tokens);
        Ok(Self { config, layout, shape, dtype })
    }

    /// Whether the frame's file is there already.
    pub fn has(&self, frame: &SceneFrame) -> bool {
        self.config.file(&frame.id.scene, frame.timestamp_ns).is_file()
    }

    /// Writes one file. Only [`NpyLayout::MomentsTokens`] keeps the variance.
    ///
    /// # Errors
    /// A scene whose name is no plain file name, a number that half precision cannot hold, a file that cannot be written.
    pub fn add(&self, frame: &SceneFrame, latent: &Latent) -> Result<(), DataError> {
        crate::staging::check_names("scene", std::slice::from_ref(&frame.id.scene))?;
        crate::staging::create_dir(&self.config.scene(&frame.id.scene))?;
        let path = self.config.file(&frame.id.scene, frame.timestamp_ns);
        let latent = latent.clone().checked(self.shape, &path)?;
        let [_, h, w] = self.shape;
        let planes: Vec<&[f32]> = match (&latent.log_var, self.layout) {
            (Some(log_var), NpyLayout::MomentsTokens) => {
                latent.mean.chunks(h * w).chain(log_var.chunks(h * w)).collect()
            }
            (None, NpyLayout::MomentsTokens) => {
                return Err(DataError::Config("this latent has no variance to write as moments".to_owned()));
            }
            _ => latent.mean.chunks(h * w).collect(),
        };
        let values: Vec<f32> = if self.layout.channels_last() {
            (0..h * w).flat_map(|cell| planes.iter().filter_map(move |plane| plane.get(cell)).copied()).collect()
        } else {
            planes.concat()
        };
        let shapes = self.layout.shapes(self.shape);
        let shape = shapes.first().map_or(&[][..], |(shape, _)| shape);
        let bytes = match self.dtype {
            LatentType::F32 => {
                npy_bytes(Dtype::F32, shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())?
            }
            LatentType::F16 => {
                if let Some(value) = values.iter().find(|value| !f16::from_f32(**value).is_finite()) {
                    let why = format!("{value} does not fit half precision; write f32 instead");
                    return Err(DataError::Format { format: "latent", why, path });
                }
                let halves = values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect::<Vec<_>>();
                npy_bytes(Dtype::F16, shape, &halves)?
            }
        };
        write_whole(&path, &bytes)
    }
}
