//! Mean pictures of each camera: what a network that has learned nothing but the average would paint.

use std::sync::Arc;

use data::{ImageSize, PadViews, PoseMode, Sample, SampleOptions, SceneDataset, SceneFrame, novel_targets};
use metrics::MeanImages;
use rayon::prelude::*;

/// Mean training picture per camera, as mounted and after each turn of the rig.
#[derive(Debug, Clone, Default)]
pub struct MeanPictures(MeanImages);

impl MeanPictures {
    /// Averages `frames` frames of each training dataset, spread evenly.
    ///
    /// # Errors
    /// Whatever a frame's pictures report.
    pub fn measure(
        datasets: &[Arc<dyn SceneDataset>],
        frames: usize,
        size: ImageSize,
        pose_mode: PoseMode,
        yaw_deg: &[f64],
    ) -> anyhow::Result<Self> {
        let mut means = MeanImages::default();
        for dataset in datasets {
            let parts: Vec<MeanImages> = spread(dataset.len(), frames)
                .into_par_iter()
                .map(|index| of_frame(&dataset.frame(index)?, size, pose_mode, yaw_deg))
                .collect::<anyhow::Result<_>>()?;
            // In the frames' order, so that the sums do not depend on threads.
            for part in parts {
                means.merge(part);
            }
        }
        Ok(Self(means))
    }

    /// The mean colour over all cameras, RGB in [0, 1]; mid grey when nothing was averaged.
    pub fn colour(&self) -> [f32; 3] {
        let pictures: Vec<Vec<f32>> = self.0.views().filter_map(|view| self.0.mean(view)).collect();
        if pictures.is_empty() {
            return [0.5; 3];
        }
        std::array::from_fn(|c| {
            let channel = |picture: &Vec<f32>| {
                let plane = picture.len() / 3;
                picture[c * plane..(c + 1) * plane].iter().sum::<f32>() / plane as f32
            };
            pictures.iter().map(channel).sum::<f32>() / pictures.len() as f32
        })
    }

    /// The mean picture of a camera of a rig turned by `yaw_deg`; `None` for a camera that training has not seen.
    pub fn of(&self, channel: &str, yaw_deg: f64) -> Option<Vec<f32>> {
        self.0.mean(&key(channel, yaw_deg))
    }
}

fn key(channel: &str, yaw_deg: f64) -> String {
    format!("{channel}@{yaw_deg}")
}

fn of_frame(frame: &SceneFrame, size: ImageSize, pose_mode: PoseMode, yaw_deg: &[f64]) -> anyhow::Result<MeanImages> {
    let mut means = MeanImages::default();
    let sample = Sample::load(frame, &SampleOptions { size, pose_mode })?;
    for view in &sample.target {
        if let Some(image) = &view.image {
            means.update(&key(&view.channel, 0.0), image);
        }
    }
    if renders(frame) {
        for yaw in yaw_deg {
            let turned = turned_pictures(frame, *yaw, size)?;
            for (view, image) in frame.views.iter().zip(turned) {
                means.update(&key(&view.channel, *yaw), &image);
            }
        }
    }
    Ok(means)
}

/// Whether ground truth of moved cameras can be had for this frame.
pub fn renders(frame: &SceneFrame) -> bool {
    !frame.views.is_empty()
        && frame.views.iter().all(|view| matches!(view.image, Some(data::ImageSource::Rendered { .. })))
}

/// What the rig would have seen, turned about the vertical by `yaw_deg` (left positive), one picture per camera.
pub fn turned_pictures(frame: &SceneFrame, yaw_deg: f64, size: ImageSize) -> anyhow::Result<Vec<Vec<f32>>> {
    let rig = frame.rig().rotated(yaw_deg.to_radians());
    let arrays = novel_targets(std::slice::from_ref(frame), &[rig], size, PadViews::Largest)?;
    let numbers = 3 * arrays.height * arrays.width;
    Ok(arrays.images.chunks_exact(numbers).map(<[f32]>::to_vec).collect())
}

/// `count` indices spread evenly over `0..len`; all of them for 0 or more than there are.
pub fn spread(len: usize, count: usize) -> Vec<usize> {
    if count == 0 || count >= len {
        return (0..len).collect();
    }
    (0..count).map(|i| (2 * i + 1) * len / (2 * count)).collect()
}
