//! Datasets with known content, without any world or real data.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use data::{Capabilities, DataError, FrameId, ImageSource, SceneDataset, SceneFrame, View};
use geometry::glam::{DMat3, DQuat, DVec2, DVec3};
use geometry::{Intrinsics, Lens, Rigid};
use image::{Rgb, RgbImage};

pub const RAW: Intrinsics = Intrinsics { fx: 40.0, fy: 42.0, cx: 31.0, cy: 25.5, width: 64, height: 48 };

/// A ring of cameras; frame i, view v has its own picture, and a fault where a test wants one.
pub struct Ring {
    pub name: &'static str,
    pub views: usize,
    pub frames: usize,
    /// Frames whose rows cannot be read.
    pub bad_rows: Vec<usize>,
    /// Frames that panic.
    pub panics: Vec<usize>,
    /// Views without a picture in every frame.
    pub absent: Vec<usize>,
    pub folder: PathBuf,
    /// How often a frame was asked for.
    pub asked: Arc<AtomicUsize>,
}

impl Ring {
    pub fn new(folder: &Path, name: &'static str, views: usize, frames: usize) -> Self {
        let ring = Self {
            name,
            views,
            frames,
            bad_rows: vec![],
            panics: vec![],
            absent: vec![],
            folder: folder.to_owned(),
            asked: Arc::default(),
        };
        for frame in 0..frames {
            for view in 0..views {
                let tone = |x: u32, y: u32, c: u32| ((frame * 37 + view * 61) as u32 + x * 3 + y * 5 + c * 80) as u8;
                let picture = RgbImage::from_fn(RAW.width, RAW.height, |x, y| Rgb([0, 1, 2].map(|c| tone(x, y, c))));
                picture.save(ring.path(frame, view)).unwrap();
            }
        }
        ring
    }

    pub fn path(&self, frame: usize, view: usize) -> PathBuf {
        self.folder.join(format!("{}-{frame}-{view}.png", self.name))
    }

    pub fn ego_from_cam(&self, view: usize) -> Rigid {
        ring_pose(view as f64 * std::f64::consts::TAU / self.views as f64)
    }
}

/// A camera 1.5 m above the ground that looks along `azimuth` (left positive), half a metre off the origin.
pub fn ring_pose(azimuth: f64) -> Rigid {
    let ego_from_forward_cam = DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X);
    let turn = DQuat::from_rotation_z(azimuth);
    Rigid::new(turn * DQuat::from_mat3(&ego_from_forward_cam), turn * DVec3::new(0.5, 0.0, 1.5))
}

/// The car at a time; it drives and turns.
pub fn car(seconds: f64) -> Rigid {
    Rigid::from_yaw(0.3 + 0.2 * seconds, DVec3::new(1000.0 + 10.0 * seconds, -500.0, 2.0))
}

impl SceneDataset for Ring {
    fn len(&self) -> usize {
        self.frames
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        self.asked.fetch_add(1, Ordering::Relaxed);
        assert!(!self.panics.contains(&index), "this frame panics");
        if self.bad_rows.contains(&index) {
            return Err(DataError::Config("these rows are bad".into()));
        }
        let seconds = index as f64 * 0.5;
        let view = |view: usize| {
            // Each camera exposes 10 ms after the one before.
            let delay = view as f64 * 0.01;
            let size = (RAW.width, RAW.height);
            View {
                channel: format!("CAM_{view}"),
                timestamp_ns: ((seconds + delay) * 1e9) as i64,
                image: (!self.absent.contains(&view))
                    .then(|| ImageSource::File { file: self.path(index, view).into(), size }),
                mask: None,
                intrinsics: RAW,
                lens: Lens::Pinhole,
                ego_from_cam: self.ego_from_cam(view),
                world_from_ego: car(seconds + delay),
            }
        };
        Ok(SceneFrame {
            id: FrameId { dataset: self.name.into(), scene: "ring".into(), frame: index.to_string() },
            timestamp_ns: (seconds * 1e9) as i64,
            world_from_ego: car(seconds),
            views: (0..self.views).map(view).collect(),
            boxes: None,
            scene_text: None,
        })
    }

    fn scene_ranges(&self) -> Vec<std::ops::Range<usize>> {
        std::iter::once(0..self.frames).collect()
    }

    fn name(&self) -> &str {
        self.name
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities::default()
    }

    fn max_views(&self) -> usize {
        self.views
    }
}

/// A picture of one raw pixel whose value is all there is.
pub fn dot(path: &Path, at: DVec2) {
    let mut picture = RgbImage::new(RAW.width, RAW.height);
    picture.put_pixel(at.x as u32, at.y as u32, Rgb([255, 255, 255]));
    picture.save(path).unwrap();
}
