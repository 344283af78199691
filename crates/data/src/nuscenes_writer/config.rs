//! What to write, and what was written.

use std::path::PathBuf;

use geometry::{CameraRig, Intrinsics, Lens, RigCamera};
use serde::{Deserialize, Serialize};
use world::{RenderOptions, WorldConfig};

use super::timing;
use crate::DataError;
use crate::manifest::WriterManifest;
use crate::staging::check_names;

/// Names of the official mini split. Scenes borrow them so that `mini_train` and `mini_val` of any tool select scenes.
const MINI_TRAIN: [&str; 8] =
    ["scene-0061", "scene-0553", "scene-0655", "scene-0757", "scene-0796", "scene-1077", "scene-1094", "scene-1100"];
const MINI_VAL: [&str; 2] = ["scene-0103", "scene-0916"];
/// The release's numbers end at 1110.
const FIRST_FREE_NUMBER: usize = 2000;
/// Longest scene the procedural world offers, seconds.
const LONGEST_SCENE_SECS: f64 = 60.0;

/// A procedural dataset in the nuScenes layout.
///
/// Start from [`NuScenesWriterConfig::new`] and change fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NuScenesWriterConfig {
    /// Folder to make. Not part of the manifest, so that the same dataset has the same bytes anywhere.
    #[serde(skip)]
    pub out: PathBuf,
    /// Replace `out` if this tool wrote it. A folder without a manifest is never replaced.
    #[serde(skip)]
    pub force: bool,
    /// Name of the tables' folder.
    pub version: String,
    /// Number of scenes; each is a world of its own.
    pub scenes: usize,
    /// The one seed of everything.
    pub seed: u64,
    /// Key frames (2 Hz) per scene; 40 in the release.
    pub key_frames_per_scene: usize,
    /// Also write the pictures between key frames, 12 Hz in all.
    pub sweeps: bool,
    /// Probability that a sweep is lost, as happens in the release; 0 keeps all.
    pub sweep_drop_share: f64,
    /// Cameras, which must be pinholes: the layout has no field for a lens.
    pub rig: CameraRig,
    /// Width and height of the pictures in pixels; the intrinsics scale along. `None` keeps each camera's own size.
    pub image_size: Option<(u32, u32)>,
    /// 1 to 100.
    pub jpeg_quality: u8,
    /// Names of the scenes. Empty: the official mini names, `mini_train` first and `mini_val` for the last fifth (at least one
    /// from two scenes on), so that split selection works; an eleventh scene and further ones are `scene-2000` and on.
    pub scene_names: Vec<String>,
    /// Directions per turn of the 32-beam lidar; 1080 on the real car, 0 writes empty files and counts no points.
    pub lidar_columns: u32,
    /// The generator's knobs. `duration_secs` is raised where the key frames need more.
    pub world: WorldConfig,
    /// How pictures are rendered.
    pub render: RenderOptions,
}

impl NuScenesWriterConfig {
    /// Ten scenes of 40 key frames in `v1.0-mini`, without sweeps, pictures of the rig's own size, JPEG quality 95.
    pub fn new(out: PathBuf, rig: CameraRig) -> Self {
        Self {
            out,
            force: false,
            version: "v1.0-mini".to_owned(),
            scenes: MINI_TRAIN.len() + MINI_VAL.len(),
            seed: 0,
            key_frames_per_scene: 40,
            sweeps: false,
            sweep_drop_share: 0.0,
            rig,
            image_size: None,
            jpeg_quality: 95,
            scene_names: vec![],
            lidar_columns: 360,
            world: WorldConfig::default(),
            render: RenderOptions::default(),
        }
    }

    /// The names the scenes get, in order.
    pub fn resolved_scene_names(&self) -> Vec<String> {
        if !self.scene_names.is_empty() {
            return self.scene_names.clone();
        }
        let val = if self.scenes < 2 { 0 } else { (self.scenes / 5).clamp(1, MINI_VAL.len()) };
        let train = (self.scenes - val).min(MINI_TRAIN.len());
        let official = MINI_TRAIN[..train].iter().chain(&MINI_VAL[..val]).map(|name| (*name).to_owned());
        let free = (FIRST_FREE_NUMBER..).map(|number| format!("scene-{number:04}"));
        official.chain(free).take(self.scenes).collect()
    }

    /// The cameras as written: scaled to `image_size`.
    pub(super) fn cameras(&self) -> Vec<RigCamera> {
        let resize = |camera: &RigCamera| match self.image_size {
            None => camera.clone(),
            Some(size) => RigCamera { intrinsics: scaled(&camera.intrinsics, size), ..camera.clone() },
        };
        self.rig.cameras.iter().map(resize).collect()
    }

    /// The generator's knobs with enough time for all key frames.
    pub(super) fn world_config(&self) -> WorldConfig {
        // Rounded up to whole seconds so that small changes of the timetable keep the worlds.
        let needed = timing::needed_secs(self.key_frames_per_scene).ceil();
        WorldConfig { duration_secs: self.world.duration_secs.max(needed), ..self.world.clone() }
    }

    /// # Errors
    /// [`DataError::Config`], naming the setting; calibration that no camera can have.
    pub(super) fn check(&self) -> Result<(), DataError> {
        let refuse = |text: String| Err(DataError::Config(text));
        let names = self.resolved_scene_names();
        if self.scenes == 0 || self.key_frames_per_scene == 0 {
            return refuse("a dataset needs at least one scene and one key frame per scene".to_owned());
        }
        if timing::needed_secs(self.key_frames_per_scene) > LONGEST_SCENE_SECS {
            let most = (1..).take_while(|n| timing::needed_secs(*n) <= LONGEST_SCENE_SECS).count();
            return refuse(format!("key_frames_per_scene is {}, at most {most} fit", self.key_frames_per_scene));
        }
        if names.len() != self.scenes {
            return refuse(format!("scene_names holds {} names for {} scenes", names.len(), self.scenes));
        }
        if !(1..=100).contains(&self.jpeg_quality) {
            return refuse(format!("jpeg_quality is {}, it must be 1 to 100", self.jpeg_quality));
        }
        if !(0.0..=1.0).contains(&self.sweep_drop_share) {
            return refuse(format!("sweep_drop_share is {}, it must be 0 to 1", self.sweep_drop_share));
        }
        check_names("version", std::slice::from_ref(&self.version))?;
        check_names("scene name", &names)?;
        self.check_rig()
    }

    fn check_rig(&self) -> Result<(), DataError> {
        if self.rig.is_empty() {
            return Err(DataError::Config("the rig has no cameras".to_owned()));
        }
        let mut channels: Vec<String> = self.rig.cameras.iter().map(|c| c.channel.clone()).collect();
        channels.push(super::lidar::CHANNEL.to_owned());
        check_names("channel", &channels)?;
        for camera in self.cameras() {
            if camera.lens != Lens::Pinhole {
                return Err(DataError::Config(format!(
                    "camera {} has a lens, but the nuScenes layout holds rectified pictures only; use a pinhole rig",
                    camera.channel
                )));
            }
            let calibration =
                |source| DataError::Calibration { row: camera.channel.clone(), source, path: self.out.clone() };
            camera.camera().map_err(calibration)?;
        }
        Ok(())
    }
}

/// In our pixel convention a resize scales all four numbers.
pub(crate) fn scaled(raw: &Intrinsics, (width, height): (u32, u32)) -> Intrinsics {
    let (sx, sy) = (f64::from(width) / f64::from(raw.width), f64::from(height) / f64::from(raw.height));
    Intrinsics { fx: raw.fx * sx, fy: raw.fy * sy, cx: raw.cx * sx, cy: raw.cy * sy, width, height }
}

/// `manifest.json` beside the data.
pub type Manifest = WriterManifest<NuScenesWriterConfig, ManifestScene>;

/// How a scene of the dataset came about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManifestScene {
    /// Its name in `scene.json`.
    pub name: String,
    /// [`world::World::generate`] with this seed and [`Manifest::config`]'s knobs ...
    pub world_seed: u64,
    /// ... and this duration in seconds gives the scene's world again.
    pub world_duration_secs: f64,
    /// The map it lies on.
    pub location: String,
    /// `p_map = p_world + this`, metres: worlds lie beside each other on one map.
    pub map_from_world: [f64; 2],
    /// The table stamp at which the world's time is zero, microseconds.
    pub start_us: i64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(scenes: usize) -> NuScenesWriterConfig {
        NuScenesWriterConfig {
            scenes,
            ..NuScenesWriterConfig::new(PathBuf::from("out"), CameraRig { cameras: vec![] })
        }
    }

    #[test]
    fn official_names_come_first_and_both_splits_are_served() {
        assert_eq!(config(1).resolved_scene_names(), ["scene-0061"]);
        assert_eq!(config(2).resolved_scene_names(), ["scene-0061", "scene-0103"]);
        let ten = config(10).resolved_scene_names();
        assert_eq!(ten[..8], MINI_TRAIN);
        assert_eq!(ten[8..], MINI_VAL);
        assert_eq!(config(12).resolved_scene_names()[10..], ["scene-2000", "scene-2001"]);
    }

    #[test]
    fn scaling_keeps_the_relative_principal_point() {
        let raw = Intrinsics { fx: 1200.0, fy: 1200.0, cx: 800.5, cy: 450.5, width: 1600, height: 900 };
        let small = scaled(&raw, (160, 90));
        assert!((small.cx - 80.05).abs() < 1e-12 && (small.fy - 120.0).abs() < 1e-12);
    }

    #[test]
    fn settings_that_cannot_be_met_name_themselves() {
        let text = |config: NuScenesWriterConfig| config.check().unwrap_err().to_string();
        assert!(text(config(0)).contains("at least one scene"));
        assert!(text(config(1)).contains("no cameras"));
        assert!(text(NuScenesWriterConfig { key_frames_per_scene: 400, ..config(1) }).contains("key_frames_per_scene"));
        let names = vec!["a".to_owned(), "a".to_owned()];
        assert!(text(NuScenesWriterConfig { scene_names: names, ..config(2) }).contains("occurs twice"));
        assert!(text(NuScenesWriterConfig { version: "../x".to_owned(), ..config(1) }).contains("version"));
    }
}
