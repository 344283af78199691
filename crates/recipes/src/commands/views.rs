//! What `novel-view` and `change-rig` share: moved rigs, decoding them, and their truth where it can be rendered.

use clap::Args;
use data::{ImageSize, SceneFrame};
use geometry::glam::DVec3;
use geometry::{CameraRig, Rigid};
use metrics::NovelViews;

use super::UsageError;
use super::common::{LoadedModel, say};
use super::pictures::PictureArgs;
use crate::bev_vae::{Coded, Viewer, pictures_of};
use crate::sheet::Sheet;

/// Turns and shifts of a rig.
#[derive(Debug, Clone, Default, Args)]
pub struct MotionArgs {
    /// Turns of the rig in degrees, left positive, for example --yaw=-30,30
    #[arg(long, value_name = "DEG", value_delimiter = ',', allow_hyphen_values = true, value_parser = parse_angle)]
    pub yaw: Vec<f64>,
    /// Shift of the rig in metres as x,y,z (forward, left, up); may be repeated
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_shift, allow_hyphen_values = true)]
    pub shift: Vec<DVec3>,
}

pub(super) fn parse_angle(text: &str) -> Result<f64, String> {
    let angle: Option<f64> = text.trim().parse().ok();
    angle.filter(|angle| angle.is_finite()).ok_or_else(|| "write finite degrees, for example -30,30".to_owned())
}

fn parse_shift(text: &str) -> Result<DVec3, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    match numbers.map_err(|e| e.to_string())?.as_slice() {
        [x, y, z] if [x, y, z].iter().all(|v| v.is_finite()) => Ok(DVec3::new(*x, *y, *z)),
        _ => Err("write three finite numbers, x,y,z".to_owned()),
    }
}

/// A rig to decode and what it is called.
#[derive(Debug, Clone)]
pub(super) struct Asked {
    pub name: String,
    pub rig: CameraRig,
}

impl MotionArgs {
    pub(super) fn is_empty(&self) -> bool {
        self.yaw.is_empty() && self.shift.is_empty()
    }

    /// The rig turned and shifted, one entry per motion.
    pub(super) fn of(&self, name: &str, rig: &CameraRig) -> Vec<Asked> {
        let turned = self
            .yaw
            .iter()
            .map(|yaw| Asked { name: format!("{name} yaw {yaw:+} deg"), rig: rig.rotated(yaw.to_radians()) });
        let shifted = self.shift.iter().map(|shift| Asked {
            name: format!("{name} shift {:+} {:+} {:+} m", shift.x, shift.y, shift.z),
            rig: rig.moved(&Rigid::from_yaw(0.0, *shift)),
        });
        turned.chain(shifted).collect()
    }
}

/// Decodes asked rigs frame by frame and collects sheet, pictures and measurements.
pub(super) struct Views<'a> {
    pub viewer: Viewer<'a>,
    args: &'a PictureArgs,
    size: ImageSize,
    sheet: Sheet,
    scores: NovelViews,
    frames: usize,
}

impl<'a> Views<'a> {
    pub fn new(loaded: &'a LoadedModel, args: &'a PictureArgs) -> Self {
        let size = loaded.experiment.image_size();
        Self {
            viewer: Viewer::new(&loaded.experiment, &loaded.model, &loaded.device),
            args,
            size,
            sheet: Sheet::new(size.height as usize, size.width as usize),
            scores: NovelViews::default(),
            frames: 0,
        }
    }

    /// Adds one frame: its input, then each rig decoded and, where it can be rendered, the truth.
    pub fn add(&mut self, frame: &SceneFrame, asked: &[Asked]) -> anyhow::Result<()> {
        let coded = self.viewer.encode(frame)?;
        self.sheet.row(coded.pictures());
        for one in asked {
            self.add_rig(frame, &coded, one)?;
        }
        self.sheet.space();
        self.frames += 1;
        Ok(())
    }

    fn add_rig(&mut self, frame: &SceneFrame, coded: &Coded, Asked { name, rig }: &Asked) -> anyhow::Result<()> {
        let decoded = self.viewer.decode(coded, &self.viewer.cameras(rig)?);
        self.sheet.row(decoded.iter().map(Vec::as_slice));
        self.args.save(name, frame, rig, &decoded, self.size)?;
        let Some(truth) = self.viewer.truth(frame, rig)? else { return Ok(()) };
        let (height, width) = (self.size.height as usize, self.size.width as usize);
        let size = metrics::ImageSize { channels: 3, height, width };
        for (picture, truth) in decoded.iter().zip(pictures_of(&truth)) {
            self.scores.update(name, picture, truth, size);
        }
        self.sheet.row(pictures_of(&truth));
        Ok(())
    }

    /// Writes the sheet and says what was measured.
    pub fn finish(self) -> anyhow::Result<()> {
        if self.frames == 0 {
            return Err(UsageError::of("there is no frame to encode; --frames and the data's split say which"));
        }
        self.sheet.save(&self.args.out)?;
        for score in self.scores.summaries() {
            let db = score.psnr.mean_db.map_or_else(|| "-".to_owned(), |db| format!("{db:.2} dB"));
            let ssim = score.ssim.map_or_else(|| "-".to_owned(), |ssim| format!("{ssim:.4}"));
            let pictures = score.psnr.images;
            say(format_args!(
                "{}: PSNR {db}, SSIM {ssim} against rendered truth over {pictures} pictures",
                score.motion
            ))?;
        }
        say(format_args!(
            "rows per frame: input, then per asked rig the decoded views and, where it can be rendered, their truth; written to {}",
            self.args.out.display()
        ))
    }
}

#[cfg(test)]
mod tests {
    use geometry::RigPreset;

    use super::*;

    #[test]
    fn every_motion_is_named_and_moves_the_rig() {
        let motions = MotionArgs { yaw: vec![-30.0, 30.0], shift: vec![DVec3::new(0.0, 1.5, -0.25)] };
        let rig = RigPreset::Waymo.rig();
        let asked = motions.of("waymo", &rig);
        let names: Vec<&str> = asked.iter().map(|one| one.name.as_str()).collect();
        assert_eq!(names, ["waymo yaw -30 deg", "waymo yaw +30 deg", "waymo shift +0 +1.5 -0.25 m"]);
        let turn = asked[1].rig.cameras[2].azimuth() - rig.cameras[2].azimuth();
        assert!((turn.to_degrees() - 30.0).abs() < 1e-9);
        let moved = asked[2].rig.cameras[0].ego_from_cam.translation - rig.cameras[0].ego_from_cam.translation;
        assert!((moved - DVec3::new(0.0, 1.5, -0.25)).length() < 1e-12);
        assert!(parse_angle("inf").is_err() && parse_shift("1,2").is_err() && parse_shift("1,2,nan").is_err());
    }
}
