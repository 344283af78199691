//! One frame with its pixels at network size and the matrices that belong to them.

use std::sync::Arc;

use geometry::glam::{DMat3, DVec3};
use geometry::{CameraRig, ImageEdit, RigCamera, Rigid};
use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::undistort::{load_pinhole, load_pinhole_mask};
use crate::{DataError, FrameId, ImageSource, SceneFrame, View};

/// Network picture size; a raw picture is stretched to it, aspect ratio not kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageSize {
    /// Rows, px.
    pub height: u32,
    /// Columns, px.
    pub width: u32,
}

impl ImageSize {
    /// As many rows as columns.
    pub const fn square(side: u32) -> Self {
        Self { height: side, width: side }
    }
}

/// Which pose a camera gets while the car moves between the exposures of its cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseMode {
    /// The mounting pose, as if all views were simultaneous; what released BEV-VAE checkpoints were trained with.
    Static,
    /// The pose at the picture's own instant in the ego frame of the frame's reference instant.
    #[default]
    Compensated,
}

/// How frames become samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleOptions {
    /// Network picture size.
    pub size: ImageSize,
    /// Poses of the cameras.
    pub pose_mode: PoseMode,
}

/// All views of one frame, twice: as the encoder sees them and as the decoder shall paint them.
#[derive(Debug, Clone)]
pub struct Sample {
    /// Where it comes from.
    pub id: FrameId,
    /// Reference instant.
    pub timestamp_ns: i64,
    /// The car at the reference instant.
    pub world_from_ego: Rigid,
    /// The dataset's own words.
    pub text: Option<String>,
    /// What is encoded; augmentation changes it.
    pub input: Vec<SampleView>,
    /// What is decoded; clean.
    pub target: Vec<SampleView>,
}

/// One pinhole view at network size.
#[derive(Debug, Clone)]
pub struct SampleView {
    /// The channel's name in its dataset.
    pub channel: String,
    /// RGB in [0, 1], `[3, H, W]`; `None` masks the view out.
    pub image: Option<Arc<Vec<f32>>>,
    /// `[H, W]`, false where the dataset says to ignore the pixel; `None` where every pixel counts.
    pub pixel_mask: Option<Arc<Vec<bool>>>,
    /// Camera matrix of the raw picture, px.
    pub k: DMat3,
    /// Pose, metres.
    pub ego_from_cam: Rigid,
    /// Raw to network pixels.
    pub edit: ImageEdit,
}

impl Sample {
    /// Decodes or renders every view of a frame. Distorted pictures come back as pinhole pictures with the same K.
    ///
    /// # Errors
    /// [`DataError::Frame`] naming the frame, around whatever is wrong with a picture or its calibration.
    pub fn load(frame: &SceneFrame, options: &SampleOptions) -> Result<Self, DataError> {
        let views: Result<Vec<SampleView>, DataError> =
            frame.views.iter().map(|view| SampleView::load(view, &frame.world_from_ego, options)).collect();
        let views = views.map_err(|source| in_frame(&frame.id, source))?;
        Ok(Self {
            id: frame.id.clone(),
            timestamp_ns: frame.timestamp_ns,
            world_from_ego: frame.world_from_ego,
            text: frame.scene_text.clone(),
            input: views.clone(),
            target: views,
        })
    }

    /// Redefines the ego frame, for all cameras and for the car's own pose: `ego_from_cam ← new_from_ego · ego_from_cam`.
    pub fn move_rig(&mut self, new_from_ego: &Rigid) {
        self.world_from_ego = self.world_from_ego * new_from_ego.inverse();
        for view in self.input.iter_mut().chain(&mut self.target) {
            view.ego_from_cam = *new_from_ego * view.ego_from_cam;
        }
    }
}

/// Wraps an error once in the name of its frame.
pub(crate) fn in_frame(id: &FrameId, source: DataError) -> DataError {
    match source {
        DataError::Frame { .. } => source,
        source => DataError::Frame {
            dataset: id.dataset.clone(),
            scene: id.scene.clone(),
            frame: id.frame.clone(),
            source: Box::new(source),
        },
    }
}

impl SampleView {
    fn load(view: &View, world_from_ref_ego: &Rigid, options: &SampleOptions) -> Result<Self, DataError> {
        let mut loaded = Self::of_camera(&view.rig_camera(), options.size);
        if options.pose_mode == PoseMode::Compensated {
            loaded.ego_from_cam = view.ref_ego_from_cam(world_from_ref_ego);
        }
        if let Some(source) = &view.image {
            loaded.image = Some(Arc::new(planar(&load_pinhole(source, view, &loaded.edit)?)));
            let mask = view.mask.as_ref().map(|mask| load_pinhole_mask(mask, view, &loaded.edit));
            loaded.pixel_mask = mask.transpose()?.map(Arc::new);
        }
        Ok(loaded)
    }

    /// A camera of a rig without its picture.
    pub fn of_camera(camera: &RigCamera, size: ImageSize) -> Self {
        let raw = &camera.intrinsics;
        Self {
            channel: camera.channel.clone(),
            image: None,
            pixel_mask: None,
            k: raw.matrix(),
            ego_from_cam: camera.ego_from_cam,
            edit: ImageEdit::identity(raw.width, raw.height).resize(size.width, size.height),
        }
    }

    /// Mirrors pixels, their mask and the matrix.
    pub fn flip(&mut self) {
        let width = self.edit.width as usize;
        self.edit_pixels(|pixels| pixels.chunks_exact_mut(width).for_each(<[f32]>::reverse));
        if let Some(mask) = &mut self.pixel_mask {
            Arc::make_mut(mask).chunks_exact_mut(width).for_each(<[bool]>::reverse);
        }
        self.edit = self.edit.flip();
    }

    /// Changes the `[3, H, W]` pixels of this view only; nothing happens to a masked view.
    pub(crate) fn edit_pixels(&mut self, change: impl FnOnce(&mut [f32])) {
        if let Some(image) = &mut self.image {
            let pixels: &mut Vec<f32> = Arc::make_mut(image);
            change(pixels);
        }
    }

    /// Rows of the 3×4 matrix `p ↦ (u·z, v·z, z)` from ego metres to network pixels.
    pub fn img_from_ego(&self) -> [[f64; 4]; 3] {
        let img_from_cam = self.edit.img_from_raw * self.k;
        let cam_from_ego = self.ego_from_cam.inverse();
        rows(&(img_from_cam * cam_from_ego.rotation_matrix()), img_from_cam * cam_from_ego.translation)
    }

    /// Rows of the 3×4 matrix `(u·z, v·z, z) ↦ p` from network pixels times depth to ego metres.
    pub fn ego_from_img(&self) -> [[f64; 4]; 3] {
        let cam_from_img = (self.edit.img_from_raw * self.k).inverse();
        rows(&(self.ego_from_cam.rotation_matrix() * cam_from_img), self.ego_from_cam.translation)
    }
}

fn rows(linear: &DMat3, offset: DVec3) -> [[f64; 4]; 3] {
    std::array::from_fn(|i| {
        let row = linear.row(i);
        [row.x, row.y, row.z, offset[i]]
    })
}

/// Interleaved bytes to planes in [0, 1].
fn planar(image: &RgbImage) -> Vec<f32> {
    let plane = image.width() as usize * image.height() as usize;
    let mut out = vec![0.0; 3 * plane];
    for (channel, plane) in out.chunks_exact_mut(plane.max(1)).enumerate() {
        for (value, pixel) in plane.iter_mut().zip(image.as_raw().chunks_exact(3)) {
            *value = f32::from(pixel[channel]) / 255.0;
        }
    }
    out
}

/// The frame as other cameras on the same car would see it at its reference instant.
///
/// A rendered frame gets rendered views of its own world. Nobody took the pictures a real frame would need: its new views have
/// `image: None`.
///
/// # Errors
/// [`DataError::Frame`] around a camera that cannot be used.
pub fn rerig(frame: &SceneFrame, rig: &CameraRig) -> Result<SceneFrame, DataError> {
    let snapshot = frame.views.iter().find_map(|view| match &view.image {
        Some(ImageSource::Rendered { snapshot, .. }) => Some(snapshot),
        _ => None,
    });
    let views = rig.cameras.iter().map(|mounted| {
        let camera = mounted
            .camera()
            .map_err(|e| in_frame(&frame.id, DataError::Config(format!("camera {}: {e}", mounted.channel))))?;
        let image = snapshot.map(|snapshot| ImageSource::Rendered {
            snapshot: snapshot.clone(),
            camera,
            world_from_cam: frame.world_from_ego * mounted.ego_from_cam,
        });
        let view = View::of_camera(mounted, frame.world_from_ego);
        Ok(View { timestamp_ns: frame.timestamp_ns, image, ..view })
    });
    let views = views.collect::<Result<Vec<View>, DataError>>()?;
    Ok(SceneFrame { views, ..frame.clone() })
}
