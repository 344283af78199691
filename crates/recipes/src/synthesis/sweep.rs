//! Quality against guidance: the same layouts with the same noise at several scales.

use anyhow::ensure;
use data::SceneDataset;
use data::layout::Layout;
use data::{ImageSource, SceneFrame};
use geometry::ImageEdit;
use image::RgbImage;
use metrics::{Moments, Raster, frechet_distance};
use serde::Serialize;

use super::{Synthesiser, cameras_of, noise_key};
use crate::bev_vae::spread;
use crate::evaluate::{FeatureNetwork, Pictures, network_input};

/// Cells along each side of a picture whose mean colours are its features where no network is given.
const COLOUR_CELLS: usize = 4;

/// What was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SweepReport {
    /// What the features are.
    pub features: String,
    /// Frames sampled at every scale.
    pub frames: usize,
    /// Pictures compared at every scale.
    pub pictures: usize,
    /// By scale, ascending as asked.
    pub points: Vec<SweepPoint>,
}

/// One scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SweepPoint {
    /// Guidance scale.
    pub scale: f64,
    /// Fréchet distance of the pictures' features to those of the dataset's own pictures.
    pub distance: f64,
    /// Mean absolute difference to the pictures without guidance by the layout (scale 0), in [0, 1]: how much the layout changes.
    pub change: f64,
}

/// Samples `count` annotated frames spread over a dataset at every scale and compares their pictures with the dataset's own, at the
/// network's size. `network` looks at the pictures; without it mean colours of 4x4 cells do.
///
/// # Errors
/// A frame without boxes or pictures, whatever the model or the network says; fewer than two pictures.
pub fn sweep_guidance(
    (synthesiser, dataset, seed): (&Synthesiser, &dyn SceneDataset, u64),
    count: usize,
    scales: &[f64],
    network: Option<&dyn FeatureNetwork>,
    progress: &mut dyn FnMut(usize, usize),
) -> anyhow::Result<SweepReport> {
    let frames = spread(dataset.len(), count);
    let mut real = Side::new(network);
    let mut made: Vec<Side<'_>> = scales.iter().map(|_| Side::new(network)).collect();
    let mut changes = vec![0.0; scales.len()];
    for (done, index) in frames.iter().enumerate() {
        progress(done, frames.len());
        let frame = dataset.frame(*index)?;
        ensure!(frame.boxes.is_some(), "frame {} of {} is not annotated", frame.id.frame, frame.id.scene);
        let layout = Layout::of_frame(&frame, &synthesiser.dit.conditioner.classes);
        let shown: Vec<bool> = frame.views.iter().map(|view| view.image.is_some()).collect();
        real.add(&real_pictures(&frame, synthesiser)?)?;
        let rig = cameras_of(&frame, synthesiser.pose_mode());
        let paint = |scale: f64| -> anyhow::Result<Vec<RgbImage>> {
            let guidance = synthesiser.guidance.with_scale(scale);
            let latent = synthesiser.latent_guided(&layout, &noise_key(seed, &frame.id, 0), guidance)?;
            let pictures = synthesiser.pictures(latent, &rig)?;
            Ok(pictures.into_iter().zip(&shown).filter(|(_, shown)| **shown).map(|(picture, _)| picture).collect())
        };
        let free = paint(0.0)?;
        for ((scale, side), change) in scales.iter().zip(&mut made).zip(&mut changes) {
            let pictures = if *scale == 0.0 { free.clone() } else { paint(*scale)? };
            *change += difference(&free, &pictures) / frames.len() as f64;
            side.add(&pictures)?;
        }
    }
    let pictures = real.count;
    let truth = real.moments.statistics("the dataset's pictures")?;
    let mut points = Vec::new();
    for ((scale, side), change) in scales.iter().zip(made).zip(changes) {
        let distance = frechet_distance(&truth, &side.moments.statistics("sampled pictures")?)?.value;
        points.push(SweepPoint { scale: *scale, distance, change });
    }
    let features =
        network.map_or_else(|| "mean colours of 4x4 cells".to_owned(), |network| network.feature().network.clone());
    Ok(SweepReport { features, frames: frames.len(), pictures, points })
}

fn real_pictures(frame: &SceneFrame, synthesiser: &Synthesiser) -> anyhow::Result<Vec<RgbImage>> {
    let size = synthesiser.vae.image_size();
    let load = |source: &ImageSource| {
        let (width, height) = source.size();
        source.load(&ImageEdit::identity(width, height).resize(size.width, size.height))
    };
    Ok(frame.views.iter().filter_map(|view| view.image.as_ref()).map(load).collect::<Result<_, _>>()?)
}

struct Side<'a> {
    network: Option<&'a dyn FeatureNetwork>,
    moments: Moments,
    count: usize,
}

impl<'a> Side<'a> {
    fn new(network: Option<&'a dyn FeatureNetwork>) -> Self {
        let width = network.map_or(3 * COLOUR_CELLS * COLOUR_CELLS, FeatureNetwork::width);
        Self { network, moments: Moments::new(width), count: 0 }
    }

    fn add(&mut self, pictures: &[RgbImage]) -> anyhow::Result<()> {
        for picture in pictures {
            let row = match self.network {
                None => colours(picture)?,
                Some(network) => {
                    let (height, width) = (picture.height() as usize, picture.width() as usize);
                    let raster = Raster { height, width, pixels: picture.as_raw().clone() };
                    let values = network_input(&raster, network.feature());
                    let [height, width] = network.feature().size;
                    network.features(Pictures { count: 1, height, width, values: &values })?
                }
            };
            self.moments.update(&row)?;
            self.count += 1;
        }
        Ok(())
    }
}

/// Mean colours of the cells, in [0, 1].
fn colours(picture: &RgbImage) -> anyhow::Result<Vec<f32>> {
    let cells = COLOUR_CELLS as u32;
    let edit = ImageEdit::identity(picture.width(), picture.height()).resize(cells, cells);
    let size = picture.dimensions();
    let source = ImageSource::Memory { picture: std::sync::Arc::new(picture.clone()), size };
    let small = source.load(&edit)?;
    Ok(small.as_raw().iter().map(|value| f32::from(*value) / 255.0).collect())
}

fn difference(a: &[RgbImage], b: &[RgbImage]) -> f64 {
    let values =
        |pictures: &[RgbImage]| pictures.iter().flat_map(|picture| picture.as_raw().clone()).collect::<Vec<u8>>();
    let (a, b) = (values(a), values(b));
    let sum: f64 = a.iter().zip(&b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    sum / 255.0 / a.len().max(1) as f64
}
