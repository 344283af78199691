//! Random changes of a sample, drawn from the run's seed and the item's number only.
//!
//! Pixels of the input are flipped and recoloured; the target stays the clean picture under its own matrix (the public BEV-VAE loader
//! decodes the clean picture under the flipped matrix). The rig motion redefines the ego frame for input and target alike.

mod color;

use geometry::Rigid;
use geometry::glam::DVec3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::seeding::{Purpose, rng};
use crate::{DataError, Sample};

pub use color::ColorJitter;

/// What may happen to a sample; everything is off by default.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AugmentConfig {
    /// Chance that an input view is mirrored left and right, its matrix with it.
    pub flip_probability: f64,
    /// Colours of input views.
    pub color_jitter: ColorJitter,
    /// Chance that an input view loses its colours.
    pub grayscale_probability: f64,
    /// Random ego frame.
    pub rig_motion: RigMotion,
    /// Chance that a view is removed from the input and stays a target; at least one view always remains.
    pub drop_view_probability: f64,
}

/// A random rigid motion of the ego frame, one for all cameras of a sample: `ego_from_cam ← M · ego_from_cam`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigMotion {
    /// Chance that it happens.
    pub probability: f64,
    /// Yaw is uniform in ± this many degrees.
    pub yaw_deg: f64,
    /// x and y shifts are uniform in ± this many metres.
    pub shift_m: f64,
}

impl Default for RigMotion {
    /// Off; the ranges are those of the public BEV-VAE settings (any heading, 10 % of a 102.4 m grid).
    fn default() -> Self {
        Self { probability: 0.0, yaw_deg: 180.0, shift_m: 10.24 }
    }
}

impl AugmentConfig {
    /// Refuses numbers without a meaning.
    ///
    /// # Errors
    /// [`DataError::Config`] naming the setting.
    pub fn validate(&self) -> Result<(), DataError> {
        let probabilities = [
            ("flip_probability", self.flip_probability),
            ("color_jitter.probability", self.color_jitter.probability),
            ("grayscale_probability", self.grayscale_probability),
            ("rig_motion.probability", self.rig_motion.probability),
            ("drop_view_probability", self.drop_view_probability),
        ];
        if let Some((name, value)) = probabilities.into_iter().find(|(_, p)| !(0.0..=1.0).contains(p)) {
            return Err(DataError::Config(format!("augment.{name} must lie in 0..=1, but is {value}")));
        }
        let ranges = [
            ("color_jitter.brightness", self.color_jitter.brightness, 1.0),
            ("color_jitter.contrast", self.color_jitter.contrast, 1.0),
            ("color_jitter.saturation", self.color_jitter.saturation, 1.0),
            ("color_jitter.hue", self.color_jitter.hue, 0.5),
            ("rig_motion.yaw_deg", self.rig_motion.yaw_deg, 180.0),
            ("rig_motion.shift_m", self.rig_motion.shift_m, f64::MAX),
        ];
        match ranges.into_iter().find(|(_, value, most)| !(0.0..=*most).contains(value)) {
            Some((name, value, most)) => {
                Err(DataError::Config(format!("augment.{name} must lie in 0..={most}, but is {value}")))
            }
            None => Ok(()),
        }
    }

    /// Changes the sample that is item `item` of the run with this seed.
    pub fn apply(&self, sample: &mut Sample, seed: u64, item: u64) {
        let mut rng = rng(seed, Purpose::Augment, item, 0);
        if rng.random_bool(self.rig_motion.probability) {
            let motion = self.rig_motion.draw(&mut rng);
            sample.move_rig(&motion);
        }
        self.drop_views(sample, &mut rng);
        for view in &mut sample.input {
            if rng.random_bool(self.flip_probability) {
                view.flip();
            }
            if rng.random_bool(self.color_jitter.probability) {
                let change = self.color_jitter.draw(&mut rng);
                view.edit_pixels(|pixels| change.apply(pixels));
            }
            if rng.random_bool(self.grayscale_probability) {
                view.edit_pixels(color::to_gray);
            }
        }
    }

    fn drop_views(&self, sample: &mut Sample, rng: &mut ChaCha8Rng) {
        let present: Vec<usize> = (0..sample.input.len()).filter(|i| sample.input[*i].image.is_some()).collect();
        if self.drop_view_probability == 0.0 || present.is_empty() {
            return;
        }
        let kept = present[rng.random_range(0..present.len())];
        for i in present {
            if rng.random_bool(self.drop_view_probability) && i != kept {
                sample.input[i].image = None;
            }
        }
    }
}

impl RigMotion {
    fn draw(&self, rng: &mut ChaCha8Rng) -> Rigid {
        let yaw = rng.random_range(-1.0..=1.0) * self.yaw_deg.to_radians();
        let mut shift = || rng.random_range(-1.0..=1.0) * self.shift_m;
        let (x, y) = (shift(), shift());
        Rigid::from_yaw(yaw, DVec3::new(x, y, 0.0))
    }
}
