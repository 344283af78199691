//! Where decoded pictures go: a contact sheet, and if asked for one file per camera with the rig that it shows.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use data::{ImageSize, SceneFrame};
use geometry::{CameraRig, ImageEdit, Lens};

use crate::evaluate::write_file;
use crate::sheet::{rgb_image, save_picture};

/// Options of every command that decodes pictures.
#[derive(Debug, Clone, Args)]
pub struct PictureArgs {
    /// Contact sheet to write, .png or .jpg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Also write every decoded picture by itself into this folder, with the cameras it was decoded for (rig.json)
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// File type of --pictures
    #[arg(long, value_enum, default_value = "png", requires = "pictures")]
    pub format: PictureFormat,
}

/// File types of single pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PictureFormat {
    /// Lossless
    Png,
    /// Smaller
    Jpg,
}

impl PictureArgs {
    /// Complains about an unusable --out before anything is computed.
    pub(super) fn check(&self) -> anyhow::Result<()> {
        let known = image::ImageFormat::from_path(&self.out).ok();
        let writable =
            known.is_some_and(|format| [image::ImageFormat::Png, image::ImageFormat::Jpeg].contains(&format));
        if writable {
            Ok(())
        } else {
            Err(super::UsageError::of(format!("--out {}: needs the ending .png or .jpg", self.out.display())))
        }
    }

    /// Writes the pictures of one frame as `<views>/<dataset>_<scene>_<frame>/<camera>.png`, and their cameras beside them.
    pub(super) fn save(
        &self,
        views: &str,
        frame: &SceneFrame,
        rig: &CameraRig,
        decoded: &[Vec<f32>],
        size: ImageSize,
    ) -> anyhow::Result<()> {
        let Some(root) = &self.pictures else { return Ok(()) };
        let id = &frame.id;
        let folder = root.join(file_name(views)).join(file_name(&format!("{}_{}_{}", id.dataset, id.scene, id.frame)));
        let ending = match self.format {
            PictureFormat::Png => "png",
            PictureFormat::Jpg => "jpg",
        };
        for (camera, values) in rig.cameras.iter().zip(decoded) {
            let path = folder.join(format!("{}.{ending}", file_name(&camera.channel)));
            save_picture(&rgb_image(values, size.height, size.width), &path)?;
        }
        write_rig(&folder.join("rig.json"), &shown(rig, size))
    }
}

/// The cameras of decoded pictures: pinholes of the pictures' size.
fn shown(rig: &CameraRig, size: ImageSize) -> CameraRig {
    let mut rig = rig.clone();
    for camera in &mut rig.cameras {
        let raw = camera.intrinsics;
        camera.intrinsics = ImageEdit::identity(raw.width, raw.height).resize(size.width, size.height).intrinsics(&raw);
        camera.lens = Lens::Pinhole;
    }
    rig
}

fn write_rig(path: &Path, rig: &CameraRig) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(rig).with_context(|| format!("cannot write {}", path.display()))?;
    write_file(path, text.as_bytes())
}

/// Letters, digits, `.`, `+`, `-` and `_` of a name stay; a name of dots alone, which would be another folder, does not.
fn file_name(name: &str) -> String {
    let keep = |c: char| if c.is_ascii_alphanumeric() || "+-_.".contains(c) { c } else { '_' };
    let name: String = name.chars().map(keep).collect();
    if name.chars().all(|c| c == '.') { "_".repeat(name.len().max(1)) } else { name }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside_the_folder() {
        assert_eq!(file_name("waymo yaw +30"), "waymo_yaw_+30");
        assert_eq!([file_name(".."), file_name("a/../b"), file_name("")], ["__", "a_.._b", "_"]);
    }

    #[test]
    fn shown_cameras_are_pinholes_of_the_pictures_size() {
        let rig = shown(&geometry::RigPreset::NuPlan.rig(), ImageSize { height: 64, width: 96 });
        let camera = &rig.cameras[0];
        assert_eq!((camera.lens, camera.intrinsics.width, camera.intrinsics.height), (Lens::Pinhole, 96, 64));
        assert!((camera.intrinsics.fx - 1545.0 * 96.0 / 1920.0).abs() < 1e-9);
    }
}
