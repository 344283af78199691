//! Pages of sampled layouts: every camera's decoded picture with the boxes where its calibration puts them, the layout from above beside.

use std::path::Path;

use data::{FrameId, LocalMap, SceneFrame, View};
use geometry::{CameraRig, Rigid};
use image::RgbImage;

use super::sample::LatentSampler;
use super::step::Frozen;
use super::{DitExperiment, LatentItem, NoiseKey};
use crate::sheet::{rgb_image, save_picture};
use crate::show::{Layer, PageContent, PageOptions, draw_page};

/// One page per layout and guidance: 0, 1, and that of the config.
pub(super) fn draw_pages(
    (frozen, sampler, experiment): (&Frozen, &LatentSampler, &DitExperiment),
    items: &[LatentItem],
    (rig, keys): (&CameraRig, &[NoiseKey]),
    folder: &Path,
) -> anyhow::Result<()> {
    let layouts: Vec<_> = items.iter().map(|item| &item.layout).collect();
    let best = experiment.sampling.guidance;
    let grid = &frozen.conditioner.grid;
    let range_m = grid.x_range.iter().chain(&grid.y_range).fold(0f64, |most, end| most.max(end.abs()));
    let options = PageOptions { width: experiment.preview.width, range_m, layers: vec![Layer::Boxes] };
    let cameras = frozen.vae.cameras(rig)?;
    for guidance in [best.with_scale(0.0), best.with_scale(1.0), best] {
        let latents = sampler.sample(&layouts, keys, &experiment.preview_sampler(), guidance)?;
        for (number, item) in items.iter().enumerate() {
            let decoded = frozen.vae.decode(latents.clone().narrow(0, number, 1), &cameras);
            let size = frozen.vae.image_size();
            let pictures = decoded.iter().map(|values| rgb_image(values, size.height, size.width)).collect();
            let content = PageContent {
                frame: painted_frame(item, rig, pictures, guidance.scale()),
                map: LocalMap::default(),
                occupancy: None,
                lacking: Vec::new(),
            };
            let name = format!("layout_{number}_guidance_{}.png", guidance.scale());
            save_picture(&draw_page(content, &options)?, &folder.join(name))?;
        }
    }
    Ok(())
}

/// The frame that the pictures stand for.
fn painted_frame(item: &LatentItem, rig: &CameraRig, pictures: Vec<RgbImage>, scale: f64) -> SceneFrame {
    let view = |(camera, picture): (&geometry::RigCamera, RgbImage)| {
        let bare = View::of_camera(camera, Rigid::IDENTITY);
        bare.with_picture(picture)
    };
    let FrameId { dataset, scene, frame } = &item.id;
    SceneFrame {
        id: FrameId { dataset: format!("{dataset}, guidance {scale}"), scene: scene.clone(), frame: frame.clone() },
        timestamp_ns: 0,
        world_from_ego: Rigid::IDENTITY,
        views: rig.cameras.iter().zip(pictures).map(view).collect(),
        boxes: Some(item.layout.annotations()),
        scene_text: None,
    }
}
